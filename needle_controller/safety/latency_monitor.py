# SPDX-License-Identifier: Apache-2.0
"""Latency monitor: compare the latency of the commands with the configured delay."""

from typing import Final

from needle_ros.status import LatencyStatus
from needle_ros.timing import RateCounter

#: Tolerated fraction of late commands, and tolerated number per second [Hz].
_BORNE: Final = 0.05
_FEW: Final = 3.0


class LatencyMonitor:
    """Count the commands that are later than ``delay``, in periods [s] of the control laws."""

    def __init__(self, delay: int = 0, period: float = 1.0) -> None:
        self._delay, self._longest = delay, (delay + 1) * period
        self._answered = self._late = 0
        self._oldest = 0.0
        self._window = RateCounter()

    def add(self, now: int, age: float) -> None:
        """Add a command at a time [ns] that answers a measurement of an age [s]."""
        late = age > self._longest
        self._answered += 1
        self._late += late
        self._oldest = max(self._oldest, age)
        self._window.add(now, late)

    def warning(self, now: int) -> str | None:
        """Return a warning if too many commands of the last second were late, else None."""
        share = self._window.share(now)
        if share <= _BORNE or share * self._window.rate(now) < _FEW:
            return None
        return (
            f'{share:.0%} of the commands are too late for delay {self._delay}: raise it, lower '
            'the rate, or free the machine'
        )

    def status(self) -> LatencyStatus:
        """Return the numbers of answers, and the largest latency."""
        return LatencyStatus(answered=self._answered, late=self._late, longest=self._oldest)
