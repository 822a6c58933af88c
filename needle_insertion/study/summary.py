"""What a table of samples says: probabilities, quantiles, and which quantity matters."""

from __future__ import annotations

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


def column(table: Path, name: str) -> FloatArray:
    """
    Read one column of a table of samples.

    Parameters
    ----------
    table : Path
        Parquet file.
    name : str
        Its name.

    Returns
    -------
    ndarray, shape (samples,)
        Its values, by number of the sample.

    """
    return np.asarray(parquet.read_table(table, columns=[name])[name].to_numpy())


def probability(values: FloatArray) -> Estimate:
    """
    Return how often something is so.

    Parameters
    ----------
    values : ndarray, shape (n,)
        1 where it is, 0 where it is not, nan where that does not exist.

    Returns
    -------
    Estimate
        With the interval of Wilson, which also holds near 0 and 1.

    """
    seen = values[np.isfinite(values)]
    n = len(seen)
    if n == 0:
        return Estimate(np.nan, 0.0, 1.0)
    p, z = float(seen.mean()), _NORMAL
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
    y, x = values[seen], by[seen]
    groups = min(_GROUPS, len(y) // 2)
    if groups < 2 or y.var() == 0.0 or x.var() == 0.0:
        return 0.0
    means = [
        (len(one), one.mean()) for one in np.array_split(y[np.argsort(x, kind='stable')], groups)
    ]
    between = sum(n * (mean - y.mean()) ** 2 for n, mean in means) / (len(y) * y.var())
    chance = (groups - 1) / (len(y) - 1)
    return float(max(0.0, (between - chance) / (1.0 - chance)))


def worst(values: FloatArray, number: int) -> list[int]:
    """
    Return the samples with the largest values.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Values; nan does not count.
    number : int
        How many.

    Returns
    -------
    list of int
        Their numbers, the worst first.

    """
    order = np.argsort(np.where(np.isfinite(values), -values, np.inf), kind='stable')
    return [int(k) for k in order[:number] if np.isfinite(values[k])]
