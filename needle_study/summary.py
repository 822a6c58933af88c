# SPDX-License-Identifier: Apache-2.0
"""Evaluate a table of samples: probabilities, quantiles, and sensitivity to each variable."""

from collections.abc import Iterable, Iterator, Sequence
from math import sqrt
from pathlib import Path
from typing import Final, NamedTuple

from needle_dynamics import FloatArray
import numpy as np
from scipy.stats import binom

_NORMAL: Final = 1.96  #: half-width of a 95 % interval over the standard deviation
_TAIL: Final = 0.025  #: probability of an interval above the true value, and below it

#: Groups of samples in the estimate of a variance fraction, and the least number of samples.
_GROUPS, _FEWEST = 32, 200


class Estimate(NamedTuple):
    """A value with its 95 % interval, from a number of samples."""

    value: float
    low: float
    high: float
    samples: int


def batches(table: Path, name: str) -> Iterator[FloatArray]:
    """Yield the values of one column of a table by sample number, in batches of shape (k,)."""
    # Takes long to import, and a table in memory does not need it.
    from pyarrow import parquet

    with parquet.ParquetFile(table) as file:
        for batch in file.iter_batches(columns=[name], use_threads=False):
            yield batch.column(0).to_numpy(zero_copy_only=False)


def column(table: Path, name: str, most: int | None = None) -> FloatArray:
    """Read one column of a table, up to `most` values."""
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


def probability(parts: Iterable[FloatArray]) -> Estimate:
    """Estimate the fraction of ones among 1 and 0, with the interval of Wilson; NaN is ignored."""
    n, yes = 0, 0.0
    for values in parts:
        finite = values[np.isfinite(values)]
        n, yes = n + len(finite), yes + float(finite.sum())
    if n == 0:
        return Estimate(np.nan, 0.0, 1.0, 0)
    p, z = yes / n, _NORMAL
    middle = (p + z * z / (2 * n)) / (1.0 + z * z / n)
    half = z / (1.0 + z * z / n) * sqrt(p * (1.0 - p) / n + z * z / (4 * n * n))
    return Estimate(p, max(0.0, middle - half), min(1.0, middle + half), n)


def quantile(values: FloatArray, part: float) -> Estimate:
    """Estimate the quantile below which a part of the values is; NaN is ignored."""
    finite = np.sort(values[np.isfinite(values)])
    n = len(finite)
    if n == 0:
        return Estimate(np.nan, -np.inf, np.inf, 0)
    # Ranks, from 1: the true value is below the first, and above the second, in one of 40 studies
    # each.
    low, high = (int(binom.ppf(tail, n, part)) for tail in (_TAIL, 1.0 - _TAIL))
    return Estimate(
        float(np.quantile(finite, part)),
        float(finite[low - 1]) if low >= 1 else -np.inf,
        float(finite[high]) if high < n else np.inf,
        n,
    )


def share(values: FloatArray, by: FloatArray) -> float:
    """Return the first-order Sobol index of a variable; NaN for fewer than 200 samples."""
    finite = np.isfinite(values)
    y = values[finite][np.argsort(by[finite], kind='stable')]
    if len(y) < _FEWEST:
        return float('nan')
    if np.ptp(y) == 0.0 or np.ptp(by[finite]) == 0.0:
        return 0.0
    means = [(len(one), one.mean()) for one in np.array_split(y, _GROUPS)]
    between = sum(n * (mean - y.mean()) ** 2 for n, mean in means) / (len(y) * y.var())
    by_chance = (_GROUPS - 1) / (len(y) - 1)
    return float(max(0.0, (between - by_chance) / (1.0 - by_chance)))


def worst(parts: Iterable[FloatArray], number: int) -> list[int]:
    """Return the sample numbers of the largest values, the largest first; NaN is ignored."""
    top, numbers, first = np.empty(0), np.empty(0, dtype=np.int64), 0
    for values in parts:
        top = np.concatenate([top, np.where(np.isfinite(values), values, -np.inf)])
        numbers = np.concatenate([numbers, np.arange(first, first + len(values))])
        best = np.argsort(-top, kind='stable')[:number]
        top, numbers, first = top[best], numbers[best], first + len(values)
    return [int(number) for number in numbers[np.isfinite(top)]]
