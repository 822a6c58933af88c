# SPDX-License-Identifier: Apache-2.0
"""Trajectories of joints: points, validation, and start time."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple, TypeAlias

from needle_ros.errors import ParameterError
from needle_ros.timing import NANOSECONDS, seconds

#: Maximum number of points: checking a million invalid points would take seconds.
MOST_POINTS: Final = 10_000

#: A number of each joint at each point, or none at a point.
Points: TypeAlias = Sequence[Sequence[float]]


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


class LateTrajectoryError(ParameterError):
    """All points of a trajectory are in the past."""


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
    if times[0] < 0.0 or any(late <= early for early, late in pairwise(times)):
        raise ParameterError(f'trajectory times must be >= 0 and increasing, got {list(times)} s')
