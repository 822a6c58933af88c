"""The plant as the graph sees it."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
import signal
from signal import Signals
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped, WrenchStamped
from needle_controller.controller_node import ControllerNode
from needle_dynamics import FloatArray, ForceSensorParameters, IndenterParameters
from needle_dynamics.plant_node import PlantNode
from needle_insertion.experiment.node_process import GraphError
from needle_ros.base_node import COMMAND, LATCHED, SENSOR
import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterValueException
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from std_srvs.srv._trigger import Trigger_Response
from support.ros_graph import RosGraph
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
import yaml

#: Slow enough for a thread that also runs the test.
RATE = {'rate': 200.0}

NOISE = ForceSensorParameters().per_axis('noise')[:3]


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message in nanoseconds."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def wrench(force: float) -> WrenchStamped:
    """Return a wrench command."""
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


class Bench:
    """A plant in this process with a probe that listens to it and commands it."""

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

    def until(self, condition: Callable[..., Any], what: str) -> None:
        self.graph.spin_until(condition, what)

    def further(self, count: int) -> list[WrenchStamped]:
        """Spin until there are so many more readings of the force; return them."""
        seen = len(self.wrenches)
        self.until(lambda: len(self.wrenches) >= seen + count, 'readings')
        return self.wrenches[seen:]

    @property
    def waited(self) -> float:
        """How long simulated time has waited for this machine [s]."""
        return float(self.plant.diagnose()[2]['waited for the machine [s]'])

    def zero(self) -> Trigger_Response:
        """Ask for the tare; return the answer."""
        answer = self.tare.call_async(Trigger.Request())
        self.until(answer.done, 'the answer')
        return answer.result()

    def refused(self, count: int) -> None:
        """Spin until so many commands have been refused."""
        self.until(lambda: self.plant.diagnose()[2]['commands refused'] == count, 'the refusal')


def test_publishes_its_four_topics_in_step(ros_graph: RosGraph) -> None:
    """Each sample appears on all four topics with one stamp, exactly one period after the last."""
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
    ros_graph.add(PlantNode, parameters={**RATE, 'tip_deflection': 5e-4})
    ros_graph.spin_until(lambda: all(len(t) >= 100 for t in topics.values()), 'samples')
    stamps = {topic: [stamp_ns(m) for m in messages] for topic, messages in topics.items()}
    common = set.intersection(*(set(s) for s in stamps.values()))
    assert len(common) >= 90
    # Whole nanoseconds: the period may be off by the rounding of either stamp.
    assert set(np.diff(stamps['joint_states'])) <= {4_999_999, 5_000_000, 5_000_001}
    truth = topics['ground_truth'][-1]
    joints = next(m for m in topics['joint_states'] if stamp_ns(m) == stamp_ns(truth))
    assert list(truth.name) == ['d', 'theta', 'q1', 'q2']
    assert joints.position[0] == pytest.approx(0.2 - truth.position[0], abs=1e-15)
    assert topics['tip_deflection'][-1].header.frame_id == 'needle_entry'
    assert topics['base_wrench'][-1].header.frame_id == 'needle_base'


def test_moves_under_a_command_and_stops_without_it(ros_graph: RosGraph) -> None:
    """A push drives the needle at (f - mu_s) / mu_v, until the command is too old."""
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
    # mu_v = 300 N s/m; friction is settled within microseconds.
    assert states[-1].velocity[0] == pytest.approx(0.01, rel=1e-9)
    ros_graph.spin_until(lambda: states[-1].velocity[0] == 0.0, 'the stop after the timeout')


@pytest.mark.parametrize('force', [float('nan'), float('inf'), -1e300])
def test_a_command_that_no_robot_could_mean_is_no_force(ros_graph: RosGraph, force: float) -> None:
    """NaN, infinity and absurd forces are refused, counted, and leave the needle where it is."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    plant = ros_graph.add(PlantNode, parameters=RATE)
    ros_graph.spin_until(lambda: states and commands.get_subscription_count(), 'discovery')
    commands.publish(wrench(force))
    ros_graph.spin_until(lambda: plant.diagnose()[2]['commands refused'] == 1, 'the refusal')
    seen = len(states)
    ros_graph.spin_until(lambda: len(states) > seen + 20, 'further samples')
    assert states[-1].position[0] == states[0].position[0]


def test_the_base_follows_a_trajectory_and_feels_friction(ros_graph: RosGraph) -> None:
    """In mode robot the base is where the trajectory says, and the wrench is mu_s + mu_v u."""
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
    # The last approach closes half the error per period: far below a micrometer at rest.
    assert states[-1].position[0] == pytest.approx(0.11, abs=1e-6)
    speed = {stamp_ns(m): m.velocity[0] for m in states}
    steady = [m.wrench.force.y for m in wrenches if abs(speed.get(stamp_ns(m), 0.0) - 0.01) < 1e-6]
    # Mean of at least 50 readings; the filter leaves a fifth of the noise; five sigma.
    assert len(steady) > 50
    assert np.mean(steady) == pytest.approx(3.56, abs=5 * 0.2 * max(NOISE) / np.sqrt(50))


def test_a_needle_pulled_out_stands_still_and_is_reported(ros_graph: RosGraph) -> None:
    """Below the least inserted length the plant stops, and /diagnostics says why."""
    probe = ros_graph.node('probe')
    reports = ros_graph.listen(probe, DiagnosticArray, '/diagnostics', 10)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    ros_graph.add(PlantNode, parameters={**RATE, 'depth': 0.002})
    ros_graph.spin_until(commands.get_subscription_count, 'discovery')

    def reported() -> bool:
        commands.publish(wrench(-3.0))
        return any('minimum_depth' in report.status[0].message for report in reports)

    ros_graph.spin_until(reported, 'the report')


def test_its_configuration_is_a_parameter_file(ros_graph: RosGraph) -> None:
    """The latched configuration reaches who comes late and holds every parameter."""
    ros_graph.add(PlantNode, parameters={**RATE, 'model.coulomb_friction': 1, 'depth': 0.03})
    late = ros_graph.listen(ros_graph.node('probe'), String, 'plant/configuration', LATCHED)
    ros_graph.spin_until(lambda: late, 'configuration')
    values = yaml.safe_load(late[0].data)['/plant']['ros__parameters']
    assert values['model.coulomb_friction'] == 1
    assert values['model.viscous_friction'] == 300.0
    assert values['model.preset'] == 'phantom'


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode])
def test_its_configuration_makes_it_anew(
    ros_graph: RosGraph, tmp_path: Path, kind: type[ControllerNode] | type[PlantNode]
) -> None:
    """A node started from the configuration of another has the same configuration."""
    layers = {'model.layer_depths': [0.03, 0.06], 'model.layer_stiffnesses': [900.0, 200.0]}
    for parameters in ({}, layers):
        first = ros_graph.add(kind, parameters=parameters, start=False)
        file = tmp_path / 'node.yaml'
        file.write_text(first.configuration())
        arguments = ['--ros-args', '--params-file', str(file)]
        second = ros_graph.add(kind, cli_args=arguments)
        assert second.configuration() == first.configuration()


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode])
def test_the_shipped_parameter_file_is_accepted(
    ros_graph: RosGraph, kind: type[ControllerNode] | type[PlantNode]
) -> None:
    """Every name in config/insertion.yaml is known and every value valid."""
    file = Path(__file__).parents[2] / 'config' / 'insertion.yaml'
    node = ros_graph.add(kind, cli_args=['--ros-args', '--params-file', str(file)])
    given = yaml.safe_load(file.read_text())[f'/**/{node.get_name()}']['ros__parameters']
    assert {name: node.get_parameter(name).value for name in given} == given


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({'model.lenght': 0.3}, "unknown parameter 'model.lenght'; did you mean 'model.length'"),
        ({'model.preset': 'steel'}, 'model.preset must be one of paper_si, paper_mm, phantom'),
        ({'depth': 0.3}, 'insertion depth 0.3 m is outside'),
        ({'seed': -1}, 'seed out of range'),
    ],
)
def test_bad_parameters_end_the_process_with_one_line(
    ros_graph: RosGraph, parameters: dict[str, Any], complaint: str
) -> None:
    """A process that cannot be configured says why in its last line and exits with 2."""
    plant = ros_graph.start('plant', parameters)
    assert plant.process.wait(30) == 2
    assert complaint in plant.last_line
    with pytest.raises(GraphError, match='ended early with status 2'):
        plant.check()


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({'mode': 'dream'}, "mode must be one of simulation, robot, indenter, got 'dream'"),
        ({'model.length': 'long'}, "model.length must be a number, got 'long'"),
        ({'sensor.filter': 7}, 'sensor.filter must be an integer from 0 (none) to 6, got 7'),
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
        (
            {'rate': 5.0},
            'command_timeout must be at least a period, 0.2 s, got 0.1 s',
        ),
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
def test_it_refuses_to_be_configured_and_says_why(
    ros_graph: RosGraph, parameters: dict[str, Any], complaint: str
) -> None:
    """The reason is one line that names the parameter; nothing is left half made."""
    node = ros_graph.add(PlantNode, parameters=parameters, start=False)
    assert not node.start()
    assert complaint in node.failure
    assert node.diagnose()[2] == {}


@pytest.mark.parametrize(
    ('name', 'value'), [('model.density', -1.0), ('step', float('nan')), ('step', 1e-13)]
)
def test_a_value_out_of_its_range_is_refused(ros_graph: RosGraph, name: str, value: float) -> None:
    """The range that the parameter is declared with holds from the start."""
    with pytest.raises(InvalidParameterValueException, match=f'{name} out of range'):
        ros_graph.add(PlantNode, parameters={name: value})


@pytest.mark.parametrize('name', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_end_it_well(ros_graph: RosGraph, name: Signals) -> None:
    """Ctrl-C, a kill and a closed terminal end the process with 0 and without a traceback."""
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
def test_arguments_that_ros_cannot_read_end_in_one_line(
    tmp_path: Path, arguments: list[str]
) -> None:
    """An unreadable command line is told in one line, with exit status 2."""
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


def test_beyond_its_range_without_hub_stop_it_stands_still(ros_graph: RosGraph) -> None:
    """Pushed through by more than its length the plant stops and reports; it does not die."""
    probe = ros_graph.node('probe')
    reports = ros_graph.listen(probe, DiagnosticArray, '/diagnostics', 10)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    limits = {'force_limit': 20.0, 'power_limit': 1e3}
    free = {'model.hub_stop': False, 'model.preset': 'paper_si', 'depth': 0.1, **limits}
    ros_graph.add(PlantNode, parameters={**RATE, **free})
    ros_graph.spin_until(commands.get_subscription_count, 'discovery')

    def reported() -> bool:
        commands.publish(wrench(20.0))
        return any('insertion depth' in report.status[0].message for report in reports)

    ros_graph.spin_until(reported, 'the report')


def test_the_preset_is_fixed_at_start(ros_graph: RosGraph) -> None:
    """The defaults follow from the preset, so it cannot change afterwards."""
    plant = ros_graph.add(PlantNode, start=False)
    changed = plant.set_parameters([Parameter('model.preset', value='paper_si')])[0]
    assert not changed.successful


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode])
@pytest.mark.parametrize('configured', [False, True])
def test_it_can_be_shut_down_before_it_was_active(
    ros_graph: RosGraph, kind: type[ControllerNode] | type[PlantNode], configured: bool
) -> None:
    """Shutdown is granted from unconfigured and from inactive."""
    node = ros_graph.add(kind, start=False)
    if configured:
        assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS


def test_a_trajectory_out_of_reach_is_refused(ros_graph: RosGraph) -> None:
    """The base stays where it is when a point lies before the skin or beyond the hub."""
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


def test_in_simulation_a_path_is_for_the_controller_alone(ros_graph: RosGraph) -> None:
    """One subscriber, so that `ros2 topic pub --once` waits for the one that counts."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    ros_graph.add(PlantNode, parameters=RATE)
    ros_graph.add(ControllerNode, parameters=RATE)
    ros_graph.spin_until(lambda: states and probe.count_subscribers('joint_trajectory'), 'both')
    assert probe.count_subscribers('joint_trajectory') == 1


def test_a_push_breaks_the_needle_away_and_a_motion_follows(ros_graph: RosGraph) -> None:
    """An effort ramp moves the base from mu_s on; then positions count from where it is."""
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
    # The force of a sample is the mean of its interval: 2 N/s over 5 ms between samples; the
    # ramp itself is rounded.
    assert max(resting) <= 0.56 + 1e-12
    assert 0.56 - 1e-12 < min(moving) < 0.56 + 0.011
    # mu_v = 300 N s/m; the speed is that of the last quarter of 5 ms, in which the force rises by
    # 2.5 mN, the reading that at its end. After the largest force it brakes for the way back.
    last = max(range(len(at)), key=lambda i: at[i][0])
    steady = [(f - 0.56) / 300.0 - speed for f, speed in at[:last] if f > 0.56]
    assert len(steady) > 100
    assert np.abs(steady).max() < 0.0013 / 300.0
    assert states[-1].position[0] == pytest.approx(0.1, abs=1.5e-6)


def has_refused_one(plant: PlantNode) -> bool:
    """Tell whether the plant has refused one command."""
    return plant.diagnose()[2]['commands refused'] == 1


def has(messages: list[Any], count: int) -> bool:
    """Tell whether so many messages have come."""
    return len(messages) >= count


def test_a_trajectory_sent_before_the_activation_begins_with_it(ros_graph: RosGraph) -> None:
    """With the same seed two runs are then the same, sample by sample."""
    runs = []
    for name in ('one', 'two'):
        probe = ros_graph.node(name)
        wrenches = ros_graph.listen(probe, WrenchStamped, f'{name}/base_wrench', SENSOR)
        course = probe.create_publisher(JointTrajectory, f'{name}/joint_trajectory', COMMAND)
        plant = ros_graph.add(
            PlantNode,
            parameters={**RATE, 'mode': 'robot', 'depth': 0.1},
            namespace=name,
            start=False,
        )
        plant.trigger_configure()
        ros_graph.spin_until(course.get_subscription_count, 'the subscription')
        course.publish(trajectory(['insertion'], (0.3, [], [2.0]), (0.6, [0.1], [])))
        assert course.wait_for_all_acked(Duration(seconds=10))
        for _ in range(10):
            ros_graph.executor.spin_once(timeout_sec=0.02)
        # Only the newest command counts: this one, refused, tells that the first was taken.
        course.publish(trajectory(['insertion']))
        ros_graph.spin_until(partial(has_refused_one, plant), 'the refusal')
        (sender,) = (p for p in plant.publishers if p.topic_name.endswith('base_wrench'))
        ros_graph.spin_until(sender.get_subscription_count, 'the reader')
        plant.trigger_activate()
        ros_graph.spin_until(partial(has, wrenches, 150), 'readings')
        runs.append([message.wrench.force.y for message in wrenches[:150]])
    assert max(runs[0]) > 1.0
    assert runs[0] == runs[1]


def test_the_encoder_counts_whole_micrometers(ros_graph: RosGraph) -> None:
    """In mode robot the joint position is rounded to the encoder's resolution."""
    bench = Bench(ros_graph, mode='robot', depth=0.1, **{'base.encoder_resolution': 1e-4})
    bench.course.publish(trajectory(['insertion'], (0.5, [0.102], [])))
    bench.until(lambda: bench.states[-1].position[0] >= 0.102, 'the end')
    counts = np.array([m.position[0] for m in bench.states]) / 1e-4
    # Rounding of a quotient of the size of 1000.
    assert np.abs(counts - np.round(counts)).max() < 1e-9
    assert len(set(np.round(counts))) == 21


def test_the_end_effector_presses_the_tissue(ros_graph: RosGraph) -> None:
    """In mode indenter the pose is where K(|F|) d = F, and the wrench is F; nothing else comes."""
    bench = Bench(ros_graph, mode='indenter')
    force = np.array([0.6, -1.2])
    bench.course.publish(trajectory(['z', 'x'], (0.5, [], [-1.2, 0.6]), (9.0, [], [-1.2, 0.6])))
    bench.until(lambda: bench.poses and bench.poses[-1].pose.position.z < -9e-4, 'the press')
    bench.until(lambda: bench.wrenches[-1].wrench.force.z < -1.1, 'the press')
    seen = len(bench.poses)
    # The last of the ramp takes 0.1 s, 20 samples.
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
        ('robot', trajectory(['insertion']), 'trajectory has no points'),
        (
            'robot',
            trajectory(['insertion'], (1.0, [], [])),
            'each point needs a position or an effort',
        ),
        (
            'robot',
            trajectory(['insertion'], (1.0, [], [5e3])),
            'a push must be within 15 N, got [5000.0] N',
        ),
        (
            'robot',
            trajectory(['insertion'], (1.0, [0.1], []), (1.0, [0.1], [])),
            'trajectory times must be >= 0 and increasing, got [1.0, 1.0] s',
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
def test_trajectories_are_refused_with_their_reason(
    ros_graph: RosGraph,
    capfd: pytest.CaptureFixture[str],
    mode: str,
    message: JointTrajectory,
    reason: str,
) -> None:
    """With one line, in the log and in the answer to the sender; nothing moves."""
    bench = Bench(ros_graph, mode=mode, depth=0.1)
    bench.course.publish(message)
    bench.refused(1)
    assert f'joint_trajectory rejected: {reason}\n' in capfd.readouterr().err
    assert bench.plant.diagnose()[2]['request joint_trajectory 0'] == f'rejected: {reason}'
    if bench.states:
        assert bench.states[-1].position[0] == 0.1


def test_tare_zeroes_the_readings_at_rest(ros_graph: RosGraph) -> None:
    """After the tare the readings are about zero, and stay so after a deactivation."""
    biased = {'sensor.force_bias': [1.0, -2.0, 3.0], 'sensor.torque_bias': 0.1}
    bench = Bench(ros_graph, **biased)

    def mean(messages: list[WrenchStamped]) -> FloatArray:
        parts = [(m.wrench.force, m.wrench.torque) for m in messages]
        return np.mean([[f.x, f.y, f.z, t.x, t.y, t.z] for f, t in parts], axis=0)

    offset = np.array([1.0, -2.0, 3.0, 0.1, 0.1, 0.1])
    # Five sigma of the 20 readings of a tenth of a second and of 100 more.
    noise = np.repeat([0.2 * max(NOISE), 0.2 * 1.5e-3], 3)
    bound = 5 * noise * np.sqrt(1 / 20 + 1 / 100)
    assert np.all(np.abs(mean(bench.further(100)) - offset) < bound)
    answer = bench.zero()
    assert (answer.success, answer.message) == (True, 'the force sensor is zeroed')
    # The readings on their way when the tare came are not zeroed.
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


def test_tare_is_refused_while_the_needle_moves(ros_graph: RosGraph) -> None:
    """A moving needle cannot be zeroed, nor one that has just come to rest."""
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


def test_simulated_time_runs_faster(ros_graph: RosGraph) -> None:
    """At ten times the pace 10 s of stamps pass in about 1 s; not one sample is missing."""
    bench = Bench(ros_graph, rate=100.0, real_time_factor=10.0)
    begin, first, waited = time.monotonic(), len(bench.states), bench.waited
    bench.until(lambda: len(bench.states) >= first + 1000, 'ten seconds')
    passed = time.monotonic() - begin
    # Not faster, but for what a stall of the backlog has left to make up; slower only by what
    # it has waited for this machine, and by the last messages on their way.
    assert passed > 0.5
    assert passed - (bench.waited - waited) < 2.0
    stamps = np.diff([stamp_ns(message) for message in bench.states])
    assert set(stamps) <= {9_999_999, 10_000_000, 10_000_001}


@pytest.mark.parametrize('factor', [1.0, 2.0])
def test_after_a_stall_samples_are_given_up_or_simulated_time_waits(
    ros_graph: RosGraph, factor: float
) -> None:
    """Stamps that are the node's clock skip what is beyond the backlog; others never skip."""
    bench = Bench(ros_graph, rate=100.0, real_time_factor=factor, backlog=0.05)
    bench.further(20)
    # The stall: nobody spins the plant.
    time.sleep(0.5)
    bench.further(50)
    stamps = np.diff([stamp_ns(message) for message in bench.states])
    given_up = bench.plant.diagnose()[2]['samples given up']
    if factor == 1.0:
        # 0.5 s, less the backlog.
        assert given_up >= 44
        assert stamps.max() >= 0.44e9
    else:
        assert given_up == 0
        assert float(bench.plant.diagnose()[2]['waited for the machine [s]']) >= 0.44
        assert set(stamps) <= {9_999_999, 10_000_000, 10_000_001}


def test_its_clock_drives_a_node_with_simulated_time(ros_graph: RosGraph) -> None:
    """A node with use_sim_time is never ahead of the newest sample, and goes with it."""
    follower = ros_graph.add(Node, 'follower', parameters={'use_sim_time': True})
    bench = Bench(ros_graph, rate=100.0, real_time_factor=10.0, publish_clock=True)
    bench.until(lambda: follower.get_clock().now().nanoseconds > 0, '/clock')
    before = follower.get_clock().now().nanoseconds
    begin, waited = time.monotonic(), bench.waited
    bench.until(
        lambda: follower.get_clock().now().nanoseconds > before + 5 * 10**9, 'five seconds'
    )
    # Ten times as fast as the clock on the wall, but for a machine that is busy.
    assert time.monotonic() - begin - (bench.waited - waited) < 2.5
    now = follower.get_clock().now().nanoseconds
    bench.further(50)
    assert now in {stamp_ns(message) for message in bench.states}


def test_a_command_ages_in_simulated_time(ros_graph: RosGraph) -> None:
    """At five times the pace a command of 0.1 s counts for 0.02 s of the node's clock."""
    bench = Bench(ros_graph, rate=1000.0, real_time_factor=5.0)
    bench.commands.publish(wrench(3.56))
    bench.until(lambda: any(m.velocity[0] > 0.0 for m in bench.states), 'motion')
    bench.until(lambda: bench.states[-1].velocity[0] == 0.0, 'rest')
    moving = [stamp_ns(m) for m in bench.states if m.velocity[0] > 0.0]
    # By the node's clock it would be 0.5 s. When it comes, samples of a stall may still be due:
    # those of the backlog, 0.05 s of five times the pace.
    assert 0.08e9 < moving[-1] - moving[0] < 0.1e9 + 5.0 * 0.05e9 + 0.02e9


def test_friction_may_change_while_it_moves(ros_graph: RosGraph) -> None:
    """A live change of friction alters the speed at once, and not the depth."""
    bench = Bench(ros_graph)
    configurations = bench.graph.listen(bench.probe, String, 'plant/configuration', LATCHED)

    def pushed() -> bool:
        bench.commands.publish(wrench(3.56))
        return bench.states[-1].velocity[0] > 0.0

    bench.until(lambda: pushed() and bench.states[-1].position[0] > 0.021, 'motion')
    depth = bench.plant.diagnose()[2]['inserted length [m]']
    changed = bench.plant.set_parameters_atomically(
        [
            Parameter('model.coulomb_friction', value=2.06),
            Parameter('model.viscous_friction', value=150.0),
        ]
    )
    assert changed.successful
    assert bench.plant.diagnose()[2]['inserted length [m]'] == depth
    slow = len(bench.states)
    bench.until(lambda: pushed() and len(bench.states) > slow + 40, 'further samples')
    speed = np.array([message.velocity[0] for message in bench.states])
    position = np.array([message.position[0] for message in bench.states])
    # (3.56 - 2.06) N / 150 N s/m, friction being settled within 0.1 ms.
    assert set(np.round(speed[speed > 0.0], 9)) == {0.01}
    assert np.diff(position).max() <= 0.01 / 200.0 * (1.0 + 1e-9)
    bench.until(lambda: 'model.coulomb_friction: 2.06' in configurations[-1].data, 'configuration')


def test_the_controller_takes_friction_live_if_its_gains_can_bear_it(ros_graph: RosGraph) -> None:
    """Friction is checked as at the start; what is refused leaves the value, and says why."""
    node = ros_graph.add(ControllerNode, parameters={**RATE, 'law': 'pid'})
    friction = [Parameter('model.viscous_friction', value=value) for value in (200.0, 0.3)]
    assert node.set_parameters(friction[:1])[0].successful
    refused = node.set_parameters(friction[1:])[0]
    assert not refused.successful
    assert refused.reason.startswith('pid.insertion gains are unstable at 200 Hz')
    assert node.get_parameter('model.viscous_friction').value == 200.0


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
            "model.coulomb_friction must be a number, got 'much'",
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
def test_what_cannot_change_live_is_refused(
    ros_graph: RosGraph,
    kind: type[ControllerNode] | type[PlantNode],
    name: str,
    value: bool | float | str,
    reason: str,
) -> None:
    """A refused change says why and leaves the value."""
    node = ros_graph.add(kind, parameters=RATE)
    before = node.get_parameter(name).value
    answer = node.set_parameters([Parameter(name, value=value)])[0]
    assert (answer.successful, answer.reason) == (False, reason)
    assert node.get_parameter(name).value == before
