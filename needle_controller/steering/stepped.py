# SPDX-License-Identifier: Apache-2.0
"""Stepped insertion: the guide moves while the needle rests, then the needle moves."""

from needle_controller.steering.insertion import InsertionStrategy
from needle_controller.steering.law import GuideSetpoint
from needle_controller.steering.motion import JointMotion
from needle_ros.status import SteeringPhase as Phase
import numpy as np


class SteppedInsertion(InsertionStrategy):
    """
    Insert a needle in steps, with a measurement at rest at the end of each.

    The needle moves when the guide has arrived: the path is independent of their speeds.
    """

    def _begin_step(self, to: GuideSetpoint, now: int) -> JointMotion | None:
        goal = self._motions.goal
        goal = np.array([goal[0], to.x, to.z, to.roll])[: len(goal)]
        return self._send(Phase.GUIDING, goal, now)

    def _arrive(self, stamp: int, now: int) -> JointMotion | None:
        if self.phase is Phase.GUIDING and self.law.step:
            goal = np.array([self.law.depths[self.law.step], *self._motions.goal[1:]])
            return self._send(Phase.INSERTING, goal, now)
        return super()._arrive(stamp, now)
