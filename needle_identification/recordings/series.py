"""Samples in bounded memory, however many there are and in whatever order they come."""

from __future__ import annotations

from typing import Final

from needle_dynamics import FloatArray
import numpy as np
from numpy.typing import NDArray

#: Finest bin [ns]: 400 Hz, ten times what a friction of 10 Hz and its filter need, and more.
FINEST: Final = 2_500_000

#: Most samples that are kept.
LARGEST: Final = 2**20

#: Samples that are gathered before they are sorted in, at least.
_GATHERED: Final = 2**16


class Series:
    """
    Samples by their stamps.

    Samples that come no denser than two in a bin are kept as they are. Denser ones are averaged
    over bins: one mean stamp and mean values for each, which delays nothing. When there are more
    than `LARGEST`, neighbors are merged until there are not.

    Parameters
    ----------
    columns : int
        Values of one sample.

    Attributes
    ----------
    stamps : ndarray, shape (n,)
        Strictly increasing [ns]; up to date after `compact`, like all that follow.
    values : ndarray, shape (n, columns)
        What was measured.
    late : int
        Samples that came after one with a later stamp.
    repeated : int
        Samples left out because another one gathered with them had the same stamp.
    width : int
        Width of the bins [ns], 0 for none.

    """

    def __init__(self, columns: int) -> None:
        self.stamps = np.empty(0, dtype=np.int64)
        self.values: FloatArray = np.empty((0, columns))
        self.late = self.repeated = self.width = 0
        self._weights: FloatArray = np.empty(0)
        self._gathered: list[tuple[NDArray[np.int64], FloatArray]] = []
        self._count = 0
        self._last = -(2**63)

    def add(self, stamps: NDArray[np.int64], values: FloatArray) -> None:
        """Add finite samples in the order in which they came."""
        if len(stamps) == 0:
            return
        self.late += int(np.count_nonzero(stamps[1:] < stamps[:-1])) + int(stamps[0] < self._last)
        self._last = int(stamps[-1])
        self._gathered.append((stamps, values))
        self._count += len(stamps)
        # In proportion to what is there, so that the cost of a sample does not grow.
        if self._count > max(_GATHERED, len(self.stamps)):
            self.compact()

    def compact(self) -> None:
        """Sort in what was gathered, and average where there is too much."""
        stamps = np.concatenate([self.stamps, *(stamps for stamps, _ in self._gathered)])
        values = np.concatenate([self.values, *(values for _, values in self._gathered)])
        weights = np.concatenate([self._weights, np.ones(self._count)])
        self._gathered, self._count = [], 0
        if (stamps[1:] < stamps[:-1]).any():
            order = np.argsort(stamps, kind='stable')
            stamps, values, weights = stamps[order], values[order], weights[order]
        again = np.zeros(len(stamps), dtype=np.bool_)
        again[1:] = stamps[1:] == stamps[:-1]
        if again.any():
            self.repeated += int(np.count_nonzero(again))
            stamps, values, weights = stamps[~again], values[~again], weights[~again]
        if not self.width and len(stamps) > 2 and np.median(np.diff(stamps)) < FINEST / 2:
            self.width = FINEST
        if self.width:
            stamps, values, weights = _binned(stamps, values, weights, self.width)
        while len(stamps) > LARGEST:
            self.width = 2 * self.width or FINEST
            stamps, values, weights = _binned(stamps, values, weights, self.width)
        self.stamps, self.values, self._weights = stamps, values, weights


def _binned(
    stamps: NDArray[np.int64], values: FloatArray, weights: FloatArray, width: int
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Average what lies in one bin; what is alone in its bin stays as it is."""
    bins = stamps // width
    first = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    if len(first) == len(stamps):
        return stamps, values, weights
    total = np.add.reduceat(weights, first)
    number = np.diff(first, append=len(stamps))
    since = (stamps - np.repeat(stamps[first], number)) * weights
    mean_stamps = stamps[first] + np.rint(np.add.reduceat(since, first) / total).astype(np.int64)
    means = np.add.reduceat(values * weights[:, None], first, axis=0) / total[:, None]
    means[number == 1] = values[first[number == 1]]
    return mean_stamps, means, total
