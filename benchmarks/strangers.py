# SPDX-License-Identifier: Apache-2.0
"""Effect of unexpected publishers and killed nodes on a real plant and controller."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import signal
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Any, Final

from benchmarks.measure import Bar
from benchmarks.page import Tick
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from needle_insertion.graph.ros_graph import Graph, GraphError, NodeProcess
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.status import ControllerStatus, NodeReport, NodeStatus, read_reports
from sensor_msgs.msg import JointState

#: Publishes force commands repeatedly: for 6 to 48 ms, or for the first 80 ms after its start.
PUSHER: Final = """
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

#: Publishes false needle positions for a time after the first subscription, or until terminated,
#: with current or future stamps.
LIAR: Final = """
import signal, sys, time
import rclpy
from rclpy.duration import Duration
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
ahead, stay = Duration(seconds=float(sys.argv[1])), float(sys.argv[2])
rclpy.init()
told = []
signal.signal(signal.SIGTERM, lambda *_: told.append(True))
node = rclpy.create_node('liar')
publisher = node.create_publisher(JointState, 'joint_states', qos_profile_sensor_data)
lie = JointState(name=['insertion', 'rotation'], velocity=[0.0, 0.0], effort=[0.0, 0.0])
lie.position = [0.045, 0.0]
found, end = 0, time.monotonic() + 30.0
while time.monotonic() < end and not (told and found):
    lie.header.stamp = (node.get_clock().now() + ahead).to_msg()
    publisher.publish(lie)
    if not found and (found := publisher.get_subscription_count()):
        end = time.monotonic() + stay
    time.sleep(5e-4)
print(found)
"""

#: Publishes unreachable targets at the highest rate, for 2 s after the first subscription.
ASKER: Final = """
import time
from geometry_msgs.msg import PointStamped
from needle_ros.base_node import COMMAND
import rclpy
rclpy.init()
node = rclpy.create_node('asker')
publisher = node.create_publisher(PointStamped, 'target', COMMAND)
wish = PointStamped()
wish.point.y = 9.0
found, end = 0, time.monotonic() + 30.0
while time.monotonic() < end:
    publisher.publish(wish)
    if not found and (found := publisher.get_subscription_count()):
        end = time.monotonic() + 2.0
print(found)
"""

#: Depth before a disturbance, target depth after it, and its tolerance [m].
START, NEXT, NEAR = 0.04, 0.045, 2e-4


class Bystander:
    """
    Observes a plant and a controller, each a process, and sets targets.

    Attributes
    ----------
    plant, controller : NodeProcess
        The processes.
    depths : list of float
        True insertion depths since the start of the last disturbance [m].

    """

    def __init__(self, graph: Graph) -> None:
        self._graph, self.depths = graph, list[float]()
        self._health: list[DiagnosticArray] = []
        #: Statuses of the messages parsed so far, and number of these messages.
        self._reports: list[NodeReport] = []
        self._parsed = 0
        probe = graph.node('bystander')
        probe.create_subscription(JointState, 'ground_truth', self._on_truth, SENSOR)
        probe.create_subscription(DiagnosticArray, '/diagnostics', self._health.append, 10)
        self._targets = probe.create_publisher(PointStamped, 'target', COMMAND)
        self.plant, self.controller = graph.start('plant'), graph.start('controller')
        self.goes_to(START)

    def _on_truth(self, message: JointState) -> None:
        self.depths.append(0.2 - message.position[0])

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until a condition holds; a `GraphError` also has depths and status of the nodes."""
        try:
            self._graph.spin_until(condition, what, timeout=180.0)
        except GraphError as error:
            depths = [f'{1e3 * act(self.depths):.3f}' for act in (min, max)] if self.depths else []
            raise GraphError(f'{error}; mm {" to ".join(depths)}; {self._complaints}') from error

    def goes_to(self, depth: float) -> None:
        """Send a target depth [m] until the needle rests there."""
        target = PointStamped()
        target.point.y = depth

        def rests() -> bool:
            self._targets.publish(target)
            there = self.depths[-500:]
            return len(there) == 500 and max(abs(one - depth) for one in there) < NEAR

        self.until(rests, f'{depth} m')

    def endures(
        self,
        script: str,
        *arguments: object,
        condition: Callable[[NodeStatus], bool] | None = None,
    ) -> tuple[int, float]:
        """
        Run the program of an unexpected node; end it once a status meets the condition, if given.

        Returns the number of connections, and the motion of the needle [m].
        """
        self.depths.clear()
        stranger = subprocess.Popen(
            [sys.executable, '-c', script, *map(str, arguments)],
            env=self._graph.environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        if condition is not None:
            self.until(
                lambda: self.reported(condition) or stranger.poll() is not None, 'the report'
            )
            stranger.terminate()
        self.until(lambda: stranger.poll() is not None, 'the end of the other node')
        said, _ = stranger.communicate()
        return int(said), self.moved

    @property
    def moved(self) -> float:
        """Motion of the needle since the start of the last disturbance [m]."""
        return max(self.depths) - min(self.depths)

    @property
    def _heard(self) -> list[NodeReport]:
        # Each message is parsed once: conditions are evaluated at every message of any topic.
        new = self._health[self._parsed :]
        self._parsed += len(new)
        self._reports += [one for array in new for one in read_reports(array)]
        return self._reports

    def reported(self, condition: Callable[[NodeStatus], bool]) -> bool:
        """Return whether any status met a condition."""
        return any(one.status is not None and condition(one.status) for one in self._heard)

    @property
    def _complaints(self) -> str:
        """Last message of each node."""
        last = {one.node: one.message for one in self._heard}
        return '; '.join(f'{name}: {message!r}' for name, message in last.items())

    @property
    def stops(self) -> set[int]:
        """Number of latched stops reported by the controllers."""
        found = [one.status for one in self._heard]
        return {one.stops for one in found if isinstance(one, ControllerStatus)}


def measure(tick: Tick, tries: int = 10) -> tuple[list[tuple[str, ...]], list[Bar]]:
    """Run unexpected nodes and kill nodes, several times each; return table rows and bars."""
    rows: list[tuple[str, ...]] = []
    bars: list[Bar] = []
    for what, bar, count, act in _trials(tries):
        tick(what)
        with TemporaryDirectory() as logs, Graph(Path(logs)) as graph:
            bystander = Bystander(graph)
            moved = afterwards = ''
            found = float('inf')
            try:
                found = 1e3 * act(graph, bystander)
                moved = f'{found:.3f} mm'
                bystander.goes_to(NEXT)
                afterwards = 'continues' if bystander.stops <= {0} else 'continues after a stop'
            except GraphError as error:
                afterwards = str(error)
        rows.append((what, str(count), moved, f'{bar:g} mm', afterwards))
        bars.append(Bar(what, found if afterwards == 'continues' else float('inf'), bar, 'mm'))
    return rows, bars


#: A trial: disturbance, largest motion of the needle [mm], repeats, and its function.
_Trial = tuple[str, float, int, Callable[[Graph, Bystander], float]]


def _trials(tries: int) -> list[_Trial]:
    """Return the trials. A killed controller leaves the motion unfinished."""
    pushers = [
        (
            f'{force:g} N from a second commander, {words}',
            1.0,
            tries,
            _visit(PUSHER, force, when, tries),
        )
        for force in (900.0, 14.0)
        for when, words in (('found', 'for 6 to 48 ms'), ('blind', 'that lives for 80 ms'))
    ]
    liars = [
        (f'joint_states from a second robot{words}', 1.0, 1, _visit(LIAR, ahead, 2.0))
        for ahead, words in ((0.0, ''), (0.09, ', 90 ms ahead'))
    ]
    return [
        *pushers,
        *liars,
        ('targets out of reach, without a pause', 1.0, 1, _visit(ASKER)),
        ('the controller is killed in motion', 2.0, 1, _killed('controller', signal.SIGKILL)),
        ('the controller is frozen in motion', 2.0, 1, _killed('controller', signal.SIGSTOP)),
    ]


def _visit(script: str, *arguments: object) -> Callable[[Graph, Bystander], float]:
    def act(_graph: Graph, bystander: Bystander) -> float:
        found, moved = bystander.endures(script, *arguments)
        return moved if found else float('inf')

    return act


def _killed(name: str, how: signal.Signals) -> Callable[[Graph, Bystander], float]:
    """Return a function that kills a node in motion and starts a new one."""

    def act(graph: Graph, bystander: Bystander) -> float:
        target = PointStamped()
        target.point.y = 0.1
        victim: NodeProcess = getattr(bystander, name)

        def moves() -> bool:
            bystander._targets.publish(target)
            return bystander.depths[-1] > START + 5e-3

        bystander.until(moves, 'motion')
        if how == signal.SIGKILL:
            victim.kill()
        else:
            victim.process.send_signal(how)
        bystander.depths.clear()
        bystander.until(lambda: len(bystander.depths) > 1500, 'a second and a half')
        moved = bystander.moved
        victim.kill()
        graph.start(name)
        return moved

    return act
