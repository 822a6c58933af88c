# SPDX-License-Identifier: Apache-2.0
"""Simulation features of the plant: pause, step, reset, lockstep, command stamps, faults."""

from time import sleep

from builtin_interfaces.msg import Duration
from builtin_interfaces.msg._time import Time
from geometry_msgs.msg import PointStamped, PoseArray, WrenchStamped
from needle_controller.controller_node import ControllerNode
from needle_dynamics import NeedleModel, NeedleParameters
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.event_log import Severity
from needle_ros.status import PlantPhase, PlantStatus
import numpy as np
import pytest
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import GraphBench, RosGraph, stamp_ns
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker

RATE = {'rate': 200.0}
PERIOD = 5_000_000


class Bench(GraphBench):
    """A plant in this process, with a probe that subscribes, commands and calls services."""

    def __init__(self, ros_graph: RosGraph, **parameters: bool | float | str) -> None:
        self.graph = ros_graph
        self.probe = ros_graph.node('probe')
        #: Force that answers each sample; None: no command.
        self.force: float | None = None
        self.states: list[JointState] = []
        self.probe.create_subscription(JointState, 'joint_states', self.on_state, SENSOR)
        self.wrenches = ros_graph.listen(self.probe, WrenchStamped, 'base_wrench', SENSOR)
        self.tips = ros_graph.listen(self.probe, PointStamped, 'tip_deflection', SENSOR)
        self.commands = self.probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
        self.services = {
            name: self.probe.create_client(kind, f'plant/{name}')
            for name, kind in (('pause_time', SetBool), ('step', Trigger), ('reset', Trigger))
        }
        self.plant = ros_graph.add(PlantNode, parameters={**RATE, **parameters})
        self.until(
            lambda: (
                self.commands.get_subscription_count()
                and all(client.service_is_ready() for client in self.services.values())
            ),
            'discovery',
        )

    def on_state(self, message: JointState) -> None:
        """Keep a sample, and answer it."""
        self.states.append(message)
        if self.force is not None:
            self.command(self.force, stamp=message.header.stamp)

    def command(self, force: float, stamp: Time | None = None, frame: str = '') -> None:
        message = WrenchStamped()
        message.header.frame_id = frame
        if stamp is not None:
            message.header.stamp = stamp
        message.wrench.force.y = force
        self.commands.publish(message)

    def further(self, count: int) -> list[JointState]:
        """Spin until a number of additional samples; return them."""
        seen = len(self.states)
        self.until(lambda: len(self.states) >= seen + count, 'samples')
        return self.states[seen:]

    def call(self, name: str, data: bool | None = None) -> tuple[bool, str]:
        """Call a service; return success and message."""
        request = Trigger.Request() if data is None else SetBool.Request(data=data)
        answer = self.services[name].call_async(request)
        self.until(answer.done, 'the answer')
        return answer.result().success, answer.result().message

    def set(self, **values: float | str) -> None:
        parameters = [
            Parameter(name.replace('__', '.'), value=value) for name, value in values.items()
        ]
        changed = self.plant.set_parameters_atomically(parameters)
        assert changed.successful, changed.reason

    @property
    def status(self) -> PlantStatus:
        """Latest status of the plant."""
        return self.plant.diagnose().status

    def quiet(self) -> None:
        """Spin until no message has arrived for ten periods."""
        for _ in range(100):
            seen = len(self.states)
            for _ in range(10):
                self.graph.executor.spin_once(timeout_sec=PERIOD * 1e-9)
            if len(self.states) == seen:
                return
        pytest.fail('samples do not stop')


def test_command_has_one_period_of_delay(ros_graph: RosGraph) -> None:
    """The answer to sample k moves the needle from k + 1 to k + 2."""
    bench = Bench(ros_graph, lockstep=True, needle='paper_mm')
    forces = {}

    def answer(message: JointState) -> None:
        # Friction settles within microseconds: the velocity indicates the force.
        k = round(stamp_ns(message) / PERIOD)
        forces[k] = 0.56 + 2.5 * (1 + k % 5)
        bench.command(forces[k], stamp=message.header.stamp)

    setattr(bench, 'on_state', answer)  # noqa: B010
    bench.probe.create_subscription(JointState, 'joint_states', answer, SENSOR)
    bench.until(lambda: len(bench.states) >= 50, 'samples')
    for message in bench.states[5:]:
        k = round(stamp_ns(message) / PERIOD)
        assert message.velocity[0] == pytest.approx((forces[k - 2] - 0.56) / 300.0, rel=1e-9)


def test_pause_stops_time_and_steps_take_single_samples(ros_graph: RosGraph) -> None:
    """No other sample is published in a pause; time then resumes at its value."""
    bench = Bench(ros_graph, publish_clock=True)
    clocks = ros_graph.listen(bench.probe, Clock, '/clock', SENSOR)
    bench.further(20)
    assert bench.call('step') == (False, 'step refused: time is not paused; pause first')
    granted, said = bench.call('pause_time', data=True)
    assert granted
    assert said.startswith('paused at ')
    bench.quiet()
    assert bench.status.phase is PlantPhase.PAUSED
    before = stamp_ns(bench.states[-1])
    for k in (1, 2, 3):
        seen = len(bench.states)
        assert bench.call('step')[0]
        bench.until(lambda seen=seen: len(bench.states) > seen, 'the sample')
        assert stamp_ns(bench.states[-1]) == before + k * PERIOD
        assert len(bench.states) == seen + 1
    assert bench.call('pause_time', data=False) == (True, 'time resumed')
    first = bench.further(20)[0]
    assert stamp_ns(first) == before + 4 * PERIOD
    last = bench.states[-1].header.stamp
    bench.until(lambda: any(message.clock == last for message in clocks), 'simulated time')


def test_start_in_pause(ros_graph: RosGraph) -> None:
    """With `paused` no sample is published before time is resumed."""
    bench = Bench(ros_graph, paused=True)
    bench.quiet()
    assert not bench.states
    bench.call('pause_time', data=False)
    bench.further(10)


def test_reset_restores_the_needle_and_keeps_time(ros_graph: RosGraph) -> None:
    """Initial depth, velocity and noise; stamps never go back, and the needle is not held."""
    bench = Bench(ros_graph, lockstep=True, paused=True, tip_deflection=5e-4)
    bench.force = 3.56
    bench.call('pause_time', data=False)
    bench.until(lambda: bench.states and bench.states[-1].position[0] > 0.0225, 'motion')
    bench.call('pause_time', data=True)
    bench.quiet()
    assert bench.call('reset')[0]
    moved, before = len(bench.states), bench.states[-1]
    begun = len(bench.wrenches)
    bench.call('pause_time', data=False)
    bench.until(lambda: len(bench.wrenches) >= begun + 40, 'samples')
    assert stamp_ns(bench.states[moved]) == stamp_ns(before) + PERIOD
    assert bench.states[moved].position[0] == bench.states[0].position[0]
    again = [(m.wrench.force.y, m.wrench.force.z) for m in bench.wrenches[begun : begun + 40]]
    first = [(m.wrench.force.y, m.wrench.force.z) for m in bench.wrenches[:40]]
    assert again == first


def test_reset_after_the_needle_left_the_tissue(ros_graph: RosGraph) -> None:
    bench = Bench(ros_graph, depth=0.002)
    bench.force = -3.0
    bench.until(lambda: 'minimum_depth' in bench.status.halt, 'the end')
    bench.force = 0.0
    bench.quiet()
    assert bench.call('reset')[0]
    # State: 0.2 m minus 0.198 m.
    assert bench.further(5)[-1].position[0] == pytest.approx(0.002, abs=1e-15)


def test_services_of_an_inactive_plant_are_rejected(ros_graph: RosGraph) -> None:
    """Each with a reason."""
    bench = Bench(ros_graph)
    bench.plant.trigger_deactivate()
    for name, data in (('pause_time', True), ('step', None), ('reset', None)):
        assert bench.call(name, data) == (False, f'{name} refused: the plant is not active')


def test_lockstep_plant_waits_and_reports_the_reason(ros_graph: RosGraph) -> None:
    """Without a command time stops, and the sample is repeated."""
    bench = Bench(ros_graph, lockstep=True)
    bench.until(lambda: len(bench.states) >= 2, 'the repeated sample')
    assert {stamp_ns(message) for message in bench.states} == {PERIOD}
    bench.until(lambda: bench.status.awaited == 'no command has answered', 'the warning')
    assert bench.status.time == 0.005
    bench.force = 0.0
    bench.further(20)
    assert stamp_ns(bench.states[-1]) > 15 * PERIOD


@pytest.mark.parametrize('remaps', [[], ['--ros-args', '-r', '/clock:=clock']])
def test_two_plants_with_their_own_time_need_two_clocks(
    ros_graph: RosGraph, remaps: list[str]
) -> None:
    """On one topic each plant reports the other; on two, each controller has its plant's time."""
    times: dict[str, dict[str, object]] = {
        'left': {'lockstep': True},
        'right': {'publish_clock': True, 'real_time_factor': 0.1},
    }
    plants, controllers = {}, {}
    for name, own in times.items():
        options = {'namespace': name, 'cli_args': remaps}
        plants[name] = ros_graph.add(PlantNode, parameters={**RATE, **own}, **options)
        controllers[name] = ros_graph.add(
            ControllerNode, parameters={**RATE, 'use_sim_time': True}, **options
        )
    if not remaps:
        ros_graph.spin_until(
            lambda: all(one.diagnose().status.other_clock for one in plants.values()), 'the others'
        )
        for name, other in zip(plants, ('/right/plant', '/left/plant'), strict=True):
            report = plants[name].diagnose()
            line = f'{other} publishes /clock, too: remap it in each namespace, -r /clock:=clock'
            assert (report.severity, report.message) == (Severity.ERROR, line)
        return

    def behind(name: str) -> float:
        """Return the periods from the time of a controller to the time of its plant."""
        time = 1e-9 * controllers[name].get_clock().now().nanoseconds
        return float(plants[name].diagnose().status.time - time) * RATE['rate']

    ros_graph.spin_until(lambda: plants['left'].diagnose().status.time > 1.0, 'a second')
    reports = {name: plant.diagnose() for name, plant in plants.items()}
    assert {one.status.other_clock for one in reports.values()} == {''}
    assert Severity.ERROR not in {one.severity for one in reports.values()}
    assert all(one.diagnose().severity is Severity.INFO for one in controllers.values())
    # The other time is 90 % of a second away, 180 periods.
    assert all(abs(behind(name)) < 20.0 for name in times)


def test_maximum_speed_exceeds_real_time(ros_graph: RosGraph) -> None:
    """With a factor of 0, 30 s of simulated time take less, by the report of the plant."""
    probe = ros_graph.node('probe')
    clock = ros_graph.latest(probe, Clock, '/clock', SENSOR)
    ros_graph.start('plant', {'rate': 100.0, 'real_time_factor': 0.0, 'publish_clock': True})
    ros_graph.spin_until(lambda: clock.message, '/clock', timeout=60.0)
    begin, first = probe.get_clock().now(), clock.message.clock.sec
    ros_graph.spin_until(lambda: clock.message.clock.sec > first + 30, '30 s')
    assert (probe.get_clock().now() - begin).nanoseconds < 15e9


def test_out_of_order_command_is_discarded(ros_graph: RosGraph) -> None:
    bench = Bench(ros_graph, command_timeout=60.0)
    *_, earlier, newest = bench.further(10)
    bench.command(0.0, stamp=newest.header.stamp)
    # Only the newest message is queued for the plant.
    bench.further(20)
    bench.command(3.56, stamp=earlier.header.stamp)
    bench.until(lambda: bench.status.superseded == 1, 'the refusal')
    assert not any(message.velocity[0] for message in bench.further(20))


def test_stale_and_wrong_frame_commands_are_discarded(ros_graph: RosGraph) -> None:
    """Commands older than the timeout, or in another frame."""
    bench = Bench(ros_graph)
    bench.further(5)
    old = bench.states[-1].header.stamp
    bench.further(40)
    # 40 samples are 0.2 s; command_timeout is 0.1 s.
    bench.command(3.56, stamp=old)
    bench.until(lambda: bench.status.stale == 1, 'the refusal')
    bench.command(3.56, frame='needle_tip')
    bench.until(lambda: bench.status.rejected == 1, 'the refusal')
    assert not any(message.velocity[0] for message in [*bench.states, *bench.further(20)])
    bench.force = 3.56
    bench.until(lambda: bench.states[-1].position[0] > 0.0201, 'motion')


def test_overloaded_plant_accepts_commands(ros_graph: RosGraph) -> None:
    """It drops samples instead of publishing stale samples, which have a command timeout."""
    # 10^7 steps per second exceed any machine. On a busy machine, an answer may take longer than
    # 0.1 s.
    bench = Bench(ros_graph, rate=1000.0, step=1e-7, command_timeout=2.0)
    bench.until(lambda: bench.status.skipped > 300, 'the overload')
    bench.force = 8.0
    bench.until(lambda: bench.states[-1].position[0] > 0.03, 'motion')
    given_up = bench.status.skipped
    bench.until(lambda: bench.status.skipped > given_up, 'more samples')


def test_backlog_is_limited_by_the_command_timeout(ros_graph: RosGraph) -> None:
    """Where samples have the time of the clock; independent time waits."""
    reason = 'backlog must be at most half of command_timeout, 0.1 s, got 0.5 s'
    plant = ros_graph.add(PlantNode, parameters={'backlog': 0.5}, start=False)
    assert not plant.start()
    assert plant.failure.startswith(reason)
    for valid in ({'real_time_factor': 2.0}, {'publish_clock': True}, {'mode': 'robot'}):
        assert ros_graph.add(PlantNode, parameters={'backlog': 0.5, **valid}).is_active


def test_duplicate_commanders_apply_no_force(ros_graph: RosGraph) -> None:
    """The diagnostics report it."""
    bench = Bench(ros_graph)
    bench.force = 3.56
    bench.until(lambda: bench.states and bench.states[-1].velocity[0] > 0.0, 'motion')
    other = bench.probe.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    bench.until(lambda: bench.status.commanders == 2, 'the error')
    bench.until(lambda: bench.states[-1].velocity[0] == 0.0, 'rest')
    assert not any(message.velocity[0] for message in bench.further(20))
    bench.probe.destroy_publisher(other)
    bench.until(lambda: bench.states[-1].velocity[0] > 0.0, 'motion')


def test_needle_shape_equals_the_model_shape(ros_graph: RosGraph) -> None:
    """The line from the base through the entry point to the tip; the poses are on it."""
    bench = Bench(ros_graph, depth=0.1, tip_deflection=0.005, **{'model.tissue_damping': 0.0})
    shapes = ros_graph.listen(bench.probe, Marker, 'needle_shape', SENSOR)
    poses = ros_graph.listen(bench.probe, PoseArray, 'needle_poses', SENSOR)
    truth = ros_graph.listen(bench.probe, JointState, 'ground_truth', SENSOR)
    bench.until(lambda: len(shapes) >= 3 and len(poses) >= 3, 'shapes')
    states = {stamp_ns(m): [*m.position, *m.velocity] for m in truth}
    shape, line = next(
        (m, p) for m in shapes for p in poses if stamp_ns(m) == stamp_ns(p) in states
    )
    model = NeedleModel(NeedleParameters.preset('phantom'))
    state = states[stamp_ns(shape)]
    points = np.array([[p.y, p.z] for p in shape.points])
    assert points[0] == pytest.approx([-0.1, 0.0])
    assert points[1:] == pytest.approx(model.shape(state, len(points) - 1), abs=1e-15)
    assert points[-1] == pytest.approx([0.1, model.tip_deflection(state)])
    assert [(p.position.y, p.position.z) for p in line.poses] == [tuple(p) for p in points[1:]]
    # y of the pose is along the needle, to second order of the distance of 5 mm.
    tip, before = line.poses[-1], line.poses[-2]
    turn = 2.0 * np.arctan2(tip.orientation.x, tip.orientation.w)
    rise = (tip.position.z - before.position.z) / (tip.position.y - before.position.y)
    assert np.tan(turn) == pytest.approx(rise, rel=1e-6)
    assert (shape.header.frame_id, line.header.frame_id) == ('needle_entry', 'needle_entry')


def test_steered_needle_publishes_shape_and_path(ros_graph: RosGraph) -> None:
    """Poses are tangential in both planes, and invalid trajectories are reported."""
    values: dict[str, bool | float | str] = {
        'mode': 'robot',
        'steered': True,
        'needle': 'bending_35mm',
        'guide.position_limit': 0.01,
        'tip.noise': 0.0,
    }
    bench = Bench(ros_graph, **values)
    lines = ros_graph.listen(bench.probe, Marker, 'needle_shape', SENSOR)
    poses = ros_graph.listen(bench.probe, PoseArray, 'needle_poses', SENSOR)
    course = bench.probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
    bench.until(course.get_subscription_count, 'the plant')
    message = JointTrajectory(joint_names=['insertion', 'guide_x', 'guide_z'])
    soon = Duration(nanosec=500_000_000)
    message.points = [JointTrajectoryPoint(positions=[0.03, 9e-3, -11e-3], time_from_start=soon)]
    course.publish(message)
    bench.until(lambda: bench.plant.diagnose().status.rejected == 1, 'the refusal')
    bench.until(lambda: bench.states, 'a sample')
    assert bench.states[-1].name == [
        'insertion', 'guide_x', 'guide_z', 'guide_tilt_x', 'guide_tilt_z', 'roll',
    ]  # fmt: skip
    message.points[0].positions = [0.03, 9e-3, -5e-3]
    course.publish(message)
    # The robot rests within 10 nm of the end, with a factor of ten.
    there = pytest.approx([0.03, 9e-3, -5e-3], abs=1e-7)
    bench.until(lambda: bench.states[-1].position.tolist()[:3] == there, 'the end of the course')
    seen = len(poses), len(lines)
    bench.until(lambda: len(poses) > seen[0] and len(lines) > seen[1] + 2, 'pictures')
    newest = {line.ns: [(p.x, p.y, p.z) for p in line.points] for line in lines[-2:]}
    assert newest.keys() == {'needle', 'path'}
    assert newest['needle'][1] == pytest.approx((9e-3, -0.04, -5e-3), abs=1e-7)
    tip = bench.tips[-1].point
    assert newest['needle'][-1] == pytest.approx((tip.x, tip.y, tip.z), abs=1e-6)
    assert newest['path'][0][1] == 0.0
    # Between two points the needle follows the poses, to second order of the distance.
    along = [np.array([p.position.x, p.position.y, p.position.z]) for p in poses[-1].poses]
    for k in (5, 15, 25):
        turn = poses[-1].poses[k].orientation
        # y axis rotated by the quaternion.
        x, z, w = turn.x, turn.z, turn.w
        ahead = np.array([-2.0 * w * z, 1.0 - 2.0 * (x * x + z * z), 2.0 * w * x])
        step = along[k + 1] - along[k - 1]
        np.testing.assert_allclose(ahead, step / np.linalg.norm(step), atol=1e-4)
        assert turn.y == 0.0


def test_faults_may_be_set_and_cleared_while_active(ros_graph: RosGraph) -> None:
    """A fault affects its stream only, and is reported."""
    bench = Bench(ros_graph)
    bench.further(5)
    bench.set(fault__kind='bias', fault__topic='base_wrench', fault__size=20.0)
    bench.until(lambda: bench.wrenches[-1].wrench.force.x > 15.0, 'the bias')
    assert (bench.status.faulty_topic, bench.status.sensor_fault) == ('base_wrench', 'bias')
    bench.set(fault__kind='nan', fault__topic='joint_states')
    bench.until(lambda: np.isnan(bench.states[-1].position[0]), 'the fault')
    bench.until(lambda: abs(bench.wrenches[-1].wrench.force.x) < 1.0, 'the end of the bias')
    bench.set(fault__kind='drop', fault__topic='tip_deflection')
    # Messages in transit.
    bench.further(20)
    dropped = len(bench.tips)
    bench.further(20)
    assert len(bench.tips) == dropped
    bench.set(fault__kind='none')
    bench.until(lambda: len(bench.tips) > dropped + 10, 'the tip')
    assert bench.status.sensor_fault == ''


def test_delayed_reading_keeps_its_stamp_after_a_stall(ros_graph: RosGraph) -> None:
    """A stall drops samples, and time jumps: stamps follow."""
    bench = Bench(ros_graph, **{'tip.delay': 0.1})
    bench.further(40)
    sleep(0.5)
    bench.further(40)
    assert bench.status.skipped > 0
    samples = {stamp_ns(message) for message in bench.states}
    first = min(samples)
    late = [stamp_ns(message) for message in bench.tips if stamp_ns(message) >= first]
    assert len(late) > 40
    assert set(late) <= samples
