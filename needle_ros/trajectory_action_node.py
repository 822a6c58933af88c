# SPDX-License-Identifier: Apache-2.0
"""Action ``follow_joint_trajectory``: server of a node that takes trajectories, and client."""

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from action_msgs.msg import GoalStatus
from needle_ros import contract
from needle_ros.base_node import BaseNode, message_class
from needle_ros.contract import FOLLOW_JOINT_TRAJECTORY_TYPE, JOINT_TRAJECTORY
from needle_ros.errors import MessageError, ParameterError, printable
from needle_ros.requests import Acknowledgement, RequestLog, RequestStatus, Verdict
from needle_ros.timing import NANOSECONDS, nanoseconds, set_time
from needle_ros.trajectories import (
    ErrorCode,
    FollowedJoint,
    JointPath,
    Outcome,
    outcome_of,
    TrajectoryGoal,
    UnknownJointError,
)
import numpy as np
from rclpy.action.client import ActionClient, ClientGoalHandle
from rclpy.action.server import ActionServer, CancelResponse, ServerGoalHandle
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory

_PERIOD: Final = NANOSECONDS // 20  #: Of the feedback [ns], as for joint_trajectory_controller.


class _GoalServer(ActionServer):
    """Action server of goals that the node executes, without a callback for each."""

    def notify_execute(self, _goal: ServerGoalHandle, _execute: object) -> None:
        """Do nothing: the node executes the goal with its samples."""

    def send_result(self, handle: ServerGoalHandle, result: Any) -> None:
        """Send a result now: the executor would send it after the node is cleaned up."""
        response = self.action_type.Impl.GetResultService.Response()
        response.status, response.result = handle.status, result
        future = self._result_futures[bytes(handle.goal_id.uuid)]
        # Without an executor the future calls back at once.
        future._set_executor(None)
        future.set_result(response)


@dataclass(slots=True, eq=False)
class _Execution:
    """A goal, its handle, and the time of its next feedback [ns]."""

    handle: ServerGoalHandle
    goal: TrajectoryGoal
    due: int = 0


class TrajectoryAction:
    """
    Offer ``~/follow_joint_trajectory`` of control_msgs, if this package is installed.

    A goal for some of the `joints` becomes the same request as a message on `joint_trajectory`,
    which `request` executes with its stamp [ns], and `requests` answers. Every goal is accepted,
    and an invalid one aborted with code and reason, for which a rejection has no field. `hold`
    holds the joints of a goal that is canceled or violates a tolerance, `discard` discards those
    that await their start, for a reason. `now` returns the time of the stamps [ns].
    """

    def __init__(
        self,
        node: BaseNode,
        requests: RequestLog,
        joints: Collection[str],
        request: Callable[[int, JointPath], None],
        hold: Callable[[Collection[str]], None],
        discard: Callable[[Collection[str], str], None],
        now: Callable[[], int],
    ) -> None:
        self._node, self._requests, self._joints = node, requests, joints
        self._request, self._hold, self._discard, self._now = request, hold, discard, now
        self._server: _GoalServer | None = None
        self._running: dict[int, _Execution] = {}  #: Goals in execution, by their stamps [ns].
        self._canceled: list[ServerGoalHandle] = []
        self._updated = 0  #: Time of the last check of the goals [ns].
        try:
            self._action = message_class(contract.FOLLOW_JOINT_TRAJECTORY_TYPE, kind='action')
        except MessageError:
            # Not among the wheels of ROS 2.
            return
        self._server = _GoalServer(
            node,
            self._action,
            contract.FOLLOW_JOINT_TRAJECTORY,
            # Goals are executed by `update`.
            lambda _handle: self._action.Result(),
            handle_accepted_callback=self._on_goal,
            cancel_callback=self._on_cancel,
        )

    @property
    def moves(self) -> bool:
        return bool(self._running)

    def destroy(self) -> None:
        """End all goals, and destroy the server."""
        self._requests.end('the node is cleaned up', self._joints)
        self._finish_canceled()
        if self._server is not None:
            self._server.destroy()

    # Goals.

    def _on_goal(self, handle: ServerGoalHandle) -> None:
        handle.execute()
        try:
            if not self._node.is_active:
                raise ParameterError('the node is not active')
            goal = TrajectoryGoal.from_message(handle.request, self._joints)
        except ParameterError as error:
            unknown = isinstance(error, UnknownJointError)
            code = ErrorCode.INVALID_JOINTS if unknown else ErrorCode.INVALID_GOAL
            self._finish(handle, Outcome(code, str(error)))
            return
        execution = _Execution(handle, goal)
        stamp = nanoseconds(handle.request.trajectory.header.stamp) or self._now()
        report = partial(self._on_answer, execution)
        goal.stamp = self._requests.watch(contract.JOINT_TRAJECTORY, stamp, goal.joints, report)
        if not self._running:
            self._updated = self._now()
        self._running[goal.stamp] = execution
        # Joint positions have no frame: MoveIt sends the frame of its model.
        self._request(goal.stamp, goal.trajectory)

    def _on_answer(
        self, execution: _Execution, answer: Acknowledgement, moved: Collection[str]
    ) -> None:
        """Process an answer to the request of a goal; `moved` are joints not to hold."""
        goal = execution.goal
        goal.moves |= answer.verdict is Verdict.ACCEPTED
        if not answer.refused:
            return
        del self._running[goal.stamp]
        left = goal.joints - {*moved}
        if goal.moves and left:
            self._hold(left)
        self._finish(execution.handle, outcome_of(answer, self._now()))

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        """End the motion of a goal; its result follows when rclpy has changed its state."""
        for execution in [*self._running.values()]:
            if execution.handle == handle:
                self._end(execution, 'the goal was canceled')
                self._canceled.append(handle)
                executor: Any = self._node.executor
                executor.create_task(self._finish_canceled)
        return CancelResponse.ACCEPT

    def _finish_canceled(self) -> None:
        handles, self._canceled = self._canceled, []
        for handle in handles:
            self._finish(handle, Outcome(ErrorCode.SUCCESSFUL, 'the goal was canceled'))

    def _end(self, execution: _Execution, reason: str) -> None:
        """End the execution of a goal; with a reason, also its motion."""
        goal = execution.goal
        self._requests.unwatch(contract.JOINT_TRAJECTORY, goal.stamp)
        del self._running[goal.stamp]
        if reason and goal.moves:
            self._hold(goal.joints)
        elif reason:
            # The joints follow something else until its start.
            self._discard(goal.joints, reason)

    def update(
        self, stamp: int, followed: Mapping[str, FollowedJoint], paused: Collection[str] = ()
    ) -> None:
        """Check the goals at a sample with a stamp [ns], except for paused joints."""
        elapsed, self._updated = stamp - self._updated, stamp
        for execution in [*self._running.values()]:
            goal = execution.goal
            if not goal.moves:
                continue
            if goal.joints & {*paused}:
                goal.paused += elapsed
                continue
            outcome = goal.check(stamp, followed)
            if outcome is not None or stamp >= execution.due:
                execution.due = stamp + _PERIOD
                execution.handle.publish_feedback(self._feedback(goal, stamp, followed))
            if outcome is not None:
                self._end(execution, outcome.reason)
                self._finish(execution.handle, outcome)

    # Messages.

    def _feedback(
        self, goal: TrajectoryGoal, stamp: int, followed: Mapping[str, FollowedJoint]
    ) -> Any:
        joints = [followed[name] for name in goal.trajectory.joints]
        feedback = self._action.Feedback(joint_names=[*goal.trajectory.joints])
        set_time(feedback.header.stamp, stamp)
        desired = np.array([joint.reference[:3] for joint in joints])
        actual = np.array([joint.actual for joint in joints])
        elapsed = divmod(max(0, stamp - goal.stamp), NANOSECONDS)
        for point, values in (
            (feedback.desired, desired),
            (feedback.actual, actual),
            (feedback.error, desired - actual),
        ):
            point.positions, point.velocities, point.effort = values.T.tolist()
            point.time_from_start.sec, point.time_from_start.nanosec = elapsed
        return feedback

    def _finish(self, handle: ServerGoalHandle, outcome: Outcome) -> None:
        if handle.is_cancel_requested:
            handle.canceled()
        elif outcome.code is ErrorCode.SUCCESSFUL:
            handle.succeed()
        else:
            handle.abort()
            line = f'follow_joint_trajectory aborted, {outcome.code.name}: {outcome.reason}'
            self._node.get_logger().warning(printable(line), throttle_duration_sec=1.0)
        reason = printable(outcome.reason)
        result = self._action.Result(error_code=int(outcome.code), error_string=reason)
        if self._server is not None:
            self._server.send_result(handle, result)


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
        self._last = JointTrajectory()  #: The last trajectory, which supersedes all others.

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
        """Report the answer to the last trajectory, or its absence."""
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
