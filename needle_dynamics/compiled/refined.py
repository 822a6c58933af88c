"""
A run of intervals whose steps follow the vibration of the needle.

What a step neglects is in how modes and insertion axis act on each other within it: it matters
in proportion to the frequency and while the needle vibrates. So steps are a part of the period
of the slowest mode, which grows as the square of the inserted length, and become longer as the
vibration fades. How good that is shows in a second run, whose steps are half as long everywhere.
"""

from __future__ import annotations

from math import ceil, sqrt
from typing import Final

from needle_dynamics.arrays import Matrix, Vector
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.integrals import mode_integrals, ModeIntegrals
from needle_dynamics.compiled.step import advance, Inputs, Needle
import numpy as np

#: Step while the needle vibrates most, as a part of the slowest mode's period over 2 pi.
SHARE: Final = 0.25

#: Steps after which their length is chosen anew.
_BLOCK: Final = 32

#: Most steps of an interval: nobody waits for them.
_MOST: Final = 1e12


@kernel
def run_refined(
    c: Needle,
    state: Vector,
    forces: Vector,
    interval: float,
    finer: int,
    states: Matrix,
    steps: Vector,
) -> tuple[int, float]:
    """
    Advance a state through intervals of constant force, in place.

    Parameters
    ----------
    c : Needle
        The needle.
    state : ndarray, shape (2 (2 + n),)
        State; overwritten.
    forces : ndarray, shape (k,)
        Insertion force of each interval [N].
    interval : float
        Length of an interval [s].
    finer : int
        Every step is divided by this number.
    states : ndarray, shape (k + 1, 2 (2 + n))
        Overwritten with the states at the ends of the intervals.
    steps : ndarray, shape (k,)
        Overwritten with the shortest step of each interval [s].

    Returns
    -------
    done : int
        Number of intervals that were completed.
    left : float
        As from `advance`, of the next one; 0 if all were completed.

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
            # Energy of the modes, as if all were of this frequency.
            size = 0.0
            for i in range(n):
                for j in range(n):
                    moving = state[4 + n + i] * state[4 + n + j]
                    size += at.gram[i, j] * (moving + square * state[2 + i] * state[2 + j])
            largest = max(largest, size)
            count = 1.0
            if largest > 0.0:
                # With the root of the amplitude: where it is large the error counts most, and
                # so do steps.
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
