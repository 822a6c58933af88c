"""What can go wrong, as types: every error of these packages is a `NeedleError`."""

from typing import Final

#: Longest line that is said.
_LONGEST: Final = 500


class NeedleError(Exception):
    """Base of all errors raised on purpose; its message is one line for a person."""


class JobError(NeedleError):
    """A job failed though nothing was wrong with what it was given."""


class ParameterError(NeedleError, ValueError):
    """A parameter is unknown, missing, or outside its valid range."""


class MessageError(NeedleError, ValueError):
    """Bytes are not a message of the type that they should be."""


class ShapeError(NeedleError, ValueError):
    """An array does not have the shape that is needed."""


def printable(line: str) -> str:
    """
    Return a line as a terminal can show it: not too long, and without what would steer it.

    Parameters
    ----------
    line : str
        May have whatever a message had.

    Returns
    -------
    str
        The line.

    """
    if len(line) > _LONGEST:
        line = f'{line[: _LONGEST - 4]} ...'
    return ''.join(one if one.isprintable() else '?' for one in line)
