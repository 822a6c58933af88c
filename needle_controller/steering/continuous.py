# SPDX-License-Identifier: Apache-2.0
"""Continuous insertion: the needle moves without rest, and the guide follows its depth."""

from needle_controller.steering.guarded_law import GuardedLaw, TipMeasurements
from needle_controller.steering.insertion import SteppedInsertion
from needle_controller.steering.law import GuideSetpoint, SteeringFaultError
from needle_controller.steering.motion import JointMotion
from needle_controller.steering.motion_control import BRAKING, LAGGING, MotionControl, STILL
from needle_controller.steering.settings import ExecutiveSettings
from needle_ros.status import SteeringPhase as Phase
from needle_ros.timing import NANOSECONDS
import numpy as np


class ContinuousInsertion(SteppedInsertion):
    """Insert a needle without rests, with measurements in motion; the guide follows its depth."""

    def __init__(
        self, law: GuardedLaw, motions: MotionControl, settings: ExecutiveSettings
    ) -> None:
        super().__init__(law, motions, settings)
        #: Measurements at the depths, and the last depth that was passed.
        self._passing: dict[int, TipMeasurements] = {}
        self._passed = 0
        self._between = np.zeros((2, 2))  #: positions of the guide around the next depth [m]
        self._sent = 0  #: time of the last guide motion [ns]
        self._moved = False  #: whether the needle has begun to move

    def _begin_step(self, to: GuideSetpoint, now: int) -> JointMotion | None:
        self._between = np.array([[0.0, 0.0], [to.x, to.z]])
        self.phase, self._rest = Phase.INSERTING, None
        return self._insert(now, float(self.law.depths[0]))

    def _insert(self, now: int, begin: float, *, again: bool = False) -> JointMotion:
        motions, depths = self._motions, self.law.depths
        motions.origin = np.array([depths[0], *self._between[0]])
        motions.goal = np.array([depths[-1], *self._between[1]])
        # From the present depth, within the motion.
        motions.again = lambda later: self._insert(
            later, float(np.clip(motions.at[0], motions.origin[0], motions.goal[0])), again=True
        )
        return motions.insert(begin, now, again=again)

    def follow(self, stamp: int, now: int) -> JointMotion | None:
        """Send the guide with the needle, and plan at each passed depth."""
        if self.phase is not Phase.INSERTING:
            return super().follow(stamp, now)
        motions, depths, settings = self._motions, self.law.depths, self._settings
        depth, last = float(motions.at[0]), self.law.steps
        self._moved |= depth >= depths[0] + STILL
        if not self._moved:
            return None
        while self._passed < last - 1 and depth >= depths[self._passed + 1]:
            self._passed += 1
            self._pass()
        if self._passed == last:
            return super().follow(stamp, now)
        if depth >= depths[last] - settings.depth_tolerance:
            self._passed, motions.due = last, stamp
            return self._end_guide(now)
        if stamp > motions.due + settings.patience * NANOSECONDS:
            # The guide is at its setpoint of this depth.
            motions.goal[1:] = motions.at[1:]
            return super().follow(stamp, now)
        interval = 1.0 / settings.rate
        if stamp - self._sent < interval * NANOSECONDS:
            return None
        self._sent = stamp
        low, high = depths[self._passed : self._passed + 2].tolist()
        begin, end = self._between
        part = min(max((depth + motions.velocity * interval - low) / (high - low), 0.0), 1.0)
        rate = (end - begin) * motions.velocity / (high - low)
        move = motions.guide_to(begin + part * (end - begin), rate, interval, now)
        motions.monitor.stream(move)
        return move

    def _end_guide(self, now: int, *, again: bool = False) -> JointMotion:
        """Send the guide to the end of the last step, with a check of its arrival."""
        motions = self._motions
        motions.again = lambda later: self._end_guide(later, again=True)
        move = motions.guide_to(self._between[1], np.zeros(2), BRAKING, now)
        motions.monitor.begin(move, motions.at, again=again, arrives=True)
        return move

    def _pass(self) -> None:
        k, at, there = self._passed, self._motions.at, self._between[1]
        if np.abs(at[1:3] - there).max() > LAGGING * self._settings.guide_tolerance:
            x, z = 1e3 * at[1:3]
            raise SteeringFaultError(
                f'the guide is at x = {x:.3f} mm, z = {z:.3f} mm at a depth of '
                f'{1e3 * at[0]:.2f} mm, not at {1e3 * there[0]:.3f} mm, {1e3 * there[1]:.3f} mm'
            )
        if k > 1:
            self.law.update(self._passing.pop(k - 1, TipMeasurements()), k - 1)
        to = self.law.plan()
        self._between = np.array([there, [to.x, to.z]])
        self._motions.origin[1:], self._motions.goal[1:] = there, self._between[1]

    def _end_measurement(self, measured: TipMeasurements, now: int) -> JointMotion | None:
        """Pass the measurement in motion before it to the law as well."""
        k = self.law.step - 1
        readings = self._passing.pop(k, None)
        if readings is not None:
            self.law.update(readings, k)
        return super()._end_measurement(measured, now)

    def tip(self, stamp: int, tip: tuple[float, ...], now: int) -> JointMotion | None:
        """Process a reading of the tip, x, y, z [m], at rest or in motion."""
        if self.phase is not Phase.INSERTING:
            return super().tip(stamp, tip, now)
        # Insertion depth at the time of the reading.
        depths, depth = self.law.depths, self._motions.depth_at(stamp)
        at = int(np.searchsorted(depths, depth))
        if 0 < at < len(depths):
            readings = self._passing.setdefault(at, TipMeasurements())
            readings.take(tip, float(depths[at]) - depth)
        return None
