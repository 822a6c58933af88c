"""What can go wrong, as types: every error of this package is a `NeedleError`."""


class NeedleError(Exception):
    """Base of all errors raised on purpose; its message is one line for a person."""


class JobError(NeedleError):
    """A job failed though nothing was wrong with what it was given."""


class ParameterError(NeedleError, ValueError):
    """A parameter is unknown, missing, or outside its valid range."""


class ShapeError(NeedleError, ValueError):
    """An array does not have the shape the model needs."""


class ToleranceError(NeedleError):
    """An accuracy that was asked for cannot be reached."""


class InsertedLengthError(NeedleError):
    """The inserted length left the range in which the equations are regular."""
