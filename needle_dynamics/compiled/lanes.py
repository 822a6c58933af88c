# SPDX-License-Identifier: Apache-2.0
r"""
Simulation of many needles in parallel, in the lanes of the processor's vector registers.

The step equals `needle_dynamics.compiled.step` for up to four modes (more than two: `many_lanes`).
Loops over lanes have no calls and branches, so that the compiler can vectorize them; rare events
(the motion stops, an interval or a layer of tissue ends), swelling, and friction other than
Coulomb's are handled lane by lane. Lanes are independent: results do not depend, to the bit, on
the number and the order of the needles.

Modes scale with the length of the needle: with the modes of a needle of length 1 (index 1),

.. math:: G(s) = G_1(\xi), \quad H(s) = H_1(\xi) / l^4, \quad \phi(s) = \phi_1(\xi) / \sqrt l,
   \quad \phi''(s) = \phi_1''(\xi) / l^{5/2}, \quad \xi = s / l,

and a single table is enough for all needles.
"""

from collections.abc import Callable
from math import inf, isfinite, sqrt
from typing import Final, NamedTuple, TypeAlias

from needle_dynamics.arrays import Array3, FloatArray, IntArray, IntVector, Matrix, Vector
from needle_dynamics.compiled.cache import compiled, inlined, kernel
from needle_dynamics.compiled.friction import COULOMB as COULOMB_LAW
from needle_dynamics.compiled.friction import friction_flow, FrictionConstants
from needle_dynamics.compiled.lane_functions import lane_decay_means, lane_sine_cosine, ROUND
from needle_dynamics.compiled.lane_rows import (
    ABOVE,
    ACCELERATION,
    BENDING,
    BREAKAWAY,
    COLUMNS,
    COULOMB,
    DAMPING,
    DENSITY,
    DEPTH,
    FORCE,
    H,
    HIGH,
    IMPULSE,
    INERTIA,
    INSIDE,
    KEPT,
    LaneModes,
    LANES,
    LAW,
    LAYER,
    LEFT,
    LENGTH,
    LOW,
    MASS,
    NEEDLE,
    NEW_Q1,
    NEW_Q2,
    NEW_U,
    NEW_Z1,
    NEW_Z2,
    Q1,
    Q2,
    REST,
    ROWS,
    SERIES,
    SMOOTHING_SPEED,
    STIFFNESS,
    STOP,
    STOPS,
    STRIBECK_SPEED,
    SWELLING,
    SWELLING_TIME,
    TIME,
    TIP,
    TISSUE,
    TRAVEL,
    VELOCITY,
    VISCOUS,
    WITHDRAWAL,
    XI,
    XI4,
    Z1,
    Z2,
)  # fmt: skip
from needle_dynamics.compiled.many_lanes import (
    end_many_lanes,
    load_many_lane,
    MANY_ROWS,
    save_many_lane,
    tip_many_lanes,
)  # fmt: skip
from needle_dynamics.compiled.modal_flow import normal_pair, turn_pair
from needle_dynamics.compiled.step import GRADED_FROM
from needle_dynamics.compiled.tissue import growth_at, time_to_layer
import numpy as np

_TIP_COLUMNS: Final = (18, 22)  #: first and end of those for phi


#: Compiled function that advances the modes of n lanes.
Rotation: TypeAlias = Callable[[FloatArray, int, LaneModes], None]


class BatchTrajectory(NamedTuple):
    """Inputs and steps of a batch."""

    #: Insertion force [N] and torque [N m] in each interval, shape (runs or 1, k or 1).
    forces: Matrix
    torques: Matrix
    intervals: int  #: number of intervals
    #: Length of an interval and of the longest step [s].
    interval: float
    longest: float
    graded: bool  #: let steps grow with the insertion depth, as in `Integrator`


class LaneBatch(NamedTuple):
    """Needles of a batch, their inputs, and results."""

    needles: Matrix  #: `Constants`, shape (all or 1, 19)
    modes: LaneModes
    #: Layers of the tissue, shape (all or 1, m, `LAYER` + pairs of modes), with m = 0 if all
    #: needles are in one that does not swell.
    layers: Array3
    trajectory: BatchTrajectory
    runs: IntVector  #: indices of the runs to compute
    states: Matrix  #: initial states, replaced by those at the end, shape (all, 2 (2 + n))
    #: States at the ends of the intervals, shape (all, count + 1, 2 (2 + n)); unused if it has
    #: one row per run.
    kept: Array3
    completed: Vector  #: completed intervals, shape (all,)


@compiled
def _begin(w: FloatArray, n: int, layers: FloatArray, longest: float, grade: float) -> None:
    """Compute the step of each lane, the depth in its middle, and the tissue there."""
    for i in range(n):
        s, left, length = w[DEPTH + i], w[LEFT + i], w[LENGTH + i]
        whole = longest * max(1.0, grade * s / (GRADED_FROM * length))
        count = left / whole * (1.0 - 1e-9)
        near = (count + ROUND) - ROUND
        steps = max(near + 1.0 if near < count else near, 1.0)
        h = left / steps
        w[H + i] = h
        w[REST + i] = left - h if steps > 1.0 else 0.0
    if layers.shape[1] > 1:
        for i in range(n):
            own = layers[int(w[NEEDLE + i])]
            border = time_to_layer(own[:, 0], own[:, 1], w[DEPTH + i], w[VELOCITY + i])
            if 1e-3 * w[H + i] < border < w[H + i]:
                # A step ends at a layer border, so that its stiffness is constant.
                w[H + i], w[REST + i] = border, w[LEFT + i] - border
    sixth = grade / 6.0
    for i in range(n):
        s, u, h, length = w[DEPTH + i], w[VELOCITY + i], w[H + i], w[LENGTH + i]
        middle = min(s + 0.5 * h * u + sixth * h * h * w[ACCELERATION + i], w[STOP + i])
        inside = w[LOW + i] <= middle <= w[HIGH + i]
        xi = middle / length if inside else 1.0
        square = xi * xi
        w[XI + i] = xi
        w[XI4 + i] = square * square
        w[INSIDE + i] = 1.0 if inside else 0.0
    if layers.shape[1] > 0:
        for i in range(n):
            _enter(w, i, layers[int(w[NEEDLE + i])])


@inlined
def _enter(w: FloatArray, i: int, layers: FloatArray) -> None:
    """Set the stiffness of the tissue in the middle of the step."""
    k, middle = 0, w[XI + i] * w[LENGTH + i]
    while k + 1 < len(layers) and middle >= layers[k + 1, 0]:
        k += 1
    growth = growth_at(w[SWELLING + i], w[SWELLING_TIME + i], w[TIME + i] + 0.5 * w[H + i])
    w[TISSUE + i] = growth * layers[k, 1]
    for pair in range(layers.shape[1] - LAYER):
        w[ABOVE + pair * LANES + i] = growth * layers[k, LAYER + pair]


@compiled
def _modes(w: FloatArray, n: int, table: FloatArray, first: int, end: int) -> None:
    """Evaluate columns of the series of the modes: a first term, and four more at a time."""
    last = table.shape[0] - 1
    for j in range(first, end):
        row, top = SERIES + j * LANES, table[last, j]
        for i in range(n):
            w[row + i] = top
        for m in range(last - 4, -1, -4):
            a, b, c, d = table[m, j], table[m + 1, j], table[m + 2, j], table[m + 3, j]
            for i in range(n):
                z = w[XI4 + i]
                w[row + i] = (((w[row + i] * z + d) * z + c) * z + b) * z + a


@inlined
def _powers(w: FloatArray, column: int, i: int, xi: float) -> float:
    at = SERIES + column * LANES + i
    return float(w[at] + xi * w[at + LANES] + xi * xi * w[at + 2 * LANES])


@inlined
def _line(w: FloatArray, column: int, i: int, xi: float) -> float:
    at = SERIES + column * LANES + i
    return float(w[at] + xi * w[at + LANES])


@inlined
def rotate_two_lanes(w: FloatArray, n: int, modes: LaneModes) -> None:
    """Advance the deflections through the step, as `modal_flow.rotate_two`."""
    _modes(w, n, modes.table, 0, COLUMNS)
    _rotate(w, n)


@compiled
def _rotate(w: FloatArray, n: int) -> None:
    for i in range(n):
        h, xi, rho = w[H + i], w[XI + i], w[DENSITY + i]
        ka, length = w[TISSUE + i], w[LENGTH + i]
        ei = w[BENDING + i] / (length * length * length * length)
        fifth = w[XI4 + i] * xi
        g11 = fifth * _powers(w, 0, i, xi)
        g12 = fifth * _powers(w, 3, i, xi)
        g22 = fifth * _powers(w, 6, i, xi)
        k11 = ei * (xi * _powers(w, 9, i, xi)) + ka * g11 + w[ABOVE + i]
        k12 = ei * (xi * _powers(w, 12, i, xi)) + ka * g12 + w[ABOVE + LANES + i]
        k22 = ei * (xi * _powers(w, 15, i, xi)) + ka * g22 + w[ABOVE + 2 * LANES + i]
        m = normal_pair(rho, g11, g12, g22, k11, k12, k22)
        v1 = w[Z1 + i] * m.i11
        v2 = (w[Z2 + i] - m.l21 * v1) * m.i22
        x = 0.5 * h * w[DAMPING + i] / rho
        turned = turn_pair(
            m, rho, ei, ka,
            (xi * xi * _line(w, 18, i, xi), xi * xi * _line(w, 20, i, xi)),
            (_line(w, 22, i, xi), _line(w, 24, i, xi)),
            (m.l11 * w[Q1 + i] + m.l21 * w[Q2 + i], m.l22 * w[Q2 + i]), (v1, v2),
            1.0 - x * lane_decay_means(x)[0],
            lane_sine_cosine(m.omega1 * h), lane_sine_cosine(m.omega2 * h), h,
        )  # fmt: skip
        new_q2 = turned.y2 * m.i22
        w[NEW_Q1 + i] = (turned.y1 - m.l21 * new_q2) * m.i11
        w[NEW_Q2 + i] = new_q2
        w[NEW_Z1 + i] = m.l11 * turned.v1
        w[NEW_Z2 + i] = m.l21 * turned.v1 + m.l22 * turned.v2
        w[IMPULSE + i] = turned.impulse / length


@compiled
def _move(w: FloatArray, n: int) -> None:
    """Move the insertion axis, as `friction.friction_flow`."""
    for i in range(n):
        h, u, mass = w[H + i], w[VELOCITY + i], w[MASS + i]
        sign, factor = (1.0, 1.0) if u > 0.0 else (-1.0, w[WITHDRAWAL + i])
        drive = w[FORCE + i] - w[IMPULSE + i] / h
        a = (drive - sign * factor * w[COULOMB + i]) / mass
        x = factor * w[VISCOUS + i] / mass * h
        mean, ramp = lane_decay_means(x)
        new_u = u * (1.0 - x * mean) + a * h * mean
        w[NEW_U + i] = new_u
        w[TRAVEL + i] = h * (u * mean + a * h * ramp)
        w[STOPS + i] = 1.0 if new_u * u <= 0.0 else 0.0
    for i in range(n):
        if w[STOPS + i] != 0.0 or w[LAW + i] != COULOMB_LAW:
            h = w[H + i]
            friction = FrictionConstants(
                int(w[LAW + i]), w[COULOMB + i], w[VISCOUS + i], w[WITHDRAWAL + i],
                w[BREAKAWAY + i], w[STRIBECK_SPEED + i], w[SMOOTHING_SPEED + i],
            )  # fmt: skip
            drive = w[FORCE + i] - w[IMPULSE + i] / h
            w[NEW_U + i], w[TRAVEL + i] = friction_flow(
                friction, w[MASS + i], w[VELOCITY + i], drive, h
            )


@compiled
def _end(w: FloatArray, n: int) -> None:
    """End the step of each lane; a lane that would leave its range keeps its state."""
    for i in range(n):
        depth, velocity = w[DEPTH + i] + w[TRAVEL + i], w[NEW_U + i]
        stopped = depth >= w[STOP + i]
        high = inf if stopped else w[HIGH + i]
        inside = w[INSIDE + i] != 0.0 and w[LOW + i] <= depth <= high
        gain = (velocity - w[VELOCITY + i]) / w[H + i]
        w[INSIDE + i] = 1.0 if inside else 0.0
        w[DEPTH + i] = (w[STOP + i] if stopped else depth) if inside else w[DEPTH + i]
        w[VELOCITY + i] = (0.0 if stopped else velocity) if inside else w[VELOCITY + i]
        w[ACCELERATION + i] = gain
        w[Q1 + i] = w[NEW_Q1 + i] if inside else w[Q1 + i]
        w[Q2 + i] = w[NEW_Q2 + i] if inside else w[Q2 + i]
        w[Z1 + i] = w[NEW_Z1 + i] if inside else w[Z1 + i]
        w[Z2 + i] = w[NEW_Z2 + i] if inside else w[Z2 + i]
        w[LEFT + i], w[TIME + i] = w[REST + i], w[TIME + i] + w[H + i]


@compiled
def empty_lanes(modes: LaneModes) -> FloatArray:
    size = (MANY_ROWS if modes.number > 2 else ROWS) * LANES
    memory = np.zeros(size + 7)
    # A register of 64 bytes is then loaded from a single cache line.
    first = (-memory.ctypes.data % 64) // 8
    return memory[first : first + size]


@inlined
def step_lanes(
    rotate: Rotation,
    w: FloatArray,
    n: int,
    modes: LaneModes,
    layers: FloatArray,
    longest: float,
    grade: float,
) -> None:
    """Take one step of at most ``longest`` [s] in each of n lanes."""
    _begin(w, n, layers, longest, grade)
    rotate(w, n, modes)
    _move(w, n)
    _end(w, n)
    if modes.number > 2:
        end_many_lanes(w, n, modes.number)


@compiled
def tip_lanes(w: FloatArray, n: int, modes: LaneModes) -> None:
    """Compute the tip deflection of each lane at its present depth."""
    for i in range(n):
        xi = w[DEPTH + i] / w[LENGTH + i]
        square = xi * xi
        w[XI + i], w[XI4 + i] = xi, square * square
    if modes.number > 2:
        tip_many_lanes(w, n, modes.number, modes.table)
        return
    _modes(w, n, modes.table, *_TIP_COLUMNS)
    for i in range(n):
        xi = w[XI + i]
        sum_of_modes = _line(w, 18, i, xi) * w[Q1 + i] + _line(w, 20, i, xi) * w[Q2 + i]
        w[TIP + i] = xi * xi / sqrt(w[LENGTH + i]) * sum_of_modes


@inlined
def _gram(table: FloatArray, xi: float) -> tuple[float, float, float]:
    """Return G of two modes at a relative depth."""
    z = xi * xi * xi * xi
    g11, g12, g22 = 0.0, 0.0, 0.0
    for m in range(table.shape[0] - 1, -1, -1):
        g11 = g11 * z + (table[m, 0] + xi * (table[m, 1] + xi * table[m, 2]))
        g12 = g12 * z + (table[m, 3] + xi * (table[m, 4] + xi * table[m, 5]))
        g22 = g22 * z + (table[m, 6] + xi * (table[m, 7] + xi * table[m, 8]))
    fifth = z * xi
    return fifth * g11, fifth * g12, fifth * g22


@compiled
def load_lane(
    w: FloatArray, i: int, needles: FloatArray, which: int, state: FloatArray, modes: LaneModes
) -> None:
    constants = needles[which]
    for k in range(len(constants)):
        w[k * LANES + i] = constants[k]
    length, rho, m = constants[0], constants[1], len(state) // 2
    depth = length - state[0]
    w[DEPTH + i], w[VELOCITY + i], w[ACCELERATION + i] = depth, -state[m], 0.0
    w[TIME + i], w[NEEDLE + i], w[TISSUE + i] = 0.0, float(which), w[STIFFNESS + i]
    for row in range(ABOVE, SERIES, LANES):
        w[row + i] = 0.0
    for k in range(m - 2):
        w[Q1 + k * LANES + i] = state[2 + k]
    if modes.number > 2:
        load_many_lane(w, i, modes.table, state[m + 2 :])
        return
    g11, g12, g22 = _gram(modes.table, depth / length)
    w[Z1 + i] = rho * (g11 * state[6] + g12 * state[7])
    w[Z2 + i] = rho * (g12 * state[6] + g22 * state[7])


@compiled
def swap_lanes(w: FloatArray, i: int, j: int) -> None:
    for row in range(0, KEPT * LANES, LANES):
        w[row + i], w[row + j] = w[row + j], w[row + i]


@compiled
def save_lane(w: FloatArray, i: int, modes: LaneModes, state: FloatArray) -> None:
    """Write the state of a lane, without the angle and its rate."""
    length, rho, m = w[LENGTH + i], w[DENSITY + i], len(state) // 2
    state[0], state[m] = length - w[DEPTH + i], -w[VELOCITY + i]
    for k in range(m - 2):
        state[2 + k] = w[Q1 + k * LANES + i]
    if modes.number > 2:
        save_many_lane(w, i, modes.table, state[m + 2 :])
        return
    g11, g12, g22 = _gram(modes.table, w[DEPTH + i] / length)
    z1, z2 = w[Z1 + i], w[Z2 + i]
    # By Cholesky, as in `advance`: G is nearly singular at small depths.
    l11 = sqrt(rho * g11)
    l21 = rho * g12 / l11
    l22 = sqrt(rho * g22 - l21 * l21)
    v1 = z1 / l11
    rate2 = (z2 - l21 * v1) / (l22 * l22)
    state[6], state[7] = (v1 - l21 * rate2) / l11, rate2


@inlined
def run_with(rotate: Rotation, batch: LaneBatch) -> None:
    """Advance needles through intervals of constant inputs; ``rotate`` advances their modes."""
    needles, modes, layers, trajectory, runs, states, kept, completed = batch
    w = empty_lanes(modes)
    # Run and interval of each lane.
    which, at = np.zeros(LANES, dtype=np.int64), np.zeros(LANES, dtype=np.int64)
    waiting, n = 0, 0
    while True:
        while n < LANES and waiting < len(runs):
            i = runs[waiting]
            waiting += 1
            load_lane(w, n, needles, i if len(needles) > 1 else 0, states[i], modes)
            if kept.shape[1] > 1:
                kept[i, 0] = states[i]
            which[n], at[n] = i, 0
            w[FORCE + n] = _input(trajectory.forces, i, 0)
            w[LEFT + n], w[INSIDE + n] = trajectory.interval, 1.0
            n += 1
        if n == 0:
            return
        step_lanes(
            rotate, w, n, modes, layers, trajectory.longest, 1.0 if trajectory.graded else 0.0
        )
        # Backwards: a lane that ends is filled with the last lane, which is already checked.
        for i in range(n - 1, -1, -1):
            continues = w[INSIDE + i] != 0.0
            if continues and w[LEFT + i] == 0.0:
                continues = _next(w, i, which[i], at, trajectory, modes, states, kept)
                completed[which[i]] = at[i]
            if not continues:
                n -= 1
                which[i], at[i] = which[n], at[n]
                for k in range(KEPT):
                    w[k * LANES + i] = w[k * LANES + n]


@kernel
def run(batch: LaneBatch) -> None:
    """Run `run_with` for needles with one or two modes."""
    run_with(rotate_two_lanes, batch)


@inlined
def _next(
    w: FloatArray,
    i: int,
    which: int,
    at: IntArray,
    trajectory: BatchTrajectory,
    modes: LaneModes,
    states: FloatArray,
    kept: FloatArray,
) -> bool:
    """End the interval of a lane; return whether the lane continues with the next interval."""
    state, time = states[which], trajectory.interval
    turn = 2.0 / w[INERTIA + i] * _input(trajectory.torques, which, at[i])
    spin = len(state) // 2 + 1
    angle, rate = state[1], state[spin]
    save_lane(w, i, modes, state)
    state[1] = angle + (rate + 0.5 * turn * time) * time
    state[spin] = rate + turn * time
    size = 0.0
    for value in state:
        size += abs(value)
    if not isfinite(size):
        return False
    at[i] += 1
    if kept.shape[1] > 1:
        kept[which, at[i]] = state
    w[FORCE + i] = _input(trajectory.forces, which, min(at[i], trajectory.intervals - 1))
    w[LEFT + i], w[ACCELERATION + i] = time, 0.0
    return bool(at[i] < trajectory.intervals)


@inlined
def _input(values: FloatArray, which: int, k: int) -> float:
    """Return the input of a run in an interval; arrays of length one apply to all."""
    first, second = values.shape
    return float(values[which if first > 1 else 0, k if second > 1 else 0])
