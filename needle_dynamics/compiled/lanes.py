# SPDX-License-Identifier: Apache-2.0
r"""
Simulation of many needles in parallel, in the lanes of the processor's vector registers.

The step equals `needle_dynamics.compiled.step` for up to two modes. Loops over lanes have no calls
and branches, so that the compiler can vectorize them; rare events (the motion stops, an interval
or a layer of tissue ends), swelling, and friction other than Coulomb's are handled lane by lane.
Lanes are independent: results do not depend, to the bit, on the number and the order of the
needles.

Modes scale with the length of the needle: with the modes of a needle of length 1 (index 1),

.. math:: G(s) = G_1(\xi), \quad H(s) = H_1(\xi) / l^4, \quad \phi(s) = \phi_1(\xi) / \sqrt l,
   \quad \phi''(s) = \phi_1''(\xi) / l^{5/2}, \quad \xi = s / l,

and a single table is enough for all needles.
"""

from math import factorial, inf, isfinite, pi, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import Array3, FloatArray, IntArray, IntVector, Matrix, Vector
from needle_dynamics.compiled.cache import compiled, inlined, kernel
from needle_dynamics.compiled.friction import COULOMB, friction_flow, FrictionConstants
from needle_dynamics.compiled.modal_flow import normal_pair, turn_pair
from needle_dynamics.compiled.step import GRADED_FROM
from needle_dynamics.compiled.tissue import growth_at, time_to_layer
import numpy as np

LANES: Final = 32  #: number of lanes per step: their rows fit into the first-level cache
COLUMNS: Final = 26  #: columns of `ModeTables.series` for G, H, phi and phi'' of two modes
_TIP: Final = (18, 22)  #: first and end of those for phi
#: Those that couple the second mode with the first one, and with the tip.
SECOND: Final = [3, 4, 5, 12, 13, 14, 20, 21, 24, 25]
STATE: Final = 8  #: entries of the state of two modes

# Offset of each row of the lanes. First the constants.
(
    LENGTH, _DENSITY, _BENDING, _STIFFNESS, _DAMPING, _MASS, _COULOMB, _VISCOUS, _WITHDRAWAL,
    _LOW, _HIGH, _STOP, _INERTIA, _SWELLING, _SWELLING_TIME,
    _LAW, _BREAKAWAY, _STRIBECK_SPEED, _SMOOTHING_SPEED,
    # Motion, modes, time left of the interval, time, and row of the layers of the needle.
    DEPTH, VELOCITY, ACCELERATION, _Q1, _Q2, _Z1, _Z2, FORCE, LEFT, TIME, _NEEDLE,
    # Stiffness at the tip, and the addition of the layers above to the stiffness of the modes.
    _TISSUE, _ABOVE11, _ABOVE12, _ABOVE22,
    # One step: its length, time left after it, relative depth in its middle and fourth power of
    # this depth, whether the depth is in range, and the impulse of the modes.
    _H, _REST, _XI, _XI4, INSIDE, _IMPULSE,
    # Result of the step.
    _NEW_Q1, _NEW_Q2, _NEW_Z1, _NEW_Z2, _NEW_U, _TRAVEL, _STOPS,
    # Tip deflection [m], by `tip_lanes`.
    TIP,
    # Series of the modes.
    _SERIES,
) = range(0, 49 * LANES, LANES)  # fmt: skip

#: Number of rows that move with a needle between lanes.
_KEPT: Final = _H // LANES
ROWS: Final = _SERIES // LANES + COLUMNS

_ROUND: Final = 1.5 * 2.0**52  #: adding and subtracting this number rounds to an integer

#: pi / 2 as a sum of three parts; integer multiples of the first two are exact.
_HALF_PI: Final = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
_TURN: Final = 2.0 / pi

#: Coefficients of Taylor series, 1 / 2! to 1 / 19!.
(
    _F2, _F3, _F4, _F5, _F6, _F7, _F8, _F9, _F10, _F11, _F12, _F13, _F14, _F15, _F16, _F17, _F18,
    _F19,
) = (1.0 / factorial(k) for k in range(2, 20))  # fmt: skip

_DECAYED: Final = 40.0  #: exponent above which exp(-x) is negligible against 1


class Constants(NamedTuple):
    """Constants of a needle, in the order of the first rows; units as in `NeedleParameters`."""

    length: float
    linear_density: float
    bending_stiffness: float
    tissue_stiffness: float
    tissue_damping: float
    moving_mass: float
    coulomb_friction: float
    viscous_friction: float
    withdrawal_friction: float
    #: Range of the insertion depth [m].
    lowest: float
    highest: float
    stop: float  #: insertion depth at which the hub stops, or infinity [m]
    rotary_inertia: float
    #: Final increase and time constant of the stiffness [1, s].
    swelling: float
    swelling_time: float
    #: As in `FrictionConstants`.
    law: float
    breakaway_friction: float
    stribeck_speed: float
    smoothing_speed: float


#: Columns of the layers of a needle: depth at which a layer begins [m], infinite without one; its
#: stiffness [N/m^2]; and the addition to the stiffness of two modes (11, 12, 22) [N/m^2].
LAYER: Final = 5


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


@inlined
def _sine_cosine(x: float) -> tuple[float, float]:
    """Return sine and cosine of an angle [rad] without branches."""
    turns = (x * _TURN + _ROUND) - _ROUND
    r = ((x - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
    y = r * r
    sine = r - r * y * (
        _F3 - y * (_F5 - y * (_F7 - y * (_F9 - y * (_F11 - y * (_F13 - y * _F15)))))
    )
    cosine = 1.0 - y * (
        _F2 - y * (_F4 - y * (_F6 - y * (_F8 - y * (_F10 - y * (_F12 - y * (_F14 - y * _F16))))))
    )
    quarter = turns - 4.0 * ((0.25 * turns + _ROUND) - _ROUND)
    odd = abs(quarter) == 1.0
    one = cosine if odd else sine
    two = sine if odd else cosine
    # ``quarter`` is -2 to 2.
    first = -one if quarter == -1.0 or abs(quarter) == 2.0 else one
    second = -two if quarter == 1.0 or abs(quarter) == 2.0 else two
    return first, second


@inlined
def _decay_means(x: float) -> tuple[float, float]:
    """Return `friction.decay_means` without branches: series of x / 32, doubled five times."""
    z = -min(x, _DECAYED) / 32.0
    ramp = _F14 + z * (_F15 + z * (_F16 + z * (_F17 + z * (_F18 + z * _F19))))
    ramp = _F8 + z * (_F9 + z * (_F10 + z * (_F11 + z * (_F12 + z * (_F13 + z * ramp)))))
    ramp = _F2 + z * (_F3 + z * (_F4 + z * (_F5 + z * (_F6 + z * (_F7 + z * ramp)))))
    mean = 1.0 + z * ramp
    for _ in range(5):
        ramp = 0.25 * (mean * mean + 2.0 * ramp)
        mean *= 1.0 + 0.5 * z * mean
        z *= 2.0
    far = 1.0 / max(x, _DECAYED)
    return (far, (1.0 - far) * far) if x > _DECAYED else (mean, ramp)


@compiled
def _begin(w: FloatArray, n: int, layers: FloatArray, longest: float, grade: float) -> None:
    """Compute the step of each lane, the depth in its middle, and the tissue there."""
    for i in range(n):
        s, left, length = w[DEPTH + i], w[LEFT + i], w[LENGTH + i]
        whole = longest * max(1.0, grade * s / (GRADED_FROM * length))
        count = left / whole * (1.0 - 1e-9)
        near = (count + _ROUND) - _ROUND
        steps = max(near + 1.0 if near < count else near, 1.0)
        h = left / steps
        w[_H + i] = h
        w[_REST + i] = left - h if steps > 1.0 else 0.0
    if layers.shape[1] > 1:
        for i in range(n):
            own = layers[int(w[_NEEDLE + i])]
            border = time_to_layer(own[:, 0], own[:, 1], w[DEPTH + i], w[VELOCITY + i])
            if 1e-3 * w[_H + i] < border < w[_H + i]:
                # A step ends at a layer border, so that its stiffness is constant.
                w[_H + i], w[_REST + i] = border, w[LEFT + i] - border
    sixth = grade / 6.0
    for i in range(n):
        s, u, h, length = w[DEPTH + i], w[VELOCITY + i], w[_H + i], w[LENGTH + i]
        middle = min(s + 0.5 * h * u + sixth * h * h * w[ACCELERATION + i], w[_STOP + i])
        inside = w[_LOW + i] <= middle <= w[_HIGH + i]
        xi = middle / length if inside else 1.0
        square = xi * xi
        w[_XI + i] = xi
        w[_XI4 + i] = square * square
        w[INSIDE + i] = 1.0 if inside else 0.0
    if layers.shape[1] > 0:
        for i in range(n):
            _enter(w, i, layers[int(w[_NEEDLE + i])])


@inlined
def _enter(w: FloatArray, i: int, layers: FloatArray) -> None:
    """Set the stiffness of the tissue in the middle of the step."""
    k, middle = 0, w[_XI + i] * w[LENGTH + i]
    while k + 1 < len(layers) and middle >= layers[k + 1, 0]:
        k += 1
    growth = growth_at(w[_SWELLING + i], w[_SWELLING_TIME + i], w[TIME + i] + 0.5 * w[_H + i])
    w[_TISSUE + i] = growth * layers[k, 1]
    w[_ABOVE11 + i] = growth * layers[k, 2]
    w[_ABOVE12 + i] = growth * layers[k, 3]
    w[_ABOVE22 + i] = growth * layers[k, 4]


@compiled
def _modes(w: FloatArray, n: int, table: FloatArray, first: int, end: int) -> None:
    """Evaluate columns of the series of the modes: a first term, and four more at a time."""
    last = table.shape[0] - 1
    for j in range(first, end):
        row, top = _SERIES + j * LANES, table[last, j]
        for i in range(n):
            w[row + i] = top
        for m in range(last - 4, -1, -4):
            a, b, c, d = table[m, j], table[m + 1, j], table[m + 2, j], table[m + 3, j]
            for i in range(n):
                z = w[_XI4 + i]
                w[row + i] = (((w[row + i] * z + d) * z + c) * z + b) * z + a


@inlined
def _powers(w: FloatArray, column: int, i: int, xi: float) -> float:
    at = _SERIES + column * LANES + i
    return float(w[at] + xi * w[at + LANES] + xi * xi * w[at + 2 * LANES])


@inlined
def _line(w: FloatArray, column: int, i: int, xi: float) -> float:
    at = _SERIES + column * LANES + i
    return float(w[at] + xi * w[at + LANES])


@compiled
def _rotate(w: FloatArray, n: int) -> None:
    """Advance the deflections through the step, as `modal_flow.rotate_two`."""
    for i in range(n):
        h, xi, rho = w[_H + i], w[_XI + i], w[_DENSITY + i]
        ka, length = w[_TISSUE + i], w[LENGTH + i]
        ei = w[_BENDING + i] / (length * length * length * length)
        fifth = w[_XI4 + i] * xi
        g11 = fifth * _powers(w, 0, i, xi)
        g12 = fifth * _powers(w, 3, i, xi)
        g22 = fifth * _powers(w, 6, i, xi)
        k11 = ei * (xi * _powers(w, 9, i, xi)) + ka * g11 + w[_ABOVE11 + i]
        k12 = ei * (xi * _powers(w, 12, i, xi)) + ka * g12 + w[_ABOVE12 + i]
        k22 = ei * (xi * _powers(w, 15, i, xi)) + ka * g22 + w[_ABOVE22 + i]
        m = normal_pair(rho, g11, g12, g22, k11, k12, k22)
        v1 = w[_Z1 + i] * m.i11
        v2 = (w[_Z2 + i] - m.l21 * v1) * m.i22
        x = 0.5 * h * w[_DAMPING + i] / rho
        turned = turn_pair(
            m, rho, ei, ka,
            (xi * xi * _line(w, 18, i, xi), xi * xi * _line(w, 20, i, xi)),
            (_line(w, 22, i, xi), _line(w, 24, i, xi)),
            (m.l11 * w[_Q1 + i] + m.l21 * w[_Q2 + i], m.l22 * w[_Q2 + i]), (v1, v2),
            1.0 - x * _decay_means(x)[0],
            _sine_cosine(m.omega1 * h), _sine_cosine(m.omega2 * h), h,
        )  # fmt: skip
        new_q2 = turned.y2 * m.i22
        w[_NEW_Q1 + i] = (turned.y1 - m.l21 * new_q2) * m.i11
        w[_NEW_Q2 + i] = new_q2
        w[_NEW_Z1 + i] = m.l11 * turned.v1
        w[_NEW_Z2 + i] = m.l21 * turned.v1 + m.l22 * turned.v2
        w[_IMPULSE + i] = turned.impulse / length


@compiled
def _move(w: FloatArray, n: int) -> None:
    """Move the insertion axis, as `friction.friction_flow`."""
    for i in range(n):
        h, u, mass = w[_H + i], w[VELOCITY + i], w[_MASS + i]
        sign, factor = (1.0, 1.0) if u > 0.0 else (-1.0, w[_WITHDRAWAL + i])
        drive = w[FORCE + i] - w[_IMPULSE + i] / h
        a = (drive - sign * factor * w[_COULOMB + i]) / mass
        x = factor * w[_VISCOUS + i] / mass * h
        mean, ramp = _decay_means(x)
        new_u = u * (1.0 - x * mean) + a * h * mean
        w[_NEW_U + i] = new_u
        w[_TRAVEL + i] = h * (u * mean + a * h * ramp)
        w[_STOPS + i] = 1.0 if new_u * u <= 0.0 else 0.0
    for i in range(n):
        if w[_STOPS + i] != 0.0 or w[_LAW + i] != COULOMB:
            h = w[_H + i]
            friction = FrictionConstants(
                int(w[_LAW + i]), w[_COULOMB + i], w[_VISCOUS + i], w[_WITHDRAWAL + i],
                w[_BREAKAWAY + i], w[_STRIBECK_SPEED + i], w[_SMOOTHING_SPEED + i],
            )  # fmt: skip
            drive = w[FORCE + i] - w[_IMPULSE + i] / h
            w[_NEW_U + i], w[_TRAVEL + i] = friction_flow(
                friction, w[_MASS + i], w[VELOCITY + i], drive, h
            )


@compiled
def _end(w: FloatArray, n: int) -> None:
    """End the step of each lane; a lane that would leave its range keeps its state."""
    for i in range(n):
        depth, velocity = w[DEPTH + i] + w[_TRAVEL + i], w[_NEW_U + i]
        stopped = depth >= w[_STOP + i]
        high = inf if stopped else w[_HIGH + i]
        inside = w[INSIDE + i] != 0.0 and w[_LOW + i] <= depth <= high
        gain = (velocity - w[VELOCITY + i]) / w[_H + i]
        w[INSIDE + i] = 1.0 if inside else 0.0
        w[DEPTH + i] = (w[_STOP + i] if stopped else depth) if inside else w[DEPTH + i]
        w[VELOCITY + i] = (0.0 if stopped else velocity) if inside else w[VELOCITY + i]
        w[ACCELERATION + i] = gain
        w[_Q1 + i] = w[_NEW_Q1 + i] if inside else w[_Q1 + i]
        w[_Q2 + i] = w[_NEW_Q2 + i] if inside else w[_Q2 + i]
        w[_Z1 + i] = w[_NEW_Z1 + i] if inside else w[_Z1 + i]
        w[_Z2 + i] = w[_NEW_Z2 + i] if inside else w[_Z2 + i]
        w[LEFT + i], w[TIME + i] = w[_REST + i], w[TIME + i] + w[_H + i]


@inlined
def step_lanes(
    w: FloatArray, n: int, table: FloatArray, layers: FloatArray, longest: float, grade: float
) -> None:
    """Take one step of at most ``longest`` [s] in each of n lanes."""
    _begin(w, n, layers, longest, grade)
    _modes(w, n, table, 0, COLUMNS)
    _rotate(w, n)
    _move(w, n)
    _end(w, n)


@compiled
def tip_lanes(w: FloatArray, n: int, table: FloatArray) -> None:
    """Compute the tip deflection of each lane at its present depth."""
    for i in range(n):
        xi = w[DEPTH + i] / w[LENGTH + i]
        square = xi * xi
        w[_XI + i], w[_XI4 + i] = xi, square * square
    _modes(w, n, table, *_TIP)
    for i in range(n):
        xi = w[_XI + i]
        sum_of_modes = _line(w, 18, i, xi) * w[_Q1 + i] + _line(w, 20, i, xi) * w[_Q2 + i]
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
    w: FloatArray, i: int, needles: FloatArray, which: int, state: FloatArray, table: FloatArray
) -> None:
    constants = needles[which]
    for k in range(len(constants)):
        w[k * LANES + i] = constants[k]
    length, rho = constants[0], constants[1]
    depth = length - state[0]
    g11, g12, g22 = _gram(table, depth / length)
    w[DEPTH + i], w[VELOCITY + i], w[ACCELERATION + i] = depth, -state[4], 0.0
    w[_Q1 + i], w[_Q2 + i] = state[2], state[3]
    w[_Z1 + i] = rho * (g11 * state[6] + g12 * state[7])
    w[_Z2 + i] = rho * (g12 * state[6] + g22 * state[7])
    w[TIME + i], w[_NEEDLE + i], w[_TISSUE + i] = 0.0, float(which), w[_STIFFNESS + i]
    w[_ABOVE11 + i] = w[_ABOVE12 + i] = w[_ABOVE22 + i] = 0.0


@compiled
def swap_lanes(w: FloatArray, i: int, j: int) -> None:
    for row in range(0, _KEPT * LANES, LANES):
        w[row + i], w[row + j] = w[row + j], w[row + i]


@compiled
def save_lane(w: FloatArray, i: int, table: FloatArray, state: FloatArray) -> None:
    """Write the state of a lane, without the angle and its rate."""
    length, rho = w[LENGTH + i], w[_DENSITY + i]
    g11, g12, g22 = _gram(table, w[DEPTH + i] / length)
    z1, z2 = w[_Z1 + i], w[_Z2 + i]
    # By Cholesky, as in `advance`: G is nearly singular at small depths.
    l11 = sqrt(rho * g11)
    l21 = rho * g12 / l11
    l22 = sqrt(rho * g22 - l21 * l21)
    v1 = z1 / l11
    rate2 = (z2 - l21 * v1) / (l22 * l22)
    state[0], state[2], state[3] = length - w[DEPTH + i], w[_Q1 + i], w[_Q2 + i]
    state[4], state[6], state[7] = -w[VELOCITY + i], (v1 - l21 * rate2) / l11, rate2


@kernel
def run(
    needles: Matrix,
    table: Matrix,
    layers: Array3,
    trajectory: BatchTrajectory,
    runs: IntVector,
    states: Matrix,
    kept: Array3,
    completed: Vector,
) -> None:
    """Advance needles through intervals of constant inputs."""
    # ``needles``, shape (all or 1, 19), are `Constants`; ``table``, shape (1 + 4 m, 26), the first
    # columns of the series of two modes of length 1; ``layers``, shape (all or 1, m, `LAYER`), the
    # layers of the tissue, with m = 0 if all needles are in one that does not swell; ``runs`` the
    # indices of the runs to compute.
    # Outputs: ``states``, shape (all, 8), at the end; ``kept``, shape (all, count + 1, 8), at the
    # ends of the intervals (unused if it has one row per run); ``completed``, shape (all,),
    # intervals.
    w = np.zeros(ROWS * LANES)
    # Run and interval of each lane.
    which, at = np.zeros(LANES, dtype=np.int64), np.zeros(LANES, dtype=np.int64)
    waiting, n = 0, 0
    while True:
        while n < LANES and waiting < len(runs):
            i = runs[waiting]
            waiting += 1
            load_lane(w, n, needles, i if len(needles) > 1 else 0, states[i], table)
            if kept.shape[1] > 1:
                kept[i, 0] = states[i]
            which[n], at[n] = i, 0
            w[FORCE + n] = _input(trajectory.forces, i, 0)
            w[LEFT + n], w[INSIDE + n] = trajectory.interval, 1.0
            n += 1
        if n == 0:
            return
        step_lanes(w, n, table, layers, trajectory.longest, 1.0 if trajectory.graded else 0.0)
        # Backwards: a lane that ends is filled with the last lane, which is already checked.
        for i in range(n - 1, -1, -1):
            continues = w[INSIDE + i] != 0.0
            if continues and w[LEFT + i] == 0.0:
                continues = _next(w, i, which[i], at, trajectory, table, states, kept)
                completed[which[i]] = at[i]
            if not continues:
                n -= 1
                which[i], at[i] = which[n], at[n]
                for k in range(_KEPT):
                    w[k * LANES + i] = w[k * LANES + n]


@inlined
def _next(
    w: FloatArray,
    i: int,
    which: int,
    at: IntArray,
    trajectory: BatchTrajectory,
    table: FloatArray,
    states: FloatArray,
    kept: FloatArray,
) -> bool:
    """End the interval of a lane; return whether the lane continues with the next interval."""
    state, time = states[which], trajectory.interval
    turn = 2.0 / w[_INERTIA + i] * _input(trajectory.torques, which, at[i])
    angle, rate = state[1], state[5]
    save_lane(w, i, table, state)
    state[1] = angle + (rate + 0.5 * turn * time) * time
    state[5] = rate + turn * time
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
