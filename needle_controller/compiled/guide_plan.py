# SPDX-License-Identifier: Apache-2.0
"""Reachable set of the tip, and the next position of the guide."""

from __future__ import annotations

from math import cos, erf, inf, pi, sin, sqrt, tau
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_controller.compiled.hypotheses import (
    BEVEL,
    constant_mean,
    constants,
    guide_ahead,
    HARD,
    layered_shift,
    LONG,
    Steering,
    STEP,
    times,
    tip_distribution,
    tip_form,
    tip_mean,
    TURNS,
    weights,
)
from needle_dynamics.arrays import ComplexArray, ComplexVector, FloatArray, Vector
from needle_dynamics.compiled.cache import compiled, inlined, kernel
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

USED: Final = 0.8  #: Fraction of the later guide motion that the plan uses.

#: Candidate positions of the guide, relative to its range.
_FINE: Final = np.linspace(-1.0, 1.0, 121)

#: Number of candidate bevel directions, and candidate guide positions for each direction.
_ROLLS: Final = 16
_COARSE: Final = np.linspace(-1.0, 1.0, 13)

_TURN: Final = 1e-4**2  #: Least decrease of the mean square distance by a turn [m^2].
_OVERLOAD: Final = 1.0  #: Cost of a load above its limit [m^2/N^2]: dominates every distance.

_LEAST_VARIANCE: Final = 1e-9**2  #: Least variance of a tip in the plan [m^2].

#: Abscissas and weights of the quadrature over a normal distribution.
_ABSCISSAS: Final = np.array([-(3.0**0.5), 0.0, 3.0**0.5])
_WEIGHTS: Final = np.array([1.0, 4.0, 1.0]) / 6.0

#: Cost of the distance from the setpoint that follows the line to the target, and of its motion
#: [shift of the tip per shift of the guide, squared].
_DEVIATION, _MOTION = 1e-3, 2.5e-3

#: Weight of the expected squared deviation from a planned path, relative to the squared miss.
PATH: Final = 10.0

#: Depths over which the tip is brought to the line, variance of the response of a hypothesis
#: relative to its square, and least weight of a hypothesis in the plan.
_AHEAD, _DOUBT, _LEAST_WEIGHT = 4, 0.05, 1e-4

HIT: Final = 1e-3  #: Distance from the target that counts as a hit [m].


class FinalTip(NamedTuple):
    """Final position of the tip by hypothesis, without further guide motion."""

    means: ComplexVector  #: mean, x + i z [m], shape (h,)
    errors: Vector  #: standard deviation along each axis [m], shape (h,)
    turned: Vector  #: radius of the circle in which later turns move the tip [m], shape (h,)


@compiled
def _ends(c: Steering, w: FloatArray, turns: int, first: int) -> FinalTip:
    """Return the final position of the tip with ``turns`` turns from step ``first`` on."""
    r, last = c.responses, len(c.guide)
    # Future positions of the guide are 0.
    tip = tip_distribution(c, tip_form(c, w, 0.0, last, c.guide))
    means, turned = tip.means, np.zeros(len(tip.means))
    if turns > 0:
        for i in range(len(means)):
            g, load = i % len(r.bevel), constant_mean(c, i, BEVEL)
            for j in range(first, last + 1):
                means[i] -= load * r.bevel[g, last, j] * c.turned[g, j]
            turned[i] = abs(load) * r.later_bevel[g, first]
    errors = np.empty(len(means))
    for i in range(len(means)):
        # Rounding may exceed a variance near 0.
        errors[i] = sqrt(max(tip.variances[i], _LEAST_VARIANCE))
    return FinalTip(means, errors, turned)


@inlined
def _guide_now(c: Steering) -> complex:
    """Return the present position of the guide [m]."""
    k = c.counts[STEP]
    return c.guide[k - 1] if 0 < k <= len(c.guide) else 0j


@inlined
def _guide_range(c: Steering, begin: float, step: int) -> tuple[float, float]:
    """Return middle and half width of the range of the guide ``step`` + 1 steps later [m]."""
    low, high = max(begin - c.ranges[step], -c.limit), min(begin + c.ranges[step], c.limit)
    return 0.5 * (low + high), 0.5 * (high - low)


@compiled
def _reachable(c: Steering, w: FloatArray) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    r, k, last, now = c.responses, c.counts[STEP], len(c.guide), _guide_now(c)
    points = len(r.guide)
    shifts, reach = np.zeros(points, np.complex128), np.zeros(points, np.complex128)
    for j in range(k, last):
        (x, wide), (z, high) = _guide_range(c, now.real, j - k), _guide_range(c, now.imag, j - k)
        for g in range(points):
            shifts[g] += times(r.guide[g, last, j], complex(x, z))
            reach[g] += times(abs(r.guide[g, last, j]), complex(wide, high))
    ends = _ends(c, w, c.counts[TURNS], k + 1)
    middles, sizes = ends.means, np.empty(len(ends.means), np.complex128)
    for i in range(len(sizes)):
        middles[i] += shifts[i % points]
        # The square with the area of the circle.
        turned = 0.5 * sqrt(pi) * ends.turned[i]
        sizes[i] = reach[i % points] + complex(turned, turned)
    return middles, sizes, ends.errors


@kernel
def reachable_set(boxed: Boxed[Steering]) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return middle, half widths, x + i z, and error of the reachable set [m], shape (h,)."""
    return _reachable(boxed.value, weights(boxed.value.logs))


@inlined
def _within(mean: float, deviation: float, size: float) -> float:
    """Return the probability that a normal variable is between -``size`` and ``size``."""
    scale = sqrt(0.5) / deviation
    return 0.5 * (erf(scale * (size - mean)) + erf(scale * (size + mean)))


@kernel
def hit_probability(boxed: Boxed[Steering]) -> float:
    """Return the probability that the tip can reach the target within 1 mm."""
    c, w, found = boxed.value, weights(boxed.value.logs), 0.0
    middles, sizes, errors = _reachable(c, w)
    for i in range(len(w)):
        if w[i] == 0.0:
            continue
        x = _within(c.target[0] - middles[i].real, errors[i], HIT + sizes[i].real)
        z = _within(c.target[1] - middles[i].imag, errors[i], HIT + sizes[i].imag)
        # The planes are independent in a hypothesis only.
        found += w[i] * x * z
    return found


@kernel
def choose_guide(boxed: Boxed[Steering]) -> complex:
    """Return the next position of the guide, x + i z [m], and turn the needle if worthwhile."""
    c = boxed.value
    k, last, w = c.counts[STEP], len(c.guide), weights(c.logs)
    turns, candidates = c.counts[TURNS], _candidates(c, _FINE)
    ends = _ends(c, w, turns, k + 2)
    cost, guide = _best(c, w, ends, candidates)
    if turns == 0 or cost < _TURN:
        return guide
    # The present plan with a turn now.
    base, few = ends if turns > 1 else _ends(c, w, 0, k + 2), _candidates(c, _COARSE)
    best, roll, chosen = inf, 0.0, base
    for turn in range(1 - _ROLLS // 2, _ROLLS // 2 + 1):
        other = c.roll[-1] + tau * turn / _ROLLS
        means = base.means.copy()
        for i in range(len(means)):
            g, push = i % len(c.turned), 0.0
            for j in range(k + 1, k + 2 if turns > 1 else last + 1):
                push += c.responses.bevel[g, last, j]
            change = _direction(_tip_roll(c, g, other)) - c.turned[g, k + 1]
            means[i] += constant_mean(c, i, BEVEL) * push * change
        ends = FinalTip(means, base.errors, base.turned)
        costs = _costs(c, w, ends, few)
        along_x = along_z = inf
        for t in range(costs.shape[1]):
            along_x, along_z = min(along_x, costs[0, t]), min(along_z, costs[1, t])
        found = along_x + along_z
        if found < best:
            best, roll, chosen = found, other, ends
    if best + _TURN > cost:
        return guide
    for g in range(len(c.turned)):
        c.roll[g] = _tip_roll(c, g, roll)
        c.turned[g, k + 1 :] = _direction(c.roll[g])
    c.roll[-1], c.counts[TURNS] = roll, turns - 1
    return _best(c, w, chosen, candidates)[1]


@inlined
def _tip_roll(c: Steering, g: int, base: float) -> float:
    """Return the roll of the tip at a point of the grid for a roll of the base [rad]."""
    lag = c.responses.lags[g, c.counts[STEP]]
    return float(min(max(c.roll[g], base - lag), base + lag))


@inlined
def _direction(roll: float) -> complex:
    return complex(cos(roll), -sin(roll))


@inlined
def _candidates(c: Steering, parts: FloatArray) -> FloatArray:
    """Return candidate positions of the guide in x and z [m], shape (2, positions)."""
    if c.limit == 0.0:
        return np.zeros((2, 1))
    now, found = _guide_now(c), np.empty((2, len(parts)))
    for plane in range(2):
        middle, half = _guide_range(c, now.imag if plane else now.real, 0)
        for t in range(len(parts)):
            found[plane, t] = middle + half * parts[t]
    return found


@compiled
def _best(
    c: Steering, w: FloatArray, ends: FinalTip, candidates: FloatArray
) -> tuple[float, complex]:
    """Return mean square distance from the reachable set and position of the best candidate."""
    costs, whole, found = _costs(c, w, ends, candidates), 0.0, np.empty(2)
    follow, gain = _follow(c, w) if c.limit > 0.0 else (0j, 0.0)
    deviation = _DEVIATION + c.following * gain
    for plane in range(2):
        wanted = follow.imag if plane else follow.real
        wanted, best = min(max(wanted, -c.limit), c.limit), inf
        for t in range(candidates.shape[1]):
            cost = costs[plane, t] + deviation * (candidates[plane, t] - wanted) ** 2
            if cost < best:
                best, at = cost, t
        whole += costs[plane, at]
        # Between the candidates.
        low, high = max(at - 1, 0), min(at + 1, candidates.shape[1] - 1)
        low, high = candidates[plane, low], candidates[plane, high]
        here = candidates[plane, at]
        found[plane] = min(max(wanted, 0.5 * (low + here)), 0.5 * (here + high))
    return whole, complex(found[0], found[1])


@compiled
def _costs(c: Steering, w: FloatArray, ends: FinalTip, candidates: FloatArray) -> FloatArray:
    """Return the mean square distance from the reachable set by candidate, in x and z [m^2]."""
    r, k, last = c.responses, c.counts[STEP], len(c.guide)
    # Later positions that depend on the next position; the others are only limited.
    near = 0
    while near < last - k - 1 and c.ranges[near] < 2.0 * c.limit:
        near += 1
    count = candidates.shape[1]
    middles, halves = np.empty((near, count)), np.empty((near, count))
    left, later, found = np.empty(count), np.empty(count), np.zeros((2, count))
    load, stiffness = _guide_load(c, w)
    for plane in range(2):
        to = candidates[plane]
        for j in range(near):
            for t in range(count):
                middles[j, t], halves[j, t] = _guide_range(c, to[t], j)
        for i in np.flatnonzero(w >= _LEAST_WEIGHT):
            mean, g = ends.means[i].imag if plane else ends.means[i].real, i % len(r.guide)
            need = c.target[plane] - mean
            shift, anywhere = r.guide[g, last, k], c.limit * r.later_guide[g, k + 1 + near]
            for t in range(count):
                left[t] = need - shift * to[t]
                later[t] = USED * (anywhere + sqrt(0.5) * ends.turned[i])
            for j in range(near):
                shift = r.guide[g, last, k + 1 + j]
                for t in range(count):
                    left[t] -= shift * middles[j, t]
                    later[t] += USED * abs(shift) * halves[j, t]
            for a in range(len(_WEIGHTS)):
                off, weight = ends.errors[i] * _ABSCISSAS[a], w[i] * _WEIGHTS[a]
                for t in range(count):
                    short = max(0.0, abs(left[t] + off) - later[t])
                    found[plane, t] += weight * short * short
        force = load.imag if plane else load.real
        over = np.maximum(0.0, np.abs(force + stiffness * to) - c.load_limit)
        found[plane] += _OVERLOAD * over**2
    return found


@compiled
def _guide_load(c: Steering, w: FloatArray) -> tuple[complex, float]:
    """Return the load on a guide at zero [N], and its derivative by the position [N/m]."""
    r, k, force, stiffness = c.responses, c.counts[STEP], 0j, 0.0
    if c.load_limit == inf:
        return force, stiffness
    for i in range(len(w)):
        load, g = c.mean[i, len(c.path) + constants(c) + k], i % len(r.guide_load)
        for j in range(k):
            load += r.guide_load[g, k, j] * c.guide[j]
        push = 0j
        for j in range(c.turned.shape[1]):
            push += r.bevel_load[g, k, j] * c.turned[g, j]
        load += push * constant_mean(c, i, BEVEL)
        force += w[i] * load
        stiffness += w[i] * r.guide_load[g, k, k]
    return force, stiffness


@compiled
def _follow(c: Steering, w: FloatArray) -> tuple[complex, float]:
    """Return the setpoint that brings the tip to its path over the next steps, and its gain."""
    r, k, last, guide = c.responses, c.counts[STEP], len(c.guide), guide_ahead(c)
    need, gain, used = 0j, _MOTION, np.flatnonzero(w > _LEAST_WEIGHT)
    moved = complex(c.target[0], c.target[1]) - c.waypoints[last]
    for at in range(k + 1, min(k + _AHEAD, last) + 1):
        form = tip_form(c, w, _LEAST_WEIGHT, at, guide)
        line = c.waypoints[at] + c.path[at] * moved
        for one in used:
            i = int(one)
            g, shift = i % len(r.guide), 0.0
            long, hard = constant_mean(c, i, LONG).real, constant_mean(c, i, HARD).real
            for j in range(k, at):
                shift += r.guide[g, at, j]
                shift += long * r.between[0, g, at, j] + hard * r.between[1, g, at, j]
                shift += layered_shift(c, i, at, j)
            need += w[i] * shift * (line - tip_mean(c, i, form))
            gain += w[i] * (1.0 + _DOUBT) * shift**2
    return guide[k] + need / gain, gain
