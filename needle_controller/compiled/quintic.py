# SPDX-License-Identifier: Apache-2.0
"""Extreme values of polynomials of fifth order."""

from needle_dynamics.arrays import FloatArray, Vector
from needle_dynamics.compiled.cache import compiled, kernel
import numpy as np


@compiled
def _value(c: FloatArray, x: float) -> float:
    value = 0.0
    for j in range(len(c) - 1, -1, -1):
        value = value * x + c[j]
    return value


@kernel
def quintic_extremes(c: Vector) -> FloatArray:  # noqa: C901
    """Return the range of c[0] + c[1] x + ... and two derivatives on [0, 1], shape (3, 2)."""
    derivatives, extremes = np.zeros((6, 6)), np.empty((3, 2))
    for j in range(6):
        derivatives[0, j] = c[j]
    for k in range(1, 6):
        for j in range(6 - k):
            derivatives[k, j] = (j + 1) * derivatives[k - 1, j + 1]
    # Between two turning points a polynomial has at most one root. The roots of each derivative,
    # from the linear derivative on, are the turning points of the derivative of one order less.
    turns, found, values, count = np.zeros(6), np.zeros(6), np.empty(6), 2
    turns[1] = 1.0
    for k in range(4, -1, -1):
        least = most = values[0] = _value(derivatives[k], turns[0])
        for i in range(1, count):
            values[i] = _value(derivatives[k], turns[i])
            least, most = min(least, values[i]), max(most, values[i])
        if k < 3:
            extremes[k, 0], extremes[k, 1] = least, most
        if k == 0:
            break
        number = 1
        for i in range(count - 1):
            positive = values[i] > 0.0
            if (values[i + 1] > 0.0) == positive:
                continue
            low, high = turns[i], turns[i + 1]
            for _ in range(53):
                middle = 0.5 * (low + high)
                if (_value(derivatives[k], middle) > 0.0) == positive:
                    low = middle
                else:
                    high = middle
            found[number] = low
            number += 1
        found[number] = 1.0
        count = number + 1
        for i in range(count):
            turns[i] = found[i]
    return extremes
