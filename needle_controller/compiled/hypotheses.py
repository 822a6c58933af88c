# SPDX-License-Identifier: Apache-2.0
r"""
Hypotheses of the steering controller: state, and update by tip measurements.

By hypothesis the tip at a depth is :math:`z = a \cdot b + x \cdot \theta` with the positions b of
the guide, x + i z, and unknown constants :math:`\theta` with mean :math:`\bar\theta` and
covariance P. Its mean is :math:`a \cdot b + x \cdot \bar\theta`, its covariance with the constants
:math:`s = P \bar x`, and its variance :math:`x \cdot s`; a tip measurement is an update of rank
one. See `needle_controller.steering.laws.multi_hypothesis`.
"""

from __future__ import annotations

from math import exp, inf, isfinite, log
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
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Standard deviation of the relative loss of the bevel load at rest.
_BEVEL_RELEASE: Final = 0.03

#: Index of the bevel load among the constants.
BEVEL: Final = 3

#: Gate on the squared innovation over its variance (exceeded by noise once in 3 million tip
#: measurements), and number of successive measurements outside the gate of all hypotheses that is
#: a fault.
_GATE, _MOST_IMPLAUSIBLE = 30.0, 2

#: Least logarithm of the weight of a hypothesis, relative to the largest; then it is discarded.
_LEAST_LOG: Final = -30.0

#: Number of equal successive tip measurements of a moving needle that is a frozen sensor.
MOST_SAME: Final = 2

#: Largest number of successive missing tip measurements.
MOST_MISSING: Final = 6

#: Indices of `Steering.counts`: tip measurements so far, remaining turns, and successive equal,
#: implausible and missing measurements.
STEP, TURNS, SAME, IMPLAUSIBLE, MISSING = range(5)

#: Result of the check of a tip measurement.
VALID, LOST, FROZEN, OUTLIER = range(4)


class HypothesisResponses(NamedTuple):
    """Responses of the tip by point of the grid: arrays of `SteeringModel`, and sums."""

    #: As in `SteeringModel`.
    guide: Array3
    causes: Array3
    bevel: Array3
    elastic: Matrix
    guide_load: Array3
    causes_load: Array3
    bevel_load: Array3
    between: Array4
    lags: Matrix
    #: Sums of the absolute values of `guide` at the last depth, from each step on,
    #: shape (g, n + 1).
    later_guide: Matrix
    #: Sums of the absolute values of `bevel` at the last depth, from the skin and each step on,
    #: shape (g, n + 3).
    later_bevel: Matrix


class Steering(NamedTuple):
    """State and limits of a steering controller: h hypotheses, n steps and m constants."""

    responses: HypothesisResponses  #: responses of the tip
    drifts: Vector  #: standard deviation of the slow error by hypothesis [m], shape (h,)
    decay: Vector  #: correlation of the slow error over a step, shape (n,)
    path: Vector  #: depths relative to the target depth, from 0 to 1, shape (n + 1,)
    limit: float  #: largest position of the guide along each axis [m]
    load_limit: float  #: largest planned force of the guide [N]
    ranges: Vector  #: range of the guide motion after a number of steps, from 1 [m], shape (n,)
    target: Vector  #: target of the tip, x and z [m], shape (2,)
    mean: ComplexMatrix  #: mean of the constants, shape (h, m)
    covariance: ComplexArray3  #: their covariance, shape (h, m, m)
    #: Logarithm of the probability of each hypothesis, up to a constant; -inf if discarded,
    #: shape (h,).
    logs: Vector
    guide: ComplexVector  #: position of the guide in each step [m]; 0 in future steps, shape (n,)
    #: Direction of the bevel relative to zero roll, on the skin and in each step, by point of the
    #: grid, shape (g, n + 1).
    turned: ComplexMatrix
    #: Roll of the tip by point of the grid, then of the base [rad], shape (g + 1,).
    roll: Vector
    last: Vector  #: last tip measurement [m], shape (2,)
    #: Tip measurements so far, remaining turns, successive equal, implausible and missing
    #: measurements, shape (5,).
    counts: IntVector


class TipDistribution(NamedTuple):
    """Distribution of the tip at a depth by hypothesis."""

    means: ComplexVector  #: mean, x + i z [m], shape (h,)
    variances: Vector  #: variance along each axis [m^2], shape (h,)
    shared: ComplexMatrix  #: covariance with the constants, shape (h, m)


class TipMoments(NamedTuple):
    """Mean and covariance of the tip over all hypotheses."""

    #: Mean [m].
    x: float
    z: float
    #: Covariance [m^2].
    xx: float
    xz: float
    zz: float


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
def _guide_at_rest(c: Steering) -> ComplexArray:
    """Return the positions of the guide, shape (n,), with the guide at rest from now on."""
    guide, done = c.guide.copy(), min(c.counts[STEP], len(c.guide))
    if done > 0:
        for j in range(done, len(guide)):
            guide[j] = guide[done - 1]
    return guide


@compiled
def tip_mean(c: Steering, i: int, at: int, guide: ComplexArray, row: ComplexArray) -> complex:
    """Return the mean of the tip at a depth in a hypothesis; ``row`` takes x, shape (m,)."""
    r, m = c.responses, len(row)
    g, mean = i % len(r.guide), 0j
    for j in range(m - 3):
        row[j] = r.causes[g, at, j]
    row[BEVEL] = row[m - 3] = row[m - 2] = row[m - 1] = 0.0
    for j in range(c.turned.shape[1]):
        row[BEVEL] += r.bevel[g, at, j] * c.turned[g, j]
    for j in range(len(guide)):
        mean += r.guide[g, at, j] * guide[j]
        row[m - 3] += r.between[0, g, at, j] * guide[j]
        row[m - 2] += r.between[1, g, at, j] * guide[j]
    for j in range(m):
        mean += c.mean[i, j] * row[j]
    return mean


@compiled
def tip_distribution(
    c: Steering, at: int, guide: ComplexArray, seen: float = 0.0
) -> TipDistribution:
    """
    Return the distribution of the tip at a depth by hypothesis; 0 for discarded hypotheses.

    With ``seen`` = 1: distribution of the measured tip, with the slow error of the sensor.
    """
    h, m = c.mean.shape
    means, variances = np.zeros(h, np.complex128), np.zeros(h)
    shared, row = np.zeros((h, m), np.complex128), np.empty(m, np.complex128)
    for i in range(h):
        if c.logs[i] == -inf:
            continue
        means[i] = tip_mean(c, i, at, guide, row) + seen * c.mean[i, m - 1]
        of, row[m - 1] = shared[i], seen
        for j in range(m):
            # P is Hermitian: its rows are its conjugated columns.
            for l in range(m):
                of[l] += row[j] * c.covariance[i, j, l]
        for j in range(m):
            variances[i] += of[j].real * row[j].real + of[j].imag * row[j].imag
            of[j] = of[j].conjugate()
        elastic = c.responses.elastic[i % len(c.responses.elastic), at]
        variances[i] += (_BEVEL_RELEASE * elastic * abs(c.mean[i, BEVEL])) ** 2
    return TipDistribution(means, variances, shared)


@compiled
def _moments(w: FloatArray, tip: TipDistribution) -> TipMoments:
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
    return TipMoments(x, z, xx, xz, zz)


@kernel
def predict(boxed: Boxed[Steering], at: int) -> TipMoments:
    """Predict the tip at depth number ``at`` with guide and roll as last commanded."""
    c = boxed.value
    return _moments(weights(c.logs), tip_distribution(c, at, _guide_at_rest(c)))


@kernel
def update(
    boxed: Boxed[Steering], at: int, x: float, z: float, variance: float
) -> tuple[int, float, float]:
    """
    Update hypotheses and weights with a tip measurement (x, z) [m] at depth number ``at``.

    ``x`` and ``z`` are nan if the measurement is missing; ``variance`` is per axis [m^2]. Returns
    `VALID` or the reason for a stop, and the innovation along both axes [m].
    """
    c = boxed.value
    tip, w = tip_distribution(c, at, _guide_at_rest(c), 1.0), weights(c.logs)
    predicted = _moments(w, tip)
    for i in range(len(w)):
        tip.variances[i] += variance
    kind, counts = _check(c, complex(x, z), tip)
    if counts:
        largest = -inf
        for i in range(len(w)):
            if c.logs[i] > -inf:
                _update_hypothesis(
                    c, i, complex(x, z) - tip.means[i], tip.variances[i], tip.shared[i]
                )
                largest = max(largest, c.logs[i])
        for i in range(len(w)):
            if c.logs[i] < largest + _LEAST_LOG:
                c.logs[i] = -inf
    return kind, x - predicted.x, z - predicted.z


@inlined
def _check(c: Steering, measured: complex, tip: TipDistribution) -> tuple[int, bool]:
    """Check a tip measurement; return its kind and whether the update uses it."""
    counts, x, z = c.counts, measured.real, measured.imag
    if not (isfinite(x) and isfinite(z)):
        counts[MISSING] += 1
        return (LOST if counts[MISSING] > MOST_MISSING else VALID), False
    counts[MISSING] = 0
    same = x == c.last[0] and z == c.last[1]
    counts[SAME] = counts[SAME] + 1 if same else 0
    c.last[0], c.last[1] = x, z
    if same:
        return (FROZEN if counts[SAME] >= MOST_SAME else VALID), False
    for i in range(len(c.logs)):
        off = measured - tip.means[i]
        # False for an infinite distance and for nan.
        if c.logs[i] > -inf and off.real**2 + off.imag**2 <= _GATE * tip.variances[i]:
            counts[IMPLAUSIBLE] = 0
            return VALID, True
    counts[IMPLAUSIBLE] += 1
    return (OUTLIER if counts[IMPLAUSIBLE] >= _MOST_IMPLAUSIBLE else VALID), False


@inlined
def _update_hypothesis(
    c: Steering, i: int, off: complex, variance: float, shared: ComplexArray
) -> None:
    """Update a hypothesis and its weight with the innovation of a tip measurement [m]."""
    for j in range(len(shared)):
        gain = shared[j] / variance
        c.mean[i, j] += gain * off
        to = c.covariance[i, j]
        for k in range(len(shared)):
            to[k] -= gain * shared[k].conjugate()
    c.logs[i] -= 0.5 * (off.real**2 + off.imag**2) / variance + log(variance)


@kernel
def advance(boxed: Boxed[Steering]) -> None:
    """Advance to the next step: the slow error of the sensor changes."""
    c, k = boxed.value, boxed.value.counts[STEP]
    if k < len(c.decay):
        last, decay = c.mean.shape[1] - 1, c.decay[k]
        for i in range(len(c.logs)):
            if c.drifts[i] == 0.0 or c.logs[i] == -inf:
                continue
            c.mean[i, last] *= decay
            for j in range(last + 1):
                c.covariance[i, last, j] *= decay
                c.covariance[i, j, last] *= decay
            c.covariance[i, last, last] += (1.0 - decay**2) * c.drifts[i] ** 2
    c.counts[STEP] = k + 1
