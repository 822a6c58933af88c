"""A run of the simulated nodes whose course depends on simulated time only, on any machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from needle_identification.recorder_node import is_hidden
from needle_insertion.experiment.node_process import GraphError
from needle_insertion.experiment.progress import Show
from needle_insertion.experiment.ros_graph import ACTIVATE, CONFIGURE, Graph
from needle_ros import contract
from needle_ros.base_node import COMMAND, profile, SENSOR
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reader
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

#: Longest time in which a message arrives, on a busy machine [s].
_ARRIVAL: Final = Duration(seconds=30.0)

#: Longest time without a sample, on a busy machine [s].
_STALL: Final = 60.0


class Sample(NamedTuple):
    """
    A sample of the plant.

    Attributes
    ----------
    stamp : int
        Its stamp [ns].
    time : float
        Time since the first one [s].
    depth : float
        Insertion depth [m].

    """

    stamp: int
    time: float
    depth: float


class SimulatedRun:
    """
    Starts nodes and a plant, acts at samples of the plant, and records everything.

    In lock-step the plant waits at each sample until it has been acted upon and all messages of
    that have arrived: whatever is sent arrives at the same sample on any machine.

    Parameters
    ----------
    graph : Graph
        The graph.
    show : callable
        Shows the progress.
    lockstep : bool
        Whether the plant runs in lock-step; else in real time.

    Attributes
    ----------
    node : Node
        Node of this process.
    values : dict
        Values that each node published last on /diagnostics, by its name; its message is that
        of the empty name.

    """

    def __init__(self, graph: Graph, show: Show, *, lockstep: bool = True) -> None:
        self._graph, self._show, self._lockstep = graph, show, lockstep
        self.node = node = graph.node('demo')
        self.values: dict[str, dict[str, str]] = {}
        self._read = Reader(contract.JOINT_STATES.type_name).read
        self._act: Callable[[Sample], bool] | None = None
        self._first = self._last = 0
        kind = contract.PROCESSED
        self._processed: Publisher | None = None
        if lockstep:
            self._processed = node.create_publisher(Header, kind.name, profile(kind.qos))
        node.create_subscription(DiagnosticArray, contract.DIAGNOSTICS.name, self._hear, 10)
        self._samples = node.create_subscription(
            JointState, contract.JOINT_STATES.name, self._on_sample, SENSOR, raw=True
        )

    def publisher(self, kind: type, topic: str) -> Callable[[Any], None]:
        """
        Offer a topic.

        Parameters
        ----------
        kind : type
            Message type.
        topic : str
            Its name.

        Returns
        -------
        callable
            Publishes a message and waits until it has arrived everywhere.

        """
        publisher = self.node.create_publisher(kind, topic, COMMAND)

        def publish(message: Any) -> None:
            publisher.publish(message)
            if not publisher.wait_for_all_acked(_ARRIVAL):
                raise GraphError(f'{topic} did not arrive')

        return publish

    def record(
        self,
        bag: Path,
        nodes: Mapping[str, Mapping[str, object]],
        act: Callable[[Sample], bool],
    ) -> None:
        """
        Run the nodes until there is nothing more to do.

        Parameters
        ----------
        bag : Path
            Bag to write.
        nodes : mapping
            Parameters of each node by its name, the plant last.
        act : callable
            Called with each sample; returns whether to go on.

        Raises
        ------
        GraphError
            If a node fails.

        """
        graph, node = self._graph, self.node
        started = [graph.start('recorder', {'path': str(bag)})]
        time = {'use_sim_time': True} if self._lockstep else {}
        for name, parameters in nodes.items():
            own = {'autostart': False, 'lockstep': self._lockstep} if name == 'plant' else time
            started.append(graph.start(name, {**parameters, **own}))
        for one in started[:-1]:
            graph.wait_active(node, one.name, self._show_start)
        self._show('starting plant')
        graph.change(node, 'plant', CONFIGURE)
        # The bag has every sample, and every sample is waited for.
        participants = str(self._lockstep + ('steering' in nodes and self._lockstep))
        graph.spin_until(
            lambda: (
                self._samples.get_publisher_count()
                and self._is_recorded()
                and self.values.get('plant', {}).get('nodes in lock-step') == participants
            ),
            'the recorder and the nodes in lock-step',
        )
        self._act = act
        graph.change(node, 'plant', ACTIVATE)
        graph.spin_until(lambda: self._act is None, 'the next sample', _STALL, lambda: self._last)
        for one in started:
            one.interrupt()

    def _show_start(self, name: str) -> None:
        """Show that a node starts, and what it reports meanwhile."""
        said = self.values.get(name, {}).get('', '')
        self._show(f'starting {name}' + (f': {said}' if said else ''))

    def _is_recorded(self) -> bool:
        """Return whether the recorder has subscribed to all topics."""
        node = self.node
        return all(
            'recorder' in [one.node_name for one in node.get_subscriptions_info_by_topic(topic)]
            for topic, _ in node.get_topic_names_and_types()
            if node.count_publishers(topic) and not is_hidden(topic)
        )

    def _hear(self, array: DiagnosticArray) -> None:
        for status in array.status:
            values = {one.key: one.value for one in status.values}
            self.values[status.name.rpartition('/')[2]] = {**values, '': status.message}

    def _on_sample(self, data: bytes) -> None:
        """Act at a sample, and let the plant go on."""
        if self._act is None:
            return
        reading = self._read(data)
        stamp = reading.stamp
        if stamp != self._last:
            self._first, self._last = self._first or stamp, stamp
            time = (stamp - self._first) / NANOSECONDS
            if not self._act(Sample(stamp, time, reading.values[0][0])):
                self._act = None
                return
        if self._processed is not None:
            message = Header(frame_id=self.node.get_fully_qualified_name())
            message.stamp.sec, message.stamp.nanosec = divmod(stamp, NANOSECONDS)
            self._processed.publish(message)
