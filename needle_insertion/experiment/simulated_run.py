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
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

#: Value of /diagnostics of a plant: number of nodes that it waits for.
IN_LOCKSTEP: Final = 'nodes in lock-step'

#: Longest time in which a message arrives, on a busy machine [s].
_ARRIVAL: Final = Duration(seconds=30.0)

#: Longest time without a sample, on a busy machine [s].
_STALL: Final = 60.0

#: Time between two checks whether the run has ended [s].
_CHECK: Final = 0.05


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


class Witness:
    """
    Acts at samples of a plant.

    A plant in lock-step waits at each sample until that has been done, and for good from the
    sample on at which there is nothing more to do until `release`.

    Parameters
    ----------
    node : Node
        Node of this process.
    act : callable
        Called with each sample; returns whether time goes on.
    lockstep : bool
        Whether the plant runs in lock-step.

    Attributes
    ----------
    stamp : int
        Stamp of the newest sample [ns].
    ended : bool
        Whether there is nothing more to do.

    """

    def __init__(self, node: Node, act: Callable[[Sample], bool], *, lockstep: bool) -> None:
        self._node, self._act = node, act
        self._first = self.stamp = 0
        self.ended = False
        topic = contract.JOINT_STATES
        self._read = Reader(topic.type_name).read
        self._processed: Publisher | None = None
        if lockstep:
            kind = contract.PROCESSED
            self._processed = node.create_publisher(Header, kind.name, profile(kind.qos))
        self._samples = node.create_subscription(
            JointState, topic.name, self._on_sample, SENSOR, raw=True
        )

    @property
    def is_matched(self) -> bool:
        """Whether there is a plant."""
        return bool(self._samples.get_publisher_count())

    def release(self) -> None:
        """Let the plant go on alone."""
        self._node.destroy_subscription(self._samples)
        # A sample that was received before is still passed on.
        processed, self._processed = self._processed, None
        if processed is not None:
            self._node.destroy_publisher(processed)

    def _on_sample(self, data: bytes) -> None:
        if self.ended:
            return
        reading = self._read(data)
        stamp = reading.stamp
        if stamp != self.stamp:
            self._first, self.stamp = self._first or stamp, stamp
            time = (stamp - self._first) / NANOSECONDS
            self.ended = not self._act(Sample(stamp, time, reading.values[0][0]))
        if self._processed is not None and not self.ended:
            message = Header(frame_id=self._node.get_fully_qualified_name())
            message.stamp.sec, message.stamp.nanosec = divmod(stamp, NANOSECONDS)
            self._processed.publish(message)


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
        node.create_subscription(DiagnosticArray, contract.DIAGNOSTICS.name, self._hear, 10)

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
        witness = Witness(node, act, lockstep=self._lockstep)
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
        participants = str(self._lockstep * (2 + ('steering' in nodes)))
        graph.spin_until(
            lambda: (
                witness.is_matched
                and self._is_recorded()
                and self.values.get('plant', {}).get(IN_LOCKSTEP) == participants
            ),
            'the recorder and the nodes in lock-step',
        )
        graph.change(node, 'plant', ACTIVATE)
        graph.spin_until(
            lambda: witness.ended,
            'the next sample',
            _STALL,
            sign=lambda: witness.stamp,
            period=_CHECK,
        )
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
