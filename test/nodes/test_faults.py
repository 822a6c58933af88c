# SPDX-License-Identifier: Apache-2.0
"""Fault injection in a graph: each fault is reported and leads to zero force."""

from pathlib import Path
import re
import resource
from typing import Any

from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_controller.controller_node import ControllerNode
from needle_dynamics.plant_node import PlantNode
from needle_identification import Bag
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.event_log import Severity
from needle_ros.status import ControllerPhase, ControllerStatus, PlantStatus, RecorderStatus
from needle_ros.timing import seconds
import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from std_srvs.srv._trigger import Trigger_Response
from support.ros_graph import ControllerBench, RosGraph

RATE, START, TARGET = 200.0, 0.02, 0.025

#: Position error by dry friction after the end of the force of inverse dynamics [m].
NEAR = 2e-4

#: Velocity at rest [m/s]: a law with exact friction compensation leaves 1e-13.
REST = 1e-9


class Loop(ControllerBench):
    """
    Plant and controller in this process, and a probe.

    Time is simulated: it waits for a stalled machine, which is therefore not a fault.
    """

    def __init__(
        self,
        graph: RosGraph,
        plant: dict[str, float] | None = None,
        controller: dict[str, float] | None = None,
    ) -> None:
        self.graph = graph
        self.probe = graph.node('probe')
        self.truth = graph.latest(self.probe, JointState, 'ground_truth', SENSOR)
        self.command = graph.latest(self.probe, WrenchStamped, 'wrench_command', COMMAND)
        self.targets = self.probe.create_publisher(PointStamped, 'target', COMMAND)
        self.plant = graph.add(
            PlantNode, parameters={'rate': RATE, 'publish_clock': True, **(plant or {})}
        )
        self.controller = graph.add(
            ControllerNode, parameters={'rate': RATE, 'use_sim_time': True, **(controller or {})}
        )
        self.until(lambda: self.status.latency.answered > 5 and self.truth.message, 'discovery')

    @property
    def depth(self) -> Any:
        """True insertion depth [m]."""
        return 0.2 - self.truth.message.position[0]

    @property
    def speed(self) -> float:
        """True insertion velocity [m/s]."""
        return -self.truth.message.velocity[0]

    @property
    def time(self) -> Any:
        """Time of the newest sample [s]."""
        return seconds(self.truth.message.header.stamp)

    def aim(self, depth: float = TARGET) -> None:
        """Send a target until it is accepted."""
        message = PointStamped()
        message.point.y = depth

        def taken() -> bool:
            self.targets.publish(message)
            return self.status.target == depth

        self.until(taken, 'the target')

    def break_down(self, kind: str, topic: str, **values: float) -> None:
        """Inject a fault into a stream of the plant."""
        parameters: dict[str, Any] = {'fault.kind': kind, 'fault.topic': topic}
        parameters |= {f'fault.{name}': value for name, value in values.items()}
        changed = self.plant.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in parameters.items()]
        )
        assert changed.successful, changed.reason

    def mend(self) -> None:
        """End the fault."""
        self.plant.set_parameters([Parameter('fault.kind', value='none')])

    def passes(self, seconds: float) -> None:
        """Spin for a simulated duration [s]."""
        end = self.time + seconds
        self.until(lambda: self.time >= end, f'{seconds} s')

    def moves(self) -> None:
        """Spin until the needle moves."""
        self.until(lambda: self.speed > 0.005, 'motion')

    def arrives(self, depth: float = TARGET) -> None:
        """Spin until the needle rests at its target."""
        self.until(
            lambda: abs(self.depth - depth) < NEAR and abs(self.speed) < REST, 'the arrival'
        )

    def rests_without_force(self, phase: ControllerPhase) -> None:
        """Spin until the controller is in a phase without force, and the needle rests."""
        self.until(lambda: self.status.phase is phase, phase.value)
        self.until(lambda: self.speed == 0.0, 'rest')
        depth = self.depth
        self.passes(0.3)
        assert self.depth == depth
        assert self.controller.diagnose().severity != Severity.INFO
        force = self.command.message.wrench.force.y
        # Without measurements the command timeout of the plant applies.
        assert force == 0.0 or self.plant.diagnose().status.command_rate == 0.0

    def clears(self) -> Trigger_Response:
        """Clear the latched stop."""
        client = self.probe.create_client(Trigger, 'controller/clear_stop')
        self.until(client.service_is_ready, 'the service')
        answer = client.call_async(Trigger.Request())
        self.until(answer.done, 'the answer')
        return answer.result()


@pytest.mark.requirement('S-064', 'S-067')
@pytest.mark.parametrize(
    ('kind', 'values'),
    [
        ('drop', {'probability': 0.3}),
        ('delay', {'probability': 0.3, 'delay': 0.01}),
        ('duplicate', {}),
        ('reorder', {'probability': 0.3}),
    ],
)
@pytest.mark.parametrize('topic', ['joint_states', 'base_wrench', 'tip_deflection'])
def test_lost_and_reordered_measurements_are_tolerated(
    ros_graph: RosGraph, kind: str, values: dict[str, float], topic: str
) -> None:
    """The needle reaches its target without a latched stop."""
    loop = Loop(ros_graph)
    loop.break_down(kind, topic, **values)
    loop.aim()
    loop.arrives()
    assert loop.status.stops == 0


@pytest.mark.requirement('S-073')
@pytest.mark.parametrize('topic', ['base_wrench', 'tip_deflection'])
@pytest.mark.parametrize(
    ('kind', 'values'), [('drop', {}), ('freeze', {}), ('nan', {}), ('delay', {'delay': 5.0})]
)
def test_motion_continues_without_bending_sensors(
    ros_graph: RosGraph, kind: str, values: dict[str, float], topic: str
) -> None:
    """The observer ignores missing or invalid inputs; diagnostics report them."""
    loop = Loop(ros_graph, plant={'tip.noise': 1e-4})
    loop.aim()
    loop.moves()
    loop.break_down(kind, topic, **values)
    loop.until(lambda: topic in loop.status.warning, 'the warning')
    assert loop.controller.diagnose().severity == Severity.WARNING
    loop.arrives()


@pytest.mark.requirement('S-003')
@pytest.mark.parametrize(
    ('kind', 'values'), [('drop', {}), ('nan', {}), ('delay', {'delay': 0.5})]
)
def test_encoder_loss_gives_zero_force_until_recovery(
    ros_graph: RosGraph, kind: str, values: dict[str, float]
) -> None:
    """The needle then continues to its target, unless it has moved too much."""
    loop = Loop(ros_graph, controller={'jump': 0.01})
    loop.aim(0.04)
    loop.moves()
    loop.break_down(kind, 'joint_states', **values)
    loop.rests_without_force(ControllerPhase.FAULT)
    loop.until(lambda: 'joint_states' in loop.status.fault, 'the reason')
    loop.mend()
    loop.arrives(0.04)


@pytest.mark.requirement('S-069')
@pytest.mark.parametrize(
    ('kind', 'values', 'why'),
    [
        # Which monitor is first depends on the velocity at which the encoders freeze.
        ('freeze', {}, 'contradict each other|encoders do not move'),
        ('saturate', {'size': 0.021}, 'contradict each other|encoders do not move'),
        ('bias', {'size': 0.01}, 'insertion moved by'),
    ],
)
def test_inconsistent_encoders_end_the_motion(
    ros_graph: RosGraph, kind: str, values: dict[str, float], why: str
) -> None:
    """Zero force and the reason."""
    loop = Loop(ros_graph)
    loop.aim(0.1)
    loop.moves()
    loop.break_down(kind, 'joint_states', **values)
    loop.until(lambda: re.search(why, f'{loop.status.fault} {loop.status.stop}'), why)
    loop.until(lambda: loop.speed == 0.0, 'rest')


@pytest.mark.requirement('S-021', 'S-043', 'S-074')
@pytest.mark.parametrize(
    ('topic', 'size', 'why'),
    [('base_wrench', 50.0, 'load'), ('tip_deflection', 0.06, 'tip_deflection')],
)
def test_overload_latches_a_stop(ros_graph: RosGraph, topic: str, size: float, why: str) -> None:
    """Until the reading is within the limits and the stop is cleared."""
    loop = Loop(ros_graph)
    loop.aim(0.04)
    loop.moves()
    loop.break_down('bias', topic, size=size)
    loop.rests_without_force(ControllerPhase.STOPPED)
    assert why in loop.status.stop
    refused = loop.clears()
    assert not refused.success
    loop.mend()
    loop.passes(0.1)
    loop.rests_without_force(ControllerPhase.STOPPED)
    assert loop.clears().success
    # Nothing moves without a new target.
    loop.passes(0.1)
    assert loop.status.target is None
    loop.aim(0.04)
    loop.arrives(0.04)


@pytest.mark.requirement('S-077', 'S-098')
def test_killed_controller_leaves_the_needle_at_rest(ros_graph: RosGraph) -> None:
    """The plant applies command_timeout; a new controller takes over within seconds."""
    probe = ros_graph.node('probe')
    truth = ros_graph.latest(probe, JointState, 'ground_truth', SENSOR)
    targets = probe.create_publisher(PointStamped, 'target', COMMAND)
    plant = ros_graph.add(PlantNode, parameters={'rate': RATE, 'command_timeout': 1.0})
    parameters = {'rate': RATE, 'measurement_timeout': 1.0}
    message = PointStamped()
    message.point.y = 0.1

    def moves() -> bool:
        targets.publish(message)
        return truth.message is not None and truth.message.velocity[0] < 0.0

    first = ros_graph.start('controller', parameters)
    ros_graph.spin_until(moves, 'motion', timeout=60.0)
    first.kill()
    ros_graph.spin_until(lambda: truth.message.velocity[0] == 0.0, 'rest')
    assert plant.diagnose().status.rejected == 0
    reports = ros_graph.statuses(probe, ControllerStatus, COMMAND)
    ros_graph.start('controller', parameters)
    ros_graph.spin_until(moves, 'motion', timeout=60.0)
    # The graph may list the dead controller until its lease of 20 s is over.
    assert probe.count_publishers('wrench_command') in {1, 2}
    assert plant.diagnose().status.commanders == 0

    def is_well() -> bool:
        return bool(reports) and reports[-1].stops == 0

    ros_graph.spin_until(is_well, 'no stop')


@pytest.mark.requirement('S-098')
def test_controller_resumes_after_a_plant_restart(ros_graph: RosGraph) -> None:
    """It commands zero, reports the reason, and continues with the new plant."""
    probe = ros_graph.node('probe')
    states = ros_graph.latest(probe, JointState, 'joint_states', SENSOR)
    forces = ros_graph.latest(probe, WrenchStamped, 'wrench_command', COMMAND)
    targets = probe.create_publisher(PointStamped, 'target', COMMAND)
    controller = ros_graph.add(ControllerNode, parameters={'measurement_timeout': 1.0})
    message = PointStamped()
    message.point.y = 0.1

    def moves() -> bool:
        targets.publish(message)
        return states.message is not None and states.message.velocity[0] > 0.0

    first = ros_graph.start('plant', {'command_timeout': 1.0})
    ros_graph.spin_until(moves, 'motion', timeout=60.0)
    first.kill()
    # On a busy machine the measurements may be too old before.
    ros_graph.spin_until(lambda: 'stale' in controller.diagnose().status.fault, 'the fault')
    assert controller.diagnose().status.phase is ControllerPhase.FAULT
    ros_graph.spin_until(lambda: forces.message.wrench.force.y == 0.0, 'no force')
    ros_graph.start('plant', {'command_timeout': 1.0})
    ros_graph.spin_until(moves, 'motion', timeout=60.0)


def test_recorder_reports_a_full_disk_and_keeps_its_messages(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """The recording ends, the node continues, and the bag can be read."""
    loop = Loop(ros_graph)
    bag = tmp_path / 'bag'
    reports = ros_graph.statuses(loop.probe, RecorderStatus, 100)
    recorder = ros_graph.start('recorder', {'path': str(bag), 'compression': 'none'})
    loop.until(lambda: list(bag.glob('*.mcap')) and loop.depth, 'the bag')
    # The messages of about 7 s: those of a stall are lost in one piece, and are few in comparison.
    size = 2_000_000
    resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (size, size))
    loop.until(lambda: any('File too large' in one.failure for one in reports), 'the report')
    recorder.check()
    (file,) = bag.glob('*.mcap')
    read = Bag(file)
    count = sum(len(batch.received) for batch in read.batches(lambda _topic: True))
    assert file.stat().st_size <= size
    # Messages, each of less than 200 bytes, fill more than half of the file.
    assert count > size / 2 / 200


@pytest.mark.requirement('S-101')
def test_clock_jumps_do_not_move_the_needle(ros_graph: RosGraph) -> None:
    """The loop continues after jumps of an external clock, with zero force in between."""
    clocks = ros_graph.node('clock')
    ticks = clocks.create_publisher(Clock, '/clock', SENSOR)
    probe = ros_graph.node('probe')
    truth = ros_graph.latest(probe, JointState, 'ground_truth', SENSOR)
    targets = probe.create_publisher(PointStamped, 'target', COMMAND)
    simulated = {'rate': RATE, 'use_sim_time': True}
    ros_graph.add(PlantNode, parameters=simulated)
    controller = ros_graph.add(ControllerNode, parameters=simulated)
    now = [10_000_000_000_000]
    # All nodes must receive a clock jump first, or every message would be late.
    seen, waited = [None], [0]

    def goes_on(step: int = 0) -> None:
        waited[0] += 1
        if step == 0 and truth.message is seen[0] and waited[0] < 20:
            return
        seen[0], waited[0] = truth.message, 0
        now[0] += step or 5_000_000
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now[0], 10**9)
        ticks.publish(message)

    def aimed(depth: float) -> None:
        message = PointStamped()
        message.point.y = depth

        def taken() -> bool:
            goes_on()
            if waited[0] == 0:
                targets.publish(message)
            return controller.diagnose().status.target == depth

        ros_graph.spin_until(taken, 'the target')

    def reached(depth: float) -> bool:
        goes_on()
        return abs(0.2 - truth.message.position[0] - depth) < NEAR

    def sampled() -> bool:
        goes_on()
        return truth.message is not None

    ros_graph.spin_until(sampled, 'the first sample')
    aimed(0.022)
    ros_graph.spin_until(
        lambda: reached(0.022) and abs(truth.message.velocity[0]) < REST, 'the needle at rest'
    )
    for jump in (3600 * 10**9, -7200 * 10**9):
        before = truth.message.position[0]
        goes_on(jump)
        for _ in range(200):
            ros_graph.executor.spin_once(timeout_sec=0.01)
            goes_on()
        assert abs(truth.message.position[0] - before) < NEAR
    aimed(0.024)
    ros_graph.spin_until(lambda: reached(0.024), 'the needle')


def test_command_flood_does_not_stop_sampling(ros_graph: RosGraph) -> None:
    """The plant samples and warns under commands at the maximum rate of a process."""
    probe = ros_graph.node('probe')
    samples = ros_graph.listen(
        probe,
        JointState,
        'joint_states',
        QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT),
    )
    reports = ros_graph.statuses(probe, PlantStatus)
    commands = probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    # At 20 Hz; a process can publish hundreds of times as many.
    plant = ros_graph.start('plant', {'rate': 20.0, 'publish_clock': True})
    ros_graph.spin_until(
        lambda: samples and commands.get_subscription_count(), 'discovery', timeout=60.0
    )
    message = WrenchStamped()
    # Below mu_s.
    message.wrench.force.y = 0.3

    def flood() -> None:
        for _ in range(100):
            commands.publish(message)

    def warned() -> bool:
        flood()
        return any(one.command_rate > 60.0 for one in reports)

    ros_graph.spin_until(warned, 'the warning')
    first = len(samples)

    def further() -> bool:
        flood()
        return len(samples) > first + 60

    ros_graph.spin_until(further, 'three seconds of samples')
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in samples]
    assert set(np.diff(stamps)) <= {49_999_999, 50_000_000, 50_000_001}
    # The process still exits normally.
    plant.interrupt()
