"""What can go wrong with recordings and with identification, as types."""

from needle_ros.errors import NeedleError


class RecordingError(NeedleError):
    """A recording cannot be written or read, or lacks what is needed."""


class IdentificationError(NeedleError):
    """The recordings do not determine the parameters."""
