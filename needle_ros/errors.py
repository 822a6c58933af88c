"""What can go wrong, as types: every error of these packages is a `NeedleError`."""

from typing import Final

#: Longest line that is said.
_LONGEST: Final = 500


class NeedleError(Exception):
    """Base of all errors raised on purpose; its message is one line for a person."""

    def __str__(self) -> str:
        # It may have names from a recording, or from another's folder.
        return shown(super().__str__())


class JobError(NeedleError):
    """A job failed though nothing was wrong with what it was given."""


class ParameterError(NeedleError, ValueError):
    """A parameter is unknown, missing, or outside its valid range."""


class MessageError(NeedleError, ValueError):
    """Bytes are not a message of the type that they should be."""


class ShapeError(NeedleError, ValueError):
    """An array does not have the shape that is needed."""


def shown(text: str) -> str:
    """
    Return text as a terminal and a file can show it in a line: without what would steer them.

    Parameters
    ----------
    text : str
        May have whatever a message or a name has.

    Returns
    -------
    str
        The text, with blanks for line ends, and question marks for what cannot be printed.

    """
    if text.isprintable():
        return text
    return ''.join(one if one.isprintable() else ' ' if one.isspace() else '?' for one in text)


def printable(line: str) -> str:
    """
    Return a line for a log: as `shown`, and not too long.

    Parameters
    ----------
    line : str
        May have whatever a message had.

    Returns
    -------
    str
        The line.

    """
    return shown(f'{line[: _LONGEST - 4]} ...' if len(line) > _LONGEST else line)
