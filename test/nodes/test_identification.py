# SPDX-License-Identifier: Apache-2.0
"""Identification node: results from bags and running topics, and parameters of other nodes."""

from dataclasses import replace
import math
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from needle_dynamics.plant_node import PlantNode
from needle_identification.identification_node import IdentificationNode
from needle_ros.base_node import COMMAND, LATCHED, SENSOR
from needle_ros.event_log import Severity
from needle_ros.status import IdentificationStatus
from numpy.testing import assert_allclose
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.presses import write_presses
from support.ros_graph import RosGraph
from support.samples import NOISY, simulated, TRUTH, write_bag
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

COEFFICIENTS = (('coulomb_friction', 'N'), ('viscous_friction', 'N s/m'))


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return three recordings of the simulated needle."""
    folder = tmp_path_factory.mktemp('bags')
    paths = [folder / f'run_{seed}' for seed in range(3)]
    for seed, path in enumerate(paths):
        write_bag(path, simulated(sensor=NOISY, seed=seed))
    return [str(path) for path in paths]


@pytest.fixture(scope='module')
def place(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a recording of presses."""
    path = tmp_path_factory.mktemp('places') / 'place'
    write_presses(path)
    return str(path)


def call(ros_graph: RosGraph, service: str) -> tuple[bool, str]:
    """Call a service of the node; return success and message."""
    client = ros_graph.node('caller').create_client(Trigger, f'identification/{service}')
    ros_graph.spin_until(client.service_is_ready, 'the service')
    asked: list[Future] = []
    start = time.monotonic()

    def answered() -> bool:
        # A response to an undiscovered client is lost: repeat the call.
        if time.monotonic() - start >= 6.0 * len(asked):
            asked.append(client.call_async(Trigger.Request()))
        return any(answer.done() for answer in asked)

    ros_graph.spin_until(answered, 'the answer')
    response = next(answer for answer in asked if answer.done()).result()
    return response.success, response.message


def apply(ros_graph: RosGraph, target: str) -> tuple[bool, str]:
    """Call ``~/apply`` until the node has discovered the other node."""
    answers = [(False, f'{target}: no such node')]

    def answered() -> bool:
        if f'{target}: no such node' in answers[-1][1]:
            answers.append(call(ros_graph, 'apply'))
            return False
        return True

    ros_graph.spin_until(answered, f'the node {target}')
    return answers[-1]


def statuses(message: DiagnosticArray) -> dict[str, dict[str, str]]:
    """Return the values of each status by name."""
    return {s.name: {v.key: v.value for v in s.values} for s in message.status}


def test_activation_publishes_a_latched_result(ros_graph: RosGraph, bags: list[str]) -> None:
    """Estimate, interval, unit, sample count and quality."""
    ros_graph.add(IdentificationNode, parameters={'bags': bags})
    late = ros_graph.listen(ros_graph.node('late'), DiagnosticArray, 'friction', LATCHED)
    ros_graph.spin_until(lambda: late, 'the result')
    status = statuses(late[0])
    assert list(status)[:2] == ['coulomb_friction', 'viscous_friction']
    assert list(status)[-3:] == bags
    for name, unit in COEFFICIENTS:
        values = status[name]
        low, high = float(values['interval_low']), float(values['interval_high'])
        assert low < getattr(TRUTH, name) < high
        assert low < float(values['estimate']) < high
        assert (values['unit'], values['recordings']) == (unit, '3')
        assert int(values['samples']) > 1000
    assert float(status[bags[0]]['determination']) > 0.99


def test_publishes_stiffness_by_force(ros_graph: RosGraph, place: str) -> None:
    """Latched: k_a at the chosen force, and each entry at each force."""
    parameters = {'bags': [place], 'what': 'stiffness', 'level': 1.5}
    ros_graph.add(IdentificationNode, parameters=parameters)
    late = ros_graph.listen(ros_graph.node('late'), DiagnosticArray, 'stiffness', LATCHED)
    ros_graph.spin_until(lambda: late, 'the result')
    status = statuses(late[0])
    assert float(status['tissue_stiffness']['estimate']) == pytest.approx(520.0, abs=5.0)
    assert float(status['k_xx at 1.10 N']['estimate']) == pytest.approx(1260.0, abs=5.0)
    assert status[place]['presses'] == '16'


def test_result_is_a_parameter_file_for_any_namespace(
    ros_graph: RosGraph, bags: list[str], tmp_path: Path
) -> None:
    """Rclpy applies the file to plant and controller only."""
    output = tmp_path / 'friction.yaml'
    ros_graph.add(IdentificationNode, parameters={'bags': bags, 'output': str(output)})
    for name, namespace, expected in (
        ('plant', None, True),
        ('controller', None, True),
        ('plant', '/lab/left', True),
        ('recorder', None, False),
    ):
        node = ros_graph.add(
            Node,
            name,
            namespace=namespace,
            cli_args=['--ros-args', '--params-file', str(output)],
            automatically_declare_parameters_from_overrides=True,
        )
        assert node.has_parameter('model.coulomb_friction') == expected
        if expected:
            value = node.get_parameter('model.viscous_friction').value
            assert value == pytest.approx(TRUTH.viscous_friction, rel=0.01)


def test_service_reports_the_reason_of_a_failure(ros_graph: RosGraph) -> None:
    """One line, and the node stays active."""
    node = ros_graph.add(IdentificationNode)
    assert call(ros_graph, 'identify') == (False, 'no recordings to identify from')
    assert node.is_active


def test_recordings_that_differ_are_reported(
    ros_graph: RosGraph, bags: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """As by the command: another needle has twice the friction."""
    other = simulated(sensor=NOISY, seed=3)
    write_bag(tmp_path / 'other', replace(other, force=2.0 * other.force))
    ros_graph.add(IdentificationNode, parameters={'bags': [*bags, str(tmp_path / 'other')]})
    assert call(ros_graph, 'identify')[0]
    assert 'the recordings differ' in capfd.readouterr().err


def test_service_uses_the_current_bags(ros_graph: RosGraph, bags: list[str]) -> None:
    """A running node identifies from other recordings without a restart."""
    node = ros_graph.add(IdentificationNode, parameters={'bags': bags[:1]})
    assert node.set_parameters([Parameter('bags', value=bags)])[0].successful
    success, message = call(ros_graph, 'identify')
    assert success
    assert message.startswith('mu_s = 0.5')
    assert message.endswith('from 3 recordings')
    assert not node.set_parameters([Parameter('what', value='stiffness')])[0].successful


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({'bags': ['/no/such/bag']}, '/no/such/bag does not exist'),
        ({'friction.cutoff': 0.0}, 'friction.cutoff must be finite, > 0'),
        ({'friction.terms': ['drag']}, 'friction.terms must be one of coulomb'),
        ({'friction.cutof': 5.0}, "unknown parameter 'friction.cutof'; did you mean 'friction."),
        ({'stiffness.estimator': 'luck'}, 'stiffness.estimator must be one of'),
        ({'what': 'mass'}, "what must be one of friction, stiffness, got 'mass'"),
        ({'time': 'now'}, "time must be one of header, receive, got 'now'"),
        ({'force_axis': '-w'}, "force_axis must be x, y, z, -x, -y or -z, got '-w'"),
        ({'axes': ['x']}, "axes must be two, got ['x']"),
        ({'window': 0.0}, 'window must be finite, > 0'),
    ],
)
def test_invalid_parameters_are_rejected_at_start(
    ros_graph: RosGraph, parameters: dict[str, Any], complaint: str
) -> None:
    node = ros_graph.add(IdentificationNode, start=False, parameters=parameters)
    assert not node.start()
    assert complaint in node.failure


# Running topics.


def test_friction_of_a_running_plant_is_identified(ros_graph: RosGraph) -> None:
    """The intervals shrink around the friction of the moving simulated plant."""
    truth = {'coulomb_friction': 0.8, 'viscous_friction': 200.0}
    parameters = {f'model.{name}': value for name, value in truth.items()}
    plant = {'mode': 'robot', 'depth': 0.1, 'rate': 250.0, 'real_time_factor': 4.0}
    ros_graph.start('plant', {**plant, **parameters})
    node = ros_graph.add(IdentificationNode, parameters={'live': True})
    probe = ros_graph.node('probe')
    found = ros_graph.listen(probe, DiagnosticArray, 'friction', LATCHED)
    reports = ros_graph.listen(probe, DiagnosticArray, '/diagnostics', 10)
    trajectory = probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
    ros_graph.spin_until(trajectory.get_subscription_count, 'the plant')
    message = JointTrajectory(joint_names=['insertion'])
    for second, depth in enumerate([0.1, 0.105, 0.1, 0.11, 0.1, 0.115] * 5, 1):
        point = JointTrajectoryPoint(positions=[depth])
        point.time_from_start.sec = second
        message.points.append(point)
    trajectory.publish(message)

    def told() -> bool:
        if not found:
            return False
        status = statuses(found[-1])
        intervals = [
            (float(status[name]['interval_low']), float(status[name]['interval_high']))
            for name, _ in COEFFICIENTS
        ]
        # Two percent of the true value.
        return all(
            high - low < 0.04 * truth[name]
            for (name, _), (low, high) in zip(COEFFICIENTS, intervals, strict=True)
        )

    ros_graph.spin_until(told, 'the friction')
    assert {status.hardware_id for status in found[-1].status} == {'live'}
    status = statuses(found[-1])
    for name, _ in COEFFICIENTS:
        # The number of received messages is random: twice the interval.
        low, high = (float(status[name][f'interval_{end}']) for end in ('low', 'high'))
        assert abs(truth[name] - (low + high) / 2.0) < high - low
    assert int(status['coulomb_friction']['samples']) > 100
    node.publish_diagnostics()
    ros_graph.spin_until(
        lambda: any('mu_s = 0.' in s.message for r in reports for s in r.status), 'diagnostics'
    )


def test_running_topics_have_the_units_of_the_axes(ros_graph: RosGraph) -> None:
    """As recordings: mm against the axis, and mN."""
    axes = {'motion_axis': '-slide[mm]', 'force_axis': 'z[mN]'}
    node = ros_graph.add(IdentificationNode, parameters={'live': True, **axes})
    probe = ros_graph.node('probe')
    joints = probe.create_publisher(JointState, 'joint_states', SENSOR)
    wrenches = probe.create_publisher(WrenchStamped, 'base_wrench', SENSOR)
    ros_graph.spin_until(
        lambda: joints.get_subscription_count() and wrenches.get_subscription_count(), 'discovery'
    )
    for k in range(3):
        state = JointState(name=['slide'], position=[-50.0 - k], velocity=[-100.0])
        wrench = WrenchStamped()
        wrench.wrench.force.z = 700.0
        for message in (state, wrench):
            message.header.stamp.sec, message.header.stamp.nanosec = 5, 10_000_000 * k
        joints.publish(state)
        wrenches.publish(wrench)
    ros_graph.spin_until(lambda: node.diagnose().status.samples == 3, 'the samples')
    recording = node._live.recording()
    assert_allclose(recording.depth, [0.050, 0.051, 0.052], rtol=1e-12)
    assert_allclose(recording.velocity, 0.1, rtol=1e-12)
    assert_allclose(recording.force, 0.7, rtol=1e-12)


@pytest.mark.parametrize('stamps', ['header', 'receive'])
def test_receive_times_are_those_of_the_middleware(ros_graph: RosGraph, stamps: str) -> None:
    """However late the node takes the messages; also for messages without a stamp."""
    node = ros_graph.add(IdentificationNode, parameters={'live': True, 'time': stamps})
    probe = ros_graph.node('probe')
    joints = probe.create_publisher(JointState, 'joint_states', SENSOR)
    wrenches = probe.create_publisher(WrenchStamped, 'base_wrench', SENSOR)
    ros_graph.spin_until(
        lambda: joints.get_subscription_count() and wrenches.get_subscription_count(), 'discovery'
    )
    sent = []
    for k in range(4):
        state, wrench = JointState(name=['insertion'], position=[0.01 * k]), WrenchStamped()
        if stamps == 'receive':
            # Stamps that are to be ignored.
            state.header.stamp.sec, wrench.header.stamp.sec = 5 * k + 5, 7
        sent.append(probe.get_clock().now().nanoseconds)
        joints.publish(state)
        wrenches.publish(wrench)
        # Nothing spins meanwhile.
        time.sleep(0.05)
    ros_graph.spin_until(lambda: node.diagnose().status.samples == 4, 'the samples')
    recording = node._live.recording()
    # All are taken at once, within a millisecond.
    assert recording.time[-1] > 0.5e-9 * (sent[-1] - sent[0])
    stated = 'without a stamp, the receive time is used' in '; '.join(recording.losses)
    assert stated == (stamps == 'header')


def test_invalid_messages_are_counted_and_the_node_stays_active(ros_graph: RosGraph) -> None:
    """NaN, a clock set back, and joint states without the joint or without its position."""
    node = ros_graph.add(IdentificationNode, parameters={'live': True})
    probe = ros_graph.node('probe')
    joints = probe.create_publisher(JointState, 'joint_states', SENSOR)
    wrenches = probe.create_publisher(WrenchStamped, 'base_wrench', SENSOR)
    ros_graph.spin_until(
        lambda: joints.get_subscription_count() and wrenches.get_subscription_count(), 'discovery'
    )
    diagnosis = node.diagnose()
    assert diagnosis.severity == Severity.WARNING
    assert 'insertion' in diagnosis.message
    for names, position in ((['other'], [0.1]), (['insertion'], []), ([], [])):
        joints.publish(JointState(name=names, position=position))
    for seconds, force in ((5, 1.0), (4, 1.0), (6, math.nan), (1, 1.0)):
        wrench = WrenchStamped()
        wrench.header.stamp.sec, wrench.wrench.force.y = seconds, force
        wrenches.publish(wrench)
    ros_graph.spin_until(lambda: sum(node.diagnose().status.discarded.values()) >= 3, 'the counts')
    # The missing position counts as not finite.
    assert node.diagnose().status == IdentificationStatus(
        discarded={'not finite': 2, 'clock set back': 1}
    )
    assert node.is_active


#: Prints what the first live identification imports, in a new process.
_FIRST = """
import sys
import numpy as np
import rclpy
from needle_identification.identification_node import IdentificationNode
from rclpy.parameter import Parameter
rclpy.init()
node = IdentificationNode(parameter_overrides=[Parameter('live', value=True)])
assert node.start(), node.failure
for k in range(500):
    velocity = 8e-3 * np.sin(8e-3 * k)
    node._live.take_motion(4_000_000 * k, 0.1 - 4e-3 * np.cos(8e-3 * k), velocity)
    node._live.take_force(4_000_000 * k, 0.5 * np.sign(velocity) + 300.0 * velocity)
before = set(sys.modules)
node._identify_live()
assert node._found, node._doubts
print(sorted(set(sys.modules) - before))
"""


def test_first_live_identification_imports_nothing() -> None:
    """Libraries are imported before samples arrive."""
    run = subprocess.run(
        [sys.executable, '-c', _FIRST], capture_output=True, text=True, timeout=60.0, check=False
    )
    assert (run.stdout.splitlines()[-1:], run.returncode) == (['[]'], 0), run.stderr


# Parameters of running nodes.


def test_result_is_applied_to_a_running_plant(ros_graph: RosGraph, bags: list[str]) -> None:
    """The plant continues with the identified friction; the answer contains it."""
    plant = ros_graph.add(
        PlantNode, parameters={'rate': 200.0, 'model.coulomb_friction': 2.0, 'mode': 'robot'}
    )
    ros_graph.add(IdentificationNode, parameters={'bags': bags})
    success, message = apply(ros_graph, 'plant')
    assert success, message
    assert 'plant: model.coulomb_friction = 0.5' in message
    assert 'controller: no such node' in message
    for name, _ in COEFFICIENTS:
        value = plant.get_parameter(f'model.{name}').value
        assert value == pytest.approx(getattr(TRUTH, name), rel=0.01)


def test_result_is_applied_to_another_process(ros_graph: RosGraph, bags: list[str]) -> None:
    """A failed call and a later success, with the executor of the nodes."""
    ros_graph.start('identification', {'bags': bags, 'apply_to': ['plant']})
    assert call(ros_graph, 'apply') == (False, 'plant: no such node')
    ros_graph.start('plant', {'model.coulomb_friction': 2.0})
    asker = ros_graph.node('asker')
    parameters = asker.create_client(GetParameters, 'plant/get_parameters')
    ros_graph.wait_for(asker, 'plant')
    # The nodes may not be discovered yet.
    ros_graph.spin_until(lambda: call(ros_graph, 'apply')[0], 'the accepted parameter')
    answer = parameters.call_async(GetParameters.Request(names=['model.coulomb_friction']))
    ros_graph.spin_until(answer.done, 'the parameter')
    value = answer.result().values[0].double_value
    assert value == pytest.approx(TRUTH.coulomb_friction, rel=0.01)


def test_rejected_parameters_are_reported(ros_graph: RosGraph, place: str) -> None:
    """A running plant cannot change its tissue: the answer contains the reason."""
    ros_graph.add(PlantNode, parameters={'rate': 200.0})
    ros_graph.add(IdentificationNode, parameters={'bags': [place], 'what': 'stiffness'})
    success, message = apply(ros_graph, 'plant')
    assert not success
    assert 'not model.tissue_stiffness' in message
    assert 'cannot change while configured' in message


def test_apply_before_the_first_result_is_rejected(ros_graph: RosGraph) -> None:
    ros_graph.add(IdentificationNode)
    success, message = call(ros_graph, 'apply')
    assert not success
    assert message.startswith('nothing identified yet')


def test_apply_has_a_timeout(
    ros_graph: RosGraph, bags: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The call ends with the reason, without blocking the node."""
    monkeypatch.setattr('needle_ros.requests.CALL_TIMEOUT', 0.3)
    ros_graph.add(IdentificationNode, parameters={'bags': bags, 'apply_to': ['deaf']})
    # A node without a spinning executor offers the service, but does not respond.
    deaf = Node('deaf', context=ros_graph.context)
    try:
        assert apply(ros_graph, 'deaf') == (False, 'deaf/set_parameters: no answer within 0.3 s')
    finally:
        deaf.destroy_node()
