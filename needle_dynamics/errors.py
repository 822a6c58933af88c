# SPDX-License-Identifier: Apache-2.0
"""Exceptions of the needle model."""

from needle_ros.errors import NeedleError


class ToleranceError(NeedleError):
    """The requested accuracy cannot be reached."""


class InsertionDepthError(NeedleError):
    """The insertion depth left the range in which the equations are regular."""
