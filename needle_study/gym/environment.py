# SPDX-License-Identifier: Apache-2.0
"""Check the actions of an environment, and draw a needle without a graphics library."""

from typing import Any, Final

from needle_dynamics import FloatArray
from needle_dynamics.simulated.trajectory import floats
from needle_ros.errors import ParameterError, ShapeError
import numpy as np

_WIDTH, _HEIGHT, _MARGIN = 320, 120, 20  #: size of an image and depth 0 [pixels]

_TISSUE, _AIR, _NEEDLE, _TARGET = (
    (240, 205, 190), (255, 255, 255), (40, 40, 60), (200, 30, 30),
)  # fmt: skip

_SPOT: Final = 3  #: half of the size of the target [pixels]


def checked_actions(actions: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return actions as floats clipped to [-1, 1]; they must be finite and have the shape."""
    found = floats('actions', actions)
    if found.shape != shape:
        raise ShapeError(f'actions must have shape {shape}, got {found.shape}')
    wrong = found[~np.isfinite(found)]
    if len(wrong):
        raise ParameterError(f'actions must be finite, got {wrong[0]}')
    return np.clip(found, -1.0, 1.0)


def picture(length: float, deflection: float, tip: Any, target: Any) -> Any:
    """
    Return an image of tip and target, shape (height, width, 3), bytes.

    ``tip`` and ``target`` are depth and lateral position [m]. ``length`` is the depth at the right
    edge and ``deflection`` the lateral position at the upper edge [m].
    """
    image = np.full((_HEIGHT, _WIDTH, 3), _TISSUE, dtype=np.uint8)
    image[:, :_MARGIN] = _AIR

    def pixel(depth: float, lateral: float) -> tuple[int, int]:
        column = _MARGIN + (_WIDTH - 1 - _MARGIN) * depth / length
        row = 0.5 * (_HEIGHT - 1) * (1.0 - lateral / deflection)
        return int(np.clip(row, 0, _HEIGHT - 1)), int(np.clip(column, 0, _WIDTH - 1))

    row, column = pixel(*target)
    low, left = max(row - _SPOT, 0), max(column - _SPOT, 0)
    image[low : row + _SPOT + 1, left : column + _SPOT + 1] = _TARGET
    row, column = pixel(*tip)
    middle, columns = 0.5 * (_HEIGHT - 1), np.arange(column + 1)
    # A clamped beam with a load at its end, from the left edge to the tip.
    part = columns / max(column, 1)
    rows = middle + (row - middle) * 0.5 * part**2 * (3.0 - part)
    image[np.rint(rows).astype(int), columns] = _NEEDLE
    return image
