"""Errors of the model."""

from needle_ros.errors import NeedleError


class ToleranceError(NeedleError):
    """The requested accuracy cannot be reached."""


class InsertedLengthError(NeedleError):
    """The inserted length left the range in which the equations are regular."""
