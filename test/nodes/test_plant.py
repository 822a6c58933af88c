"""The plant as the graph sees it."""

from pathlib import Path
import signal
import subprocess
import sys

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_controller.controller_node import ControllerNode
from needle_dynamics import ForceSensorParameters
from needle_dynamics.base_node import COMMAND, LATCHED, SENSOR
from needle_dynamics.plant_node import PlantNode
from needle_insertion.graph import GraphError
import numpy as np
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
import yaml

#: Slow enough for a thread that also runs the test.
RATE = {'rate': 200.0, 'sensor.cutoff': 50.0}


def stamp_ns(message) -> int:
    """Return the stamp of a message in nanoseconds."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def wrench(force: float) -> WrenchStamped:
    """Return a wrench command."""
    message = WrenchStamped()
    message.wrench.force.y = force
    return message


def test_publishes_its_four_topics_in_step(ros_graph):
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


def test_moves_under_a_command_and_stops_without_it(ros_graph):
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
def test_a_command_that_no_robot_could_mean_is_no_force(ros_graph, force):
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


def test_the_base_follows_a_trajectory_and_feels_friction(ros_graph):
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
    noise = ForceSensorParameters().force_noise
    # Mean of at least 50 samples of which the filter leaves 70 % of the noise; five sigma.
    assert len(steady) > 50
    assert np.mean(steady) == pytest.approx(3.56, abs=5 * noise / np.sqrt(50))


def test_a_needle_pulled_out_stands_still_and_is_reported(ros_graph):
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


def test_its_configuration_is_a_parameter_file(ros_graph):
    """The latched configuration reaches who comes late and holds every parameter."""
    ros_graph.add(PlantNode, parameters={**RATE, 'model.coulomb_friction': 1, 'depth': 0.03})
    late = ros_graph.listen(ros_graph.node('probe'), String, 'plant/configuration', LATCHED)
    ros_graph.spin_until(lambda: late, 'configuration')
    values = yaml.safe_load(late[0].data)['/plant']['ros__parameters']
    assert values['model.coulomb_friction'] == 1
    assert values['model.viscous_friction'] == 300.0
    assert values['model.preset'] == 'phantom'


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode])
def test_its_configuration_makes_it_anew(ros_graph, tmp_path, kind):
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
def test_the_shipped_parameter_file_is_accepted(ros_graph, kind):
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
        ({'mode': 'dream'}, 'mode must be one of simulation, robot'),
        ({'sensor.cutoff': 600.0}, 'cutoff must be < half the sample rate = 500 Hz'),
        ({'model.length': 'long'}, "model.length must be a number, got 'long'"),
        ({'model.density': -1.0}, 'model.density'),
        ({'step': float('nan')}, 'step'),
        ({'depth': 0.3}, 'inserted length 0.3 m is outside'),
        ({'seed': -1}, 'seed out of range'),
        ({'step': 1e-13}, 'step out of range'),
    ],
)
def test_bad_parameters_end_the_process_with_one_line(ros_graph, parameters, complaint):
    """A process that cannot be configured says why in its last line and exits with 2."""
    plant = ros_graph.start('plant', parameters)
    assert plant.process.wait(30) == 2
    assert complaint in plant.last_words()
    with pytest.raises(GraphError, match='ended early with status 2'):
        plant.check()


@pytest.mark.parametrize('name', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_well(ros_graph, name):
    """SIGINT and SIGTERM end the process with 0 and without a traceback."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    plant = ros_graph.start('plant')
    ros_graph.spin_until(lambda: states, 'joint_states')
    plant.process.send_signal(name)
    assert plant.process.wait(30) == 0
    assert 'Traceback' not in plant.last_words()


@pytest.mark.parametrize(
    'arguments',
    [['--params-file', 'missing.yaml'], ['-p', 'depth']],
    ids=['no such file', 'no value'],
)
def test_arguments_that_ros_cannot_read_end_in_one_line(tmp_path, arguments):
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


def test_beyond_its_range_without_hub_stop_it_stands_still(ros_graph):
    """Pushed through by more than its length the plant stops and reports; it does not die."""
    probe = ros_graph.node('probe')
    reports = ros_graph.listen(probe, DiagnosticArray, '/diagnostics', 10)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    free = {'model.hub_stop': False, 'model.preset': 'paper_si', 'depth': 0.1}
    ros_graph.add(PlantNode, parameters={**RATE, **free})
    ros_graph.spin_until(commands.get_subscription_count, 'discovery')

    def reported() -> bool:
        commands.publish(wrench(20.0))
        return any('inserted length' in report.status[0].message for report in reports)

    ros_graph.spin_until(reported, 'the report')


def test_the_preset_is_fixed_at_start(ros_graph):
    """The defaults follow from the preset, so it cannot change afterwards."""
    plant = ros_graph.add(PlantNode, start=False)
    changed = plant.set_parameters([Parameter('model.preset', value='paper_si')])[0]
    assert not changed.successful


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode])
@pytest.mark.parametrize('configured', [False, True])
def test_it_can_be_shut_down_before_it_was_active(ros_graph, kind, configured):
    """Shutdown is granted from unconfigured and from inactive."""
    node = ros_graph.add(kind, start=False)
    if configured:
        assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS


def test_a_trajectory_out_of_reach_is_refused(ros_graph):
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
