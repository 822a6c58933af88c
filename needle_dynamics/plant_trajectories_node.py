# SPDX-License-Identifier: Apache-2.0
"""Requests of the node `plant`: trajectories of its joints, and their acknowledgement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from needle_dynamics.simulated.indenter import JOINTS as PRESS_JOINTS
from needle_dynamics.simulated.joint_commands import moved_joints
from needle_dynamics.simulated.run import Event, PlantRun, TRAJECTORY
from needle_ros import contract
from needle_ros.base_node import BaseNode
from needle_ros.errors import ParameterError, printable
from needle_ros.requests import RequestLog, Verdict
from needle_ros.timing import NANOSECONDS, nanoseconds
from needle_ros.trajectories import JointPath
from needle_ros.waiting_requests import WaitingRequests
from trajectory_msgs.msg import JointTrajectory


class PlantTrajectories:
    """
    Receive `joint_trajectory`, execute each request once, and acknowledge it.

    A trajectory starts at the sample nearest before its stamp: it waits for this sample, or joins
    if it arrives later. Without a stamp, or in a plant that is not active, it starts on arrival.
    While `stopped` is not empty, none is executed. `simulated` returns the simulated time [ns].
    """

    def __init__(self, node: BaseNode, plant_run: PlantRun, simulated: Callable[[], int]) -> None:
        self._node, self._run, self._simulated = node, plant_run, simulated
        constants, topic = plant_run.constants, contract.JOINT_TRAJECTORY
        # In mode `simulation`, `insertion` is the reference of a controller.
        is_indenter = constants.mode == 'indenter'
        moved = moved_joints(constants.mode, steered=constants.steered)
        self._moved = PRESS_JOINTS if is_indenter else moved
        #: Whether trajectories are received.
        self.received = bool(self._moved)
        self.requests = RequestLog({topic: self._moved} if self.received else {})
        self._waiting = WaitingRequests(self.requests)
        #: Stamp of the newest sample, and period of the samples [ns].
        self._sampled, self._period = 0, round(NANOSECONDS / constants.own.rate)
        self.rejected = 0
        self.stopped = ''
        if self.received:
            node.subscribe(topic, self._on_trajectory)

    def discard(self, reason: str) -> None:
        """Discard the trajectories that wait."""
        self._waiting.discard(reason, Verdict.SUPERSEDED)

    def sample(self, stamp: int) -> None:
        """Begin the trajectories that start before the next sample; ``stamp`` [ns] is the last."""
        self._sampled = stamp
        self._begin(0.0)

    def _begin(self, elapsed: float) -> None:
        """Execute the requests that are due, at a time after their start [s]."""
        while (request := self._waiting.take(self._sampled + self._period)) is not None:
            topic, stamp, moved, act = request
            try:
                act(self._run, elapsed)
            except ParameterError as error:
                self._reject(str(error))
                self.requests.reject(topic, stamp, error)
            else:
                self.requests.answer(topic, stamp, Verdict.ACCEPTED, joints=moved)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Execute a trajectory if it is new and valid, or let it wait, and acknowledge it."""
        topic, stamp = contract.JOINT_TRAJECTORY, nanoseconds(message.header.stamp)
        path = JointPath.from_message(message)
        # In mode `simulation`, `insertion` is addressed to the controller.
        moved = tuple(name for name in path.joints or self._moved if name in self._moved)
        now = self._simulated() if self._node.is_active else stamp
        known = self.requests.check(topic, stamp, now, '', moved)
        if known is not None:
            if known.verdict in (Verdict.REJECTED, Verdict.LATE):
                self._reject(known.reason)
        elif self.stopped:
            # A stop of the node `steering` is not an error of its sender.
            self.requests.answer(topic, stamp, Verdict.SUPERSEDED, self.stopped)
        else:
            if not self._node.is_active:
                self._sampled = stamp
            request = self._waiting.add(topic, stamp, moved, partial(_follow, path, moved))
            self._begin(request.elapsed(self._sampled))
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


def _follow(path: JointPath, moved: Sequence[str], plant_run: PlantRun, elapsed: float) -> None:
    """Follow a trajectory, at a time after its start [s]; without points, stop its joints."""
    if path.stops:
        if path.joints and not moved:
            raise ParameterError(f'moves none of the joints {list(path.joints)}')
        plant_run.hold(moved)
        return
    joints, times, positions, _, efforts = path.after(elapsed)
    content = {'joints': joints, 'times': times, 'positions': positions, 'efforts': efforts}
    plant_run.perform(Event(TRAJECTORY, content))
