"""Validation of trajectory_msgs/JointTrajectory points."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, TypeAlias

from needle_ros.errors import ParameterError

#: Maximum number of points: checking a million invalid points would take seconds.
MOST_POINTS: Final = 10_000

#: A number of each joint at each point, or none at a point.
Points: TypeAlias = Sequence[Sequence[float]]


def joint_values(joint: str, joints: Sequence[str], values: Points) -> list[float | None]:
    """
    Return the values of one joint at each point of a trajectory, None at points without one.

    `joints` are the joint names of the trajectory; `ParameterError` if the joint is not among
    them.
    """
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
