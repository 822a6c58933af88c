"""What a table of samples says: probabilities, quantiles, and which quantity matters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import ceil, floor, sqrt
from pathlib import Path
from typing import Final, NamedTuple

from needle_dynamics import FloatArray
import numpy as np
from pyarrow import parquet

#: Half of an interval of 95 % over the standard deviation.
_NORMAL: Final = 1.96

#: Groups of samples by which a share of the variance is found.
_GROUPS: Final = 32


class Estimate(NamedTuple):
    """
    A number with its interval of 95 %.

    Attributes
    ----------
    value, low, high : float
        The number, and the ends of the interval.

    """

    value: float
    low: float
    high: float


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
        return Estimate(np.nan, 0.0, 1.0)
    p, z = yes / n, _NORMAL
    middle = (p + z * z / (2 * n)) / (1.0 + z * z / n)
    half = z / (1.0 + z * z / n) * sqrt(p * (1.0 - p) / n + z * z / (4 * n * n))
    return Estimate(p, max(0.0, middle - half), min(1.0, middle + half))


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
        With an interval between two of the values, whatever the distribution.

    """
    seen = np.sort(values[np.isfinite(values)])
    n = len(seen)
    if n == 0:
        return Estimate(np.nan, np.nan, np.nan)
    half = _NORMAL * sqrt(n * part * (1.0 - part))
    low, high = max(0, floor(n * part - half) - 1), min(n - 1, ceil(n * part + half))
    return Estimate(float(np.quantile(seen, part)), float(seen[low]), float(seen[high]))


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
        First-order index of Sobol, from means of equal groups, less what chance would give.

    """
    seen = np.isfinite(values)
    y = values[seen][np.argsort(by[seen], kind='stable')]
    groups = min(_GROUPS, len(y) // 2)
    if groups < 2 or y.var() == 0.0 or np.ptp(by[seen]) == 0.0:
        return 0.0
    means = [(len(one), one.mean()) for one in np.array_split(y, groups)]
    between = sum(n * (mean - y.mean()) ** 2 for n, mean in means) / (len(y) * y.var())
    chance = (groups - 1) / (len(y) - 1)
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
