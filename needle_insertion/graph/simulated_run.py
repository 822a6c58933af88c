# SPDX-License-Identifier: Apache-2.0
"""Run simulated nodes in lock-step, so that the result depends on simulated time only."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from geometry_msgs.msg import PointStamped
from needle_identification.recorder_node import is_hidden
from needle_insertion.graph.messages import listen_states, State, target_message
from needle_insertion.graph.node_process import GraphError, NodeProcess
from needle_insertion.graph.ros_graph import ACTIVATE, CONFIGURE, Graph
from needle_insertion.progress import Show
from needle_ros import contract
from needle_ros.base_node import COMMAND, profile, SENSOR
from needle_ros.status import PlantStatus
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import MessageReader
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

WARM_UP: Final = 0.1  #: Time before the target is sent, until all sensors have reported [s].

#: Timeout of the arrival of a message on a busy machine [s].
_ARRIVAL: Final = Duration(seconds=30.0)

_STALL: Final = 60.0  #: Timeout of a sample on a busy machine [s].
_CHECK: Final = 0.05  #: Period of the checks for the end of the run [s].


class RunSample(NamedTuple):
    """A sample of the plant."""

    stamp: int  #: [ns].
    time: float  #: Time since the first sample [s].
    depth: float  #: Insertion depth [m].


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


def start_nodes(
    graph: Graph,
    node: Node,
    nodes: Mapping[str, Mapping[str, object]],
    show: Callable[[str], object],
    file: Path | None = None,
    *,
    lockstep: bool,
) -> list[NodeProcess]:
    """
    Start nodes with their parameters, and wait until all are active, and the plant inactive.

    `file` is the parameter file of all nodes except the recorder. See `activate_plant`.
    """
    processes = []
    for name, parameters in nodes.items():
        own: dict[str, object] = {}
        if name == 'plant':
            own = {'autostart': False, 'lockstep': lockstep}
        elif name != 'recorder' and lockstep:
            own = {'use_sim_time': True}
        used = None if name == 'recorder' else file
        processes.append(graph.start(name, {**parameters, **own}, used))
    for name in nodes:
        if name != 'plant':
            graph.wait_active(node, name, show)
    if 'plant' in nodes:
        # A recorder subscribes to publishers that exist.
        graph.change(node, 'plant', CONFIGURE)
    return processes


def activate_plant(
    graph: Graph,
    node: Node,
    states: Mapping[str, State],
    number: int,
    what: str = 'the nodes in lock-step',
    ready: Callable[[], bool] = lambda: True,
) -> None:
    """Activate the plant when `ready`, and the plant has discovered the nodes in lock-step."""

    def found() -> bool:
        status = states['plant'].status if 'plant' in states else None
        in_lockstep = isinstance(status, PlantStatus) and status.lockstep_nodes == number
        return in_lockstep and ready()

    graph.spin_until(found, what)
    graph.change(node, 'plant', ACTIVATE)


class SimulatedRun:
    """
    Start nodes and a plant, send a target, and record everything.

    In lock-step the plant waits at each sample until the action is complete and all its messages
    have arrived: a message arrives at the same sample on any machine. `states` has the latest
    state of each node by its name.
    """

    def __init__(self, graph: Graph, show: Show, *, lockstep: bool = True) -> None:
        self._graph, self._show, self._lockstep = graph, show, lockstep
        self.node = graph.node('demo')
        self.states = listen_states(self.node)

    def insert(
        self,
        bag: Path,
        nodes: Mapping[str, Mapping[str, object]],
        start: float,
        target: tuple[float, float, float],
        proceeds: Callable[[RunSample], bool],
        motion: JointTrajectory | None = None,
    ) -> None:
        """
        Insert from a depth to a target [m], and record until `proceeds` returns False.

        `nodes` are the parameters of the nodes, the plant last; `motion` is published with the
        target.
        """
        aim = self._publisher(PointStamped, contract.TARGET.name)
        move = self._publisher(JointTrajectory, contract.JOINT_TRAJECTORY.name) if motion else None
        waiting = True

        def act(sample: RunSample) -> bool:
            nonlocal waiting
            if waiting and sample.time >= WARM_UP:
                waiting = False
                aim(target_message(sample.stamp, target))
                if move is not None:
                    move(motion)
            done = (sample.depth - start) / (target[1] - start)
            self._show('inserting', min(max(done, 0.0), 1.0))
            return proceeds(sample)

        self._record(bag, nodes, act)

    def _publisher(self, kind: type, topic: str) -> Callable[[Any], None]:
        """Create a publisher; return a function that publishes and waits for all subscribers."""
        publisher = self.node.create_publisher(kind, topic, COMMAND)

        def publish(message: Any) -> None:
            publisher.publish(message)
            if not publisher.wait_for_all_acked(_ARRIVAL):
                raise GraphError(f'{topic} did not arrive')

        return publish

    def _record(
        self,
        bag: Path,
        nodes: Mapping[str, Mapping[str, object]],
        act: Callable[[RunSample], bool],
    ) -> None:
        """Record the nodes until `act`, called at each sample of the plant, returns False."""
        graph, node = self._graph, self.node
        witness = Witness(node, act, lockstep=self._lockstep)
        recorded = {'recorder': {'path': str(bag)}, **nodes}
        started = start_nodes(graph, node, recorded, self._show_start, lockstep=self._lockstep)
        self._show('starting plant')
        # The bag must contain every sample, and lock-step must include all nodes.
        activate_plant(
            graph,
            node,
            self.states,
            self._lockstep * (2 + ('steering' in nodes)),
            'the recorder and the nodes in lock-step',
            lambda: witness.is_matched and self._is_recorded(),
        )
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
        message = self.states[name].message if name in self.states else ''
        self._show(f'starting {name}' + (f': {message}' if message else ''))

    def _is_recorded(self) -> bool:
        """Return whether the recorder has subscribed to all topics."""
        node = self.node
        return all(
            'recorder' in [one.node_name for one in node.get_subscriptions_info_by_topic(topic)]
            for topic, _ in node.get_topic_names_and_types()
            if node.count_publishers(topic) and not is_hidden(topic)
        )
