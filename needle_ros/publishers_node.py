# SPDX-License-Identifier: Apache-2.0
"""Detection of duplicate publishers and of their liveliness."""

from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from needle_ros import contract
from needle_ros.base_node import BaseNode, message_class, profile
from needle_ros.contract import Topic
from needle_ros.timing import nanoseconds
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter


def offer_lease(node: BaseNode, lease: Topic) -> None:
    """Offer a liveliness lease, before creating the publisher of the topic itself."""
    node.create_publisher(message_class(lease.type_name), _name(node, lease), profile(lease.qos))


def _name(node: BaseNode, lease: Topic) -> str:
    """Return the name of a lease, which follows the remapping of its topic."""
    owner, _, own = lease.name.rpartition('/')
    return f'{node.resolve_topic_name(owner)}/{own}'


def request_stamp(node: Node) -> Time:
    """Return the stamp of a request that is sent now, in simulated time if there is a clock."""
    # `count_publishers` does not follow a remapping. Before the first message of /clock the stamp
    # is zero, which means the time of arrival.
    clocks = node.get_publishers_info_by_topic(contract.CLOCK.name)
    if clocks and not node.get_parameter('use_sim_time').value:
        node.set_parameters([Parameter('use_sim_time', value=True)])
    stamp: Time = node.get_clock().now().to_msg()
    return stamp


def next_stamp(node: Node, before: int) -> int:
    """Return a stamp [ns] that identifies a request after one: simulated time may stand still."""
    stamp = nanoseconds(request_stamp(node))
    return max(stamp, before + 1) if stamp else 0


class Publishers:
    """
    Number of live publishers of a topic.

    A killed node stays in the graph for 20 s, and with a lease counts for 0.5 s. `lease` is as in
    `offer_lease`; `on_change` is called when a lease ends or is renewed.
    """

    def __init__(
        self, node: BaseNode, lease: Topic, on_change: Callable[[], object] | None = None
    ) -> None:
        self._node, self._notify = node, on_change
        self._lease = _name(node, lease)
        self._over = 0
        node.create_subscription(
            message_class(lease.type_name),
            self._lease,
            lambda _message: None,
            profile(lease.qos),
            event_callbacks=SubscriptionEventCallbacks(liveliness=self._on_change),
        )

    def _on_change(self, event: Any) -> None:
        self._over = event.not_alive_count
        if self._notify is not None:
            self._notify()

    def count(self, topic: Topic, matched: int = 0) -> int:
        """Return the number of live publishers of a topic, of which `matched` are matched."""
        # `count_publishers` does not follow a remapping, but takes a fraction of the time of the
        # list. The graph may be updated later than the matches, which include dead publishers.
        name = self._node.resolve_topic_name(topic.name)
        number = max(self._node.count_publishers(name), matched)
        if not self._over:
            return number
        publishers = self._node.get_publishers_info_by_topic(topic.name)
        # A process with an expired lease but no publisher must not hide a duplicate publisher.
        processes = {_process(one) for one in publishers}
        others = sum(
            _process(one) not in processes
            for one in self._node.get_publishers_info_by_topic(self._lease)
        )
        return number - max(0, self._over - others)


def _process(endpoint: Any) -> bytes:
    """Return the common prefix of the endpoint identifiers of a process."""
    return bytes(endpoint.endpoint_gid[:12])
