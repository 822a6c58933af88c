# SPDX-License-Identifier: Apache-2.0
r"""
Likelihood of white and slow noise at any sampling times, and fraction of lost samples.

The errors of each axis are a bias, terms of the delay and of the position, white noise of
deviation s, and an Ornstein-Uhlenbeck process of deviation :math:`s \sqrt g` and correlation time
tau. At any sampling times, the inverse covariance matrix Q of this process is tridiagonal
[Rue2005]_, so that

.. math:: (I + g Q^{-1})^{-1} = I - g (Q + g I)^{-1}, \qquad
   \log |I + g Q^{-1}| = \log |Q + g I| - \log |Q|

take a time that is proportional to the number of samples. The likelihood is restricted, as in
`needle_identification.estimation.memory`: bias and delay are integrated out. The variance of the
white noise has its most probable value for each g and tau.

References
----------
.. [Rue2005] H. Rue, L. Held, "Gaussian Markov Random Fields", Chapman & Hall, 2005.

"""

from itertools import product
from math import exp, inf, log, log1p, nan, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import estimated, ParameterEstimate
from needle_identification.estimation.memory import precision
from needle_ros.quantities import NORMAL
import numpy as np
from scipy.linalg.lapack import dpttrf, dpttrs
from scipy.optimize import minimize
from scipy.special import betaincinv

#: Grid of the search: variances of slow over white noise, and number of correlation times.
RATIOS: Final = (1e-4, 1e6)
_RATIOS: Final = np.geomspace(*RATIOS, 9)
_TIMES: Final = 9

#: Twice the gain of the log likelihood above which noise is not white. Of 1000 recordings with
#: white noise, five have a larger gain (chi-squared, two constants).
_SLOW: Final = 10.6

_STEP: Final = 0.02  # step of the logarithms for a curvature

_REGULAR: Final = 0.25  # largest deviation of a step from a multiple of the period [periods]
_IRREGULAR: Final = 0.05  # largest fraction of steps beyond it
_BURSTS: Final = 2.6  # memory of losses that are not independent [standard errors]
_NO_BURSTS: Final = ParameterEstimate(name='dropout_time', symbol='T', unit='s')


class NoiseFit(NamedTuple):
    """Noise of k axes, with the constants of the mean: k biases, and those of the regressors."""

    constants: FloatArray  #: biases [m], p of the slopes [s], and m of each axis [1]
    covariance: FloatArray  #: of the constants, for known noise
    log_noise: float  #: logarithm of the deviation of the white noise [m]
    log_ratio: float  #: logarithm of the variance of slow over white noise; -inf: white
    log_time: float  #: logarithm of the correlation time [s]
    deviance: float  #: -2 log restricted likelihood
    freedom: int  #: values less constants
    information: float  #: number of independent samples with the same information on the bias
    spread: FloatArray = np.full((3, 3), np.nan)  #: covariance of the logarithms


class NoiseLikelihood:
    """Likelihood of errors (n, k) [m] of a sensor at times (n,) [s]."""

    def __init__(
        self,
        time: FloatArray,
        errors: FloatArray,
        slopes: FloatArray | None,
        regressors: FloatArray | None = None,
    ) -> None:
        """Slopes, (n, k) or (p, n, k), have one constant; regressors (n, m) one on each axis."""
        self._steps, k = np.diff(time), errors.shape[1]
        shared = np.reshape([] if slopes is None else slopes, (-1, *errors.shape))
        own = np.empty((len(time), 0)) if regressors is None else regressors
        ones, p, m = np.ones((len(time), 1)), len(shared), own.shape[1]
        self._columns = np.asfortranarray(np.hstack([ones, errors, *shared, own]))
        #: Column of each constant by axis; the last one, of zeros, if it has none.
        self._places = np.full((k, k + p + k * m), -1)
        for axis, places in enumerate(self._places):
            places[axis] = 0
            places[k : k + p] = 1 + k + k * np.arange(p) + axis
            places[k + p + axis * m : k + p + (axis + 1) * m] = 1 + k + k * p + np.arange(m)
        step, span = float(np.median(self._steps)), float(time[-1] - time[0])
        #: Correlation times that differ from white noise and from a drift.
        self.times = step, span

    def fit(self, log_ratio: float, log_time: float) -> NoiseFit:
        """Fit bias, delay and white noise for a ratio of variances and a correlation time."""
        gram, logarithm = self._products(exp(log_ratio), exp(log_time))
        k, size = self._places.shape
        one, errors = gram[0, 0], gram[1 : k + 1, 1 : k + 1]
        normal, right = self._normal(gram)
        inverse = np.linalg.inv(normal)
        constants = inverse @ right
        freedom = k * len(self._columns) - size
        squares = max(float(np.trace(errors) - right @ constants), 1e-300)
        variance = squares / freedom
        deviance = freedom * log(variance) + k * logarithm + np.linalg.slogdet(normal)[1]
        covariance, information = variance * inverse, float(one * (1.0 + exp(log_ratio)))
        logarithms = 0.5 * log(variance), log_ratio, log_time
        return NoiseFit(constants, covariance, *logarithms, float(deviance), freedom, information)

    def _normal(self, gram: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return matrix and right side of the normal equations from the products."""
        padded = np.pad(gram, (0, 1))
        normal = sum(padded[np.ix_(places, places)] for places in self._places)
        right = sum(padded[places, 1 + axis] for axis, places in enumerate(self._places))
        return np.asarray(normal), np.asarray(right)

    def condition(self) -> float:
        """Return the condition number of the normal equations, each constant scaled."""
        normal, _ = self._normal(self._columns.T @ self._columns)
        size = np.sqrt(np.diag(normal))
        return float(np.linalg.cond(normal / np.outer(size, size))) if size.all() else inf

    def best(self) -> NoiseFit:
        """Return the most probable noise; white unless slow noise is significant."""
        white = self.fit(-inf, 0.0)
        low, high = map(log, self.times)
        grid = product(np.log(_RATIOS), np.linspace(low, high, _TIMES))
        start = min((self.fit(*at) for at in grid), key=lambda one: one.deviance)
        bounds = tuple(map(log, RATIOS)), (low, high)
        found = minimize(
            lambda at: self.fit(*at.tolist()).deviance,
            [start.log_ratio, start.log_time],
            method='Nelder-Mead',
            bounds=bounds,
            options={'xatol': 1e-3, 'fatol': 1e-4},
        )
        slow = self.fit(*found.x.tolist())
        best = white if white.deviance - slow.deviance < _SLOW else slow
        return best._replace(spread=self._spread(best))

    def _spread(self, at: NoiseFit) -> FloatArray:
        """Return the covariance of the logarithms of white deviation, ratio and time."""
        own = np.diag([0.5 / at.freedom, 0.0, 0.0])
        if at.log_ratio == -inf:
            return own
        here = np.array([at.log_ratio, at.log_time])
        offsets = _STEP * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]])
        fits = [self.fit(*(here + offset).tolist()) for offset in offsets]
        d, middle = [one.deviance for one in fits], at.deviance
        ratio, time = d[0] + d[1] - 2.0 * middle, d[2] + d[3] - 2.0 * middle
        mixed = 0.5 * (d[4] + d[5] - 2.0 * middle - ratio - time)
        curvature = np.array([[ratio, mixed], [mixed, time]]) / _STEP**2
        if np.linalg.eigvalsh(curvature)[0] <= 0.0:
            return np.full((3, 3), np.inf)
        spread = 2.0 * np.linalg.inv(curvature)
        slopes = [fits[0].log_noise - fits[1].log_noise, fits[2].log_noise - fits[3].log_noise]
        jacobian = np.vstack([np.array(slopes) / (2.0 * _STEP), np.eye(2)])
        return np.asarray(own + jacobian @ spread @ jacobian.T)

    def _products(self, ratio: float, time: float) -> tuple[FloatArray, float]:
        """Return the weighted products of all columns, and the logarithm of the determinant."""
        columns = self._columns
        if not ratio:
            return columns.T @ columns, 0.0
        diagonal, beside, log_chain = precision(self._steps, time)
        d, e, _ = dpttrf(diagonal + ratio, beside)
        solved, _ = dpttrs(d, e, columns)
        logarithm = float(np.log(d).sum()) + log_chain
        return columns.T @ (columns - ratio * solved), logarithm


def log_interval(log_value: float, variance: float) -> tuple[float, float]:
    """Return the 95 % interval of a positive value from its logarithm."""
    half = NORMAL * sqrt(variance)
    return exp(log_value - half), exp(log_value + half)


def binomial_interval(count: int, total: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a probability (Clopper and Pearson 1934)."""
    low = float(betaincinv(count, total - count + 1, 0.025)) if count else 0.0
    high = float(betaincinv(count + 1, total - count, 0.975)) if count < total else 1.0
    return low, high


def fit_losses(time: FloatArray) -> tuple[ParameterEstimate, ParameterEstimate]:
    """Return the fraction of lost samples and the duration of a burst, at times [s], (n,)."""
    # A Markov process; nan without a regular period, and no duration for independent losses.
    steps = np.diff(time)
    period = float(np.median(steps))
    # Drift of the clocks does not add up, since each step is rounded by itself.
    each = np.maximum(np.rint(steps / period), 1.0)
    if np.mean(np.abs(steps / period - each) > _REGULAR) > _IRREGULAR:
        return _dropout(nan, inf, (-inf, inf)), _NO_BURSTS
    bursts, lost = int(np.count_nonzero(each > 1.0)), int(each.sum()) - len(steps)
    total = len(time) + lost
    if not bursts:
        return _dropout(0.0, 1.0 / total, binomial_interval(0, total)), _NO_BURSTS
    # Transitions from received and from lost samples: a burst ends once.
    begin, end = bursts / len(steps), bursts / lost
    fraction, kept = begin / (begin + end), 1.0 - begin - end
    variance = begin * (1.0 - begin) / len(steps), end * (1.0 - end) / lost
    error = fraction * sqrt(
        ((1.0 - fraction) ** 2) * (variance[0] / begin**2 + variance[1] / end**2)
    )
    if kept <= _BURSTS * sqrt(sum(variance)):
        fraction = lost / total
        error = sqrt(fraction * (1.0 - fraction) / total)
        return _dropout(fraction, error, binomial_interval(lost, total)), _NO_BURSTS
    # The logit of a fraction is nearly normal.
    logit, half = log(fraction) - log1p(-fraction), NORMAL * error / (fraction * (1.0 - fraction))
    low, high = (1.0 / (1.0 + exp(-at)) for at in (logit - half, logit + half))
    duration = -period / ((1.0 - fraction) * log(kept))
    # Derivatives of the logarithm of the duration.
    whole = (begin + end) ** 2
    by_begin = end / whole / (1.0 - fraction) + 1.0 / (kept * log(kept))
    by_end = -begin / whole / (1.0 - fraction) + 1.0 / (kept * log(kept))
    log_error = sqrt(by_begin**2 * variance[0] + by_end**2 * variance[1])
    ends = duration * exp(-NORMAL * log_error), duration * exp(NORMAL * log_error)
    burst = estimated('dropout_time', 'T', 's', duration, duration * log_error, ends)
    return _dropout(fraction, error, (low, high)), burst


def _dropout(value: float, error: float, interval: tuple[float, float]) -> ParameterEstimate:
    return estimated('dropout', 'p', '1', value, error, interval)
