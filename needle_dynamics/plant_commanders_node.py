# SPDX-License-Identifier: Apache-2.0
"""Command topics of the node `plant`, and the number of nodes that publish on them."""

from collections.abc import Callable
from time import monotonic_ns

from needle_ros import contract
from needle_ros.base_node import BaseNode
from needle_ros.publishers_node import Publishers
from needle_ros.timing import NANOSECONDS, RateCounter
from needle_ros.wire import Reading


class PlantCommanders:
    """Subscribe to commands at a rate [Hz]; `on_change` is called when publishers come or go."""

    def __init__(
        self,
        node: BaseNode,
        on_wrench: Callable[[Reading], None],
        on_joints: Callable[[Reading], None],
        on_change: Callable[[int | None], None],
    ) -> None:
        self._node = node
        self._leases = Publishers(node, contract.COMMANDER, lambda: on_change(None))
        self._wrenches = node.listen(contract.WRENCH_COMMAND, on_wrench, on_change)
        self._joints = node.listen(contract.JOINT_COMMANDS, on_joints, on_change)
        #: Number of publishers matched by DDS, including stale entries, and time of change [ns].
        self._matched, self._matched_at = 0, 0
        self._announced = 0  #: Number of publishers that were counted before the event of a match.
        #: On a steady clock.
        self.rate = RateCounter()

    def _count_matched(self) -> tuple[int, int]:
        """Return the publishers of each topic matched by DDS, including stale entries."""
        return self._wrenches.get_publisher_count(), self._joints.get_publisher_count()

    @property
    def changed(self) -> bool:
        """Whether publishers appeared or disappeared since the last `update`."""
        return sum(self._count_matched()) != self._matched

    def update(self, new: int | None) -> bool:
        """
        Update the publishers; return whether there may have been several, if only briefly.

        ``new`` is the number of new ones of an event, which may be late; None without an event. An
        event ends the count before it: a doubt means several.
        """
        before, matched = self._matched, sum(self._count_matched())
        if matched != before:
            self._matched, self._matched_at = matched, monotonic_ns()
        announced = self._announced + max(0, matched - before)
        self._announced = announced if new is None else 0
        several = max(before, matched) > 1
        return bool((several and matched != before) or (before and (new or 0) > announced))

    def count(self) -> int:
        """Return the number of live publishers."""
        # DDS may count a short-lived publisher forever; after a second the graph is reliable.
        fresh = monotonic_ns() - self._matched_at < NANOSECONDS
        wrenches, joints = self._count_matched() if fresh else (0, 0)
        # A driver has no lease: it counts while it is in the graph.
        drivers = self._node.get_publishers_info_by_topic(contract.JOINT_COMMANDS.name)
        count = self._leases.count(contract.WRENCH_COMMAND, wrenches)
        return count + max(len(drivers), joints)
