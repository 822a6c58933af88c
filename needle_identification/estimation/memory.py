# SPDX-License-Identifier: Apache-2.0
r"""
Estimate the autocorrelation of noise and its effect on the errors of a regression.

The samples of a recording are divided into parts, as long as a filter correlates white noise.
Their mean residuals are modeled as white noise and exponentially correlated noise,

.. math:: \operatorname{cov}(r_i, r_j) = \sigma^2 \left( w_i \delta_{ij}
   + g \, e^{-|t_i - t_j| / \tau} \right)

with :math:`w_i` one over the relative length of part i. The models are white noise, and a grid of
:math:`g` and :math:`\tau`, with times up to longer than the recording, where the model is a random
walk. A third kind is white noise with differences of white noise, as in a velocity computed from
noisy positions: an error added to one part is subtracted from the next, and errors shrink. The
probability of each model follows from its restricted likelihood [Patterson1971]_, which accounts
for the slow noise removed by the fit. The error of a parameter is such that its 95 % interval is
the interval of all models, weighted by probability. Errors therefore include correlations that the
data cannot exclude.

References
----------
.. [Patterson1971] H. D. Patterson, R. Thompson, "Recovery of inter-block information when block
   sizes are unequal", Biometrika 58(3), 1971, doi:10.1093/biomet/58.3.545.

"""

from dataclasses import dataclass
from math import exp, sqrt
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
import numpy as np
from scipy.linalg.lapack import dpttrf, dpttrs
from scipy.special import ndtr, ndtri

_RATIOS: Final = np.geomspace(0.02, 2e6, 10)  # correlated over white variance
_TIMES: Final = 24  # number of correlation times, from half a part
_LONGEST: Final = 10.0  # longest correlation time, relative to the recording
_DIFFERENCES: Final = np.geomspace(0.05, 3.0, 5)  # variances over white noise
_DIFFERENCED: Final = 0.1  # prior probability of differences

#: Prior probability of white noise. 0.5 is too large: a correlation time of a fifth of a part was
#: not detected, and 89 % of the intervals contained the true value.
_WHITE: Final = 0.2

_NEGLIGIBLE: Final = 1e-6  # smallest probability of a model that is included
_BISECTIONS: Final = 30  # bisection steps, for an accuracy of an interval of 1/1000 of the widest
_ROUNDING: Final = 1e-9  # relative size of rounding errors
_MOST_PARTS: Final = 1000  # largest number of parts for the comparison of models
_RUN: Final = 50  # parts per run, of a larger number


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Parts of about equal ``length`` [samples], without gaps; limits (m, 2): begin and end."""

    limits: IntArray
    length: float

    @property
    def sizes(self) -> FloatArray:
        return np.diff(self.limits, axis=1)[:, 0].astype(np.float64)

    @property
    def centers(self) -> FloatArray:
        return np.asarray(self.limits.mean(axis=1))

    def sums(self, values: FloatArray) -> FloatArray:
        """Return the sum over each part, (m, ...), of values (n, ...)."""
        # Padding for the limit after the last sample.
        padded = np.concatenate([values, np.zeros_like(values[:1])])
        return np.asarray(np.add.reduceat(padded, self.limits.ravel(), axis=0)[::2])

    def means(self, values: FloatArray) -> FloatArray:
        """Return the mean over each part, (m, ...), of values (n, ...)."""
        return np.asarray((self.sums(values).T / self.sizes).T)


def stretches(chosen: BoolArray) -> IntArray:
    """Return the first and one past the last sample of each run of chosen samples, (m, 2)."""
    edges = np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]]))
    return np.flatnonzero(edges).reshape(-1, 2)


def divided(used: BoolArray, length: int) -> Parts:
    """Divide the used samples, (n,), into parts of about `length`, if possible at least half."""
    start, end = stretches(used).T
    count = np.maximum(np.rint((end - start) / length), 1).astype(np.int_)
    before = np.cumsum(count) - count
    start, size, before, count = np.repeat([start, end - start, before, count], count, axis=1)
    number = np.arange(len(start)) - before
    cuts = [start + size * k // count for k in (number, number + 1)]
    return Parts(np.column_stack(cuts), float(length))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Memory:
    """Autocorrelation of noise, and its effect on the errors of k parameters."""

    inflation: FloatArray  # (k,) errors over errors for white noise, for intervals of 95 %
    far: FloatArray  # (k,) likewise for intervals of 99.6 %, for tests
    length: float  # most probable correlation time [samples]; 0: white noise
    ratio: float  # its variance relative to white noise

    def whitened(self, means: FloatArray, parts: Parts) -> FloatArray:
        """Return the innovations, (m,), of the means of noise over parts (Kalman filter)."""
        white = parts.length / parts.sizes
        if not self.length:
            return np.asarray(means / np.sqrt(white))
        found = np.empty(len(means))
        expected, variance, last = 0.0, self.ratio, -np.inf
        for k, (mean, own, at) in enumerate(
            zip(means.tolist(), white.tolist(), parts.centers.tolist(), strict=True)
        ):
            kept = exp((last - at) / self.length)
            expected *= kept
            variance = self.ratio + kept**2 * (variance - self.ratio)
            whole = variance + own
            found[k] = (mean - expected) / sqrt(whole)
            expected += variance / whole * (mean - expected)
            variance *= own / whole
            last = at
        return found


def memory_of(
    residual: FloatArray, regressors: FloatArray, influence: FloatArray, parts: Parts
) -> Memory:
    """Estimate the autocorrelation of noise from the residuals (n,); white with too few parts."""
    # Influence (n, k): change of each parameter by each sample; zero for unused samples.
    r, a = parts.means(residual), parts.sums(influence)
    x, strengths, _ = np.linalg.svd(parts.means(regressors), full_matrices=False)
    x = x[:, strengths > _ROUNDING * strengths[0]]
    m, k = x.shape
    free = m - k
    if free < 1 or not r.any():
        ones = np.ones(a.shape[1])
        return Memory(inflation=ones, far=ones, length=0.0, ratio=0.0)
    white, time = parts.length / parts.sizes, parts.centers
    plain = (a**2 * white[:, np.newaxis]).sum(axis=0)
    # In a long recording, the models are compared on a subset of the parts.
    some = _spread_out(m)
    own, both = white[some], np.column_stack([x, r])[some]
    weighed = both / own[:, np.newaxis]
    free = len(some) - k
    # Time and ratio; log|V|; (x, r)' V^-1 (x, r). Time 0: white, with a ratio of differences.
    models, sizes, products = [], [], []
    for ratio in (0.0, *_DIFFERENCES.tolist()):
        d, e, _ = dpttrf(own + ratio, _shared(time[some], parts.length) * ratio)
        models.append((0.0, ratio))
        sizes.append(float(np.log(d).sum()))
        products.append(both.T @ dpttrs(d, e, both)[0])
    longest = _LONGEST * max(float(time[-1] - time[0]), 1.0)
    for length in np.geomspace(0.5 * parts.length, longest, _TIMES):
        diagonal, beside, log_chain = precision(np.diff(time[some]), length)
        for ratio in _RATIOS.tolist():
            d, e, _ = dpttrf(diagonal / ratio + 1.0 / own, beside / ratio)
            models.append((float(length), ratio))
            sizes.append(sizes[0] + log_chain + len(some) * np.log(ratio) + float(np.log(d).sum()))
            products.append(products[0] - weighed.T @ dpttrs(d, e, weighed)[0])
    table = np.array(products)
    # Determinant of the whole = determinant of the block * residual sum of squares of r.
    within = np.linalg.slogdet(table[:, :k, :k])[1]
    left = np.exp(np.linalg.slogdet(table)[1] - within)
    logs = -0.5 * (np.array(sizes) + free * np.log(left) + within)
    few = 1 + len(_DIFFERENCES)
    logs[1:few] += np.log(_DIFFERENCED / _WHITE / len(_DIFFERENCES))
    logs[few:] += np.log((1.0 - _WHITE - _DIFFERENCED) / _WHITE / (len(logs) - few))
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    counts = np.flatnonzero(weights > _NEGLIGIBLE).tolist()
    # The diagonal of a' V a, of the included models.
    beside = (a[:-1] * a[1:] * _shared(time, parts.length)[:, np.newaxis]).sum(axis=0)
    spreads = {0.0: (a**2).sum(axis=0) + 2.0 * beside}
    deviations = []
    for k in counts:
        length, ratio = models[k]
        if length not in spreads:
            d, e, _ = dpttrf(*precision(np.diff(time), length)[:2])
            spreads[length] = (a * dpttrs(d, e, a)[0]).sum(axis=0)
        deviations.append(np.sqrt(left[k] / free * (plain + ratio * spreads[length])))
    length, ratio = models[int(np.argmax(weights))]
    white, found = np.sqrt(left[0] / free * plain), np.array(deviations)
    usual, far = (_growth(weights[counts], found, white, outside) for outside in (0.05, 0.004))
    return Memory(inflation=usual, far=far, length=length, ratio=ratio)


def _spread_out(count: int) -> IntArray:
    """Select runs of parts, evenly over a recording: for short and long correlation times."""
    if count <= _MOST_PARTS:
        return np.arange(count)
    starts = np.linspace(0, count - _RUN, _MOST_PARTS // _RUN).astype(np.int_)
    return np.asarray((starts[:, np.newaxis] + np.arange(_RUN)).ravel())


def _shared(time: FloatArray, length: float) -> FloatArray:
    """Return the covariance of differences in neighbors; zero across a gap."""
    return np.where(np.diff(time) < 1.5 * length, -0.5, 0.0)


def precision(gaps: FloatArray, length: float) -> tuple[FloatArray, FloatArray, float]:
    """Return diagonal, off-diagonal and log determinant of the inverse covariance of a chain."""
    kept, new = np.exp(-gaps / length), -np.expm1(-2.0 * gaps / length)
    diagonal = np.ones(len(gaps) + 1)
    diagonal[:-1] += kept**2 / new
    diagonal[1:] += kept**2 / new
    return diagonal, np.asarray(-kept / new), float(np.log(new).sum())


def _growth(
    weights: FloatArray, deviations: FloatArray, white: FloatArray, outside: float
) -> FloatArray:
    """Return the intervals of mixtures of normal distributions relative to white noise."""
    normal = float(ndtri(1.0 - 0.5 * outside))
    # A column of zeros has no error, and no growth.
    deviations, white = (np.where(white > 0.0, one, 1.0) for one in (deviations, white))
    low, high = (normal * limit(deviations, axis=0) for limit in (np.min, np.max))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        beyond = weights @ (2.0 * ndtr(-middle / deviations)) > outside * weights.sum()
        low, high = np.where(beyond, middle, low), np.where(beyond, high, middle)
    return np.asarray(high / (normal * white))
