"""Who publishes commands, and is alive."""

from __future__ import annotations

from typing import Any

from needle_ros import contract
from needle_ros.base_node import BaseNode, message_class, profile
from rclpy.event_handler import SubscriptionEventCallbacks


class Commanders:
    """
    Counts the nodes that command.

    A node that was killed stays in the graph for 20 s. If it has joined the topic `COMMANDER` of
    the contract, it no longer counts when its lease of 0.5 s is over. Others, such as
    ``ros2 topic pub``, count as long as the graph has them.

    Parameters
    ----------
    node : BaseNode
        The node that wants to know.

    """

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        #: As remapped: the lease belongs to the commands.
        self.topic: str = node.resolve_topic_name(contract.WRENCH_COMMAND.name)
        self._lease = self.topic + contract.COMMANDER.name.removeprefix(
            contract.WRENCH_COMMAND.name
        )
        self._kind = message_class(contract.COMMANDER.type_name)
        self._dead = 0
        node.create_subscription(
            self._kind,
            self._lease,
            lambda _message: None,
            profile(contract.COMMANDER.qos),
            event_callbacks=SubscriptionEventCallbacks(liveliness=self._on_change),
        )

    def _on_change(self, event: Any) -> None:
        self._dead = event.not_alive_count

    def join(self) -> None:
        """Offer the lease, before the commands: a commander without one never counts as dead."""
        self._node.create_publisher(self._kind, self._lease, profile(contract.COMMANDER.qos))

    def count(self) -> int:
        """
        Count those that are alive, active or not.

        Returns
        -------
        int
            Publishers of commands, but those whose lease is over.

        """
        return self._node.count_publishers(self.topic) - self._dead
