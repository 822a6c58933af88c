"""A plant and a controller as processes, ours or bare, and the node that watches them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
import subprocess
import sys
import time
from typing import Any, Final, TypeAlias

from geometry_msgs.msg import PointStamped
from needle_insertion.experiment.node_process import GraphError
from needle_insertion.experiment.ros_graph import ACTIVATE, CONFIGURE, DEACTIVATE, Graph
from needle_ros.base_node import COMMAND, LATCHED
from needle_ros.timing import nanoseconds
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool

#: Figures of one turn by name.
Figures: TypeAlias = dict[str, float]

#: Time of arrival and time stamp of each message [ns], by topic.
Seen: TypeAlias = Mapping[str, list[tuple[int, int]]]

#: Executors of the pairs of bare nodes, by name.
_BARE: Final = {'bare': 'events', 'bare, usual executor': 'single'}

#: Parameters of our plants, by name of the pair: the needle of the paper, and one that bends.
_OURS: Final[Mapping[str, dict[str, object]]] = {
    'needle': {},
    'needle, steered': {
        'steered': True,
        'model.preset': 'bending_35mm',
        'steering.bevel_load': [0.3],
    },
}

#: Names of the pairs; the first is that of this package.
PAIRS: Final = ('needle', *_BARE, 'needle, steered')

#: Roles of the bare nodes that stand for a plant and a controller.
_ROLES: Final = {'plant': 'plant', 'controller': 'echo'}

#: Target depths, which keep the needle moving [m].
TARGETS: Final = (0.06, 0.09)

#: Time at the start of a turn that does not count [s].
_SETTLE: Final = 0.5


def cpu_seconds(process: int) -> float:
    """
    Return the CPU time of a process: all threads, user and system.

    Parameters
    ----------
    process : int
        Process id.

    Returns
    -------
    float
        CPU time [s].

    """
    # The clock of clock_getcpuclockid(3): /proc/PID/stat has a resolution of only 10 ms.
    return time.clock_gettime(~process << 3 | 2)


class Pair:
    """
    A plant and a controller as processes, and the node that watches them.

    Parameters
    ----------
    name : str
        One of `PAIRS`.
    graph : Graph
        Graph of the processes and the node.

    Attributes
    ----------
    node : rclpy.node.Node
        Node in this process that watches.
    pids : dict[str, int]
        Process ids of ``plant`` and ``controller``.

    """

    def __init__(self, name: str, graph: Graph) -> None:
        self.graph = graph
        self.node = graph.node(f'watch_{PAIRS.index(name)}')
        self.pids: dict[str, int] = {}
        self._kill: dict[str, Callable[[], None]] = {}
        self._bare: list[subprocess.Popen[bytes]] = []
        self._executor = _BARE.get(name)
        self._plant = _OURS.get(name, {})
        self._run = self.node.create_publisher(Bool, 'run', LATCHED)
        self._target = self.node.create_publisher(PointStamped, 'target', COMMAND)
        self._targets = 0

    def start(self, what: str) -> None:
        """
        Start a process.

        Parameters
        ----------
        what : str
            ``plant`` or ``controller``.

        """
        if self._executor is None:
            given = self._plant if what == 'plant' else {}
            node = self.graph.start(what, {'autostart': False, **given})
            self.pids[what], self._kill[what] = node.process.pid, node.kill
        else:
            bare = self.start_bare(_ROLES[what], self._executor)
            self.pids[what], self._kill[what] = bare.pid, partial(self._kill_bare, bare)

    def kill(self, what: str) -> None:
        """
        Kill a process: it does not take part any more.

        Parameters
        ----------
        what : str
            ``plant`` or ``controller``.

        """
        self._kill.pop(what)()
        del self.pids[what]

    def _kill_bare(self, process: subprocess.Popen[bytes]) -> None:
        self._bare.remove(process)
        process.kill()
        process.communicate()

    def start_bare(self, role: str, executor: str = 'events') -> subprocess.Popen[bytes]:
        """
        Start a bare node.

        Parameters
        ----------
        role, executor : str
            Arguments of `benchmarks.bare.main`.

        Returns
        -------
        Popen
            The process. What it prints can be read from its ``stdout``.

        """
        process = subprocess.Popen(
            [sys.executable, '-m', 'benchmarks.bare', role, executor],
            env=self.graph.environment,
            stdout=subprocess.PIPE,
        )
        self._bare.append(process)
        return process

    def ready(self, what: str) -> None:
        """
        Wait until a process that was started is ready.

        Parameters
        ----------
        what : str
            ``plant`` or ``controller``.

        """
        if self._executor is None:
            self.graph.change(self.node, what, CONFIGURE)
            if what == 'controller':
                self.graph.change(self.node, what, ACTIVATE)
        topic = {'plant': 'joint_states', 'controller': 'wrench_command'}[what]
        self.until(lambda: self.node.count_publishers(topic), topic)

    def end(self) -> None:
        """End the bare nodes; the graph ends the others."""
        for process in self._bare:
            process.kill()
        for process in self._bare:
            process.wait()
            if process.stdout is not None:
                process.stdout.close()

    def until(self, condition: Callable[[], Any], what: str, timeout: float = 120.0) -> None:
        """
        Spin until a condition holds.

        Parameters
        ----------
        condition : callable
            Returns whether it holds.
        what : str
            What is waited for, for the message of the error.
        timeout : float
            Longest time to wait [s].

        Raises
        ------
        GraphError
            If the condition does not hold in time, or a process has ended.

        """

        def holds() -> Any:
            ended = [p.args for p in self._bare if p.poll() is not None]
            if ended:
                raise GraphError(f'a bare node ended early: {ended}')
            return condition()

        self.graph.spin_until(holds, what, timeout)

    def spin(self, duration: float) -> None:
        """
        Spin for some time.

        Parameters
        ----------
        duration : float
            Time [s].

        """
        end = time.monotonic() + duration
        self.until(lambda: time.monotonic() >= end, 'the end', duration + 30.0)

    @contextmanager
    def running(self) -> Iterator[None]:
        """
        Let the plant run within a ``with`` statement.

        Yields
        ------
        None

        """
        if self._executor is None:
            self.graph.change(self.node, 'plant', ACTIVATE)
        else:
            self.run_bare(True)
        yield
        if self._executor is None:
            self.graph.change(self.node, 'plant', DEACTIVATE)
        else:
            self.run_bare(False)

    def run_bare(self, run: bool) -> None:
        """
        Let the bare nodes run or stop.

        Parameters
        ----------
        run : bool
            Whether they run.

        """
        self._run.publish(Bool(data=run))

    def aim(self, depth: float | None = None) -> None:
        """
        Send a target to the controller.

        Parameters
        ----------
        depth : float, optional
            Target depth [m]; the next of `TARGETS` if not given.

        """
        target = PointStamped()
        target.point.y = TARGETS[self._targets % len(TARGETS)] if depth is None else depth
        self._targets += 1
        self._target.publish(target)

    @contextmanager
    def watching(self, topics: Mapping[str, tuple[type, QoSProfile]]) -> Iterator[Seen]:
        """
        Note the messages of some topics within a ``with`` statement.

        Parameters
        ----------
        topics : Mapping[str, tuple]
            Type and quality of service by topic.

        Yields
        ------
        Seen
            Grows with each message.

        """
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
        Measure the CPU time of the processes after half a second to settle.

        Parameters
        ----------
        duration : float
            Time of the measurement [s].
        seen : Seen
            Messages from `watching`; only those of the measurement are left.

        Returns
        -------
        Figures
            Share of one core that each process takes [%].

        """
        self.until(lambda: all(seen.values()), f'{", ".join(seen)}')
        self.spin(_SETTLE)
        for rows in seen.values():
            rows.clear()
        spent = {what: cpu_seconds(pid) for what, pid in self.pids.items()}
        begin = time.monotonic()
        self.spin(duration)
        wall = time.monotonic() - begin
        return {
            f'CPU of the {what} [%]': 100.0 * (cpu_seconds(pid) - spent[what]) / wall
            for what, pid in self.pids.items()
        }
