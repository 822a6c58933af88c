# SPDX-License-Identifier: Apache-2.0
"""Inputs of the node `plant`: commands and their publishers, trajectories and their answers."""

from collections.abc import Callable, Collection
from functools import partial
from time import monotonic_ns
from typing import Final

from needle_dynamics.simulated.commands import moved_joints
from needle_dynamics.simulated.indenter import JOINTS as PRESS_JOINTS
from needle_dynamics.simulated.run import Executions, PlantRun
from needle_ros import contract
from needle_ros.base_node import BaseNode
from needle_ros.errors import printable
from needle_ros.publishers_node import Publishers
from needle_ros.requests import RequestLog, Verdict, WaitingRequest, WaitingRequests
from needle_ros.timing import NANOSECONDS, nanoseconds, RateCounter
from needle_ros.trajectories import joint_values, JointPath
from needle_ros.trajectory_action_node import TrajectoryAction
from needle_ros.wire import Reading
from trajectory_msgs.msg import JointTrajectory

_DEEPER: Final = 1e-4  #: Smallest motion of a resting needle that inserts it [m].
_INACTIVE: Final = 'the plant is not active'


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


class PlantTrajectories:
    """
    Receive trajectories as messages and goals, execute each once, and acknowledge it.

    A trajectory starts at the sample nearest before its stamp: it waits for this sample, or joins
    if it arrives later. Without a stamp, it starts on arrival, or with the activation of a plant
    that is not active, which rejects those with a stamp. While `stopped` is not empty, none is
    executed. A pause holds the joints that move; the remaining paths are followed after it, as
    are the requests that await their start. `simulated` returns the simulated time [ns]; `inserts`
    is called before a path moves a resting needle deeper.
    """

    def __init__(
        self,
        node: BaseNode,
        plant_run: PlantRun,
        simulated: Callable[[], int],
        inserts: Callable[[], None],
    ) -> None:
        self._node, self._run, self._simulated = node, plant_run, simulated
        self._inserts = inserts
        constants, topic = plant_run.constants, contract.JOINT_TRAJECTORY
        # In mode `simulation`, `insertion` is the reference of a controller.
        is_indenter = constants.mode == 'indenter'
        moved = moved_joints(constants.mode, steered=constants.steered)
        self._moved = PRESS_JOINTS if is_indenter else moved
        #: Whether trajectories are received.
        self.received = bool(self._moved)
        self.requests = RequestLog({topic: self._moved} if self.received else {})
        self._waiting = WaitingRequests(self.requests)
        self.executions = Executions(plant_run, self._moved)
        self.rejected = 0
        self.stopped = ''
        #: Error of the plant, after which it takes no sample; '' without one.
        self._halted = ''
        self._action: TrajectoryAction | None = None
        if self.received:
            node.subscribe(topic, self._on_trajectory)
            self._action = TrajectoryAction(
                node,
                self.requests,
                self._moved,
                self._follow,
                self._hold,
                self._discard,
                simulated,
            )

    def begin(self) -> None:
        """Await the first sample of a plant that is active, or was reset."""
        self.executions.sampled, self._halted = 0, ''

    def destroy(self) -> None:
        """End all goals, and destroy the action."""
        if self._action is not None:
            self._action.destroy()

    def end(self, reason: str) -> None:
        """Discard the trajectories sent until now, and end the goals, whose joints hold."""
        self.requests.supersede(self._simulated())
        self._waiting.end(reason, Verdict.SUPERSEDED)
        self.executions.forget(self._moved)

    def halt(self, reason: str) -> None:
        """Discard all trajectories of a plant that cannot move, nor hold, until a reset."""
        self._halted = reason
        self.requests.end(reason, self._moved)
        self.end(reason)

    def displace(self, reason: str, joints: Collection[str]) -> None:
        """Discard the trajectories of joints that something else moves."""
        self._discard(joints, reason)
        self.executions.forget(joints)
        self.requests.end(reason, joints)

    def _discard(self, joints: Collection[str], reason: str) -> None:
        self._waiting.discard(reason, joints)

    def _execute(
        self, path: JointPath, moved: tuple[str, ...], _run: PlantRun, elapsed: float
    ) -> None:
        """Follow a path with some joints, at a time after its start [s]."""
        if self._is_inserted(path, moved):
            self._inserts()
        self.executions.follow(path, moved, elapsed)

    def _is_inserted(self, path: JointPath, moved: Collection[str]) -> bool:
        """Whether a path moves a resting needle deeper; it still moves if `steering` brakes it."""
        name, plant = contract.INSERTION, self._run.plant
        if path.stops or name not in moved or not plant.references()[name].arrived:
            return False
        *_, end = joint_values(name, path.joints, path.positions)
        return end is None or end > plant.depth + _DEEPER

    def _hold(self, joints: Collection[str]) -> None:
        self.executions.forget(joints)
        self._run.hold([name for name in self._moved if name in joints])

    def sample(self, stamp: int) -> None:
        """Begin the trajectories that start before the next sample; ``stamp`` [ns] is the last."""
        if self._action is not None and self._action.moves:
            self._action.update(stamp, self._run.followed(), self.executions.joints_held)
        self.executions.sampled = stamp
        if not self.executions.paused:
            self._begin(stamp + self.executions.period, 0.0)

    def _begin(self, until: int, elapsed: float, only: WaitingRequest | None = None) -> None:
        """
        Execute the requests that start before a time [ns], at a time after their start [s].

        During a pause only a new request is executed: `steering` brakes by one.
        """
        only = only if self.executions.paused else None
        for error in self._waiting.execute(until, self._run, elapsed, only):
            self._reject(str(error))

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Execute a trajectory if it is new and valid, or let it wait, and acknowledge it."""
        self._follow(nanoseconds(message.header.stamp), JointPath.from_message(message))

    def _follow(self, stamp: int, path: JointPath) -> None:
        topic = contract.JOINT_TRAJECTORY
        # In mode `simulation`, `insertion` is addressed to the controller.
        moved = tuple(name for name in path.joints or self._moved if name in self._moved)
        now = self._simulated()
        known = self.requests.check(topic, stamp, now, joints=moved)
        if known is not None:
            if known.verdict in (Verdict.REJECTED, Verdict.LATE):
                self._reject(known.reason)
        elif self.stopped or self._halted:
            # A stop of the node `steering` is not an error of its sender.
            verdict = Verdict.SUPERSEDED if self.stopped else Verdict.REJECTED
            self.requests.answer(topic, stamp, verdict, self.stopped or self._halted)
        elif stamp and not self._node.is_active:
            self._reject(_INACTIVE)
            self.requests.reject(topic, stamp, _INACTIVE)
        else:
            # Not active, or before the first sample.
            self.executions.sampled = (
                self.executions.sampled
                if self._node.is_active and self.executions.sampled
                else now
            )
            action = partial(self._execute, path, moved)
            request = self._waiting.add(topic, stamp, moved, action)
            # A stop waits for no sample.
            until = now + 1 if path.stops else 0
            due = max(self.executions.sampled + self.executions.period, until)
            self._begin(due, request.elapsed(self.executions.sampled), request)
        self.publish_answers()

    def _reject(self, reason: str) -> None:
        self.rejected += 1
        self._node.get_logger().error(
            printable(f'joint_trajectory rejected: {reason}'), throttle_duration_sec=1.0
        )

    def publish_answers(self) -> None:
        """Publish the status of the node if it lacks results of requests."""
        if self.requests.due():
            self._node.publish_diagnostics()
