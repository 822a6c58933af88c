# SPDX-License-Identifier: Apache-2.0
"""Insertion along a plan by the steering executive, without ROS."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from needle_controller import SteeringPrior
from needle_controller.steering.insertion_plan import Plan
from needle_ros.errors import ParameterError
from needle_ros.status import SteeringPhase as Phase
import numpy as np
import pytest
from support.plans import bowed_plan, CLEARANCE
from support.steered_robot import Robot, SETTINGS

PLAN = bowed_plan()


def deviation(robot: Robot, tips: dict[float, Any], plan: Plan = PLAN) -> float:
    """Return the largest distance of the tip from the path at the steps [m]."""
    path = plan.tip_path
    offs = [
        tip - [np.interp(depth, path.depths, one) for one in path.tips.T]
        for depth, tip in tips.items()
    ]
    return float(np.hypot(*np.array(offs).T).max())


@pytest.mark.parametrize('start', [0.0, 0.003])
def test_tip_stays_in_its_tube_and_reaches_the_target(start: float) -> None:
    """A needle in softer tissue with a tilted guide, from the skin or inserted straight before."""
    robot = Robot(plan=PLAN, prior=SteeringPrior(noise=5e-5))
    robot.ways[0] = np.zeros(1), np.full(1, start)
    robot.tick(20)
    x, z = PLAN.tip_path.tips[-1].tolist()
    assert robot.aim((x, PLAN.length, z)) == ''
    tips: dict[float, Any] = {}
    for _ in range(6000):
        robot.tick()
        if not robot.loop.steers:
            break
        if robot.loop.phase is Phase.MEASURING:
            tips[float(robot.at[0])] = robot.needle.tip[[0, 2]]
    assert robot.loop.phase is Phase.DONE, robot.loop.fault
    assert len(tips) >= len(PLAN.depths) - 1
    assert deviation(robot, tips) < CLEARANCE
    # Sixteen readings of 0.18 mm per measurement, and the remaining uncertainty of the tissue.
    assert np.hypot(*(robot.needle.tip[[0, 2]] - PLAN.tip_path.tips[-1])) < 3e-4
    # The needle of the robot is tilted by 20 mrad, so that it leaves the tube without feedback.
    assert 0.02 * (PLAN.length + 0.04) > CLEARANCE


def test_target_at_another_depth_is_rejected() -> None:
    robot = Robot(plan=PLAN)
    robot.tick(20)
    assert robot.aim((0.0, 0.05, 0.0)) == (
        'target rejected: the plan is to a depth of 60.000 mm, the target at 50.000 mm'
    )


@pytest.mark.parametrize(
    ('plan', 'settings', 'message'),
    [
        ({}, {'guide_limit': 2e-3}, r'the plan needs guide_limit >= 3\.\d+ mm, got 2 mm'),
        ({}, {'guide_step': 1e-4}, r'the plan needs guide_step >= \d\.\d+ mm, got 0\.1 mm'),
        ({}, {'continuous': True}, 'continuous must be 0 with a plan, got True'),
        ({}, {'turns': 1}, 'turns must be 0 with a plan, got 1'),
        ({'guide': np.full((12, 2), 1e-3)}, {}, 'must have a guide at zero in its first step'),
    ],
)
def test_plan_outside_the_settings_is_rejected_by_a_line(
    plan: dict[str, Any], settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ParameterError, match=message) as caught:
        Robot(replace(SETTINGS, **settings), plan=replace(PLAN, **plan))
    assert '\n' not in str(caught.value)


def test_law_that_cannot_follow_a_path_is_rejected() -> None:
    robot = Robot(plan=PLAN, law='springs')
    robot.tick(20)
    assert "law 'springs' cannot follow a planned path" in robot.aim((0.0, PLAN.length, 0.0))
