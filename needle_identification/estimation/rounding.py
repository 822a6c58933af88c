# SPDX-License-Identifier: Apache-2.0
"""Resolution of measured values, such as the count of an encoder."""

from math import inf
from typing import Final

from needle_dynamics.arrays import FloatArray
import numpy as np

_EQUAL: Final = 1e-12  # relative difference of equal values, by rounding
_MULTIPLE: Final = 0.02  # largest deviation from a multiple of the resolution
_MOSTLY: Final = 0.9  # smallest fraction of multiples


def resolution(values: FloatArray) -> float:
    """Return the step of which nearly all differences of the values are multiples, or 0."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > _EQUAL * np.abs(values).max(initial=0.0)]
    least = float(steps.min(initial=inf))
    multiple = np.abs(steps / least - np.rint(steps / least)) < _MULTIPLE
    return least if len(steps) and np.mean(multiple) > _MOSTLY else 0.0
