# SPDX-License-Identifier: Apache-2.0
"""Parse axes and names with a sign, such as ``-x`` or ``-slide``, in options and parameters."""

from typing import Final

from needle_ros.errors import ParameterError

AXES: Final = ('x', 'y', 'z')  #: Axes of a frame, in the order of message fields.


def signed(text: str) -> tuple[float, str]:
    """Split a name into its sign (1 or -1, from a leading ``-``) and the rest."""
    return (-1.0, text[1:]) if text.startswith('-') else (1.0, text)


def signed_axis(text: str, what: str) -> tuple[float, str]:
    """Split an axis, such as ``-x``, into sign and name; reject names other than x, y, z."""
    sign, axis = signed(text)
    if axis not in AXES:
        raise ParameterError(f'{what} must be x, y, z, -x, -y or -z, got {text!r}')
    return sign, axis
