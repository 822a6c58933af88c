# SPDX-License-Identifier: Apache-2.0
r"""
Hypotheses of the steering controller: state, and update by tip measurements.

By hypothesis the tip at a depth is :math:`z = a \cdot b + x \cdot \theta` with the positions b of
the guide, x + i z, and unknown constants :math:`\theta` with mean :math:`\bar\theta` and
covariance P. Its mean is :math:`a \cdot b + x \cdot \bar\theta`, its covariance with the constants
:math:`s = P \bar x`, and its variance :math:`x \cdot s`; a tip measurement is an update of rank
one. See `needle_controller.steering.laws.multi_hypothesis`.

A tip measurement has a gross error with the probability :math:`\epsilon`. Its innovation e, with
the variance v along each axis, has the likelihood

.. math:: L = (1 - \epsilon) N(e; v) + \epsilon N(e; v + \sigma_g^2)

and no gross error with the probability :math:`r = (1 - \epsilon) N(e; v) / L`. The constants then
are a mixture: updated with probability r, unchanged otherwise. A normal distribution of the same
mean and covariance replaces it ([BarShalom2011]_, section 3.4, for measurements with clutter):

.. math:: \bar\theta + r \frac{s}{v} e, \quad
   P - r \left( 1 - (1 - r) \frac{|e|^2}{2 v} \right) \frac{s \bar s^T}{v}

The probability :math:`\epsilon` is the mean of a beta distribution of the measurements so far.

A fault of the sensor is an offset that stays: the evidence is a cumulative sum of the logarithm of
the likelihood ratio of this fault and of the mixture over all hypotheses [Page1954]_.

References
----------
.. [BarShalom2011] Y. Bar-Shalom, P. K. Willett, X. Tian, "Tracking and Data Fusion", YBS, 2011.
.. [Page1954] E. S. Page, "Continuous inspection schemes", Biometrika 41, 1954.

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

_BEVEL_RELEASE: Final = 0.03  #: Standard deviation of the relative loss of the bevel load at rest.
BEVEL: Final = 3  #: Index of the bevel load among the constants.

#: Standard deviation of a gross error of a tip measurement along each axis [m]: organs below the
#: diaphragm move by 5 to 10 mm.
_GROSS: Final = 5e-3

#: Prior of the probability of a gross error, a beta distribution: the number of gross errors, and
#: of all measurements, with the same effect.
_GROSS_PRIOR, _COUNT_PRIOR = 0.1, 20.0

#: A sensor fault: standard deviation of its offset, and of the change of the offset from one
#: measurement to the next along each axis [m].
_FAULT, _FAULT_CHANGE = 0.03, 2e-4

#: Largest increase of the evidence of a sensor fault by one measurement, and evidence that stops
#: the needle: a single measurement never does.
_MOST_EVIDENCE, _STOP_EVIDENCE = 8.0, 10.0

_FARTHEST: Final = 0.1**2  #: Squared distance of a measurement with a gross error [m^2].
_LEAST_LOG: Final = -30.0  #: Logarithm of the relative weight of a hypothesis to discard.
MOST_SAME: Final = 2  #: Number of equal successive tip measurements that is a frozen sensor.
MOST_MISSING: Final = 6  #: Largest number of successive missing tip measurements.

#: Indices of `Steering.counts`: tip measurements so far, remaining turns, and successive equal,
#: gross and missing measurements.
STEP, TURNS, SAME, GROSS, MISSING = range(5)

#: Indices of `Steering.gross`: expected number of gross errors, number of measurements, evidence
#: of a sensor fault, and the last innovation along x and z [m].
_ERRORS, _MEASURED, _EVIDENCE, _LAST_X, _LAST_Z = range(5)

VALID, LOST, FROZEN, OUTLIER = range(4)  #: Result of the check of a tip measurement.


class HypothesisResponses(NamedTuple):
    """Shifts of the tip at each depth, for g points of the grid, and their sums."""

    guide: Array3  #: per position of the guide in each step, shape (g, n + 1, n)
    #: Per origin [m], turn of the frame [rad], tilt, load of the bevel [N] without roll, and
    #: curvature of the path at each depth [1/m], shape (g, n + 1, 5 + n).
    causes: Array3
    bevel: Array3  #: per load of the bevel [N] on the skin, and in each step, (g, n + 1, n + 1)
    elastic: Matrix  #: of the resting tip per load of the bevel [m/N], shape (g, n + 1)
    #: The same for the force on the guide at its position of each step [N], with n rows.
    guide_load: Array3
    causes_load: Array3
    bevel_load: Array3
    #: Change of `guide` to the next bending length, and to the next skin, shape (2, g, n + 1, n).
    between: Array4
    lags: Matrix  #: largest lag of the roll of the tip behind the base [rad], shape (g, n + 1)
    #: Sums of the absolute values at the last depth: of `guide` from each step on, shape
    #: (g, n + 1), and of `bevel` from the skin and each step on, shape (g, n + 3).
    later_guide: Matrix
    later_bevel: Matrix


class Steering(NamedTuple):
    """State and limits of a steering controller: h hypotheses, n steps and m constants."""

    responses: HypothesisResponses
    drifts: Vector  #: standard deviation of the slow error by hypothesis [m], shape (h,)
    decay: Vector  #: correlation of the slow error over a step, shape (n,)
    path: Vector  #: depths relative to the target depth, from 0 to 1, shape (n + 1,)
    limit: float  #: largest position of the guide along each axis [m]
    load_limit: float  #: largest planned force of the guide [N]
    ranges: Vector  #: range of the guide motion after a number of steps, from 1 [m], shape (n,)
    target: Vector  #: target of the tip, x and z [m], shape (2,)
    mean: ComplexMatrix  #: mean of the constants, shape (h, m)
    covariance: ComplexArray3  #: their covariance, shape (h, m, m)
    logs: Vector  #: logarithm of the hypothesis weights; -inf if discarded, shape (h,)
    guide: ComplexVector  #: position of the guide in each step [m]; 0 in future steps, shape (n,)
    #: Direction of the bevel relative to zero roll, on the skin and in each step, by point of the
    #: grid, shape (g, n + 1).
    turned: ComplexMatrix
    roll: Vector  #: Roll of the tip by point of the grid, then of the base [rad], shape (g + 1,).
    last: Vector  #: last tip measurement [m], shape (2,)
    counts: IntVector  #: numbers with the index `STEP` and so on, shape (5,)
    gross: Vector  #: numbers with the index `_ERRORS` and so on, shape (5,)


class TipDistribution(NamedTuple):
    """Distribution of the tip at a depth by hypothesis."""

    means: ComplexVector  #: mean, x + i z [m], shape (h,)
    variances: Vector  #: variance along each axis [m^2], shape (h,)
    shared: ComplexMatrix  #: covariance with the constants, shape (h, m)


class TipMoments(NamedTuple):
    """Mean [m] and covariance [m^2] of the tip over all hypotheses."""

    x: float
    z: float
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
    for i in range(len(w)):
        tip.variances[i] += variance
    predicted = _moments(w, tip)
    kind, used = _check_sensor(c, x, z)
    off = complex(x - predicted.x, z - predicted.z)
    if used:
        sound, likelihood = _update_hypotheses(c, w, tip, complex(x, z))
        spread = 0.5 * (predicted.xx + predicted.zz)
        if _detect_fault(c, off, spread, sound, likelihood):
            kind = OUTLIER
    return kind, off.real, off.imag


@inlined
def _check_sensor(c: Steering, x: float, z: float) -> tuple[int, bool]:
    """Count missing and equal tip measurements; return the kind and whether the update uses it."""
    counts = c.counts
    if not (isfinite(x) and isfinite(z)):
        counts[MISSING] += 1
        return (LOST if counts[MISSING] > MOST_MISSING else VALID), False
    counts[MISSING] = 0
    same = x == c.last[0] and z == c.last[1]
    counts[SAME] = counts[SAME] + 1 if same else 0
    c.last[0], c.last[1] = x, z
    return (FROZEN if counts[SAME] >= MOST_SAME else VALID), not same


@inlined
def _log_density(off: complex, variance: float) -> float:
    """Return the logarithm of a normal density in both planes, up to a constant."""
    # Finite also for a measurement whose square is not.
    return -0.5 * min(off.real**2 + off.imag**2, _FARTHEST) / variance - log(variance)


@compiled
def _update_hypotheses(
    c: Steering, w: FloatArray, tip: TipDistribution, measured: complex
) -> tuple[float, float]:
    """Update all hypotheses; return the probability of no gross error, and the log-likelihood."""
    share = (_GROSS_PRIOR + c.gross[_ERRORS]) / (_COUNT_PRIOR + c.gross[_MEASURED])
    likely, sounds, largest = np.full(len(w), -inf), np.zeros(len(w)), -inf
    for i in range(len(w)):
        if c.logs[i] == -inf:
            continue
        off, variance = measured - tip.means[i], tip.variances[i]
        normal = log(1.0 - share) + _log_density(off, variance)
        gross = log(share) + _log_density(off, variance + _GROSS**2)
        likely[i] = max(normal, gross) + log(1.0 + exp(-abs(normal - gross)))
        largest = max(largest, likely[i])
        # False for an infinite distance.
        if off.real**2 + off.imag**2 < _FARTHEST:
            sounds[i] = exp(normal - likely[i])
            _update_hypothesis(c, i, off, variance, tip.shared[i], sounds[i])
    whole, sound, most = 0.0, 0.0, -inf
    for i in range(len(w)):
        part = w[i] * exp(likely[i] - largest)
        whole += part
        sound += part * sounds[i]
        c.logs[i] += likely[i]
        most = max(most, c.logs[i])
    for i in range(len(w)):
        if c.logs[i] < most + _LEAST_LOG:
            c.logs[i] = -inf
    return sound / whole, largest + log(whole)


@inlined
def _update_hypothesis(
    c: Steering, i: int, off: complex, variance: float, shared: ComplexArray, sound: float
) -> None:
    """Update a hypothesis with an innovation [m] that has no gross error with a probability."""
    # Mean and covariance of the mixture of the constants with and without the measurement.
    squared = 0.5 * (off.real**2 + off.imag**2)
    learned = sound * (1.0 - (1.0 - sound) * squared / variance)
    for j in range(len(shared)):
        gain = shared[j] / variance
        c.mean[i, j] += sound * gain * off
        to = c.covariance[i, j]
        for k in range(len(shared)):
            to[k] -= learned * gain * shared[k].conjugate()


@inlined
def _detect_fault(
    c: Steering, off: complex, variance: float, sound: float, likelihood: float
) -> bool:
    """Return whether innovations [m] are gross for too long, or are the offset of a fault."""
    counts, gross = c.counts, c.gross
    if counts[GROSS] > 0:
        change = off - complex(gross[_LAST_X], gross[_LAST_Z])
        faulty = _log_density(change, variance + _FAULT_CHANGE**2)
    else:
        faulty = -inf
    # A fault may begin with any measurement.
    faulty = max(faulty, _log_density(off, _FAULT**2))
    found = gross[_EVIDENCE] + min(faulty - likelihood, _MOST_EVIDENCE)
    gross[_EVIDENCE] = max(0.0, found)
    gross[_ERRORS] += 1.0 - sound
    gross[_MEASURED] += 1.0
    gross[_LAST_X], gross[_LAST_Z] = off.real, off.imag
    counts[GROSS] = counts[GROSS] + 1 if sound < 0.5 else 0
    return bool(gross[_EVIDENCE] >= _STOP_EVIDENCE or counts[GROSS] > MOST_MISSING)


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
