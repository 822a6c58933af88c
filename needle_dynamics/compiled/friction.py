# SPDX-License-Identifier: Apache-2.0
"""
Friction along the insertion axis: friction laws, and the motion of the axis under them.

Each law is a branch of `dry_friction`. To add a law, add its name to `FRICTION_LAWS` and its
branch there; simulation, linearization and inverse dynamics use it. A new constant is a field of
`FrictionConstants`, of `needle_dynamics.friction.Friction` and of `NeedleParameters`. The number
of a law of a user (`needle_dynamics.friction.add_friction_law`) is the address of its function.
"""

from collections.abc import Callable
from math import exp, expm1, inf, log1p, sqrt, tanh
from typing import Any, cast, Final, NamedTuple

from needle_dynamics.compiled.cache import compiled, inlined_kernel, kernel

#: Names of the laws; the index is the number of the law.
FRICTION_LAWS: Final = ('coulomb', 'stribeck', 'tanh')

COULOMB, STRIBECK, TANH = range(3)

#: Largest change of dry friction in a part of a step, relative to static friction, and relative to
#: Coulomb friction under a smooth law.
_CHANGE, _SMOOTH_CHANGE = 1e-3, 1e-2
_SHORTEST: Final = 2e-3  #: shortest part that is divided, over the step


class _Call:
    """Call of a C function, for compiled functions; Numba is imported at the first compilation."""

    _type: Any = None

    @property
    def _numba_type_(self) -> Any:
        self._type = self._type or _call_type()
        return self._type


def _call_type() -> Any:
    from numba import types
    from numba.core.cgutils import ir
    from numba.core.registry import cpu_target
    from numba.extending import intrinsic

    def call(_context: Any, _address: Any, _coulomb: Any, _speed: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            number = ir.DoubleType()
            law = ir.FunctionType(number, [number, number]).as_pointer()
            return builder.call(builder.inttoptr(arguments[0], law), arguments[1:])

        return types.float64(types.int64, types.float64, types.float64), generate

    made = intrinsic(call)
    cpu_target.typing_context.refresh()
    return cpu_target.typing_context.resolve_value_type(made)


#: Dry friction [N] of the law at an address, from Coulomb friction [N] and speed [m/s].
own_level: Final = cast(Callable[[int, float, float], float], _Call())


class FrictionConstants(NamedTuple):
    """Constants of a friction law; see `needle_dynamics.friction.Friction`."""

    law: int  #: index of the law in `FRICTION_LAWS`, or address of the function of a user
    #: Coulomb friction mu_s [N] and viscous friction mu_v [N s/m].
    coulomb: float
    viscous: float
    withdrawal: float  #: ratio of friction on withdrawal to friction on insertion
    breakaway: float  #: ratio of static friction to mu_s (``stribeck``)
    #: Speed scales of the decay (``stribeck``) and of the sign change (``tanh``) [m/s].
    stribeck_speed: float
    smoothing_speed: float


@kernel
def dry_friction(f: FrictionConstants, coulomb: float, speed: float) -> tuple[float, float]:
    """Return dry friction at a speed [N] and its derivative [N s/m], for every law."""
    # ``coulomb`` is for the direction of motion [N]. The value at rest is the static friction
    # limit; if it is zero, the law is smooth and the needle never sticks. A law of a user has no
    # derivative here, see `dry_slope`.
    if f.law == STRIBECK:
        ratio = speed / f.stribeck_speed
        excess = (f.breakaway - 1.0) * exp(-ratio * ratio)
        return coulomb * (1.0 + excess), -2.0 * coulomb * excess * ratio / f.stribeck_speed
    if f.law == TANH:
        turned = tanh(speed / f.smoothing_speed)
        return coulomb * turned, coulomb * (1.0 - turned * turned) / f.smoothing_speed
    if f.law > TANH:
        return own_level(f.law, coulomb, speed), 0.0
    return coulomb, 0.0


@kernel
def dry_slope(f: FrictionConstants, coulomb: float, speed: float) -> float:
    """Return the derivative of dry friction with respect to the speed [N s/m], for every law."""
    if f.law > TANH:
        # Relative to the speed, and small compared with the speed scales of friction at rest.
        step = 1e-5 * speed + 1e-9
        low = max(speed - step, 0.0)
        rise = own_level(f.law, coulomb, speed + step) - own_level(f.law, coulomb, low)
        return rise / (speed + step - low)
    return dry_friction(f, coulomb, speed)[1]


@kernel
def friction_force(f: FrictionConstants, velocity: float, drive: float) -> float:
    """Return the force (15) with any dry law [N], positive against insertion."""
    # At rest it balances ``drive``, the sum of the other forces [N], up to static friction.
    dry, _ = dry_friction(f, f.coulomb, abs(velocity))
    if velocity == 0.0:
        return min(max(drive, -f.withdrawal * dry), dry)
    if velocity > 0.0:
        return dry + f.viscous * velocity
    return f.withdrawal * (f.viscous * velocity - dry)


@kernel
def decay_means(x: float) -> tuple[float, float]:
    """Return two means of exp(-x r) for x >= 0, without cancellation at small x."""
    # The mean over r in [0, 1], (1 - exp(-x)) / x, and the integral over r in [0, 1] of the mean
    # over [0, r] times r, (x - 1 + exp(-x)) / x^2.
    if x < 1e-4:
        # Taylor: the next terms are below 1e-13.
        return 1.0 - x * (0.5 - x / 6.0), 0.5 - x * (1.0 / 6.0 - x / 24.0)
    mean = -expm1(-x) / x
    return mean, (1.0 - mean) / x


@compiled
def glide(u: float, a: float, b: float, t: float) -> tuple[float, float]:
    """Solve u_dot = a - b u for a time t [s], exactly; return velocity and displacement."""
    x = b * t
    mean, ramp = decay_means(x)
    return u * (1.0 - x * mean) + a * t * mean, t * (u * mean + a * t * ramp)


@compiled
def slide(
    u: float,
    drive: float,
    mass: float,
    coulomb: float,
    viscous: float,
    t: float,
    withdrawal: float = 1.0,
    breakaway: float = 1.0,
) -> tuple[float, float]:
    """Return velocity [m/s] and displacement [m] under a force [N] and friction (15), exactly."""
    # ``withdrawal`` is the ratio of friction on withdrawal to friction on insertion, ``breakaway``
    # that of static friction to Coulomb friction. The velocity is exactly zero while stuck.
    distance = 0.0
    if u != 0.0:
        sign = 1.0 if u > 0.0 else -1.0
        factor = 1.0 if u > 0.0 else withdrawal
        b = factor * viscous / mass
        braking = (factor * coulomb - drive * sign) / mass
        stop = inf
        if braking > 0.0:
            stop = abs(u) / braking
            if b * stop > 1e-16:
                # Below, equal to rounding, and b may be too small for the division.
                stop = log1p(b * stop) / b
        if stop > t:
            return glide(u, -sign * braking, b, t)
        _, distance = glide(u, -sign * braking, b, stop)
        t -= stop
    bearable = breakaway * coulomb
    if -withdrawal * bearable <= drive <= bearable:
        return 0.0, distance
    factor = 1.0 if drive > 0.0 else withdrawal
    excess = drive - coulomb if drive > 0.0 else drive + factor * coulomb
    velocity, further = glide(0.0, excess / mass, factor * viscous / mass, t)
    return velocity, distance + further


@inlined_kernel
def friction_flow(
    f: FrictionConstants, mass: float, u: float, drive: float, h: float
) -> tuple[float, float]:
    """Return velocity [m/s] and displacement [m] of the axis after a step, for every law."""
    # Coulomb friction is exact. Other laws with static friction use the level of dry friction in
    # the middle of a part of the step, which is of second order; a part is so short that this
    # level is nearly constant. Smooth laws are stiff: they take two implicit stages of second
    # order, L-stable (R. Alexander, SIAM J. Numer. Anal. 14, 1977), or one stage of first order
    # where the two stages would add energy or overshoot the steady velocity.
    if f.law == COULOMB:
        return slide(u, drive, mass, f.coulomb, f.viscous, h, f.withdrawal)
    return _divided_flow(f, mass, u, drive, h)


@compiled
def _divided_flow(
    f: FrictionConstants, mass: float, u: float, drive: float, h: float
) -> tuple[float, float]:
    """Return velocity and displacement after a step in parts of nearly constant dry friction."""
    static = dry_friction(f, f.coulomb, 0.0)[0]
    largest = _CHANGE * static if static > 0.0 else _SMOOTH_CHANGE * f.coulomb
    distance, rest, part = 0.0, h, h
    while rest > 0.0:
        part = min(part, rest)
        if static > 0.0:
            end, way, change = _sticking_flow(f, mass, u, drive, part)
        else:
            end, way, change = _smooth_flow(f, mass, u, drive, part)
        if change > largest and part > _SHORTEST * h:
            # Thirds: runs with steps of h and h / 2 have different parts, and their difference
            # contains the error of the parts.
            part /= 3.0
            continue
        u = end
        distance += way
        rest -= part
        part *= 3.0
    return u, distance


@compiled
def _sticking_flow(
    f: FrictionConstants, mass: float, u: float, drive: float, h: float
) -> tuple[float, float, float]:
    """Return velocity, displacement and change of friction of a law with static friction."""
    static = dry_friction(f, f.coulomb, 0.0)[0]
    level = dry_friction(f, f.coulomb, abs(u))[0]
    half, _ = slide(u, drive, mass, level, f.viscous, 0.5 * h, f.withdrawal, static / level)
    middle = dry_friction(f, f.coulomb, abs(half))[0]
    end, way = slide(u, drive, mass, middle, f.viscous, h, f.withdrawal, static / middle)
    last = dry_friction(f, f.coulomb, abs(end))[0]
    change = max(abs(middle - level), abs(last - middle))
    return end, way, max(change, static - min(level, last)) if u * end < 0.0 else change


@compiled
def _smooth_flow(
    f: FrictionConstants, mass: float, u: float, drive: float, h: float
) -> tuple[float, float, float]:
    part = 1.0 - sqrt(0.5)
    first = _implicit_stage(f, mass, u, drive, part * h)
    end = _implicit_stage(f, mass, u + (1.0 - part) / part * (first - u), drive, part * h)
    step = h * ((1.0 - part) * first + part * end)
    lost = drive * step - 0.5 * mass * (end * end - u * u)
    turned = (drive - friction_force(f, end, 0.0)) * (drive - friction_force(f, u, 0.0)) < 0.0
    if lost < 0.0 or turned:
        end = _implicit_stage(f, mass, u, drive, h)
        step = h * end
    before = dry_friction(f, f.coulomb, abs(u))[0]
    after = dry_friction(f, f.coulomb, abs(end))[0]
    return end, step, abs(before - after) if u * end >= 0.0 else before + after


@compiled
def _implicit_stage(f: FrictionConstants, mass: float, u: float, drive: float, h: float) -> float:
    """Solve mass (w - u) = h (drive - friction(w)) for w under a smooth law."""
    # The residual grows with w: Newton iteration with a bracket around the root.
    inertia = mass / h
    reach = (abs(drive) + f.coulomb * max(1.0, f.withdrawal)) / inertia + abs(u)
    low, high = -reach, reach
    w = u
    for _ in range(100):
        factor = 1.0 if w >= 0.0 else f.withdrawal
        level, slope = dry_friction(f, f.coulomb, abs(w))
        if f.law > TANH:
            slope = dry_slope(f, f.coulomb, abs(w))
        dry = level if w >= 0.0 else -level
        value = inertia * (w - u) - drive + factor * (dry + f.viscous * w)
        steep = slope + f.viscous
        if value > 0.0:
            high = w
        else:
            low = w
        following = w - value / (inertia + factor * steep)
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - w) <= 1e-15 * reach:
            return following
        w = following
    return w
