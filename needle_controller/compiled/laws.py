# SPDX-License-Identifier: Apache-2.0
"""
Sampled control laws on one axis, for the node and for the compiled loop over thousands of runs.

The functions take `LawConstants` and `Instant` as plain tuples and name their fields inside: Numba
recognizes a plain tuple several times faster than a named tuple.

Friction is adapted by recursive least squares. In each direction of motion three corrections are
estimated: of dry friction, of viscous friction, and of dry friction per insertion depth. Their
prior is zero with a standard deviation of half their bound. Each period of sliding is a
measurement: the force of the period, less inertia and modeled friction at the mean speed.
Corrections without excitation do not change. While the law learns, the covariance grows slowly, up
to the prior.
"""

from math import inf, isnan, sqrt
from typing import Annotated, Final, NamedTuple, TypeAlias

from needle_dynamics.arrays import FloatArray, Vector
from needle_dynamics.compiled.cache import compiled, inlined, inlined_kernel, kernel
from needle_dynamics.compiled.friction import (
    dry_friction,
    friction_flow,
    friction_force,
    FrictionConstants,
    TANH,
)

#: Corrections of one direction, and the size of their estimate with its covariance.
TERMS: Final = 3
BLOCK: Final = TERMS + TERMS * TERMS

LENGTH: Final = 0.05  #: Insertion depth over which dry friction may change by its bound [m].
_CORRELATED: Final = 0.01  #: Correlation time of the measurement noise [s].
_RELEARNED: Final = 60.0  #: Time in which a covariance grows to its prior, without samples [s].

#: Kinds of laws.
INVERSE_DYNAMICS: Final = 0.0
PID: Final = 1.0

#: Entries of the memory of a law: integral of the error, filtered rate of the error, force offset
#: that fades after a switch of laws, and for inverse dynamics position and velocity of the modeled
#: motion, valid if `FOLLOWS` is 1.
INTEGRAL, RATE, OFFSET, POSITION, VELOCITY, FOLLOWS = 0, 1, 2, 3, 4, 5

#: Learned friction, for insertion and then for withdrawal; before it a flag and the last measured
#: position and velocity, valid if the flag is 1.
MEASURED: Final = 6
LEARNED: Final = 9
MEMORY: Final = LEARNED + 2 * BLOCK

_SLIDES: Final = 5e-4  #: Least speed at which friction is learned [m/s].


@inlined
def bounds(share: float, coulomb: float, viscous: float) -> tuple[float, float, float]:
    """Return the largest modulus of each correction [N], [N s/m], [N/m], relative to the model."""
    return share * coulomb, share * viscous, share * coulomb / LENGTH


@inlined
def correction(
    block: FloatArray, limits: tuple[float, float, float], depth: float, speed: float
) -> float:
    """Return the learned friction [N] of a block (BLOCK,) at a depth [m] and a speed [m/s]."""
    dry, viscous, slope = limits
    dry_part = min(max(block[2], -slope), slope) * (depth - LENGTH) + block[0]
    return float(min(max(dry_part, -dry), dry) + min(max(block[1], -viscous), viscous) * speed)


@inlined
def learn(
    block: FloatArray,
    limits: tuple[float, float, float],
    depth: float,
    speed: float,
    missing: float,
    noise: float,
    period: float,
) -> None:
    """
    Update the estimate of one direction, shape (BLOCK,), with one period of sliding.

    ``missing`` is the friction beyond the model [N], and ``noise`` its standard deviation.
    """
    prior = (0.25 * limits[0] ** 2, 0.25 * limits[1] ** 2, 0.25 * limits[2] ** 2)
    growth = period / _RELEARNED
    # The covariance is symmetric: its diagonal, and the entries above it.
    c00 = (block[3] if block[3] > 0.0 else prior[0]) + growth * prior[0]
    c11 = (block[7] if block[7] > 0.0 else prior[1]) + growth * prior[1]
    c22 = (block[11] if block[11] > 0.0 else prior[2]) + growth * prior[2]
    c01, c02, c12 = block[4], block[5], block[8]
    if c00 > prior[0] or c11 > prior[1] or c22 > prior[2]:
        s0 = _shrink(prior[0], c00)
        s1 = _shrink(prior[1], c11)
        s2 = _shrink(prior[2], c22)
        c00, c11, c22 = s0 * s0 * c00, s1 * s1 * c11, s2 * s2 * c22
        c01, c02, c12 = s0 * s1 * c01, s0 * s2 * c02, s1 * s2 * c12
    # Regressors: 1, speed, and depth from `LENGTH`.
    away = depth - LENGTH
    w0 = c00 + c01 * speed + c02 * away
    w1 = c01 + c11 * speed + c12 * away
    w2 = c02 + c12 * speed + c22 * away
    variance = noise * noise * max(_CORRELATED / period, 1.0) + w0 + speed * w1 + away * w2
    error = missing - block[0] - speed * block[1] - away * block[2]
    g0, g1, g2 = w0 / variance, w1 / variance, w2 / variance
    block[0] += g0 * error
    block[1] += g1 * error
    block[2] += g2 * error
    block[3], block[7], block[11] = c00 - g0 * w0, c11 - g1 * w1, c22 - g2 * w2
    block[4] = block[6] = c01 - g0 * w1
    block[5] = block[9] = c02 - g0 * w2
    block[8] = block[10] = c12 - g1 * w2


@inlined
def _shrink(most: float, variance: float) -> float:
    """Return the factor of a deviation that reduces its variance to the largest."""
    return sqrt(most / variance) if variance > most else 1.0


class LawConstants(NamedTuple):
    """A sampled law on one axis."""

    kind: float  #: `INVERSE_DYNAMICS` or `PID`
    period: float  #: sample period h [s]
    #: Response of the axis over one period of insertion, and of withdrawal; see `Response`.
    pv: float
    vv: float
    pf: float
    vf: float
    back_pv: float
    back_vv: float
    back_pf: float
    back_vf: float
    inertia: float  #: inertia of the axis [kg]
    #: Friction of the axis; see `FrictionConstants`.
    friction_law: float
    coulomb: float
    viscous: float
    withdrawal: float
    breakaway: float
    stribeck_speed: float
    smoothing_speed: float
    breakaway_speed: float  #: speed above which Coulomb friction is fully compensated [m/s]
    ahead: float  #: prediction time of the speed for this compensation [s]
    #: Feedback gains: force per error, integral and rate of the error.
    kp: float
    ki: float
    kd: float
    #: Gains k_p [1/s^2] and k_v [1/s] of the modeled motion (inverse dynamics).
    model_kp: float
    model_kv: float
    filter_time: float  #: time constant of the filter of the error rate [s]
    tolerance: float  #: error at rest below which the integral is frozen [m]
    #: Fraction of an excess force that back-calculation removes in one period; 0: conditional.
    tracking: float
    feed_forward: float  #: 1 with feed-forward, 0 without
    fade: float  #: factor by which the offset after a switch decreases in one period
    bound: float  #: largest learned friction relative to the model; 0 without learning
    #: Standard deviation of the force measurement for learning [N]; infinite while frozen.
    noise: float


class Instant(NamedTuple):
    """State and setpoint, the inputs of a law."""

    #: State of the axis.
    position: float
    velocity: float
    #: Setpoint.
    target: float
    target_velocity: float
    target_acceleration: float


#: Plain tuples of the same fields: faster as arguments of compiled functions than named tuples.
LawTuple: TypeAlias = Annotated[tuple[float, ...], len(LawConstants._fields)]
InstantTuple: TypeAlias = Annotated[tuple[float, ...], len(Instant._fields)]


class _Implicit(NamedTuple):
    """
    Feedback as an equation for its own force: force = forward + push / divisor.

    The filtered rate of the error at the end of the period is rate - slope times the feedback.
    `end` and `reached` are the goal position and velocity then.
    """

    forward: float
    push: float
    divisor: float
    rate: float
    slope: float
    end: float
    reached: float


@inlined
def _friction(c: LawConstants) -> FrictionConstants:
    return FrictionConstants(
        int(c.friction_law),
        c.coulomb,
        c.viscous,
        c.withdrawal,
        c.breakaway,
        c.stribeck_speed,
        c.smoothing_speed,
    )


@inlined
def _dry(c: LawConstants, velocity: float, acceleration: float) -> float:
    """Return the dry friction of a motion [N] at its predicted velocity."""
    if c.coulomb == 0.0:
        return 0.0
    soon = velocity + c.ahead * acceleration
    level = dry_friction(_friction(c), c.coulomb, abs(soon))[0]
    if soon < 0.0:
        level *= c.withdrawal
    if c.friction_law == TANH:
        return level if soon > 0.0 else -level
    return level * min(max(soon / c.breakaway_speed, -1.0), 1.0)


@inlined
def _aim(c: LawConstants, memory: FloatArray, at: Instant) -> Instant:
    """Return the motion to follow: the reference, or the modeled motion, which converges to it."""
    if c.kind == PID:
        return at
    position, velocity = at.position, at.velocity
    if memory[FOLLOWS] == 1.0:
        position, velocity = float(memory[POSITION]), float(memory[VELOCITY])
    acceleration = (
        at.target_acceleration
        + c.model_kv * (at.target_velocity - velocity)
        + c.model_kp * (at.target - position)
    )
    return Instant(at.position, at.velocity, position, velocity, acceleration)


@inlined
def _learned(c: LawConstants, memory: FloatArray, position: float, soon: float) -> float:
    """Return the learned additional friction [N] at a position and the velocity shortly after."""
    if c.bound == 0.0:
        return 0.0
    first = LEARNED if soon > 0.0 else LEARNED + BLOCK
    most = bounds(c.bound, c.coulomb, c.viscous)
    found = correction(memory[first : first + BLOCK], most, position, abs(soon))
    return found * min(max(soon / c.breakaway_speed, -1.0), 1.0)


@inlined
def adapt(
    constants: LawTuple, memory: Vector, position: float, velocity: float, force: float
) -> None:
    """Learn friction from the last period and its force less known loads, if the axis slid."""
    c = LawConstants(*constants)
    if c.bound == 0.0:
        return
    valid, before, rate = memory[MEASURED], memory[MEASURED + 1], memory[MEASURED + 2]
    memory[MEASURED], memory[MEASURED + 1], memory[MEASURED + 2] = 1.0, position, velocity
    if valid != 1.0 or c.noise == inf:
        return
    mean = (position - before) / c.period
    # Sliding in the same direction at both ends, and no missing measurement between them.
    slides = min(abs(mean), abs(velocity), abs(rate)) > _SLIDES and velocity * rate > 0.0
    if not slides or abs(mean - 0.5 * (velocity + rate)) > 0.5 * abs(mean):
        return
    sign = 1.0 if mean > 0.0 else -1.0
    first = LEARNED if mean > 0.0 else LEARNED + BLOCK
    modeled = friction_force(_friction(c), mean, 0.0) + c.inertia * (velocity - rate) / c.period
    known = _learned(c, memory, memory[POSITION], memory[VELOCITY])
    learn(
        memory[first : first + BLOCK],
        bounds(c.bound, c.coulomb, c.viscous),
        position,
        abs(mean),
        sign * (force - modeled),
        c.noise,
        c.period,
    )
    if memory[FOLLOWS] == 1.0 and c.ki > 0.0:
        # The integral has compensated this friction: the sum of both does not change. Friction
        # that is gone does not return to the integral.
        more = _learned(c, memory, memory[POSITION], memory[VELOCITY]) - known
        pf, vf = (c.pf, c.vf) if memory[VELOCITY] > 0.0 else (c.back_pf, c.back_vf)
        integral, taken = memory[INTEGRAL], more * _divisor(c, pf, vf) / c.ki
        memory[INTEGRAL] -= min(max(taken, min(integral, 0.0)), max(integral, 0.0))


@inlined
def _divisor(c: LawConstants, pf: float, vf: float) -> float:
    """Return the factor by which implicit feedback reduces its force, for a response pf, vf."""
    h = c.period
    return 1.0 + (c.kp + h * c.ki) * pf + c.kd * h / (c.filter_time + h) * vf


@inlined
def _implicit(c: LawConstants, memory: FloatArray, aim: Instant) -> _Implicit:
    """Set up feed-forward and implicit feedback; see `needle_controller.laws.sampled.Pid`."""
    h = c.period
    reached = aim.target_velocity + h * aim.target_acceleration
    direction = aim.target_velocity + reached
    if direction == 0.0:
        direction = aim.target - aim.position
    pv, vv, pf, vf = c.pv, c.vv, c.pf, c.vf
    if direction < 0.0:
        pv, vv, pf, vf = c.back_pv, c.back_vv, c.back_pf, c.back_vf
    linear = (reached - vv * aim.target_velocity) / vf
    share = h / (c.filter_time + h)
    rate = (1.0 - share) * memory[RATE]
    stiffness, slope = c.kp + h * c.ki, share * vf
    divisor = _divisor(c, pf, vf)
    if c.kind == PID:
        end = aim.target + h * aim.target_velocity
        rate += share * (reached - vv * aim.velocity)
        push = stiffness * (end - aim.position - pv * aim.velocity)
    else:
        # The feed-forward moves the model to the end; feedback of the deviation only.
        end = aim.target + pv * aim.target_velocity + pf * linear
        slower = aim.target_velocity - aim.velocity
        rate += share * vv * slower
        push = stiffness * (aim.target - aim.position + pv * slower)
    push += c.kd * rate + c.ki * memory[INTEGRAL] + memory[OFFSET]
    soon = aim.target_velocity + c.ahead * aim.target_acceleration
    forward = _learned(c, memory, aim.target, soon)
    if c.kind == PID and c.feed_forward != 0.0:
        push += linear
    if c.feed_forward != 0.0:
        forward += _dry(c, aim.target_velocity, aim.target_acceleration)
        if c.kind != PID:
            forward += linear
    return _Implicit(forward, push, divisor, rate, slope, end, reached)


@inlined
def _step(c: LawConstants, memory: FloatArray, at: Instant, load: float, limit: float) -> float:
    """Return the force within its limit [N] and update the memory."""
    aim = _aim(c, memory, at)
    form = _implicit(c, memory, aim)
    wanted = form.forward + form.push / form.divisor
    if c.kind != PID:
        wanted += load
    force = min(max(wanted, -limit), limit)
    excess = wanted - force
    memory[RATE] = form.rate - form.slope * (form.push / form.divisor - excess)
    error = aim.target - aim.position
    at_rest = at.target_velocity == 0.0 and at.target_acceleration == 0.0
    if not (at_rest and abs(at.target - at.position) < c.tolerance):
        if c.tracking > 0.0:
            memory[INTEGRAL] += c.period * error
            if c.ki > 0.0:
                memory[INTEGRAL] -= c.tracking * excess * form.divisor / c.ki
        elif excess * error <= 0.0:
            memory[INTEGRAL] += c.period * error
    memory[OFFSET] *= c.fade
    # Without feedback, and at the force limit, the modeled motion restarts at the measurement.
    memory[FOLLOWS] = 1.0 if c.kp > 0.0 and excess == 0.0 else 0.0
    memory[POSITION], memory[VELOCITY] = form.end, form.reached
    return force


@kernel
def law_force(constants: LawTuple, memory: Vector, instant: InstantTuple, load: float) -> float:
    """
    Return the force for the next period before any limit [N]; see the classes of the laws.

    ``memory`` has shape (MEMORY,), and ``load`` is a known force against the motion [N].
    """
    return _step(LawConstants(*constants), memory.copy(), Instant(*instant), load, inf)


@compiled
def _match(
    constants: LawTuple, memory: Vector, instant: InstantTuple, load: float, force: float
) -> None:
    """Set the memory such that the force of the law equals ``force`` [N]; else as `law_force`."""
    c, at = LawConstants(*constants), Instant(*instant)
    memory[:MEASURED] = 0.0
    memory[RATE] = at.target_velocity - at.velocity
    form = _implicit(c, memory, _aim(c, memory, at))
    missing = (force - form.forward) * form.divisor - form.push
    if c.kind != PID:
        missing -= load * form.divisor
    if c.ki > 0.0:
        memory[INTEGRAL] = missing / c.ki
    else:
        memory[OFFSET] = missing


@inlined
def law_step(
    constants: LawTuple, memory: Vector, instant: InstantTuple, load: float, limit: float
) -> float:
    """Return the force within its limit [N] and update the memory; else as `law_force`."""
    return _step(LawConstants(*constants), memory, Instant(*instant), load, limit)


@inlined
def axis_step(
    constants: LawTuple, position: float, velocity: float, force: float
) -> tuple[float, float]:
    """Return position and velocity of the axis after one period under a force less loads [N]."""
    c = LawConstants(*constants)
    velocity, moved = friction_flow(_friction(c), c.inertia, velocity, force, c.period)
    return position + moved, velocity


@inlined_kernel
def answer(
    constants: LawTuple,
    memory: Vector,
    forces: Vector,
    instant: InstantTuple,
    load: float,
    limit: float,
    taken_over: float,
) -> float:
    """
    Return the force within its limit [N] that answers a measurement, and update the memory.

    ``instant`` has the measured state and the setpoint for the effect of the command. ``forces``,
    shape (1 + delay,), are the force of the last period and the commands without effect so far
    [N], updated. Before its limit the force equals a ``taken_over`` one that is not nan [N].
    """
    position, velocity, target, rate, acceleration = instant
    adapt(constants, memory, position, velocity, forces[0] - load)
    for i in range(1, len(forces)):
        position, velocity = axis_step(constants, position, velocity, forces[i] - load)
        forces[i - 1] = forces[i]
    at = (position, velocity, target, rate, acceleration)
    if not isnan(taken_over):
        _match(constants, memory, at, load, taken_over)
    force = law_step(constants, memory, at, load, limit)
    forces[-1] = force
    return force
