# SPDX-License-Identifier: Apache-2.0
"""Reports of other nodes on processed and recorded samples, for the clock of the plant."""

from collections.abc import Callable
from typing import Any

from needle_ros import contract
from needle_ros.base_node import BaseNode, profile
from needle_ros.sample_clock import SampleClock
from needle_ros.timing import nanoseconds
from rclpy.event_handler import SubscriptionEventCallbacks
from std_msgs.msg import Header


class SampleReports:
    """Pass reports to a clock; ``checks`` counts the checks at which the same sample waited."""

    def __init__(
        self,
        node: BaseNode,
        advance: Callable[[], None],
        clock: SampleClock,
        *,
        processed: bool,
        recorded: bool,
    ) -> None:
        self._node, self._advance, self._clock = node, advance, clock
        self.checks = 0
        self._awaited: int | None = None
        if processed:
            self._subscribe(contract.PROCESSED, self._on_processed, self._on_participant)
        if recorded:
            self._subscribe(contract.RECORDED, self._on_recorded, self._on_recorder)

    def check(self) -> None:
        """Count the checks of the sample that waits for its answers."""
        awaited, before = self._clock.awaited, self._awaited
        self.checks = self.checks + 1 if awaited is not None and awaited == before else 0
        self._awaited = awaited

    def _subscribe(
        self, topic: contract.Topic, take: Callable[[Header], None], matched: Callable[[Any], None]
    ) -> None:
        events = SubscriptionEventCallbacks(matched=matched)
        self._node.create_subscription(
            Header, topic.name, take, profile(topic.qos), event_callbacks=events
        )

    def _on_processed(self, message: Header) -> None:
        if self._node.is_active:
            self._clock.answered(nanoseconds(message.stamp), message.frame_id)
            self._advance()

    def _on_participant(self, event: Any) -> None:
        self._clock.participants = event.current_count
        self._node.publish_diagnostics()

    def _on_recorded(self, message: Header) -> None:
        recorded, stamp = self._clock.recorded, nanoseconds(message.stamp)
        before = len(recorded)
        recorded[message.frame_id] = stamp
        if not stamp:
            # A zero stamp marks the end of the recording.
            del recorded[message.frame_id]
        if len(recorded) != before:
            self._node.publish_diagnostics()
        if self._node.is_active:
            self._advance()

    def _on_recorder(self, event: Any) -> None:
        """Discard the recorder list when a recorder disappears; the others report again."""
        if event.current_count_change < 0:
            self._clock.recorded.clear()
