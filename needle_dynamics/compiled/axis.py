# SPDX-License-Identifier: Apache-2.0
"""Motion along the insertion axis: friction per length, cutting force, and membranes."""

from __future__ import annotations

from math import copysign, inf, sqrt
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import BoolArray, BoolVector, FloatArray, Vector
from needle_dynamics.compiled.cache import compiled, inlined, kernel
from needle_dynamics.compiled.friction import slide

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

DEPTH, VELOCITY, DEEPEST = range(3)  #: Indices of the axis state.

_HALVINGS: Final = 60  #: bisections of an event time: to the last digit of a step


class AxisConstants(NamedTuple):
    """Constants along the insertion axis."""

    mass: float  #: moving mass [kg]
    #: Friction that does not depend on the depth: mu_s [N] and mu_v [N s/m].
    coulomb: float
    viscous: float
    withdrawal: float  #: friction on withdrawal over that on insertion
    reach: float  #: depth at which the hub stops [m]
    starts: Vector  #: depths at which the layers begin [m], shape (layers,)
    #: Friction per length in each layer [N/m] and [N s/m^2], shape (layers,).
    coulomb_per_length: Vector
    viscous_per_length: Vector
    cutting: Vector  #: cutting force in each layer [N], shape (layers,)
    #: Depth [m], puncture force [N] and stiffness [N/m] of each membrane, shape (membranes,).
    membranes: Vector
    strengths: Vector
    stiffness: Vector


class Resistance(NamedTuple):
    """Forces that resist the motion at a depth."""

    dry: float  #: Coulomb friction on insertion [N]
    viscous: float  #: viscous friction on insertion [N s/m]
    cutting: float  #: cutting force, on insertion only [N]
    elastic: float  #: force of membranes, out of the tissue [N]


@compiled
def resistance(a: AxisConstants, depth: float, touches: bool, punctured: BoolArray) -> Resistance:
    """Return the resistance at a depth [m]; ``touches``: the tip touches uncut tissue."""
    dry, viscous, cutting, elastic = a.coulomb, a.viscous, 0.0, 0.0
    for i in range(len(a.starts)):
        end = a.starts[i + 1] if i + 1 < len(a.starts) else inf
        inside = min(depth, end) - a.starts[i]
        if inside < 0.0:
            break
        dry += a.coulomb_per_length[i] * inside
        viscous += a.viscous_per_length[i] * inside
        cutting = a.cutting[i]
    for i in range(len(a.membranes)):
        if not punctured[i] and depth >= a.membranes[i]:
            # The tip deforms the membrane and does not cut.
            elastic += a.stiffness[i] * (depth - a.membranes[i])
            touches = False
    return Resistance(dry, viscous, cutting if touches else 0.0, elastic)


@compiled
def _events(a: AxisConstants, state: FloatArray, punctured: BoolArray) -> tuple[float, float]:
    """Return the range of depths [m] around the tip without any change of the resistance."""
    depth = state[DEPTH]
    low, high = 0.0, a.reach
    for start in a.starts:
        if start < depth:
            low = max(low, start)
        elif start > depth:
            high = min(high, start)
    if depth < state[DEEPEST]:
        high = min(high, state[DEEPEST])
    for i in range(len(a.membranes)):
        if punctured[i]:
            continue
        if depth < a.membranes[i]:
            high = min(high, a.membranes[i])
        else:
            high = min(high, a.membranes[i] + a.strengths[i] / a.stiffness[i])
            if depth > a.membranes[i]:
                low = max(low, a.membranes[i])
    return low, high


@inlined
def _arrive(a: AxisConstants, state: FloatArray, punctured: BoolArray) -> None:
    depth = state[DEPTH]
    state[DEEPEST] = max(state[DEEPEST], depth)
    for i in range(len(a.membranes)):
        if depth >= a.membranes[i] + a.strengths[i] / a.stiffness[i]:
            punctured[i] = True
    if depth >= a.reach and state[VELOCITY] > 0.0:
        # Contact of the hub with the guide.
        state[VELOCITY] = 0.0


@inlined
def _glide(
    a: AxisConstants, r: Resistance, velocity: float, force: float, t: float
) -> tuple[float, float]:
    """Return velocity [m/s] and displacement [m] under a constant resistance."""
    # Cutting as friction with the ratio of `slide`, plus a constant force.
    share = r.cutting / (1.0 + a.withdrawal)
    drive = force - r.elastic - a.withdrawal * share
    return slide(velocity, drive, a.mass, r.dry + share, r.viscous, t, a.withdrawal)


@kernel
def push(
    boxed: Boxed[AxisConstants],
    state: Vector,
    punctured: BoolVector,
    force: float,
    duration: float,
    step: float,
) -> float:
    """Advance under a force [N] for ``duration`` [s] in steps up to ``step`` [s], in place."""
    # Returns the time left when the needle leaves the tissue [s], otherwise 0.
    a = boxed.value
    left = duration
    while left > 0.0:
        t = min(step, left)
        depth, velocity = state[DEPTH], state[VELOCITY]
        low, high = _events(a, state, punctured)
        if depth >= a.reach and velocity >= 0.0 and force > 0.0:
            # At rest on the hub, pushed against it.
            state[VELOCITY] = 0.0
            return 0.0
        touches = depth >= state[DEEPEST]
        # Second order: resistance at the middle of the displacement.
        r = resistance(a, depth, touches, punctured)
        _, half = _glide(a, r, velocity, force, 0.5 * t)
        middle = min(max(depth + half, low), high)
        r = resistance(a, middle, touches, punctured)
        after, moved = _glide(a, r, velocity, force, t)
        if not low < depth + moved < high and moved != 0.0:
            at = high if moved > 0.0 else low
            early, late = 0.0, t
            for _ in range(_HALVINGS):
                between = 0.5 * (early + late)
                _, gone = _glide(a, r, velocity, force, between)
                beyond = depth + gone >= at if moved > 0.0 else depth + gone <= at
                if beyond:
                    late = between
                else:
                    early = between
            t = late
            after, _ = _glide(a, r, velocity, force, t)
            state[DEPTH] = at
        else:
            state[DEPTH] = depth + moved
        state[VELOCITY] = after
        left -= t
        if state[DEPTH] <= 0.0 and moved < 0.0:
            state[DEPTH] = 0.0
            return max(left, 1e-300)
        _arrive(a, state, punctured)
    return 0.0


@kernel
def carry_on(
    boxed: Boxed[AxisConstants],
    state: Vector,
    punctured: BoolVector,
    velocity: float,
    duration: float,
    step: float,
    forces: Vector,
) -> float:
    """Advance with a ramp to ``velocity`` [m/s] over ``duration`` [s], at any force, in place."""
    # ``forces``, shape (parts,), takes the mean force in equal parts [N]. Returns as `push`.
    a = boxed.value
    rate = (velocity - state[VELOCITY]) / duration
    left = duration
    for k in range(len(forces)):
        begin, end, impulse = left, duration * ((len(forces) - 1 - k) / len(forces)), 0.0
        while left > end:
            t = min(step, left - end)
            depth, before = state[DEPTH], state[VELOCITY]
            low, high = _events(a, state, punctured)
            touches = depth >= state[DEEPEST]
            moved = (before + 0.5 * rate * t) * t
            if not low < depth + moved < high and moved != 0.0:
                at = high if moved > 0.0 else low
                moved = at - depth
                # Root without cancellation; rounding can make the square negative.
                root = sqrt(max(0.0, before * before + 2.0 * rate * moved))
                t = min(t, 2.0 * moved / (before + copysign(root, moved)))
                state[DEPTH] = at
            else:
                state[DEPTH] = depth + moved
            state[VELOCITY] = velocity if t == left else before + rate * t
            r = resistance(a, min(max(depth + 0.5 * moved, low), high), touches, punctured)
            mean = before + 0.5 * rate * t
            impulse += t * (a.mass * rate + r.elastic + _resisting(a, r, mean))
            left = end if t == left - end else left - t
            state[DEPTH] = max(state[DEPTH], 0.0)
            if (state[DEPTH] == 0.0 and moved < 0.0) or (state[DEPTH] >= a.reach and moved > 0.0):
                forces[k:] = impulse / (begin - left)
                return max(left, 1e-300)
            _arrive(a, state, punctured)
        forces[k] = impulse / (begin - end)
    return 0.0


@inlined
def _resisting(a: AxisConstants, r: Resistance, velocity: float) -> float:
    """Return friction and cutting force [N]; at rest the static friction of least force."""
    if velocity > 0.0:
        return r.dry + r.cutting + r.viscous * velocity
    if velocity < 0.0:
        return a.withdrawal * (r.viscous * velocity - r.dry)
    return min(max(-r.elastic, -a.withdrawal * r.dry), r.dry + r.cutting)
