# SPDX-License-Identifier: Apache-2.0
"""
The plant as ros2_control hardware, over DDS.

ros2_control is not available as a wheel. `Driver` publishes the messages of
joint_state_topic_hardware_interface 1.1.0: at its own rate, one array for each kind of interface,
NaN for unset commands.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.util import find_spec
from math import nan
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseArray, WrenchStamped
from needle_controller.controller_node import ControllerNode
from needle_dynamics.plant_node import PlantNode
from needle_identification.recorder_node import is_hidden
from needle_insertion.replay.rerun import verify
from needle_ros import contract
from needle_ros.base_node import COMMAND, message_class, SENSOR
from needle_ros.status import PlantStatus, read_reports
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from support.generated_messages import importable
from support.installed import ROOT
from support.ros_graph import GraphBench, RosGraph
import yaml

CONTROLLERS = yaml.safe_load((ROOT / 'config/ros2_control.yaml').read_text(encoding='utf-8'))
LAUNCH = ast.parse((ROOT / 'launch/ros2_control.launch.py').read_text(encoding='utf-8'))
#: rclcpp::QoS(1) and rclcpp::SensorDataQoS().
SENT = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
HEARD = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)

GUIDE = ('guide_x', 'guide_z', 'guide_tilt_x', 'guide_tilt_z', 'roll')
STEERED: dict[str, Any] = {'steered': True, 'needle': 'bending_35mm', 'depth': 0.02}


class Driver(GraphBench):
    """Publishes controller commands at its own rate, and keeps the latest joint states."""

    def __init__(
        self,
        graph: RosGraph,
        folder: Path,
        interfaces: Mapping[str, tuple[str, ...]],
        rate: float = 100.0,
        **plant: Any,
    ) -> None:
        self.graph, self.node = graph, graph.node('needle_hardware')
        self.logs = folder / 'logs'
        self.interfaces = interfaces
        #: Commands of controllers by joint and interface.
        self.set: dict[tuple[str, str], float] = {}
        self.active, self.update = True, lambda: None
        self.state: dict[tuple[str, str], float] = {}
        self.status = PlantStatus()
        self.node.create_subscription(JointState, 'joint_states', self._on_state, HEARD)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 10)
        if 'publish_clock' in plant:
            self.node.set_parameters([Parameter('use_sim_time', value=True)])
        self.commands = self.node.create_publisher(JointState, 'joint_commands', SENT)
        graph.start('plant', {'rate': 1000.0, **plant})
        self.node.create_timer(1.0 / rate, self.write)
        self.until(self.commands.get_subscription_count, 'the plant')
        if 'paused' not in plant:
            self.until(lambda: self.state, 'the first sample')

    def proceed(self) -> None:
        """Start the time of a plant that is paused."""
        client = self.node.create_client(SetBool, 'plant/pause_time')
        self.until(client.service_is_ready, 'the service')
        answer = client.call_async(SetBool.Request(data=False))
        self.until(answer.done, 'the answer')
        self.until(lambda: self.state, 'the first sample')

    def _on_state(self, message: JointState) -> None:
        for k, name in enumerate(message.name):
            for kind in ('position', 'velocity', 'effort'):
                self.state[name, kind] = getattr(message, kind)[k]

    def _on_health(self, message: DiagnosticArray) -> None:
        for report in read_reports(message):
            if isinstance(report.status, PlantStatus):
                self.status = report.status

    def write(self) -> None:
        """Send a message like `JointStateTopicSystem::write` with a threshold of -1."""
        self.update()
        if not self.active:
            return
        message = JointState()
        message.header.stamp = self.node.get_clock().now().to_msg()
        for joint, kinds in self.interfaces.items():
            message.name.append(joint)
            for kind in kinds:
                getattr(message, kind).append(self.set.get((joint, kind), nan))
        self.commands.publish(message)

    def said(self) -> str:
        """Return the log of the plant."""
        return (self.logs / 'plant.log').read_text(encoding='utf-8')

    @property
    def refused(self) -> int:
        """Number of rejected commands in the diagnostics of the plant."""
        return self.status.rejected

    def at(self, joint: str = 'insertion') -> float:
        return self.state[joint, 'position']

    def further(self, seconds: float) -> None:
        """Spin for a duration in real time."""
        end = self.node.get_clock().now().nanoseconds + seconds * 1e9
        self.until(lambda: self.node.get_clock().now().nanoseconds > end, 'the duration')


class Trajectory:
    """Moves to a goal at constant speed, with efforts like insertion_effort."""

    def __init__(self, driver: Driver, goal: float, speed: float) -> None:
        own = CONTROLLERS['/**/insertion_effort']['ros__parameters']['gains']['insertion']
        self.gains = own
        self.driver, self.goal, self.speed = driver, goal, speed
        self.wanted, self.integral = driver.at(), 0.0
        self.before = driver.node.get_clock().now().nanoseconds

    def __call__(self) -> None:
        now = self.driver.node.get_clock().now().nanoseconds
        passed, self.before = 1e-9 * (now - self.before), now
        left = self.goal - self.wanted
        step = max(-self.speed * passed, min(self.speed * passed, left))
        self.wanted += step
        error = self.wanted - self.driver.at()
        speed = self.speed if abs(left) > abs(step) else 0.0
        slower = (speed if left > 0.0 else -speed) - self.driver.state['insertion', 'velocity']
        own = self.gains
        self.integral += own['i'] * error * passed
        self.integral = max(own['i_clamp_min'], min(own['i_clamp_max'], self.integral))
        force = own['p'] * error + self.integral + own['d'] * slower
        force = max(own['u_clamp_min'], min(own['u_clamp_max'], force))
        self.driver.set['insertion', 'effort'] = force


PUSHED: dict[str, tuple[str, ...]] = {'insertion': ('effort',), 'rotation': ('effort',)}
CARRIED: dict[str, tuple[str, ...]] = {'insertion': ('position',)}


# Launch file as source: its nodes are not available as wheels.


def table(name: str) -> dict[str, ast.expr]:
    """Return the entries of a dictionary of the launch file, by key."""
    (made,) = (
        item.value
        for item in ast.walk(LAUNCH)
        if isinstance(item, ast.Assign) and ast.unparse(item.targets[0]) == name
    )
    assert isinstance(made, ast.Dict)
    return {
        ast.literal_eval(key): value for key, value in zip(made.keys, made.values, strict=True)
    }


def test_launch_file_refers_to_existing_items(ros_graph: RosGraph) -> None:
    """Each argument is used; parameters, arguments of xacro and files exist."""
    asked = {
        ast.literal_eval(item.slice)
        for item in ast.walk(LAUNCH)
        if isinstance(item, ast.Subscript) and ast.unparse(item.value) == 'given'
        if isinstance(item.slice, ast.Constant)
    }
    assert asked == table('ARGUMENTS').keys()
    plant = ros_graph.add(PlantNode, start=False)
    assert [name for name in table('plant') if not plant.has_parameter(name)] == []
    text = (ROOT / 'description/needle_insertion.urdf.xacro').read_text(encoding='utf-8')
    assert [name for name in table('described') if f'<xacro:arg name="{name}"' not in text] == []
    files = re.findall(r"share / '([^']+)'", ast.unparse(LAUNCH))
    assert len(files) == 2
    assert [name for name in files if not (ROOT / name).is_file()] == []


# Mode simulation: efforts.


@pytest.mark.parametrize('rate', [100.0, 200.0])
def test_effort_controller_reaches_its_goal(
    ros_graph: RosGraph, tmp_path: Path, rate: float
) -> None:
    """With the shipped gains, at a lower rate than the plant; a timeout ends the force."""
    driver = Driver(ros_graph, tmp_path, PUSHED, rate, mode='simulation', depth=0.02)
    start = driver.at()
    driver.further(0.3)
    # An unset command is zero force, without a fault.
    assert driver.at() == start
    driver.update = Trajectory(driver, 0.026, 0.01)
    driver.until(lambda: abs(driver.at() - 0.026) < 2e-4, 'the goal')
    driver.until(lambda: abs(driver.state['insertion', 'velocity']) < 1e-5, 'rest')
    assert abs(driver.at() - 0.026) < 5e-4
    assert driver.refused == 0
    driver.update = lambda: None
    driver.set['insertion', 'effort'] = 2.0
    driver.until(lambda: driver.state['insertion', 'velocity'] > 1e-3, 'a push')
    driver.active = False
    driver.until(lambda: driver.state['insertion', 'velocity'] == 0.0, 'the end of the push')
    assert driver.state['insertion', 'effort'] == 0.0


@pytest.mark.requirement('S-093')
def test_duplicate_commanders_move_nothing(ros_graph: RosGraph, tmp_path: Path) -> None:
    """On either topic; the first continues when it is the only commander again."""
    driver = Driver(ros_graph, tmp_path, PUSHED, mode='simulation', depth=0.02)
    driver.set['insertion', 'effort'] = 1.0
    driver.until(lambda: driver.state['insertion', 'velocity'] > 1e-3, 'the push')
    for kind, topic in ((WrenchStamped, 'wrench_command'), (JointState, 'joint_commands')):
        rival = driver.node.create_publisher(kind, topic, COMMAND)
        driver.until(lambda: driver.status.commanders == 2, 'the report')
        driver.until(lambda: driver.state['insertion', 'velocity'] == 0.0, 'rest')
        before = driver.at()
        driver.further(0.3)
        assert driver.at() == before
        driver.node.destroy_publisher(rival)
        driver.until(lambda: driver.state['insertion', 'velocity'] > 1e-3, 'the push')


@pytest.mark.parametrize('value', [nan, float('inf'), 16.0])
def test_effort_that_becomes_nan_is_rejected(
    ros_graph: RosGraph, tmp_path: Path, value: float
) -> None:
    """It is reported, and the force is zero until the effort is a number again."""
    driver = Driver(ros_graph, tmp_path, PUSHED, mode='simulation', depth=0.02)
    driver.set['insertion', 'effort'] = 1.0
    driver.until(lambda: driver.state['insertion', 'velocity'] > 1e-3, 'the push')
    driver.set['insertion', 'effort'] = value
    driver.until(lambda: driver.state['insertion', 'velocity'] == 0.0, 'rest')
    driver.until(lambda: driver.refused > 0, 'the count')
    assert 'must be within force_limit, 15 N' in driver.said()
    driver.set['insertion', 'effort'] = 1.0
    driver.until(lambda: driver.state['insertion', 'velocity'] > 1e-3, 'the push')


def test_arrays_of_wrong_length_are_rejected(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Entries cannot be assigned to joints; the message names the required interfaces."""
    driver = Driver(
        ros_graph, tmp_path, {'insertion': ('effort',), 'guide_x': ('position',)}, **STEERED
    )
    before = driver.at()
    driver.set |= {('insertion', 'effort'): 2.0, ('guide_x', 'position'): 1e-3}
    driver.until(lambda: driver.refused > 10, 'the refusals')
    assert (driver.at(), driver.at('guide_x')) == (before, 0.0)
    said = driver.said()
    assert 'declare the same command interfaces for all joints of the hardware' in said


# Mode robot, and the guide: positions.


def test_position_controller_is_followed(ros_graph: RosGraph, tmp_path: Path) -> None:
    """With a delay of one message at 100 Hz; the plant then rests despite further messages."""
    driver = Driver(ros_graph, tmp_path, CARRIED, mode='robot', depth=0.03)
    driver.further(0.3)
    assert driver.at() == pytest.approx(0.03, abs=1e-6)
    course = Trajectory(driver, 0.04, 0.01)

    def follow() -> None:
        course()
        driver.set['insertion', 'position'] = course.wanted

    driver.update = follow
    driver.until(lambda: abs(driver.at() - 0.04) < 2e-6, 'the goal')
    driver.until(lambda: driver.state['insertion', 'velocity'] == 0.0, 'rest')
    driver.update = lambda: None
    driver.set['insertion', 'position'] = 0.3
    driver.until(lambda: driver.refused > 0, 'the refusal')
    assert driver.at() == pytest.approx(0.04, abs=2e-6)
    said = driver.said()
    assert 'joint_commands: trajectory must stay in [0.001, 0.2] m, got 0.3 m' in said


@pytest.mark.requirement('S-286')
def test_pause_and_retraction_hold_joint_commands(ros_graph: RosGraph, tmp_path: Path) -> None:
    """The commands continue to move 10 mm ahead of the needle."""
    driver = Driver(ros_graph, tmp_path, CARRIED, mode='robot', depth=0.03)

    def lead() -> None:
        driver.set['insertion', 'position'] = driver.at() + 0.01

    def call(kind: type, name: str, request: Any) -> None:
        client = driver.node.create_client(kind, f'plant/{name}')
        driver.until(client.service_is_ready, 'the service')
        answer = client.call_async(request)
        driver.until(answer.done, 'the answer')
        assert answer.result().success

    driver.update = lead
    driver.until(lambda: driver.at() > 0.032, 'the motion')
    call(SetBool, 'pause', SetBool.Request(data=True))
    driver.until(lambda: driver.state['insertion', 'velocity'] == 0.0, 'rest')
    rest = driver.at()
    driver.further(0.5)
    assert driver.at() == rest
    call(Trigger, 'retract', Trigger.Request())
    driver.until(lambda: driver.at() < 0.0105, 'the retraction')
    driver.further(0.5)
    assert driver.at() < 0.0105


def test_duplicate_position_commanders_are_not_followed(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    driver = Driver(ros_graph, tmp_path, CARRIED, mode='robot', depth=0.03)
    rival = driver.node.create_publisher(JointState, 'joint_commands', COMMAND)
    driver.until(lambda: driver.status.commanders == 2, 'the report')
    driver.set['insertion', 'position'] = 0.031
    driver.further(0.5)
    assert driver.at() == pytest.approx(0.03, abs=1e-6)
    driver.node.destroy_publisher(rival)
    driver.until(lambda: driver.at() > 0.0309, 'the goal')


# Replay of recorded runs.


@pytest.mark.parametrize('mode', ['robot', 'simulation', 'steered'])
def test_commanded_run_is_reproduced_by_replay(
    ros_graph: RosGraph, tmp_path: Path, mode: str
) -> None:
    """Bit for bit: forces are in `ground_truth`, positions in the events of the plant."""
    probe = ros_graph.node('probe')
    recorder = ros_graph.start('recorder', {'path': str(tmp_path / 'bag')})
    kinds: dict[str, dict[str, tuple[str, ...]]] = {
        'robot': CARRIED,
        'simulation': PUSHED,
        'steered': dict.fromkeys(('insertion', *GUIDE), ('position', 'effort')),
    }
    driver = Driver(
        ros_graph,
        tmp_path,
        kinds[mode],
        # The recorder keeps up on a busy machine: its queue of 50 samples lasts for 2 s.
        **{
            'rate': 100.0,
            'real_time_factor': 0.25,
            'publish_clock': True,
            'paused': True,
            **(STEERED if mode == 'steered' else {'mode': mode, 'depth': 0.02}),
        },
    )

    def recorded() -> bool:
        published = [
            name
            for name, _ in probe.get_topic_names_and_types()
            if probe.count_publishers(name) and not is_hidden(name)
        ]
        return {'/joint_commands', '/plant/events', '/ground_truth'} <= set(published) and all(
            'recorder' in [one.node_name for one in probe.get_subscriptions_info_by_topic(name)]
            for name in published
        )

    ros_graph.spin_until(recorded, 'the recorder')
    driver.proceed()
    course = Trajectory(driver, 0.024, 0.01)

    def follow() -> None:
        course()
        if mode == 'robot':
            driver.set['insertion', 'position'] = course.wanted
        if mode == 'steered':
            driver.set['guide_x', 'position'] = 0.1 * (course.wanted - 0.02)
            driver.set['roll', 'position'] = 1e2 * (course.wanted - 0.02)

    driver.update = follow
    driver.until(lambda: driver.at() > 0.0235, 'the goal')
    driver.further(0.3)
    driver.active = False
    driver.further(0.3)
    recorder.interrupt()
    (run,) = verify(tmp_path / 'bag')
    assert run.verdict == 'identical', f'{run.first} | {run.reason} | {run.notes}'
    assert set(run.topics) == {'/joint_states', '/base_wrench', '/tip_deflection', '/ground_truth'}
    assert run.recorded.rows['/joint_states'].values[-1, 0] > 0.0235
    driven = [note for note in run.notes if 'joint_commands' in note]
    # Reported once for hundreds of messages.
    assert len(driven) == (mode != 'simulation')
    assert sum(map(len, run.recorded.commands.values())) > 50


# Subscribers.


@pytest.mark.parametrize('mode', ['simulation', 'indenter'])
def test_default_qos_receives_every_topic(ros_graph: RosGraph, mode: str) -> None:
    """`create_subscription(type, topic, callback, 10)` requests reliable delivery."""
    node = ros_graph.node('reader')
    indents = mode == 'indenter'
    there = {'base_wrench', 'end_effector_pose', '/clock'}
    topics = [
        topic
        for topic in contract.TOPICS
        if topic.qos.lossy
        and (topic.name in there if indents else topic.name != 'end_effector_pose')
    ]
    heard = {
        topic.name: ros_graph.listen(node, message_class(topic.type_name), topic.name, 10)
        for topic in topics
    }
    ros_graph.add(PlantNode, parameters={'rate': 200.0, 'mode': mode, 'publish_clock': True})
    if not indents:
        ros_graph.add(ControllerNode, parameters={'rate': 200.0, 'use_sim_time': True})
        target = node.create_publisher(PointStamped, 'target', COMMAND)
        message = PointStamped()
        message.point.y = 0.021

        def aimed() -> bool:
            target.publish(message)
            return bool(heard['tracking_error'])

        ros_graph.spin_until(aimed, 'the motion')
    ros_graph.spin_until(lambda: all(heard.values()), 'all topics')
    assert len(heard) == (3 if indents else 9)


#: Subscribes with default QoS, and prints a line at the first message.
READER = """
import rclpy, sys
from sensor_msgs.msg import JointState
from geometry_msgs.msg import WrenchStamped
rclpy.init()
node = rclpy.create_node('slow')
heard = set()
def take(message):
    if type(message) not in heard:
        heard.add(type(message))
        print('heard', flush=True)
for kind, topic in ((JointState, 'joint_states'), (WrenchStamped, 'base_wrench')):
    node.create_subscription(kind, topic, take, 10)
rclpy.spin(node)
"""


def test_stopped_subscriber_does_not_block_the_plant(ros_graph: RosGraph) -> None:
    """A reliable subscriber that takes no messages."""
    probe = ros_graph.node('probe')
    stamps: list[int] = []

    def take(message: Any) -> None:
        stamps.append(message.header.stamp.nanosec)

    probe.create_subscription(JointState, 'joint_states', take, SENSOR)
    ros_graph.start('plant', {'rate': 500.0})
    ros_graph.spin_until(lambda: len(stamps) > 100, 'samples')
    reader = subprocess.Popen(
        [sys.executable, '-c', READER],
        env=ros_graph.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert [reader.stdout.readline() for _ in range(2)] == ['heard\n'] * 2
        reader.send_signal(signal.SIGSTOP)
        seen = len(stamps)
        # 6 s, far more than a publisher keeps. With the default wait of 0.1 s for each or every
        # tenth message, this would take minutes.
        ros_graph.spin_until(lambda: len(stamps) > seen + 3000, 'further samples', timeout=120.0)
        assert reader.poll() is None
    finally:
        reader.kill()
        reader.communicate()


# Transforms.


def test_missing_tf2_msgs_is_reported(ros_graph: RosGraph) -> None:
    """One line, and the process ends; with the package the plant publishes."""
    if find_spec('tf2_msgs'):
        pytest.skip('tf2_msgs is installed here')
    plant = ros_graph.start('plant', {'publish_tf': True})
    assert plant.process.wait(60) == 2
    reason = 'publish_tf must be false: tf2_msgs/msg/TFMessage is not installed'
    assert plant.last_line.endswith(reason)


def test_invalid_prefix_is_rejected(ros_graph: RosGraph) -> None:
    """As tf does."""
    node = ros_graph.add(PlantNode, parameters={'frame_prefix': '/left'}, start=False)
    assert not node.start()
    assert node.failure == "frame_prefix must not begin with a slash, got '/left'"


def test_publish_tf_is_rejected_without_a_needle(ros_graph: RosGraph) -> None:
    parameters = {'publish_tf': True, 'mode': 'indenter'}
    node = ros_graph.add(PlantNode, parameters=parameters, start=False)
    assert not node.start()
    assert node.failure == 'publish_tf must be false: there is no needle in mode indenter'


@pytest.fixture(scope='module')
def transforms(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Return the folder of tf2_msgs, built from its definition if not installed."""
    with importable('tf2_msgs', tmp_path_factory.mktemp('tf2')) as entry:
        yield entry


@pytest.mark.parametrize(('steered', 'prefix'), [(False, ''), (True, 'left/')])
def test_tip_transform_is_published(
    ros_graph: RosGraph, transforms: str, steered: bool, prefix: str
) -> None:
    """In `needle_base`, equal to the last pose of `needle_poses`, with the QoS of tf listeners."""
    kind = import_module('tf2_msgs.msg').TFMessage
    reader = ros_graph.node('reader')
    heard = ros_graph.listen(reader, kind, '/tf', 100)
    poses = ros_graph.listen(reader, PoseArray, 'needle_poses', 10)
    more = STEERED if steered else {'depth': 0.05, 'tip_deflection': 5e-3}
    ros_graph.environment['PYTHONPATH'] = os.pathsep.join(
        filter(None, (transforms, os.environ.get('PYTHONPATH')))
    )
    more |= {'rate': 200.0, 'publish_tf': True, 'frame_prefix': prefix}
    ros_graph.start('plant', more)
    found: list[tuple[Any, Any]] = []

    def matched() -> bool:
        by_stamp = {(p.header.stamp.sec, p.header.stamp.nanosec): p for p in poses}
        for message in heard:
            (one,) = message.transforms
            stamp = one.header.stamp
            if (stamp.sec, stamp.nanosec) in by_stamp:
                found.append((one, by_stamp[stamp.sec, stamp.nanosec].poses[-1]))
        return bool(found)

    ros_graph.spin_until(matched, 'a transform and a picture of one sample')
    one, tip = found[0]
    frames = one.header.frame_id, one.child_frame_id
    assert frames == (prefix + contract.BASE, prefix + contract.TIP)
    assert {message.header.frame_id for message in poses} == {prefix + contract.ENTRY}
    depth = STEERED['depth'] if steered else 0.05
    place, turn = one.transform.translation, one.transform.rotation
    assert (place.x, place.z) == (tip.position.x, tip.position.z)
    # The base is at s - l; a bent needle moves it by some nanometers.
    assert place.y == pytest.approx(tip.position.y - (depth - 0.2), abs=1e-6)
    assert turn == tip.orientation
    assert steered or place.z != 0.0
