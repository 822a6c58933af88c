# SPDX-License-Identifier: Apache-2.0
"""Trajectories of joints: points, validation, start time; goals, their tolerances and results."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from math import isfinite
from typing import Any, Final, NamedTuple, TypeAlias

from needle_ros.errors import ParameterError
from needle_ros.requests import Acknowledgement, is_stale, LateTrajectoryError, Verdict
from needle_ros.timing import NANOSECONDS, nanoseconds, seconds

#: Maximum number of points: checking a million invalid points would take seconds.
MOST_POINTS: Final = 10_000

#: A number of each joint at each point, or none at a point.
Points: TypeAlias = Sequence[Sequence[float]]

_ERASED: Final = -1.0  #: Value of a tolerance that disables its check, as 0 does.


class JointReference(NamedTuple):
    """Reference of a joint that follows trajectories; NaN for values that are not controlled."""

    position: float  #: position [m or rad]
    velocity: float  #: velocity [m/s or rad/s]
    effort: float  #: force [N] or torque [N m]
    arrived: bool  #: whether it is at the end of its motion


class FollowedJoint(NamedTuple):
    """Reference of a joint, and its measured position, velocity and effort, in equal units."""

    reference: JointReference
    actual: tuple[float, float, float]


class JointPath(NamedTuple):
    """
    Points of joints, with times from the stamp of the trajectory [s].

    One that arrives later joins at its first point that is not in the past, as for
    joint_trajectory_controller. Without points, the joints stop; without names, all joints.
    """

    joints: Sequence[str]
    times: Sequence[float]
    positions: Points
    velocities: Points = ()
    efforts: Points = ()

    @classmethod
    def from_message(cls, message: Any) -> JointPath:
        # One point above the limit is enough to reject it.
        points = message.points[: MOST_POINTS + 1]
        times = [seconds(point.time_from_start) for point in points]
        columns = (
            [list(getattr(point, field)) for point in points]
            for field in ('positions', 'velocities', 'effort')
        )
        return cls(list(message.joint_names), times, *columns)

    @property
    def stops(self) -> bool:
        return not self.times

    def end(self, begun: int) -> int:
        """Return the time of the last point after a start [ns]; the start without points."""
        return begun + round(NANOSECONDS * self.times[-1]) if self.times else begun

    def check(self, elapsed: float) -> None:
        """Check number and times of the points, at a time after the start [s]."""
        if len(self.times) > MOST_POINTS:
            raise ParameterError(f'a path may have at most {MOST_POINTS} points')
        if self.stops:
            return
        check_times(self.times)
        if elapsed > 0.0 and self.times[-1] <= elapsed:
            raise LateTrajectoryError(
                f'all points are in the past, the last by {elapsed - self.times[-1]:.3f} s'
            )

    def after(self, elapsed: float) -> JointPath:
        """Return the points that are not in the past at a time after the start [s], from then."""
        self.check(elapsed)
        if elapsed <= 0.0 or self.stops:
            return self
        kept = [k for k, time in enumerate(self.times) if time > elapsed]
        times = [self.times[k] - elapsed for k in kept]
        columns = (
            [values[k] for k in kept] if values else values
            for values in (self.positions, self.velocities, self.efforts)
        )
        return JointPath(self.joints, times, *columns)

    def only(self, joints: Collection[str]) -> JointPath:
        kept = [k for k, name in enumerate(self.joints) if name in joints]
        columns = (
            [[point[k] for k in kept if k < len(point)] for point in values]
            for values in (self.positions, self.velocities, self.efforts)
        )
        return JointPath([self.joints[k] for k in kept], self.times, *columns)


def joint_values(joint: str, joints: Sequence[str], values: Points) -> list[float | None]:
    """Return the values of one of the `joints` at each point, None at points without one."""
    if joint not in joints:
        raise ParameterError(f'needs the joint {joint!r}, got {list(joints)}')
    index = list(joints).index(joint)
    return [float(point[index]) if len(point) > index else None for point in values]


def check_times(times: Sequence[float]) -> None:
    """Check that times of trajectory points [s] are non-negative and increasing."""
    if not times:
        raise ParameterError('trajectory has no points')
    rule = 'trajectory times must be >= 0 and increasing'
    if times[0] < 0.0:
        raise ParameterError(f'{rule}, got {times[0]:g} s')
    for early, late in pairwise(times):
        if late <= early:
            raise ParameterError(f'{rule}, got {late:g} s after {early:g} s')


class ErrorCode(IntEnum):
    """Error codes of control_msgs/action/FollowJointTrajectory."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class Outcome(NamedTuple):
    """Result of a goal: error code, and its reason for users."""

    code: ErrorCode
    reason: str


class UnknownJointError(ParameterError):
    """A goal names a joint that is not moved, none, or one twice."""


class Tolerance(NamedTuple):
    """Largest errors of a joint: position [m or rad] and velocity; 0 or less without a limit."""

    position: float
    velocity: float

    def excess(self, name: str, joint: FollowedJoint) -> str:
        """Describe an error of a joint beyond the tolerance, '' without one."""
        reference = joint.reference
        for what, limit, desired, actual in zip(
            self._fields, self, reference[:2], joint.actual[:2], strict=True
        ):
            # A push has no position: NaN is not beyond a limit.
            if limit > 0.0 and abs(desired - actual) > limit:
                error = desired - actual
                return f'{what} error of {name} is {error:.6g}, beyond its tolerance {limit:.6g}'
        return ''


@dataclass(slots=True)
class TrajectoryGoal:
    """
    A goal with its tolerances by joint.

    It succeeds when the references of all joints have arrived and the joints are within ``goal``,
    at most ``timeout`` [ns] after the last point (0: any time). Before, they must be within
    ``path``.
    """

    trajectory: JointPath
    path: Mapping[str, Tolerance]
    goal: Mapping[str, Tolerance]
    timeout: int
    stamp: int = 0  #: Stamp of its request [ns].
    moves: bool = False  #: Whether its motion has begun.
    paused: int = 0  #: Time for which it was paused [ns].

    @classmethod
    def from_message(cls, message: Any, joints: Collection[str]) -> TrajectoryGoal:
        trajectory = JointPath.from_message(message.trajectory)
        _check_joints('joint_names', trajectory.joints, joints)
        if trajectory.stops:
            raise ParameterError('trajectory has no points; cancel a goal to stop its joints')
        if message.multi_dof_trajectory.joint_names or message.multi_dof_trajectory.points:
            raise ParameterError('multi_dof_trajectory must be empty')
        for field in ('component_path_tolerance', 'component_goal_tolerance'):
            # They are for multi-DOF joints.
            if names := [one.joint_name for one in getattr(message, field)]:
                raise ParameterError(f'{field} must be empty, got {", ".join(names)}')
        return cls(
            trajectory,
            _tolerances('path_tolerance', message.path_tolerance, trajectory.joints),
            _tolerances('goal_tolerance', message.goal_tolerance, trajectory.joints),
            nanoseconds(message.goal_time_tolerance),
        )

    @property
    def joints(self) -> frozenset[str]:
        return frozenset(self.trajectory.joints)

    def check(self, stamp: int, followed: Mapping[str, FollowedJoint]) -> Outcome | None:
        """Return the outcome at a sample with a stamp [ns], None while the goal is executed."""
        joints = {name: followed[name] for name in self.trajectory.joints}
        waits = [name for name, joint in joints.items() if not joint.reference.arrived]
        limits = self.path if waits else self.goal
        found = (limit.excess(name, joints[name]) for name, limit in limits.items())
        excess = next(filter(None, found), '')
        if waits and excess:
            return Outcome(ErrorCode.PATH_TOLERANCE_VIOLATED, excess)
        if not waits and not excess:
            return Outcome(ErrorCode.SUCCESSFUL, '')
        late = stamp - self.trajectory.end(self.stamp + self.paused)
        if 0 < self.timeout < late:
            reason = excess or f'the reference of {waits[0]} has not arrived'
            late_by = f'{late / NANOSECONDS:.3f} s after the last point'
            return Outcome(ErrorCode.GOAL_TOLERANCE_VIOLATED, f'{reason}, {late_by}')
        return None


def outcome_of(answer: Acknowledgement, now: int) -> Outcome:
    """Return the outcome of a goal whose request is refused at a time [ns]."""
    rejected = answer.verdict is Verdict.REJECTED
    is_old = rejected and is_stale(answer.stamp, now) and answer.stamp < now
    old = answer.verdict is Verdict.LATE or is_old
    code = ErrorCode.OLD_HEADER_TIMESTAMP if old else ErrorCode.INVALID_GOAL
    return Outcome(code, answer.reason)


def _check_joints(field: str, names: Collection[str], valid: Collection[str]) -> None:
    if not names or len({*names}) < len(names) or not {*names} <= {*valid}:
        raise UnknownJointError(
            f'{field} must be some of {", ".join(valid) or "no joint"}, each once, got '
            f'{", ".join(names) or "none"}'
        )


def _tolerances(
    field: str, messages: Iterable[Any], joints: Collection[str]
) -> dict[str, Tolerance]:
    found = {one.name: Tolerance(one.position, one.velocity) for one in messages}
    if found:
        _check_joints(field, [one.name for one in messages], joints)
    for name, tolerance in found.items():
        if not all(isfinite(limit) and (limit >= 0.0 or limit == _ERASED) for limit in tolerance):
            raise ParameterError(
                f'{field} of {name} must be positive, 0 or {_ERASED:g}, got {list(tolerance)}'
            )
    return found
