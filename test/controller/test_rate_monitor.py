# SPDX-License-Identifier: Apache-2.0
"""The rate monitor detects a wrong rate, without false alarms."""

from __future__ import annotations

from itertools import pairwise

from needle_controller import ControllerSettings
from needle_controller.safety.input_monitor import InputMonitor
from needle_controller.safety.timing_monitor import RateMonitor, TimingMonitor
from needle_ros.timing import NANOSECONDS
import numpy as np
from numpy.random import Generator
import pytest


def judged(
    rate: float, true: float, rng: Generator, *, jitter: float = 0.0, lost: float = 0.0
) -> str | None:
    """Return the warning after five seconds of samples, checked every 50 ms."""
    pace = RateMonitor(rate, 0.1)
    stamps = np.arange(int(5.0 * true)) / true
    stamps += jitter / true * rng.uniform(-1.0, 1.0, stamps.shape)
    stamps = np.sort(stamps)[rng.random(stamps.shape) >= lost]
    times = np.rint(NANOSECONDS * (1.0 + stamps)).astype(int).tolist()
    look, newest = 0, (0, 0)
    for before, stamp in pairwise(times):
        if stamp >= look:
            # The last sample before the check.
            pace.add(*newest)
            look = stamp + NANOSECONDS // 20
        newest = stamp, stamp - before
    return pace.warning()


@pytest.mark.requirement('S-110')
@pytest.mark.parametrize(('rate', 'true'), [(1000.0, 500.0), (500.0, 1000.0), (100.0, 125.0)])
def test_wrong_rate_gives_a_warning(rate: float, true: float) -> None:
    """The warning has both rates and the correction, with jitter too."""
    rng = np.random.default_rng(1)
    for jitter in (0.0, 0.02):
        said = judged(rate, true, rng, jitter=jitter)
        assert said is not None
        found = float(said.partition(' is received at ')[2].partition(' Hz')[0])
        assert found == pytest.approx(true, rel=0.03)
        assert f'rate is {rate:g} Hz: set rate to {found:.3g}' in said


@pytest.mark.requirement('S-110')
@pytest.mark.parametrize('rate', [50.0, 200.0, 1000.0])
def test_correct_rate_gives_no_warning(rate: float) -> None:
    """For any jitter, lost samples and small clock differences."""
    rng = np.random.default_rng(2)
    for jitter in (0.0, 0.1, 0.45):
        for lost in (0.0, 0.2, 0.4):
            for drift in (0.95, 1.0, 1.05):
                said = judged(rate, drift * rate, rng, jitter=jitter, lost=lost)
                assert said is None, (jitter, lost, drift, said)


def test_rate_monitor_needs_a_second_of_samples() -> None:
    """A few steps give no warning, nor do gaps or repeated samples."""
    pace = RateMonitor(100.0, 0.1)
    for k in range(19):
        pace.add(k * 20_000_000, 20_000_000)
        pace.add(k * 20_000_000, 20_000_000)
    pace.add(10**10, 10**9)
    pace.add(10**10 + 1, 0)
    assert pace.warning() is None
    pace.add(2 * 10**10, 20_000_000)
    assert pace.warning() == (
        'joint_states is received at 50 Hz, rate is 100 Hz: set rate to 50, or the robot to 100 Hz'
    )


def test_wrong_rate_is_reported_before_the_late_commands_that_it_causes() -> None:
    """A command after 3 ms is late at the rate in the settings, not at the rate of the robot."""
    for rate in (1000.0, 200.0):
        monitor = TimingMonitor(ControllerSettings(rate=rate), stamped=True)
        joints = InputMonitor('joint_states', 0.1)
        for stamp in range(NANOSECONDS, 4 * NANOSECONDS, NANOSECONDS // 200):
            now = stamp + 3_000_000
            assert joints.check(stamp, now) is None
            monitor.add(stamp, now)
            monitor.compare_rate(joints)
        wrong = rate == 1000.0
        said = monitor.warning(now)
        assert (monitor.status().late > 0) == wrong
        assert ('is received at 200 Hz' in said) if said else not wrong
