# SPDX-License-Identifier: Apache-2.0
"""
Evaluate a table of samples: probabilities, quantiles, and sensitivity to each variable.

The interval of a probability is by the method of Wilson, with the number of independent samples
that has the variance between the replicates of the design [Korn1998]_. Sobol' indices are
correlations of samples that have variables in common [Janon2014]_.

References
----------
.. [Janon2014] A. Janon et al., "Asymptotic normality and efficiency of two Sobol index
   estimators", ESAIM: Probability and Statistics 18, 2014.
.. [Korn1998] E. L. Korn, B. I. Graubard, "Confidence intervals for proportions with small expected
   number of positive counts estimated from survey data", Survey Methodology 24, 1998.

"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import sqrt
from pathlib import Path
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_ros.quantities import NORMAL
from needle_study.designs import RandomDesign, REPLICATES, SaltelliDesign
from needle_study.study import dimensions, Study
import numpy as np
from scipy.special import stdtrit
from scipy.stats import binom

_TAIL: Final = 0.025  #: probability of an interval above the true value, and below it

#: Groups of samples in the estimate of a variance fraction, and the least number of samples.
_GROUPS, _FEWEST = 32, 200

_ENOUGH: Final = 2.0  #: least number of samples of a replicate on each side of a quantile

#: Name of the noise among the variables.
NOISE: Final = 'noise'


class Estimate(NamedTuple):
    """A value with its 95 % interval, from a number of samples."""

    value: float
    low: float
    high: float
    samples: int


class Indices(NamedTuple):
    """Fractions of a variance that vary with one variable."""

    first: Estimate  #: explained by the variable alone
    total: Estimate | None = None  #: with its interactions; None if not estimated


def batches(table: Path, name: str) -> Iterator[FloatArray]:
    """Yield the values of one column of a table by sample number, in batches of shape (k,)."""
    # Takes long to import, and a table in memory does not need it.
    from pyarrow import parquet

    with parquet.ParquetFile(table) as file:
        for batch in file.iter_batches(columns=[name], use_threads=False):
            yield batch.column(0).to_numpy(zero_copy_only=False)


def column(table: Path, name: str, most: int | None = None) -> FloatArray:
    found, size = list[FloatArray](), 0
    for values in batches(table, name):
        found.append(values)
        size += len(values)
        if most is not None and size >= most:
            break
    return np.concatenate(found)[:most]


def picked(table: Path, name: str, numbers: Sequence[int]) -> FloatArray:
    """Read the values of one column for some sample numbers."""
    wanted, found, first = np.array(numbers, dtype=np.int64), np.empty(len(numbers)), 0
    for values in batches(table, name):
        here = (first <= wanted) & (wanted < first + len(values))
        found[here] = values[wanted[here] - first]
        first += len(values)
    return found


def probability(parts: Iterable[FloatArray], design: RandomDesign | None = None) -> Estimate:
    """
    Estimate the fraction of ones among 1 and 0, with the interval of Wilson [Wilson1927]_.

    Parameters
    ----------
    parts : iterable of array, shape (n,)
        Values 1 and 0 in parts; NaN is ignored.
    design : RandomDesign, optional
        Its replicates give the number of independent samples that have the same variance.

    References
    ----------
    .. [Wilson1927] E. B. Wilson, "Probable inference, the law of succession, and statistical
       inference", Journal of the American Statistical Association 22(158), 1927.

    """
    sums = np.zeros((2, max(1, design.replicates if design else 0)))
    first = 0
    for values in parts:
        finite = np.isfinite(values)
        sums += _sums(values[finite], np.flatnonzero(finite) + first, design, sums.shape[1])
        first += len(values)
    n, yes = sums.sum(axis=1).tolist()
    if n == 0:
        return Estimate(np.nan, 0.0, 1.0, 0)
    p, size, z = yes / n, _size(sums), NORMAL
    middle = (p + z * z / (2 * size)) / (1.0 + z * z / size)
    half = z / (1.0 + z * z / size) * sqrt(p * (1.0 - p) / size + z * z / (4 * size * size))
    return Estimate(p, max(0.0, middle - half), min(1.0, middle + half), int(n))


def _sums(
    values: FloatArray, numbers: IntArray, design: RandomDesign | None, replicates: int
) -> FloatArray:
    """Return number and sum of the values of each replicate, shape (2, replicates)."""
    at = design.replicate(numbers) if design and replicates > 1 else np.zeros_like(numbers)
    return np.array([np.bincount(at, one, replicates) for one in (np.ones(len(values)), values)])


def _size(sums: FloatArray) -> float:
    """Return the number of independent samples with the same interval, by number and sum."""
    n, yes = sums
    count, p = len(n), float(yes.sum() / n.sum())
    if count == 1:
        return float(n.sum())
    apart = yes - p * n
    variance = count / (count - 1) * float(apart @ apart) / float(n.sum()) ** 2
    if variance == 0.0 or not n.all():
        return float(n.sum())
    # The variance has an error: Student's distribution.
    wider = float(stdtrit(count - 1, 1.0 - _TAIL)) / NORMAL
    return p * (1.0 - p) / (variance * wider**2)


def quantile(values: FloatArray, part: float, design: RandomDesign | None = None) -> Estimate:
    """
    Estimate a quantile, with an interval by ranks.

    With replicates that have enough samples, the interval has the values for which the fractions
    of the replicates below do not deviate from ``part``, by their scatter and Student's
    distribution: the fractions have no bias, unlike the quantiles of few samples.

    Parameters
    ----------
    values : array, shape (n,)
        Values; NaN is ignored.
    part : float
        Fraction of the values below the quantile, in (0, 1).
    design : RandomDesign, optional
        As for `probability`.
    """
    known = np.flatnonzero(np.isfinite(values))
    finite = np.sort(values[known])
    n = len(finite)
    if n == 0:
        return Estimate(np.nan, -np.inf, np.inf, 0)
    value = float(np.quantile(finite, part))
    size = n
    if design and design.replicates:
        of = design.replicate(known[np.argsort(values[known], kind='stable')])
        numbers = np.bincount(of, minlength=design.replicates)
        if numbers.min() * min(part, 1.0 - part) >= _ENOUGH:
            low, high = _ranks(of, numbers, part)
            return Estimate(value, float(finite[low - 1]), float(finite[high]), n)
        below = (values[known] <= value).astype(np.float64)
        size = max(1, round(_size(_sums(below, known, design, design.replicates))))
    # Ranks, from 1: the true value is below the first, and above the second, in one of 40 studies
    # each.
    tails = (_TAIL, 1.0 - _TAIL)
    low, high = (int(binom.ppf(tail, size, part) * n / size) for tail in tails)
    return Estimate(
        value,
        float(finite[low - 1]) if low >= 1 else -np.inf,
        float(finite[high]) if high < n else np.inf,
        n,
    )


def _ranks(of: IntArray, numbers: IntArray, part: float) -> tuple[int, int]:
    """
    Return the ranks of the ends of an interval, below and above it.

    ``of`` has the replicate of each value in rising order, ``numbers`` the values of each.
    """
    n, count = len(of), len(numbers)
    # Number of smaller values of the same replicate.
    smaller, order = np.empty(n), np.argsort(of, kind='stable')
    smaller[order] = np.arange(n) - np.repeat(np.cumsum(numbers) - numbers, numbers)
    each = 1.0 / numbers[of]
    # Of the fractions of the replicates below a value: mean, mean square and variance of the mean.
    mean = np.cumsum(each) / count
    square = np.cumsum((2.0 * smaller + 1.0) * each**2) / count
    variance = np.maximum(square - mean**2, 0.0) / (count - 1)
    most = float(stdtrit(count - 1, 1.0 - _TAIL)) * np.sqrt(variance)
    inside = 1 + np.flatnonzero(np.abs(mean - part) <= most)
    # Without scatter, as of the median of one variable, the ends are next to the estimate.
    middle = np.array([int(n * part), int(n * part) + 1])
    inside = np.concatenate([inside[inside < n], middle])
    return int(inside.min()), int(inside.max())


def indices(
    values: FloatArray, columns: Mapping[str, FloatArray], study: Study
) -> dict[str, Indices]:
    """
    Estimate the Sobol' indices of each variable, by variable; empty for fewer than 200 samples.

    The groups of a design `saltelli` also have the index of the noise, total indices, and for all
    variables of a table one index, by its name. For other designs the samples are grouped by each
    variable. The intervals are of the jackknife over the replicates, or over as many parts; they
    are [0, 1] if the values without one of these are constant.
    """
    if np.count_nonzero(np.isfinite(values)) < _FEWEST:
        return {}
    if isinstance(study.design, SaltelliDesign):
        return _grouped(values, dimensions(study.population), study.design)
    parts = study.design.replicate(np.arange(len(values))) % REPLICATES
    return {name: Indices(_sorted(values, one, parts)) for name, one in columns.items()}


def _grouped(
    values: FloatArray, names: Sequence[str], design: SaltelliDesign
) -> dict[str, Indices]:
    """Correlate the samples of the groups that share a variable, or all other variables."""
    count = len(values) // design.group
    groups = values[: count * design.group].reshape(count, design.group).T
    kept = np.isfinite(groups).all(axis=0)
    replicates = (np.arange(count) % REPLICATES)[kept]
    first, second, *others = groups[:, kept]
    if not np.ptp(groups[:, kept]):
        none = Estimate(0.0, 0.0, 0.0, len(first))
        return dict.fromkeys((NOISE, *names), Indices(none, none))

    def estimate(one: FloatArray, other: FloatArray, sign: float) -> Estimate:
        powers = (one * other, 0.5 * (one**2 + other**2), 0.5 * (one + other), np.ones(len(one)))
        sums = np.array([np.bincount(replicates, power, REPLICATES) for power in powers])

        def index(sums: FloatArray) -> float:
            product, square, mean = sums[:3] / sums[3]
            variance = square - mean**2
            same = (product - mean**2) / variance if variance > 0.0 else np.nan
            return float(same if sign > 0.0 else 1.0 - same)

        total = sums.sum(axis=1)
        return _jackknife(index(total), [index(total - one) for one in sums.T], int(total[3]))

    return {
        name: Indices(estimate(second, other, 1.0), estimate(first, other, -1.0))
        for name, other in zip((NOISE, *names), others, strict=True)
    }


def _jackknife(value: float, without: Sequence[float], samples: int) -> Estimate:
    """Return a value, NaN as 0, with the interval of its values without each replicate."""
    count = len(without)
    if not np.isfinite([value, *without]).all():
        # All variance may be of one replicate, as of a single event.
        return Estimate(min(max(0.0, value), 1.0), 0.0, 1.0, samples)
    error = sqrt((count - 1) / count * float(np.sum((np.array(without) - np.mean(without)) ** 2)))
    half = float(stdtrit(count - 1, 1.0 - _TAIL)) * error
    # A fraction: also of an estimate with an error.
    value, low, high = (min(max(0.0, one), 1.0) for one in (value, value - half, value + half))
    return Estimate(value, low, high, samples)


def _sorted(values: FloatArray, by: FloatArray, parts: IntArray) -> Estimate:
    """Estimate a first-order index from the means over ranges of a variable."""
    finite = np.isfinite(values)
    y, by, parts = values[finite], by[finite], parts[finite]
    if np.ptp(y) == 0.0 or np.ptp(by) == 0.0:
        return Estimate(0.0, 0.0, 0.0, len(y))

    def index(kept: BoolArray) -> float:
        y_, by_ = y[kept], by[kept]
        if np.ptp(y_) == 0.0:
            return np.nan
        groups = np.array_split(y_[np.argsort(by_, kind='stable')], _GROUPS)
        between = sum(len(one) * (one.mean() - y_.mean()) ** 2 for one in groups)
        between /= len(y_) * y_.var()
        by_chance = (_GROUPS - 1) / (len(y_) - 1)
        return float((between - by_chance) / (1.0 - by_chance))

    without = [index(parts != part) for part in range(REPLICATES)]
    return _jackknife(index(np.ones(len(y), dtype=np.bool_)), without, len(y))


def worst(parts: Iterable[FloatArray], number: int) -> list[int]:
    """Return the sample numbers of the largest values, the largest first; NaN is ignored."""
    top, numbers, first = np.empty(0), np.empty(0, dtype=np.int64), 0
    for values in parts:
        top = np.concatenate([top, np.where(np.isfinite(values), values, -np.inf)])
        numbers = np.concatenate([numbers, np.arange(first, first + len(values))])
        best = np.argsort(-top, kind='stable')[:number]
        top, numbers, first = top[best], numbers[best], first + len(values)
    return [int(number) for number in numbers[np.isfinite(top)]]
