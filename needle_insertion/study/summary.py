"""What a table of samples says: probabilities, quantiles, and which quantity matters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import sqrt
from pathlib import Path
from typing import Final, NamedTuple

from needle_dynamics import FloatArray
import numpy as np
from pyarrow import parquet
from scipy.stats import binom

#: Half of an interval of 95 % over the standard deviation.
_NORMAL: Final = 1.96

#: Part of all intervals that lie above the true value, and below it.
_TAIL: Final = 0.025

#: Groups of samples by which a share of the variance is found, and the fewest samples.
_GROUPS, _FEWEST = 32, 200


class Estimate(NamedTuple):
    """
    A number with its interval of 95 %.

    Attributes
    ----------
    value, low, high : float
        The number, and the ends of the interval.
    samples : int
        Of how many samples it is.

    """

    value: float
    low: float
    high: float
    samples: int


def batches(table: Path, name: str) -> Iterator[FloatArray]:
    """
    Read one column of a table of samples, part by part.

    Parameters
    ----------
    table : Path
        Parquet file.
    name : str
        Its name.

    Yields
    ------
    ndarray, shape (k,)
        The next values, by number of the sample.

    """
    with parquet.ParquetFile(table) as file:
        for batch in file.iter_batches(columns=[name], use_threads=False):
            yield batch.column(0).to_numpy(zero_copy_only=False)


def column(table: Path, name: str, most: int | None = None) -> FloatArray:
    """
    Read one column of a table of samples.

    Parameters
    ----------
    table, name
        As for `batches`.
    most : int, optional
        How many values at most; all if not given.

    Returns
    -------
    ndarray, shape (samples,) or (most,)
        The first values, by number of the sample.

    """
    found, size = list[FloatArray](), 0
    for values in batches(table, name):
        found.append(values)
        size += len(values)
        if most is not None and size >= most:
            break
    return np.concatenate(found)[:most]


def picked(table: Path, name: str, numbers: Sequence[int]) -> FloatArray:
    """
    Read some values of a column of a table of samples.

    Parameters
    ----------
    table, name
        As for `batches`.
    numbers : sequence of int
        Numbers of the samples.

    Returns
    -------
    ndarray, shape (k,)
        Their values.

    """
    wanted, found, first = np.array(numbers, dtype=np.int64), np.empty(len(numbers)), 0
    for values in batches(table, name):
        here = (first <= wanted) & (wanted < first + len(values))
        found[here] = values[wanted[here] - first]
        first += len(values)
    return found


def probability(parts: Iterable[FloatArray]) -> Estimate:
    """
    Return how often something is so.

    Parameters
    ----------
    parts : iterable of ndarray, shape (k,)
        Values: 1 where it is, 0 where it is not, nan where that does not exist.

    Returns
    -------
    Estimate
        With the interval of Wilson, which also holds near 0 and 1.

    """
    n, yes = 0, 0.0
    for values in parts:
        seen = values[np.isfinite(values)]
        n, yes = n + len(seen), yes + float(seen.sum())
    if n == 0:
        return Estimate(np.nan, 0.0, 1.0, 0)
    p, z = yes / n, _NORMAL
    middle = (p + z * z / (2 * n)) / (1.0 + z * z / n)
    half = z / (1.0 + z * z / n) * sqrt(p * (1.0 - p) / n + z * z / (4 * n * n))
    return Estimate(p, max(0.0, middle - half), min(1.0, middle + half), n)


def quantile(values: FloatArray, part: float) -> Estimate:
    """
    Return the value below which a part of all are.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Values; nan does not count.
    part : float
        The part.

    Returns
    -------
    Estimate
        With an interval between two of the values, whatever the distribution; an end is infinite
        where there are too few of them.

    """
    seen = np.sort(values[np.isfinite(values)])
    n = len(seen)
    if n == 0:
        return Estimate(np.nan, -np.inf, np.inf, 0)
    # Ranks, from 1: the true value is below that of the first, and above that of the second, once
    # in 40 studies each.
    low, high = (int(binom.ppf(tail, n, part)) for tail in (_TAIL, 1.0 - _TAIL))
    return Estimate(
        float(np.quantile(seen, part)),
        float(seen[low - 1]) if low >= 1 else -np.inf,
        float(seen[high]) if high < n else np.inf,
        n,
    )


def share(values: FloatArray, by: FloatArray) -> float:
    """
    Return the part of a variance that one quantity alone explains.

    Parameters
    ----------
    values : ndarray, shape (n,)
        A figure; nan does not count.
    by : ndarray, shape (n,)
        The quantity.

    Returns
    -------
    float
        First-order index of Sobol, from means of equal groups, less what chance would give; nan
        of fewer than 200 samples, where chance is most of it.

    """
    seen = np.isfinite(values)
    y = values[seen][np.argsort(by[seen], kind='stable')]
    if len(y) < _FEWEST:
        return float('nan')
    if np.ptp(y) == 0.0 or np.ptp(by[seen]) == 0.0:
        return 0.0
    means = [(len(one), one.mean()) for one in np.array_split(y, _GROUPS)]
    between = sum(n * (mean - y.mean()) ** 2 for n, mean in means) / (len(y) * y.var())
    chance = (_GROUPS - 1) / (len(y) - 1)
    return float(max(0.0, (between - chance) / (1.0 - chance)))


def worst(parts: Iterable[FloatArray], number: int) -> list[int]:
    """
    Return the samples with the largest values.

    Parameters
    ----------
    parts : iterable of ndarray, shape (k,)
        Values, by number of the sample; nan does not count.
    number : int
        How many.

    Returns
    -------
    list of int
        Their numbers, the worst first.

    """
    top, numbers, first = np.empty(0), np.empty(0, dtype=np.int64), 0
    for values in parts:
        top = np.concatenate([top, np.where(np.isfinite(values), values, -np.inf)])
        numbers = np.concatenate([numbers, np.arange(first, first + len(values))])
        best = np.argsort(-top, kind='stable')[:number]
        top, numbers, first = top[best], numbers[best], first + len(values)
    return [int(number) for number in numbers[np.isfinite(top)]]
