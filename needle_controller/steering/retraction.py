# SPDX-License-Identifier: Apache-2.0
"""Retraction of a steered needle: the guide returns to its zero as the needle is withdrawn."""

from __future__ import annotations

from needle_controller.steering.motion import JointMotion
from needle_controller.steering.motion_control import MotionControl, STILL
from needle_controller.steering.settings import ExecutiveSettings
from needle_ros.requests import REPEAT_AFTER
from needle_ros.timing import NANOSECONDS
import numpy as np


class Retraction:
    """
    Withdraw a needle to `retract_depth`, and reduce the guide offset with the insertion depth.

    The position of the guide is proportional to the remaining distance, so that the needle leaves
    along its path; it is zero at the end. A needle that is not deeper rests. `done` is whether
    needle and guide have arrived.
    """

    def __init__(self, motions: MotionControl, settings: ExecutiveSettings) -> None:
        self._motions, self._settings = motions, settings
        self.done = False
        self._begin = motions.at.copy()
        self._end = min(settings.retract_depth, float(self._begin[0]))
        #: Time of the last guide motion and of the last insertion motion [ns], and the insertion
        #: depth then [m].
        self._guided = 0
        self._sent: tuple[int, float] | None = None

    def follow(self, now: int) -> JointMotion | None:
        """Return the next motion at the present positions; the insertion is repeated if lost."""
        if self.done:
            return None
        motions, settings = self._motions, self._settings
        depth, guide = float(motions.at[0]), motions.at[1:3]
        rest, begin = depth - self._end, float(self._begin[0]) - self._end
        if rest > settings.depth_tolerance:
            if self._is_due(depth, now):
                self._sent = now, depth
                return motions.withdraw(self._end, now)
        elif np.abs(guide).max() <= settings.guide_tolerance:
            self.done = True
        interval = 1.0 / settings.rate
        if self.done or now - self._guided < interval * NANOSECONDS:
            return None
        self._guided = now
        # At the end of the guide motion.
        rest += motions.velocity * interval
        part = min(max(rest / begin, 0.0), 1.0) if begin > settings.depth_tolerance else 0.0
        return motions.guide_toward(part * self._begin[1:3], interval, now)

    def _is_due(self, depth: float, now: int) -> bool:
        """Return whether the withdrawal must be sent: first, or again to a needle at rest."""
        if self._sent is None:
            return True
        since, before = self._sent
        if now - since < REPEAT_AFTER * NANOSECONDS:
            return False
        if abs(depth - before) > STILL:
            self._sent = now, depth
            return False
        return True
