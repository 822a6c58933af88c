# SPDX-License-Identifier: Apache-2.0
"""Joint motions of needle and guide from rest to rest."""

from math import ceil, sqrt
from typing import Final, NamedTuple

from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics.arrays import FloatArray
import numpy as np

_PEAK: Final = 1.875  #: Highest speed of a smooth motion from rest to rest over its mean.

#: Highest acceleration of such a motion, times its squared duration over its distance; cubics
#: between its points add 5 %.
_STEEPEST: Final = 1.05 * 10.0 / sqrt(3.0)

_POINTS: Final = 20  #: Fewest points of a motion.
_INTERVAL: Final = 0.05  #: Longest time from one point of a motion to the next [s].


class JointMotion(NamedTuple):
    """Joint motion of needle and guide, for a robot or a controller."""

    joints: tuple[str, ...]  #: names of the joints
    times: FloatArray  #: times from the start [s], shape (n,)
    positions: FloatArray  #: positions [m, rad], shape (n, joints)
    velocities: FloatArray  #: velocities [m/s, rad/s], shape (n, joints)
    stamp: int = 0  #: time at which it is sent [ns], which identifies it; 0 until it is sent


def smooth(
    joints: tuple[str, ...], begin: FloatArray, end: FloatArray, duration: float
) -> JointMotion:
    """
    Return a minimum-jerk motion (fifth-order polynomial) from rest to rest of proportional joints.

    ``begin`` and ``end`` are positions [m, rad], shape (joints,); ``duration`` is in s.
    """
    count = max(_POINTS, ceil(duration / _INTERVAL))
    part = np.arange(1, count + 1) / count
    gone = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
    rate = 30.0 * (part * (1.0 - part)) ** 2 / duration
    way = end - begin
    # The last point is exact.
    positions = np.vstack([begin + np.outer(gone[:-1], way), end])
    return JointMotion(joints, duration * part, positions, np.outer(rate, way))


def duration_of(way: FloatArray, settings: ExecutiveSettings) -> float:
    """
    Return the shortest duration [s] of a smooth motion within speed and acceleration limits.

    ``way`` is the displacement of the joints [m, rad], shape (joints,).
    """
    along, across = float(abs(way[0])), float(np.hypot(way[1], way[2]))
    return max(
        _PEAK * along / settings.speed,
        _PEAK * across / settings.guide_speed,
        _PEAK * float(np.abs(way[3:]).sum()) / settings.roll_speed,
        sqrt(_STEEPEST * max(along, across) / settings.acceleration),
    )
