# SPDX-License-Identifier: Apache-2.0
"""Action client ``follow_joint_trajectory`` of a node that sends trajectories."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import Any

from action_msgs.msg import GoalStatus
from needle_ros.base_node import BaseNode
from needle_ros.contract import FOLLOW_JOINT_TRAJECTORY, JOINT_TRAJECTORY
from needle_ros.errors import ParameterError, printable
from needle_ros.requests import Acknowledgement, RequestStatus, Verdict
from needle_ros.timing import nanoseconds
from needle_ros.trajectory_goals import ErrorCode
from rclpy.action.client import ActionClient, ClientGoalHandle
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory


class TrajectoryClient:
    """
    Send trajectories as goals, and report the answers as those of a receiver of the topic.

    Parameters
    ----------
    node : BaseNode
        The sender.
    action : str
        Name of the action.
    tell : callable
        Takes the name of the action, and its answer to the last trajectory.

    Raises
    ------
    ParameterError
        If control_msgs is not installed.

    """

    def __init__(
        self, node: BaseNode, action: str, tell: Callable[[str, RequestStatus], None]
    ) -> None:
        package, _, kind = FOLLOW_JOINT_TRAJECTORY.type_name.partition('/action/')
        try:
            self._kind = getattr(import_module(f'{package}.action'), kind)
        except ImportError:
            raise ParameterError(f'the action {action} needs {package}: install it') from None
        self._action, self._tell = action, tell
        self._client = ActionClient(node, self._kind, action)
        #: The last trajectory; an older one is superseded by it.
        self._last = JointTrajectory()

    def destroy(self) -> None:
        """Destroy the client."""
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
        self._tell(self._action, RequestStatus({topic: tuple(self._last.joint_names)}, answers))

    def _on_response(self, trajectory: JointTrajectory, future: Future) -> None:
        handle: ClientGoalHandle = future.result()
        if trajectory is self._last:
            if handle.accepted:
                self._report(Verdict.ACCEPTED)
            else:
                self._report(Verdict.REJECTED, 'the goal was rejected')
        if handle.accepted:
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
