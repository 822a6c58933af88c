"""The controller as the graph sees it, alone and around the plant."""

from math import nan

from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_controller.controller_node import ControllerNode
from needle_dynamics.base_node import COMMAND, SENSOR
from needle_dynamics.plant_node import PlantNode
import pytest
from rclpy.duration import Duration
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

#: Both nodes in the test's own thread.
SLOW = {'rate': 200.0}


class Bench:
    """A controller with a probe that plays the plant."""

    def __init__(self, graph, **parameters):
        self.graph = graph
        self.node = graph.node('probe')
        self.states = self.node.create_publisher(JointState, 'joint_states', SENSOR)
        self.target = self.node.create_publisher(PointStamped, 'target', COMMAND)
        self.commands = graph.listen(self.node, WrenchStamped, 'wrench_command', COMMAND)
        self.controller = graph.add(ControllerNode, parameters={**SLOW, **parameters})
        graph.spin_until(
            lambda: (
                self.states.get_subscription_count()
                and self.target.get_subscription_count()
                and self.node.count_publishers('wrench_command')
            ),
            'discovery',
        )

    def measure(self, depth: float, speed: float = 0.0) -> float:
        """Publish a measurement and return the force that answers it."""
        message = JointState(name=['insertion'], position=[depth], velocity=[speed])
        message.header.stamp = self.node.get_clock().now().to_msg()
        count = len(self.commands)
        self.states.publish(message)
        self.graph.spin_until(lambda: len(self.commands) > count, 'an answer')
        return self.commands[-1].wrench.force.y

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


@pytest.mark.parametrize('law', ['inverse_dynamics', 'pid'])
@pytest.mark.parametrize('reference', ['trapezoid', 'minimum_jerk'])
def test_reaches_the_target(ros_graph, law, reference):
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


def test_no_force_before_a_target(ros_graph):
    """Measurements alone are answered with zero."""
    assert Bench(ros_graph).measure(0.02) == 0.0


def test_lets_go_when_measurements_stop(ros_graph):
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
def test_lets_go_of_a_measurement_it_cannot_use(ros_graph, message):
    """What is not finite, not complete or not the insertion joint is answered with zero force."""
    bench = Bench(ros_graph)
    bench.aim(0.1)
    assert bench.push() > 0.5
    message.header.stamp = bench.node.get_clock().now().to_msg()
    bench.states.publish(message)
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert 'joint_states' in bench.controller.diagnose()[1]


def test_an_emergency_stop_latches(ros_graph):
    """After a stop every answer is zero until it is cleared; then the motion starts anew."""
    bench = Bench(ros_graph)
    stop = bench.node.create_client(Trigger, 'controller/emergency_stop')
    clear = bench.node.create_client(Trigger, 'controller/clear_stop')
    ros_graph.spin_until(lambda: stop.service_is_ready() and clear.service_is_ready(), 'services')
    bench.aim(0.1)
    assert bench.push() > 0.5
    stopped = stop.call_async(Trigger.Request())
    ros_graph.spin_until(stopped.done, 'the stop')
    assert stopped.result().success
    assert [bench.measure(0.02) for _ in range(3)] == [0.0, 0.0, 0.0]
    cleared = clear.call_async(Trigger.Request())
    ros_graph.spin_until(cleared.done, 'the release')
    assert bench.push() > 0.5


def test_a_target_out_of_reach_is_refused(ros_graph):
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


def test_unstable_gains_refuse_the_transition(ros_graph):
    """Gains that cannot be stable leave the node unconfigured with the reason."""
    controller = ros_graph.add(
        ControllerNode, start=False, parameters={'inverse_dynamics.insertion.kv': 3000.0}
    )
    assert not controller.start()
    assert 'inverse_dynamics.insertion gains cannot be stable at 1000 Hz' in controller.failure
    assert not controller.is_active


def test_unstable_gains_end_the_process(ros_graph):
    """Run on its own it says so in one line and exits with 2."""
    controller = ros_graph.start('controller', {'inverse_dynamics.insertion.kv': 3000.0})
    assert controller.process.wait(30) == 2
    assert 'cannot be stable' in controller.last_words()


def test_parameters_cannot_change_while_configured(ros_graph):
    """A change that would not take effect is refused, with the way to make it."""
    controller = ros_graph.add(ControllerNode, parameters=SLOW)
    parameter = controller.get_parameter('law')
    result = controller.set_parameters([parameter])[0]
    assert not result.successful
    assert 'clean up the node first' in result.reason


@pytest.mark.parametrize('offset', [-10.0, 3600.0, None], ids=['old', 'ahead', 'not stamped'])
def test_lets_go_of_stamps_that_are_not_now(ros_graph, offset):
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


def test_forgets_the_target_when_the_needle_is_elsewhere_after_a_fault(ros_graph):
    """A needle that comes back at another depth is not pushed towards the old target."""
    bench = Bench(ros_graph, measurement_timeout=0.2)
    bench.aim(0.1)
    assert bench.push() > 0.5
    ros_graph.spin_until(lambda: bench.commands[-1].wrench.force.y == 0.0, 'zero force')
    assert [bench.measure(0.05) for _ in range(5)] == [0.0] * 5
    assert bench.controller.diagnose()[2]['target [m]'] is None


def test_configuring_again_doubles_nothing(ros_graph):
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
