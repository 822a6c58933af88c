# SPDX-License-Identifier: Apache-2.0
"""The plant node in the graph."""

from functools import partial
from pathlib import Path
import signal
from signal import Signals
import subprocess
import sys
import time
from typing import Any

from geometry_msgs.msg import PointStamped, PoseStamped, WrenchStamped
from needle_controller.controller_node import ControllerNode
from needle_dynamics import FloatArray
from needle_dynamics.plant_node import PlantNode
from needle_dynamics.simulated.force_sensor import ForceSensorParameters
from needle_dynamics.simulated.indenter import IndenterParameters
from needle_insertion.graph.ros_graph import InvalidNodeError
from needle_ros.base_node import COMMAND, LATCHED, SENSOR
from needle_ros.requests import Verdict
from needle_ros.status import PlantStatus
import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterValueException
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger
from std_srvs.srv._trigger import Trigger_Response
from support.ros_graph import GraphBench, RosGraph, stamp_ns
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
import yaml

#: Low rate for a thread that also runs the test.
RATE = {'rate': 200.0}

#: Simulated time waits for a busy machine: no sample is dropped.
COMPLETE = {**RATE, 'publish_clock': True}

NOISE = ForceSensorParameters().per_axis('noise')[:3]


def wrench(force: float) -> WrenchStamped:
    message = WrenchStamped()
    message.wrench.force.y = force
    return message


def trajectory(
    joints: list[str], *points: tuple[float, list[float], list[float]]
) -> JointTrajectory:
    """Return a trajectory of points: time from start, positions, efforts."""
    message = JointTrajectory(joint_names=joints)
    for at, positions, effort in points:
        point = JointTrajectoryPoint(positions=positions, effort=effort)
        point.time_from_start.sec, rest = divmod(round(at * 1e9), 10**9)
        point.time_from_start.nanosec = rest
        message.points.append(point)
    return message


class Bench(GraphBench):
    """A plant in this process, with a probe that subscribes and commands."""

    def __init__(self, ros_graph: RosGraph, **parameters: Any) -> None:
        self.graph = ros_graph
        self.probe = ros_graph.node('probe')
        self.states = ros_graph.listen(self.probe, JointState, 'joint_states', SENSOR)
        self.wrenches = ros_graph.listen(self.probe, WrenchStamped, 'base_wrench', SENSOR)
        self.poses = ros_graph.listen(self.probe, PoseStamped, 'end_effector_pose', SENSOR)
        self.commands = self.probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
        self.course = self.probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        self.tare = self.probe.create_client(Trigger, 'plant/tare')
        simulated = parameters.get('mode', 'simulation') == 'simulation'
        self.plant = ros_graph.add(PlantNode, parameters={**RATE, **parameters})
        self.until(
            lambda: (
                self.wrenches
                and (self.states or self.poses)
                and self.commands.get_subscription_count()
                and (self.course.get_subscription_count() or simulated)
                and self.tare.service_is_ready()
            ),
            'discovery',
        )

    def further(self, count: int) -> list[WrenchStamped]:
        """Spin until a number of additional force readings; return them."""
        seen = len(self.wrenches)
        self.until(lambda: len(self.wrenches) >= seen + count, 'readings')
        return self.wrenches[seen:]

    @property
    def waited(self) -> float:
        """Accumulated delay of simulated time by this machine [s]."""
        return self.plant.diagnose().status.waited

    def zero(self) -> Trigger_Response:
        """Call the tare service; return the response."""
        answer = self.tare.call_async(Trigger.Request())
        self.until(answer.done, 'the answer')
        return answer.result()

    def refused(self, count: int) -> None:
        """Spin until a number of rejected commands."""
        self.until(lambda: self.plant.diagnose().status.rejected == count, 'the refusal')


def test_four_topics_are_published_per_sample(ros_graph: RosGraph) -> None:
    """With one stamp, exactly one period after the previous sample."""
    probe = ros_graph.node('probe')
    topics = {
        topic: ros_graph.listen(probe, kind, topic, SENSOR)
        for topic, kind in (
            ('joint_states', JointState),
            ('base_wrench', WrenchStamped),
            ('tip_deflection', PointStamped),
            ('ground_truth', JointState),
        )
    }
    ros_graph.add(PlantNode, parameters={**COMPLETE, 'tip_deflection': 5e-4})
    ros_graph.spin_until(lambda: all(len(t) >= 100 for t in topics.values()), 'samples')
    stamps = {topic: [stamp_ns(m) for m in messages] for topic, messages in topics.items()}
    common = set.intersection(*(set(s) for s in stamps.values()))
    assert len(common) >= 90
    # Integer nanoseconds: the period may be off by the rounding of both stamps.
    assert set(np.diff(stamps['joint_states'])) <= {4_999_999, 5_000_000, 5_000_001}
    truth = topics['ground_truth'][-1]
    joints = next(m for m in topics['joint_states'] if stamp_ns(m) == stamp_ns(truth))
    assert list(truth.name) == ['d', 'theta', 'q1', 'q2']
    assert joints.position[0] == pytest.approx(0.2 - truth.position[0], abs=1e-15)
    assert topics['tip_deflection'][-1].header.frame_id == 'needle_entry'
    assert topics['base_wrench'][-1].header.frame_id == 'needle_base'


@pytest.mark.requirement('S-064', 'S-065')
def test_moves_under_a_command_until_the_command_timeout(ros_graph: RosGraph) -> None:
    """A constant force moves the needle at (f - mu_s) / mu_v, until the command is too old."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    ros_graph.add(PlantNode, parameters=RATE)
    ros_graph.spin_until(lambda: states and commands.get_subscription_count(), 'discovery')

    def pushed() -> bool:
        commands.publish(wrench(3.56))
        return states[-1].velocity[0] > 0.0

    ros_graph.spin_until(pushed, 'motion')
    ros_graph.spin_until(lambda: pushed() and states[-1].position[0] > 0.022, 'depth')
    # mu_v = 300 N s/m; friction settles within microseconds.
    assert states[-1].velocity[0] == pytest.approx(0.01, rel=1e-9)
    ros_graph.spin_until(lambda: states[-1].velocity[0] == 0.0, 'the stop after the timeout')


@pytest.mark.requirement('S-032')
@pytest.mark.parametrize('force', [float('nan'), float('inf'), -1e300])
def test_invalid_force_commands_are_rejected(ros_graph: RosGraph, force: float) -> None:
    """NaN, infinite and implausible forces are counted and do not move the needle."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    plant = ros_graph.add(PlantNode, parameters=RATE)
    ros_graph.spin_until(lambda: states and commands.get_subscription_count(), 'discovery')
    commands.publish(wrench(force))
    ros_graph.spin_until(lambda: plant.diagnose().status.rejected == 1, 'the refusal')
    seen = len(states)
    ros_graph.spin_until(lambda: len(states) > seen + 20, 'further samples')
    assert states[-1].position[0] == states[0].position[0]


def test_base_follows_a_trajectory_with_friction_force(ros_graph: RosGraph) -> None:
    """In mode robot; the wrench is mu_s + mu_v u."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    wrenches = ros_graph.listen(probe, WrenchStamped, 'base_wrench', SENSOR)
    trajectories = probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
    ros_graph.add(PlantNode, parameters={**RATE, 'mode': 'robot', 'depth': 0.1})
    ros_graph.spin_until(lambda: states and trajectories.get_subscription_count(), 'discovery')
    point = JointTrajectoryPoint(positions=[0.11])
    point.time_from_start.sec = 1
    trajectories.publish(JointTrajectory(joint_names=['insertion'], points=[point]))
    ros_graph.spin_until(lambda: states[-1].position[0] > 0.10999, 'the end')
    ros_graph.spin_until(lambda: states[-1].velocity[0] == 0.0, 'rest')
    # The final approach halves the error per period: far below 1 um at rest.
    assert states[-1].position[0] == pytest.approx(0.11, abs=1e-6)
    speed = {stamp_ns(m): m.velocity[0] for m in states}
    steady = [m.wrench.force.y for m in wrenches if abs(speed.get(stamp_ns(m), 0.0) - 0.01) < 1e-6]
    # Mean of at least 50 readings; the filter passes a fifth of the noise; five sigma.
    assert len(steady) > 50
    assert np.mean(steady) == pytest.approx(3.56, abs=5 * 0.2 * max(NOISE) / np.sqrt(50))


def test_needle_below_the_minimum_depth_stops(ros_graph: RosGraph) -> None:
    """/diagnostics reports the reason."""
    probe = ros_graph.node('probe')
    reports = ros_graph.statuses(probe, PlantStatus)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    ros_graph.add(PlantNode, parameters={**RATE, 'depth': 0.002})
    ros_graph.spin_until(commands.get_subscription_count, 'discovery')

    def reported() -> bool:
        commands.publish(wrench(-3.0))
        return any('minimum_depth' in one.halt for one in reports)

    ros_graph.spin_until(reported, 'the report')


def test_configuration_is_a_latched_parameter_file(ros_graph: RosGraph) -> None:
    """Late-joining subscribers receive all parameters."""
    ros_graph.add(PlantNode, parameters={**RATE, 'model.coulomb_friction': 1, 'depth': 0.03})
    late = ros_graph.listen(ros_graph.node('probe'), String, 'plant/configuration', LATCHED)
    ros_graph.spin_until(lambda: late, 'configuration')
    values = yaml.safe_load(late[0].data)['/plant']['ros__parameters']
    assert values['model.coulomb_friction'] == 1
    assert values['model.viscous_friction'] == 300.0
    assert values['needle'] == 'phantom'


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode])
def test_configuration_recreates_the_node(
    ros_graph: RosGraph, tmp_path: Path, kind: type[ControllerNode] | type[PlantNode]
) -> None:
    """A node started from the configuration has the same configuration."""
    layers = {'model.layer_depths': [0.03, 0.06], 'model.layer_stiffnesses': [900.0, 200.0]}
    for parameters in ({}, layers):
        first = ros_graph.add(kind, parameters=parameters, start=False)
        file = tmp_path / 'node.yaml'
        file.write_text(first.configuration())
        arguments = ['--ros-args', '--params-file', str(file)]
        second = ros_graph.add(kind, cli_args=arguments)
        assert second.configuration() == first.configuration()


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode])
def test_shipped_parameter_file_is_valid(
    ros_graph: RosGraph, kind: type[ControllerNode] | type[PlantNode]
) -> None:
    file = Path(__file__).parents[2] / 'config' / 'insertion.yaml'
    node = ros_graph.add(kind, cli_args=['--ros-args', '--params-file', str(file)])
    given = yaml.safe_load(file.read_text())[f'/**/{node.get_name()}']['ros__parameters']
    assert {name: node.get_parameter(name).value for name in given} == given


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({'model.lenght': 0.3}, "unknown parameter 'model.lenght'; did you mean 'model.length'"),
        ({'needle': 'steel'}, 'needle must be one of paper_si, paper_mm, phantom'),
        ({'depth': 0.3}, 'insertion depth 0.3 m is outside'),
        ({'seed': -1}, 'seed out of range'),
    ],
)
def test_invalid_parameters_end_the_process(
    ros_graph: RosGraph, parameters: dict[str, Any], complaint: str
) -> None:
    """With a one-line error, which the graph repeats, and status 2."""
    plant = ros_graph.start('plant', parameters)
    assert plant.process.wait(30) == 2
    assert complaint in plant.last_line
    with pytest.raises(InvalidNodeError, match=f'^plant: .*{complaint}'):
        plant.check()


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({'mode': 'dream'}, "mode must be one of simulation, robot, indenter, got 'dream'"),
        ({'model.length': 'long'}, 'model.length must be a number, or text with a unit of m'),
        ({'sensor.filter': 7}, 'sensor.filter must be an integer from 0 to 6, got 7'),
        (
            {'sensor.rate': 1500.0},
            'must be a whole multiple of 1000 Hz, got 1500 Hz; 8000 Hz would do',
        ),
        (
            {'sensor.force_noise': [0.1, 0.2]},
            'sensor.force_noise must be one number or three, x y z, got [0.1, 0.2]',
        ),
        (
            {'sensor.force_drift': [0.1, -0.1, 0.1]},
            'sensor.force_drift must be finite, >= 0 N/s^0.5',
        ),
        (
            {'base.encoder_resolution': -1},
            'base.encoder_resolution must be finite, >= 0 m, got -1.0',
        ),
        ({'real_time_factor': -1}, 'real_time_factor must be finite, >= 0 and <= 100, got -1.0'),
        (
            {'lockstep': True, 'use_sim_time': True},
            'lockstep and use_sim_time cannot both be true: the plant would follow its own',
        ),
        (
            {'lockstep': True, 'mode': 'robot'},
            'lockstep must be false except in mode simulation, where commands answer samples, got',
        ),
        ({'rate': 5.0}, 'command_timeout must be at least a period, 0.2 s, got 0.1 s'),
        ({'fault.kind': 'bad luck'}, 'fault.kind must be one of none, drop, delay, duplicate'),
        ({'fault.topic': 'clock'}, 'fault.topic must be one of joint_states, base_wrench'),
        (
            {'mode': 'indenter', 'indenter.stiffness_xx': [1000.0]},
            'indenter.stiffness_xx must be a list with one value for each of the force_levels',
        ),
        (
            {'publish_clock': True, 'use_sim_time': True},
            'publish_clock and use_sim_time cannot both be true: the plant would follow its own',
        ),
    ],
)
def test_invalid_parameters_fail_configure(
    ros_graph: RosGraph, parameters: dict[str, Any], complaint: str
) -> None:
    """The error names the parameter; no partial configuration remains."""
    node = ros_graph.add(PlantNode, parameters=parameters, start=False)
    assert not node.start()
    assert complaint in node.failure
    assert node.diagnose().status == PlantStatus()


@pytest.mark.parametrize(
    ('name', 'value'), [('model.density', -1.0), ('step', float('nan')), ('step', 1e-13)]
)
def test_value_out_of_range_is_rejected(ros_graph: RosGraph, name: str, value: float) -> None:
    """The declared parameter range applies from the start."""
    with pytest.raises(InvalidParameterValueException, match=f'{name} out of range'):
        ros_graph.add(PlantNode, parameters={name: value})


@pytest.mark.parametrize('name', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_end_the_process_normally(ros_graph: RosGraph, name: Signals) -> None:
    """Ctrl-C, SIGTERM and SIGHUP: status 0 without a traceback."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    plant = ros_graph.start('plant')
    ros_graph.spin_until(lambda: states, 'joint_states')
    plant.process.send_signal(name)
    assert plant.process.wait(30) == 0
    assert 'Traceback' not in plant.last_line


@pytest.mark.parametrize(
    'arguments',
    [['--params-file', 'missing.yaml'], ['-p', 'depth']],
    ids=['no such file', 'no value'],
)
def test_invalid_ros_arguments_end_the_process(tmp_path: Path, arguments: list[str]) -> None:
    """One line, with exit status 2."""
    ended = subprocess.run(
        [sys.executable, '-m', 'needle_dynamics.plant_node', '--ros-args', *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr.splitlines()[-1].startswith('error: ')
    assert 'Traceback' not in ended.stderr


def test_needle_beyond_its_length_stops_without_hub_stop(ros_graph: RosGraph) -> None:
    """The plant stops the needle and reports; the node continues."""
    probe = ros_graph.node('probe')
    reports = ros_graph.statuses(probe, PlantStatus)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    limits = {'force_limit': 20.0, 'power_limit': 1e3}
    free = {'model.hub_stop': False, 'needle': 'paper_si', 'depth': 0.1, **limits}
    ros_graph.add(PlantNode, parameters={**RATE, **free})
    ros_graph.spin_until(commands.get_subscription_count, 'discovery')

    def reported() -> bool:
        commands.publish(wrench(20.0))
        return any('insertion depth' in one.halt for one in reports)

    ros_graph.spin_until(reported, 'the report')


def test_preset_is_read_only(ros_graph: RosGraph) -> None:
    """The preset determines the defaults."""
    plant = ros_graph.add(PlantNode, start=False)
    changed = plant.set_parameters([Parameter('needle', value='paper_si')])[0]
    assert not changed.successful


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode])
@pytest.mark.parametrize('configured', [False, True])
def test_shutdown_before_activation(
    ros_graph: RosGraph, kind: type[ControllerNode] | type[PlantNode], configured: bool
) -> None:
    """From unconfigured and from inactive."""
    node = ros_graph.add(kind, start=False)
    if configured:
        assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS


def test_trajectory_out_of_range_is_rejected(ros_graph: RosGraph) -> None:
    """The base does not move for a point in front of the skin or beyond the hub."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    trajectories = probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
    ros_graph.add(PlantNode, parameters={**RATE, 'mode': 'robot', 'depth': 0.1})
    ros_graph.spin_until(lambda: states and trajectories.get_subscription_count(), 'discovery')
    for depth in (-0.01, 0.3, float('nan')):
        point = JointTrajectoryPoint(positions=[depth])
        point.time_from_start.sec = 1
        trajectories.publish(JointTrajectory(joint_names=['insertion'], points=[point]))
    seen = len(states)
    ros_graph.spin_until(lambda: len(states) > seen + 50, 'further samples')
    assert {message.position[0] for message in states[seen:]} == {0.1}


def test_only_the_controller_subscribes_to_paths_in_simulation(ros_graph: RosGraph) -> None:
    """`ros2 topic pub --once` waits for one subscriber, the controller."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    ros_graph.add(PlantNode, parameters=RATE)
    ros_graph.add(ControllerNode, parameters=RATE)
    ros_graph.spin_until(lambda: states and probe.count_subscribers('joint_trajectory'), 'both')
    assert probe.count_subscribers('joint_trajectory') == 1


def test_push_then_motion(ros_graph: RosGraph) -> None:
    """An effort ramp moves the base above mu_s; later positions are relative to it."""
    quiet = {'sensor.force_noise': 0.0, 'sensor.force_resolution': 0.0, 'sensor.filter': 0}
    bench = Bench(ros_graph, mode='robot', depth=0.1, **quiet)
    bench.course.publish(
        trajectory(['insertion'], (1.0, [], [2.0]), (1.4, [0.1], []), (2.0, [0.1], []))
    )
    states = bench.states
    bench.until(lambda: states[-1].velocity[0] < 0.0, 'the way back')
    bench.until(lambda: states[-1].velocity[0] == 0.0, 'rest')
    force = {stamp_ns(m): m.wrench.force.y for m in bench.wrenches}
    pushed = states[: next(i for i, m in enumerate(states) if m.velocity[0] < 0.0)]
    at = [(force[stamp_ns(m)], m.velocity[0]) for m in pushed if stamp_ns(m) in force]
    moving = [f for f, speed in at if speed > 0.0]
    resting = [f for f, speed in at[: len(at) - len(moving)]]
    # The force of a sample is the mean of its interval: 2 N/s over 5 ms between samples; the ramp
    # itself is rounded.
    assert max(resting) <= 0.56 + 1e-12
    assert 0.56 - 1e-12 < min(moving) < 0.56 + 0.011
    # mu_v = 300 N s/m; the velocity refers to the last quarter of 5 ms, in which the force rises
    # by 2.5 mN, the reading to its end. After the largest force the base brakes before it
    # reverses.
    last = max(range(len(at)), key=lambda i: at[i][0])
    steady = [(f - 0.56) / 300.0 - speed for f, speed in at[:last] if f > 0.56]
    assert len(steady) > 100
    assert np.abs(steady).max() < 0.0013 / 300.0
    assert states[-1].position[0] == pytest.approx(0.1, abs=1.5e-6)


def has_refused_one(plant: PlantNode) -> bool:
    """Return whether the plant has rejected one command."""
    return plant.diagnose().status.rejected == 1


def has(messages: list[Any], count: int) -> bool:
    """Return whether a number of messages have arrived."""
    return len(messages) >= count


def test_trajectory_before_activation_starts_with_it(ros_graph: RosGraph) -> None:
    """Two runs with the same seed are then identical for each sample."""
    runs = []
    for name in ('one', 'two'):
        probe = ros_graph.node(name)
        wrenches = ros_graph.listen(probe, WrenchStamped, f'{name}/base_wrench', SENSOR)
        course = probe.create_publisher(JointTrajectory, f'{name}/joint_trajectory', COMMAND)
        plant = ros_graph.add(
            PlantNode,
            parameters={**COMPLETE, 'mode': 'robot', 'depth': 0.1},
            namespace=name,
            start=False,
        )
        plant.trigger_configure()
        ros_graph.spin_until(course.get_subscription_count, 'the subscription')
        course.publish(trajectory(['insertion'], (0.3, [], [2.0]), (0.6, [0.1], [])))
        assert course.wait_for_all_acked(Duration(seconds=10))
        for _ in range(10):
            ros_graph.executor.spin_once(timeout_sec=0.02)
        # Only the newest command applies: the rejection of the next command shows that the first
        # was received.
        course.publish(trajectory(['elbow']))
        ros_graph.spin_until(partial(has_refused_one, plant), 'the refusal')
        (sender,) = (p for p in plant.publishers if p.topic_name.endswith('base_wrench'))
        ros_graph.spin_until(sender.get_subscription_count, 'the reader')
        plant.trigger_activate()
        ros_graph.spin_until(partial(has, wrenches, 150), 'readings')
        runs.append([message.wrench.force.y for message in wrenches[:150]])
    assert max(runs[0]) > 1.0
    assert runs[0] == runs[1]


@pytest.mark.requirement('S-275')
def test_inactive_plant_rejects_a_trajectory_with_a_stamp(ros_graph: RosGraph) -> None:
    """It rests after its activation."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    course = probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
    parameters = {**RATE, 'mode': 'robot', 'depth': 0.1}
    plant = ros_graph.add(PlantNode, parameters=parameters, start=False)
    plant.trigger_configure()
    ros_graph.spin_until(course.get_subscription_count, 'the subscription')
    message = trajectory(['insertion'], (0.5, [0.102], []))
    message.header.stamp = probe.get_clock().now().to_msg()
    course.publish(message)
    ros_graph.spin_until(lambda: plant.diagnose().status.requests.answers, 'the answer')
    (answer,) = plant.diagnose().status.requests.answers
    assert (answer.verdict, answer.reason) == (Verdict.REJECTED, 'the plant is not active')
    plant.trigger_activate()
    # Two seconds of samples, more than the trajectory.
    ros_graph.spin_until(lambda: len(states) > 2 * RATE['rate'], 'samples')
    assert {state.position[0] for state in states} == {0.1}


def test_encoder_resolution_of_a_micrometer(ros_graph: RosGraph) -> None:
    """In mode robot the joint position is rounded to the encoder resolution."""
    bench = Bench(ros_graph, mode='robot', depth=0.1, **{'base.encoder_resolution': 1e-4})
    bench.course.publish(trajectory(['insertion'], (0.5, [0.102], [])))
    bench.until(lambda: bench.states[-1].position[0] >= 0.102, 'the end')
    counts = np.array([m.position[0] for m in bench.states]) / 1e-4
    # Rounding of a quotient of about 1000.
    assert np.abs(counts - np.round(counts)).max() < 1e-9
    assert len(set(np.round(counts))) == 21


def test_end_effector_position_follows_the_tissue_stiffness(ros_graph: RosGraph) -> None:
    """In mode indenter K(|F|) d = F, and the wrench is F; no other topic is published."""
    bench = Bench(ros_graph, mode='indenter')
    force = np.array([0.6, -1.2])
    bench.course.publish(trajectory(['z', 'x'], (0.5, [], [-1.2, 0.6]), (9.0, [], [-1.2, 0.6])))
    bench.until(lambda: bench.poses and bench.poses[-1].pose.position.z < -9e-4, 'the press')
    bench.until(lambda: bench.wrenches[-1].wrench.force.z < -1.1, 'the press')
    seen = len(bench.poses)
    # The end of the ramp takes 0.1 s, 20 samples.
    readings = np.array([[m.wrench.force.x, m.wrench.force.z] for m in bench.further(150)[50:]])
    poses = [message.pose.position for message in bench.poses[seen + 50 :]]
    place = np.array([[p.x, p.z] for p in poses])
    p = IndenterParameters()
    stiffness = [
        np.interp(np.hypot(*force), p.force_levels, m) for m in p.matrices.reshape(-1, 4).T
    ]
    # Five sigma of 100 readings.
    assert np.abs(readings.mean(axis=0) - force).max() < 5 * 0.2 * max(NOISE) / 10.0
    pressed = np.linalg.solve(np.reshape(stiffness, (2, 2)), force)
    assert np.abs(place.mean(axis=0) - pressed).max() < 5 * p.position_noise / np.sqrt(len(place))
    assert np.mean([p.y for p in poses]) == pytest.approx(1e-4 * np.hypot(*force), abs=1e-5)
    assert bench.poses[-1].header.frame_id == 'needle_entry'
    assert not bench.states
    assert {stamp_ns(m) for m in bench.poses} & {stamp_ns(m) for m in bench.wrenches}


@pytest.mark.parametrize(
    ('mode', 'message', 'reason'),
    [
        ('robot', trajectory(['x'], (1.0, [0.1], [])), "needs the joint 'insertion', got ['x']"),
        ('robot', trajectory(['elbow']), "moves none of the joints ['elbow']"),
        (
            'robot',
            trajectory(['insertion'], (1.0, [], [])),
            'each point needs a position or an effort',
        ),
        (
            'robot',
            trajectory(['insertion'], (1.0, [], [5e3])),
            'a push must be within 15 N, got 5000 N',
        ),
        (
            'robot',
            trajectory(['insertion'], (1.0, [0.1], []), (1.0, [0.1], [])),
            'trajectory times must be >= 0 and increasing, got 1 s after 1 s',
        ),
        (
            'indenter',
            trajectory(['x', 'z'], (1.0, [0.0, 0.0], [])),
            'the indenter takes efforts, not positions',
        ),
        ('indenter', trajectory(['x'], (1.0, [], [1.0])), "needs the joint 'z', got ['x']"),
        (
            'indenter',
            trajectory(['x', 'z'], (1.0, [], [1.0])),
            'each point needs efforts of x and z within 15 N, got [[1.0]]',
        ),
    ],
)
def test_invalid_trajectories_are_rejected_with_a_reason(
    ros_graph: RosGraph,
    capfd: pytest.CaptureFixture[str],
    mode: str,
    message: JointTrajectory,
    reason: str,
) -> None:
    """One line in the log and in the answer; the base does not move."""
    bench = Bench(ros_graph, mode=mode, depth=0.1)
    bench.course.publish(message)
    bench.refused(1)
    assert f'joint_trajectory rejected: {reason}\n' in capfd.readouterr().err
    (answer,) = bench.plant.diagnose().status.requests.answers
    assert (answer.verdict, answer.reason) == (Verdict.REJECTED, reason)
    if bench.states:
        assert bench.states[-1].position[0] == 0.1


def test_tare_zeroes_the_readings_at_rest(ros_graph: RosGraph) -> None:
    """After the tare the readings are about zero, also after a deactivation."""
    biased = {'sensor.force_bias': [1.0, -2.0, 3.0], 'sensor.torque_bias': 0.1}
    bench = Bench(ros_graph, **biased)

    def mean(messages: list[WrenchStamped]) -> FloatArray:
        parts = [(m.wrench.force, m.wrench.torque) for m in messages]
        return np.mean([[f.x, f.y, f.z, t.x, t.y, t.z] for f, t in parts], axis=0)

    offset = np.array([1.0, -2.0, 3.0, 0.1, 0.1, 0.1])
    # Five sigma of the 20 readings of 0.1 s and of 100 more.
    noise = np.repeat([0.2 * max(NOISE), 0.2 * 1.5e-3], 3)
    bound = 5 * noise * np.sqrt(1 / 20 + 1 / 100)
    assert np.all(np.abs(mean(bench.further(100)) - offset) < bound)
    answer = bench.zero()
    assert (answer.success, answer.message) == (True, 'the force sensor is zeroed')
    # Readings published before the tare are not zeroed.
    assert np.all(np.abs(mean(bench.further(110)[10:])) < bound)
    bench.plant.trigger_deactivate()
    refused = bench.zero()
    assert (refused.success, refused.message) == (False, 'tare refused: the plant is not active')
    bench.plant.trigger_activate()
    assert np.all(np.abs(mean(bench.further(110)[10:])) < bound)
    bench.plant.trigger_deactivate()
    bench.plant.trigger_cleanup()
    assert bench.plant.start()
    assert np.all(np.abs(mean(bench.further(110)[10:]) - offset) < bound)


def test_tare_is_rejected_while_the_needle_moves(ros_graph: RosGraph) -> None:
    """A moving needle cannot be zeroed, nor a needle that has just stopped."""
    bench = Bench(ros_graph)

    def pushed() -> bool:
        bench.commands.publish(wrench(3.56))
        return bench.states[-1].velocity[0] > 0.0

    bench.until(pushed, 'motion')
    answer = bench.tare.call_async(Trigger.Request())
    bench.until(lambda: pushed() and answer.done(), 'the answer')
    assert not answer.result().success
    # (3.56 - 0.56) N / 300 N s/m.
    assert answer.result().message == 'tare refused: the needle moves at 10 mm/s; it must rest'
    bench.until(lambda: bench.states[-1].velocity[0] == 0.0, 'rest')
    soon = bench.zero()
    assert not soon.success
    assert 'of 20 readings at rest so far' in soon.message
    bench.further(20)
    assert bench.zero().success


def test_simulated_time_at_ten_times_real_time(ros_graph: RosGraph) -> None:
    """10 s of stamps take about 1 s; no sample is missing."""
    bench = Bench(ros_graph, rate=100.0, real_time_factor=10.0)
    begin, first, waited = time.monotonic(), len(bench.states), bench.waited
    bench.until(lambda: len(bench.states) >= first + 1000, 'ten seconds')
    passed = time.monotonic() - begin
    # Faster only by the backlog of a stall; slower only by the delay of this machine and by
    # pending messages.
    assert passed > 0.5
    assert passed - (bench.waited - waited) < 2.0
    stamps = np.diff([stamp_ns(message) for message in bench.states])
    assert set(stamps) <= {9_999_999, 10_000_000, 10_000_001}


@pytest.mark.parametrize('factor', [1.0, 2.0])
def test_stall_drops_samples_or_delays_simulated_time(ros_graph: RosGraph, factor: float) -> None:
    """Time of the node clock skips samples beyond the backlog; independent time does not."""
    bench = Bench(ros_graph, rate=100.0, real_time_factor=factor, backlog=0.05)
    bench.further(20)
    # A stall: the plant is not spun.
    time.sleep(0.5)
    bench.further(50)
    stamps = np.diff([stamp_ns(message) for message in bench.states])
    given_up = bench.plant.diagnose().status.skipped
    if factor == 1.0:
        # 0.5 s minus the backlog.
        assert given_up >= 44
        assert stamps.max() >= 0.44e9
    else:
        assert given_up == 0
        assert bench.plant.diagnose().status.waited >= 0.44
        assert set(stamps) <= {9_999_999, 10_000_000, 10_000_001}


def test_time_waits_for_a_recorder_and_repeats_the_newest_sample(ros_graph: RosGraph) -> None:
    """A recorder that subscribes while time waits receives the sample: neither waits forever."""
    bench = Bench(ros_graph, publish_clock=True)
    recorder = ros_graph.node('recorder')
    reports = recorder.create_publisher(Header, 'joint_states/_recorded', COMMAND)

    def lags() -> bool:
        report = Header(frame_id='/recorder')
        report.stamp.nanosec = 1
        reports.publish(report)
        return 'a recorder is 80 samples behind' in bench.plant.diagnose().message

    bench.until(lags, 'the lag')
    sample = ros_graph.latest(recorder, JointState, 'joint_states', SENSOR)
    bench.until(lambda: sample.message, 'the sample again')
    assert stamp_ns(sample.message) == stamp_ns(bench.states[-1])
    number = len(bench.states)
    report = Header(frame_id='/recorder', stamp=sample.message.header.stamp)
    reports.publish(report)
    bench.until(lambda: len(bench.states) > number + 10, 'the next samples')


def test_clock_topic_drives_a_node_with_simulated_time(ros_graph: RosGraph) -> None:
    """A node with use_sim_time follows the newest sample and is never ahead of it."""
    follower = ros_graph.add(Node, 'follower', parameters={'use_sim_time': True})
    bench = Bench(ros_graph, rate=100.0, real_time_factor=10.0, publish_clock=True)
    bench.until(lambda: follower.get_clock().now().nanoseconds > 0, '/clock')
    before = follower.get_clock().now().nanoseconds
    begin, waited = time.monotonic(), bench.waited
    bench.until(
        lambda: follower.get_clock().now().nanoseconds > before + 5 * 10**9, 'five seconds'
    )
    # Ten times real time, less on a busy machine.
    assert time.monotonic() - begin - (bench.waited - waited) < 2.5
    now = follower.get_clock().now().nanoseconds
    bench.further(50)
    assert now in {stamp_ns(message) for message in bench.states}


def test_command_age_is_measured_in_simulated_time(ros_graph: RosGraph) -> None:
    """At five times real time a command of 0.1 s is valid for 0.02 s of the node clock."""
    bench = Bench(ros_graph, rate=1000.0, real_time_factor=5.0)
    bench.commands.publish(wrench(3.56))
    bench.until(lambda: any(m.velocity[0] > 0.0 for m in bench.states), 'motion')
    bench.until(lambda: bench.states[-1].velocity[0] == 0.0, 'rest')
    moving = [stamp_ns(m) for m in bench.states if m.velocity[0] > 0.0]
    # 0.5 s by the node clock. On arrival, samples of a stall may still be due: the backlog of 0.05
    # s at five times real time.
    assert 0.08e9 < moving[-1] - moving[0] < 0.1e9 + 5.0 * 0.05e9 + 0.02e9


def test_friction_may_change_during_motion(ros_graph: RosGraph) -> None:
    """The velocity changes immediately, the depth is continuous."""
    bench = Bench(ros_graph)
    configurations = bench.graph.listen(bench.probe, String, 'plant/configuration', LATCHED)

    def pushed() -> bool:
        bench.commands.publish(wrench(3.56))
        return bench.states[-1].velocity[0] > 0.0

    bench.until(lambda: pushed() and bench.states[-1].position[0] > 0.021, 'motion')
    depth = bench.plant.diagnose().status.insertion_depth
    changed = bench.plant.set_parameters_atomically(
        [
            Parameter('model.coulomb_friction', value=2.06),
            Parameter('model.viscous_friction', value=150.0),
        ]
    )
    assert changed.successful
    assert bench.plant.diagnose().status.insertion_depth == depth
    slow = len(bench.states)
    bench.until(lambda: pushed() and len(bench.states) > slow + 40, 'further samples')
    speed = np.array([message.velocity[0] for message in bench.states])
    position = np.array([message.position[0] for message in bench.states])
    # (3.56 - 2.06) N / 150 N s/m; friction settles within 0.1 ms.
    assert set(np.round(speed[speed > 0.0], 9)) == {0.01}
    assert np.diff(position).max() <= 0.01 / 200.0 * (1.0 + 1e-9)
    bench.until(lambda: 'model.coulomb_friction: 2.06' in configurations[-1].data, 'configuration')


def test_rejected_change_leaves_the_plant_unchanged(ros_graph: RosGraph) -> None:
    """Also the friction of a change whose fault is invalid."""
    bench = Bench(ros_graph)
    friction = bench.plant._run.constants.model.coulomb_friction
    changed = bench.plant.set_parameters_atomically(
        [
            Parameter('model.coulomb_friction', value=friction + 1.0),
            Parameter('fault.kind', value='bad luck'),
        ]
    )
    assert not changed.successful
    assert bench.plant._run.constants.model.coulomb_friction == friction


def test_controller_friction_may_change_if_gains_stay_stable(ros_graph: RosGraph) -> None:
    """The check is the same as at the start; a rejection keeps the value and gives the reason."""
    node = ros_graph.add(ControllerNode, parameters={**RATE, 'law': 'pid'})
    friction = [Parameter('model.viscous_friction', value=value) for value in (200.0, 0.3)]
    assert node.set_parameters(friction[:1])[0].successful
    refused = node.set_parameters(friction[1:])[0]
    assert not refused.successful
    assert refused.reason.startswith('pid.insertion gains are unstable at 200 Hz')
    assert node.get_parameter('model.viscous_friction').value == 200.0


def test_publisher_is_counted_once_before_and_at_its_event(ros_graph: RosGraph) -> None:
    """A timer may count a publisher of commands before the event of its match is executed."""
    plant = ros_graph.add(PlantNode, parameters={'paused': True})
    ros_graph.node('commander').create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    # Without spinning: the event of the match stays queued.
    deadline = time.monotonic() + 60.0
    while not plant._commanders.changed and time.monotonic() < deadline:
        time.sleep(0.01)
    now = plant._time.simulated(plant.now())
    plant._check_commanders()
    plant._check_commanders(1)
    assert plant._run.commands.may_move(now)
    # Another one, which has disappeared since.
    plant._check_commanders(1)
    assert not plant._run.commands.may_move(now)


@pytest.mark.parametrize(
    ('kind', 'name', 'value', 'reason'),
    [
        (
            PlantNode,
            'model.tissue_stiffness',
            600.0,
            'model.tissue_stiffness: cannot change while configured; clean up the node first',
        ),
        (
            PlantNode,
            'model.coulomb_friction',
            'much',
            "model.coulomb_friction must be a number, or text with a unit of N, mN, got 'much'",
        ),
        (
            PlantNode,
            'model.viscous_friction',
            -1,
            'model.viscous_friction must be finite, >= 0 N s/m, got -1.0',
        ),
        (
            ControllerNode,
            'deflection_feedback',
            'none',
            'deflection_feedback: cannot change while configured; clean up the node first',
        ),
        (
            ControllerNode,
            'model.coulomb_friction',
            True,
            'model.coulomb_friction must be a number, got True',
        ),
    ],
)
def test_read_only_parameters_are_rejected_while_active(
    ros_graph: RosGraph,
    kind: type[ControllerNode] | type[PlantNode],
    name: str,
    value: bool | float | str,
    reason: str,
) -> None:
    """A rejection gives the reason and keeps the value."""
    node = ros_graph.add(kind, parameters=RATE)
    before = node.get_parameter(name).value
    answer = node.set_parameters([Parameter(name, value=value)])[0]
    assert (answer.successful, answer.reason) == (False, reason)
    assert node.get_parameter(name).value == before
