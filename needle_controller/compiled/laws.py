"""
The arithmetic of the sampled control laws on one axis.

One set of functions serves the node, call by call, and the compiled loop over thousands of runs.
They take `LawConstants` and `Instant` as plain tuples and name their fields inside: Numba
recognizes a plain tuple several times faster than a named one.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled

#: Kinds of laws.
INVERSE_DYNAMICS: Final = 0.0
PID: Final = 1.0

#: Entries of the memory of a law: integral of the error, filtered rate of the error, and a force
#: that fades after a switch of laws.
INTEGRAL, RATE, OFFSET = 0, 1, 2
MEMORY: Final = 3


class LawConstants(NamedTuple):
    """
    A sampled law on one axis.

    Attributes
    ----------
    kind : float
        `INVERSE_DYNAMICS` or `PID`.
    period : float
        Sample period h [s].
    pv, vv, pf, vf : float
        Response of the axis over one period to its speed and to a constant force; see `Response`.
    coulomb : float
        Coulomb friction [N].
    breakaway_speed : float
        Speed from which on Coulomb friction is fully compensated [m/s].
    ahead : float
        Time ahead of that speed [s].
    kp, ki, kd : float
        Gains; ``kd`` is k_v of inverse dynamics, which has no ``ki``.
    filter_time : float
        Time constant of the filter of the error rate [s].
    tolerance : float
        Error at rest below which the integral is frozen [m].
    tracking : float
        Part of an excess force that back-calculation removes in one period; 0 for conditional
        integration.
    feed_forward : float
        1 with feed-forward, 0 without.
    fade : float
        Factor by which the offset after a switch decreases in one period.

    """

    kind: float
    period: float
    pv: float
    vv: float
    pf: float
    vf: float
    coulomb: float
    breakaway_speed: float
    ahead: float
    kp: float
    ki: float
    kd: float
    filter_time: float
    tolerance: float
    tracking: float
    feed_forward: float
    fade: float


class Instant(NamedTuple):
    """
    What a law responds to.

    Attributes
    ----------
    position, speed : float
        State of the axis.
    target, target_speed, target_acceleration : float
        Setpoint.

    """

    position: float
    speed: float
    target: float
    target_speed: float
    target_acceleration: float


class _Implicit(NamedTuple):
    """
    PID as an equation for its own force: force = dry + push / divisor.

    The filtered rate of the error at the end of the period is rate - slope (force - dry).
    """

    push: float
    divisor: float
    dry: float
    rate: float
    slope: float


@compiled
def _lean(c: LawConstants, speed: float, acceleration: float) -> float:
    """Return the share of Coulomb friction to compensate, by the speed shortly ahead."""
    if c.coulomb == 0.0:
        return 0.0
    return min(max((speed + c.ahead * acceleration) / c.breakaway_speed, -1.0), 1.0)


@compiled
def _implicit(c: LawConstants, memory: FloatArray, at: Instant) -> _Implicit:
    """Set up the implicit form of `needle_controller.laws.pid.Pid`."""
    h = c.period
    share = h / (c.filter_time + h)
    error = at.target + h * at.target_speed - at.position - c.pv * at.speed
    reached = at.target_speed + h * at.target_acceleration
    rate = (1.0 - share) * memory[RATE] + share * (reached - c.vv * at.speed)
    stiffness = c.kp + h * c.ki
    push = stiffness * error + c.kd * rate + c.ki * memory[INTEGRAL] + memory[OFFSET]
    dry = 0.0
    if c.feed_forward != 0.0:
        push += (reached - c.vv * at.target_speed) / c.vf
        dry = c.coulomb * _lean(c, at.target_speed, at.target_acceleration)
    slope = share * c.vf
    return _Implicit(push, 1.0 + stiffness * c.pf + c.kd * slope, dry, rate, slope)


@compiled
def _force(c: LawConstants, memory: FloatArray, at: Instant, load: float) -> float:
    """Return the force for the next period, before any limit."""
    if c.kind == PID:
        form = _implicit(c, memory, at)
        return form.dry + form.push / form.divisor
    acceleration = (
        at.target_acceleration
        + c.kd * (at.target_speed - at.speed)
        + c.kp * (at.target - at.position)
    )
    linear = (at.speed + c.period * acceleration - c.vv * at.speed) / c.vf
    dry = c.coulomb * _lean(c, at.speed, acceleration)
    return linear + dry + load + float(memory[OFFSET])


@compiled
def _remember(
    c: LawConstants, memory: FloatArray, at: Instant, wanted: float, force: float
) -> None:
    """Update the memory for a wanted force and the one that the limit left of it."""
    if c.kind == PID:
        form = _implicit(c, memory, at)
        memory[RATE] = form.rate - form.slope * (force - form.dry)
        error, excess = at.target - at.position, wanted - force
        at_rest = at.target_speed == 0.0 and at.target_acceleration == 0.0
        if not (at_rest and abs(error) < c.tolerance):
            if c.tracking > 0.0:
                memory[INTEGRAL] += c.period * error
                if c.ki > 0.0:
                    memory[INTEGRAL] -= c.tracking * excess * form.divisor / c.ki
            elif excess * error <= 0.0:
                memory[INTEGRAL] += c.period * error
    memory[OFFSET] *= c.fade


@compiled
def law_force(
    constants: tuple[float, ...], memory: FloatArray, instant: tuple[float, ...], load: float
) -> float:
    """
    Return the force for the next period, before any limit.

    Parameters
    ----------
    constants : tuple of float
        Fields of `LawConstants`.
    memory : ndarray, shape (MEMORY,)
        Memory of the law.
    instant : tuple of float
        Fields of `Instant`.
    load : float
        Known force against the motion [N].

    Returns
    -------
    float
        Force [N]; the equations are those of the classes of the laws.

    """
    return _force(LawConstants(*constants), memory, Instant(*instant), load)


@compiled
def law_match(
    constants: tuple[float, ...],
    memory: FloatArray,
    instant: tuple[float, ...],
    load: float,
    force: float,
) -> None:
    """
    Set the memory such that the force of the law equals a given one.

    Parameters
    ----------
    constants, memory, instant, load
        As for `law_force`.
    force : float
        Force that the law shall return [N].

    """
    c, at = LawConstants(*constants), Instant(*instant)
    memory[INTEGRAL] = memory[OFFSET] = 0.0
    memory[RATE] = at.target_speed - at.speed
    missing = force - _force(c, memory, at, load)
    if c.kind == PID:
        missing *= _implicit(c, memory, at).divisor
        if c.ki > 0.0:
            memory[INTEGRAL] = missing / c.ki
            return
    memory[OFFSET] = missing


@compiled
def law_step(
    constants: tuple[float, ...],
    memory: FloatArray,
    instant: tuple[float, ...],
    load: float,
    limit: float,
) -> float:
    """
    Return the force within its limit and update the memory.

    Parameters
    ----------
    constants, memory, instant, load
        As for `law_force`.
    limit : float
        Largest force [N].

    Returns
    -------
    float
        Force for the next period [N].

    """
    c, at = LawConstants(*constants), Instant(*instant)
    wanted = _force(c, memory, at, load)
    force = min(max(wanted, -limit), limit)
    _remember(c, memory, at, wanted, force)
    return force
