# SPDX-License-Identifier: Apache-2.0
"""
Filter of the observer: history, step of one sample, and estimate at the present depth.

Over one sample the depth is frozen at its mean. A late measurement is processed at its time.
"""

from __future__ import annotations

from math import exp, inf, pi, sqrt
from typing import Annotated, Final, NamedTuple, TYPE_CHECKING

from needle_controller.compiled.bending import (
    base_impulse,
    change_basis,
    freeze,
    Frozen,
    tip_response,
    turn,
)
from needle_controller.compiled.kalman import add_to_mean, clear_mean, measure, propagate
from needle_dynamics.arrays import Array3, FloatArray, Matrix, Shaped, Vector
from needle_dynamics.compiled.cache import compiled, inlined, kernel
from needle_dynamics.compiled.matrices import copy
from needle_dynamics.compiled.normal_modes import coupling, empty_normal_modes, NormalModes
from needle_dynamics.compiled.step import CompiledNeedle
from needle_dynamics.compiled.tissue import growth_at
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Scalars of each sample: its time and length [s], mean insertion depth [m], stiffness factor of
#: swelling, readings of the wrench [N, N m], and sum and number of the squared normalized
#: innovations.
SAMPLE = np.dtype(
    [
        (name, float)
        for name in ('time', 'span', 'depth', 'growth', 'lateral', 'moment', 'nis', 'degrees')
    ]
)


class LowPass(NamedTuple):
    """Low-pass of a channel of the wrench with f entries: its memory and its reading."""

    ticks: int  #: samples of the force sensor in a sample of the filter
    transition: Matrix  #: transition over a sample of the filter, shape (f, f)
    noise: Array3  #: covariance of the noise over a sample, for force and moment, shape (2, f, f)
    response: Matrix  #: response to a unit input after a number of ticks, shape (ticks, f)
    steady: Vector  #: steady response to a constant unit input, shape (f,)


#: Entries of the state after c and b of the modes: lateral force at the tip [N], and the offsets
#: of the measured lateral force [N] and moment [N m]. They vary slowly and drive the rest.
LOADS: Final = 3


class Noise(NamedTuple):
    """Noise model of the filter."""

    force: float  #: spectral density of the distributed lateral force [N^2 s/m]
    prior: float  #: variance of the tip deflection at the start [m^2]
    tip: float  #: variance of a sample of the tip deflection [m^2]
    #: Variances of the readings of lateral force [N^2] and moment [N^2 m^2], behind the low-pass.
    reading: tuple[float, float]
    wrench: tuple[float, float]  #: variances of their white noise before the low-pass
    #: Variances of the `LOADS`, and their decorrelation rates [1/s].
    loads: tuple[float, float, float]
    rates: tuple[float, float, float]


class Filter(NamedTuple):
    """Filter and its history: arrays with one row per stored sample."""

    needle: CompiledNeedle
    noise: Noise
    low_pass: LowPass
    samples: Annotated[NDArray[np.void], Shaped(SAMPLE, 1)]  #: shape (slots,)
    states: Matrix  #: state after the sample, see `kalman`, shape (slots, N)
    #: Its covariance, and the transition over the sample, shape (slots, N, N).
    covariances: Array3
    transitions: Array3
    #: Normal modes at the mean depth, as in `NormalModes`, shape (slots, n, n).
    shapes: Array3
    inverses: Array3
    #: Squares of their frequencies, and their values at the tip, shape (slots, n).
    squares: Matrix
    tips: Matrix
    changes: Array3  #: change of basis from the previous sample, shape (slots, 2 n, 2 n)
    exposures: Matrix  #: start and end [s] and mean [m] of the tip deflection, shape (m, 3)


@inlined
def _modes(f: Filter, slot: int) -> NormalModes:
    return NormalModes(f.shapes[slot], f.inverses[slot], f.squares[slot])


@inlined
def _growth(needle: CompiledNeedle, time: float) -> float:
    return growth_at(needle.swelling, needle.swelling_time, max(time, 0.0))


@kernel
def begin(boxed: Boxed[Filter], slot: int, time: float, span: float, depth: float) -> None:
    """
    Write the prior state at a time [s] and insertion depth [m] into a slot.

    All c and b have the same variance, such that the tip has its prior variance. The prior of the
    low-pass memory is a constant and a white wrench of the size that such a needle exerts.
    """
    f = boxed.value
    needle, low_pass = f.needle, f.low_pass
    n, filters = f.squares.shape[1], low_pass.steady.shape[0]
    frozen = freeze(needle, depth, _growth(needle, time), _modes(f, slot))
    impulse = np.empty((2, 2 * n))
    base_impulse(needle, frozen, 0.0, impulse)
    share = 0.0
    for k in range(n):
        tip = 0.0
        for i in range(n):
            tip += frozen.at.value[i] * frozen.modes.shapes[i, k]
        share += tip * tip / frozen.modes.squares[k]
    variance = f.noise.prior / share
    sample = f.samples[slot]
    sample['time'], sample['span'] = time, span
    sample['depth'], sample['growth'] = depth, frozen.growth
    sample['nis'] = sample['degrees'] = 0.0
    f.states[slot] = 0.0
    covariance = f.covariances[slot]
    covariance[:] = 0.0
    for i in range(2 * n):
        covariance[i, i] = variance
    tick, rate = span / low_pass.ticks, needle.tissue_damping / needle.linear_density
    for channel in range(2):
        reaction = 0.0
        for k in range(n):
            by_c, by_b = _over(rate, frozen.modes.squares[k], impulse[channel], k, tick)
            reaction += by_c * by_c + by_b * by_b
        reaction *= variance
        first = 2 * n + LOADS + channel * filters
        for i in range(filters):
            covariance[first + i, first + i] += f.noise.wrench[channel] + reaction
            for j in range(filters):
                steady = low_pass.steady[i] * low_pass.steady[j]
                covariance[first + i, first + j] += reaction * steady
    # Covariance of the loads with the memory of the low-pass, and between its channels.
    arms = (-1.0, -needle.length)
    for load in range(LOADS):
        covariance[2 * n + load, 2 * n + load] = f.noise.loads[load]
    for entry in range(2 * filters):
        one, i = entry // filters, 2 * n + LOADS + entry
        by_tip = arms[one] * low_pass.steady[entry % filters] * f.noise.loads[0]
        by_offset = low_pass.steady[entry % filters] * f.noise.loads[1 + one]
        covariance[i, 2 * n] = covariance[2 * n, i] = by_tip
        covariance[i, 2 * n + 1 + one] = covariance[2 * n + 1 + one, i] = by_offset
        for other in range(2 * filters):
            two, j = other // filters, 2 * n + LOADS + other
            steady = low_pass.steady[other % filters]
            covariance[i, j] += by_tip * arms[two] * steady
            if one == two:
                covariance[i, j] += by_offset * steady


@inlined
def _over(
    rate: float, square: float, impulse: FloatArray, k: int, tick: float
) -> tuple[float, float]:
    """Return the mean force over the next tick per c and b of a mode."""
    cc, cb, bc, bb = turn(rate, square, tick)
    c, b = impulse[k] / tick, impulse[impulse.shape[0] // 2 + k] / tick
    return c * (cc - 1.0) + b * bc, c * cb + b * (bb - 1.0)


@inlined
def _write_transition(  # noqa: C901
    f: Filter, frozen: Frozen, change: FloatArray, span: float, velocity: float, out: FloatArray
) -> None:
    """Compute the transition over a sample: change of basis, then modes and low-pass."""
    needle, low_pass = f.needle, f.low_pass
    n, filters, ticks = f.squares.shape[1], low_pass.steady.shape[0], low_pass.ticks
    modal, tick, rate = 2 * n, span / ticks, needle.tissue_damping / needle.linear_density
    impulse, drive = np.empty((2, modal)), np.zeros((2 * filters, modal))
    base_impulse(needle, frozen, velocity, impulse)
    rest, direct = np.empty(n), np.empty(2)
    tip_response(needle, frozen, rest, direct)
    out[:] = 0.0
    for load in range(LOADS):
        out[modal + load, modal + load] = exp(-span * f.noise.rates[load])
    for k in range(n):
        square = frozen.modes.squares[k]
        cc, cb, bc, bb = turn(rate, square, span)
        for j in range(modal):
            out[k, j] = cc * change[k, j] + cb * change[n + k, j]
            out[n + k, j] = bc * change[k, j] + bb * change[n + k, j]
        # Under a force at the tip the mode rotates about its equilibrium.
        out[k, modal], out[n + k, modal] = (1.0 - cc) * rest[k], -bc * rest[k]
        cc, cb, bc, bb = turn(rate, square, tick)
        for channel in range(2):
            by_c, by_b = _over(rate, square, impulse[channel], k, tick)
            for count in range(ticks):
                for i in range(filters):
                    left = low_pass.response[ticks - 1 - count, i]
                    drive[channel * filters + i, k] += left * by_c
                    drive[channel * filters + i, n + k] += left * by_b
                by_c, by_b = by_c * cc + by_b * bc, by_c * cb + by_b * bb
    for channel in range(2):
        first = modal + LOADS + channel * filters
        for i in range(filters):
            constant = 0.0
            for count in range(ticks):
                constant += low_pass.response[count, i]
            out[first + i, modal] = direct[channel] * constant
            out[first + i, modal + 1 + channel] = constant
            for k in range(n):
                out[first + i, modal] -= rest[k] * drive[channel * filters + i, k]
            for k in range(modal):
                part = drive[channel * filters + i, k]
                for j in range(modal):
                    out[first + i, j] += part * change[k, j]
            for j in range(filters):
                out[first + i, first + j] = low_pass.transition[i, j]


@inlined
def _expose(
    f: Filter,
    slot: int,
    start: float,
    end: float,
    exposure: float,
    x: FloatArray,
    covariance: FloatArray,
    work: FloatArray,
) -> None:
    """Add a part of a sample, with times from its start [s], to the running mean of the tip."""
    n = f.squares.shape[1]
    change, fresh, row = f.changes[slot], work[0], work[1, : 2 * n + 1]
    by_force = 0.0
    rate = f.needle.tissue_damping / f.needle.linear_density
    for k in range(n):
        square = f.squares[slot, k]
        omega = sqrt(square)
        c1, c2, c3, c4 = turn(rate, square, start)
        e1, e2, e3, e4 = turn(rate, square, end)
        # Integral of c over the time, from the change of the state over it.
        share = -f.tips[slot, k] / (square * exposure)
        fresh[k] = share * (e3 - c3 + rate / omega * (e1 - c1))
        fresh[n + k] = share * (e4 - c4 + rate / omega * (e2 - c2))
        rest = f.tips[slot, k] / omega
        by_force += rest * (rest * (end - start) / exposure - fresh[k])
    row[2 * n] = by_force
    for k in range(2 * n):
        row[k] = 0.0
        for i in range(2 * n):
            row[k] += fresh[i] * change[i, k]
    add_to_mean(x, covariance, row, work[2])


@compiled
def _advance(f: Filter, count: int, old: int, new: int) -> None:  # noqa: C901
    """Compute the slot ``new`` from the slot ``old`` with the measurements in between."""
    n, filters, size = f.squares.shape[1], f.low_pass.steady.shape[0], f.states.shape[1]
    modal, last = 2 * n, size - 1
    drivers = modal + LOADS
    work = np.empty((size + 2, size))
    x, covariance = f.states[new], f.covariances[new]
    copy(f.covariances[old], covariance)
    for i in range(size):
        x[i] = f.states[old, i]
    sample = f.samples[new]
    t0, t1, span = f.samples[old]['time'], sample['time'], sample['span']
    # White noise of the sample, half at each end: trapezoidal rule.
    kick = 0.5 * span * f.noise.force / f.needle.linear_density
    for k in range(n, modal):
        covariance[k, k] += kick
    for load in range(LOADS):
        kept = exp(-2.0 * span * f.noise.rates[load])
        covariance[modal + load, modal + load] += (1.0 - kept) * f.noise.loads[load]
    nis, degrees = 0.0, 0.0
    for w in range(count):
        start, end, value = f.exposures[w]
        if end <= t0:
            continue
        if start >= t1:
            break
        if start >= t0:
            clear_mean(x, covariance)
        # Spans of irregular stamps are stretched to whole periods.
        stretch = span / (t1 - t0)
        since, until = max(start - t0, 0.0) * stretch, min(end - t0, t1 - t0) * stretch
        _expose(f, new, since, until, (end - start) * stretch, x, covariance, work)
        if end <= t1:
            nis += measure(x, covariance, last, value, f.noise.tip, size, work)
            degrees += 1.0
            clear_mean(x, covariance)
    used = size if covariance[last, last] > 0.0 else last
    propagate(x, covariance, f.transitions[new], drivers, filters, used, work)
    readings = (sample['lateral'], sample['moment'])
    for channel in range(2):
        first = drivers + channel * filters
        for i in range(filters):
            for j in range(filters):
                covariance[first + i, first + j] += f.low_pass.noise[channel, i, j]
    for channel in range(2):
        reading, variance = readings[channel], f.noise.reading[channel]
        # A missing reading is NaN.
        if reading == reading:
            index = drivers + (channel + 1) * filters - 1
            nis += measure(x, covariance, index, reading, variance, used, work)
            degrees += 1.0
    for k in range(n, modal):
        covariance[k, k] += kick
    sample['nis'], sample['degrees'] = nis, degrees


@kernel
def observe(
    boxed: Boxed[Filter],
    count: int,
    old: int,
    new: int,
    time: float,
    span: float,
    before: float,
    depth: float,
    rate: float,
    velocity: float,
    lateral: float,
    moment: float,
) -> float:
    """
    Process one sample into the slot ``new``, after the slot ``old``; return the load [N].

    ``count`` is the number of valid exposures. Over the sample the insertion depth changes from
    ``before`` to ``depth`` [m], with velocities ``rate`` and ``velocity`` [m/s]. ``lateral`` [N]
    and ``moment`` [N m] are the readings of the wrench, NaN if missing.
    """
    # Mean of the cubic through both ends, limited to their range.
    mean = before + 0.5 * (depth - before) + span * (rate - velocity) / 12.0
    end, depth = depth, min(max(mean, min(before, depth)), max(before, depth))
    velocity = 0.5 * (rate + velocity)
    f = boxed.value
    n = f.squares.shape[1]
    last, sample, change = f.samples[old], f.samples[new], f.changes[new]
    growth = _growth(f.needle, time)
    sample['time'], sample['span'] = time, span
    sample['depth'], sample['growth'] = depth, growth
    sample['lateral'], sample['moment'] = lateral, moment
    frozen = freeze(f.needle, depth, growth, _modes(f, new))
    change_basis(_modes(f, old), frozen.modes, -0.5 * span, 0.5 * span, change)
    if depth == last['depth'] and growth == last['growth']:
        # No accumulation of rounding while the needle rests.
        for i in range(2 * n):
            for k in range(2 * n):
                change[i, k] = 1.0 if i == k else 0.0
    for k in range(n):
        f.tips[new, k] = 0.0
        for i in range(n):
            f.tips[new, k] += frozen.at.value[i] * frozen.modes.shapes[i, k]
    _write_transition(f, frozen, change, span, velocity, f.transitions[new])
    _advance(f, count, old, new)
    further, now = np.empty((2 * n, 2 * n)), np.empty(2 * n)
    return _load(f.needle, _present(f, new, end, further, now), now, span)


@kernel
def expose(
    boxed: Boxed[Filter],
    count: int,
    oldest: int,
    newest: int,
    start: float,
    end: float,
    slack: float,
    deflection: float,
) -> int:
    """
    Insert the exposure of a tip sample [s], repeat the later steps, and return the new ``count``.

    An overlap with others or the time before the history is cut off; -1 if it exceeds ``slack``.
    """
    f = boxed.value
    exposures, first, place = f.exposures, f.samples[oldest]['time'], count
    while place > 0 and exposures[place - 1, 1] > end:
        place -= 1
    floor = max(first, exposures[place - 1, 1]) if place > 0 else first
    ceiling = exposures[place, 0] if place < count else inf
    if start < floor - slack or end > ceiling + slack:
        return -1
    if count == exposures.shape[0]:
        gone = 0
        while gone < count and exposures[gone, 1] <= first:
            gone += 1
        if gone == 0:
            return -1
        for k in range(gone, count):
            exposures[k - gone] = exposures[k]
        count, place = count - gone, max(place - gone, 0)
    for k in range(count, place, -1):
        exposures[k] = exposures[k - 1]
    start = max(start, floor)
    exposures[place, 0], exposures[place, 1] = start, min(end, ceiling)
    exposures[place, 2] = deflection
    _repeat(f, count + 1, oldest, newest, start)
    return count + 1


@kernel
def replay(boxed: Boxed[Filter], count: int, oldest: int, newest: int, since: float) -> None:
    """Recompute the slots later than ``since`` [s], the time of changed measurements."""
    _repeat(boxed.value, count, oldest, newest, since)


@inlined
def _repeat(f: Filter, count: int, oldest: int, newest: int, since: float) -> None:
    slots, slot = f.samples.shape[0], newest
    while slot != oldest and f.samples[slot]['time'] > since:
        slot = slot - 1 if slot > 0 else slots - 1
    while slot != newest:
        following = slot + 1 if slot + 1 < slots else 0
        _advance(f, count, slot, following)
        slot = following


@inlined
def _present(f: Filter, slot: int, depth: float, change: FloatArray, now: FloatArray) -> Frozen:
    """Write c and b of the modes at the present depth, and their derivatives by the slot."""
    n = f.squares.shape[1]
    sample = f.samples[slot]
    frozen = freeze(f.needle, depth, sample['growth'], empty_normal_modes(n))
    change_basis(_modes(f, slot), frozen.modes, -0.5 * sample['span'], 0.0, change)
    for i in range(2 * n):
        now[i] = 0.0
        for k in range(2 * n):
            now[i] += change[i, k] * f.states[slot, k]
    return frozen


@inlined
def _load(needle: CompiledNeedle, frozen: Frozen, now: FloatArray, span: float) -> float:
    """
    Return the force of the bent needle against insertion [N].

    By the modes below half the sample rate: the estimated rates of faster modes are noise, which
    their square would add to the force.
    """
    at, modes = frozen.at, frozen.modes
    n = modes.squares.shape[0]
    bend, tip, rate = 0.0, 0.0, 0.0
    for j in range(n):
        omega = sqrt(modes.squares[j])
        if omega * span < pi:
            for i in range(n):
                bend += at.curvature[i] * modes.shapes[i, j] * now[j] / omega
                tip += at.value[i] * modes.shapes[i, j] * now[j] / omega
                rate += at.value[i] * modes.shapes[i, j] * now[n + j]
    density, stiffness = needle.linear_density, frozen.stiffness
    return coupling(density, needle.bending_stiffness, stiffness, bend, tip, rate)


@kernel
def estimate(
    boxed: Boxed[Filter], slot: int, depth: float, modal: Vector, jacobian: Matrix
) -> tuple[float, float, float]:
    """
    Transform the newest slot to modal coordinates at the present depth, half a sample later.

    ``modal``, shape (2 n,), takes q [m^3/2] and q_dot [m^3/2 / s], ``jacobian``, shape (2 n, 2 n),
    their derivatives by c and b of the slot. Returns the tip deflection and its standard deviation
    [m], and the force of the bent needle against insertion [N].
    """
    f = boxed.value
    needle, covariance = f.needle, f.covariances[slot]
    n = f.squares.shape[1]
    change, now = np.empty((2 * n, 2 * n)), np.empty(2 * n)
    frozen = _present(f, slot, depth, change, now)
    at, modes = frozen.at, frozen.modes
    modal[:] = 0.0
    jacobian[:] = 0.0
    for i in range(n):
        for j in range(n):
            shape, omega = modes.shapes[i, j], sqrt(modes.squares[j])
            modal[i] += shape / omega * now[j]
            modal[n + i] += shape * now[n + j]
            for k in range(2 * n):
                jacobian[i, k] += shape / omega * change[j, k]
                jacobian[n + i, k] += shape * change[n + j, k]
    deflection, variance = 0.0, 0.0
    row = np.zeros(2 * n)
    for i in range(n):
        deflection += at.value[i] * modal[i]
        for k in range(2 * n):
            row[k] += at.value[i] * jacobian[i, k]
    for i in range(2 * n):
        for k in range(2 * n):
            variance += row[i] * covariance[i, k] * row[k]
    load = _load(needle, frozen, now, f.samples[slot]['span'])
    return deflection, sqrt(max(variance, 0.0)), load
