# SPDX-License-Identifier: Apache-2.0
"""
Sequences of intervals of constant forces, with steps of given length or adapted to the vibration.

The error of a step is the neglected coupling between modes and insertion axis within it: it grows
with the frequency and the amplitude of the vibration. Steps are therefore a fraction of the period
of the slowest mode, which grows as the square of the insertion depth, and become longer as the
vibration decays. A second run with steps of half the length everywhere gives the error.

The error of the symmetric step has even powers of its length only, apart from a small term of
viscous friction. Where the motion is smooth, k runs through a block of steps, with 1, 2, ..., k
divisions of each step, are therefore extrapolated to order 2 k. Source: E. Hairer, S. P. Norsett,
G. Wanner, "Solving Ordinary Differential Equations I", 2nd ed., 1993, section II.9.
"""

from math import ceil, sqrt
from typing import Final

from needle_dynamics.arrays import Matrix, Vector
from needle_dynamics.compiled.cache import inlined, kernel
from needle_dynamics.compiled.integrals import mode_integrals, ModeIntegrals
from needle_dynamics.compiled.step import advance, CompiledNeedle, GRADED_FROM, Inputs
from needle_dynamics.compiled.tissue import layer_at
import numpy as np

#: Step at the largest vibration, as a fraction of the slowest mode's period over 2 pi.
SHARE: Final = 0.25

_BLOCK: Final = 32  #: number of steps between updates of the step length
#: Divisions of the steps of a block after which the needle moves otherwise than before, over 2 to
#: the number of runs: runs of different order have different steps there, so that their difference
#: includes the error.
_FINE: Final = 4
_MOST: Final = 1e12  #: largest number of steps of an interval


@inlined
def _is_smooth(c: CompiledNeedle, state: Vector, ends: Matrix) -> bool:
    """Return whether direction of motion, rest and layer are the same before and after."""
    at = 2 + c.modes.modes.shape[1]
    starts = c.layers.starts
    layer, direction = layer_at(starts, c.length - state[0], 0), np.sign(state[at])
    for end in ends:
        if np.sign(end[at]) != direction or layer_at(starts, c.length - end[0], 0) != layer:
            return False
    return True


@kernel
def advance_extrapolated(
    c: CompiledNeedle,
    state: Vector,
    time: float,
    inputs: Inputs,
    longest: float,
    graded: bool,
    duration: float,
    runs: int,
) -> float:
    """Advance a state as `advance`, at order 2 ``runs``; return the time left undone [s]."""
    # The order is 2 in a block after which the needle rests, moves in another direction or is in
    # another layer than before.
    none = np.empty((0, 3))
    if runs == 1:
        return advance(c, state, time, inputs, longest, graded, duration, none)[0]
    ends = np.empty((runs, state.shape[0]))
    rest = duration
    while rest > 0.0:
        step = longest
        if graded:
            step *= max(1.0, (c.length - state[0]) / (GRADED_FROM * c.length))
        count = ceil(rest / step * (1.0 - 1e-9))
        taken = min(count, _BLOCK)
        span = rest if taken == count else rest * (taken / count)
        now, left = time + (duration - rest), 0.0
        for k in range(runs):
            ends[k] = state
            step = span / (taken * (k + 1))
            if left == 0.0:
                left, _ = advance(c, ends[k], now, inputs, step, False, span, none)
        if left == 0.0 and _is_smooth(c, state, ends):
            for m in range(1, runs):
                for k in range(runs - 1, m - 1, -1):
                    ratio = (k + 1.0) / (k + 1.0 - m)
                    for i in range(state.shape[0]):
                        ends[k, i] += (ends[k, i] - ends[k - 1, i]) / (ratio * ratio - 1.0)
            state[:] = ends[runs - 1]
        else:
            step = span / (taken * _FINE * 2**runs)
            left, _ = advance(c, state, now, inputs, step, False, span, none)
            if left != 0.0:
                return rest - span + left
        rest = rest - span if taken < count else 0.0
    return 0.0


@kernel
def run(
    c: CompiledNeedle,
    state: Vector,
    forces: Vector,
    torques: Vector,
    interval: float,
    longest: float,
    graded: bool,
    runs: int,
    states: Matrix,
) -> int:
    """Advance through intervals of constant inputs, in place; return the completed count."""
    # ``forces`` [N] and ``torques`` [N m] have shape (k,). ``states``, shape (k + 1, 2 (2 + n)),
    # takes the states at the ends of the intervals; with a single row it is unused.
    keep = states.shape[0] > 1
    if keep:
        states[0] = state
    for k in range(forces.shape[0]):
        inputs = Inputs(forces[k], torques[k], 0.0, False)
        left = advance_extrapolated(
            c, state, k * interval, inputs, longest, graded, interval, runs
        )
        if left != 0.0:
            return k
        if keep:
            states[k + 1] = state
    return len(forces)


@kernel
def run_refined(
    c: CompiledNeedle,
    state: Vector,
    forces: Vector,
    torques: Vector,
    interval: float,
    finer: int,
    runs: int,
    states: Matrix,
    steps: Vector,
) -> tuple[int, float]:
    """Advance through k intervals; return the completed count and the time left as `advance`."""
    # ``forces`` [N] and ``torques`` [N m] have shape (k,); every step is divided by ``finer``.
    # ``states``, shape (k + 1, 2 (2 + n)), takes the states at the ends of the intervals,
    # ``steps``, shape (k,), the shortest step of each interval [s].
    n = c.modes.modes.shape[1]
    grids, rows = np.empty((2, n, n)), np.empty((4, n))
    at = ModeIntegrals(grids[0], grids[1], rows[0], rows[1], rows[2], rows[3])
    work = np.empty(c.modes.series.shape[1] + 4 * n)
    tissue, slowest, largest = 0.0, c.modes.modes[0, 0], 0.0
    for stiffness in c.layers.stiffnesses:
        tissue = max(tissue, stiffness)
    states[0] = state
    for k in range(forces.shape[0]):
        inputs = Inputs(forces[k], torques[k], 0.0, False)
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
            left = advance_extrapolated(
                c, state, k * interval + (interval - rest), inputs, step, False, span, runs
            )
            if left != 0.0:
                return k, left
            rest = rest - span if taken < count else 0.0
        states[k + 1] = state
    return len(forces), 0.0
