# SPDX-License-Identifier: Apache-2.0
"""Run a plant and a controller as processes, of this package or bare, and measure them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
import subprocess
import sys
import time
from typing import Any, Final, TypeAlias

from geometry_msgs.msg import PointStamped
from needle_insertion.graph.ros_graph import ACTIVATE, CONFIGURE, DEACTIVATE, Graph, GraphError
from needle_ros.base_node import COMMAND, LATCHED
from needle_ros.timing import nanoseconds
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool

#: Metrics of one turn by name.
Figures: TypeAlias = dict[str, float]

#: Time of arrival and time stamp of each message [ns], by topic.
Seen: TypeAlias = Mapping[str, list[tuple[int, int]]]

#: Messages of the pairs of bare nodes, by name.
_BARE: Final = {'bare': 'objects', 'bare, bytes': 'bytes'}

#: Parameters of the plants by name of the pair: the needle of the paper, and a flexible needle.
_OURS: Final[Mapping[str, dict[str, object]]] = {
    'needle': {},
    'needle, steered': {'steered': True, 'needle': 'bending_35mm', 'steering.bevel_load': [0.3]},
}

#: Names of the pairs; the first is the pair of this package.
PAIRS: Final = ('needle', *_BARE, 'needle, steered')

#: Roles of the bare nodes in place of plant and controller.
_ROLES: Final = {'plant': 'plant', 'controller': 'echo'}

#: A topic that each publishes.
_TOPICS: Final = {'plant': 'joint_states', 'controller': 'wrench_command'}

#: Target depths of continuous motion [m].
TARGETS: Final = (0.06, 0.09)

#: Settling time at the start of a turn [s].
_SETTLE: Final = 0.5

#: Least number of messages of each topic in a turn.
_FEWEST: Final = 10


def cpu_seconds(process: int) -> float:
    """Return the CPU time of a process [s]: all threads, user and system."""
    # The clock of clock_getcpuclockid(3): /proc/PID/stat has a resolution of only 10 ms.
    return time.clock_gettime(~process << 3 | 2)


class Pair:
    """
    A plant and a controller as processes, and a measuring node in this process.

    `parameters` are parameters of both nodes of this package.

    Attributes
    ----------
    node : rclpy.node.Node
        Measuring node.
    pids : dict[str, int]
        Process ids of ``plant`` and ``controller``.

    """

    def __init__(self, name: str, graph: Graph, **parameters: object) -> None:
        self.graph, self._parameters = graph, parameters
        self.node = graph.node(f'watch_{PAIRS.index(name)}')
        self.pids: dict[str, int] = {}
        self._kill: dict[str, Callable[[], None]] = {}
        self._bare: list[subprocess.Popen[bytes]] = []
        self._kind = _BARE.get(name)
        self._plant = _OURS.get(name, {})
        self._run = self.node.create_publisher(Bool, 'run', LATCHED)
        self._target = self.node.create_publisher(PointStamped, 'target', COMMAND)
        self._targets = 0

    def start(self, what: str) -> None:
        """Start ``plant`` or ``controller``."""
        if self._kind is None:
            given = self._plant if what == 'plant' else {}
            node = self.graph.start(what, {'autostart': False, **self._parameters, **given})
            self.pids[what], self._kill[what] = node.process.pid, node.kill
        else:
            bare = self.start_bare(_ROLES[what], self._kind)
            self.pids[what], self._kill[what] = bare.pid, partial(self._kill_bare, bare)

    def kill(self, what: str) -> None:
        """Kill ``plant`` or ``controller``."""
        self._kill.pop(what)()
        del self.pids[what]

    def _kill_bare(self, process: subprocess.Popen[bytes]) -> None:
        self._bare.remove(process)
        process.kill()
        process.communicate()

    def start_bare(self, role: str, kind: str = 'objects') -> subprocess.Popen[bytes]:
        """Start a bare node by `benchmarks.bare.main`; its output is in ``stdout``."""
        process = subprocess.Popen(
            [sys.executable, '-m', 'benchmarks.bare', role, kind],
            env=self.graph.environment,
            stdout=subprocess.PIPE,
        )
        self._bare.append(process)
        return process

    def ready(self, what: str) -> None:
        """Wait until ``plant`` or ``controller`` is ready."""
        if self._kind is None:
            self.graph.change(self.node, what, CONFIGURE)
            if what == 'controller':
                self.graph.change(self.node, what, ACTIVATE)
        self.until(lambda: self.node.count_publishers(_TOPICS[what]), _TOPICS[what])

    def wait_for_end(self, what: str) -> None:
        """Wait until the publishers of a killed ``plant`` or ``controller`` are gone."""
        topic = _TOPICS[what]
        self.until(lambda: not self.node.count_publishers(topic), f'the end of {topic}')

    def end(self) -> None:
        """Terminate the bare nodes; the graph terminates the others."""
        for process in self._bare:
            process.kill()
        for process in self._bare:
            process.wait()
            if process.stdout is not None:
                process.stdout.close()

    def until(self, condition: Callable[[], Any], what: str, timeout: float = 120.0) -> None:
        """Spin until a condition holds; raise a GraphError after a timeout [s] or a crash."""

        def holds() -> Any:
            ended = [p.args for p in self._bare if p.poll() is not None]
            if ended:
                raise GraphError(f'a bare node ended early: {ended}')
            return condition()

        self.graph.spin_until(holds, what, timeout)

    def spin(self, duration: float) -> None:
        """Spin for a duration [s]."""
        end = time.monotonic() + duration
        self.until(lambda: time.monotonic() >= end, 'the end', duration + 30.0)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Run the plant within a ``with`` statement."""
        if self._kind is None:
            self.graph.change(self.node, 'plant', ACTIVATE)
        else:
            self.run_bare(True)
        yield
        if self._kind is None:
            self.graph.change(self.node, 'plant', DEACTIVATE)
        else:
            self.run_bare(False)

    def run_bare(self, run: bool) -> None:
        """Start or stop the bare nodes."""
        self._run.publish(Bool(data=run))

    def aim(self, depth: float | None = None) -> None:
        """Send a target depth [m] to the controller, by default the next of `TARGETS`."""
        target = PointStamped()
        target.point.y = TARGETS[self._targets % len(TARGETS)] if depth is None else depth
        self._targets += 1
        self._target.publish(target)

    @contextmanager
    def watching(self, topics: Mapping[str, tuple[type, QoSProfile]]) -> Iterator[Seen]:
        """Record the messages of topics (type, QoS) within a ``with`` statement."""
        seen: Seen = {topic: [] for topic in topics}

        def note(rows: list[tuple[int, int]], message: Any) -> None:
            rows.append((time.time_ns(), nanoseconds(message.header.stamp)))

        subscriptions = [
            self.node.create_subscription(kind, topic, partial(note, seen[topic]), qos)
            for topic, (kind, qos) in topics.items()
        ]
        yield seen
        for subscription in subscriptions:
            self.node.destroy_subscription(subscription)

    def measure(self, duration: float, seen: Seen) -> Figures:
        """
        Measure the CPU load of each process for a duration [s], in % of one core, after settling.

        Only messages of the measurement remain in `seen`; it lasts until each topic has some.
        """
        self.until(lambda: all(seen.values()), f'{", ".join(seen)}')
        self.spin(_SETTLE)
        for rows in seen.values():
            rows.clear()
        spent = {what: cpu_seconds(pid) for what, pid in self.pids.items()}
        begin = time.monotonic()
        self.spin(duration)
        self.until(lambda: all(len(rows) >= _FEWEST for rows in seen.values()), 'enough messages')
        wall = time.monotonic() - begin
        return {
            f'CPU of the {what} [%]': 100.0 * (cpu_seconds(pid) - spent[what]) / wall
            for what, pid in self.pids.items()
        }
