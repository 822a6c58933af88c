"""Who publishes what may have one source only, and is alive."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from needle_ros import contract
from needle_ros.base_node import BaseNode, message_class, profile
from needle_ros.contract import Topic
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter


def offer_lease(node: BaseNode, lease: Topic) -> None:
    """
    Offer a lease, before a topic: a publisher without one never counts as dead.

    Parameters
    ----------
    node : BaseNode
        The node that publishes the topic.
    lease : Topic
        Topic of the lease. It is named after a topic, and goes where that one is remapped to.

    """
    node.create_publisher(message_class(lease.type_name), _name(node, lease), profile(lease.qos))


def _name(node: BaseNode, lease: Topic) -> str:
    owner, _, own = lease.name.rpartition('/')
    return f'{node.resolve_topic_name(owner)}/{own}'


def request_stamp(node: Node) -> Time:
    """
    Return the stamp of a request that is made now, in the time of the graph.

    Parameters
    ----------
    node : Node
        The node that makes it. It uses simulated time from now on where there is a ``/clock``.

    Returns
    -------
    Time
        The time now; zero, which stands for the time of arrival, before the first ``/clock``.

    """
    if node.count_publishers(contract.CLOCK.name) and not node.get_parameter('use_sim_time').value:
        node.set_parameters([Parameter('use_sim_time', value=True)])
    stamp: Time = node.get_clock().now().to_msg()
    return stamp


class Publishers:
    """
    Counts the nodes that publish a topic.

    A node that was killed stays in the graph for 20 s. If it offers a lease, it no longer counts
    when this is over, after 0.5 s. Others, such as ``ros2 topic pub``, count as long as the graph
    has them.

    Parameters
    ----------
    node : BaseNode
        The node that wants to know.
    lease : Topic
        Topic on which publishers offer a lease, see `offer_lease`.
    on_change : callable, optional
        Called when a lease ends or begins again.

    """

    def __init__(
        self, node: BaseNode, lease: Topic, on_change: Callable[[], object] | None = None
    ) -> None:
        self._node, self._told = node, on_change
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
        if self._told is not None:
            self._told()

    def count(self, topic: Topic, matched: int = 0) -> int:
        """
        Count those that are alive, active or not.

        Parameters
        ----------
        topic : Topic
            The topic.
        matched : int
            Its publishers that a subscription has been matched with, dead ones too: the graph
            may learn of them later.

        Returns
        -------
        int
            Its publishers, but those whose lease is over.

        """
        publishers = self._node.get_publishers_info_by_topic(topic.name)
        number = max(len(publishers), matched)
        if not self._over:
            return number
        # Who only offers a lease, and lets it end, must not hide a stranger.
        processes = {_process(one) for one in publishers}
        others = sum(
            _process(one) not in processes
            for one in self._node.get_publishers_info_by_topic(self._lease)
        )
        return number - max(0, self._over - others)


def _process(endpoint: Any) -> bytes:
    """Return what the identifiers of all endpoints of a process begin with."""
    return bytes(endpoint.endpoint_gid[:12])
