# SPDX-License-Identifier: Apache-2.0
"""Sort samples by time, in bounded memory."""

from typing import Final

from needle_dynamics.arrays import FloatArray, IntArray
import numpy as np

FINEST: Final = 2_500_000  #: finest bin [ns]: 400 Hz, above the cutoff of the friction filter
LARGEST: Final = 2**20  #: largest number of samples that are kept
_GATHERED: Final = 2**16  # smallest number of added samples that is sorted


class Series:
    """Samples in order of stamp, after `compact`; ``late``, ``repeated`` count their stamps."""

    # More than two samples per bin of ``width`` [ns] are averaged, stamps and values alike; above
    # `LARGEST` samples, neighbors are.

    def __init__(self, columns: int) -> None:
        self.stamps = np.empty(0, dtype=np.int64)
        self.values: FloatArray = np.empty((0, columns))
        self.late = self.repeated = self.width = 0
        self._weights: FloatArray = np.empty(0)
        self._gathered: list[tuple[IntArray, FloatArray]] = []
        self._count = 0
        self._last = -(2**63)

    def add(self, stamps: IntArray, values: FloatArray) -> None:
        """Add samples in order of reception: stamps [ns], (n,), and values, (n, columns)."""
        if len(stamps) == 0:
            return
        self.late += int(np.count_nonzero(stamps[1:] < stamps[:-1])) + int(stamps[0] < self._last)
        self._last = int(stamps[-1])
        self._gathered.append((stamps, values))
        self._count += len(stamps)
        # In proportion to the number of samples, for a constant cost per sample.
        if self._count > max(_GATHERED, len(self.stamps)):
            self.compact()

    def compact(self) -> None:
        """Sort the added samples, and average where the samples are too dense or too many."""
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
    stamps: IntArray, values: FloatArray, weights: FloatArray, width: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Average the samples of each bin; keep a single sample of a bin unchanged."""
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
