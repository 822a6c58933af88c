# SPDX-License-Identifier: Apache-2.0
"""Timing monitor: rate of the measurements, and latency of the commands."""

from collections import deque
from statistics import median
from typing import Final

from needle_controller.controller import ControllerSettings
from needle_controller.safety.input_monitor import InputMonitor
from needle_ros.status import LatencyStatus
from needle_ros.timing import NANOSECONDS, RateCounter

_LATE: Final = 0.05  #: Tolerated fraction of late commands.
_FEW: Final = 3.0  #: Tolerated number of late commands per second [Hz].
_MOST: Final = 40  #: Largest number of compared steps.
_FEWEST: Final = 20  #: Least number of compared steps: a second of them.
_TOLERANCE: Final = 0.2  #: Relative tolerance of a period.
_SHARE: Final = 0.9  #: Fraction of periods out of tolerance for a warning.


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
        if share <= _LATE or share * self._window.rate(now) < _FEW:
            return None
        return (
            f'{share:.0%} of the commands are too late for delay {self._delay}: raise it, lower '
            'the rate, or free the machine'
        )

    def status(self) -> LatencyStatus:
        return LatencyStatus(answered=self._answered, late=self._late, longest=self._oldest)


class RateMonitor:
    """
    Compare the steps between stamps of measurements with the ``rate`` of the laws [Hz].

    Only a sample of the measurements is compared, to save computing time. Lost measurements and
    jitter make some steps longer and others shorter; a wrong rate changes nearly all of them.
    ``longest`` is the step from which it is a gap [s].
    """

    def __init__(self, rate: float, longest: float) -> None:
        self._rate = rate
        self._longest = round(longest * NANOSECONDS)
        self._steps: deque[float] = deque(maxlen=_MOST)
        self._last = -1

    def add(self, stamp: int, step: int) -> None:
        """Add the newest measurement and the step to it [ns], a few times per second."""
        if stamp != self._last and 0 < step <= self._longest:
            self._steps.append(step * self._rate / NANOSECONDS)
        self._last = stamp

    def warning(self) -> str | None:
        """Return a warning with both rates if they differ; None otherwise or with few samples."""
        steps = self._steps
        if len(steps) < _FEWEST:
            return None
        enough = _SHARE * len(steps)
        slow = sum(step > 1.0 + _TOLERANCE for step in steps) >= enough
        fast = sum(step < 1.0 / (1.0 + _TOLERANCE) for step in steps) >= enough
        if not slow and not fast:
            return None
        found = self._rate / median(steps)
        return (
            f'joint_states is received at {found:.4g} Hz, rate is {self._rate:g} Hz: set rate to '
            f'{found:.3g}, or the robot to {self._rate:g} Hz'
        )


class TimingMonitor:
    """
    Compare rate and latency with the settings of a controller; without, only measure the latency.

    Without `stamped`, stamps are receive times: they do not resolve single periods, and the rate
    is not compared.
    """

    def __init__(
        self, settings: ControllerSettings | None = None, *, stamped: bool = False
    ) -> None:
        self._latency, self._rate = LatencyMonitor(), None
        if settings is not None:
            self._latency = LatencyMonitor(int(settings.delay), 1.0 / settings.rate)
            if stamped:
                self._rate = RateMonitor(settings.rate, settings.measurement_timeout)
        self._warned = False

    def add(self, stamp: int, now: int) -> None:
        """Add a measurement that is answered now; times are in ns."""
        self._latency.add(now, (now - stamp) / NANOSECONDS)

    def compare_rate(self, joints: InputMonitor) -> str | None:
        """Compare the newest measurement, and return a new warning."""
        if self._rate is None:
            return None
        self._rate.add(joints.last, joints.step)
        line, warned = self._rate.warning(), self._warned
        self._warned = line is not None
        return None if warned else line

    def warning(self, now: int) -> str | None:
        """Return a warning of the rate or, at the correct rate, of the latency at a time [ns]."""
        # At a wrong rate commands are late, too.
        rate = self._rate.warning() if self._rate is not None else None
        return rate or self._latency.warning(now)

    def status(self) -> LatencyStatus:
        return self._latency.status()
