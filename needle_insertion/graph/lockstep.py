# SPDX-License-Identifier: Apache-2.0
"""Start nodes and a plant in lock-step: the result depends on simulated time only."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from needle_insertion.graph.messages import State
from needle_insertion.graph.ros_graph import ACTIVATE, CONFIGURE, Graph, NodeProcess
from needle_ros import contract
from needle_ros.base_node import profile, SENSOR
from needle_ros.status import PlantStatus
from needle_ros.timing import NANOSECONDS, set_time
from needle_ros.wire import MessageReader
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

WARM_UP: Final = 0.1  #: Time before the target is sent, until all sensors have reported [s].


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
            set_time(message.stamp, stamp)
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
        status = states['plant'].report.status if 'plant' in states else None
        in_lockstep = isinstance(status, PlantStatus) and status.lockstep_nodes == number
        return in_lockstep and ready()

    graph.spin_until(found, what)
    graph.change(node, 'plant', ACTIVATE)
