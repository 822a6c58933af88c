"""
Everything of the control laws that is compiled: one file, none of it calls into another one.

A law is an array of constants, slots below, and what it remembers an array that is written in
place: the same functions serve the node and compiled loops over thousands of runs.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, exp, expm1, sin, sqrt
from typing import cast, Final, TypeVar

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
def _pid(
    c: FloatArray,
    m: FloatArray,
    position: float,
    speed: float,
    target: float,
    target_speed: float,
    target_acceleration: float,
) -> tuple[float, float, float, float, float]:
    """
    Set up the implicit form of `needle_controller.pid.Pid`.

    Returns push and divisor, the force being dry + push / divisor, and what the filtered rate at
    the end will be: constant minus slope (force - dry).
    """
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
def law_force(
    c: FloatArray,
    m: FloatArray,
    position: float,
    speed: float,
    target: float,
    target_speed: float,
    target_acceleration: float,
    load: float,
) -> float:
    """Return the force for the next period before any limit; see the classes of the laws."""
    if c[LAW] == PID:
        push, divisor, dry, _, _ = _pid(
            c, m, position, speed, target, target_speed, target_acceleration
        )
        return dry + push / divisor
    acceleration = (
        target_acceleration + c[KD] * (target_speed - speed) + c[KP] * (target - position)
    )
    predicted = speed + c[PERIOD] * acceleration
    linear = (predicted - c[VP] * position - c[VV] * speed) / c[VF]
    dry = c[COULOMB] * _lean(c, speed, acceleration)
    return float(linear + dry + load + m[OFFSET])


@compiled
def law_remember(
    c: FloatArray,
    m: FloatArray,
    position: float,
    speed: float,
    target: float,
    target_speed: float,
    target_acceleration: float,
    wanted: float,
    force: float,
) -> None:
    """Update what the law remembers, in place, for a force that it wanted and the one applied."""
    if c[LAW] == PID:
        _, divisor, dry, error_rate, slope = _pid(
            c, m, position, speed, target, target_speed, target_acceleration
        )
        m[RATE] = error_rate - slope * (force - dry)
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
def law_match(
    c: FloatArray,
    m: FloatArray,
    position: float,
    speed: float,
    target: float,
    target_speed: float,
    target_acceleration: float,
    load: float,
    force: float,
) -> None:
    """Set what the law remembers, in place, so that its force equals a given one."""
    m[INTEGRAL] = m[OFFSET] = 0.0
    m[RATE] = target_speed - speed
    missing = force - law_force(
        c, m, position, speed, target, target_speed, target_acceleration, load
    )
    if c[LAW] == PID:
        _, divisor, _, _, _ = _pid(
            c, m, position, speed, target, target_speed, target_acceleration
        )
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
    wanted = law_force(c, m, position, speed, target, target_speed, target_acceleration, load)
    force = min(max(wanted, -limit), limit)
    law_remember(c, m, position, speed, target, target_speed, target_acceleration, wanted, force)
    return force


@compiled
def normal_modes(
    at: FloatArray,
    offset: FloatArray,
    density: float,
    bending: float,
    stiffness: float,
    growth: float,
    damping: float,
    period: float,
) -> FloatArray:
    """
    Return the normal modes of the inserted part with their responses over a period.

    Parameters
    ----------
    at : ndarray, shape (n (n + 1) + 4 n,)
        `ModeShapes.packed` at the inserted length.
    offset : ndarray, shape (pairs + 2 n,)
        Row of `Tissue.offsets` of the layer that holds the tip.
    density, bending, stiffness, growth, damping : float
        rho A, E I_y, k_a of that layer, growth of the tissue by swelling, and c_a.
    period : float
        Duration of the responses [s].

    Returns
    -------
    ndarray, shape (2 n + TABLE, n)
        The shapes V with V^T rho A G V = 1, so that q = V eta, and their inverse; from row 2 n
        on `oscillation` of each mode (six rows), the squares of the natural frequencies
        [1/s^2], ascending, phi(s), phi''(s), and the stiffness of the tissue at the tip.

    """
    n = 1
    while n * (n + 1) + 4 * n < at.shape[0]:
        n += 1
    pairs = n * (n + 1) // 2
    mass, stiff = np.empty((n, n)), np.empty((n, n))
    k = 0
    for i in range(n):
        for j in range(i, n):
            mass[i, j] = mass[j, i] = density * at[k]
            tissue = growth * (stiffness * at[k] + offset[k])
            stiff[i, j] = stiff[j, i] = bending * at[pairs + k] + tissue
            k += 1
    factor = np.linalg.cholesky(mass)
    half = np.linalg.solve(factor, stiff)
    squares, turned = np.linalg.eigh(np.linalg.solve(factor, half.T.copy()))
    table = np.empty((2 * n + TABLE, n))
    table[:n] = np.linalg.solve(factor.T.copy(), turned)
    table[n : 2 * n] = turned.T.copy() @ factor.T.copy()
    for i in range(n):
        table[2 * n : 2 * n + 6, i] = oscillation(damping / density, squares[i], period)
        table[2 * n + SQUARES, i] = squares[i]
        table[2 * n + VALUE, i] = at[2 * pairs + i]
        table[2 * n + CURVATURE, i] = at[2 * pairs + n + i]
        table[2 * n + TISSUE, i] = growth * stiffness
    return table


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
def deflection_free(table: FloatArray, x: FloatArray, force: FloatArray) -> FloatArray:
    """Return deflections and rates, shape (2, n), one period after ``x`` under constant forces."""
    n = x.shape[1]
    shapes, inverse, r = table[:n], table[n : 2 * n], table[2 * n : 2 * n + 6]
    eta, rate = inverse @ x[0], inverse @ x[1]
    push = shapes.T @ force
    end = np.empty_like(x)
    end[0] = shapes @ (r[0] * eta + r[1] * rate + r[4] * push)
    end[1] = shapes @ (r[2] * eta + r[3] * rate + r[5] * push)
    return end


@compiled
def deflection_predict(
    c: FloatArray, table: FloatArray, x: FloatArray, speed: float, force: FloatArray
) -> tuple[FloatArray, float]:
    """Return what `deflection_free` does with the needle in motion, and the load of insertion."""
    against, held = coupling(c, table, x, speed)
    return deflection_free(table, x, force - held), against


@compiled
def _deflection_pid(
    c: FloatArray, m: FloatArray, table: FloatArray, x: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Do what `_pid` does, on all deflections; divisor and slope are matrices."""
    n = x.shape[1]
    shapes, inverse, r = table[:n], table[n : 2 * n], table[2 * n : 2 * n + 6]
    h = c[PERIOD]
    share = h / (c[FILTER_TIME] + h)
    end = deflection_free(table, x, np.zeros(n))
    error = target[0] + h * target[1] - end[0]
    reached = target[1] + h * target[2]
    error_rate = (1.0 - share) * m[RATE] + share * (reached - end[1])
    stiffness = c[KP] + h * c[KI]
    push = stiffness * error + c[KD] * error_rate + c[KI] * m[INTEGRAL] + m[OFFSET]
    if c[FEED_FORWARD] != 0.0:
        eta, rate = inverse @ target[0], inverse @ target[1]
        linear = inverse @ reached - r[2] * eta - r[3] * rate
        push = push + inverse.T @ (linear / r[5])
    slope = share * (shapes * r[5]) @ shapes.T
    divisor = np.eye(n) + stiffness * (shapes * r[4]) @ shapes.T + c[KD] * slope
    return push, divisor, error_rate, slope


@compiled
def deflection_force(
    c: FloatArray,
    m: FloatArray,
    table: FloatArray,
    x: FloatArray,
    target: FloatArray,
    held: FloatArray,
) -> FloatArray:
    """
    Return the generalized forces on all deflections for the next period.

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
    held : ndarray, shape (n,)
        Other known forces against the deflections.

    Returns
    -------
    ndarray, shape (n,)
        Generalized forces.

    """
    if c[LAW] == PID:
        push, divisor, _, _ = _deflection_pid(c, m, table, x, target)
        return np.asarray(np.linalg.solve(divisor, push))
    n = x.shape[1]
    inverse, r = table[n : 2 * n], table[2 * n : 2 * n + 6]
    wanted = target[2] + c[KD] * (target[1] - x[1]) + c[KP] * (target[0] - x[0])
    eta, rate = inverse @ x[0], inverse @ x[1]
    change = c[PERIOD] * (inverse @ wanted)
    linear = (rate + change - r[2] * eta - r[3] * rate) / r[5]
    return np.asarray(inverse.T @ linear + held + m[OFFSET])


@compiled
def deflection_match(
    c: FloatArray,
    m: FloatArray,
    table: FloatArray,
    x: FloatArray,
    target: FloatArray,
    speed: float,
    force: FloatArray,
) -> None:
    """Set what the law remembers, in place, so that its forces equal given ones."""
    m[:] = 0.0
    m[RATE] = target[1] - x[1]
    _, held = coupling(c, table, x, speed)
    missing = force - deflection_force(c, m, table, x, target, held)
    if c[LAW] == PID:
        _, divisor, _, _ = _deflection_pid(c, m, table, x, target)
        missing = divisor @ missing
        if c[KI] > 0.0:
            m[INTEGRAL] = missing / c[KI]
            return
    m[OFFSET] = missing


@compiled
def deflection_step(
    c: FloatArray,
    m: FloatArray,
    table: FloatArray,
    x: FloatArray,
    target: FloatArray,
    speed: float,
) -> tuple[FloatArray, float]:
    """Return the forces and the load of insertion; update what the law remembers, in place."""
    against, held = coupling(c, table, x, speed)
    force = deflection_force(c, m, table, x, target, held)
    if c[LAW] == PID:
        _, _, error_rate, slope = _deflection_pid(c, m, table, x, target)
        m[RATE] = error_rate - slope @ force
        m[INTEGRAL] += c[PERIOD] * (target[0] - x[0])
    m[OFFSET] *= c[FADE]
    return force, against
