# SPDX-License-Identifier: Apache-2.0
"""The controller node in the graph, alone and with a plant."""

from collections.abc import Callable
from itertools import pairwise
from math import inf, nan
from threading import Event
from time import monotonic
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped, WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from needle_controller.compiled.laws import INTEGRAL
from needle_controller.controller import Controller
from needle_controller.controller_node import ControllerNode
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.event_log import Severity
from needle_ros.status import ControllerPhase, ControllerStatus
from needle_ros.system_state import Mode
import pytest
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.duration import Duration
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from std_srvs.srv._set_bool import SetBool_Request, SetBool_Response
from std_srvs.srv._trigger import Trigger_Request, Trigger_Response
from support.ros_graph import ControllerBench, GraphBench, RosGraph
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Both nodes in the thread of the test.
SLOW = {'rate': 200.0}


class Bench(ControllerBench):
    """A controller, and a probe in place of the plant."""

    def __init__(self, graph: RosGraph, start: Any = True, **parameters: Any) -> None:
        self.graph = graph
        self.node = graph.node('probe')
        self.states = self.node.create_publisher(JointState, 'joint_states', SENSOR)
        self.target = self.node.create_publisher(PointStamped, 'target', COMMAND)
        self.wrenches = self.node.create_publisher(WrenchStamped, 'base_wrench', SENSOR)
        self.tips = self.node.create_publisher(PointStamped, 'tip_deflection', SENSOR)
        self.commands = graph.listen(self.node, WrenchStamped, 'wrench_command', COMMAND)
        self.controller = graph.add(ControllerNode, start=False, parameters={**SLOW, **parameters})
        if start:
            self.start()

    def start(self) -> None:
        """Start the controller, and wait for the discovery."""
        assert self.controller.start(), self.controller.failure
        self.graph.spin_until(
            lambda: (
                self.states.get_subscription_count()
                and self.target.get_subscription_count()
                and self.wrenches.get_subscription_count()
                and self.tips.get_subscription_count()
                and self.node.count_publishers('wrench_command')
            ),
            'discovery',
        )

    def now(self) -> Time:
        """Return the current stamp."""
        return self.node.get_clock().now().to_msg()

    def measure(self, depth: float, speed: float = 0.0) -> float:
        """Publish a measurement and return its force command."""
        message = JointState(name=['insertion'], position=[depth], velocity=[speed])
        return self.ask(message, fresh=True)

    def ask(self, message: JointState, fresh: bool = False) -> float:
        """Publish a joint state and return its force command."""
        count = len(self.commands)
        asked: list[tuple[float, Time]] = []

        def answers() -> list[WrenchStamped]:
            # On a busy machine a measurement may be stale on arrival.
            if not asked or (fresh and monotonic() - asked[-1][0] > 1.0):
                if fresh:
                    message.header.stamp = self.now()
                asked.append((monotonic(), message.header.stamp))
                self.states.publish(message)
            stamps = [stamp for _, stamp in asked]
            return [c for c in self.commands[count:] if c.header.stamp in stamps]

        self.graph.spin_until(answers, 'an answer')
        return answers()[-1].wrench.force.y

    def call(
        self, name: str, kind: type[SetBool] | type[Trigger] = Trigger, **request: bool
    ) -> SetBool_Response | Trigger_Response:
        """Return the response of a service."""
        client = self.node.create_client(kind, f'controller/{name}')
        self.graph.spin_until(client.service_is_ready, name)
        answers: list[tuple[float, Future]] = []

        def answered() -> list[Future]:
            # The response to an undiscovered client is lost; the services are idempotent.
            if not answers or monotonic() - answers[-1][0] > 1.0:
                answers.append((monotonic(), client.call_async(kind.Request(**request))))
            return [answer for _, answer in answers if answer.done()]

        self.graph.spin_until(answered, name)
        return answered()[0].result()

    def said(self) -> str:
        """Return the first diagnostics message."""
        return self.controller.diagnose().message

    def wrench(
        self,
        axial: float = 0.0,
        lateral: float = 0.0,
        moment: float = 0.0,
        frame: str = 'needle_base',
        stamp: bool = True,
    ) -> None:
        """Publish a force sensor reading."""
        message = WrenchStamped()
        message.header.frame_id = frame
        if stamp:
            message.header.stamp = self.now()
        message.wrench.force.y, message.wrench.force.z = axial, lateral
        message.wrench.torque.x = moment
        self.wrenches.publish(message)

    def tip(self, deflection: float, frame: str = 'needle_entry', stamp: bool = True) -> None:
        """Publish a tip measurement."""
        message = PointStamped()
        message.header.frame_id = frame
        if stamp:
            message.header.stamp = self.now()
        message.point.y, message.point.z = 0.02, deflection
        self.tips.publish(message)

    def aim(self, depth: float, deflection: float = 0.0) -> None:
        """Publish a target and wait until the controller has received it."""
        message = PointStamped()
        message.point.y, message.point.z = depth, deflection
        self.target.publish(message)
        self.graph.spin_until(lambda: self.controller.diagnose().status.target, 'the target')

    def push(self) -> float:
        """Publish measurements until the reference moves and a force is commanded."""
        self.graph.spin_until(lambda: self.measure(0.02) > 0.5, 'a force')
        return self.commands[-1].wrench.force.y


@pytest.mark.parametrize('law', ['adaptive', 'inverse_dynamics', 'pid'])
@pytest.mark.parametrize('reference', ['trapezoid', 'minimum_jerk'])
def test_reaches_the_target(ros_graph: RosGraph, law: str, reference: str) -> None:
    """
    With the plant over DDS, for each law and each reference.

    In lockstep, so that the overshoot does not depend on the load of the machine.
    """
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    errors = ros_graph.listen(probe, JointState, 'tracking_error', SENSOR)
    aims = ros_graph.listen(probe, JointState, 'reference', SENSOR)
    targets = probe.create_publisher(PointStamped, 'target', COMMAND)
    ros_graph.add(PlantNode, parameters={**SLOW, 'lockstep': True})
    chosen = {'law': law, 'reference.kind': reference, 'use_sim_time': True}
    ros_graph.add(ControllerNode, parameters={**SLOW, **chosen})
    ros_graph.spin_until(lambda: states and targets.get_subscription_count(), 'discovery')
    message = PointStamped()
    message.point.y = 0.025
    targets.publish(message)
    ros_graph.spin_until(lambda: aims and aims[-1].position[0] == 0.025, 'the end of the motion')
    # 0.1 mm: five times the breakaway velocity over h kp at 1 kHz, which leaves 22 um at 200 Hz.
    ros_graph.spin_until(lambda: abs(errors[-1].position[0]) < 1e-4, 'the target')
    assert max(m.position[0] for m in states) < 0.026


def test_no_force_before_a_target(ros_graph: RosGraph) -> None:
    """Measurements without a target are answered with zero."""
    assert Bench(ros_graph).measure(0.02) == 0.0


@pytest.mark.requirement('S-068', 'S-076')
def test_zero_force_after_the_measurement_timeout(ros_graph: RosGraph) -> None:
    bench = Bench(ros_graph, measurement_timeout=0.2)
    bench.aim(0.1)
    assert bench.push() > 0.5
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'stale' in bench.status.fault


@pytest.mark.requirement('S-054', 'S-071')
@pytest.mark.parametrize(
    'message',
    [
        JointState(name=['insertion'], position=[nan], velocity=[0.0]),
        JointState(name=['insertion'], position=[0.02], velocity=[]),
        JointState(name=['elbow'], position=[0.02], velocity=[0.0]),
    ],
    ids=['not finite', 'no velocity', 'other joint'],
)
def test_zero_force_for_invalid_measurements(ros_graph: RosGraph, message: JointState) -> None:
    """Non-finite or incomplete measurements, and measurements without the insertion joint."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    message.header.stamp = bench.node.get_clock().now().to_msg()
    bench.states.publish(message)
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'joint_states' in bench.status.fault


@pytest.mark.requirement('S-088')
def test_stop_latches(ros_graph: RosGraph) -> None:
    """The force is zero until the stop is cleared and a user sends a new target."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    assert bench.call('stop').success
    assert [bench.measure(0.02) for _ in range(3)] == [0.0, 0.0, 0.0]
    assert bench.said() == 'requested by a user; ~/clear_stop releases'
    assert bench.call('clear_stop').success
    assert [bench.measure(0.02) for _ in range(20)] == [0.0] * 20
    bench.aim(0.1)
    assert bench.push() > 0.5


def test_target_out_of_range_is_rejected(ros_graph: RosGraph) -> None:
    """A target beyond the hub keeps the previous target."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    for depth in (0.3, nan):
        message = PointStamped()
        message.point.y = depth
        bench.target.publish(message)
    bench.aim(0.05)
    ros_graph.spin_until(
        lambda: bench.controller.diagnose().status.target == 0.05, 'the next good target'
    )


def test_unstable_gains_fail_configure(ros_graph: RosGraph) -> None:
    """The node stays unconfigured and reports the reason."""
    controller = ros_graph.add(
        ControllerNode, start=False, parameters={'adaptive.insertion.kv': 3000.0}
    )
    assert not controller.start()
    assert 'adaptive.insertion gains are unstable at 1000 Hz' in controller.failure
    assert not controller.is_active


def test_unstable_gains_end_the_process(ros_graph: RosGraph) -> None:
    """The process prints one line and exits with status 2."""
    controller = ros_graph.start('controller', {'adaptive.insertion.kv': 3000.0})
    assert controller.process.wait(30) == 2
    assert 'are unstable' in controller.last_line


def test_parameters_cannot_change_while_configured(ros_graph: RosGraph) -> None:
    """The rejection contains the required procedure."""
    controller = ros_graph.add(ControllerNode, parameters=SLOW)
    parameter = Parameter('reference.kind', value='minimum_jerk')
    result = controller.set_parameters([parameter])[0]
    assert not result.successful
    assert 'clean up the node first' in result.reason


@pytest.mark.requirement('S-046', 'S-065')
@pytest.mark.parametrize('offset', [-10.0, 3600.0, None], ids=['old', 'ahead', 'not stamped'])
def test_zero_force_for_stale_future_and_missing_stamps(
    ros_graph: RosGraph, offset: float | None
) -> None:
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    message = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    if offset is not None:
        moment = bench.node.get_clock().now() + Duration(seconds=offset)
        message.header.stamp = moment.to_msg()
    bench.states.publish(message)
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'stale' in bench.status.fault
    # Valid measurements are answered again.
    assert bench.push() > 0.5


@pytest.mark.requirement('S-069')
def test_target_is_discarded_if_the_needle_moved_during_a_fault(ros_graph: RosGraph) -> None:
    """A needle at another depth is not pushed towards the previous target."""
    bench = Bench(ros_graph, measurement_timeout=0.2)
    bench.aim(0.1)
    assert bench.push() > 0.5
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert [bench.measure(0.05) for _ in range(5)] == [0.0] * 5
    assert bench.controller.diagnose().status.target is None


def test_repeated_configure_does_not_duplicate_subscriptions(ros_graph: RosGraph) -> None:
    """Only one subscription to the ground truth after repeated cleanup and configure."""
    controller = ros_graph.add(
        ControllerNode, parameters={**SLOW, 'deflection_feedback': 'ground_truth'}
    )
    for _ in range(3):
        assert controller.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
        assert controller.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        assert controller.start()
    topics = [subscription.topic_name for subscription in controller.subscriptions]
    assert topics.count('/ground_truth') == 1
    assert topics.count('/joint_states') == 1


def test_failed_configure_is_undone(ros_graph: RosGraph) -> None:
    """Resources created before the invalid parameter are destroyed."""
    wrong = {'deflection_feedback': 'ground_truth', 'safety.sensor_timeout': 0.0}
    controller = ros_graph.add(ControllerNode, start=False, parameters={**SLOW, **wrong})
    assert controller.trigger_configure() == TransitionCallbackReturn.FAILURE
    assert 'safety.sensor_timeout' in controller.failure
    assert '/ground_truth' not in [one.topic_name for one in controller.subscriptions]
    controller.set_parameters(
        [
            Parameter('safety.sensor_timeout', value=1.0),
            Parameter('deflection_feedback', value='none'),
        ]
    )
    assert controller.start()
    assert '/ground_truth' not in [one.topic_name for one in controller.subscriptions]


class Loop(GraphBench):
    """
    Controller and simulated plant in one thread, with a probe.

    Time is simulated: it waits for a stalled machine, which is therefore not a fault.
    """

    def __init__(
        self,
        graph: RosGraph,
        *,
        rate: float = 200.0,
        depth: float = 0.02,
        **parameters: float | str,
    ) -> None:
        self.graph = graph
        self.probe = graph.node('probe')
        self.states = graph.listen(self.probe, JointState, 'joint_states', SENSOR)
        self.aims = graph.listen(self.probe, JointState, 'reference', SENSOR)
        self.forces = graph.listen(self.probe, WrenchStamped, 'wrench_command', COMMAND)
        self.targets = self.probe.create_publisher(PointStamped, 'target', COMMAND)
        self.paths = self.probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        self.plant = graph.add(
            PlantNode,
            parameters={
                'rate': rate,
                'depth': depth,
                'command_timeout': 1.0,
                'publish_clock': True,
            },
        )
        self.node = graph.add(
            ControllerNode,
            parameters={
                'rate': rate,
                'use_sim_time': True,
                'measurement_timeout': 1.0,
                # On a busy machine the needle may lead its reference.
                'safety.tracking_error': 0.1,
                **parameters,
            },
        )
        self.until(lambda: self.aims and self.targets.get_subscription_count(), 'discovery')
        self.until(self.paths.get_subscription_count, 'discovery')

    def aim(self, depth: float) -> None:
        message = PointStamped()
        message.point.y = depth
        self.targets.publish(message)
        self.until(lambda: self.status.target == depth, 'the target')

    def call(
        self,
        kind: type[SetBool] | type[Trigger],
        name: str,
        request: SetBool_Request | Trigger_Request,
    ) -> SetBool_Response | Trigger_Response:
        client = self.probe.create_client(kind, f'controller/{name}')
        self.until(client.service_is_ready, name)
        answer = client.call_async(request)
        self.until(answer.done, name)
        return answer.result()

    @property
    def status(self) -> ControllerStatus:
        """Latest status of the controller."""
        return self.node.diagnose().status

    def speed(self) -> float:
        return self.aims[-1].velocity[0]


def path(*points: tuple[float, float, None], joint: str = 'insertion') -> JointTrajectory:
    """Return a trajectory of points: time, position, velocity or None."""
    message = JointTrajectory(joint_names=[joint])
    for time, position, speed in points:
        point = JointTrajectoryPoint(positions=[position])
        if speed is not None:
            point.velocities = [speed]
        point.time_from_start = Duration(seconds=time).to_msg()
        message.points.append(point)
    return message


@pytest.mark.requirement('S-008')
def test_pause_resume_and_retract(ros_graph: RosGraph) -> None:
    """The reference brakes, holds, continues to its target, and retracts."""
    loop = Loop(ros_graph, retract_depth='19mm')
    loop.aim(0.1)
    loop.until(lambda: loop.speed() == 0.01, 'the highest speed')
    assert loop.call(SetBool, 'pause', SetBool.Request(data=True)).success
    loop.until(lambda: loop.speed() == 0.0, 'rest')
    held = loop.aims[-1].position[0]
    count = len(loop.aims)
    loop.until(lambda: len(loop.aims) > count + 40, 'a while')
    assert {m.position[0] for m in loop.aims[count:]} == {held}
    assert loop.status.system is Mode.PAUSED
    assert loop.call(SetBool, 'pause', SetBool.Request(data=False)).success
    loop.until(lambda: loop.speed() > 0.0, 'motion')
    assert loop.call(Trigger, 'retract', Trigger.Request()).message == 'retracting'
    loop.until(lambda: loop.aims[-1].position[0] == 0.019, 'the way back')
    loop.until(lambda: abs(loop.states[-1].position[0] - 0.019) < 1e-4, 'the needle')
    # Continuous: one period at the limits, and rounding.
    aims = [(m.position[0], m.velocity[0]) for m in loop.aims]
    assert max(abs(b[0] - a[0]) for a, b in pairwise(aims)) < 0.01 * 0.2
    assert loop.call(Trigger, 'stop', Trigger.Request()).success
    refused = loop.call(Trigger, 'retract', Trigger.Request())
    assert 'stopped' in refused.message
    assert not refused.success


def test_trajectory_is_followed(ros_graph: RosGraph) -> None:
    """Positions without velocities are followed to the end; the plant ignores the trajectory."""
    loop = Loop(ros_graph)
    loop.paths.publish(path((0.5, 0.024, None), (1.0, 0.022, None)))
    loop.until(lambda: loop.aims[-1].position[0] == 0.022, 'the end')
    assert max(m.position[0] for m in loop.aims) > 0.0235
    loop.until(lambda: abs(loop.states[-1].position[0] - 0.022) < 1e-4, 'the needle')
    assert loop.status.rejected == 0
    assert loop.plant.diagnose().status.rejected == 0


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (path((1.0, 0.3, None)), 'positions must be in [0.001, 0.2] m'),
        (path((1.0, nan, None)), 'must be finite'),
        (path((1.0, 0.05, None), (1.0, 0.06, None)), 'increasing'),
        (path((1.0, 0.05, None), joint='elbow'), "needs the joint 'insertion'"),
        (path((0.0, 0.05, None), (1.0, 0.1, None)), 'must be within 0.01 m/s'),
    ],
    ids=['reach', 'finite', 'times', 'joint', 'speed'],
)
def test_infeasible_trajectory_is_rejected(
    ros_graph: RosGraph, message: JointTrajectory, reason: str
) -> None:
    """One line in log and diagnostics; the needle does not move."""
    bench = Bench(ros_graph)
    paths = bench.node.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
    ros_graph.spin_until(paths.get_subscription_count, 'discovery')
    paths.publish(message)
    ros_graph.spin_until(lambda: bench.status.rejected == 1, 'the rejection')
    assert reason in bench.status.last_rejection
    assert bench.measure(0.02) == 0.0


def test_bumpless_transfer_of_law_and_gains(ros_graph: RosGraph) -> None:
    """By parameter over DDS: the commanded force is continuous."""
    loop = Loop(ros_graph)
    loop.aim(0.1)
    loop.until(lambda: loop.states[-1].position[0] > 0.022, 'steady motion')
    for name, value in (('law', 'pid'), ('pid.insertion.kp', 4000.0), ('law', 'inverse_dynamics')):
        # An earlier command may still arrive.
        count = len(loop.forces)
        assert loop.node.set_parameters([Parameter(name, value=value)])[0].successful
        loop.until(lambda count=count: len(loop.forces) > count + 20, 'commands')
        forces = [m.wrench.force.y for m in loop.forces[count - 1 :]]
        # 3.6 N; the handover decays by 5 % of its value in a period of 5 ms.
        assert max(abs(b - a) for a, b in pairwise(forces)) < 0.05 * forces[0]
    assert loop.status.law == 'inverse_dynamics'


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('adaptive.insertion.kv', 3000.0, 'are unstable'),
        ('pid.insertion.kp', [1.0, 2.0], 'must be a number'),
        ('law', 'bang_bang', 'law must be one of adaptive, inverse_dynamics, pid'),
        ('retract_depth', 0.5, 'retract_depth must be in [0.001, 0.2] m'),
        ('retract_depth', '300mm', 'retract_depth must be in [0.001, 0.2] m, got 0.3'),
        ('retract_depth', '20N', 'retract_depth must be a number, or text with a unit of m, cm'),
    ],
)
def test_invalid_gains_are_rejected_while_active(
    ros_graph: RosGraph, name: str, value: float | list[float] | str, reason: str
) -> None:
    """The reason is in the response and on /diagnostics; the previous value is kept."""
    node = ros_graph.add(ControllerNode, parameters=SLOW)
    before = node.get_parameter(name).value
    answer = node.set_parameters([Parameter(name, value=value)])[0]
    assert not answer.successful
    assert reason in answer.reason
    assert node.get_parameter(name).value == before
    assert reason in node.diagnose().status.last_rejection


@pytest.mark.requirement('S-324')
def test_controller_works_during_a_check_of_gains(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Measurements and ~/stop are answered; the changes are made in the order of the requests."""
    bench = Bench(ros_graph)
    client = bench.node.create_client(SetParameters, 'controller/set_parameters')
    ros_graph.spin_until(client.service_is_ready, 'the service')
    bench.aim(0.1)
    assert bench.push() > 0.5
    checked, go_on = Controller._checked, Event()

    def check(self: Controller, *wanted: Any) -> Any:
        assert go_on.wait(60.0)
        return checked(self, *wanted)

    monkeypatch.setattr(Controller, '_checked', check)

    def change(**gains: float) -> Future:
        changes = [
            Parameter(f'adaptive.insertion.{name}', value=value).to_parameter_msg()
            for name, value in gains.items()
        ]
        return client.call_async(SetParameters.Request(parameters=changes))

    answers = [change(kv=3000.0), change(kp=901.0, kv=61.0), change(kp=902.0)]
    assert min(bench.measure(0.02) for _ in range(5)) > 0.5
    assert bench.call('stop').success
    assert bench.measure(0.02) == 0.0
    assert not any(answer.done() for answer in answers)
    go_on.set()
    ros_graph.spin_until(lambda: all(answer.done() for answer in answers), 'the changes')
    successes = [[one.successful for one in answer.result().results] for answer in answers]
    assert successes == [[False], [True, True], [True]]
    assert 'are unstable' in bench.status.last_rejection
    values = bench.controller.values()
    assert [values[f'adaptive.insertion.{name}'] for name in ('kp', 'kv')] == [902.0, 61.0]


def test_deactivation_during_a_check_of_gains(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The value is set, and used by the next configuration."""
    bench = Bench(ros_graph)
    client = bench.node.create_client(
        SetParametersAtomically, 'controller/set_parameters_atomically'
    )
    ros_graph.spin_until(client.service_is_ready, 'the service')
    checked, begun, go_on = Controller._checked, Event(), Event()

    def check(self: Controller, *wanted: Any) -> Any:
        begun.set()
        assert go_on.wait(60.0)
        return checked(self, *wanted)

    monkeypatch.setattr(Controller, '_checked', check)
    gain = Parameter('adaptive.insertion.kp', value=901.0).to_parameter_msg()
    answer = client.call_async(SetParametersAtomically.Request(parameters=[gain]))
    ros_graph.spin_until(begun.is_set, 'the check')
    transitions = bench.node.create_client(ChangeState, 'controller/change_state')
    ros_graph.spin_until(transitions.service_is_ready, 'the service')
    for number in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
        done = transitions.call_async(ChangeState.Request(transition=Transition(id=number)))
        ros_graph.spin_until(done.done, 'the transition')
        assert done.result().success
    assert not answer.done()
    go_on.set()
    ros_graph.spin_until(answer.done, 'the change')
    assert answer.result().result.successful
    assert bench.controller.start()
    assert bench.controller.values()['adaptive.insertion.kp'] == 901.0


@pytest.mark.requirement('S-072')
def test_zero_force_after_a_position_jump(ros_graph: RosGraph) -> None:
    """A jump of 5 mm within a period is not a needle motion."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    assert bench.measure(0.025) == 0.0
    assert 'insertion moved by' in bench.status.fault
    assert bench.controller.get_parameter('jump').value < 5e-3


def test_observer_estimates_the_tip(ros_graph: RosGraph) -> None:
    """By default it estimates the tip of a bent needle from the sensors of the plant."""
    probe = ros_graph.node('probe')
    tips = ros_graph.listen(probe, PointStamped, 'tip_deflection', SENSOR)
    ros_graph.add(
        PlantNode,
        parameters={**SLOW, 'depth': 0.15, 'tip_deflection': 3e-3, 'model.tissue_damping': 1.6,
                    'tip.rate': 50.0, 'tip.noise': 1e-4, 'tip.delay': 0.02},
    )  # fmt: skip
    node = ros_graph.add(ControllerNode, parameters={**SLOW, 'observer.tip_exposure': 0.02})
    ros_graph.spin_until(lambda: len(tips) > 25, 'tips')
    observed = node.diagnose().status.observer
    assert observed is not None
    # The needle oscillates to rest; three standard deviations, of estimate and last measurement.
    allowed = 3.0 * (observed.tip_deflection_deviation + 1e-4) + 5e-4
    assert abs(observed.tip_deflection - tips[-1].point.z) < allowed
    low, high = observed.nis_interval
    assert 0.0 < low < 1.0 < high
    assert observed.restarts == 0
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in tips]
    assert min(b - a for a, b in pairwise(stamps)) == pytest.approx(0.02, abs=1e-6)


@pytest.mark.requirement('S-044')
def test_integral_is_frozen_during_a_stop(ros_graph: RosGraph) -> None:
    """The integral of PID, which compensates friction, is kept."""
    bench = Bench(ros_graph, law='pid')
    bench.aim(0.1)
    memory = bench.controller._supervisor.controller._insertion.memory
    bench.push()
    ros_graph.spin_until(lambda: bench.measure(0.02) and memory[INTEGRAL], 'the integral')
    assert bench.call('stop').success
    learned = float(memory[INTEGRAL])
    assert [bench.measure(0.02) for _ in range(50)] == [0.0] * 50
    assert memory[INTEGRAL] == learned
    assert bench.call('clear_stop').success
    bench.measure(0.02)
    assert memory[INTEGRAL] != 0.0


#: Needle that the probe may hold at its position for a while: it reports no motion.
LIGHT = {'safety.tracking_error': 1.0, 'force_limit': 0.8}

#: A value beyond each limit, and a value within it.
BEYOND = {
    'speed': (lambda b: b.measure(0.02, 0.15), 'insertion speed 0.15 m/s is beyond'),
    'depth': (lambda b: b.measure(0.204), 'insertion depth 0.204 m is outside'),
    'axial': (lambda b: b.wrench(axial=-40.0), 'axial force -40 N is beyond the limit of 30 N'),
    'lateral': (lambda b: b.wrench(lateral=12.0), 'lateral force 12 N is beyond'),
    'moment': (lambda b: b.wrench(moment=1.5), 'moment 1.5 N m is beyond'),
    'tip': (lambda b: b.tip(0.07), 'tip deflection 0.07 m is beyond the limit of 0.05 m'),
}


@pytest.mark.requirement('S-021', 'S-041')
@pytest.mark.parametrize('limit', BEYOND)
def test_limit_violation_latches_a_stop(ros_graph: RosGraph, limit: str) -> None:
    """Zero force and reason on /diagnostics; the stop cannot be cleared while it persists."""
    exceed, reason = BEYOND[limit]
    bench = Bench(ros_graph)
    reports = ros_graph.statuses(bench.node, ControllerStatus)
    bench.aim(0.1)
    assert bench.push() > 0.5

    def stopped() -> str:
        exceed(bench)
        return bench.status.stop

    ros_graph.spin_until(stopped, 'the stop')
    assert reason in bench.status.stop
    ros_graph.spin_until(
        lambda: any(
            reason in one.stop and one.phase is ControllerPhase.STOPPED for one in reports
        ),
        'the reason on /diagnostics',
    )
    assert [bench.measure(0.02) for _ in range(3)] == [0.0] * 3
    exceed(bench)
    ros_graph.spin_until(lambda: bench.controller._supervisor.safety.guard.violated, 'one more')
    refused = bench.call('clear_stop')
    assert not refused.success
    assert reason in refused.message
    # Value within the limit; the step back first counts as a jump.
    for _ in range(3):
        bench.wrench()
        bench.tip(0.0)
        bench.measure(0.02)
    ros_graph.spin_until(
        lambda: not bench.controller._supervisor.safety.guard.violated, 'values within the limits'
    )
    assert bench.call('clear_stop').success
    assert bench.status.stops == 1
    # The target is discarded.
    assert bench.measure(0.02) == 0.0
    bench.aim(0.1)
    assert bench.push() > 0.5


@pytest.mark.requirement('S-070')
def test_frozen_encoders_cause_a_stop(ros_graph: RosGraph) -> None:
    """Frozen encoders with a moving reference are a fault."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    ros_graph.spin_until(lambda: bench.measure(0.02) == 0.0 and bench.status.stop, 'the stop')
    assert 'the encoders do not move' in bench.status.stop
    assert bench.call('clear_stop').success
    bench.aim(0.1)
    assert bench.push() > 0.5


@pytest.mark.requirement('S-037')
def test_single_spike_is_rejected_without_a_stop(ros_graph: RosGraph) -> None:
    """The motion continues."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    for count, load in enumerate((0.0, 0.1, 60.0, 0.1, 0.0), 1):
        bench.wrench(lateral=load)

        def is_taken(count: int = count) -> bool:
            found = bench.input('base_wrench')
            return found.accepted + sum(found.rejected.values()) == count

        # A busy controller takes the newest readings only.
        ros_graph.spin_until(is_taken, 'the reading')
    assert bench.input('base_wrench').rejected.get('jump') == 2
    assert bench.push() > 0.5
    assert bench.status.stops == 0


@pytest.mark.requirement('S-059', 'S-063')
@pytest.mark.parametrize(
    ('send', 'topic', 'kind'),
    [
        (lambda b: b.wrench(stamp=False), 'base_wrench', 'not stamped'),
        (lambda b: b.wrench(frame='needle_entry'), 'base_wrench', 'frame'),
        (lambda b: b.wrench(lateral=nan), 'base_wrench', 'not finite'),
        (lambda b: b.wrench(axial=inf), 'base_wrench', 'not finite'),
        (lambda b: b.tip(0.0, stamp=False), 'tip_deflection', 'not stamped'),
        (lambda b: b.tip(0.0, frame=''), 'tip_deflection', 'frame'),
        (lambda b: b.tip(nan), 'tip_deflection', 'not finite'),
    ],
)
def test_invalid_readings_are_counted_and_discarded(
    ros_graph: RosGraph, send: Callable[..., Any], topic: str, kind: str
) -> None:
    """The observer does not process them, and the motion continues."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    send(bench)
    ros_graph.spin_until(lambda: bench.input(topic).rejected.get(kind) == 1, 'the refusal')
    assert bench.input(topic).accepted == 0
    assert bench.controller._supervisor.bending.observer.refused == 0
    assert bench.push() > 0.5


@pytest.mark.requirement('S-073')
def test_motion_continues_without_optional_sensors(ros_graph: RosGraph) -> None:
    """Diagnostics warn while sensors are missing; the force is unchanged."""
    bench = Bench(ros_graph, **LIGHT, **{'safety.sensor_timeout': 0.3})
    bench.aim(0.1)
    depth = 0.02

    def stale() -> bool:
        bench.measure(depth)
        return all(name in bench.status.warning for name in ('base_wrench', 'tip_deflection'))

    ros_graph.spin_until(stale, 'the warning')
    assert bench.controller.diagnose().severity == Severity.WARNING
    assert bench.measure(depth) > 0.5

    def well() -> bool:
        bench.wrench()
        bench.tip(0.0)
        bench.measure(depth)
        return bench.status.phase is ControllerPhase.ACTIVE and not bench.status.warning

    ros_graph.spin_until(well, 'the end of the warning')
    assert bench.measure(depth) > 0.5


@pytest.mark.requirement('S-073')
def test_missing_required_sensors_cause_a_stop(ros_graph: RosGraph) -> None:
    bench = Bench(
        ros_graph, **{'safety.sensor_timeout': 0.3, 'safety.sensors_required': True, **LIGHT}
    )
    bench.aim(0.1)
    assert bench.push() > 0.5
    ros_graph.spin_until(lambda: bench.measure(0.02) == 0.0, 'the stop')
    assert 'is stale' in bench.status.stop
    assert 'is stale' in bench.call('clear_stop').message


@pytest.mark.requirement('S-079')
def test_duplicate_commanders_command_zero_force(ros_graph: RosGraph) -> None:
    """The force is zero while another node publishes commands, and returns afterwards."""
    bench = Bench(ros_graph, **{'safety.tracking_error': 1.0})
    bench.aim(0.1)
    assert bench.push() > 0.5
    rival = bench.node.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    ros_graph.spin_until(lambda: bench.measure(0.02) == 0.0, 'zero force')
    assert bench.said() == '2 nodes publish wrench_command'
    assert bench.controller.diagnose().severity == Severity.WARNING
    bench.node.destroy_publisher(rival)
    assert bench.push() > 0.5


@pytest.mark.requirement('S-089')
def test_commands_have_the_stamp_of_the_measurement(ros_graph: RosGraph) -> None:
    """A repeated measurement gets the same command; other commands have the current time."""
    bench = Bench(ros_graph, measurement_timeout=1.0)
    bench.aim(0.1)
    force, stamp = bench.push(), bench.commands[-1].header.stamp
    again = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    again.header.stamp = stamp
    assert bench.ask(again) == force
    assert bench.input('joint_states').repeated == 1
    # Commands of the watchdog do not answer a measurement.
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    last = bench.commands[-1].header.stamp
    assert (last.sec, last.nanosec) > (stamp.sec, stamp.nanosec)


def test_repeated_measurement_after_a_stop_gets_zero_force(ros_graph: RosGraph) -> None:
    """The previous force is not sent again."""
    bench = Bench(ros_graph, measurement_timeout=5.0)
    bench.aim(0.1)
    assert bench.push() > 0.5
    stamp = bench.commands[-1].header.stamp
    assert bench.call('stop').success
    again = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    again.header.stamp = stamp
    assert bench.ask(again) == 0.0


class SimulatedTime(Bench):
    """Bench with a clock set by the test."""

    def __init__(self, graph: RosGraph, **parameters: Any) -> None:
        super().__init__(graph, use_sim_time=True, **parameters)
        self.clock = self.node.create_publisher(Clock, '/clock', 10)
        graph.spin_until(self.clock.get_subscription_count, 'the clock')
        self.set(0.0)

    def set(self, seconds: float) -> None:
        """Set the clock and wait until the controller has received it."""
        self.time = round(seconds * 1e9)
        self.clock.publish(Clock(clock=self.now()))
        clock = self.controller.get_clock()
        self.graph.spin_until(lambda: clock.now().nanoseconds == self.time, 'the clock')

    def now(self) -> Time:
        return Time(sec=self.time // 10**9, nanosec=self.time % 10**9)

    def measure(self, depth: float, speed: float = 0.0) -> float:
        self.set((self.time + 5_000_000) / 1e9)
        return super().measure(depth, speed)


@pytest.mark.requirement('S-060')
def test_first_sample_with_stamp_zero_is_answered(ros_graph: RosGraph) -> None:
    bench = SimulatedTime(ros_graph)
    message = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    assert bench.ask(message) == 0.0
    assert bench.status.latency.answered == 1
    bench.aim(0.1)
    assert bench.push() > 0.5


@pytest.mark.requirement('S-085')
def test_clock_set_back_restarts_the_motion(ros_graph: RosGraph) -> None:
    """Zero force first; the next sample is answered despite its earlier stamp."""
    bench = SimulatedTime(ros_graph)
    bench.set(100.0)
    bench.aim(0.1)
    assert bench.push() > 0.5
    bench.set(50.0)
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'clock went back by' in bench.status.fault
    assert bench.push() > 0.5
    assert bench.status.phase is ControllerPhase.ACTIVE


@pytest.mark.requirement('S-084')
def test_clock_jump_ahead_restarts_the_motion(ros_graph: RosGraph) -> None:
    """The motion restarts at the position of the needle, without a fault."""
    bench = SimulatedTime(ros_graph)
    bench.set(100.0)
    bench.aim(0.1)
    assert bench.push() > 0.5
    aims = ros_graph.listen(bench.node, JointState, 'reference', SENSOR)
    bench.set(200.0)

    def aimed() -> list[JointState]:
        bench.measure(0.0201)
        return [one for one in aims if one.header.stamp.sec >= 200]

    ros_graph.spin_until(aimed, 'the reference')
    # A continued motion would have reached the target.
    assert aimed()[0].position[0] < 0.021
    # Reported as a gap, or as a stale measurement if the watchdog is called before it arrives.
    assert bench.status.stops == 0
    assert bench.status.target == 0.1
    assert bench.push() > 0.5


@pytest.mark.requirement('S-083', 'S-101')
def test_stopped_clock_is_not_a_fault(ros_graph: RosGraph) -> None:
    """No timeout in paused time; a repeated sample gets the same force."""
    bench = SimulatedTime(ros_graph)
    bench.set(100.0)
    bench.aim(0.1)
    force = bench.push()
    message = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    message.header.stamp = bench.now()
    start = monotonic()

    def repeated() -> bool:
        forces.add(bench.ask(message))
        # Three times the timeout in real time.
        return monotonic() - start > 0.3

    forces: set[float] = set()
    ros_graph.spin_until(repeated, 'a while')
    assert forces == {force}
    assert bench.push() > 0.5


@pytest.mark.requirement('S-053')
@pytest.mark.parametrize(
    ('frame', 'stamp', 'reason'),
    [
        ('needle_base', Time(), "must be in frame '' or 'needle_entry', got 'needle_base'"),
        ('', Time(sec=5), 'target is stale: its stamp is'),
    ],
)
def test_target_with_wrong_frame_or_stamp_is_rejected(
    ros_graph: RosGraph, frame: str, stamp: Time, reason: str
) -> None:
    """An empty frame and a zero stamp are accepted."""
    bench = Bench(ros_graph)
    message = PointStamped()
    message.header.frame_id, message.header.stamp = frame, stamp
    message.point.y = 0.1
    bench.target.publish(message)
    ros_graph.spin_until(lambda: bench.status.rejected == 1, 'the refusal')
    assert reason in bench.status.last_rejection
    assert bench.status.target is None


def test_inactive_node_answers_requests(ros_graph: RosGraph) -> None:
    """Services report the state, targets are rejected, and a stop applies after activation."""
    bench = Bench(ros_graph, start=False)
    assert bench.call('stop').success
    bench.start()
    assert bench.controller.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert 'stopped' in bench.call('pause', SetBool, data=True).message
    assert 'stopped' in bench.call('retract').message
    bench.target.publish(PointStamped())
    ros_graph.spin_until(
        lambda: 'target rejected: the controller is not active' in bench.status.last_rejection,
        'the refusal',
    )
    assert bench.controller.trigger_activate() == TransitionCallbackReturn.SUCCESS
    bench.target.publish(PointStamped())
    ros_graph.spin_until(
        lambda: 'target rejected: stopped: requested by a user' in bench.status.last_rejection,
        'the rejection',
    )
    assert [bench.measure(0.02) for _ in range(5)] == [0.0] * 5
    assert bench.status.stop == 'requested by a user'
    assert bench.call('clear_stop').success
    assert bench.call('clear_stop').message == 'there was no stop'
    bench.aim(0.1)
    assert bench.push() > 0.5


@pytest.mark.requirement('S-071')
@pytest.mark.parametrize(
    'message',
    [
        JointState(),
        JointState(name=['insertion'] * 3),
        JointState(name=['insertion', 'rotation'], position=[0.02], velocity=[0.0, 0.0]),
        JointState(name=['insertion'], position=[0.02], velocity=[inf]),
        JointState(name=['insertion'], position=[1e300], velocity=[1e300]),
        JointState(name=['insertion', 'rotation'], position=[0.02, nan], velocity=[0.0, 0.0]),
    ],
)
def test_malformed_joint_states_raise_no_error(ros_graph: RosGraph, message: JointState) -> None:
    """Zero force with the same stamp; the next valid measurement is answered."""
    bench = Bench(ros_graph, measurement_timeout=5.0)
    bench.aim(0.1)
    assert bench.push() > 0.5
    message.header.stamp = bench.now()
    assert bench.ask(message) == 0.0
    assert bench.status.stop == ''
    assert bench.push() > 0.5


@pytest.mark.parametrize(
    'message',
    [
        JointState(),
        JointState(position=[0.0] * 4, velocity=[0.0] * 3),
        JointState(position=[0.18, 0.0, nan, 0.0], velocity=[0.0] * 4),
        JointState(position=[-5.0, 0.0, 0.0, 0.0], velocity=[0.0] * 4),
        JointState(position=[0.18, 0.0, 1e308, 0.0], velocity=[0.0] * 4),
    ],
)
def test_malformed_ground_truth_raises_no_error(ros_graph: RosGraph, message: JointState) -> None:
    """Ground truth with a wrong length or invalid values is discarded."""
    bench = Bench(ros_graph, deflection_feedback='ground_truth')
    truths = bench.node.create_publisher(JointState, 'ground_truth', SENSOR)
    ros_graph.spin_until(truths.get_subscription_count, 'discovery')
    bench.aim(0.1)
    message.header.stamp = bench.now()
    truths.publish(message)
    ros_graph.spin_until(lambda: 'ground_truth' in bench.status.input, 'the truth')
    assert bench.controller._supervisor.bending.load == 0.0
    assert bench.push() > 0.5


@pytest.mark.requirement('S-022', 'S-063')
def test_diagnostics_report_rates_and_saturation(ros_graph: RosGraph) -> None:
    """Rate of each input in the last second, and time at the force limit."""
    bench = SimulatedTime(ros_graph, force_limit=0.7, **{'safety.tracking_error': 0.1})
    bench.aim(0.1)

    def saturated() -> bool | float:
        bench.measure(0.02)
        seen = bench.input('joint_states').rate
        return seen and bench.status.saturated_fraction == 1.0

    ros_graph.spin_until(saturated, 'a second at the limit')
    # One message each 5 ms of simulated time: a window of a second has one more or less at its
    # ends. Measurements that are repeated until their answer count as messages, too.
    assert bench.status.command_rate == pytest.approx(200.0, abs=1.0)
    assert bench.input('joint_states').rate == pytest.approx(200.0, abs=5.0)
