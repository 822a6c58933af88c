"""
Everything of the control laws that is compiled: one file, none of it calls into another one.

A law is an array of constants, slots below, and what it remembers an array that is written in
place: the same functions serve the node and compiled loops over thousands of runs.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, exp, expm1, inf, sin, sqrt
from typing import cast, Final, TypeAlias, TypeVar

from needle_dynamics import FloatArray
import numba
import numpy as np

#: Laws by number.
INVERSE_DYNAMICS: Final = 0
PID: Final = 1

# Slots of the constants of a law.
LAW: Final = 0
PERIOD: Final = 1
#: Response of the axis over one period, see `oscillation`: end = [PP PV; VP VV] (position, speed)
#: + [PF; VF] force. Not used by laws on deflections, whose axes change with the depth.
PP: Final = 2
PV: Final = 3
VP: Final = 4
VV: Final = 5
PF: Final = 6
VF: Final = 7
#: Coulomb friction, speed at which it is fully compensated, and the time ahead of that speed.
COULOMB: Final = 8
BREAKAWAY: Final = 9
AHEAD: Final = 10
#: Gains; KD is k_v in inverse dynamics.
KP: Final = 11
KI: Final = 12
KD: Final = 13
FILTER_TIME: Final = 14
TOLERANCE: Final = 15
#: Part of an excess that back-calculation takes away in one period; 0: conditional integration.
TRACKING: Final = 16
#: 1 with feed-forward, 0 without.
FEED_FORWARD: Final = 17
#: What a period leaves of the offset.
FADE: Final = 18
#: Of a law on deflections: rho A, E I_y, 1; all 0 if motion and deflection are not coupled.
DENSITY: Final = 19
BENDING: Final = 20
COUPLED: Final = 21
CONSTANTS: Final = 22

# Slots of what a law remembers: int e dt, the filtered rate of the error, a force that fades.
INTEGRAL: Final = 0
RATE: Final = 1
OFFSET: Final = 2
MEMORY: Final = 3

# Rows of the table of `normal_modes`, counted from 2 n.
SQUARES: Final = 6
VALUE: Final = 7
CURVATURE: Final = 8
TISSUE: Final = 9
TABLE: Final = 10

#: Position and speed, and those wanted with the acceleration.
Instant: TypeAlias = tuple[float, float, float, float, float]

_Function = TypeVar('_Function', bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compile a function to machine code at its first call and keep it on disk."""
    # error_model: divide as C does. nogil: batches run in threads.
    return cast(_Function, numba.njit(cache=True, error_model='numpy', nogil=True)(function))


@compiled
def oscillation(
    damping: float, square: float, t: float
) -> tuple[float, float, float, float, float, float]:
    """
    Solve x_ddot + damping x_dot + square x = f for a time t under a constant f, exactly.

    Parameters
    ----------
    damping, square : float
        Damping [1/s], not negative, and square of the natural frequency [1/s^2], positive.
    t : float
        Duration [s].

    Returns
    -------
    tuple of float
        ``(pp, pv, vp, vv, pf, vf)`` with ``end = pp x + pv v + pf f`` for the position and
        ``vp x + vv v + vf f`` for the speed.

    """
    half = 0.5 * damping
    apart = square - half * half
    if apart >= 0.0:
        w = sqrt(apart)
        fall = exp(-half * t)
        s = fall * (sin(w * t) / w if w > 0.0 else t)
        pp = fall * cos(w * t) + half * s
        vv = pp - damping * s
        r = 0.0
    else:
        # Two real poles, the slow one in a form that does not cancel.
        r = sqrt(-apart)
        fast = -(half + r)
        slow = square / fast
        s = exp(slow * t) * -expm1(-2.0 * r * t) / (2.0 * r)
        pp = exp(slow * t) - slow * s
        vv = exp(slow * t) + fast * s
    if max(damping, sqrt(square)) * t < 0.3:
        # The integral of s as a power series: 1 - pp would cancel.
        before, now, power = 0.0, 1.0, 0.5 * t * t
        pf = power
        for j in range(3, 17):
            before, now = now, -damping * now - square * before
            power *= t / j
            pf += now * power
    elif r * t > 0.1:
        pf = (expm1(slow * t) / slow - expm1(fast * t) / fast) / (2.0 * r)
    else:
        pf = (1.0 - pp) / square
    return pp, s, -square * s, vv, pf, s


@compiled
def _lean(c: FloatArray, speed: float, acceleration: float) -> float:
    """Return which part of Coulomb friction to compensate: that of the speed shortly ahead."""
    if c[COULOMB] == 0.0:
        return 0.0
    return float(min(max((speed + c[AHEAD] * acceleration) / c[BREAKAWAY], -1.0), 1.0))


@compiled
def _pid(c: FloatArray, m: FloatArray, at: Instant) -> tuple[float, float, float, float, float]:
    """
    Set up the implicit form of `needle_controller.laws.pid.Pid`.

    Returns push and divisor, the force being dry + push / divisor, and what the filtered rate at
    the end will be: constant minus slope (force - dry).
    """
    position, speed, target, target_speed, target_acceleration = at
    h = c[PERIOD]
    share = h / (c[FILTER_TIME] + h)
    error = target + h * target_speed - c[PP] * position - c[PV] * speed
    reached = target_speed + h * target_acceleration
    error_rate = (1.0 - share) * m[RATE] + share * (reached - c[VP] * position - c[VV] * speed)
    stiffness = c[KP] + h * c[KI]
    push = stiffness * error + c[KD] * error_rate + c[KI] * m[INTEGRAL] + m[OFFSET]
    dry = 0.0
    if c[FEED_FORWARD] != 0.0:
        push += (reached - c[VP] * target - c[VV] * target_speed) / c[VF]
        dry = c[COULOMB] * _lean(c, target_speed, target_acceleration)
    slope = share * c[VF]
    return push, 1.0 + stiffness * c[PF] + c[KD] * slope, dry, error_rate, slope


@compiled
def law_force(c: FloatArray, m: FloatArray, at: Instant, load: float) -> float:
    """Return the force for the next period before any limit; see the classes of the laws."""
    if c[LAW] == PID:
        push, divisor, dry, _, _ = _pid(c, m, at)
        return dry + push / divisor
    position, speed, target, target_speed, target_acceleration = at
    acceleration = (
        target_acceleration + c[KD] * (target_speed - speed) + c[KP] * (target - position)
    )
    predicted = speed + c[PERIOD] * acceleration
    linear = (predicted - c[VP] * position - c[VV] * speed) / c[VF]
    dry = c[COULOMB] * _lean(c, speed, acceleration)
    return float(linear + dry + load + m[OFFSET])


@compiled
def law_remember(c: FloatArray, m: FloatArray, at: Instant, wanted: float, force: float) -> None:
    """Update what the law remembers, in place, for a force that it wanted and the one applied."""
    if c[LAW] == PID:
        _, divisor, dry, error_rate, slope = _pid(c, m, at)
        m[RATE] = error_rate - slope * (force - dry)
        position, _, target, target_speed, target_acceleration = at
        error = target - position
        excess = wanted - force
        at_rest = target_speed == 0.0 and target_acceleration == 0.0
        if not (at_rest and abs(error) < c[TOLERANCE]):
            if c[TRACKING] > 0.0:
                m[INTEGRAL] += c[PERIOD] * error
                if c[KI] > 0.0:
                    m[INTEGRAL] -= c[TRACKING] * excess * divisor / c[KI]
            elif excess * error <= 0.0:
                m[INTEGRAL] += c[PERIOD] * error
    m[OFFSET] *= c[FADE]


@compiled
def law_match(c: FloatArray, m: FloatArray, at: Instant, load: float, force: float) -> None:
    """Set what the law remembers, in place, so that its force equals a given one."""
    m[INTEGRAL] = m[OFFSET] = 0.0
    m[RATE] = at[3] - at[1]
    missing = force - law_force(c, m, at, load)
    if c[LAW] == PID:
        _, divisor, _, _, _ = _pid(c, m, at)
        missing *= divisor
        if c[KI] > 0.0:
            m[INTEGRAL] = missing / c[KI]
            return
    m[OFFSET] = missing


@compiled
def law_step(
    c: FloatArray,
    m: FloatArray,
    position: float,
    speed: float,
    target: float,
    target_speed: float,
    target_acceleration: float,
    load: float,
    limit: float,
) -> float:
    """Return the force within its limit and update what the law remembers, in place."""
    at = position, speed, target, target_speed, target_acceleration
    wanted = law_force(c, m, at, load)
    force = min(max(wanted, -limit), limit)
    law_remember(c, m, at, wanted, force)
    return force


@compiled
def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return a product of few numbers, for which BLAS takes longer to begin than to finish."""
    product = np.zeros(matrix.shape[0])
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            product[i] += matrix[i, j] * vector[j]
    return product


@compiled
def normal_modes(  # noqa: C901
    at: FloatArray,
    offset: FloatArray,
    density: float,
    bending: float,
    stiffness: float,
    damping: float,
    period: float,
    table: FloatArray,
) -> None:
    """
    Write the normal modes of the inserted part with their responses over a period.

    Parameters
    ----------
    at : ndarray, shape (n (n + 1) + 4 n,)
        `ModeShapes.packed` at the inserted length.
    offset : ndarray, shape (pairs + 2 n,)
        Row of `Tissue.offsets` of the layer that holds the tip.
    density, bending, stiffness, damping : float
        rho A, E I_y, k_a of that layer, and c_a.
    period : float
        Duration of the responses [s].
    table : ndarray, shape (2 n + TABLE, n)
        Overwritten with the shapes V with V^T rho A G V = 1, so that q = V eta, and their
        inverse; from row 2 n on `oscillation` of each mode (six rows), the squares of the
        natural frequencies [1/s^2], ascending, phi(s), phi''(s), and the stiffness of the tissue
        at the tip.

    """
    n = table.shape[1]
    pairs = n * (n + 1) // 2
    # L^-1 K L^-T, L^T and L^-1 side by side, with rho A G = L L^T: the rotations of the rows that
    # make the first diagonal turn the others into the inverse of V and its transpose.
    rows, stiff = np.zeros((n, 3 * n)), np.empty((n, n))
    k = 0
    for i in range(n):
        for j in range(i, n):
            value = density * at[k]
            for m in range(i):
                value -= rows[m, n + i] * rows[m, n + j]
            rows[i, n + j] = sqrt(value) if i == j else value / rows[i, n + i]
            tissue = stiffness * at[k] + offset[k]
            stiff[i, j] = stiff[j, i] = bending * at[pairs + k] + tissue
            k += 1
    factor, back = rows[:, n : 2 * n], rows[:, 2 * n :]
    for j in range(n):
        for i in range(j, n):
            value = 1.0 if i == j else 0.0
            for m in range(j, i):
                value -= factor[m, i] * back[m, j]
            back[i, j] = value / factor[i, i]
    for i in range(n):
        half = _times(stiff, back[i])
        for j in range(i, n):
            for m in range(j + 1):
                rows[i, j] += back[j, m] * half[m]
            rows[j, i] = rows[i, j]
    for _ in range(30):
        largest = 0.0
        for i in range(n):
            for j in range(i + 1, n):
                off, scale = rows[i, j], sqrt(rows[i, i] * rows[j, j])
                largest = max(largest, abs(off) / scale)
                if abs(off) <= 1e-17 * scale:
                    continue
                tau = (rows[j, j] - rows[i, i]) / (2.0 * off)
                t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + sqrt(1.0 + tau * tau))
                c = 1.0 / sqrt(1.0 + t * t)
                s = t * c
                for k in range(n):
                    x, y = rows[k, i], rows[k, j]
                    rows[k, i], rows[k, j] = c * x - s * y, s * x + c * y
                for k in range(3 * n):
                    x, y = rows[i, k], rows[j, k]
                    rows[i, k], rows[j, k] = c * x - s * y, s * x + c * y
        if largest <= 1e-16:
            break
    for i in range(n):
        place = 0
        for j in range(n):
            if (rows[j, j], j) < (rows[i, i], i):
                place += 1
        table[:n, place], table[n + place] = back[i], factor[i]
        table[2 * n : 2 * n + 6, place] = oscillation(damping / density, rows[i, i], period)
        table[2 * n + SQUARES, place] = rows[i, i]
    table[2 * n + VALUE] = at[2 * pairs : 2 * pairs + n]
    table[2 * n + CURVATURE] = at[2 * pairs + n : 2 * pairs + 2 * n]
    table[2 * n + TISSUE] = stiffness


@compiled
def separate(state: FloatArray, target: FloatArray, x: FloatArray) -> bool:
    """Write deflections and rates of a state, shape (2, n); return whether all is finite."""
    n = x.shape[1]
    total = 0.0
    for i in range(n):
        x[0, i], x[1, i] = state[2 + i], state[4 + n + i]
        total += abs(target[0, i]) + abs(target[1, i]) + abs(target[2, i])
    for number in state:
        total += abs(number)
    return total < inf


@compiled
def coupling(
    c: FloatArray, table: FloatArray, x: FloatArray, speed: float
) -> tuple[float, FloatArray]:
    """
    Return what couples insertion and deflection in N of (13), unless `as_printed`.

    Returns
    -------
    float, ndarray of shape (n,)
        -N_d [N], against insertion, and the part of N_q1..N_qn that the speed brings.

    """
    n = x.shape[1]
    value, curvature = table[2 * n + VALUE], table[2 * n + CURVATURE]
    tip, bend, rate = 0.0, 0.0, 0.0
    for i in range(n):
        tip += value[i] * x[0, i]
        bend += curvature[i] * x[0, i]
        rate += value[i] * x[1, i]
    elastic = c[BENDING] * bend * bend + c[COUPLED] * table[2 * n + TISSUE, 0] * tip * tip
    held = c[DENSITY] * speed * rate * value
    return 0.5 * (elastic - c[DENSITY] * rate * rate), held


@compiled
def _deflection_free(table: FloatArray, x: FloatArray, force: FloatArray, end: FloatArray) -> None:
    """Write deflections and rates one period after ``x`` under constant forces; in place too."""
    n = x.shape[1]
    shapes, inverse, r = table[:n], table[n : 2 * n], table[2 * n : 2 * n + 6]
    eta, rate = _times(inverse, x[0]), _times(inverse, x[1])
    push = _times(shapes.T, force)
    end[0] = _times(shapes, r[0] * eta + r[1] * rate + r[4] * push)
    end[1] = _times(shapes, r[2] * eta + r[3] * rate + r[5] * push)


@compiled
def deflection_predict(
    c: FloatArray, table: FloatArray, x: FloatArray, speed: float, force: FloatArray
) -> float:
    """
    Take deflections and rates, in place, through a period with the needle in motion.

    Parameters
    ----------
    c : ndarray, shape (CONSTANTS,)
        Constants of the law.
    table : ndarray, shape (2 n + TABLE, n)
        As from `normal_modes`.
    x : ndarray, shape (2, n)
        Deflections q and their rates.
    speed : float
        Insertion speed [m/s].
    force : ndarray, shape (n,)
        Generalized forces.

    Returns
    -------
    float
        Force of the bent needle against insertion at the beginning [N].

    """
    against, held = coupling(c, table, x, speed)
    _deflection_free(table, x, force - held, x)
    return against


@compiled
def _deflection_pid(
    c: FloatArray, m: FloatArray, table: FloatArray, x: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Do what `_pid` does, on all deflections; divisor and slope are matrices."""
    n = x.shape[1]
    shapes, inverse, r = table[:n], table[n : 2 * n], table[2 * n : 2 * n + 6]
    h = c[PERIOD]
    share = h / (c[FILTER_TIME] + h)
    end = np.empty_like(x)
    _deflection_free(table, x, np.zeros(n), end)
    error = target[0] + h * target[1] - end[0]
    reached = target[1] + h * target[2]
    error_rate = (1.0 - share) * m[RATE] + share * (reached - end[1])
    stiffness = c[KP] + h * c[KI]
    push = stiffness * error + c[KD] * error_rate + c[KI] * m[INTEGRAL] + m[OFFSET]
    if c[FEED_FORWARD] != 0.0:
        eta, rate = _times(inverse, target[0]), _times(inverse, target[1])
        linear = _times(inverse, reached) - r[2] * eta - r[3] * rate
        push += _times(inverse.T, linear / r[5])
    slope, divisor = np.zeros((n, n)), np.eye(n)
    for i in range(n):
        for j in range(n):
            for k in range(n):
                both = shapes[i, k] * shapes[j, k]
                slope[i, j] += share * both * r[5, k]
                divisor[i, j] += both * (stiffness * r[4, k] + c[KD] * share * r[5, k])
    return push, divisor, error_rate, slope


@compiled
def _deflection_inverse(
    c: FloatArray,
    m: FloatArray,
    table: FloatArray,
    x: FloatArray,
    target: FloatArray,
    held: FloatArray,
) -> FloatArray:
    """Return the forces on all deflections by inverse dynamics; ``held`` is against them."""
    n = x.shape[1]
    inverse, r = table[n : 2 * n], table[2 * n : 2 * n + 6]
    wanted = target[2] + c[KD] * (target[1] - x[1]) + c[KP] * (target[0] - x[0])
    eta, rate = _times(inverse, x[0]), _times(inverse, x[1])
    change = c[PERIOD] * _times(inverse, wanted)
    linear = (rate + change - r[2] * eta - r[3] * rate) / r[5]
    return np.asarray(_times(inverse.T, linear) + held + m[OFFSET])


@compiled
def deflection_step(
    c: FloatArray,
    m: FloatArray,
    table: FloatArray,
    x: FloatArray,
    target: FloatArray,
    speed: float,
    match: bool,
    force: FloatArray,
) -> float:
    """
    Write the generalized forces for the next period and update what the law remembers, in place.

    Parameters
    ----------
    c, m : ndarray, shapes (CONSTANTS,) and (MEMORY, n)
        Constants of the law and what it remembers.
    table : ndarray, shape (2 n + TABLE, n)
        As from `normal_modes`.
    x : ndarray, shape (2, n)
        Deflections q and their rates.
    target : ndarray, shape (3, n)
        Wanted deflections, rates and accelerations.
    speed : float
        Insertion speed [m/s].
    match : bool
        Set what the law remembers so that its forces equal the last ones.
    force : ndarray, shape (n,)
        The last forces, overwritten with the new ones.

    Returns
    -------
    float
        Force of the bent needle against insertion [N].

    """
    against, held = coupling(c, table, x, speed)
    if match:
        m[:] = 0.0
        m[RATE] = target[1] - x[1]
    if c[LAW] == PID:
        push, divisor, error_rate, slope = _deflection_pid(c, m, table, x, target)
        if match:
            missing = _times(divisor, force) - push
            push += missing
            if c[KI] > 0.0:
                m[INTEGRAL] = missing / c[KI]
            else:
                m[OFFSET] = missing
        force[:] = np.linalg.solve(divisor, push)
        m[RATE] = error_rate - _times(slope, force)
        m[INTEGRAL] += c[PERIOD] * (target[0] - x[0])
    else:
        if match:
            m[OFFSET] = force - _deflection_inverse(c, m, table, x, target, held)
        force[:] = _deflection_inverse(c, m, table, x, target, held)
    m[OFFSET] *= c[FADE]
    return against


@compiled
def deflection_matrix(c: FloatArray, table: FloatArray, delay: int, unmodeled: int) -> FloatArray:
    """
    Put the loop on the deflections, at rest at a depth, through a period from each unit state.

    Parameters
    ----------
    c, table : ndarray, shapes (CONSTANTS,) and (2 n + TABLE, n)
        Constants of the law, and the modes as from `normal_modes`.
    delay, unmodeled : int
        Periods from measurement to effect that the law knows of, and further ones.

    Returns
    -------
    ndarray, shape (N n, N n)
        See `needle_controller.stability.deflection_matrix`.

    """
    n, late = table.shape[1], delay + unmodeled
    shapes, inverse = table[:n], table[n : 2 * n]
    # A memory that no gain uses is not part of the loop, and the offset of a switch just fades.
    slots = [INTEGRAL, RATE]
    if c[KI] == 0.0:
        slots.remove(INTEGRAL)
    if c[FILTER_TIME] * c[KD] == 0.0:
        slots.remove(RATE)
    first = 2 + len(slots)
    size = (first + late) * n
    matrix, rest = np.empty((size, size)), np.zeros((3, n))
    for column in range(size):
        part, mode = column // n, column % n
        x, m, commands = np.zeros((2, n)), np.zeros((MEMORY, n)), np.zeros((late + 1, n))
        if part < 2:
            x[part] = shapes[:, mode]
        elif part < first:
            m[slots[part - 2]] = shapes[:, mode]
        else:
            commands[part - first] = inverse[mode]
        end = x.copy()
        for k in range(unmodeled, late):
            deflection_predict(c, table, x, 0.0, commands[k])
        deflection_step(c, m, table, x, rest, 0.0, False, commands[late])
        deflection_predict(c, table, end, 0.0, commands[0])
        for k in range(first + late):
            if k < 2:
                part_of_end = _times(inverse, end[k])
            elif k < first:
                part_of_end = _times(inverse, m[slots[k - 2]])
            else:
                part_of_end = _times(shapes.T, commands[k - first + 1])
            matrix[k * n : (k + 1) * n, column] = part_of_end
    return matrix


@compiled
def _horner(c: FloatArray, x: float) -> float:
    """Return the value of a polynomial, the constant first."""
    value = 0.0
    for j in range(len(c) - 1, -1, -1):
        value = value * x + c[j]
    return value


@compiled
def quintic_extremes(c: FloatArray) -> FloatArray:
    """
    Return where a quintic and its first two derivatives are least and largest on [0, 1].

    Parameters
    ----------
    c : ndarray, shape (6,)
        Coefficients, the constant first.

    Returns
    -------
    ndarray, shape (3, 2)
        Least and largest value of each.

    """
    derivatives, extremes = np.zeros((6, 6)), np.empty((3, 2))
    derivatives[0] = c
    for k in range(1, 6):
        for j in range(6 - k):
            derivatives[k, j] = (j + 1) * derivatives[k - 1, j + 1]
    # Between the turns of a curve it has one root at the most: those of each derivative, from the
    # straight one on, are the turns of the one before.
    turns, count = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]), 2
    found = turns.copy()
    for k in range(4, -1, -1):
        values = np.array([_horner(derivatives[k], turns[i]) for i in range(count)])
        if k < 3:
            extremes[k, 0], extremes[k, 1] = values.min(), values.max()
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
                if (_horner(derivatives[k], middle) > 0.0) == positive:
                    low = middle
                else:
                    high = middle
            found[number] = low
            number += 1
        found[number] = 1.0
        count = number + 1
        turns[:] = found
    return extremes
