"""Requests of the node `plant`: trajectories of its joints, and their acknowledgement."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from needle_dynamics.simulated.indenter import JOINTS as PRESS_JOINTS
from needle_dynamics.simulated.joint_commands import moved_joints
from needle_ros import contract
from needle_ros.base_node import BaseNode
from needle_ros.errors import ParameterError, printable
from needle_ros.requests import RequestLog, Verdict
from needle_ros.timing import nanoseconds, seconds
from needle_ros.trajectories import MOST_POINTS
from rclpy.subscription import Subscription
from trajectory_msgs.msg import JointTrajectory


class PlantTrajectories:
    """
    Receive `joint_trajectory`, execute each request once by `follow`, and acknowledge it.

    `simulated` returns the simulated time [ns]. While `stopped` is not empty, none is executed.
    """

    def __init__(
        self,
        node: BaseNode,
        simulated: Callable[[], int],
        follow: Callable[[dict[str, Any]], None],
    ) -> None:
        self._node, self._simulated, self._follow = node, simulated, follow
        self._subscription: Subscription | None = None
        self._moved: tuple[str, ...] = ()
        self.requests = RequestLog({})
        self.rejected = 0
        self.stopped = ''

    def configure(self, mode: str, *, steered: bool) -> None:
        """Subscribe, if any joint follows trajectories."""
        # In mode `simulation`, `insertion` is the reference of a controller.
        is_indenter = mode == 'indenter'
        self._moved = PRESS_JOINTS if is_indenter else moved_joints(mode, steered=steered)
        if self._moved:
            topic = contract.JOINT_TRAJECTORY
            self._subscription = self._node.subscribe(topic, self._on_trajectory)
            self.requests = RequestLog({topic: self._moved})

    def cleanup(self) -> None:
        """Unsubscribe, and discard all requests."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription, self._moved, self.requests = None, (), RequestLog({})

    @property
    def received(self) -> bool:
        """Whether trajectories are received."""
        return self._subscription is not None

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Execute a trajectory if it is new and valid, and acknowledge it."""
        stamp = nanoseconds(message.header.stamp)
        # In mode `simulation`, `insertion` is addressed to the controller.
        moved = [name for name in message.joint_names if name in self._moved]
        now = self._simulated() if self._node.is_active else stamp
        known = self.requests.check(contract.JOINT_TRAJECTORY, stamp, now, '', moved)
        if known is not None:
            if known.verdict is Verdict.REJECTED:
                self._reject(known.reason)
        elif self.stopped:
            # A stop of the node `steering` is not an error of its sender.
            verdict = Verdict.SUPERSEDED
            self.requests.answer(contract.JOINT_TRAJECTORY, stamp, verdict, self.stopped)
        else:
            verdict, reason = Verdict.ACCEPTED, ''
            try:
                self._follow(_content(message))
            except ParameterError as error:
                verdict, reason = Verdict.REJECTED, str(error)
                self._reject(reason)
            self.requests.answer(contract.JOINT_TRAJECTORY, stamp, verdict, reason, moved)
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


def _content(message: JointTrajectory) -> dict[str, Any]:
    """Return the content of a trajectory, or raise ParameterError if it has too many points."""
    points = message.points[: MOST_POINTS + 1]
    if len(points) > MOST_POINTS:
        raise ParameterError(f'a path may have at most {MOST_POINTS} points')
    return {
        'joints': list(message.joint_names),
        'times': [seconds(point.time_from_start) for point in points],
        'positions': [list(point.positions) for point in points],
        'efforts': [list(point.effort) for point in points],
    }
