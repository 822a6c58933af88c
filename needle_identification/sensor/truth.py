# SPDX-License-Identifier: Apache-2.0
"""True position of a sensor recording: interpolation, coverage, and whether its rate suffices."""

from collections.abc import Iterator
from math import sqrt
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.recordings.recording import SensorRecording
from needle_identification.recordings.samples import are_gaps
import numpy as np
from scipy.interpolate import CubicSpline

_BUNCHED: Final = 0.25  # interval of rows that come together, over the median interval
_WIDE: Final = 3.0  # largest interval of every second row, likewise
_MOVED: Final = 3.0  # smallest motion over the white noise
_SLOPE: Final = 0.05  # half the interval of a slope, short relative to motions [s]
_FEWEST: Final = 8  # smallest number of rows whose rate is tested


class TruePath:
    """True position at any time, by a cubic spline; constant if it does not move."""

    def __init__(self, one: SensorRecording) -> None:
        self._times, self._rows = one.true_time, one.true_tip
        self.moves = len(self._times) > 1
        if not self.moves:
            return
        gaps = are_gaps(np.rint(1e9 * np.diff(self._times)).astype(np.int64))
        self._starts, self._ends = self._times[:-1][gaps], self._times[1:][gaps]
        #: Median interval of the rows [s].
        self.interval = float(np.median(np.diff(self._times)))
        # A spline through rows that come together would follow their noise.
        apart = np.diff(self._times, prepend=-np.inf) > _BUNCHED * self.interval
        self._knots, self._values = self._times[apart], self._rows[apart]
        self._spline = CubicSpline(self._knots, self._values)

    def at(self, time: FloatArray) -> FloatArray:
        """Return the position at times (n,), (n, k) [m]."""
        if not self.moves:
            return np.repeat(self._rows, len(time), axis=0)
        return np.asarray(self._spline(np.clip(time, self._knots[0], self._knots[-1])))

    def slopes(self, time: FloatArray) -> FloatArray:
        """Return the change of the position by a delay at times (n,), (n, k) [m/s]."""
        # Rows farther apart have independent noise, which a slope of neighbors would amplify.
        step = max(0.5 * self.interval, _SLOPE)
        return (self.at(time - step) - self.at(time + step)) / (2.0 * step)

    def covers(self, first: FloatArray, last: FloatArray) -> BoolArray:
        """Return which intervals of times, (n,) each, have a true position without a gap."""
        inside = (self._times[0] <= first) & (last <= self._times[-1])
        # Gaps that end after the first time and start before the last time.
        ended, started = np.searchsorted(self._ends, first), np.searchsorted(self._starts, last)
        return np.asarray(inside & (ended == started))

    def error_at_half_rate(self) -> float:
        """Return the error of each second row by a spline through the others [m]."""
        if not self.moves or len(self._knots) < _FEWEST:
            return 0.0
        # An odd number of rows, so that each omitted row is between two others.
        count = len(self._knots) - (len(self._knots) + 1) % 2
        times, values = self._knots[:count], self._values[:count]
        left = values[1::2] - CubicSpline(times[::2], values[::2])(times[1::2])
        # Not across gaps.
        dense = np.diff(times[::2]) < _WIDE * self.interval
        return sqrt(float(np.mean(left[dense] ** 2))) if dense.any() else 0.0


def unresolved_motion(one: SensorRecording) -> Iterator[str]:
    """Warn of a tip that moves while the true position changes as much from row to row."""
    if one.moves or len(one.true_time) < _FEWEST or len(one.time) < _FEWEST:
        return
    noise = sqrt(0.5 * float(np.mean(np.diff(one.tip, axis=0) ** 2)))
    moved, true = (sqrt(float(part.var(axis=0).mean())) for part in (one.tip, one.true_tip))
    if min(moved, true) > _MOVED * noise:
        rate = 1.0 / float(np.median(np.diff(one.true_time)))
        yield (
            f'the true position is recorded at {rate:.3g} Hz, too slowly for its motion of '
            f'{1e3 * true:.2g} mm: its mean is used, and the motion is counted as noise'
        )
