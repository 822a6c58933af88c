# SPDX-License-Identifier: Apache-2.0
"""The node steering moves a robot by its action ``follow_joint_trajectory``, over DDS."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any

from needle_controller.steering_node import SteeringNode
from needle_ros.status import SteeringPhase
from needle_ros.trajectory_goals import ErrorCode
from nodes.test_steering import Bench, STEERING
import pytest
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from support.generated_messages import importable
from support.ros_graph import RosGraph


@pytest.fixture(scope='module', autouse=True)
def actions(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Generate control_msgs if it is not installed."""
    with importable('control_msgs', tmp_path_factory.mktemp('control')):
        yield


def test_insertion_by_goals_reaches_its_target(ros_graph: RosGraph) -> None:
    bench = Bench(ros_graph, trajectory_action='plant/follow_joint_trajectory')
    bench.aim()
    assert bench.end() is SteeringPhase.DONE, bench.said
    assert not bench.moves
    assert 'plant/follow_joint_trajectory' in bench.steering.about()


def test_missing_action_stops_the_insertion(ros_graph: RosGraph) -> None:
    bench = Bench(ros_graph, trajectory_action='arm/follow_joint_trajectory')
    bench.aim()
    assert bench.end() is SteeringPhase.STOPPED
    assert 'no answer of arm/follow_joint_trajectory' in bench.said
    assert not bench.moves


@pytest.mark.parametrize('accepted', [False, True])
def test_refused_goal_stops_the_insertion_with_its_reason(
    ros_graph: RosGraph, accepted: bool
) -> None:
    """A robot that rejects each goal, or accepts and aborts it."""
    bench = Bench(ros_graph, trajectory_action='arm/follow_joint_trajectory')
    kind = import_module('control_msgs.action').FollowJointTrajectory
    code = ErrorCode.GOAL_TOLERANCE_VIOLATED

    def execute(handle: Any) -> Any:
        handle.abort()
        return kind.Result(error_code=int(code), error_string='guide_x is blocked')

    server = ActionServer(
        bench.user,
        kind,
        'arm/follow_joint_trajectory',
        execute,
        goal_callback=lambda _goal: GoalResponse.ACCEPT if accepted else GoalResponse.REJECT,
        cancel_callback=lambda _handle: CancelResponse.ACCEPT,
    )
    bench.until(bench.steering._client._client.server_is_ready, 'the action')
    bench.aim()
    assert bench.end() is SteeringPhase.STOPPED
    reason = f'{code.name}: guide_x is blocked' if accepted else 'the goal was rejected'
    assert f'arm/follow_joint_trajectory rejected the motion: {reason}' in bench.said
    server.destroy()


def test_action_without_its_package_is_an_error(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(import_module('sys').modules, 'control_msgs.action', None)
    parameters = {**STEERING, 'trajectory_action': 'arm/follow_joint_trajectory'}
    steering = ros_graph.add(SteeringNode, parameters=parameters, start=False)
    assert not steering.start()
    assert 'needs control_msgs: install it' in steering.failure
