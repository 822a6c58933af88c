# SPDX-License-Identifier: Apache-2.0
r"""
Hypotheses of the steering controller: state, and update by tip measurements.

By hypothesis the tip at depth number k is :math:`z_k = a_k \cdot b + f_k + y_k \cdot \psi` with
the positions b of the guide, x + i z, the tip :math:`f_k` by origin, frame, tilt and path, and
constants :math:`\psi`, whose factors :math:`y_k` depend on past motion: load of the bevel,
position between two bending lengths and between two skins, stiffness of each layer with an
uncertainty of its own, and slow error of the sensor. The state is :math:`(f_0, ..., f_n, \psi)`:
a measurement contains one tip and the constants, and a tip that has been passed is no longer
updated. If the load of the guide is limited, the state includes the forces on the guide by origin,
frame, tilt and path.

With the mean :math:`\bar\theta` of the state and its covariance P, a tip :math:`x \cdot \theta`
has the covariance :math:`s = P \bar x` with the state, and the variance :math:`x \cdot s`. A tip
measurement is an update of rank one, so P is the prior covariance less a sum over all of them:

.. math:: P = P_0 - \sum_i d_i s_i \bar s_i^T

P is never formed; each measurement stores its :math:`s_i` and :math:`d_i`. The prior is the same
for all hypotheses of a point of the grid, up to path noise and slow error. In each step the entry
of the slow error in the mean and in every :math:`s_i` decreases; its prior variance is stationary.

A tip measurement may have a gross error; the state then is a mixture, which a normal distribution
replaces ([BarShalom2011]_, section 3.4, for measurements with clutter). A fault of the sensor is
an offset that stays [Page1954]_. The formulas are in docs/steering.md.

References
----------
.. [BarShalom2011] Y. Bar-Shalom, P. K. Willett, X. Tian, "Tracking and Data Fusion", YBS, 2011.
.. [Page1954] E. S. Page, "Continuous inspection schemes", Biometrika 41, 1954.

"""

from __future__ import annotations

from math import exp, inf, isfinite, log
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_controller.compiled.hypothesis_model import HypothesisResponses, StatePrior
from needle_dynamics.arrays import (
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

#: Constants after the tips of the state: load of the bevel [N], position between two bending
#: lengths and between two skins; then the logarithm of the stiffness of each layer relative to the
#: hypothesis, and as the last one the slow error of the sensor [m].
BEVEL, LONG, HARD, LAYERS = range(4)

#: Standard deviation of a gross error of a tip measurement along each axis [m]: organs below the
#: diaphragm move by 5 to 10 mm.
_GROSS: Final = 5e-3

#: Beta prior of the probability of a gross error: numbers of gross errors and of measurements.
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

#: Indices of `Steering.counts`: steps so far, remaining turns, successive equal, gross and missing
#: measurements, and measurements that were used.
STEP, TURNS, SAME, GROSS, MISSING, MEASURED = range(6)

#: Indices of `Steering.gross`: expected number of gross errors, evidence of a sensor fault, and
#: last innovation along x and z [m].
_ERRORS, _EVIDENCE, _LAST_X, _LAST_Z = range(4)

VALID, LOST, FROZEN, OUTLIER = range(4)  #: Result of the check of a tip measurement.


class Steering(NamedTuple):
    """
    State and limits of a steering controller: h hypotheses, n steps and m entries of the state.

    With a load limit, m is 2 n + 5, else n + 5, both with one more for each layer with a deviation
    of its own, and u is the largest number of measurements.
    """

    responses: HypothesisResponses
    prior: StatePrior
    path: Vector  #: depths relative to the target depth, from 0 to 1, shape (n + 1,)
    waypoints: ComplexVector  #: planned tip at each depth, 0 without a plan [m], shape (n + 1,)
    planned: ComplexVector  #: planned guide in each step, 0 without a plan [m], shape (n,)
    following: float  #: weight of the squared deviation from the waypoints
    limit: float  #: largest position of the guide along each axis [m]
    load_limit: float  #: largest planned force of the guide [N]
    ranges: Vector  #: range of the guide motion after a number of steps, from 1 [m], shape (n,)
    target: Vector  #: target of the tip, x and z [m], shape (2,)
    mean: ComplexMatrix  #: mean of the state, shape (h, m)
    #: Covariance of each measured tip with the state, from the first depth on that could still be
    #: measured, shape (h, u, m). Other entries, and discarded hypotheses, are never read.
    shared: ComplexArray3
    learned: Matrix  #: factor d of each measurement, shape (h, u)
    logs: Vector  #: logarithm of the hypothesis weights; -inf if discarded, shape (h,)
    guide: ComplexVector  #: position of the guide in each step [m]; 0 in future steps, shape (n,)
    #: Direction of the bevel relative to zero roll, on the skin and in each step, by point of the
    #: grid, shape (g, n + 1).
    turned: ComplexMatrix
    roll: Vector  #: Roll of the tip by point of the grid, then of the base [rad], shape (g + 1,).
    last: Vector  #: last tip measurement [m], shape (2,)
    counts: IntVector  #: numbers with the index `STEP` and so on, shape (6,)
    gross: Vector  #: numbers with the index `_ERRORS` and so on, shape (4,)


class TipForm(NamedTuple):
    """Tip at a depth as a linear form of the state, by point of the grid."""

    at: int  #: depth number
    shifts: ComplexVector  #: shift by the guide [m], shape (g,)
    factors: ComplexMatrix  #: factors of the constants, shape (g, 4 + layers)


class TipDistribution(NamedTuple):
    """Distribution of the tip at a depth by hypothesis."""

    means: ComplexVector  #: mean, x + i z [m], shape (h,)
    variances: Vector  #: variance along each axis [m^2], shape (h,)


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
        found[i] = 0.0 if logs[i] == -inf else exp(logs[i] - largest)
        whole += found[i]
    for i in range(len(logs)):
        found[i] /= whole
    return found


@inlined
def _squared(value: complex) -> float:
    return value.real * value.real + value.imag * value.imag


@inlined
def times(factor: float, value: complex) -> complex:
    """Return a product of two multiplications; Numba converts a real factor and has four."""
    return complex(factor * value.real, factor * value.imag)


@inlined
def constants(c: Steering) -> int:
    """Return the number of constants in the state; the last one is the slow error."""
    return len(c.prior.deviations) + 1


@inlined
def guide_ahead(c: Steering) -> ComplexArray:
    """Return past positions of the guide [m], and later ones: it moves only by the plan."""
    guide, done = c.guide.copy(), min(c.counts[STEP], len(c.guide))
    off = guide[done - 1] - c.planned[done - 1] if done > 0 else 0j
    guide[done:] = c.planned[done:] + off
    return guide


@compiled
def tip_form(
    c: Steering, w: FloatArray, least: float, at: int, guide: ComplexArray, seen: float = 0.0
) -> TipForm:
    """Return the tip, measured if ``seen`` = 1; 0 at points without a weight above ``least``."""
    r = c.responses
    shifts = np.zeros(len(r.guide), np.complex128)
    factors = np.zeros((len(r.guide), constants(c)), np.complex128)
    for g in range(len(r.guide)):
        heaviest = 0.0
        for i in range(g, len(w), len(r.guide)):
            heaviest = max(heaviest, w[i])
        if heaviest <= least:
            continue
        shift = bevel = long = hard = 0j
        # Later steps have no effect.
        for j in range(at + 1):
            bevel += times(r.bevel[g, at, j], c.turned[g, j])
        for j in range(at):
            shift += times(r.guide[g, at, j], guide[j])
            long += times(r.between[0, g, at, j], guide[j])
            hard += times(r.between[1, g, at, j], guide[j])
        shifts[g] = shift
        factors[g, BEVEL], factors[g, LONG], factors[g, HARD] = bevel, long, hard
        for k in range(LAYERS, constants(c) - 1):
            for j in range(at):
                factors[g, k] += times(r.between[k - 1, g, at, j], guide[j])
        factors[g, -1] = seen
    return TipForm(at, shifts, factors)


@inlined
def constant_mean(c: Steering, i: int, index: int) -> complex:
    """Return the mean of a constant in a hypothesis, with an index such as `BEVEL`."""
    return complex(c.mean[i, len(c.path) + index])


@inlined
def layered_shift(c: Steering, i: int, at: int, j: int) -> float:
    """Return the change of the response to the guide by the estimated stiffness of layers."""
    g, found = i % len(c.responses.guide), 0.0
    for k in range(LAYERS, constants(c) - 1):
        found += constant_mean(c, i, k).real * c.responses.between[k - 1, g, at, j]
    return float(found)


@inlined
def tip_mean(c: Steering, i: int, form: TipForm) -> complex:
    """Return the mean of the tip in a hypothesis, x + i z [m]."""
    g = i % len(form.shifts)
    mean: complex = form.shifts[g] + c.mean[i, form.at]
    for j in range(constants(c)):
        mean += form.factors[g, j] * constant_mean(c, i, j)
    return mean


@inlined
def _prior_covariance(c: Steering, i: int, at: int, other: int) -> float:
    """Return the prior covariance of a tip with a tip or a force in a hypothesis."""
    p, g = c.prior, i % len(c.prior.known)
    return float(p.known[g, at, other] + p.noises[i] * p.wandering[g, at, other])


@inlined
def _prior_variance(c: Steering, i: int, index: int) -> float:
    """Return the prior variance of a constant in a hypothesis; the slow error is stationary."""
    of = c.prior
    deviation = of.deviations[index] if index < len(of.deviations) else of.drifts[i]
    return float(deviation * deviation)


@inlined
def _covariance_with_measurement(c: Steering, i: int, k: int, form: TipForm) -> complex:
    """Return the conjugated covariance of the tip with measurement k, before its update."""
    found, g = c.shared[i, k, form.at], i % len(form.shifts)
    for j in range(constants(c)):
        found += form.factors[g, j] * c.shared[i, k, len(c.path) + j]
    return complex(found)


@inlined
def _released(c: Steering, i: int, form: TipForm) -> float:
    """Return the variance of the tip by the bevel load that may be lost at rest [m^2]."""
    elastic = _BEVEL_RELEASE * c.responses.elastic[i % len(form.shifts), form.at]
    return float(elastic**2 * _squared(constant_mean(c, i, BEVEL)))


@inlined
def _variance(c: Steering, i: int, form: TipForm) -> float:
    """Return the variance of the tip along each axis in a hypothesis [m^2]."""
    g, found = i % len(form.shifts), _prior_covariance(c, i, form.at, form.at)
    for j in range(constants(c)):
        found += _squared(form.factors[g, j]) * _prior_variance(c, i, j)
    for k in range(c.counts[MEASURED]):
        found -= float(c.learned[i, k] * _squared(_covariance_with_measurement(c, i, k, form)))
    return found + _released(c, i, form)


@compiled
def tip_distribution(c: Steering, form: TipForm) -> TipDistribution:
    """Return the distribution of the tip by hypothesis; 0 for discarded hypotheses."""
    means, variances = np.zeros(len(c.logs), np.complex128), np.zeros(len(c.logs))
    for i in range(len(means)):
        if c.logs[i] > -inf:
            means[i], variances[i] = tip_mean(c, i, form), _variance(c, i, form)
    return TipDistribution(means, variances)


@inlined
def _first(c: Steering) -> int:
    return int(max(0, c.counts[STEP] - 1))


@inlined
def _covariance_with_state(c: Steering, i: int, form: TipForm, shared: ComplexArray) -> None:
    """Compute the covariance of the tip with the state, from the first depth on, in place."""
    first, tips, g, count = _first(c), len(c.path), i % len(form.shifts), constants(c)
    for j in range(first, len(shared) - count):
        shared[j if j < tips else j + count] = _prior_covariance(c, i, form.at, j)
    for j in range(count):
        shared[tips + j] = form.factors[g, j].conjugate() * _prior_variance(c, i, j)
    for k in range(c.counts[MEASURED]):
        factor = c.learned[i, k] * _covariance_with_measurement(c, i, k, form).conjugate()
        to, of = shared[first:], c.shared[i, k, first:]
        for j in range(len(to)):
            to[j] -= factor * of[j]


@compiled
def _measurement_distribution(c: Steering, form: TipForm, noise: float) -> TipDistribution:
    """Return the distribution of a measurement with a variance [m^2]; store its covariances."""
    means, variances = np.zeros(len(c.logs), np.complex128), np.full(len(c.logs), noise)
    new = c.counts[MEASURED]
    for i in range(len(means)):
        if c.logs[i] > -inf:
            _covariance_with_state(c, i, form, c.shared[i, new])
            means[i] = tip_mean(c, i, form)
            variances[i] += _covariance_with_measurement(c, i, new, form).real + _released(
                c, i, form
            )
    return TipDistribution(means, variances)


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
    """Predict the tip at a depth number with the last roll, and the guide of `guide_ahead`."""
    c, w = boxed.value, weights(boxed.value.logs)
    return _moments(w, tip_distribution(c, tip_form(c, w, 0.0, at, guide_ahead(c))))


@kernel
def update(
    boxed: Boxed[Steering], at: int, x: float, z: float, variance: float
) -> tuple[int, float, float]:
    """
    Update hypotheses and weights with a tip measurement (x, z) [m] at depth number ``at``.

    ``x`` and ``z`` are nan if the measurement is missing; ``variance`` is per axis [m^2]. Returns
    `VALID` or the reason for a stop, and the innovation along both axes [m].
    """
    c, w = boxed.value, weights(boxed.value.logs)
    tip = _measurement_distribution(c, tip_form(c, w, 0.0, at, guide_ahead(c), 1.0), variance)
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
def _distance(off: complex, variance: float) -> float:
    """Return half the squared distance over the variance, limited: also of an infinite one."""
    return 0.5 * min(_squared(off), _FARTHEST) / variance


@inlined
def _density(off: complex, variance: float) -> float:
    """Return a normal density in both planes, up to a constant."""
    return exp(-_distance(off, variance)) / variance


@compiled
def _update_hypotheses(
    c: Steering, w: FloatArray, tip: TipDistribution, measured: complex
) -> tuple[float, float]:
    """Update all hypotheses; return the probability of no gross error, and the log-likelihood."""
    share = (_GROSS_PRIOR + c.gross[_ERRORS]) / (_COUNT_PRIOR + c.counts[MEASURED])
    densities, sounds = np.zeros(len(w)), np.zeros(len(w))
    for i in range(len(w)):
        if c.logs[i] == -inf:
            continue
        off, variance = measured - tip.means[i], tip.variances[i]
        normal = (1.0 - share) * _density(off, variance)
        densities[i] = normal + share * _density(off, variance + _GROSS**2)
        # False for an infinite distance: the measurement has no effect.
        if _squared(off) < _FARTHEST:
            sounds[i] = normal / densities[i]
            _update_hypothesis(c, i, off, variance, sounds[i])
    whole, sound, most = 0.0, 0.0, -inf
    for i in range(len(w)):
        whole += w[i] * densities[i]
        sound += w[i] * densities[i] * sounds[i]
        if c.logs[i] > -inf:
            c.logs[i] += log(densities[i])
            most = max(most, c.logs[i])
    for i in range(len(w)):
        if c.logs[i] < most + _LEAST_LOG:
            c.logs[i] = -inf
    c.counts[MEASURED] += 1
    return sound / whole, log(whole)


@inlined
def _update_hypothesis(c: Steering, i: int, off: complex, variance: float, sound: float) -> None:
    """Update a hypothesis with an innovation [m] that has no gross error with a probability."""
    shared, step = c.shared[i, c.counts[MEASURED]], sound / variance * off
    for j in range(_first(c), len(shared)):
        c.mean[i, j] += step * shared[j]
    # Covariance of the mixture of the state with and without the measurement.
    unsure = (1.0 - sound) * 0.5 * _squared(off) / variance
    c.learned[i, c.counts[MEASURED]] = sound * (1.0 - unsure) / variance


@inlined
def _detect_fault(
    c: Steering, off: complex, variance: float, sound: float, likelihood: float
) -> bool:
    """Return whether innovations [m] are gross for too long, or are the offset of a fault."""
    counts, gross = c.counts, c.gross
    if counts[GROSS] > 0:
        change = off - complex(gross[_LAST_X], gross[_LAST_Z])
        variance += _FAULT_CHANGE**2
        faulty = -_distance(change, variance) - log(variance)
    else:
        faulty = -inf
    # A fault may begin with any measurement.
    faulty = max(faulty, -_distance(off, _FAULT**2) - log(_FAULT**2))
    found = gross[_EVIDENCE] + min(faulty - likelihood, _MOST_EVIDENCE)
    gross[_EVIDENCE] = max(0.0, found)
    gross[_ERRORS] += 1.0 - sound
    gross[_LAST_X], gross[_LAST_Z] = off.real, off.imag
    counts[GROSS] = counts[GROSS] + 1 if sound < 0.5 else 0
    return bool(gross[_EVIDENCE] >= _STOP_EVIDENCE or counts[GROSS] > MOST_MISSING)


@kernel
def advance(boxed: Boxed[Steering]) -> None:
    """Advance to the next step: the slow error of the sensor changes."""
    c, k = boxed.value, boxed.value.counts[STEP]
    if k < len(c.prior.decay):
        slow, decay = len(c.path) + constants(c) - 1, c.prior.decay[k]
        for i in range(len(c.logs)):
            if c.prior.drifts[i] == 0.0 or c.logs[i] == -inf:
                continue
            c.mean[i, slow] *= decay
            for j in range(c.counts[MEASURED]):
                c.shared[i, j, slow] *= decay
    c.counts[STEP] = min(k + 1, len(c.path))
