# SPDX-License-Identifier: Apache-2.0
"""Errors of recordings and of identification."""

from needle_ros.errors import NeedleError, shown


class RecordingError(NeedleError):
    """A recording cannot be written or read, or lacks required data."""


class IdentificationError(NeedleError):
    """The recordings do not determine the parameters."""


class WrongSignError(IdentificationError):
    """A constant that cannot be negative is clearly negative."""


class UnknownNameError(NeedleError, KeyError):
    """A result or a table has no item with this name."""

    def __str__(self) -> str:
        # A KeyError quotes its message.
        return shown(self.args[0])
