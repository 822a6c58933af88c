# SPDX-License-Identifier: Apache-2.0
"""
Sequences of intervals with steps adapted to the vibration of the needle.

The error of a step is the neglected coupling between modes and insertion axis within it: it grows
with the frequency and the amplitude of the vibration. Steps are therefore a fraction of the period
of the slowest mode, which grows as the square of the insertion depth, and become longer as the
vibration decays. A second run with steps of half the length everywhere gives the error.
"""

from math import ceil, sqrt
from typing import Final

from needle_dynamics.arrays import Matrix, Vector
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.integrals import mode_integrals, ModeIntegrals
from needle_dynamics.compiled.step import advance, CompiledNeedle, Inputs
import numpy as np

#: Step at the largest vibration, as a fraction of the slowest mode's period over 2 pi.
SHARE: Final = 0.25

_BLOCK: Final = 32  #: number of steps between updates of the step length
_MOST: Final = 1e12  #: largest number of steps of an interval


@kernel
def run_refined(
    c: CompiledNeedle,
    state: Vector,
    forces: Vector,
    interval: float,
    finer: int,
    states: Matrix,
    steps: Vector,
) -> tuple[int, float]:
    """
    Advance a state through k intervals of constant force, in place.

    ``forces``, shape (k,), are the insertion forces [N], ``interval`` is in s; every step is
    divided by ``finer``. ``states``, shape (k + 1, 2 (2 + n)), takes the states at the ends of the
    intervals, ``steps``, shape (k,), the shortest step of each interval [s].

    Returns the number of completed intervals and the time left of the next interval as from
    `advance`, 0 if all were completed.
    """
    n = c.modes.modes.shape[1]
    grids, rows = np.empty((2, n, n)), np.empty((4, n))
    at = ModeIntegrals(grids[0], grids[1], rows[0], rows[1], rows[2], rows[3])
    work = np.empty(c.modes.series.shape[1] + 4 * n)
    tissue, slowest, largest = 0.0, c.modes.modes[0, 0], 0.0
    for stiffness in c.layers.stiffnesses:
        tissue = max(tissue, stiffness)
    none = np.empty((0, 3))
    for i in range(state.shape[0]):
        states[0, i] = state[i]
    for k in range(forces.shape[0]):
        inputs = Inputs(forces[k], 0.0, 0.0, False)
        rest, steps[k] = interval, interval
        while rest > 0.0:
            depth = c.length - state[0]
            mode_integrals(c.modes, depth, work, at)
            square = (c.bending_stiffness * (slowest / depth) ** 4 + tissue) / c.linear_density
            # Energy of the modes at the frequency of the slowest mode.
            size = 0.0
            for i in range(n):
                for j in range(n):
                    moving = state[4 + n + i] * state[4 + n + j]
                    size += at.gram[i, j] * (moving + square * state[2 + i] * state[2 + j])
            largest = max(largest, size)
            count = 1.0
            if largest > 0.0:
                # Steps in inverse proportion to the root of the amplitude: the error is largest
                # at large amplitudes.
                part = (size / largest) ** 0.25
                count = max(1.0, ceil(min(part * sqrt(square) / SHARE * rest, _MOST)))
            taken = min(count, _BLOCK)
            span = rest if taken == count else rest * (taken / count)
            step = span / (taken * finer)
            steps[k] = min(steps[k], step)
            left, _ = advance(
                c, state, k * interval + (interval - rest), inputs, step, False, span, none
            )
            if left != 0.0:
                return k, left
            rest = rest - span if taken < count else 0.0
        for i in range(state.shape[0]):
            states[k + 1, i] = state[i]
    return len(forces), 0.0
