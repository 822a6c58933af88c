"""Tests of what a model leaves of the response, valid although the noise is correlated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final
import warnings

from needle_dynamics import FloatArray
from needle_identification.estimation.regression import BoolArray, IntArray
import numpy as np
from scipy import stats

#: Fewest parts of the residual that are tested.
_FEWEST_PARTS: Final = 10

#: Probability below which a test speaks against the model.
_LEVEL: Final = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualTest:
    """
    A test of what the model leaves of the force, on parts as long as the noise remembers.

    Attributes
    ----------
    name : str
        ``normality``, ``trend``, ``speed``, ``spread`` or ``memory``.
    statistic, p_value : float
        Of the test; a small probability speaks against the model.
    words : str
        What it says.

    """

    name: str
    statistic: float
    p_value: float
    words: str

    @property
    def failed(self) -> bool:
        """Whether it speaks against the model, as the words say."""
        return self.p_value < _LEVEL


def residual_tests(
    residual: FloatArray,
    *,
    used: BoolArray,
    time: FloatArray,
    speed: FloatArray,
    length: int,
    parameters: int,
) -> tuple[ResidualTest, ...]:
    """
    Test means of the residual over parts as long as the noise remembers, which are independent.

    Parameters
    ----------
    residual, time, speed : ndarray, shape (n,)
        What the model leaves, when [s], and what it may depend on.
    used : ndarray of bool, shape (n,)
        Samples that were fitted; no part crosses one that was not.
    length : int
        Length of a part [samples].
    parameters : int
        Parameters that were fitted.

    Returns
    -------
    tuple of ResidualTest
        Those for which there are parts enough.

    """
    parts, follows = _parts(used, length)
    if len(parts) < _FEWEST_PARTS:
        return ()
    means, paces, times = (values[parts].mean(axis=1) for values in (residual, speed, time))
    groups = np.array_split(np.argsort(paces), min(10, len(parts) // 5))
    with warnings.catch_warnings(), np.errstate(invalid='ignore', divide='ignore'):
        # Of residuals that are all alike a test says nothing: nan.
        warnings.simplefilter('ignore')
        found = {
            'normality': stats.normaltest(means) if len(means) >= 20 else stats.shapiro(means),
            'trend': stats.spearmanr(times, means),
        }
        if len(groups) > parameters:
            found['speed'] = _lack_of_fit(means, groups, parameters)
            found['spread'] = stats.levene(*(means[g] for g in groups), center='median')
        if np.count_nonzero(follows) >= _FEWEST_PARTS:
            found['memory'] = stats.pearsonr(means[:-1][follows[1:]], means[follows])
    tests = [_judged(name, *result) for name, result in found.items()]
    return tuple(test for test in tests if np.isfinite(test.p_value))


def _parts(used: BoolArray, length: int) -> tuple[IntArray, BoolArray]:
    """Return indices of parts of runs, shape (m, length), and which follow their predecessor."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], used.astype(np.int8), [0]])))
    starts = [
        start + length * k
        for start, end in edges.reshape(-1, 2)
        for k in range((end - start) // length)
    ]
    first = np.array(starts, dtype=np.int_)
    follows = np.zeros(len(first), dtype=np.bool_)
    follows[1:] = np.diff(first) == length
    return first[:, np.newaxis] + np.arange(length), follows


#: What each test says against the model, and for it.
_WORDS: Final = {
    'normality': (
        (
            'the residuals are not normal: outliers move the estimates; the estimator huber '
            'minds them less'
        ),
        'the residuals are as good as normal',
    ),
    'trend': (
        'the residuals drift with time: sensor or tissue change during the recording',
        'the residuals show no drift with time',
    ),
    'speed': (
        'the residuals depend on the speed: the terms do not describe the friction',
        'the residuals do not depend on the speed',
    ),
    'spread': (
        'the noise depends on the speed: the estimator weighted uses that',
        'the noise is the same at all speeds',
    ),
    'memory': (
        'the residuals remember longer than the errors allow for: they are too small',
        'the residuals forget as fast as the errors assume',
    ),
}


def _judged(name: str, statistic: float, chance: float) -> ResidualTest:
    against, fine = _WORDS[name]
    return ResidualTest(
        name=name,
        statistic=float(statistic),
        p_value=float(chance),
        words=f'{against if chance < _LEVEL else fine} (p = {chance:.2g})',
    )


def _lack_of_fit(
    residual: FloatArray, groups: list[IntArray], parameters: int
) -> tuple[float, float]:
    """Compare misfit between speeds with noise within them: the F statistic, its probability."""
    between = sum(len(g) * float(residual[g].mean()) ** 2 for g in groups)
    within = sum(float(((residual[g] - residual[g].mean()) ** 2).sum()) for g in groups)
    free = len(groups) - parameters, len(residual) - len(groups)
    found = (between / free[0]) / (within / free[1])
    return found, float(stats.f.sf(found, *free))
