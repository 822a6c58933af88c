# SPDX-License-Identifier: Apache-2.0
"""Take messages from the queue of the middleware on demand."""

from collections.abc import Callable, Iterator
from typing import Any

from needle_ros.base_node import message_class, profile
from needle_ros.contract import Qos, Topic
from rclpy.node import Node


def waiting(
    node: Node, topic: Topic, qos: Qos, *, raw: bool = True
) -> Callable[[], Iterator[Any]]:
    """
    Subscribe to a topic and return a function that yields the messages since its last call.

    A sensor is subscribed as best effort. The queue holds as many messages as the depth of `qos`.
    Messages are taken on demand only: a topic of 1 kHz costs no more Python time than a topic that
    is read 30 times a second. The node must not be spun. `raw` messages are bytes.
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
