# SPDX-License-Identifier: Apache-2.0
"""
Action ``follow_joint_trajectory`` of plant and controller, over DDS.

control_msgs is not available as a wheel: where it is not installed, the action is generated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from itertools import pairwise
import os
import signal
from types import SimpleNamespace
from typing import Any

from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND
from needle_ros.contract import REQUEST_AGE
from needle_ros.requests import Verdict
from needle_ros.trajectories import ErrorCode
import pytest
from rclpy.action.client import ActionClient
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from support.generated_messages import importable
from support.policies import ACTION, POLICY
from support.ros_graph import RosGraph
from support.trajectory_bench import Bench, DEPTH, PERIOD, SECOND, trajectory

KINDS = pytest.mark.parametrize('mode', ['robot', 'simulation'])
#: A motion of 5 s at 4 mm/s.
LONG = ((5.0, DEPTH + 0.02),)
STEERED = {'steered': True, 'needle': 'bending_35mm'}


@pytest.fixture(scope='module')
def actions(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Return the folder of control_msgs, generated if it is not installed."""
    with importable('control_msgs', tmp_path_factory.mktemp('control')) as entry:
        yield entry


class Client:
    """Sends a goal, and keeps its feedback, final status and result."""

    def __init__(self, graph: RosGraph, user: Any, server: str) -> None:
        self.graph = graph
        self.kind = import_module('control_msgs.action').FollowJointTrajectory
        self._client = ActionClient(user, self.kind, f'{server}/follow_joint_trajectory')
        self.until(self._client.server_is_ready, 'the action server')

    def until(self, condition: Callable[[], Any], what: str) -> None:
        self.graph.spin_until(condition, what, 60.0)

    def goal(self, message: Any, **tolerances: Any) -> Any:
        """
        Return a goal: tolerances as ``path`` or ``goal`` (joint, position, velocity).

        ``late`` is the goal_time_tolerance [s]; ``component`` are the fields, path or goal, with a
        tolerance of a multi-DOF joint.
        """
        kind = import_module('control_msgs.msg').JointTolerance
        goal = self.kind.Goal(trajectory=message)
        for field in ('path', 'goal'):
            for name, position, *velocity in tolerances.get(field, ()):
                one = kind(name=name, position=position, velocity=sum(velocity, 0.0))
                getattr(goal, f'{field}_tolerance').append(one)
        kind = import_module('control_msgs.msg').JointComponentTolerance
        for field in tolerances.get('component', ()):
            getattr(goal, f'component_{field}_tolerance').append(kind(joint_name='base'))
        late = divmod(round(tolerances.get('late', 0.0) * SECOND), SECOND)
        goal.goal_time_tolerance.sec, goal.goal_time_tolerance.nanosec = late
        return goal

    def send(self, message: Any, **tolerances: Any) -> SimpleNamespace:
        """Send a goal, and request its result."""
        sent = SimpleNamespace(feedback=[], result=None)
        future = self._client.send_goal_async(
            self.goal(message, **tolerances),
            feedback_callback=lambda one: sent.feedback.append(one.feedback),
        )
        self.until(future.done, 'the answer to the goal')
        sent.handle = future.result()
        assert sent.handle.accepted
        sent.handle.get_result_async().add_done_callback(
            lambda done: setattr(sent, 'result', done.result())
        )
        return sent

    def end(self, sent: SimpleNamespace) -> tuple[int, ErrorCode, str]:
        """Wait for the end of a goal; return status, error code and reason."""
        self.until(lambda: sent.result is not None, 'the result')
        result = sent.result.result
        return sent.result.status, ErrorCode(result.error_code), result.error_string


class ActionBench(Bench):
    """A bench whose user sends goals to the receiver."""

    def __init__(self, graph: RosGraph, mode: str, **more: object) -> None:
        super().__init__(graph, mode, **more)
        self.client = Client(graph, self.user, self.node.get_name())

    def run(self, *points: tuple[float, float], stamp: int = 0, **more: Any) -> SimpleNamespace:
        """Send a goal with depths [m] at times [s]."""
        return self.client.send(trajectory(stamp, [(t, [d]) for t, d in points]), **more)

    def start(self, **more: Any) -> SimpleNamespace:
        """Send a long goal, and wait until the needle moves."""
        sent = self.run(*LONG, **more)
        self.moved()
        return sent


ABORTED = GoalStatus.STATUS_ABORTED


@KINDS
@pytest.mark.requirement('S-249')
def test_policy_names_the_action(ros_graph: RosGraph, actions: str, mode: str) -> None:
    """All topics and services of actions of the node; no client adds its own."""
    bench = Bench(ros_graph, mode)
    name, user = bench.node.get_name(), bench.user

    def entities() -> set[str]:
        found = user.get_topic_names_and_types() + user.get_service_names_and_types()
        # Nodes of the test before may be in the graph for some time.
        return {one for one, _ in found if ACTION in one and one.startswith(f'/{name}/')}

    # Feedback and status; goal, cancel and result.
    bench.until(lambda: len(entities()) == 5, 'the discovery')
    assert {one.partition(ACTION)[0] for one in entities()} == POLICY[name].execute


@KINDS
@pytest.mark.requirement('S-278')
def test_goal_waits_during_a_pause(ros_graph: RosGraph, actions: str, mode: str) -> None:
    """For longer than its goal_time_tolerance; it succeeds at its end."""
    bench = ActionBench(ros_graph, mode)
    end = DEPTH + 8e-3
    sent = bench.run((3.0, end), late=2.0, goal=[('insertion', 1e-3)])
    bench.moved()
    bench.call('pause', SetBool, data=True)
    begin = bench.time
    bench.until(lambda: bench.time > begin + 8 * SECOND, 'the pause')
    assert sent.result is None
    assert bench.depth < DEPTH + 6e-3
    bench.call('pause', SetBool, data=False)
    assert bench.client.end(sent)[:2] == (GoalStatus.STATUS_SUCCEEDED, ErrorCode.SUCCESSFUL)
    assert abs(bench.depth - end) < 1e-3


@KINDS
@pytest.mark.requirement('S-243')
def test_goal_succeeds_within_tolerance(ros_graph: RosGraph, actions: str, mode: str) -> None:
    bench, near = ActionBench(ros_graph, mode), 5e-5
    end = DEPTH + 3e-3
    # MoveIt sends the frame of its model.
    message = trajectory(0, [(1.0, [end])])
    message.header.frame_id = 'world'
    sent = bench.client.send(message, path=[('insertion', 1e-3)], goal=[('insertion', near, 1e-3)])
    assert bench.client.end(sent) == (GoalStatus.STATUS_SUCCEEDED, ErrorCode.SUCCESSFUL, '')
    last = sent.feedback[-1]
    assert abs(last.desired.positions[0] - end) < 1e-9
    assert abs(last.actual.positions[0] - end) <= near
    assert last.joint_names == ['insertion']
    by_stamp = {bench.stamp(one): one for one in bench.states}
    aims = {bench.stamp(one): one for one in bench.aims}
    stamps = [bench.stamp(one) for one in sent.feedback]
    # 20 Hz of a second, and the last.
    assert 15 <= len(stamps) <= 40
    for stamp, one in zip(stamps, sent.feedback, strict=True):
        (desired,), (actual,), (error,) = (
            point.positions for point in (one.desired, one.actual, one.error)
        )
        assert error == pytest.approx(desired - actual, abs=1e-15)
        if stamp in by_stamp:
            assert actual == pytest.approx(by_stamp[stamp].position[0], abs=1e-12)
        # The reference that the controller follows.
        if stamp in aims:
            assert desired == aims[stamp].position[0]
    if mode == 'robot':
        # The reference of the base is linear in time.
        passed = [
            (stamp / SECOND, one.desired.positions[0])
            for stamp, one in zip(stamps, sent.feedback, strict=True)
            if one.desired.positions[0] < end
        ]
        slopes = [(b - a) / (t - s) for (s, a), (t, b) in pairwise(passed)]
        # Rounding of a stamp as a float: 1e-7 s of 50 ms.
        assert slopes == pytest.approx([3e-3] * len(slopes), rel=1e-4)
    assert by_stamp.keys() & {*stamps}


@pytest.mark.requirement('S-243')
def test_success_waits_for_the_joints(ros_graph: RosGraph, actions: str) -> None:
    """A reference faster than the base: 20 mm in 0.1 s, at 50 mm/s."""
    bench, end = ActionBench(ros_graph, 'robot'), DEPTH + 0.02
    sent = bench.run((0.1, end), goal=[('insertion', 1e-5)])
    assert bench.client.end(sent)[0] == GoalStatus.STATUS_SUCCEEDED
    assert abs(sent.feedback[-1].actual.positions[0] - end) <= 1e-5
    assert any(
        one.desired.positions[0] == end and one.actual.positions[0] < end - 5e-3
        for one in sent.feedback
    )


@pytest.mark.requirement('S-244')
def test_late_joints_violate_the_goal_tolerance(ros_graph: RosGraph, actions: str) -> None:
    bench, end = ActionBench(ros_graph, 'robot'), DEPTH + 0.02
    sent = bench.run((0.1, end), goal=[('insertion', 1e-5)], late=0.05)
    status, code, reason = bench.client.end(sent)
    assert (status, code) == (ABORTED, ErrorCode.GOAL_TOLERANCE_VIOLATED)
    assert reason.startswith('position error of insertion is 0.0')
    bench.rests(5e-3)
    assert bench.depth < end - 5e-3


@KINDS
@pytest.mark.requirement('S-244')
@pytest.mark.parametrize('kind', ['path', 'goal'])
def test_violated_tolerance_aborts_and_holds(
    ros_graph: RosGraph, actions: str, mode: str, kind: str
) -> None:
    """No joint is as exact as a picometer while it moves; velocity likewise."""
    bench = ActionBench(ros_graph, mode)
    tight: dict[str, Any] = {kind: [('insertion', 1e-12, 1e-12)]}
    points = LONG if kind == 'path' else ((0.2, DEPTH + 1e-3),)
    # The base of the plant arrives within two samples, the reference of a controller later.
    sent = bench.run(*points, late=1e-6 if mode == 'robot' else 0.5, **tight)
    status, code, reason = bench.client.end(sent)
    assert (status, code.name) == (ABORTED, f'{kind.upper()}_TOLERANCE_VIOLATED')
    assert 'of insertion is' in reason
    assert 'beyond its tolerance 1e-12' in reason
    bench.rests(1e-3)


@KINDS
@pytest.mark.requirement('S-242')
@pytest.mark.parametrize(
    ('change', 'code', 'reason'),
    [
        ({'joints': ['elbow']}, 'INVALID_JOINTS', 'joint_names must be some of insertion, each'),
        ({'joints': []}, 'INVALID_JOINTS', 'got none'),
        ({'joints': ['insertion'] * 2}, 'INVALID_JOINTS', 'got insertion, insertion'),
        ({'path': [('elbow', 1.0)]}, 'INVALID_JOINTS', 'path_tolerance must be some of'),
        ({'goal': [('insertion', -2.0)]}, 'INVALID_GOAL', 'goal_tolerance of insertion must be'),
        ({'component': ['path']}, 'INVALID_GOAL', 'component_path_tolerance must be empty'),
        ({'component': ['goal']}, 'INVALID_GOAL', 'must be empty, got base'),
        ({'points': []}, 'INVALID_GOAL', 'trajectory has no points'),
        ({'points': [(1.0, [9.0])]}, 'INVALID_GOAL', 'must'),
        ({'points': [(1.0, [0.03]), (0.5, [0.03])]}, 'INVALID_GOAL', 'increasing'),
        ({'since': 2.0}, 'OLD_HEADER_TIMESTAMP', 'all points are in the past, the last by'),
        ({'since': REQUEST_AGE + 1.0}, 'OLD_HEADER_TIMESTAMP', 'stale: its stamp is'),
        ({'since': -REQUEST_AGE - 9.0}, 'INVALID_GOAL', 'stale: its stamp is'),
    ],
)
def test_invalid_goals_are_aborted_with_code(
    ros_graph: RosGraph, actions: str, mode: str, change: dict[str, Any], code: str, reason: str
) -> None:
    bench = ActionBench(ros_graph, mode)
    bench.until(lambda: bench.time > 8 * SECOND, 'the time')
    change = dict(change)
    since = change.pop('since', None)
    stamp = 0 if since is None else bench.time - round(since * SECOND)
    points = change.pop('points', [(1.0, [DEPTH + 5e-3])])
    joints = change.pop('joints', ['insertion'])
    sent = bench.client.send(trajectory(stamp, points, joints), **change)
    status, found, why = bench.client.end(sent)
    assert (status, found.name) == (ABORTED, code)
    assert reason in why
    assert not sent.feedback
    bench.rests(1e-4)


@KINDS
@pytest.mark.requirement('S-245')
def test_cancel_holds(ros_graph: RosGraph, actions: str, mode: str) -> None:
    bench = ActionBench(ros_graph, mode)
    sent = bench.start()
    sent.handle.cancel_goal_async()
    assert bench.client.end(sent)[0] == GoalStatus.STATUS_CANCELED
    bench.rests(1e-3)
    again = bench.run((0.5, bench.depth + 1e-3))
    assert bench.client.end(again)[0] == GoalStatus.STATUS_SUCCEEDED


@KINDS
@pytest.mark.requirement('S-245')
def test_cancel_of_a_waiting_goal_moves_nothing(
    ros_graph: RosGraph, actions: str, mode: str
) -> None:
    """The goal in execution ends at its own end."""
    bench, end = ActionBench(ros_graph, mode), DEPTH + 4e-3
    first = bench.run((2.0, end), goal=[('insertion', 1e-4)])
    bench.moved()
    waiting = bench.run(*LONG, stamp=bench.time + 4 * SECOND)
    waiting.handle.cancel_goal_async()
    assert bench.client.end(waiting)[0] == GoalStatus.STATUS_CANCELED
    assert bench.client.end(first)[0] == GoalStatus.STATUS_SUCCEEDED
    assert abs(bench.depth - end) < 1e-3
    bench.rests(1e-3)


@KINDS
@pytest.mark.requirement('S-245')
@pytest.mark.parametrize('by', ['cancel', 'topic'])
def test_stop_needs_no_joint_states(ros_graph: RosGraph, actions: str, mode: str, by: str) -> None:
    """Time is paused, and no sample is taken."""
    bench = ActionBench(ros_graph, mode)
    sent = bench.start()
    assert bench.ask('plant/pause_time', SetBool, data=True).success
    paused = bench.time
    if by == 'cancel':
        sent.handle.cancel_goal_async()
        assert bench.client.end(sent)[0] == GoalStatus.STATUS_CANCELED
    else:
        stamp = bench.send(bench.time)
        assert bench.answer(stamp)[0] is Verdict.ACCEPTED
        assert bench.client.end(sent)[2] == 'a newer joint_trajectory is followed'
    assert bench.time - paused <= PERIOD
    bench.ask('plant/pause_time', SetBool, data=False)
    bench.rests(1e-3)


@KINDS
@pytest.mark.requirement('S-246')
def test_newer_trajectories_supersede_a_goal(ros_graph: RosGraph, actions: str, mode: str) -> None:
    """As message, as goal, or as goal that waits."""
    bench = ActionBench(ros_graph, mode)
    superseded = ABORTED, ErrorCode.INVALID_GOAL, 'a newer joint_trajectory is followed'
    first = bench.start()
    bench.send(0, (5.0, DEPTH + 0.02))
    assert bench.client.end(first) == superseded
    second = bench.run((5.0, DEPTH + 0.02))
    third = bench.run(*LONG, stamp=bench.time + 4 * SECOND)
    # It follows the second goal until the third begins; the fourth replaces both.
    assert second.result is None
    end = bench.depth + 1e-3
    fourth = bench.run((1.0, end), goal=[('insertion', 1e-4)])
    assert bench.client.end(third) == superseded
    assert bench.client.end(second) == superseded
    assert bench.client.end(fourth)[0] == GoalStatus.STATUS_SUCCEEDED
    # The reference of a superseded goal is not followed: 1 mm, with the error of the control law.
    assert abs(bench.depth - end) < 2e-4
    fifth = bench.start()
    begin = bench.depth
    bench.send(0, (1.0, begin + 4e-3))
    assert bench.client.end(fifth) == superseded
    bench.until(lambda: abs(bench.depth - begin - 4e-3) < 2e-4, 'the newer trajectory')


@pytest.mark.requirement('S-246', 'S-244')
def test_other_joints_of_a_goal_hold(ros_graph: RosGraph, actions: str) -> None:
    bench = ActionBench(ros_graph, 'robot', **STEERED)
    joints, names = ('guide_x', 'guide_z'), bench.states[-1].name
    x, z = (names.index(joint) for joint in joints)

    def at(joint: int) -> float:
        return float(bench.states[-1].position[joint])

    for tolerances in ({}, {'path': [('guide_x', 1e-12)]}):
        message = trajectory(0, [(4.0, [at(x) + 4e-3, at(z) + 4e-3])], joints)
        begin = at(z)
        sent = bench.client.send(message, **tolerances)
        if not tolerances:
            bench.until(partial(lambda start: at(z) > start + 1e-4, begin), 'a motion')
            bench.course.publish(trajectory(0, [(0.5, [at(x)])], joints[:1]))
        assert bench.client.end(sent)[0] == ABORTED
        held, time = at(z), bench.time
        bench.until(partial(lambda end: bench.time > end, time + 3 * SECOND), 'three seconds')
        # Brake within 10 ms of motion at 1 mm/s, and back.
        assert abs(at(z) - held) < 1e-4


def _transition(bench: ActionBench, *numbers: int) -> None:
    for number in numbers:
        request: Any = ChangeState.Request()
        request.transition.id = number
        name = f'{bench.node.get_name()}/change_state'
        assert bench.ask(name, ChangeState, transition=request.transition).success


def _by_service(word: str, bench: ActionBench) -> None:
    bench.call(word)


def _duplicate(bench: ActionBench) -> None:
    bench.user.create_publisher(JointState, 'joint_states', 10)


ENDS: dict[str, tuple[Callable[[ActionBench], object], str]] = {
    'stop': (partial(_by_service, 'stop'), 'stop'),
    'retract': (partial(_by_service, 'retract'), 'the needle is retracted'),
    'deactivate': (lambda b: _transition(b, Transition.TRANSITION_DEACTIVATE), 'is not active'),
    'cleanup': (
        lambda b: _transition(b, Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP),
        'is not active',
    ),
    'shutdown': (lambda b: _transition(b, Transition.TRANSITION_ACTIVE_SHUTDOWN), 'is not active'),
}


@KINDS
@pytest.mark.requirement('S-247', 'S-248')
@pytest.mark.parametrize('end', ENDS)
def test_every_end_of_the_motion_ends_the_goal(
    ros_graph: RosGraph, actions: str, mode: str, end: str
) -> None:
    bench = ActionBench(ros_graph, mode)
    sent, waiting = bench.start(), None
    if end != 'retract':
        waiting = bench.run(*LONG, stamp=bench.time + 4 * SECOND)
    act, reason = ENDS[end]
    act(bench)
    for one in filter(None, (sent, waiting)):
        status, code, why = bench.client.end(one)
        assert (status, code) == (ABORTED, ErrorCode.INVALID_GOAL)
        assert reason in why
    if end == 'cleanup':
        _transition(bench, Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
        before = bench.time
        bench.until(lambda: bench.time > before, 'samples')
        bench.until(bench.client._client.server_is_ready, 'the action server')
        again = bench.run((0.5, bench.depth + 1e-3))
        assert bench.client.end(again)[0] == GoalStatus.STATUS_SUCCEEDED
    elif end == 'deactivate':
        sent = bench.run(*LONG)
        assert bench.client.end(sent)[2] == 'the node is not active'
        _transition(bench, Transition.TRANSITION_ACTIVATE)
        bench.rests(1e-3)


@pytest.mark.requirement('S-247')
def test_reset_and_joint_commands_end_a_goal(ros_graph: RosGraph, actions: str) -> None:
    bench = ActionBench(ros_graph, 'robot')
    sent = bench.start()
    bench.until(lambda: bench.depth > DEPTH + 5e-3, 'a motion of 5 mm')
    _by_service('reset', bench)
    assert bench.client.end(sent) == (ABORTED, ErrorCode.INVALID_GOAL, 'the plant was reset')
    bench.until(lambda: abs(bench.depth - DEPTH) < 1e-4, 'the start')
    bench.rests(1e-4)
    sent = bench.start()
    waiting = bench.run(*LONG, stamp=bench.time + 4 * SECOND)
    command = bench.user.create_publisher(JointState, 'joint_commands', COMMAND)
    bench.until(command.get_subscription_count, 'the plant')
    message = JointState(name=['insertion'], position=[bench.depth])

    def commanded() -> bool:
        message.position[0] += 1e-9
        command.publish(message)
        return sent.result is not None

    bench.until(commanded, 'the result')
    for one in (sent, waiting):
        reason = bench.client.end(one)[1:]
        assert reason == (ErrorCode.INVALID_GOAL, 'joint_commands are followed')
    # Not executed at its start.
    start = bench.time + 4 * SECOND
    bench.until(lambda: bench.time > start, 'the start of the goal that waited')
    assert bench.node.diagnose().status.requests.answers[-1].verdict is Verdict.SUPERSEDED


@pytest.mark.requirement('S-247')
def test_error_of_the_plant_ends_a_goal(ros_graph: RosGraph, actions: str) -> None:
    """A pull leaves the range of the needle."""
    bench = ActionBench(ros_graph, 'robot')
    push = trajectory(0, [(0.1, [-10.0]), (9.0, [-10.0])], field='effort')
    # The second goal arrives at a plant that takes no samples.
    for _ in range(2):
        status, code, reason = bench.client.end(bench.client.send(push))
        assert (status, code) == (ABORTED, ErrorCode.INVALID_GOAL)
        assert reason.endswith('the plant has stopped')
    _by_service('reset', bench)
    sent = bench.run((0.5, DEPTH + 1e-3))
    assert bench.client.end(sent)[0] == GoalStatus.STATUS_SUCCEEDED


@pytest.mark.requirement('S-247')
def test_fault_of_the_controller_ends_goal_and_motion(ros_graph: RosGraph, actions: str) -> None:
    """The motion does not resume after the fault."""
    bench = ActionBench(ros_graph, 'simulation')
    sent = bench.start()
    other = bench.user.create_publisher(JointState, 'joint_states', 10)
    status, code, reason = bench.client.end(sent)
    assert (status, code) == (ABORTED, ErrorCode.INVALID_GOAL)
    assert 'joint_states' in reason
    bench.user.destroy_publisher(other)
    bench.until(lambda: bench.node.diagnose().status.fault == '', 'the end of the fault')
    bench.rests(1e-3)


@KINDS
@pytest.mark.requirement('S-242')
def test_goal_awaits_its_start(ros_graph: RosGraph, actions: str, mode: str) -> None:
    bench = ActionBench(ros_graph, mode)
    start = bench.time + 2 * SECOND
    sent = bench.run((0.5, DEPTH + 2e-3), stamp=start)
    assert start - PERIOD <= bench.moved() < start + SECOND
    assert bench.client.end(sent)[0] == GoalStatus.STATUS_SUCCEEDED


@KINDS
@pytest.mark.requirement('S-242')
def test_late_goal_joins_at_its_points_ahead(ros_graph: RosGraph, actions: str, mode: str) -> None:
    """It does not go to the points in the past, and ends on time."""
    bench = ActionBench(ros_graph, mode)
    bench.until(lambda: bench.time > 3 * SECOND, 'the time')
    stamp, end = bench.time - 2 * SECOND, DEPTH - 4e-3
    sent = bench.run((0.5, DEPTH + 0.01), (6.0, end), stamp=stamp, goal=[('insertion', 1e-4)])
    assert bench.client.end(sent)[0] == GoalStatus.STATUS_SUCCEEDED
    # The controller joins with a detour below the error of a limit of acceleration.
    assert max(one.position[0] for one in bench.states) < DEPTH + 1e-3
    assert stamp + 5.5 * SECOND < bench.time < stamp + 9 * SECOND


@pytest.mark.requirement('S-242')
def test_indenter_takes_goals_of_efforts(ros_graph: RosGraph, actions: str) -> None:
    user = ros_graph.node('user')
    ros_graph.add(PlantNode, parameters={'mode': 'indenter', 'rate': 200.0})
    client = Client(ros_graph, user, 'plant')
    first = client.send(trajectory(0, [(9.0, [2.0, 1.0])], ('x', 'z'), 'effort'))
    client.until(lambda: first.feedback, 'feedback')
    sent = client.send(trajectory(0, [(0.5, [1.0, 0.5])], ('x', 'z'), 'effort'))
    assert client.end(first)[0] == ABORTED
    assert client.end(sent)[0] == GoalStatus.STATUS_SUCCEEDED
    assert sent.feedback[-1].desired.effort.tolist() == pytest.approx([1.0, 0.5])
    # The noise of the sensor.
    assert sent.feedback[-1].error.effort.tolist() == pytest.approx([0.0, 0.0], abs=0.5)


@pytest.mark.requirement('S-248')
def test_process_ends_its_goals(ros_graph: RosGraph, actions: str) -> None:
    """At SIGTERM, with the executor of the process."""
    user = ros_graph.node('user')
    ros_graph.environment['PYTHONPATH'] = os.pathsep.join(
        filter(None, (actions, os.environ.get('PYTHONPATH')))
    )
    started = ros_graph.start('plant', {'mode': 'robot', 'depth': DEPTH})
    ros_graph.wait_active(user, 'plant')
    client = Client(ros_graph, user, 'plant')
    sent = client.send(trajectory(0, [(0.2, [DEPTH + 1e-3])]), goal=[('insertion', 1e-4)])
    assert client.end(sent)[0] == GoalStatus.STATUS_SUCCEEDED
    sent = client.send(trajectory(0, [(9.0, [DEPTH + 0.02])]))
    client.until(lambda: sent.feedback, 'feedback')
    started.process.send_signal(signal.SIGTERM)
    ended: list[Any] = []

    def taken() -> bool:
        if sent.result is not None:
            ended.append(sent.result)
        return bool(ended)

    ros_graph._processes.clear()
    ros_graph.spin_until(taken, 'the result', 20.0)
    assert client.end(sent)[2] == 'the plant is not active'
    assert started.process.wait(60) == 0
