# SPDX-License-Identifier: Apache-2.0
"""
Step of the integrator, and sequences of steps under constant inputs.

One step of length h from (s, u, q, p) is a symmetric splitting:
drift the depth to the middle of the step, advance the modes at that depth (`modal_flow`), and
move the insertion axis under the force, the mean force of the modes and friction (`friction`).
Steps end at the borders of tissue layers, and the motion stops at the hub.
"""

from __future__ import annotations

from math import ceil, exp, inf, nan
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import compiled, inlined, kernel
from needle_dynamics.compiled.friction import dry_friction, friction_flow, FrictionConstants
from needle_dynamics.compiled.integrals import mode_integrals, ModeIntegrals, ModeTables
from needle_dynamics.compiled.matrices import backward, cholesky, forward
from needle_dynamics.compiled.modal_flow import Elasticity, rotate_many, rotate_two
from needle_dynamics.compiled.tissue import growth_at, layer_at, Layers, time_to_layer
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Relative insertion depth above which graded steps grow in proportion to the depth.
GRADED_FROM: Final = 0.1


class CompiledNeedle(NamedTuple):
    """Constants of a needle in tissue, SI units; see `needle_dynamics.model.NeedleModel`."""

    length: float
    linear_density: float
    bending_stiffness: float
    tissue_damping: float
    moving_mass: float
    carriage_mass: float
    rotary_inertia: float
    #: Range of the insertion depth [m].
    minimum_depth: float
    maximum_depth: float
    hub_stop: bool
    as_printed: bool  #: formulation `as_printed` instead of `complete`
    swelling: float
    swelling_time: float
    friction: FrictionConstants  #: friction along the insertion axis
    modes: ModeTables  #: tables of the shape modes
    layers: Layers  #: layers of tissue


@compiled
def adapted(c: CompiledNeedle, coulomb: float, viscous: float, layers: Layers) -> CompiledNeedle:
    """Return the needle with other friction coefficients [N], [N s/m] and other tissue layers."""
    f = c.friction
    friction = FrictionConstants(
        f.law, coulomb, viscous, f.withdrawal, f.breakaway, f.stribeck_speed, f.smoothing_speed
    )
    return CompiledNeedle(
        c.length, c.linear_density, c.bending_stiffness, c.tissue_damping, c.moving_mass,
        c.carriage_mass, c.rotary_inertia, c.minimum_depth, c.maximum_depth, c.hub_stop,
        c.as_printed, c.swelling, c.swelling_time, friction, c.modes, layers,
    )  # fmt: skip


class Inputs(NamedTuple):
    """Inputs of the base over an interval."""

    force: float  #: insertion force [N], positive into the tissue; ignored if ``moved``
    torque: float  #: torque about x [N m]
    velocity: float  #: insertion velocity at the end of the interval [m/s], if ``moved``
    moved: bool  #: whether the base follows a velocity ramp to ``velocity``, at any force


class Sums(NamedTuple):
    """Integrals accumulated over steps."""

    tip: float  #: integral of the tip deflection [m s]
    #: Impulse of the tissue's reaction along z [N s] and of its moment about the entry
    #: point [N m s].
    reaction: float
    moment: float
    resistance: float  #: impulse of a moved base on the needle, without the inertial part [N s]
    #: Energy lost to friction and to tissue damping, and work of the inputs [J].
    friction_work: float
    damping_work: float
    input_work: float
    impact_loss: float  #: energy lost in contacts of the hub [J]
    contact_time: float  #: time of the last hub contact [s]; -1 without contact


class Interval(NamedTuple):
    """Mean values and work over an interval, for sensors that average over the interval."""

    tip_deflection: float  #: mean tip deflection [m]
    #: Mean forces of the base on the needle along y (positive into the tissue) and z [N], and mean
    #: moment about x at the base [N m], including the torque; from the momentum balance.
    axial_force: float
    lateral_force: float
    moment: float
    #: Energy dissipated by friction and tissue damping, and work of force and torque [J].
    friction_work: float
    damping_work: float
    input_work: float
    impact_loss: float  #: energy dissipated by impacts of the hub [J]
    contact_time: float  #: time of the last hub contact [s], infinite without contact


class _Motion(NamedTuple):
    """Insertion depth [m], velocity [m/s], and mean acceleration in the last step [m/s^2]."""

    depth: float
    velocity: float
    acceleration: float


class _Border(NamedTuple):
    """State at the border of a part: lateral momentum, and angular momentum about the entry."""

    motion: _Motion
    sums: Sums
    momentum: float
    angular: float


@inlined
def _rates(
    c: CompiledNeedle, at: ModeIntegrals, z: FloatArray, factor: FloatArray, rates: FloatArray
) -> None:
    """Compute the rates of the modes from ``z``: momenta, or rates if `as_printed`."""
    n = z.shape[0]
    for i in range(n):
        rates[i] = z[i]
        for j in range(n):
            factor[i, j] = c.linear_density * at.gram[i, j]
    if not c.as_printed:
        cholesky(factor, factor)
        forward(factor, rates)
        backward(factor, rates)


@inlined
def _border(
    c: CompiledNeedle,
    at: ModeIntegrals,
    z: FloatArray,
    factor: FloatArray,
    rates: FloatArray,
    motion: _Motion,
    sums: Sums,
) -> _Border:
    """Compute the momenta for the momentum balance at the border of a part."""
    _rates(c, at, z, factor, rates)
    momentum, angular = 0.0, 0.0
    for i in range(rates.shape[0]):
        momentum += at.area[i] * rates[i]
        angular += at.moment[i] * rates[i]
    return _Border(motion, sums, c.linear_density * momentum, c.linear_density * angular)


@compiled
def _hub_contact(
    c: CompiledNeedle, u: float, drive: float, gain: float, moved: bool, room: float, h: float
) -> tuple[float, float]:
    """Return the time of the hub contact within a step [s], -1 at rest, and the velocity [m/s]."""
    if room <= 0.0:
        # Starts on the hub: all velocity is lost at once.
        return (0.0, u) if u > 0.0 else (-1.0, 0.0)
    early, late = 0.0, h
    for _ in range(60):
        trial = 0.5 * (early + late)
        if moved:
            gone = trial * (u + 0.5 * trial * gain)
        else:
            _, gone = friction_flow(c.friction, c.moving_mass, u, drive, trial)
        if gone < room:
            early = trial
        else:
            late = trial
    if moved:
        return late, u + late * gain
    return late, friction_flow(c.friction, c.moving_mass, u, drive, late)[0]


@compiled
def _resistance(
    c: CompiledNeedle, u: float, new_u: float, travel: float, impulse: float, h: float
) -> tuple[float, float]:
    """Return the friction loss of a moved needle [J] and the impulse that it requires [N s]."""
    f, mean = c.friction, 0.5 * (u + new_u)
    factor = 1.0 if mean >= 0.0 else f.withdrawal
    path = abs(u) + abs(new_u)
    if path > 0.0:
        # Dry friction weighted by the time spent in each direction.
        dry = dry_friction(f, factor * f.coulomb, abs(mean))[0] * (u + new_u) / path
    else:
        # At rest, static friction balances the pull of the modes up to its limit.
        bearable = dry_friction(f, f.coulomb, 0.0)[0]
        dry = min(max(-impulse / h, -f.withdrawal * bearable), bearable)
    viscous = f.viscous * factor
    return (dry + viscous * mean) * travel, (impulse / h + dry) * h + viscous * travel


@inlined
def _write_loads(
    c: CompiledNeedle,
    inputs: Inputs,
    before: _Border,
    now: _Border,
    span: float,
    loads: FloatArray,
) -> None:
    """Write the mean load on the base in a part of the duration, by balance of momentum."""
    gained = now.motion.velocity - before.motion.velocity
    if inputs.moved:
        axial = c.linear_density * c.length * gained
        loads[0] = (axial + now.sums.resistance - before.sums.resistance) / span
    else:
        loads[0] = inputs.force - c.carriage_mass * gained / span
    lateral = (now.momentum - before.momentum + now.sums.reaction - before.sums.reaction) / span
    about_entry = (now.angular - before.angular + now.sums.moment - before.sums.moment) / span
    lever = c.length - 0.5 * (before.motion.depth + now.motion.depth)
    loads[1], loads[2] = lateral, about_entry + lever * lateral + inputs.torque


@inlined
def _steps(  # noqa: C901
    c: CompiledNeedle,
    at: ModeIntegrals,
    work: FloatArray,
    modal: FloatArray,
    inputs: Inputs,
    gain: float,
    motion: _Motion,
    sums: Sums,
    span: float,
    end: float,
    later: float,
    longest: float,
    graded: bool,
) -> tuple[_Motion, Sums, float]:
    """Take steps through a span; return motion, sums and the time left undone [s]."""
    # ``gain`` is the acceleration of a moved base. The span ends at ``end`` - ``later``.
    q, z, q_before, z_before = modal[0], modal[1], modal[2], modal[3]
    layers, two = c.layers, q.shape[0] == 2
    layered = layers.starts.shape[0] > 1
    rho, f = c.linear_density, c.friction
    s, u, acceleration = motion
    tip, reaction, moment, resistance, friction, damping, done, impact, contact = sums
    growth, decay, layer = 1.0, 1.0, 0
    left, count, even, whole, renew = span, 0, 0.0, longest, True
    while left > 0.0:
        if renew:
            if graded:
                whole = longest * max(1.0, s / (GRADED_FROM * c.length))
            # No extra step if the time is a whole number of steps.
            count = ceil(left / whole * (1.0 - 1e-9))
            even = left / count
            renew = graded
        h = even
        count -= 1
        rest = left - h if count > 0 else 0.0
        if layered:
            border = time_to_layer(layers.starts, layers.stiffnesses, s, u)
            if 1e-3 * h < border < h:
                # A step ends at a layer border, so that its stiffness is constant.
                h, rest, renew = border, left - border, True
        middle = s + 0.5 * h * u
        if graded:
            # Mean depth of the step at the acceleration of the last step: smaller phase error.
            middle += h * h * acceleration / 6.0
        if c.hub_stop and middle > c.length:
            middle = c.length
        if not c.minimum_depth <= middle <= c.maximum_depth:
            break
        mode_integrals(c.modes, middle, work, at)
        if layered:
            layer = layer_at(layers.starts, middle, layer)
        if c.swelling != 0.0:
            growth = growth_at(c.swelling, c.swelling_time, end - (left + later) + 0.5 * h)
        if c.tissue_damping != 0.0:
            decay = exp(-0.5 * h * c.tissue_damping / rho)
        elasticity = Elasticity(
            rho, c.bending_stiffness, c.tissue_damping, c.as_printed,
            layer, growth * layers.stiffnesses[layer], growth, decay,
        )  # fmt: skip
        for i in range(q.shape[0]):
            q_before[i], z_before[i] = q[i], z[i]
        if two:
            turned = rotate_two(elasticity, layers, at, q, z, h)
        else:
            turned = rotate_many(elasticity, layers, at, q, z, h)
        drive = inputs.force - turned.impulse / h
        if inputs.moved:
            # Computed from the end, so that an end velocity of zero is exact.
            new_u = inputs.velocity - (rest + later) * gain
            travel = 0.5 * h * (u + new_u)
        else:
            new_u, travel = friction_flow(f, c.moving_mass, u, drive, h)
        stopped = c.hub_stop and s + travel >= c.length
        if s + travel < c.minimum_depth or (s + travel > c.maximum_depth and not stopped):
            # Keep the state before this step, the last valid state.
            for i in range(q.shape[0]):
                q[i], z[i] = q_before[i], z_before[i]
            break
        if stopped:
            travel = c.length - s
            late, new_u = _hub_contact(c, u, drive, gain, inputs.moved, travel, h)
            if late >= 0.0:
                contact = end - (left + later) + late
                impact += 0.5 * c.moving_mass * new_u * new_u
        gained = 0.5 * c.moving_mass * (new_u * new_u - u * u)
        if inputs.moved:
            lost, resisted = _resistance(c, u, new_u, travel, turned.impulse, h)
            done += lost + turned.impulse / h * travel + gained
            resistance += resisted
        else:
            lost = drive * travel - gained
            done += inputs.force * travel
        tip += turned.tip
        reaction += turned.reaction
        moment += turned.moment
        damping += turned.lost
        friction += lost
        acceleration = (new_u - u) / h
        s, u, left = s + travel, new_u, rest
        if stopped:
            s, u = c.length, 0.0
    sums = Sums(tip, reaction, moment, resistance, friction, damping, done, impact, contact)
    return _Motion(s, u, acceleration), sums, left


@inlined
def _means(sums: Sums, input_work: float, duration: float, loads: FloatArray) -> Interval:
    axial, lateral, moment = 0.0, 0.0, 0.0
    for part in range(loads.shape[0]):
        axial += loads[part, 0]
        lateral += loads[part, 1]
        moment += loads[part, 2]
    parts = max(1, loads.shape[0])
    return Interval(
        sums.tip / duration, axial / parts, lateral / parts, moment / parts, sums.friction_work,
        sums.damping_work, input_work, sums.impact_loss,
        sums.contact_time if sums.contact_time >= 0.0 else inf,
    )  # fmt: skip


@compiled
def advance(
    c: CompiledNeedle,
    state: Vector,
    time: float,
    inputs: Inputs,
    longest: float,
    graded: bool,
    duration: float,
    loads: Matrix,
) -> tuple[float, Interval]:
    """Advance a state under constant inputs for ``duration`` [s], in place."""
    # ``state`` has shape (2 (2 + n),); ``time`` [s] counts for swelling; ``longest`` is the
    # longest step [s], growing above a tenth of the needle length if ``graded``, since the modes
    # slow down. ``loads``, shape (parts, 3) or (0, 3), takes the load on the base in equal parts
    # of the duration, at whose ends steps end: mean forces along y and z [N] and mean moment about
    # x at the base [N m], by balance of momentum. Returns the time left undone [s], positive if
    # the insertion depth would leave its range and NaN if the state became non-finite, and the
    # means: undefined with time left, zero loads for (0, 3).
    n = c.modes.modes.shape[1]
    # Few arrays: an allocation takes a sixth of the time of a step.
    grids, rows = np.empty((3, n, n)), np.empty((9, n))
    work = np.empty(c.modes.series.shape[1] + 4 * n)
    at = ModeIntegrals(grids[0], grids[1], rows[0], rows[1], rows[2], rows[3])
    q, z, rates, factor = rows[4], rows[5], rows[8], grids[2]
    for i in range(n):
        q[i], z[i] = state[2 + i], state[4 + n + i]
    mode_integrals(c.modes, c.length - state[0], work, at)
    if not c.as_printed:
        # Momenta p = rho A G q_dot, whose equations have no term of dG/dt.
        for i in range(n):
            z[i] = 0.0
            for j in range(n):
                z[i] += c.linear_density * at.gram[i, j] * state[4 + n + j]
    sensed = loads.shape[0] > 0
    parts = loads.shape[0] if sensed else 1
    motion = _Motion(c.length - state[0], -state[2 + n], 0.0)
    sums = Sums(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
    gain = (inputs.velocity - motion.velocity) / duration
    span, left, later = duration / parts, 0.0, 0.0
    if sensed:
        border = _border(c, at, z, factor, rates, motion, sums)
    for part in range(parts):
        later = (parts - 1 - part) * span
        motion, sums, left = _steps(
            c, at, work, rows[4:], inputs, gain, motion, sums, span, time + duration, later,
            longest, graded,
        )  # fmt: skip
        mode_integrals(c.modes, motion.depth, work, at)
        if left > 0.0:
            break
        if sensed:
            now = _border(c, at, z, factor, rates, motion, sums)
            _write_loads(c, inputs, border, now, span, loads[part])
            border = now
    left += later
    done = duration - left
    turn = 2.0 * inputs.torque / c.rotary_inertia
    turned = (state[3 + n] + 0.5 * turn * done) * done
    state[0] = c.length - motion.depth
    state[1] += turned
    state[2 + n] = -motion.velocity
    state[3 + n] += turn * done
    _rates(c, at, z, factor, rates)
    for i in range(n):
        state[2 + i], state[4 + n + i] = q[i], rates[i]
    input_work = sums.input_work + inputs.torque * turned
    size = abs(input_work)
    for value in state:
        size += abs(value)
    for value in sums:
        size += abs(value)
    means = _means(sums, input_work, duration, loads)
    return (left if size < inf else nan), means


@kernel
def advance_boxed(
    boxed: Boxed[CompiledNeedle],
    state: Vector,
    time: float,
    inputs: Inputs,
    longest: float,
    graded: bool,
    duration: float,
    loads: Matrix,
) -> tuple[float, Interval]:
    """Call `advance` without a conversion of the constants."""
    return advance(boxed.value, state, time, inputs, longest, graded, duration, loads)
