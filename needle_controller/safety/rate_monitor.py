# SPDX-License-Identifier: Apache-2.0
"""Rate monitor: compare the rate of the measurements with the rate of the control laws."""

from collections import deque
from statistics import median
from typing import Final

from needle_ros.timing import NANOSECONDS

#: Largest and least number of compared steps: a second of them.
_MOST: Final = 40
_FEWEST: Final = 20

#: Relative tolerance of a period, and fraction of periods out of tolerance for a warning.
_BORNE: Final = 0.2
_SHARE: Final = 0.9


class RateMonitor:
    """
    Compare the time between two measurements, by their stamps, with the period.

    Only a sample of the measurements is compared, to save computing time. Lost measurements and
    jitter make some steps longer and others shorter; a wrong rate changes nearly all of them.
    ``rate`` is the configured rate of the laws [Hz], ``longest`` the time between measurements
    from which it is a gap [s].
    """

    def __init__(self, rate: float, longest: float) -> None:
        self._rate = rate
        self._longest = round(longest * NANOSECONDS)
        self._steps: deque[float] = deque(maxlen=_MOST)
        self._seen = -1

    def add(self, stamp: int, step: int) -> None:
        """
        Add the newest measurement, a few times per second.

        ``stamp`` is its time and ``step`` the time since the measurement before [ns].
        """
        if stamp != self._seen and 0 < step <= self._longest:
            self._steps.append(step * self._rate / NANOSECONDS)
        self._seen = stamp

    def warning(self) -> str | None:
        """Return a warning with both rates if they differ; None otherwise or with few samples."""
        steps = self._steps
        if len(steps) < _FEWEST:
            return None
        enough = _SHARE * len(steps)
        slow = sum(step > 1.0 + _BORNE for step in steps) >= enough
        fast = sum(step < 1.0 / (1.0 + _BORNE) for step in steps) >= enough
        if not slow and not fast:
            return None
        found = self._rate / median(steps)
        return (
            f'joint_states is received at {found:.4g} Hz, rate is {self._rate:g} Hz: set rate to '
            f'{found:.3g}, or the robot to {self._rate:g} Hz'
        )
