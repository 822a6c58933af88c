"""
Everything of the control laws that is compiled: one file, none of it calls into another one.

A law is an array of constants, slots below, and what it remembers an array that is written in
place: the same functions serve the node and compiled loops over thousands of runs.
"""

from __future__ import annotations

from typing import Final, TypeAlias

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled
import numpy as np

#: Laws by number.
INVERSE_DYNAMICS: Final = 0
PID: Final = 1

# Slots of the constants of a law.
LAW: Final = 0
PERIOD: Final = 1
#: Response of the axis over one period: position + PV speed + PF force, VV speed + VF force.
PV: Final = 2
VV: Final = 3
PF: Final = 4
VF: Final = 5
#: Coulomb friction, speed at which it is fully compensated, and the time ahead of that speed.
COULOMB: Final = 6
BREAKAWAY: Final = 7
AHEAD: Final = 8
#: Gains; KD is k_v in inverse dynamics.
KP: Final = 9
KI: Final = 10
KD: Final = 11
FILTER_TIME: Final = 12
TOLERANCE: Final = 13
#: Part of an excess that back-calculation takes away in one period; 0: conditional integration.
TRACKING: Final = 14
#: 1 with feed-forward, 0 without.
FEED_FORWARD: Final = 15
#: What a period leaves of the offset.
FADE: Final = 16
CONSTANTS: Final = 17

# Slots of what a law remembers: int e dt, the filtered rate of the error, a force that fades.
INTEGRAL: Final = 0
RATE: Final = 1
OFFSET: Final = 2
MEMORY: Final = 3

#: Position and speed, and those wanted with the acceleration.
Instant: TypeAlias = tuple[float, float, float, float, float]


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
    error = target + h * target_speed - position - c[PV] * speed
    reached = target_speed + h * target_acceleration
    error_rate = (1.0 - share) * m[RATE] + share * (reached - c[VV] * speed)
    stiffness = c[KP] + h * c[KI]
    push = stiffness * error + c[KD] * error_rate + c[KI] * m[INTEGRAL] + m[OFFSET]
    dry = 0.0
    if c[FEED_FORWARD] != 0.0:
        push += (reached - c[VV] * target_speed) / c[VF]
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
    linear = (predicted - c[VV] * speed) / c[VF]
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
