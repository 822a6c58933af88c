# SPDX-License-Identifier: Apache-2.0
"""The latency monitor compares commands with the configured delay."""

from __future__ import annotations

from needle_controller.safety.timing_monitor import LatencyMonitor
from needle_ros.timing import NANOSECONDS
import pytest


@pytest.mark.requirement('S-082')
@pytest.mark.parametrize(
    ('rate', 'late', 'said'), [(1000, 40, False), (1000, 60, True), (20, 2, False), (20, 10, True)]
)
def test_more_than_five_percent_late_commands_give_a_warning(
    rate: int, late: int, said: bool
) -> None:
    """In the last full second, and more than one or two."""
    period = 1.0 / rate
    lateness = LatencyMonitor(delay=1, period=period)
    for k in range(2 * rate + 1):
        now = k * NANOSECONDS // rate
        # Two periods are in time; a little more is not.
        lateness.add(now, 2.0 * period if k % rate >= late else 2.1 * period)
    warning = lateness.warning(now)
    share = f'{late / rate:.0%} of the commands are too late for delay 1: raise it'
    assert (warning is not None and warning.startswith(share)) == said
    status = lateness.status()
    assert (status.answered, status.late) == (2 * rate + 1, 2 * late + 1)
    # A second without commands ends the warning.
    lateness.add(now + 1 * NANOSECONDS, 0.0)
    lateness.add(now + 2 * NANOSECONDS, 0.0)
    assert lateness.warning(now + 2 * NANOSECONDS) is None
