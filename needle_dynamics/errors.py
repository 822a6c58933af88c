"""What can go wrong in the model."""

from needle_ros.errors import NeedleError


class ToleranceError(NeedleError):
    """An accuracy that was asked for cannot be reached."""


class InsertedLengthError(NeedleError):
    """The inserted length left the range in which the equations are regular."""
