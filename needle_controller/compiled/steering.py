r"""
Measurement update and plan of the steering controller; see `MultiHypothesisLaw`.

By hypothesis the tip at a depth is :math:`z = a \cdot b + x \cdot \theta` with the positions b of
the guide, x + i z, and unknown constants :math:`\theta` with mean :math:`\bar\theta` and
covariance P. Its mean is :math:`a \cdot b + x \cdot \bar\theta`, its covariance with the constants
:math:`s = P \bar x`, and its variance :math:`x \cdot s`; a tip measurement is an update of rank
one.
"""

from __future__ import annotations

from math import cos, exp, inf, isfinite, log, sin, sqrt, tau
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import (
    Array3,
    Array4,
    ComplexArray,
    ComplexArray3,
    ComplexMatrix,
    ComplexVector,
    FloatArray,
    IntVector,
    Matrix,
    Vector,
)
from needle_dynamics.compiled.cache import compiled, inlined, kernel
from needle_dynamics.compiled.matrices import backward, cholesky, forward
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Fraction of the later guide motion that the plan uses.
_COUNTED: Final = 0.8

#: Candidate positions of the guide, relative to its range.
_TRIED: Final = np.linspace(-1.0, 1.0, 121)

#: Number of candidate bevel directions, and candidate guide positions for each direction.
_ROLLS: Final = 16
_COARSE: Final = np.linspace(-1.0, 1.0, 13)

#: Least decrease of the mean square distance from the reachable set by a turn [m^2].
_TURN: Final = 1e-4**2

#: Cost of a load on the guide above its limit [m^2/N^2]: dominates every distance.
_OVERLOAD: Final = 1.0

#: Standard deviation of the relative loss of the bevel load at rest.
_LET_GO: Final = 0.03

#: Index of the bevel load among the constants.
BEVEL: Final = 3

#: Abscissas and weights of the quadrature over a normal distribution.
_ABSCISSAS: Final = np.array([-(3.0**0.5), 0.0, 3.0**0.5])
_WEIGHTS: Final = np.array([1.0, 4.0, 1.0]) / 6.0

#: Cost of the distance from the plan for the mean, and of motion in that plan [shift of the tip
#: per shift of the guide, squared].
_AWAY, _MOTION = 1e-5, 1e-2

#: Gate on the squared innovation over its variance (exceeded by noise once in 3 million tip
#: measurements), and number of successive measurements outside the gate that is a fault.
_IMPOSSIBLE, _MOST_IMPOSSIBLE = 30.0, 2

#: Number of equal successive tip measurements of a moving needle that is a frozen sensor.
MOST_SAME: Final = 2

#: Largest number of successive missing tip measurements.
MOST_MISSING: Final = 6

#: Distance from the target that counts as a hit [m].
_REACHED: Final = 1e-3

#: Indices of `Steering.counts`: tip measurements so far, remaining turns, and successive equal,
#: implausible and missing measurements.
STEP: Final = 0
TURNS: Final = 1
SAME: Final = 2
STRANGE: Final = 3
MISSING: Final = 4

#: Result of the check of a tip measurement.
FINE: Final = 0
LOST: Final = 1
FROZEN: Final = 2
FOREIGN: Final = 3


class HypothesisResponses(NamedTuple):
    """
    Responses of the tip by hypothesis: the arrays of `SteeringModel` with these names, and sums.

    Attributes
    ----------
    guide, causes, bevel, elastic, guide_load, causes_load, bevel_load, between : ndarray
        As in `SteeringModel`.
    later_guide : ndarray, shape (h, n + 1)
        Sums of the absolute values of `guide` at the last depth, from each step on.
    later_bevel : ndarray, shape (h, n + 3)
        Sums of the absolute values of `bevel` at the last depth, from the skin and each step on.

    """

    guide: Array3
    causes: Array3
    bevel: Array3
    elastic: Matrix
    guide_load: Array3
    causes_load: Array3
    bevel_load: Array3
    between: Array4
    later_guide: Matrix
    later_bevel: Matrix


class Steering(NamedTuple):
    """
    State and limits of a steering controller: h hypotheses, n steps and m constants.

    Attributes
    ----------
    responses : HypothesisResponses
        Responses of the tip.
    limit : float
        Largest position of the guide along each axis [m].
    load_limit : float
        Largest planned force of the guide [N].
    ways : ndarray, shape (n,)
        Range of the guide motion after a number of steps, from 1 [m].
    target : ndarray, shape (2,)
        Target of the tip, x and z [m].
    mean : ndarray of complex, shape (h, m)
        Mean of the constants.
    covariance : ndarray of complex, shape (h, m, m)
        Their covariance.
    logs : ndarray, shape (h,)
        Logarithm of the probability of each hypothesis, up to a constant.
    guide : ndarray of complex, shape (n,)
        Position of the guide in each step [m]; 0 in future steps.
    turned : ndarray of complex, shape (n + 1,)
        Direction of the bevel relative to zero roll, on the skin and in each step.
    roll : ndarray, shape (1,)
        Roll of the needle [rad].
    last : ndarray, shape (2,)
        Last tip measurement [m].
    counts : ndarray of int, shape (5,)
        Tip measurements so far, remaining turns, successive equal, implausible and missing
        measurements.

    """

    responses: HypothesisResponses
    limit: float
    load_limit: float
    ways: Vector
    target: Vector
    mean: ComplexMatrix
    covariance: ComplexArray3
    logs: Vector
    guide: ComplexVector
    turned: ComplexVector
    roll: Vector
    last: Vector
    counts: IntVector


class Tip(NamedTuple):
    """
    Distribution of the tip at a depth by hypothesis.

    Attributes
    ----------
    means : ndarray of complex, shape (h,)
        Mean, x + i z [m].
    variances : ndarray, shape (h,)
        Variance along each axis [m^2].
    shared : ndarray of complex, shape (h, m)
        Covariance with the constants.

    """

    means: ComplexVector
    variances: Vector
    shared: ComplexMatrix


class Ends(NamedTuple):
    """
    Final position of the tip by hypothesis, without further guide motion.

    Attributes
    ----------
    means : ndarray of complex, shape (h,)
        Mean, x + i z [m].
    errors : ndarray, shape (h,)
        Standard deviation along each axis [m].
    turned : ndarray, shape (h,)
        Range of the tip along each axis by later turns [m].

    """

    means: ComplexVector
    errors: Vector
    turned: Vector


class Whole(NamedTuple):
    """
    Mean and covariance of the tip over all hypotheses.

    Attributes
    ----------
    x, z : float
        Mean [m].
    xx, xz, zz : float
        Covariance [m^2].

    """

    x: float
    z: float
    xx: float
    xz: float
    zz: float


# Estimation.


@kernel
def weights(logs: Vector) -> FloatArray:
    """Return hypothesis weights, shape (h,), from their logarithms up to a constant."""
    largest, whole, found = -inf, 0.0, np.empty(len(logs))
    for value in logs:
        largest = max(largest, value)
    for i in range(len(logs)):
        found[i] = exp(logs[i] - largest)
        whole += found[i]
    for i in range(len(logs)):
        found[i] /= whole
    return found


@inlined
def _held(c: Steering) -> ComplexArray:
    """Return the positions of the guide, shape (n,), with the guide at rest from now on."""
    guide, done = c.guide.copy(), min(c.counts[STEP], len(c.guide))
    if done > 0:
        for j in range(done, len(guide)):
            guide[j] = guide[done - 1]
    return guide


@compiled
def _tip(c: Steering, at: int, guide: ComplexArray) -> Tip:
    """Return the distribution of the tip at a depth by hypothesis."""
    r = c.responses
    h, m = c.mean.shape
    means, variances = np.zeros(h, np.complex128), np.zeros(h)
    shared, row = np.zeros((h, m), np.complex128), np.empty(m, np.complex128)
    for i in range(h):
        for j in range(m - 2):
            row[j] = r.causes[i, at, j]
        row[BEVEL] = row[m - 2] = row[m - 1] = 0.0
        for j in range(len(c.turned)):
            row[BEVEL] += r.bevel[i, at, j] * c.turned[j]
        for j in range(len(guide)):
            means[i] += r.guide[i, at, j] * guide[j]
            row[m - 2] += r.between[0, i, at, j] * guide[j]
            row[m - 1] += r.between[1, i, at, j] * guide[j]
        of = shared[i]
        for j in range(m):
            means[i] += c.mean[i, j] * row[j]
            # P is Hermitian: its rows are its conjugated columns.
            for l in range(m):
                of[l] += row[j] * c.covariance[i, j, l]
        for j in range(m):
            variances[i] += of[j].real * row[j].real + of[j].imag * row[j].imag
            of[j] = of[j].conjugate()
        variances[i] += (_LET_GO * r.elastic[i, at] * abs(c.mean[i, BEVEL])) ** 2
    return Tip(means, variances, shared)


@compiled
def _whole(w: FloatArray, tip: Tip) -> Whole:
    """Return mean and covariance of the tip over all hypotheses."""
    x = z = xx = xz = zz = 0.0
    for i in range(len(w)):
        x += w[i] * tip.means[i].real
        z += w[i] * tip.means[i].imag
    for i in range(len(w)):
        dx, dz = tip.means[i].real - x, tip.means[i].imag - z
        xx += w[i] * (dx * dx + tip.variances[i])
        xz += w[i] * dx * dz
        zz += w[i] * (dz * dz + tip.variances[i])
    return Whole(x, z, xx, xz, zz)


@kernel
def expect(held: Boxed[Steering], at: int) -> Whole:
    """Predict the tip at depth number ``at`` with guide and roll as last commanded."""
    c = held.value
    return _whole(weights(c.logs), _tip(c, at, _held(c)))


@kernel
def see(
    held: Boxed[Steering], at: int, x: float, z: float, variance: float
) -> tuple[int, float, float]:
    """
    Update hypotheses and weights with a tip measurement (x, z) [m] at depth number ``at``.

    ``x`` and ``z`` are nan if the measurement is missing; ``variance`` is per axis [m^2]. Returns
    `FINE` or the reason for a stop, and the innovation along both axes [m].
    """
    c = held.value
    tip, w = _tip(c, at, _held(c)), weights(c.logs)
    there = _whole(w, tip)
    off_x, off_z = x - there.x, z - there.z
    kind, counts = _judge(c, x, z, off_x, off_z, there, variance)
    if counts:
        for i in range(len(w)):
            _learn(c, i, complex(x, z) - tip.means[i], tip.variances[i] + variance, tip.shared[i])
    return kind, off_x, off_z


@inlined
def _judge(
    c: Steering, x: float, z: float, off_x: float, off_z: float, there: Whole, variance: float
) -> tuple[int, bool]:
    """Check a tip measurement; return its kind and whether the update uses it."""
    counts = c.counts
    if not (isfinite(x) and isfinite(z)):
        counts[MISSING] += 1
        return (LOST if counts[MISSING] > MOST_MISSING else FINE), False
    counts[MISSING] = 0
    same = x == c.last[0] and z == c.last[1]
    counts[SAME] = counts[SAME] + 1 if same else 0
    c.last[0], c.last[1] = x, z
    if same:
        return (FROZEN if counts[SAME] >= MOST_SAME else FINE), False
    xx, xz, zz = there.xx + variance, there.xz, there.zz + variance
    distance = zz * off_x**2 - 2.0 * xz * off_x * off_z + xx * off_z**2
    # False for an infinite distance and for nan.
    if distance <= _IMPOSSIBLE * (xx * zz - xz**2):
        counts[STRANGE] = 0
        return FINE, True
    counts[STRANGE] += 1
    return (FOREIGN if counts[STRANGE] >= _MOST_IMPOSSIBLE else FINE), False


@inlined
def _learn(c: Steering, i: int, off: complex, variance: float, shared: ComplexArray) -> None:
    """Update a hypothesis and its weight with the innovation of a tip measurement [m]."""
    for j in range(len(shared)):
        gain = shared[j] / variance
        c.mean[i, j] += gain * off
        to = c.covariance[i, j]
        for k in range(len(shared)):
            to[k] -= gain * shared[k].conjugate()
    c.logs[i] -= 0.5 * (off.real**2 + off.imag**2) / variance + log(variance)


# Reachable set.


@compiled
def _ends(c: Steering, turns: int, first: int) -> Ends:
    """Return the final position of the tip with ``turns`` turns from step ``first`` on."""
    r, last = c.responses, len(c.guide)
    # Future positions of the guide are 0.
    tip = _tip(c, last, c.guide)
    means, turned = tip.means, np.zeros(len(tip.means))
    if turns > 0:
        for i in range(len(means)):
            load = c.mean[i, BEVEL]
            for j in range(first, last + 1):
                means[i] -= load * r.bevel[i, last, j] * c.turned[j]
            turned[i] = _COUNTED * sqrt(0.5) * abs(load) * r.later_bevel[i, first]
    errors = np.empty(len(means))
    for i in range(len(means)):
        errors[i] = sqrt(tip.variances[i])
    return Ends(means, errors, turned)


@inlined
def _there(c: Steering) -> complex:
    """Return the present position of the guide [m]."""
    k = c.counts[STEP]
    return c.guide[k - 1] if 0 < k <= len(c.guide) else 0j


@inlined
def _room(c: Steering, begin: float, step: int) -> tuple[float, float]:
    """Return middle and half width of the range of the guide ``step`` + 1 steps later [m]."""
    low, high = max(begin - c.ways[step], -c.limit), min(begin + c.ways[step], c.limit)
    return 0.5 * (low + high), 0.5 * (high - low)


@compiled
def _reach(c: Steering) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    k, last, there = c.counts[STEP], len(c.guide), _there(c)
    ends = _ends(c, c.counts[TURNS], k + 1)
    middles, sizes = ends.means, np.empty(len(ends.means), np.complex128)
    for i in range(len(sizes)):
        sizes[i] = complex(ends.turned[i], ends.turned[i])
    for j in range(k, last):
        (x, wide), (z, high) = _room(c, there.real, j - k), _room(c, there.imag, j - k)
        for i in range(len(middles)):
            shift = c.responses.guide[i, last, j]
            middles[i] += shift * complex(x, z)
            sizes[i] += abs(shift) * complex(wide, high)
    return middles, sizes, ends.errors


@kernel
def reach(held: Boxed[Steering]) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """
    Return the reachable set of the tip by hypothesis, shape (h,) each.

    Its middle x + i z [m], its half widths along x + i along z [m], and the standard deviation of
    the middle along each axis [m].
    """
    return _reach(held.value)


@kernel
def chance(held: Boxed[Steering]) -> float:
    """Return the probability that the tip can reach the target within 1 mm."""
    c = held.value
    (middles, sizes, errors), w = _reach(c), weights(c.logs)
    along_x = along_z = 0.0
    for i in range(len(w)):
        x, z = c.target[0] - middles[i].real, c.target[1] - middles[i].imag
        for a in range(len(_WEIGHTS)):
            off = errors[i] * _ABSCISSAS[a]
            if abs(x + off) <= _REACHED + sizes[i].real:
                along_x += w[i] * _WEIGHTS[a]
            if abs(z + off) <= _REACHED + sizes[i].imag:
                along_z += w[i] * _WEIGHTS[a]
    return along_x * along_z


# Plan.


@kernel
def choose(held: Boxed[Steering]) -> complex:
    """
    Return the next position of the guide, x + i z [m], and turn the needle if worthwhile.

    Updates the roll and the bevel directions of the state.
    """
    c = held.value
    k, last, w = c.counts[STEP], len(c.guide), weights(c.logs)
    turns, tried = c.counts[TURNS], _tried(c, _TRIED)
    ends = _ends(c, turns, k + 2)
    cost, guide = _best(c, w, ends, tried)
    if turns == 0 or cost < _TURN:
        return guide
    # The present plan with a turn now.
    base, few = _ends(c, turns - 1, k + 2), _tried(c, _COARSE)
    best, roll, chosen = inf, 0.0, base
    for turn in range(1 - _ROLLS // 2, _ROLLS // 2 + 1):
        other = c.roll[0] + tau * turn / _ROLLS
        means = base.means.copy()
        for i in range(len(means)):
            push = 0.0
            for j in range(k + 1, k + 2 if turns > 1 else last + 1):
                push += c.responses.bevel[i, last, j]
            means[i] += c.mean[i, BEVEL] * push * (_direction(other) - c.turned[k + 1])
        ends = Ends(means, base.errors, base.turned)
        costs = _costs(c, w, ends, few)
        along_x = along_z = inf
        for t in range(costs.shape[1]):
            along_x, along_z = min(along_x, costs[0, t]), min(along_z, costs[1, t])
        found = along_x + along_z
        if found < best:
            best, roll, chosen = found, other, ends
    if best + _TURN > cost:
        return guide
    c.roll[0], c.counts[TURNS] = roll, turns - 1
    for j in range(k + 1, len(c.turned)):
        c.turned[j] = _direction(roll)
    return _best(c, w, chosen, tried)[1]


@inlined
def _direction(roll: float) -> complex:
    """Return the direction of the bevel relative to zero roll."""
    return complex(cos(roll), -sin(roll))


@inlined
def _tried(c: Steering, parts: FloatArray) -> FloatArray:
    """Return candidate positions of the guide in x and z [m], shape (2, positions)."""
    if c.limit == 0.0:
        return np.zeros((2, 1))
    there, found = _there(c), np.empty((2, len(parts)))
    for plane in range(2):
        middle, half = _room(c, there.imag if plane else there.real, 0)
        for t in range(len(parts)):
            found[plane, t] = middle + half * parts[t]
    return found


@compiled
def _best(c: Steering, w: FloatArray, ends: Ends, tried: FloatArray) -> tuple[float, complex]:
    """Return mean square distance from the reachable set and position of the best candidate."""
    costs, whole, found = _costs(c, w, ends, tried), 0.0, np.empty(2)
    plan = _plan(c, w, ends)
    for plane in range(2):
        wanted, best = min(max(plan[plane], -c.limit), c.limit), inf
        for t in range(tried.shape[1]):
            cost = costs[plane, t] + _AWAY * (tried[plane, t] - wanted) ** 2
            if cost < best:
                best, at = cost, t
        whole += costs[plane, at]
        found[plane] = tried[plane, at]
    return whole, complex(found[0], found[1])


@compiled
def _costs(c: Steering, w: FloatArray, ends: Ends, tried: FloatArray) -> FloatArray:
    """Return the mean square distance from the reachable set by candidate, in x and z [m^2]."""
    r, k, last = c.responses, c.counts[STEP], len(c.guide)
    # Later positions that depend on the next position; the others are only limited.
    near = 0
    while near < last - k - 1 and c.ways[near] < 2.0 * c.limit:
        near += 1
    count = tried.shape[1]
    middles, halves = np.empty((near, count)), np.empty((near, count))
    left, later, found = np.empty(count), np.empty(count), np.zeros((2, count))
    felt, stiffness = _felt(c, w)
    for plane in range(2):
        to = tried[plane]
        for j in range(near):
            for t in range(count):
                middles[j, t], halves[j, t] = _room(c, to[t], j)
        for i in range(len(w)):
            mean = ends.means[i].imag if plane else ends.means[i].real
            need = c.target[plane] - mean
            shift, anywhere = r.guide[i, last, k], c.limit * r.later_guide[i, k + 1 + near]
            for t in range(count):
                left[t] = need - shift * to[t]
                later[t] = _COUNTED * anywhere + ends.turned[i]
            for j in range(near):
                shift = r.guide[i, last, k + 1 + j]
                for t in range(count):
                    left[t] -= shift * middles[j, t]
                    later[t] += _COUNTED * abs(shift) * halves[j, t]
            for a in range(len(_WEIGHTS)):
                off, weight = ends.errors[i] * _ABSCISSAS[a], w[i] * _WEIGHTS[a]
                for t in range(count):
                    short = max(0.0, abs(left[t] + off) - later[t])
                    found[plane, t] += weight * short * short
        force = felt.imag if plane else felt.real
        for t in range(count):
            over = max(0.0, abs(force + stiffness * to[t]) - c.load_limit)
            found[plane, t] += _OVERLOAD * over**2
    return found


@compiled
def _felt(c: Steering, w: FloatArray) -> tuple[complex, float]:
    """Return the load on a guide at zero [N], and its derivative by the position [N/m]."""
    r, k, force, stiffness = c.responses, c.counts[STEP], 0j, 0.0
    if c.load_limit == inf:
        return force, stiffness
    for i in range(len(w)):
        load = 0j
        for j in range(k):
            load += r.guide_load[i, k, j] * c.guide[j]
        push = 0j
        for j in range(len(c.turned)):
            push += r.bevel_load[i, k, j] * c.turned[j]
        for j in range(r.causes_load.shape[2]):
            load += (push if j == BEVEL else r.causes_load[i, k, j]) * c.mean[i, j]
        force += w[i] * load
        stiffness += w[i] * r.guide_load[i, k, k]
    return force, stiffness


@compiled
def _plan(c: Steering, w: FloatArray, ends: Ends) -> tuple[float, float]:
    """Return the next position of a least-squares plan for the mean, with a cost of motion."""
    k, last = c.counts[STEP], len(c.guide)
    count = last - k
    normal, factor = np.zeros((count, count)), np.zeros((count, count))
    for j in range(count):
        normal[j, j] = _MOTION
    x, z = np.zeros(count), np.zeros(count)
    for i in range(len(w)):
        shifts = c.responses.guide[i, last, k:]
        for j in range(count):
            weighted = w[i] * shifts[j]
            x[j] += weighted * (c.target[0] - ends.means[i].real)
            z[j] += weighted * (c.target[1] - ends.means[i].imag)
            for m in range(j, count):
                normal[j, m] += weighted * shifts[m]
    cholesky(normal, factor)
    for one in (x, z):
        forward(factor, one)
        backward(factor, one)
    return x[0], z[0]
