# SPDX-License-Identifier: Apache-2.0
"""Action client ``follow_joint_trajectory`` of a node that sends trajectories."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from needle_ros.base_node import BaseNode, message_class
from needle_ros.contract import FOLLOW_JOINT_TRAJECTORY_TYPE, JOINT_TRAJECTORY
from needle_ros.errors import MessageError, ParameterError, printable
from needle_ros.requests import Acknowledgement, RequestStatus, Verdict
from needle_ros.timing import nanoseconds
from needle_ros.trajectory_goals import ErrorCode
from rclpy.action.client import ActionClient, ClientGoalHandle
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory


class TrajectoryClient:
    """Send trajectories as goals; `take` receives the name of the action, and its answers."""

    def __init__(
        self, node: BaseNode, action: str, take: Callable[[str, RequestStatus], None]
    ) -> None:
        try:
            self._kind = message_class(FOLLOW_JOINT_TRAJECTORY_TYPE, kind='action')
        except MessageError:
            raise ParameterError(f'the action {action} needs control_msgs: install it') from None
        self._action, self._take = action, take
        self._client = ActionClient(node, self._kind, action)
        self._last = JointTrajectory()  #: The last trajectory, which supersedes older ones.

    def destroy(self) -> None:
        self._client.destroy()

    def send(self, trajectory: JointTrajectory) -> None:
        """Send a trajectory; without a server it has no answer."""
        self._last = trajectory
        self._report()
        if self._client.server_is_ready():
            future = self._client.send_goal_async(self._kind.Goal(trajectory=trajectory))
            future.add_done_callback(partial(self._on_response, trajectory))

    def _report(self, verdict: Verdict | None = None, reason: str = '') -> None:
        """Report the answer to the last trajectory, or that there is none."""
        topic, stamp = JOINT_TRAJECTORY.name, nanoseconds(self._last.header.stamp)
        answers = () if verdict is None else (Acknowledgement(topic, stamp, verdict, reason),)
        self._take(self._action, RequestStatus({topic: tuple(self._last.joint_names)}, answers))

    def _on_response(self, trajectory: JointTrajectory, future: Future) -> None:
        handle: ClientGoalHandle = future.result()
        accepted = handle.accepted
        if trajectory is self._last:
            reason = '' if accepted else 'the goal was rejected'
            self._report(Verdict.ACCEPTED if accepted else Verdict.REJECTED, reason)
        if accepted:
            handle.get_result_async().add_done_callback(partial(self._on_result, trajectory))

    def _on_result(self, trajectory: JointTrajectory, future: Future) -> None:
        answer: Any = future.result()
        if trajectory is not self._last or answer.status == GoalStatus.STATUS_SUCCEEDED:
            return
        code = name = answer.result.error_code
        with suppress(ValueError):
            name = ErrorCode(code).name
        if answer.status == GoalStatus.STATUS_CANCELED:
            name = 'canceled'
        late = code == ErrorCode.OLD_HEADER_TIMESTAMP
        reason = printable(f'{name}: {answer.result.error_string}')
        self._report(Verdict.LATE if late else Verdict.REJECTED, reason)
