"""Nodes that nobody asked for: what they command, and what they measure, moves nothing."""

from __future__ import annotations

from collections.abc import Callable
import subprocess
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from needle_ros.base_node import COMMAND, SENSOR
import pytest
from sensor_msgs.msg import JointState
from support.ros_graph import RosGraph

#: Tries of each stranger.
TRIES = 5

#: Comes, pushes for 6 to 48 ms, or for 80 ms from its first breath, and goes, again and again.
PUSHER = """
import sys, time
from geometry_msgs.msg import WrenchStamped
from needle_ros.base_node import COMMAND
import rclpy
force, waits, tries = float(sys.argv[1]), sys.argv[2] == 'found', int(sys.argv[3])
rclpy.init()
node = rclpy.create_node('stranger')
push, found = WrenchStamped(), 0
push.wrench.force.y = force
for k in range(tries):
    publisher = node.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
    deadline = time.monotonic() + 10.0
    while waits and not publisher.get_subscription_count() and time.monotonic() < deadline:
        time.sleep(1e-4)
    end = time.monotonic() + ((6 + 42 * k / (tries - 1)) * 1e-3 if waits else 0.08)
    while time.monotonic() < end:
        push.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(push)
    found += bool(publisher.get_subscription_count())
    node.destroy_publisher(publisher)
    time.sleep(0.4)
print(found)
"""

#: Says for 2 s that the needle is 5 mm deeper, with stamps that are ahead or not.
LIAR = """
import sys, time
from needle_ros.base_node import SENSOR
import rclpy
from rclpy.duration import Duration
from sensor_msgs.msg import JointState
ahead = Duration(seconds=float(sys.argv[1]))
rclpy.init()
node = rclpy.create_node('liar')
publisher = node.create_publisher(JointState, 'joint_states', SENSOR)
lie = JointState(name=['insertion', 'rotation'], velocity=[0.0, 0.0], effort=[0.0, 0.0])
found, end = 0, time.monotonic() + 2.0
while time.monotonic() < end:
    lie.header.stamp = (node.get_clock().now() + ahead).to_msg()
    lie.position = [0.045, 0.0]
    publisher.publish(lie)
    found = max(found, publisher.get_subscription_count())
    time.sleep(5e-4)
print(found)
"""


class Bystander:
    """Watches a plant and a controller, each a process, and sets targets."""

    def __init__(self, graph: RosGraph) -> None:
        self._graph, self.depths = graph, list[float]()
        self._probe = probe = graph.node('bystander')
        probe.create_subscription(JointState, 'ground_truth', self._on_truth, SENSOR)
        self._targets = probe.create_publisher(PointStamped, 'target', COMMAND)
        self._health = graph.listen(probe, DiagnosticArray, '/diagnostics', 10)
        graph.start('plant')
        graph.start('controller')
        self.goes_to(0.04)

    def _on_truth(self, message: JointState) -> None:
        self.depths.append(0.2 - message.position[0])

    def until(self, condition: Callable[[], Any], what: str) -> None:
        self._graph.spin_until(condition, what, timeout=60.0)

    def goes_to(self, depth: float) -> None:
        """Ask for a depth until the needle rests there."""
        target = PointStamped()
        target.point.y = depth

        def rests() -> bool:
            self._targets.publish(target)
            there = self.depths[-500:]
            return len(there) == 500 and max(abs(one - depth) for one in there) < 2e-4

        self.until(rests, f'{depth} m')

    def endures(self, script: str, *arguments: object) -> tuple[int, float]:
        """Let a stranger in; return how often it was connected, and how far the needle moved."""
        self.depths.clear()
        stranger = subprocess.Popen(
            [sys.executable, '-c', script, *map(str, arguments)],
            env=self._graph.environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.until(lambda: stranger.poll() is not None, 'the end of the stranger')
        said, _ = stranger.communicate()
        return int(said), max(self.depths) - min(self.depths)

    def was_told(self, what: str) -> bool:
        return any(what in status.message for one in self._health for status in one.status)

    @property
    def stops(self) -> list[str]:
        """Return how many stops the controller has latched, as often as it says so."""
        statuses = (status for one in self._health for status in one.status)
        values = ({one.key: one.value for one in status.values} for status in statuses)
        return [one['stops latched'] for one in values if 'stops latched' in one]


@pytest.mark.parametrize('when', ['found', 'blind'])
@pytest.mark.parametrize('force', [900.0, 14.0])
def test_a_second_commander_moves_nothing(ros_graph: RosGraph, force: float, when: str) -> None:
    """Whatever it asks for and however short it lives; the first goes on when it is alone."""
    bystander = Bystander(ros_graph)
    found, moved = bystander.endures(PUSHER, force, when, TRIES)
    assert found > 0
    # At 14 N the needle would go 2 mm in 48 ms.
    assert moved < 1e-3
    assert bystander.was_told('2 nodes command')
    bystander.goes_to(0.045)
    assert set(bystander.stops) == {'0'}


@pytest.mark.parametrize('ahead', [0.0, 0.09])
def test_a_second_robot_moves_nothing(ros_graph: RosGraph, ahead: float) -> None:
    """What it measures is nobody's needle; its stamps do not make those of the first late."""
    bystander = Bystander(ros_graph)
    found, moved = bystander.endures(LIAR, ahead)
    assert found > 0
    assert moved < 1e-3
    assert bystander.was_told('2 nodes publish joint_states')
    bystander.goes_to(0.045)
    assert set(bystander.stops) == {'0'}
