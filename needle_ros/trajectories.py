"""Points of a joint trajectory, as trajectory_msgs/JointTrajectory has them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from needle_ros.errors import ParameterError

#: Points that a path may have: a million of bad ones would take seconds.
MOST_POINTS: Final = 10_000


def joint_values(
    joint: str, joints: Sequence[str], values: Sequence[Sequence[float]]
) -> list[float | None]:
    """
    Pick one joint from the points of a trajectory.

    Parameters
    ----------
    joint : str
        Name of the joint.
    joints : sequence of str
        Names of all joints of the trajectory.
    values : sequence of sequence of float
        Values of the joints at each point; may be empty.

    Returns
    -------
    list of float or None
        Value of the joint at each point, None where it has none.

    Raises
    ------
    ParameterError
        If the joint is not among them.

    """
    if joint not in joints:
        raise ParameterError(f'needs the joint {joint!r}, got {list(joints)}')
    index = list(joints).index(joint)
    return [float(point[index]) if len(point) > index else None for point in values]


def check_times(times: Sequence[float]) -> None:
    """
    Refuse times of a trajectory that it cannot have.

    Parameters
    ----------
    times : sequence of float
        Time of each point from the start [s].

    Raises
    ------
    ParameterError
        If there is none, the first is negative, or they do not increase.

    """
    if not times:
        raise ParameterError('trajectory has no points')
    if times[0] < 0.0 or any(late <= early for early, late in pairwise(times)):
        raise ParameterError(f'trajectory times must be >= 0 and increasing, got {list(times)} s')
