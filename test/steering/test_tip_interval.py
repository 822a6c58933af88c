# SPDX-License-Identifier: Apache-2.0
"""The printed intervals of the tip at the end hold, also with a slow error of the sensor."""

from __future__ import annotations

from dataclasses import replace
import re

from needle_controller.steering.law import DEFAULT_LAW
from needle_dynamics.arrays import FloatArray
from needle_dynamics.simulated.tip_sensor import SlowNoise
from needle_ros.status import SteeringPhase as Phase
import numpy as np
import pytest
from support.steered_robot import PERIOD, Robot, SETTINGS

TARGET = (1e-3, 0.025, 0.0)
OWN = replace(SETTINGS, measurement_time=0.5)
CORRELATED = 1.0  #: Correlation time of the slow error [s].


def ended(law: str, size: tuple[float, float, float], seed: int) -> tuple[str, float]:
    """Return the result of an insertion with a slow error x, y, z [m], and the true y [m]."""
    robot = Robot(OWN, law=law)
    robot.noise = np.random.default_rng([seed, 0])
    slow = SlowNoise(1.0, CORRELATED, np.random.default_rng([seed, 1]), 3)

    def sees(tip: FloatArray) -> FloatArray:
        slow.advance(1e-9 * PERIOD)
        return np.asarray(tip + np.multiply(size, slow.value))

    robot.sees = sees
    robot.tick(20)
    assert robot.aim(TARGET) == ''
    for _ in range(3000):
        if not (robot.loop.steers or robot.loop.busy):
            break
        robot.tick()
    assert robot.loop.phase is Phase.DONE, robot.loop.fault
    line, _ = robot.loop._insertion.law.outcome()
    return line, float(robot.needle.tip[1])


@pytest.mark.requirement('S-271')
@pytest.mark.parametrize('size', [(3e-4, 3e-4, 3e-4), (0.0, 3e-4, 0.0)], ids=['xyz', 'y'])
@pytest.mark.parametrize(('law', 'trials'), [(DEFAULT_LAW, 50), ('springs', 100)])
def test_interval_of_the_depth_holds(
    law: str, trials: int, size: tuple[float, float, float]
) -> None:
    """
    In 90 % of the trials or more.

    It is 95 % less 1.6 standard deviations of a share of 50 trials, 3.1 %; the seeds are fixed.
    """
    held = 0
    for seed in range(trials):
        line, true = ended(law, size, seed)
        found = re.search(r'y = (\S+) ± (\S+) mm', line)
        assert found is not None
        center, half = map(float, found.groups())
        held += abs(center - 1e3 * true) <= half
    assert held >= 0.9 * trials


@pytest.mark.requirement('S-271')
@pytest.mark.parametrize('law', [DEFAULT_LAW, 'springs'])
def test_interval_of_the_depth_is_narrow_with_white_noise(law: str) -> None:
    """Below 0.2 mm, eight standard deviations of a mean of 50 readings of 0.18 mm."""
    line, _ = ended(law, (0.0, 0.0, 0.0), 0)
    found = re.search(r'y = \S+ ± (\S+) mm', line)
    assert found is not None
    assert 0.0 < float(found[1]) < 8.0 * 0.18 / np.sqrt(50.0)
