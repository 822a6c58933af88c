# SPDX-License-Identifier: Apache-2.0
"""Resolution of measured values, such as the count of an encoder."""

from math import sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
import numpy as np

_EQUAL: Final = 1e-12  # relative difference of equal values, by rounding
_MULTIPLE: Final = 0.02  # largest deviation from a multiple of the resolution
_FARTHEST: Final = 5  # largest distance of the nearest two counts
_MOSTLY: Final = 0.999  # smallest fraction of multiples
_UNEVEN: Final = 0.1  # smallest fraction of changes of the step between moving samples


def resolution(values: FloatArray) -> float:
    """Return the step of which nearly all differences of the values are multiples, or 0."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > _EQUAL * np.abs(values).max(initial=0.0)]
    if not len(steps):
        return 0.0
    # The values may be counts of which no two are neighbors.
    for least in float(steps.min()) / np.arange(1.0, _FARTHEST + 1.0):
        multiple = np.abs(steps / least - np.rint(steps / least)) < _MULTIPLE
        if np.mean(multiple) > _MOSTLY:
            return float(least)
    return 0.0


def rounding_of_motion(positions: FloatArray) -> float:
    """Return the standard deviation of the rounding of positions in order of time, or 0."""
    step = resolution(positions)
    changes = np.diff(positions)
    moving = np.abs(changes[1:]) > 0.5 * step
    uneven = np.abs(np.diff(changes)) > 0.5 * step
    # Computed positions at constant speeds are multiples of a step, too, but without rounding.
    if not moving.any() or np.mean(uneven[moving]) < _UNEVEN:
        return 0.0
    return step / sqrt(12.0)
