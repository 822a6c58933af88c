# SPDX-License-Identifier: Apache-2.0
"""Robot drivers with their own topics, joints and units, controlled by parameters only."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from importlib.util import find_spec
import json
import os
from pathlib import Path
import re
import runpy
import subprocess
import sys
import textwrap
from typing import Any

from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_controller.controller_node import ControllerNode
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.status import CommissioningPhase
from needle_ros.system_state import Mode
import pytest
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from support.installed import ROOT
from support.ros_graph import ControllerBench, RosGraph
from trajectory_msgs.msg import JointTrajectory
import yaml

DRIVERS = runpy.run_path(str(ROOT / 'examples/robot_driver.py'), run_name='drivers')

COMMON: dict[str, Any] = {'rate': 200.0, 'deflection_feedback': 'none'}

#: Parameters of docs/howto/own-robot.md.
FORCE = {
    **COMMON,
    'hardware.joint': 'slide',
    'hardware.sign': -1.0,
    'hardware.zero': 0.2,
    'hardware.wrench_topic': 'ft_sensor/wrench',
    'hardware.wrench_frame': 'ft_frame',
    'hardware.force_axis': '-z',
    'hardware.reaction': True,
    'hardware.command_topic': 'slide/commands',
    'hardware.command_type': 'float64_multi_array',
    'hardware.commissioning.positions': [0.2, 0.05],
    'hardware.commissioning.depths': [0.0, 0.15],
    'hardware.commissioning.start_depth': 0.02,
}
POSITION = {
    **COMMON,
    'hardware.joint': 'stage',
    'hardware.scale': 1e-3,
    'hardware.zero': 100.0,
    'hardware.command': 'position',
    'hardware.command_topic': 'stage/joint_trajectory',
    'hardware.command_type': 'joint_trajectory',
    'hardware.commissioning.positions': [100.0, 250.0],
    'hardware.commissioning.depths': [0.0, 0.15],
    'hardware.commissioning.start_depth': 0.02,
}
#: Robots, with their first and last insertion depth.
ROBOTS = {'force': (FORCE, 'ForceRobot'), 'position': (POSITION, 'PositionRobot')}


class Bench(ControllerBench):
    """A robot of examples/robot_driver.py, a controller, and a user."""

    def __init__(self, graph: RosGraph, which: str = 'force', **parameters: Any) -> None:
        own, name = ROBOTS[which]
        self.graph, self.user = graph, graph.node('user')
        self.goal: PointStamped | None = None
        given = {key.replace('__', '.'): value for key, value in parameters.items()}
        self.parameters = {**own, **given}
        self.robot = graph.add(DRIVERS[name])
        self.clear = self.user.create_client(Trigger, 'controller/clear_stop')
        self.target = self.user.create_publisher(PointStamped, 'target', COMMAND)
        kind = Float64MultiArray if which == 'force' else JointTrajectory
        self.topic = str(self.parameters['hardware.command_topic'])
        self.commands = graph.listen(self.user, kind, self.topic, 10)
        self.controller = graph.add(ControllerNode, parameters=self.parameters)
        self.until(
            lambda: (
                self.user.count_publishers(self.topic) == 1
                and self.target.get_subscription_count()
                and self.taken('joint_states')
                # No position is commanded before the first motion.
                and (self.commands or which == 'position')
            ),
            'discovery',
        )

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until a condition holds; repeat a discarded target."""

        def holds() -> Any:
            # On a busy machine a fault may occur during the motion, and the rate may be wrong at
            # its begin.
            if any(word in str(self.stop) for word in ('is received at', ' late')):
                self.clear.call_async(Trigger.Request())
            if self.goal is not None and self.status.target is None:
                self.target.publish(self.goal)
            return condition()

        self.graph.spin_until(holds, what)

    def taken(self, topic: str) -> int:
        """Return the number of accepted messages of a topic."""
        return self.input(topic).accepted

    @property
    def said(self) -> str:
        """First diagnostics message of the controller."""
        return str(self.controller.diagnose().message)

    @property
    def stop(self) -> str | None:
        """Reason of the stop."""
        reason: str | None = self.controller._supervisor.safety.stop
        return reason

    def aim(self, depth: float) -> None:
        """Send a target until it is accepted."""
        self.goal = PointStamped()
        self.goal.point.y = depth
        self.target.publish(self.goal)
        self.until(lambda: self.status.target == depth, 'the target')

    def arrive(self, depth: float) -> None:
        """Spin until the robot is at a depth [m]."""
        self.until(lambda: abs(self.depth - depth) < 1e-4, f'{depth} m')

    @property
    def depth(self) -> float:
        """Insertion depth reported by the robot [m]."""
        if hasattr(self.robot, 'mass'):
            return float(0.2 - self.robot.mass.position)
        return float(1e-3 * (self.robot.position - 100.0))

    def values(self) -> list[float]:
        """Return all commanded values."""
        if self.commands and isinstance(self.commands[0], Float64MultiArray):
            return [one.data[0] for one in self.commands]
        return [one.points[0].positions[0] for one in self.commands]


def test_example_drivers_are_short_and_independent() -> None:
    """At most 20 lines, without the topic contract."""
    page = ast.parse((ROOT / 'examples/robot_driver.py').read_text(encoding='utf-8'))
    drivers = [
        part
        for part in page.body
        if isinstance(part, ast.ClassDef) and part.name.endswith('Robot')
    ]
    assert [driver.name for driver in drivers] == ['ForceRobot', 'PositionRobot']
    for driver in drivers:
        for part in ast.walk(driver):
            if isinstance(part, (ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(part):
                part.body = part.body[1:]
        lines = [line for line in ast.unparse(driver).splitlines()[1:] if line]
        assert len(lines) <= 20
        assert not any(word in ast.unparse(driver) for word in ('needle', 'insertion'))


def test_documented_parameters_equal_tested_parameters() -> None:
    page = (ROOT / 'docs/howto/own-robot.md').read_text(encoding='utf-8')
    lines = [
        {name: yaml.safe_load(value) for name, value in re.findall(r'-p (\S+?):=(\S+)', block)}
        for block in re.findall(r'^```bash\n(.*?)^```', page, flags=re.DOTALL | re.MULTILINE)
        if 'hardware.' in block
    ]
    assert lines == [FORCE, POSITION]


@pytest.mark.parametrize('command', ['effort', 'position'])
@pytest.mark.parametrize('kind', ['float64_multi_array', 'joint_trajectory', 'joint_state'])
def test_message_types_are_equivalent(ros_graph: RosGraph, kind: str, command: str) -> None:
    """Over DDS: the joints in their order, and only the commanded values."""
    user = ros_graph.node('user')
    states = user.create_publisher(JointState, 'joint_states', SENSOR)
    types = {
        'float64_multi_array': Float64MultiArray,
        'joint_trajectory': JointTrajectory,
        'joint_state': JointState,
    }
    told = ros_graph.listen(user, types[kind], 'told', COMMAND)
    parameters = {
        **COMMON,
        'hardware.joint': 'slide',
        'hardware.command': command,
        'hardware.command_type': kind,
        'hardware.command_topic': 'told',
        'hardware.command_joints': ['door', 'slide'],
        'hardware.commissioning.enabled': False,
    }
    ros_graph.add(ControllerNode, parameters=parameters)

    def answered() -> bool:
        message = JointState(name=['slide', 'door'], position=[0.02, 1.0], velocity=[0.0, 0.0])
        message.header.stamp = user.get_clock().now().to_msg()
        states.publish(message)
        return bool(told)

    ros_graph.spin_until(answered, 'a command')
    values, message = [0.0, 0.0] if command == 'effort' else [1.0, 0.02], told[0]
    if kind == 'float64_multi_array':
        assert list(message.data) == values
        return
    if kind == 'joint_trajectory':
        assert message.joint_names == ['door', 'slide']
        (point,) = message.points
        # Reached within a period.
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (0, 0)
        assert (point.time_from_start.sec, point.time_from_start.nanosec) == (0, 5_000_000)
        positions, velocities, efforts = point.positions, point.velocities, point.effort
    else:
        assert message.name == ['door', 'slide']
        assert message.header.stamp.sec > 0
        positions, velocities, efforts = message.position, message.velocity, message.effort
    assert list(positions) == (values if command == 'position' else [])
    assert list(efforts) == (values if command == 'effort' else [])
    assert list(velocities) == []


@pytest.mark.requirement('S-102')
@pytest.mark.parametrize('which', ROBOTS)
def test_foreign_robot_is_controlled_by_parameters_only(ros_graph: RosGraph, which: str) -> None:
    """To 0.05 m and back to 0.03 m, by effort and by position."""
    bench = Bench(ros_graph, which)
    assert bench.depth == pytest.approx(0.02)
    for target in (0.05, 0.03):
        bench.aim(target)
        bench.arrive(target)
    assert bench.stop is None
    if which == 'force':
        assert bench.taken('base_wrench') > 100
        # The whole joint state is read, with the effort, which is monitored.
        assert max(bench.values()) > 0.5 > -0.5 > min(bench.values())
    else:
        values = bench.controller.diagnose().status
        assert values.velocity_source == 'estimated'
        steps = [abs(b - a) for a, b in zip(bench.values(), bench.values()[1:], strict=False)]
        # In mm: 0.05 m/s for two periods of 5 ms, and at most 2 mm from the robot.
        assert max(steps) <= 2.0


@pytest.mark.parametrize('which', ROBOTS)
def test_first_motion_is_checked(ros_graph: RosGraph, which: str) -> None:
    """With its result in the status; also as the response to a retraction."""
    bench = Bench(ros_graph, which)
    assert bench.status.commissioning is CommissioningPhase.WAITING
    client = bench.user.create_client(Trigger, 'controller/retract')
    bench.until(client.service_is_ready, 'the service')

    def passed() -> bool:
        if bench.status.system is Mode.RUNNING:
            client.call_async(Trigger.Request())
        return bench.status.commissioning is CommissioningPhase.PASSED

    bench.until(passed, 'the check')
    assert re.fullmatch(r'moved -0\.\d+ mm, .* ms late, .*', bench.status.commissioning_result)
    # Then the retraction is executed.
    bench.arrive(0.01)
    assert bench.stop is None


@pytest.mark.parametrize('which', ROBOTS)
def test_wrong_start_depth_refuses_the_first_motion(ros_graph: RosGraph, which: str) -> None:
    """The system is stopped, and the robot gets no force and no position."""
    bench = Bench(ros_graph, which, hardware__commissioning__start_depth=0.05)
    bench.goal = PointStamped()
    bench.goal.point.y = 0.1
    bench.until(lambda: bench.stop, 'the refusal')
    assert bench.status.commissioning is CommissioningPhase.REFUSED
    assert str(bench.stop).startswith('first motion refused: the insertion depth is 0.02 m, measu')
    assert bench.depth == pytest.approx(0.02, abs=1e-12)
    assert {*bench.values()} <= {0.0}
    assert which == 'force' or not bench.commands


def test_wrong_sign_is_rejected_at_the_start(ros_graph: RosGraph) -> None:
    """With a matching zero, by which the depth is correct."""
    parameters = {**FORCE, 'hardware.sign': 1.0, 'hardware.zero': 0.16}
    controller = ros_graph.add(ControllerNode, start=False, parameters=parameters)
    assert not controller.start()
    assert str(controller.failure).startswith('hardware.sign must be -1 with the depths 0 and ')


@pytest.mark.requirement('S-208')
def test_check_is_skipped_by_a_parameter(ros_graph: RosGraph) -> None:
    bench = Bench(ros_graph, hardware__commissioning__enabled=False)
    assert bench.status.commissioning is CommissioningPhase.SKIPPED
    bench.aim(0.03)
    bench.arrive(0.03)


@pytest.mark.requirement('S-107')
def test_force_sensor_limit_stops_the_robot(ros_graph: RosGraph) -> None:
    """The mapped axial force above its limit ends the motion."""
    bench = Bench(ros_graph, safety__axial_load=0.3)
    bench.aim(0.05)
    bench.until(lambda: bench.stop, 'the stop')
    assert bench.stop is not None
    # Already in the first motion, out of the tissue.
    assert bench.stop.startswith('axial force -0.3')
    bench.until(lambda: bench.values()[-1] == 0.0 == bench.robot.mass.velocity, 'rest')


@pytest.mark.requirement('S-107')
def test_position_robot_holds_its_measured_position_after_a_stop(ros_graph: RosGraph) -> None:
    """A load above its limit ends the motion at the position of the robot."""
    bench = Bench(ros_graph, 'position', hardware__wrench_topic='load')
    loads = bench.user.create_publisher(WrenchStamped, 'load', SENSOR)
    bench.aim(0.05)
    bench.until(lambda: bench.depth > 0.025, 'motion')

    def press() -> str | None:
        message = WrenchStamped()
        message.header.frame_id = 'needle_base'
        message.header.stamp = bench.user.get_clock().now().to_msg()
        message.wrench.force.y = 40.0
        loads.publish(message)
        return bench.stop

    bench.until(press, 'the stop')
    assert str(bench.stop).startswith('axial force 40 N is beyond the limit of 30 N')
    count = len(bench.commands)
    bench.until(lambda: len(bench.commands) > count + 20, 'commands after it')
    (rest,) = {*bench.values()[-10:]}
    # Back from the lead to the measured position.
    assert rest < max(bench.values()[:count])
    bench.until(lambda: abs(bench.robot.position - rest) < 1e-3, 'rest')
    assert 0.025 < bench.depth < 0.05


@pytest.mark.requirement('S-113', 'S-330')
@pytest.mark.parametrize('required', [False, True])
def test_wrong_frame_is_reported(ros_graph: RosGraph, required: bool) -> None:
    """With the expected frame; a required sensor stops the motion."""
    bench = Bench(ros_graph, hardware__wrench_frame='tool0', safety__sensors_required=required)
    said = "no valid message for .* s; base_wrench must be in frame 'tool0', got 'ft_frame'"
    bench.until(lambda: re.search(said, bench.said), 'the warning')
    assert bench.taken('base_wrench') == 0
    if required:
        bench.until(lambda: bench.stop, 'the stop')
    assert (bench.stop is not None) == required


@pytest.mark.requirement('S-331')
def test_force_sensor_that_no_node_publishes_is_reported(ros_graph: RosGraph) -> None:
    """With the published topics of its type."""
    bench = Bench(ros_graph, hardware__wrench_topic='typo/wrench')
    said = (
        'base_wrench is stale: no valid message for .* s; no node publishes typo/wrench; '
        r'geometry_msgs/msg/WrenchStamped is published on /ft_sensor/wrench \(hardware.wr'
    )
    bench.until(lambda: re.match(said, bench.said), 'the warning')


def test_no_force_sensor_is_expected_without_its_topic(ros_graph: RosGraph) -> None:
    bench = Bench(ros_graph, 'position', safety__sensor_timeout=0.1)
    bench.until(lambda: bench.taken('joint_states') > 200, 'a second')
    assert 'base_wrench' not in bench.said


@pytest.mark.parametrize(
    ('parameters', 'said'),
    [
        ({'hardware.scale': 0.0}, 'hardware.scale must be finite, > 0 m, got 0.0'),
        (
            {'hardware.force_axis': 'w'},
            "hardware.force_axis must be x, y, z, -x, -y or -z, got 'w'",
        ),
        ({'hardware.state_topic': 'a b'}, "hardware: the topic 'a b': Invalid topic name"),
        ({'hardware.command': 'position'}, 'hardware.command_type must be one of float64_multi_a'),
        ({'hardware.joint': 3}, 'hardware.joint must be text, got 3'),
    ],
)
def test_invalid_parameters_fail_configure(
    ros_graph: RosGraph, parameters: dict[str, Any], said: str
) -> None:
    """One line with the valid values."""
    controller = ros_graph.add(ControllerNode, start=False, parameters=parameters)
    assert not controller.start()
    assert str(controller.failure).startswith(said)
    assert '\n' not in str(controller.failure)


@pytest.mark.skipif(find_spec('control_msgs') is not None, reason='control_msgs is installed')
def test_missing_package_is_reported(ros_graph: RosGraph) -> None:
    """DynamicJointState is not available as a wheel."""
    controller = ros_graph.add(
        ControllerNode, start=False, parameters={'hardware.state_type': 'dynamic_joint_state'}
    )
    assert not controller.start()
    assert controller.failure == (
        'hardware.state_type dynamic_joint_state: control_msgs/msg/DynamicJointState is not '
        'installed'
    )


def test_topics_of_a_robot_may_change_between_configurations(ros_graph: RosGraph) -> None:
    """The publishers of the configuration before are destroyed."""
    user, topics = ros_graph.node('user'), ('wrench_command', 'slide/commands')
    controller = ros_graph.add(ControllerNode)

    def offered(*names: str) -> bool:
        return [name for name in topics if user.count_publishers(name)] == [*names]

    ros_graph.spin_until(lambda: offered('wrench_command'), 'the topic of the contract')
    changes = [Parameter(name, value=value) for name, value in FORCE.items()]
    assert not all(one.successful for one in controller.set_parameters(changes))
    controller.trigger_deactivate()
    controller.trigger_cleanup()
    ros_graph.spin_until(offered, 'no commands')
    assert all(one.successful for one in controller.set_parameters(changes))
    assert controller.start(), controller.failure
    ros_graph.spin_until(lambda: offered('slide/commands'), 'the topic of the robot')


def test_axis_y_is_not_read_as_true(ros_graph: RosGraph) -> None:
    """YAML 1.1 parses y as true."""
    parameters = {**FORCE, 'hardware.force_axis': True, 'hardware.lateral_axis': '-x'}
    controller = ros_graph.add(ControllerNode, parameters=parameters)
    assert controller._driver.robot.settings.force_axis == 'y'


@pytest.fixture
def stranger(ros_graph: RosGraph) -> Iterator[Node]:
    """Return a node of another participant: a participant cannot have two types on a topic."""
    context = Context()
    context.init(domain_id=int(ros_graph.environment['ROS_DOMAIN_ID']))
    node = Node('stranger', context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


@pytest.mark.requirement('S-112')
@pytest.mark.parametrize('there', ['elsewhere', 'another type', 'other joints'])
def test_missing_input_is_explained(ros_graph: RosGraph, stranger: Node, there: str) -> None:
    """With the existing topics, their types, and their joints."""
    user = ros_graph.node('user')
    states = user.create_publisher(JointState, 'arm/joint_states', SENSOR)
    topic = 'arm/joint_states' if there == 'other joints' else 'arm/states'
    if there == 'another type':
        stranger.create_publisher(String, topic, 10)
    parameters = {**FORCE, 'hardware.state_topic': topic}
    controller = ros_graph.add(ControllerNode, parameters=parameters)
    expected = {
        'elsewhere': 'no joint_states yet: no node publishes arm/states; '
        'sensor_msgs/msg/JointState is published on /arm/joint_states (hardware.state_topic)',
        'another type': 'no joint_states yet: arm/states is published as std_msgs/msg/String, and '
        'read as sensor_msgs/msg/JointState (hardware.state_topic, hardware.state_type)',
        'other joints': "joint_states has no position of the joint 'slide'; positions found: 'a', "
        "'b' (hardware.joint, hardware.command_joints)",
    }[there]

    def said() -> bool:
        message = JointState(name=['a', 'b'], position=[0.0, 1.0], velocity=[0.0, 0.0])
        message.header.stamp = user.get_clock().now().to_msg()
        states.publish(message)
        return str(controller.diagnose().message) == expected

    ros_graph.spin_until(said, expected)


def test_topics_are_found_by_type(ros_graph: RosGraph) -> None:
    """A single topic is used; two topics are an error that names both."""
    auto = {'hardware__state_topic': 'auto', 'hardware__wrench_topic': 'auto'}
    bench = Bench(ros_graph, **auto)
    bench.until(lambda: bench.taken('base_wrench') > 0, 'the force sensor')
    assert bench.status.robot == '/joint_states, effort of slide on slide/commands'
    bench.user.create_publisher(JointState, 'arm/joint_states', 10)
    late = ros_graph.add(ControllerNode, start=False, parameters=bench.parameters)
    assert not late.start()
    assert late.failure is not None
    assert late.failure.startswith(
        'hardware: auto for joint_states needs one topic of sensor_msgs/msg/JointState that '
        'other nodes publish, found /arm/joint_states, /joint_states'
    )


@pytest.mark.requirement('S-106')
@pytest.mark.parametrize(
    ('kind', 'topic', 'said'),
    [
        (Float64MultiArray, 'slide/commands', '2 nodes publish wrench_command'),
        (JointState, 'joint_states', '2 nodes publish joint_states'),
    ],
)
def test_duplicate_source_or_commander_gives_zero_force(
    ros_graph: RosGraph, kind: type, topic: str, said: str
) -> None:
    """For the topics of the driver."""
    bench = Bench(ros_graph)
    bench.aim(0.15)
    bench.until(lambda: bench.depth > 0.021, 'motion')
    stranger = bench.user.create_publisher(kind, topic, 10)
    bench.until(lambda: bench.said == said, said)
    bench.until(lambda: bench.values()[-1] == 0.0 == bench.robot.mass.velocity, 'rest')
    bench.user.destroy_publisher(stranger)
    bench.until(lambda: bench.robot.mass.velocity < -1e-3, 'motion again')


@pytest.mark.requirement('S-325')
@pytest.mark.parametrize('stopped', [True, False])
def test_position_robot_that_was_moved_is_not_moved_back(
    ros_graph: RosGraph, *, stopped: bool
) -> None:
    """Moved by hand without drive, in a stop or at the target: nothing moves with the drive."""
    bench = Bench(ros_graph, 'position')
    bench.aim(0.04)
    bench.arrive(0.04)
    bench.goal = None
    if stopped:
        stop = bench.user.create_client(Trigger, 'controller/stop')
        bench.until(stop.service_is_ready, 'the service')
        stop.call_async(Trigger.Request())
        bench.until(lambda: bench.stop, 'the stop')
    robot = bench.robot
    (listens,) = (one for one in robot.subscriptions if one.topic_name.endswith('trajectory'))
    drive, listens.callback = listens.callback, lambda _message: None
    robot.position = robot.goal = 130.0
    bench.until(lambda: bench.stop, 'the stop')
    count = len(bench.commands)
    bench.until(lambda: len(bench.commands) > count + 50, 'commands after it')
    listens.callback = drive
    count = len(bench.commands)
    bench.until(lambda: len(bench.commands) > count + 50, 'commands with drive')
    # A tenth of the lead of 2 mm.
    assert max(bench.values()[count:]) < 130.2
    assert robot.position < 130.2


@pytest.mark.requirement('S-326')
def test_restarted_position_robot_gets_no_old_position(ros_graph: RosGraph) -> None:
    """While two nodes publish joint states, and after: it rests where it has started."""
    bench = Bench(ros_graph, 'position')
    bench.aim(0.15)
    bench.until(lambda: bench.depth > 0.03, 'motion')
    bench.goal = None
    first = bench.robot
    for timer in list(first.timers):
        first.destroy_timer(timer)
    bench.until(lambda: 'joint_states is stale' in bench.status.fault, 'the watchdog')
    count = len(bench.commands)
    second = ros_graph.add(DRIVERS['PositionRobot'])
    second.position = second.goal = 110.0
    bench.until(lambda: bench.said == '2 nodes publish joint_states', 'two publishers')
    bench.until(lambda: sum(bench.input('joint_states').rejected.values()) > 50, 'measurements')
    first.destroy_publisher(first.states)
    bench.until(lambda: bench.said != '2 nodes publish joint_states', 'one publisher')
    count = len(bench.commands)
    bench.until(lambda: len(bench.commands) > count + 20, 'commands')
    assert max(bench.values()[count:]) < 110.2
    assert second.position < 110.2


@pytest.mark.requirement('S-314')
def test_position_robot_short_of_its_target_stops_the_system(ros_graph: RosGraph) -> None:
    """By less than the lead of 2 mm."""
    bench = Bench(ros_graph, 'position')
    robot, drive = bench.robot, bench.robot.on_command
    (listens,) = (one for one in robot.subscriptions if one.topic_name.endswith('trajectory'))

    def limited(message: JointTrajectory) -> None:
        drive(message)
        robot.goal = min(robot.goal, 139.0)

    listens.callback = limited
    bench.aim(0.04)
    bench.goal = None
    bench.until(lambda: bench.stop, 'the stop')
    assert str(bench.stop).startswith('the robot does not follow its position command: 0')
    bench.until(lambda: bench.values()[-1] < 139.2, 'a command at the robot')


@pytest.mark.requirement('S-103')
def test_zero_command_is_repeated_after_loss_of_measurements(ros_graph: RosGraph) -> None:
    """A driver without a timeout would keep the last effort if one message is lost."""
    bench = Bench(ros_graph)
    bench.aim(0.15)
    bench.until(lambda: bench.values()[-1] < -0.5, 'a force')
    for timer in list(bench.robot.timers):
        bench.robot.destroy_timer(timer)
    bench.until(lambda: 'joint_states is stale' in bench.status.fault, 'the watchdog')
    count = len(bench.commands)
    bench.until(lambda: len(bench.commands) > count + 15, 'more commands')
    assert {*bench.values()[-10:]} == {0.0}


@pytest.mark.requirement('S-104')
@pytest.mark.parametrize('which', ROBOTS)
def test_final_command_is_repeated(ros_graph: RosGraph, which: str) -> None:
    """At deactivation: zero effort, or the current position."""
    bench = Bench(ros_graph, which)
    bench.aim(0.15)
    bench.until(lambda: bench.depth > 0.022, 'motion')
    last = bench.values()[-1]
    bench.commands.clear()
    bench.controller.trigger_deactivate()
    bench.until(lambda: len(bench.commands) >= 6, 'the last commands')
    (rest,) = {*bench.values()[-5:]}
    assert rest == (0.0 if which == 'force' else pytest.approx(last, abs=1.0))
    if which == 'force':
        bench.until(lambda: bench.robot.mass.effort == 0.0, 'no effort')
    else:
        bench.until(lambda: abs(bench.robot.position - rest) < 1e-3, 'rest')


@pytest.mark.requirement('S-105')
@pytest.mark.parametrize('ending', ['interrupted', 'fails'])
def test_ended_process_leaves_zero_effort(
    ros_graph: RosGraph, tmp_path: Path, ending: str
) -> None:
    """After Ctrl-C and after an internal error; SIGKILL cannot be handled."""
    robot = ros_graph.add(DRIVERS['ForceRobot'])
    user = ros_graph.node('user')
    efforts = ros_graph.listen(user, Float64MultiArray, 'slide/commands', 100)
    target = user.create_publisher(PointStamped, 'target', COMMAND)
    words = [f'-p {name}:={json.dumps(value, separators=(",", ":"))}'
             for name, value in FORCE.items()]  # fmt: skip
    # The response to a pause fails while a force is applied.
    script = textwrap.dedent(
        """
        import sys
        from needle_controller.controller_node import ControllerNode
        from needle_ros.run_node import run
        class Faulty(ControllerNode):
            def __init__(self):
                super().__init__()
                self._supervisor.request = lambda word, now: 1 / 0
        sys.exit(run(Faulty))
        """
    )
    log = tmp_path / 'log'
    with log.open('w') as output:
        process = subprocess.Popen(
            [sys.executable, '-c', script, '--ros-args', *' '.join(words).split()],
            env={**ros_graph.environment, 'PYTHONPATH': os.pathsep.join(sys.path)},
            stderr=output,
        )
    try:
        message = PointStamped()
        message.point.y = 0.15

        def pushed() -> bool:
            target.publish(message)
            assert process.poll() is None
            return robot.mass.effort < -0.5

        ros_graph.spin_until(pushed, 'a force', timeout=180.0)
        if ending == 'interrupted':
            process.terminate()
        else:
            client = user.create_client(SetBool, 'controller/pause')
            ros_graph.spin_until(client.service_is_ready, 'the service')
            client.call_async(SetBool.Request(data=True))
        ros_graph.spin_until(lambda: process.poll() is not None, 'its end')
        ros_graph.spin_until(lambda: robot.mass.effort == 0.0, 'no effort')
        assert (process.returncode == 0) == (ending == 'interrupted')
        assert [one.data[0] for one in efforts[-5:]] == [0.0] * 5
        assert ('ZeroDivisionError' in log.read_text()) == (ending == 'fails')
    finally:
        process.kill()
        process.wait()


def test_wrong_rate_is_reported(ros_graph: RosGraph) -> None:
    """With both rates and the parameter; no warning at the correct rate."""
    bench = Bench(ros_graph, rate=1000.0)
    words = r'joint_states is received at .* Hz, rate is 1000 Hz: set rate to '
    bench.until(lambda: re.match(words, bench.status.warning), 'the rate')


@pytest.mark.requirement('S-111')
@pytest.mark.parametrize(
    ('stamps', 'said'),
    [
        ('header', 'joint_states is stale: it is not stamped (hardware.stamps)'),
        ('receive', 'active'),
    ],
)
def test_unstamped_messages_need_arrival_time(ros_graph: RosGraph, stamps: str, said: str) -> None:
    """They are rejected unless the time of arrival is configured."""
    user = ros_graph.node('user')
    states = user.create_publisher(JointState, 'joint_states', SENSOR)
    message = JointState(name=['slide'], position=[0.18], velocity=[0.0])
    controller = ros_graph.add(ControllerNode, parameters={**FORCE, 'hardware.stamps': stamps})

    def says() -> bool:
        states.publish(message)
        return str(controller.diagnose().message) == said

    ros_graph.spin_until(says, said)


@pytest.mark.requirement('S-108')
def test_stop_reaches_a_foreign_driver(ros_graph: RosGraph) -> None:
    bench = Bench(ros_graph)
    bench.aim(0.15)
    bench.until(lambda: bench.values()[-1] < -0.5, 'a force')
    client = bench.user.create_client(Trigger, 'controller/stop')
    bench.until(client.service_is_ready, 'the service')
    future = client.call_async(Trigger.Request())
    bench.until(future.done, 'the answer')
    bench.until(lambda: bench.robot.mass.effort == 0.0, 'no effort')
    count = len(bench.commands)
    bench.until(lambda: len(bench.commands) > count + 20, 'more answers')
    assert {*bench.values()[-10:]} == {0.0}


def test_preparation_names_the_topic_that_it_waits_for(ros_graph: RosGraph) -> None:
    """With the longest time; no step has a number above their total."""
    settings = {**FORCE, 'hardware.wrench_topic': 'auto'}
    controller = ros_graph.add(ControllerNode, parameters=settings, start=False)
    lines = [str(one) for one in controller.preparation()]
    assert lines[-1] == 'waiting for a topic of geometry_msgs/msg/WrenchStamped, 10 s at most'
    steps = [re.match(r'preparing (\d+) of (\d+) \(.+\)', line) for line in lines]
    counts = [(int(one[1]), int(one[2])) for one in steps if one]
    assert counts
    assert all(step <= total for step, total in counts)
