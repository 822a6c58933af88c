"""What can go wrong, as types: every error of these packages is a `NeedleError`."""


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
