# SPDX-License-Identifier: Apache-2.0
"""Joint motions of needle and guide from rest to rest."""

from math import ceil, sqrt
from typing import Final, NamedTuple

from needle_controller.reference.quintic import Quintic
from needle_controller.reference.setpoint import Setpoint
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
    """Return a minimum-jerk motion from rest to rest [m, rad] in a duration [s]."""
    count = max(_POINTS, ceil(duration / _INTERVAL))
    times = duration * (np.arange(1, count + 1) / count)
    unit, shift = Quintic(Setpoint(0.0), Setpoint(1.0), duration), end - begin
    parts, rates, _ = np.array([unit.at(time) for time in times.tolist()]).T
    # The last point is exact.
    positions = np.vstack([begin + np.outer(parts[:-1], shift), end])
    return JointMotion(joints, times, positions, np.outer(rates, shift))


def duration_of(shift: FloatArray, settings: ExecutiveSettings) -> float:
    """Return the shortest duration [s] of a smooth motion of the joints by a shift [m, rad]."""
    along, across = float(abs(shift[0])), float(np.hypot(shift[1], shift[2]))
    return max(
        _PEAK * along / settings.speed,
        _PEAK * across / settings.guide_speed,
        _PEAK * float(np.abs(shift[3:]).sum()) / settings.roll_speed,
        sqrt(_STEEPEST * max(along, across) / settings.acceleration),
    )
