# SPDX-License-Identifier: Apache-2.0
"""Timing monitor: rate of the measurements, and latency of the commands."""

from needle_controller.controller import ControllerSettings
from needle_controller.safety.input_monitor import InputMonitor
from needle_controller.safety.latency_monitor import LatencyMonitor
from needle_controller.safety.rate_monitor import RateMonitor
from needle_ros.status import LatencyStatus
from needle_ros.timing import NANOSECONDS


class TimingMonitor:
    """
    Monitor the latency, and compare rate and latency with the settings of a controller.

    Without `settings`, only the latency is measured. Without `stamped`, stamps are receive times:
    they do not resolve single periods, and the rate is not compared.
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
        """Return the status of the latency."""
        return self._latency.status()
