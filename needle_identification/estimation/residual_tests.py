# SPDX-License-Identifier: Apache-2.0
"""Test the residuals of a fit, with validity for correlated noise."""

from dataclasses import dataclass
from typing import Final
import warnings

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.memory import Memory, Parts
import numpy as np
from scipy.special import chdtrc, fdtrc, stdtr

_FEWEST_PARTS: Final = 10  # smallest number of parts for any test
_FEWEST_FOR_MOMENTS: Final = 20  # smallest number of parts, else Shapiro and Wilk
_SIGNIFICANCE: Final = 0.0025  # 1 % of the recordings fail any of the four by chance

#: Result of each test in words, if failed and if passed.
_WORDS: Final = {
    'normality': (
        'the residuals are not normal: outliers change the estimates; consider estimator huber',
        'the residuals do not differ from normal noise',
    ),
    'trend': (
        'the residuals drift with time: the sensor or the tissue changed during the recording',
        'the residuals show no drift with time',
    ),
    'speed': (
        'the residuals depend on the speed: the terms do not describe the friction',
        'the residuals do not depend on the speed',
    ),
    'spread': (
        'the noise depends on the speed: consider estimator weighted',
        'the noise is the same at all speeds',
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualTest:
    """A test of the residuals of a fit."""

    name: str  #: ``normality``, ``trend``, ``speed`` or ``spread``
    statistic: float
    p_value: float  #: a small value is evidence against the model
    words: str  #: result in words

    @property
    def failed(self) -> bool:
        return self.p_value < _SIGNIFICANCE


def residual_tests(
    residual: FloatArray,
    *,
    time: FloatArray,
    velocity: FloatArray,
    parts: Parts,
    memory: Memory,
    parameters: int,
) -> tuple[ResidualTest, ...]:
    """Test the means of the residual over parts, whitened, hence nearly independent."""
    if len(parts.limits) < _FEWEST_PARTS:
        return ()
    means = memory.whitened(parts.means(residual), parts)
    velocities, times = parts.means(velocity), parts.means(time)
    groups = np.array_split(np.argsort(velocities), min(10, len(means) // 5))
    with np.errstate(invalid='ignore', divide='ignore'):
        found = {'normality': _normality(means), 'trend': _trend(times, means)}
        if len(groups) > parameters:
            by_speed = [means[group] for group in groups]
            found['speed'] = _f_test(by_speed, 0.0, parameters)
            # Levene's test about the median.
            off = [np.abs(group - np.median(group)) for group in by_speed]
            found['spread'] = _f_test(off, float(np.concatenate(off).mean()), 1)
    # Equal residuals give nan.
    return tuple(
        ResidualTest(name=name, statistic=statistic, p_value=p_value, words=_words(name, p_value))
        for name, (statistic, p_value) in found.items()
        if np.isfinite(p_value)
    )


def _words(name: str, p_value: float) -> str:
    failed, passed = _WORDS[name]
    return f'{failed if p_value < _SIGNIFICANCE else passed} (p = {p_value:.2g})'


def _normality(values: FloatArray) -> tuple[float, float]:
    """Test for a normal distribution by skewness and kurtosis (d'Agostino and Pearson)."""
    if len(values) < _FEWEST_FOR_MOMENTS:
        # Lazy import: large, and needed for short recordings only.
        from scipy.stats import shapiro

        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            found = shapiro(values)
        return float(found.statistic), float(found.pvalue)
    n, normalized = float(len(values)), (values - values.mean()) / values.std()
    skewness, kurtosis = (float((normalized**power).mean()) for power in (3, 4))
    found = float(_skewness_score(skewness, n) ** 2 + _kurtosis_score(kurtosis, n) ** 2)
    return found, float(chdtrc(2.0, found))


def _skewness_score(skewness: float, n: float) -> float:
    """Transform the skewness of n normal values to a standard normal variable (d'Agostino)."""
    y = skewness * np.sqrt(((n + 1) * (n + 3)) / (6.0 * (n - 2)))
    kurtosis = (3.0 * (n**2 + 27 * n - 70) * (n + 1) * (n + 3)) / (
        (n - 2.0) * (n + 5) * (n + 7) * (n + 9)
    )
    w = -1 + np.sqrt(2 * (kurtosis - 1))
    return float(np.arcsinh(y / np.sqrt(2.0 / (w - 1))) / np.sqrt(0.5 * np.log(w)))


def _kurtosis_score(kurtosis: float, n: float) -> float:
    """Transform the kurtosis of n normal values to a standard normal (Anscombe and Glynn)."""
    mean = 3.0 * (n - 1) / (n + 1)
    variance = 24.0 * n * (n - 2) * (n - 3) / ((n + 1) * (n + 1.0) * (n + 3) * (n + 5))
    x = (kurtosis - mean) / variance**0.5
    skewness = (
        6.0 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9))
        * ((6.0 * (n + 3) * (n + 5)) / (n * (n - 2) * (n - 3))) ** 0.5
    )  # fmt: skip
    a = 6.0 + 8.0 / skewness * (2.0 / skewness + (1 + 4.0 / skewness**2) ** 0.5)
    below = 1 + x * (2 / (a - 4.0)) ** 0.5
    root = np.sign(below) * ((1 - 2.0 / a) / np.abs(below)) ** (1 / 3)
    return float((1 - 2 / (9.0 * a) - root) / (2 / (9.0 * a)) ** 0.5)


def _trend(times: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Test for a monotonic relation (rank correlation of Spearman)."""
    rho = np.corrcoef(_ranks(times), _ranks(values))[1, 0]
    freedom = len(values) - 2
    t = rho * np.sqrt((freedom / ((rho + 1.0) * (1.0 - rho))).clip(0))
    return float(rho), float(2.0 * stdtr(freedom, -abs(t)))


def _ranks(values: FloatArray) -> FloatArray:
    """Rank values from 1; equal values have their mean rank."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2.0)[places])


def _f_test(groups: list[FloatArray], center: float, lost: int) -> tuple[float, float]:
    """Compare the means of groups about a center with the noise; lost: degrees of freedom."""
    between = sum(len(group) * (group.mean() - center) ** 2 for group in groups)
    within = sum(((group - group.mean()) ** 2).sum() for group in groups)
    free = len(groups) - lost, sum(map(len, groups)) - len(groups)
    found = float((between / free[0]) / (within / free[1]))
    return found, float(fdtrc(*free, found))
