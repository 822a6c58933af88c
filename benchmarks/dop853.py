# SPDX-License-Identifier: Apache-2.0
"""
DOP853 in one compiled call: a solver of order 8 without Python between its steps.

Coefficients, error and step control are those of `scipy.integrate.DOP853` (E. Hairer,
S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, Springer 1993).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast, TypeVar

from needle_dynamics import FloatArray
import numba
import numpy as np
from scipy.integrate import DOP853

_Function = TypeVar('_Function', bound=Callable[..., object])

#: Weights of the stages, and of the new state in the last row; of the two error estimates.
_A = np.vstack([DOP853.A, DOP853.B])
_E3, _E5 = DOP853.E3.copy(), DOP853.E5.copy()
_STAGES = len(DOP853.B)
_SHORTEST = 1e-13  #: Shortest step [s].


def compiled(function: _Function) -> _Function:
    """Compile a function; not cached on disk: Numba does not detect a change of its callees."""
    return cast(_Function, numba.njit(error_model='numpy')(function))


@compiled
def _combine(
    x: FloatArray, h: float, row: int, table: FloatArray, slopes: FloatArray, out: FloatArray
) -> None:
    """Write a state after a step h [s], with a row of a table as weights of the slopes."""
    for i in range(x.shape[0]):
        total = 0.0
        for j in range(min(row, table.shape[1])):
            total += table[row, j] * slopes[j, i]
        out[i] = x[i] + h * total


@compiled
def _error(
    x: FloatArray,
    new: FloatArray,
    h: float,
    relative: float,
    absolute: FloatArray,
    slopes: FloatArray,
) -> float:
    """Return the error of a step h [s] over its tolerance."""
    fifth = third = 0.0
    for i in range(x.shape[0]):
        five = three = 0.0
        for j in range(_STAGES + 1):
            five += _E5[j] * slopes[j, i]
            three += _E3[j] * slopes[j, i]
        scale = absolute[i] + relative * max(abs(x[i]), abs(new[i]))
        fifth += (five / scale) ** 2
        third += (three / scale) ** 2
    if fifth == 0.0:
        return 0.0
    return float(h * fifth / ((fifth + 0.01 * third) * x.shape[0]) ** 0.5)


def build_solver(derivative: Callable[..., None]) -> Callable[..., int]:
    """
    Return a compiled solver for a compiled derivative, which has arguments (state, data, out).

    The solver advances a state, shape (n,), in place over a duration [s], with a relative and
    absolute tolerances, shape (n,). It returns the number of steps, -1 on failure; ``times`` and
    ``states``, shapes (m,) and (m, n), take as many steps.
    """

    @compiled
    def solve(
        x: FloatArray,
        duration: float,
        relative: float,
        absolute: FloatArray,
        data: tuple[object, ...],
        times: FloatArray,
        states: FloatArray,
    ) -> int:
        slopes, new = np.empty((_STAGES + 1, x.shape[0])), np.empty(x.shape[0])
        derivative(x, data, slopes[0])
        scales = absolute + relative * np.abs(x)
        h = 0.01 * (((x / scales) ** 2).sum() / ((slopes[0] / scales) ** 2).sum()) ** 0.5
        h = max(h, 100.0 * _SHORTEST)
        t, count, longest = 0.0, 0, 10.0
        while t < duration:
            h = min(h, duration - t)
            if h < _SHORTEST:
                return -1
            for stage in range(1, _STAGES + 1):
                _combine(x, h, stage, _A, slopes, new)
                derivative(new, data, slopes[stage])
            error = _error(x, new, h, relative, absolute, slopes)
            if not error < 1.0:
                # Of NaN, too; the next step is not longer.
                h *= max(0.2, 0.9 * error**-0.125) if error >= 1.0 else 0.2
                longest = 1.0
                continue
            t = t + h if duration - t - h > 1e-12 else duration
            h *= min(longest, 0.9 * error**-0.125) if error > 0.0 else longest
            x[:], slopes[0], longest = new, slopes[_STAGES], 10.0
            if count < times.shape[0]:
                times[count], states[count] = t, x
            count += 1
        return count

    return solve
