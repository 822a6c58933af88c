# SPDX-License-Identifier: Apache-2.0
"""Requests over DDS: repeated after a lost message, and executed once."""

from __future__ import annotations

from time import monotonic
from typing import Any

from builtin_interfaces.msg import Duration as DurationMessage
from geometry_msgs.msg import PointStamped
from needle_controller.controller_node import ControllerNode
from needle_controller.steering_node import SteeringNode
from needle_dynamics.plant_node import PlantNode
from needle_insertion.live.operator import Operator
from needle_ros.base_node import BaseNode, COMMAND
from needle_ros.calls_node import Calls
from needle_ros.requests import CALL_TIMEOUT, RequestLog
import pytest
from rclpy.duration import Duration
from rclpy.node import Node
from std_srvs.srv import Trigger
from support.ros_graph import RosGraph
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint


def serve(node: Node, name: str) -> Node:
    """Offer a service that responds with a name."""

    def answer(_request: Any, response: Any) -> Any:
        response.success, response.message = True, name
        return response

    node.create_service(Trigger, 'server/act', answer)
    return node


def test_lost_call_is_repeated(ros_graph: RosGraph) -> None:
    """The node that received the first call has ended; the next node responds."""
    caller = ros_graph.node('caller')
    calls, client = Calls(caller), caller.create_client(Trigger, 'server/act')
    # Without a spinning executor it receives no request.
    first = serve(Node('server', context=ros_graph.context), 'first')
    ros_graph.spin_until(client.service_is_ready, 'the service')
    answer = calls.call(client, Trigger.Request())
    first.destroy_node()
    serve(ros_graph.node('server'), 'second')
    ros_graph.spin_until(answer.done, 'the answer')
    assert answer.result().message == 'second'


def test_call_without_response_times_out(ros_graph: RosGraph) -> None:
    operator = Operator(ros_graph.node('operator'))
    deaf = Node('controller', context=ros_graph.context)
    deaf.create_service(Trigger, 'controller/retract', lambda _request, response: response)
    client = operator._clients['controller', 'retract']
    try:
        ros_graph.spin_until(client.service_is_ready, 'the service')
        outcome = operator.ask('retract')
        ros_graph.spin_until(outcome.done, 'the outcome')
        line = f'controller/retract: no answer within {CALL_TIMEOUT:g} s'
        assert outcome.result() == (False, line)
    finally:
        deaf.destroy_node()


def test_lost_target_is_repeated(ros_graph: RosGraph) -> None:
    """The controller is started after the first message."""
    # The first controller compiles for seconds.
    ros_graph.add(ControllerNode, namespace='another')
    operator = Operator(ros_graph.node('operator'))
    pending = operator.target(0.0, 0.05, 0.0)
    assert operator._target.get_subscription_count() == 0
    controller = ros_graph.add(ControllerNode)
    ros_graph.spin_until(lambda: pending.done, 'the answer')
    assert pending.outcome == (True, 'controller: target accepted')
    assert controller.diagnose().status.target == 0.05


@pytest.mark.parametrize(
    ('depth', 'steered', 'line'),
    [
        (5.0, False, r'controller: target rejected: target depth must be in \[.*\] m, got 5.0'),
        (0.05, True, 'controller: no answer to target within 6 s'),
    ],
)
def test_rejected_target_is_never_reported_as_active(
    ros_graph: RosGraph, depth: float, steered: bool, line: str
) -> None:
    operator = Operator(ros_graph.node('operator'))
    controller = ros_graph.add(ControllerNode, parameters={'steered': steered})
    ros_graph.spin_until(
        lambda: operator._target.get_subscription_count() and 'controller' in operator.states,
        'the controller',
    )
    pending = operator.target(0.0, depth, 0.0)
    ros_graph.spin_until(lambda: pending.done, 'the answer')
    accepted, said = pending.outcome
    assert not accepted
    with pytest.raises(AssertionError, match=line):
        raise AssertionError(said)
    assert controller.diagnose().status.target is None


#: A trajectory with a point before its start.
BACKWARD = JointTrajectory(
    joint_names=['insertion'],
    points=[JointTrajectoryPoint(positions=[0.03], time_from_start=DurationMessage(sec=-1))],
)


@pytest.mark.requirement('S-277')
@pytest.mark.parametrize(
    ('kind', 'parameters', 'message'),
    [
        (PlantNode, {'mode': 'robot'}, BACKWARD),
        (ControllerNode, {}, BACKWARD),
        (SteeringNode, {}, PointStamped()),
    ],
)
def test_rejection_is_published_within_200_ms(
    ros_graph: RosGraph,
    monkeypatch: pytest.MonkeyPatch,
    kind: Any,
    parameters: dict[str, object],
    message: Any,
) -> None:
    """After its receipt, also for requests that arrive faster than the status is published."""
    received: dict[int, float] = {}
    published: dict[int, float] = {}
    check, publish = RequestLog.check, BaseNode.publish_diagnostics

    def on_check(log: RequestLog, topic: Any, stamp: int, *rest: Any, **more: Any) -> Any:
        received.setdefault(stamp, monotonic())
        return check(log, topic, stamp, *rest, **more)

    def on_publish(node: BaseNode) -> None:
        publish(node)
        if isinstance(node, kind):
            for one in node.diagnose().status.requests.answers:
                if one.refused:
                    published.setdefault(one.stamp, monotonic())

    monkeypatch.setattr(RequestLog, 'check', on_check)
    monkeypatch.setattr(BaseNode, 'publish_diagnostics', on_publish)
    user = ros_graph.node('user')
    topic = 'target' if kind is SteeringNode else 'joint_trajectory'
    sender = user.create_publisher(type(message), topic, COMMAND)
    ros_graph.add(kind, parameters=parameters)
    ros_graph.spin_until(sender.get_subscription_count, 'the receiver')
    longest = []
    # Five bursts: the load of other tests may delay one of them.
    for _ in range(5):
        received.clear()
        published.clear()
        for _ in range(5):
            message.header.frame_id = 'world'
            message.header.stamp = user.get_clock().now().to_msg()
            sender.publish(message)
            assert sender.wait_for_all_acked(Duration(seconds=10))
            ros_graph.executor.spin_once(timeout_sec=0.02)
        ros_graph.spin_until(
            lambda: received and received.keys() <= published.keys(), 'the rejections'
        )
        longest.append(max(published[stamp] - at for stamp, at in received.items()))
    assert min(longest) < 0.2
