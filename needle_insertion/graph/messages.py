# SPDX-License-Identifier: Apache-2.0
"""Messages to and from running nodes: targets, status of each node, messages on demand."""

from collections.abc import Callable, Iterator
from time import monotonic
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from needle_ros import contract
from needle_ros.base_node import message_class, profile
from needle_ros.contract import Qos, Topic
from needle_ros.status import NodeReport, read_reports
from needle_ros.timing import set_time
from rclpy.node import Node


class State(NamedTuple):
    """Latest report of a node on /diagnostics."""

    report: NodeReport
    received: float  #: Time of receipt by `time.monotonic` [s].

    @property
    def age(self) -> float:
        """Time since receipt [s]; the node publishes every second."""
        return monotonic() - self.received


def listen_states(
    node: Node, on_state: Callable[[NodeReport], object] = lambda _: None
) -> dict[str, State]:
    """Subscribe to /diagnostics; return the latest state of each node, by its bare name."""
    states: dict[str, State] = {}

    def on_array(array: DiagnosticArray) -> None:
        for report in read_reports(array):
            states[report.name] = State(report, monotonic())
            on_state(report)

    topic = contract.DIAGNOSTICS
    node.create_subscription(DiagnosticArray, topic.name, on_array, profile(topic.qos))
    return states


def target_message(stamp: int, point: tuple[float, float, float]) -> PointStamped:
    """Return a target x, y, z [m] with a stamp [ns]."""
    message = PointStamped()
    message.header.frame_id = contract.ENTRY
    set_time(message.header.stamp, stamp)
    message.point.x, message.point.y, message.point.z = point
    return message


def waiting(
    node: Node, topic: Topic, qos: Qos, *, raw: bool = True
) -> Callable[[], Iterator[Any]]:
    """
    Subscribe to a topic and return a function that yields the messages since its last call.

    A sensor is subscribed as best effort. The queue holds as many messages as the depth of `qos`.
    Messages are taken on demand only: a topic of 1 kHz costs no more Python time than a topic that
    is read 30 times a second. The node must not be spun. `raw` messages are bytes.
    """
    kind, reliability = message_class(topic.type_name), profile(qos, request=True)
    made = node.create_subscription(kind, topic.name, lambda _: None, reliability, raw=raw)

    def take() -> Iterator[Any]:
        for _ in range(qos.depth):
            with made.handle:
                taken = made.handle.take_message(made.msg_type, made.raw)
            if taken is None:
                return
            yield taken[0]

    return take
