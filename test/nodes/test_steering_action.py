# SPDX-License-Identifier: Apache-2.0
"""The node steering moves a robot by its action ``follow_joint_trajectory``, over DDS."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any

from needle_controller.steering.settings import JOINTS
from needle_controller.steering_node import SteeringNode
from needle_ros.base_node import COMMAND
from needle_ros.status import SteeringPhase
from needle_ros.trajectories import ErrorCode
from nodes.test_steering import Bench, STEERING
import pytest
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from std_srvs.srv import Trigger
from support.generated_messages import importable
from support.ros_graph import RosGraph
from trajectory_msgs.msg import JointTrajectory

#: Action of a robot.
ACTION = 'arm/follow_joint_trajectory'


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
    assert 'sent 4 times, no answer of arm/follow_joint_trajectory' in bench.said
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


class WholeGoals:
    """
    Action of a robot that refuses partial goals and goals that end in motion.

    These are the defaults of joint_trajectory_controller. The plant moves by the accepted goals.
    """

    def __init__(self, bench: Bench) -> None:
        kind = import_module('control_msgs.action').FollowJointTrajectory
        self.refused: list[JointTrajectory] = []
        self.refuses = False
        robot = bench.user.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)

        def judge(goal: Any) -> GoalResponse:
            path = goal.trajectory
            whole = [*path.joint_names] == [*JOINTS[:3]] and not any(path.points[-1].velocities)
            if whole and not self.refuses:
                return GoalResponse.ACCEPT
            self.refused.append(path)
            return GoalResponse.REJECT

        def execute(handle: Any) -> Any:
            robot.publish(handle.request.trajectory)
            handle.succeed()
            return kind.Result()

        self._server = ActionServer(bench.user, kind, ACTION, execute, goal_callback=judge)
        bench.until(bench.steering._client._client.server_is_ready, 'the action')

    def destroy(self) -> None:
        self._server.destroy()


def inserted(graph: RosGraph) -> tuple[Bench, WholeGoals]:
    """Return nodes during an insertion beyond 20 mm, with the guide aside."""
    bench = Bench(graph, trajectory_action=ACTION, retract_depth=0.005)
    robot = WholeGoals(bench)
    bench.aim()
    bench.until(lambda: bench.at('insertion') > 0.02, 'the insertion')
    assert not robot.refused, bench.said
    return bench, robot


def retract(bench: Bench) -> None:
    """Request the retraction."""
    client = bench.user.create_client(Trigger, 'steering/retract')
    bench.until(client.service_is_ready, 'the service')
    answer = client.call_async(Trigger.Request())
    bench.until(answer.done, 'the answer')
    assert answer.result().success


@pytest.mark.requirement('S-265')
def test_retraction_by_an_action_that_refuses_partial_goals(ros_graph: RosGraph) -> None:
    """Beyond the depth to which the plant withdraws the needle by itself."""
    bench, robot = inserted(ros_graph)
    retract(bench)
    bench.until(lambda: bench.status.phase is SteeringPhase.IDLE, 'the end')
    assert bench.said == 'waits for a target'
    assert not robot.refused
    # Within the tolerances of depth and guide.
    assert bench.at('insertion') == pytest.approx(0.005, abs=3e-4)
    assert abs(bench.at('guide_x')) + abs(bench.at('guide_z')) < 3e-4
    robot.destroy()


@pytest.mark.requirement('S-266')
def test_refused_retraction_names_the_action(ros_graph: RosGraph) -> None:
    bench, robot = inserted(ros_graph)
    robot.refuses = True
    retract(bench)
    bench.until(lambda: bench.status.phase is SteeringPhase.IDLE, 'the end')
    failed = f'the retraction has failed: {ACTION} rejected the motion: the goal was rejected'
    assert bench.said == failed
    robot.destroy()


def test_action_without_its_package_is_an_error(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(import_module('sys').modules, 'control_msgs.action', None)
    parameters = {**STEERING, 'trajectory_action': 'arm/follow_joint_trajectory'}
    steering = ros_graph.add(SteeringNode, parameters=parameters, start=False)
    assert not steering.start()
    assert 'needs control_msgs: install it' in steering.failure


def test_action_with_continuous_is_an_error(ros_graph: RosGraph) -> None:
    parameters = {**STEERING, 'trajectory_action': ACTION, 'continuous': True}
    steering = ros_graph.add(SteeringNode, parameters=parameters, start=False)
    assert not steering.start()
    assert 'continuous must be false with trajectory_action' in steering.failure
