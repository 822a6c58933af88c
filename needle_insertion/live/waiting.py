"""Messages that wait in the middleware until somebody looks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from needle_ros.base_node import message_class, profile
from needle_ros.contract import Qos, Topic
from rclpy.node import Node


def waiting(
    node: Node, topic: Topic, qos: Qos, *, raw: bool = True
) -> Callable[[], Iterator[Any]]:
    """
    Subscribe to a topic, as best effort if it is a sensor, and take from it only when asked to.

    So a topic of 1 kHz costs no more of Python than one that is looked at 30 times a second.

    Parameters
    ----------
    node : Node
        Node that nobody spins.
    topic : Topic
        The topic.
    qos : Qos
        What is requested; as many messages as its depth wait.
    raw : bool
        Whether the messages are taken as bytes.

    Returns
    -------
    callable
        Yields what has come since the last call, and no more than may wait: what comes meanwhile
        is for the next time.

    """
    made = node.create_subscription(
        message_class(topic.type_name),
        topic.name,
        lambda _: None,
        profile(qos, request=True),
        raw=raw,
    )

    def take() -> Iterator[Any]:
        for _ in range(qos.depth):
            with made.handle:
                taken = made.handle.take_message(made.msg_type, made.raw)
            if taken is None:
                return
            yield taken[0]

    return take
