"""Run simulated nodes in lock-step, so that the result depends on simulated time only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from needle_identification.recorder_node import is_hidden
from needle_insertion.graph.node_process import GraphError
from needle_insertion.graph.ros_graph import ACTIVATE, CONFIGURE, Graph
from needle_insertion.progress import Show
from needle_ros import contract
from needle_ros.base_node import COMMAND, profile, SENSOR
from needle_ros.contract import ENTRY
from needle_ros.status import NodeStatus, PlantStatus, read_status
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import MessageReader
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

#: Time before the target is sent, until all sensors have reported [s].
WARM_UP: Final = 0.1

#: Timeout of the arrival of a message on a busy machine [s].
_ARRIVAL: Final = Duration(seconds=30.0)

#: Timeout of a sample on a busy machine [s].
_STALL: Final = 60.0

#: Period of the checks for the end of the run [s].
_CHECK: Final = 0.05


class RunSample(NamedTuple):
    """A sample of the plant."""

    #: [ns].
    stamp: int
    #: Time since the first sample [s].
    time: float
    #: Insertion depth [m].
    depth: float


def target_message(stamp: int, point: tuple[float, float, float]) -> PointStamped:
    """Return a target x, y, z [m] with a stamp [ns]."""
    message = PointStamped()
    message.header.frame_id = ENTRY
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, NANOSECONDS)
    message.point.x, message.point.y, message.point.z = point
    return message


class Witness:
    """
    Call a function at each sample of a plant, until it returns False.

    A plant in lock-step waits at each sample until the call has returned, and without end after
    the call that returned False, until `release`. `stamp` is the stamp of the newest sample [ns].
    """

    def __init__(self, node: Node, act: Callable[[RunSample], bool], *, lockstep: bool) -> None:
        self._node, self._act = node, act
        self._first = self.stamp = 0
        self.ended = False
        topic = contract.JOINT_STATES
        self._read = MessageReader(topic.type_name).read
        self._processed: Publisher | None = None
        if lockstep:
            kind = contract.PROCESSED
            self._processed = node.create_publisher(Header, kind.name, profile(kind.qos))
        self._samples = node.create_subscription(
            JointState, topic.name, self._on_sample, SENSOR, raw=True
        )

    @property
    def is_matched(self) -> bool:
        """Whether a plant publishes samples."""
        return bool(self._samples.get_publisher_count())

    def release(self) -> None:
        """End the subscription: the plant no longer waits for this process."""
        self._node.destroy_subscription(self._samples)
        # Samples in the queue are still delivered.
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
            self.ended = not self._act(RunSample(stamp, time, reading.values[0][0]))
        if self._processed is not None and not self.ended:
            message = Header(frame_id=self._node.get_fully_qualified_name())
            message.stamp.sec, message.stamp.nanosec = divmod(stamp, NANOSECONDS)
            self._processed.publish(message)


class SimulatedRun:
    """
    Start nodes and a plant, act at samples of the plant, and record everything.

    In lock-step the plant waits at each sample until the action is complete and all its messages
    have arrived: a message arrives at the same sample on any machine.
    """

    def __init__(self, graph: Graph, show: Show, *, lockstep: bool = True) -> None:
        self._graph, self._show, self._lockstep = graph, show, lockstep
        self.node = node = graph.node('demo')
        #: Latest status and message of each node by its name.
        self.statuses: dict[str, NodeStatus] = {}
        self._messages: dict[str, str] = {}
        node.create_subscription(DiagnosticArray, contract.DIAGNOSTICS.name, self._hear, 10)

    def publisher(self, kind: type, topic: str) -> Callable[[Any], None]:
        """Create a publisher; return a function that publishes and waits for all subscribers."""
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
        act: Callable[[RunSample], bool],
    ) -> None:
        """Record the nodes, the plant last, until `act`, called at each sample, returns False."""
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
        # The bag must contain every sample, and lock-step must include all nodes.
        participants = self._lockstep * (2 + ('steering' in nodes))

        def in_lockstep() -> bool:
            plant = self.statuses.get('plant')
            return isinstance(plant, PlantStatus) and plant.lockstep_nodes == participants

        graph.spin_until(
            lambda: witness.is_matched and self._is_recorded() and in_lockstep(),
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
        """Show the starting node and its status."""
        said = self._messages.get(name, '')
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
            name = status.name.rpartition('/')[2]
            self._messages[name] = status.message
            found = read_status({one.key: one.value for one in status.values})
            if found is not None:
                self.statuses[name] = found
