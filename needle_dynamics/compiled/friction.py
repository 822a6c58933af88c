"""
Friction along the insertion axis: the laws, and the motion of the axis under them.

A law is one branch of `dry_friction`. To add one, add its name to `FRICTION_LAWS` and its branch
there; simulation, linearization and inverse dynamics follow from it. A constant that it needs is a
field of `FrictionConstants`, of `needle_dynamics.friction.Friction` and of `NeedleParameters`.
"""

from __future__ import annotations

from math import exp, inf, log1p, sqrt, tanh
from typing import Final, NamedTuple

from needle_dynamics.compiled.cache import compiled, inlined_kernel, kernel
from needle_dynamics.compiled.oscillator import glide

#: Laws by name; a law's number is its place here.
FRICTION_LAWS: Final = ('coulomb', 'stribeck', 'tanh')

COULOMB: Final = 0
STRIBECK: Final = 1
TANH: Final = 2


class FrictionConstants(NamedTuple):
    """
    Constants of a friction law; see `needle_dynamics.friction.Friction`.

    Attributes
    ----------
    law : int
        Number of the law, its place in `FRICTION_LAWS`.
    coulomb, viscous : float
        Coulomb friction mu_s [N] and viscous friction mu_v [N s/m].
    withdrawal : float
        Friction on withdrawal over that on insertion.
    breakaway : float
        Friction at rest over mu_s (``stribeck``).
    stribeck_speed, smoothing_speed : float
        Speeds over which friction falls (``stribeck``) and turns (``tanh``) [m/s].

    """

    law: int
    coulomb: float
    viscous: float
    withdrawal: float
    breakaway: float
    stribeck_speed: float
    smoothing_speed: float


@kernel
def dry_friction(f: FrictionConstants, coulomb: float, speed: float) -> tuple[float, float]:
    """
    Return dry friction at a speed: the definition of every law.

    The value at rest is what friction can hold. Where it is zero, the law is smooth: the needle
    never sticks, and creeps.

    Parameters
    ----------
    f : FrictionConstants
        Constants.
    coulomb : float
        Coulomb friction in the direction of the motion [N].
    speed : float
        Modulus of the insertion velocity [m/s].

    Returns
    -------
    level : float
        Dry friction [N].
    slope : float
        Its derivative by the speed [N s/m].

    """
    if f.law == STRIBECK:
        ratio = speed / f.stribeck_speed
        excess = (f.breakaway - 1.0) * exp(-ratio * ratio)
        return coulomb * (1.0 + excess), -2.0 * coulomb * excess * ratio / f.stribeck_speed
    if f.law == TANH:
        turned = tanh(speed / f.smoothing_speed)
        return coulomb * turned, coulomb * (1.0 - turned * turned) / f.smoothing_speed
    return coulomb, 0.0


@kernel
def friction_force(f: FrictionConstants, velocity: float, drive: float) -> float:
    """
    Return the friction force on the needle, equation (15) with the dry part of the law.

    Parameters
    ----------
    f : FrictionConstants
        Constants.
    velocity : float
        Insertion velocity s_dot [m/s], positive into the tissue.
    drive : float
        Sum of the other forces [N], positive into the tissue; it decides at rest.

    Returns
    -------
    float
        Force [N], positive against insertion.

    """
    dry, _ = dry_friction(f, f.coulomb, abs(velocity))
    if velocity == 0.0:
        return min(max(drive, -f.withdrawal * dry), dry)
    if velocity > 0.0:
        return dry + f.viscous * velocity
    return f.withdrawal * (f.viscous * velocity - dry)


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
    """
    Exact flow of the insertion axis under a constant force and friction (15).

    Parameters
    ----------
    u : float
        Insertion velocity [m/s].
    drive : float
        Constant force [N], positive into the tissue.
    mass, coulomb, viscous : float
        Moving mass [kg], Coulomb friction [N], viscous friction [N s/m].
    t : float
        Duration [s].
    withdrawal : float
        Friction on withdrawal over that on insertion.
    breakaway : float
        Friction that rest can bear over Coulomb friction.

    Returns
    -------
    velocity : float
        Velocity after ``t`` [m/s]; exactly zero while stuck.
    displacement : float
        Distance moved [m].

    """
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
                # Below, it is the same to rounding, and b may be too small to divide by.
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
    """
    Move the insertion axis through a step under a constant force and any of the laws.

    Coulomb friction is exact. Other laws that hold at rest take the level of dry friction in the
    middle of the step, which is of second order. Smooth laws are stiff: they take two implicit
    stages of second order, L-stable (R. Alexander, SIAM J. Numer. Anal. 14, 1977), or one of
    first order where those would give energy back or pass the steady velocity.

    Parameters
    ----------
    f : FrictionConstants
        Constants.
    mass : float
        Moving mass [kg].
    u : float
        Insertion velocity [m/s].
    drive : float
        Constant force [N], positive into the tissue.
    h : float
        Length of the step [s].

    Returns
    -------
    velocity : float
        Velocity after the step [m/s].
    displacement : float
        Distance moved [m].

    """
    if f.law == COULOMB:
        return slide(u, drive, mass, f.coulomb, f.viscous, h, f.withdrawal)
    bearable = dry_friction(f, f.coulomb, 0.0)[0]
    if bearable > 0.0:
        level = dry_friction(f, f.coulomb, abs(u))[0]
        half, _ = slide(u, drive, mass, level, f.viscous, 0.5 * h, f.withdrawal, bearable / level)
        level = dry_friction(f, f.coulomb, abs(half))[0]
        return slide(u, drive, mass, level, f.viscous, h, f.withdrawal, bearable / level)
    part = 1.0 - sqrt(0.5)
    first = _implicit_stage(f, mass, u, drive, part * h)
    end = _implicit_stage(f, mass, u + (1.0 - part) / part * (first - u), drive, part * h)
    step = h * ((1.0 - part) * first + part * end)
    lost = drive * step - 0.5 * mass * (end * end - u * u)
    turned = (drive - friction_force(f, end, 0.0)) * (drive - friction_force(f, u, 0.0)) < 0.0
    if lost < 0.0 or turned:
        end = _implicit_stage(f, mass, u, drive, h)
        step = h * end
    return end, step


@compiled
def _implicit_stage(f: FrictionConstants, mass: float, u: float, drive: float, h: float) -> float:
    """Solve mass (w - u) = h (drive - friction(w)) for w under a smooth law."""
    # The residual grows with w: Newton, kept inside a bracket that always holds the root.
    inertia = mass / h
    reach = (abs(drive) + f.coulomb * max(1.0, f.withdrawal)) / inertia + abs(u)
    low, high = -reach, reach
    w = u
    for _ in range(100):
        factor = 1.0 if w >= 0.0 else f.withdrawal
        level, slope = dry_friction(f, f.coulomb, abs(w))
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
