"""The controller as the graph sees it, alone and around the plant."""

from collections.abc import Callable
from itertools import pairwise
from math import inf, nan
from time import monotonic
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_controller.compiled.laws import INTEGRAL
from needle_controller.controller_node import ControllerNode
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND, SENSOR
import pytest
from rclpy.duration import Duration
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from std_srvs.srv._set_bool import SetBool_Request, SetBool_Response
from std_srvs.srv._trigger import Trigger_Request, Trigger_Response
from support.ros_graph import RosGraph
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Both nodes in the test's own thread.
SLOW = {'rate': 200.0}


class Bench:
    """A controller with a probe that plays the plant."""

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
            assert self.controller.start(), self.controller.failure
        graph.spin_until(
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
        """Return the time to stamp with."""
        return self.node.get_clock().now().to_msg()

    def measure(self, depth: float, speed: float = 0.0) -> float:
        """Publish a measurement and return the force that answers it."""
        message = JointState(name=['insertion'], position=[depth], velocity=[speed])
        return self.ask(message, fresh=True)

    def ask(self, message: JointState, fresh: bool = False) -> float:
        """Publish a joint state and return the force that answers it."""
        count = len(self.commands)
        asked: list[tuple[float, Time]] = []

        def answers() -> list[WrenchStamped]:
            # On a machine that is held up a measurement may be stale before it is read.
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
        """Return the answer of a service."""
        client = self.node.create_client(kind, f'controller/{name}')
        self.graph.spin_until(client.service_is_ready, name)
        answers: list[tuple[float, Future]] = []

        def answered() -> list[Future]:
            # One to a client that the node does not know yet is lost; none of them adds up.
            if not answers or monotonic() - answers[-1][0] > 1.0:
                answers.append((monotonic(), client.call_async(kind.Request(**request))))
            return [answer for _, answer in answers if answer.done()]

        self.graph.spin_until(answered, name)
        return answered()[0].result()

    def said(self) -> str:
        """Return what its diagnostics say first."""
        return self.controller.diagnose()[1]

    def value(self, key: str) -> str:
        """Return one value of its diagnostics."""
        return str(self.controller.diagnose()[2].get(key, ''))

    def wrench(
        self,
        axial: float = 0.0,
        lateral: float = 0.0,
        moment: float = 0.0,
        frame: str = 'needle_base',
        stamp: bool = True,
    ) -> None:
        """Publish a reading of the force sensor."""
        message = WrenchStamped()
        message.header.frame_id = frame
        if stamp:
            message.header.stamp = self.now()
        message.wrench.force.y, message.wrench.force.z = axial, lateral
        message.wrench.torque.x = moment
        self.wrenches.publish(message)

    def tip(self, deflection: float, frame: str = 'needle_entry', stamp: bool = True) -> None:
        """Publish a sample of the tip."""
        message = PointStamped()
        message.header.frame_id = frame
        if stamp:
            message.header.stamp = self.now()
        message.point.y, message.point.z = 0.02, deflection
        self.tips.publish(message)

    def aim(self, depth: float, deflection: float = 0.0) -> None:
        """Publish a target and wait until the controller has it."""
        message = PointStamped()
        message.point.y, message.point.z = depth, deflection
        self.target.publish(message)
        self.graph.spin_until(lambda: self.controller.diagnose()[2]['target [m]'], 'the target')

    def push(self) -> float:
        """Measure until the reference has left and a force comes."""
        self.graph.spin_until(lambda: self.measure(0.02) > 0.5, 'a force')
        return self.commands[-1].wrench.force.y


@pytest.mark.parametrize('law', ['adaptive', 'inverse_dynamics', 'pid'])
@pytest.mark.parametrize('reference', ['trapezoid', 'minimum_jerk'])
def test_reaches_the_target(ros_graph: RosGraph, law: str, reference: str) -> None:
    """Around the plant over DDS each law brings the needle to the target with each reference."""
    probe = ros_graph.node('probe')
    states = ros_graph.listen(probe, JointState, 'joint_states', SENSOR)
    errors = ros_graph.listen(probe, JointState, 'tracking_error', SENSOR)
    aims = ros_graph.listen(probe, JointState, 'reference', SENSOR)
    targets = probe.create_publisher(PointStamped, 'target', COMMAND)
    ros_graph.add(PlantNode, parameters=SLOW)
    ros_graph.add(ControllerNode, parameters={**SLOW, 'law': law, 'reference.kind': reference})
    ros_graph.spin_until(lambda: states and targets.get_subscription_count(), 'discovery')
    message = PointStamped()
    message.point.y = 0.025
    targets.publish(message)
    ros_graph.spin_until(lambda: aims and aims[-1].position[0] == 0.025, 'the end of the motion')
    # 0.1 mm: the breakaway speed over h kp, five times that at 1 kHz, leaves 22 um at 200 Hz.
    ros_graph.spin_until(lambda: abs(errors[-1].position[0]) < 1e-4, 'the target')
    assert max(m.position[0] for m in states) < 0.026


def test_no_force_before_a_target(ros_graph: RosGraph) -> None:
    """Measurements alone are answered with zero."""
    assert Bench(ros_graph).measure(0.02) == 0.0


def test_lets_go_when_measurements_stop(ros_graph: RosGraph) -> None:
    """A force is withdrawn when the last measurement is older than the timeout."""
    bench = Bench(ros_graph, measurement_timeout=0.2)
    bench.aim(0.1)
    assert bench.push() > 0.5
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'stale' in bench.controller.diagnose()[1]


@pytest.mark.parametrize(
    'message',
    [
        JointState(name=['insertion'], position=[nan], velocity=[0.0]),
        JointState(name=['insertion'], position=[0.02], velocity=[]),
        JointState(name=['elbow'], position=[0.02], velocity=[0.0]),
    ],
    ids=['not finite', 'no velocity', 'other joint'],
)
def test_lets_go_of_a_measurement_it_cannot_use(ros_graph: RosGraph, message: JointState) -> None:
    """What is not finite, not complete or not the insertion joint is answered with zero force."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    message.header.stamp = bench.node.get_clock().now().to_msg()
    bench.states.publish(message)
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'joint_states' in bench.controller.diagnose()[1]


def test_an_emergency_stop_latches(ros_graph: RosGraph) -> None:
    """After a stop every answer is zero until it is cleared; then the motion starts anew."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    assert bench.call('emergency_stop').success
    assert [bench.measure(0.02) for _ in range(3)] == [0.0, 0.0, 0.0]
    assert bench.said() == 'emergency stop; ~/clear_stop releases'
    assert bench.call('clear_stop').success
    assert bench.push() > 0.5


def test_a_target_out_of_reach_is_refused(ros_graph: RosGraph) -> None:
    """A target beyond the hub leaves the old one in force."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    for depth in (0.3, nan):
        message = PointStamped()
        message.point.y = depth
        bench.target.publish(message)
    bench.aim(0.05)
    ros_graph.spin_until(
        lambda: bench.controller.diagnose()[2]['target [m]'] == 0.05, 'the next good target'
    )


def test_unstable_gains_refuse_the_transition(ros_graph: RosGraph) -> None:
    """Unstable gains leave the node unconfigured with the reason."""
    controller = ros_graph.add(
        ControllerNode, start=False, parameters={'adaptive.insertion.kv': 3000.0}
    )
    assert not controller.start()
    assert 'adaptive.insertion gains are unstable at 1000 Hz' in controller.failure
    assert not controller.is_active


def test_unstable_gains_end_the_process(ros_graph: RosGraph) -> None:
    """Run on its own it says so in one line and exits with 2."""
    controller = ros_graph.start('controller', {'adaptive.insertion.kv': 3000.0})
    assert controller.process.wait(30) == 2
    assert 'are unstable' in controller.last_line


def test_parameters_cannot_change_while_configured(ros_graph: RosGraph) -> None:
    """A change that would not take effect is refused, with the way to make it."""
    controller = ros_graph.add(ControllerNode, parameters=SLOW)
    parameter = Parameter('reference.kind', value='minimum_jerk')
    result = controller.set_parameters([parameter])[0]
    assert not result.successful
    assert 'clean up the node first' in result.reason


@pytest.mark.parametrize('offset', [-10.0, 3600.0, None], ids=['old', 'ahead', 'not stamped'])
def test_lets_go_of_stamps_that_are_not_now(ros_graph: RosGraph, offset: float | None) -> None:
    """A measurement stamped long ago, in the future or not at all is answered with zero force."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    message = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    if offset is not None:
        moment = bench.node.get_clock().now() + Duration(seconds=offset)
        message.header.stamp = moment.to_msg()
    bench.states.publish(message)
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'stale' in bench.controller.diagnose()[1]
    # Good measurements are answered again.
    assert bench.push() > 0.5


def test_forgets_the_target_when_the_needle_is_elsewhere_after_a_fault(
    ros_graph: RosGraph,
) -> None:
    """A needle that comes back at another depth is not pushed towards the old target."""
    bench = Bench(ros_graph, measurement_timeout=0.2)
    bench.aim(0.1)
    assert bench.push() > 0.5
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert [bench.measure(0.05) for _ in range(5)] == [0.0] * 5
    assert bench.controller.diagnose()[2]['target [m]'] is None


def test_configuring_again_doubles_nothing(ros_graph: RosGraph) -> None:
    """Clean up and configure as often as one likes: one subscription to the ground truth."""
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


def test_a_refused_configuration_leaves_nothing_behind(ros_graph: RosGraph) -> None:
    """What was made before the parameter that is not valid is undone."""
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


class Loop:
    """
    Controller and simulated plant in one thread, with a probe.

    Time is the plant's: a machine that stalls makes it wait, and is no fault of its own.
    """

    def __init__(
        self, graph: RosGraph, *, rate: float = 200.0, depth: float = 0.02, **parameters: float
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
                # A needle that is pushed on while all is held up is ahead of its reference.
                'safety.tracking_error': 0.1,
                **parameters,
            },
        )
        self.until(lambda: self.aims and self.targets.get_subscription_count(), 'discovery')
        self.until(self.paths.get_subscription_count, 'discovery')

    def until(self, condition: Callable[..., Any], what: str) -> None:
        self.graph.spin_until(condition, what)

    def aim(self, depth: float) -> None:
        message = PointStamped()
        message.point.y = depth
        self.targets.publish(message)
        self.until(lambda: self.said('target [m]') == depth, 'the target')

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

    def said(self, key: str) -> Any:
        return self.node.diagnose()[2][key]

    def speed(self) -> float:
        return self.aims[-1].velocity[0]


def path(*points: tuple[float, float, None], joint: str = 'insertion') -> JointTrajectory:
    """Return a trajectory of points: time, position, speed or None."""
    message = JointTrajectory(joint_names=[joint])
    for time, position, speed in points:
        point = JointTrajectoryPoint(positions=[position])
        if speed is not None:
            point.velocities = [speed]
        point.time_from_start = Duration(seconds=time).to_msg()
        message.points.append(point)
    return message


def test_pauses_goes_on_and_retracts(ros_graph: RosGraph) -> None:
    """The reference brakes, holds, goes on to its target, and back out again."""
    loop = Loop(ros_graph, retract_depth=0.019)
    loop.aim(0.1)
    loop.until(lambda: loop.speed() == 0.01, 'the highest speed')
    assert loop.call(SetBool, 'pause', SetBool.Request(data=True)).success
    loop.until(lambda: loop.speed() == 0.0, 'rest')
    held = loop.aims[-1].position[0]
    count = len(loop.aims)
    loop.until(lambda: len(loop.aims) > count + 40, 'a while')
    assert {m.position[0] for m in loop.aims[count:]} == {held}
    assert loop.said('paused') is True
    assert loop.call(SetBool, 'pause', SetBool.Request(data=False)).success
    loop.until(lambda: loop.speed() > 0.0, 'motion')
    assert loop.call(Trigger, 'retract', Trigger.Request()).message == 'retracting to 0.019 m'
    loop.until(lambda: loop.aims[-1].position[0] == 0.019, 'the way back')
    loop.until(lambda: abs(loop.states[-1].position[0] - 0.019) < 1e-4, 'the needle')
    # No jump in all of it: one period at the limits, and rounding.
    aims = [(m.position[0], m.velocity[0]) for m in loop.aims]
    assert max(abs(b[0] - a[0]) for a, b in pairwise(aims)) < 0.01 * 0.2
    assert loop.call(Trigger, 'emergency_stop', Trigger.Request()).success
    refused = loop.call(Trigger, 'retract', Trigger.Request())
    assert 'stopped' in refused.message
    assert not refused.success


def test_follows_a_trajectory(ros_graph: RosGraph) -> None:
    """Lines by positions alone are followed to their end; the plant leaves them to it."""
    loop = Loop(ros_graph)
    loop.paths.publish(path((0.5, 0.024, None), (1.0, 0.022, None)))
    loop.until(lambda: loop.aims[-1].position[0] == 0.022, 'the end')
    assert max(m.position[0] for m in loop.aims) > 0.0235
    loop.until(lambda: abs(loop.states[-1].position[0] - 0.022) < 1e-4, 'the needle')
    assert loop.said('inputs refused') == 0
    assert loop.plant.diagnose()[2]['commands refused'] == 0


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
def test_a_trajectory_that_it_cannot_follow_is_refused(
    ros_graph: RosGraph, message: JointTrajectory, reason: str
) -> None:
    """In one line, which diagnostics have too; nothing moves."""
    bench = Bench(ros_graph)
    paths = bench.node.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
    ros_graph.spin_until(paths.get_subscription_count, 'discovery')
    paths.publish(message)
    said = bench.controller.diagnose
    ros_graph.spin_until(lambda: said()[2]['inputs refused'] == 1, 'the refusal')
    assert reason in said()[2]['last complaint']
    assert bench.measure(0.02) == 0.0


def test_switches_law_and_gains_in_motion_without_a_bump(ros_graph: RosGraph) -> None:
    """By parameter, over DDS: the commanded force goes on where it was."""
    loop = Loop(ros_graph)
    loop.aim(0.1)
    loop.until(lambda: loop.states[-1].position[0] > 0.022, 'steady motion')
    for name, value in (('law', 'pid'), ('pid.insertion.kp', 4000.0), ('law', 'inverse_dynamics')):
        # One that is there belongs to the time before.
        count = len(loop.forces)
        assert loop.node.set_parameters([Parameter(name, value=value)])[0].successful
        loop.until(lambda count=count: len(loop.forces) > count + 20, 'commands')
        forces = [m.wrench.force.y for m in loop.forces[count - 1 :]]
        # 3.6 N; the handover fades by 5 % of its part in a period of 5 ms.
        assert max(abs(b - a) for a, b in pairwise(forces)) < 0.05 * forces[0]
    assert loop.said('law') == 'inverse_dynamics'


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('adaptive.insertion.kv', 3000.0, 'are unstable'),
        ('pid.insertion.kp', [1.0, 2.0], 'must be a number'),
        ('law', 'bang_bang', 'law must be one of adaptive, inverse_dynamics, pid'),
        ('retract_depth', 0.5, 'retract_depth must be in [0.001, 0.2] m'),
    ],
)
def test_gains_that_will_not_do_are_refused_while_running(
    ros_graph: RosGraph, name: str, value: float | list[float] | str, reason: str
) -> None:
    """The reason is the answer and on /diagnostics; the old value stays."""
    node = ros_graph.add(ControllerNode, parameters=SLOW)
    before = node.get_parameter(name).value
    answer = node.set_parameters([Parameter(name, value=value)])[0]
    assert not answer.successful
    assert reason in answer.reason
    assert node.get_parameter(name).value == before
    assert reason in node.diagnose()[2]['last complaint']


def test_a_measurement_that_jumps_is_answered_with_no_force(ros_graph: RosGraph) -> None:
    """A needle that is 5 mm on within a period is no needle."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    assert bench.measure(0.025) == 0.0
    assert 'insertion moved by' in bench.controller.diagnose()[1]
    assert bench.controller.get_parameter('jump').value < 5e-3


def test_the_observer_tells_what_it_sees(ros_graph: RosGraph) -> None:
    """By default it follows the tip of a bent needle from the plant's sensors."""
    probe = ros_graph.node('probe')
    tips = ros_graph.listen(probe, PointStamped, 'tip_deflection', SENSOR)
    ros_graph.add(
        PlantNode,
        parameters={**SLOW, 'depth': 0.15, 'tip_deflection': 3e-3, 'model.tissue_damping': 1.6,
                    'tip.rate': 50.0, 'tip.noise': 1e-4, 'tip.delay': 0.02},
    )  # fmt: skip
    node = ros_graph.add(ControllerNode, parameters={**SLOW, 'observer.tip_exposure': 0.02})
    ros_graph.spin_until(lambda: len(tips) > 25, 'tips')
    said = node.diagnose()[2]
    estimate, _, spread = str(said['tip deflection [m]']).split()
    # The needle swings to rest; three standard deviations and those of the last tip seen.
    assert abs(float(estimate) - tips[-1].point.z) < 3.0 * (float(spread) + 1e-4) + 5e-4
    assert 'in [' in said['observer consistency (NIS)']
    assert said['observer restarts'] == 0
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in tips]
    assert min(b - a for a, b in pairwise(stamps)) == pytest.approx(0.02, abs=1e-6)


def test_the_integral_is_frozen_while_it_is_stopped(ros_graph: RosGraph) -> None:
    """What PID has learned of the friction is there again after the stop."""
    bench = Bench(ros_graph, law='pid')
    bench.aim(0.1)
    memory = bench.controller._supervisor.controller._insertion.memory
    bench.push()
    ros_graph.spin_until(lambda: bench.measure(0.02) and memory[INTEGRAL], 'the integral')
    assert bench.call('emergency_stop').success
    learned = float(memory[INTEGRAL])
    assert [bench.measure(0.02) for _ in range(50)] == [0.0] * 50
    assert memory[INTEGRAL] == learned
    assert bench.call('clear_stop').success
    bench.measure(0.02)
    assert memory[INTEGRAL] != 0.0


#: Beyond each limit, and what is well within it.
BEYOND = {
    'speed': (lambda b: b.measure(0.02, 0.15), 'insertion speed 0.15 m/s is beyond'),
    'depth': (lambda b: b.measure(0.204), 'insertion depth 0.204 m is outside'),
    'axial': (lambda b: b.wrench(axial=-40.0), 'axial force -40 N is beyond the limit of 30 N'),
    'lateral': (lambda b: b.wrench(lateral=12.0), 'lateral force 12 N is beyond'),
    'moment': (lambda b: b.wrench(moment=1.5), 'moment 1.5 N m is beyond'),
    'tip': (lambda b: b.tip(0.07), 'tip deflection 0.07 m is beyond the limit of 0.05 m'),
}


@pytest.mark.parametrize('limit', BEYOND)
def test_beyond_a_limit_it_stops_until_it_is_cleared(ros_graph: RosGraph, limit: str) -> None:
    """Zero force, the reason on /diagnostics, and no way back while it is still beyond."""
    exceed, reason = BEYOND[limit]
    bench = Bench(ros_graph)
    arrays = ros_graph.listen(bench.node, DiagnosticArray, '/diagnostics', 10)
    bench.aim(0.1)
    assert bench.push() > 0.5

    def stopped() -> str:
        exceed(bench)
        return bench.value('stop')

    ros_graph.spin_until(stopped, 'the stop')
    assert reason in bench.value('stop')
    ros_graph.spin_until(
        lambda: [
            status
            for array in arrays
            for status in array.status
            if reason in status.message and status.level == DiagnosticStatus.ERROR
        ],
        'the reason on /diagnostics',
    )
    assert [bench.measure(0.02) for _ in range(3)] == [0.0] * 3
    exceed(bench)
    ros_graph.spin_until(lambda: bench.controller._supervisor.safety.guard.violated, 'one more')
    refused = bench.call('clear_stop')
    assert not refused.success
    assert reason in refused.message
    # Well again, it starts anew; a step back is a jump at first.
    for _ in range(3):
        bench.wrench()
        bench.tip(0.0)
        bench.measure(0.02)
    ros_graph.spin_until(
        lambda: not bench.controller._supervisor.safety.guard.violated, 'what is well'
    )
    assert bench.call('clear_stop').success
    assert bench.value('stops latched') == '1'
    if limit == 'depth':
        # It was elsewhere: the target is forgotten.
        bench.measure(0.02)
        bench.aim(0.1)
    assert bench.push() > 0.5


def test_a_needle_that_does_not_follow_is_not_pushed_for_ever(ros_graph: RosGraph) -> None:
    """Encoders that stand still while the reference goes on are a fault, not a reason to push."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    ros_graph.spin_until(lambda: bench.measure(0.02) == 0.0 and bench.value('stop'), 'the stop')
    assert 'tracking error' in bench.value('stop')
    assert bench.call('clear_stop').success
    assert bench.push() > 0.5


def test_one_reading_alone_stops_nothing(ros_graph: RosGraph) -> None:
    """A spike is not taken in, and the needle is pushed on."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    for load in (0.0, 0.1, 60.0, 0.1, 0.0):
        bench.wrench(lateral=load)
    ros_graph.spin_until(lambda: '2 jump' in bench.value('input base_wrench'), 'the readings')
    ros_graph.spin_until(lambda: '3 taken' in bench.value('input base_wrench'), 'the readings')
    assert bench.push() > 0.5
    assert bench.value('stops latched') == '0'


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
def test_a_reading_that_does_not_count_is_not_taken_in(
    ros_graph: RosGraph, send: Callable[..., Any], topic: str, kind: str
) -> None:
    """It is counted by its kind; the observer hears nothing of it and the motion goes on."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    send(bench)
    ros_graph.spin_until(lambda: f'1 {kind}' in bench.value(f'input {topic}'), 'the refusal')
    assert '0 taken' in bench.value(f'input {topic}')
    assert bench.controller._supervisor.bending.observer.refused == 0
    assert bench.push() > 0.5


def test_it_goes_on_without_sensors_that_fall_silent(ros_graph: RosGraph) -> None:
    """Diagnostics warn for as long as they are; the force stays."""
    bench = Bench(ros_graph, **{'safety.sensor_timeout': 0.3, 'safety.tracking_error': 1.0})
    bench.aim(0.1)
    depth = 0.02

    def stale() -> bool:
        bench.measure(depth)
        return 'base_wrench is stale' in bench.said() and 'tip_deflection' in bench.said()

    ros_graph.spin_until(stale, 'the warning')
    assert bench.controller.diagnose()[0] == DiagnosticStatus.WARN
    assert bench.measure(depth) > 0.5

    def well() -> bool:
        bench.wrench()
        bench.tip(0.0)
        bench.measure(depth)
        return bench.said() == 'active'

    ros_graph.spin_until(well, 'the end of the warning')
    assert bench.measure(depth) > 0.5


def test_it_stops_for_want_of_sensors_if_they_are_required(ros_graph: RosGraph) -> None:
    """A parameter makes of the warning a stop."""
    bench = Bench(
        ros_graph,
        **{
            'safety.sensor_timeout': 0.3,
            'safety.sensors_required': True,
            'safety.tracking_error': 1.0,
        },
    )
    bench.aim(0.1)
    assert bench.push() > 0.5
    ros_graph.spin_until(lambda: bench.measure(0.02) == 0.0, 'the stop')
    assert 'is stale' in bench.value('stop')
    assert 'is stale' in bench.call('clear_stop').message


def test_two_that_command_both_let_go(ros_graph: RosGraph) -> None:
    """While another node publishes the same topic the answer is zero; alone again it goes on."""
    bench = Bench(ros_graph, **{'safety.tracking_error': 1.0})
    bench.aim(0.1)
    assert bench.push() > 0.5
    rival = bench.node.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    ros_graph.spin_until(lambda: bench.measure(0.02) == 0.0, 'zero force')
    assert bench.said() == '2 nodes publish wrench_command'
    assert bench.controller.diagnose()[0] == DiagnosticStatus.WARN
    bench.node.destroy_publisher(rival)
    assert bench.push() > 0.5


def test_commands_carry_the_stamp_of_what_they_answer(ros_graph: RosGraph) -> None:
    """A measurement that comes again is answered as before; what answers nothing is of now."""
    bench = Bench(ros_graph, measurement_timeout=1.0)
    bench.aim(0.1)
    force, stamp = bench.push(), bench.commands[-1].header.stamp
    again = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    again.header.stamp = stamp
    assert bench.ask(again) == force
    assert '1 repeated' in bench.value('input joint_states')
    # The watchdog answers nothing.
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    last = bench.commands[-1].header.stamp
    assert (last.sec, last.nanosec) > (stamp.sec, stamp.nanosec)


def test_a_measurement_that_comes_again_after_a_stop_is_answered_with_none(
    ros_graph: RosGraph,
) -> None:
    """The stop was the last word, not the force before it."""
    bench = Bench(ros_graph, measurement_timeout=5.0)
    bench.aim(0.1)
    assert bench.push() > 0.5
    stamp = bench.commands[-1].header.stamp
    assert bench.call('emergency_stop').success
    again = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    again.header.stamp = stamp
    assert bench.ask(again) == 0.0


class SimulatedTime(Bench):
    """A bench whose clock is what the test makes it."""

    def __init__(self, graph: RosGraph, **parameters: Any) -> None:
        super().__init__(graph, use_sim_time=True, **parameters)
        self.clock = self.node.create_publisher(Clock, '/clock', 10)
        graph.spin_until(self.clock.get_subscription_count, 'the clock')
        self.set(0.0)

    def set(self, seconds: float) -> None:
        """Set the clock and wait until the controller has it."""
        self.time = round(seconds * 1e9)
        self.clock.publish(Clock(clock=self.now()))
        clock = self.controller.get_clock()
        self.graph.spin_until(lambda: clock.now().nanoseconds == self.time, 'the clock')

    def now(self) -> Time:
        return Time(sec=self.time // 10**9, nanosec=self.time % 10**9)

    def measure(self, depth: float, speed: float = 0.0) -> float:
        self.set((self.time + 5_000_000) / 1e9)
        return super().measure(depth, speed)


def test_a_simulation_that_starts_at_zero_is_answered(ros_graph: RosGraph) -> None:
    """Its first sample has a stamp of zero, and is one."""
    bench = SimulatedTime(ros_graph)
    message = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    assert bench.ask(message) == 0.0
    assert bench.value('measurements answered') == '1'
    bench.aim(0.1)
    assert bench.push() > 0.5


def test_a_clock_that_is_set_back_starts_the_motion_anew(ros_graph: RosGraph) -> None:
    """It lets go, and the next sample is answered again, though older than those before."""
    bench = SimulatedTime(ros_graph)
    bench.set(100.0)
    bench.aim(0.1)
    assert bench.push() > 0.5
    bench.set(50.0)
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'clock went back by' in bench.said()
    assert bench.push() > 0.5
    assert bench.said() != 'not active'
    assert 'clock' not in bench.said()


def test_a_clock_that_jumps_ahead_is_a_gap(ros_graph: RosGraph) -> None:
    """The motion starts anew from where the needle is; nothing is faulty."""
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
    # Had it gone on, it would be at the target by now.
    assert aimed()[0].position[0] < 0.021
    assert 'continued after 1' in bench.value('last complaint')
    assert bench.value('stops latched') == '0'
    assert bench.value('target [m]') == '0.1'
    assert bench.push() > 0.5


def test_a_clock_that_stands_is_no_fault(ros_graph: RosGraph) -> None:
    """Paused, nothing is stale; the same sample again is answered with the same force."""
    bench = SimulatedTime(ros_graph)
    bench.set(100.0)
    bench.aim(0.1)
    force = bench.push()
    message = JointState(name=['insertion'], position=[0.02], velocity=[0.0])
    message.header.stamp = bench.now()
    start = monotonic()

    def repeated() -> bool:
        forces.add(bench.ask(message))
        # Three times the timeout, by the clock on the wall.
        return monotonic() - start > 0.3

    forces: set[float] = set()
    ros_graph.spin_until(repeated, 'a while')
    assert forces == {force}
    assert bench.push() > 0.5


@pytest.mark.parametrize(
    ('frame', 'stamp', 'reason'),
    [
        ('needle_base', Time(), "must be in frame '' or 'needle_entry', got 'needle_base'"),
        ('', Time(sec=5), 'target is stale: its stamp is'),
    ],
)
def test_a_target_of_another_frame_or_time_is_refused(
    ros_graph: RosGraph, frame: str, stamp: Time, reason: str
) -> None:
    """In one line; without frame and stamp it is meant as it is, and now."""
    bench = Bench(ros_graph)
    message = PointStamped()
    message.header.frame_id, message.header.stamp = frame, stamp
    message.point.y = 0.1
    bench.target.publish(message)
    ros_graph.spin_until(lambda: bench.value('inputs refused') == '1', 'the refusal')
    assert reason in bench.value('last complaint')
    assert bench.value('target [m]') == 'None'


def test_before_it_is_active_it_answers_and_waits(ros_graph: RosGraph) -> None:
    """Services say so, a target is refused, and a stop is kept for when it is active."""
    bench = Bench(ros_graph, start=False)
    assert bench.call('emergency_stop').success
    assert bench.controller.start()
    assert bench.controller.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert 'not active' in bench.call('pause', SetBool, data=True).message
    assert 'stopped' in bench.call('retract').message
    bench.target.publish(PointStamped())
    ros_graph.spin_until(
        lambda: 'target rejected: the controller is not active' in bench.value('last complaint'),
        'the refusal',
    )
    assert bench.controller.trigger_activate() == TransitionCallbackReturn.SUCCESS
    bench.target.publish(PointStamped())
    ros_graph.spin_until(
        lambda: 'target rejected: stopped: emergency stop' in bench.value('last complaint'),
        'the rejection',
    )
    assert [bench.measure(0.02) for _ in range(5)] == [0.0] * 5
    assert bench.value('stop') == 'emergency stop'
    assert bench.call('clear_stop').success
    assert bench.call('clear_stop').message == 'there was no stop'
    bench.aim(0.1)
    assert bench.push() > 0.5


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
def test_no_joint_state_raises(ros_graph: RosGraph, message: JointState) -> None:
    """Whatever its fields are: zero force with its stamp, and the next good one is answered."""
    bench = Bench(ros_graph, measurement_timeout=5.0)
    bench.aim(0.1)
    assert bench.push() > 0.5
    message.header.stamp = bench.now()
    assert bench.ask(message) == 0.0
    assert bench.value('stop') == ''
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
def test_no_ground_truth_raises(ros_graph: RosGraph, message: JointState) -> None:
    """A truth of a wrong length, not finite or of a needle that is none is not taken in."""
    bench = Bench(ros_graph, deflection_feedback='ground_truth')
    truths = bench.node.create_publisher(JointState, 'ground_truth', SENSOR)
    ros_graph.spin_until(truths.get_subscription_count, 'discovery')
    bench.aim(0.1)
    message.header.stamp = bench.now()
    truths.publish(message)
    ros_graph.spin_until(lambda: bench.value('input ground_truth'), 'the truth')
    assert bench.controller._supervisor.bending.load == 0.0
    assert bench.push() > 0.5


def test_diagnostics_tell_rates_and_saturation(ros_graph: RosGraph) -> None:
    """Of each input in the last second, and how long the force was all there is."""
    bench = SimulatedTime(ros_graph, force_limit=0.7, **{'safety.tracking_error': 0.1})
    bench.aim(0.1)

    def saturated() -> bool | float:
        bench.measure(0.02)
        seen = float(bench.value('input joint_states').split()[0])
        return seen and bench.value('share of commands at their limit') == '1.000'

    ros_graph.spin_until(saturated, 'a second at the limit')
    # One each 5 ms; one more where a measurement had to be said again.
    assert float(bench.value('commands per second')) == pytest.approx(200.0, abs=1.0)
    assert float(bench.value('input joint_states').split()[0]) == pytest.approx(200.0, abs=5.0)
