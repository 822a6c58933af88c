# SPDX-License-Identifier: Apache-2.0
"""Stepped insertion: guide and needle move in turn, with a measurement at rest after each step."""

from needle_controller.steering.guarded_law import GuardedLaw, TipMeasurements
from needle_controller.steering.law import GuideSetpoint, SteeringFaultError
from needle_controller.steering.motion import JointMotion
from needle_controller.steering.motion_control import MotionControl, STILL
from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics.arrays import FloatArray
from needle_ros.status import SteeringPhase as Phase
from needle_ros.timing import NANOSECONDS
import numpy as np


class SteppedInsertion:
    """
    Insert a needle under a steering law: straighten the guide, measure, plan, move.

    The needle moves when the guide has arrived: the path is independent of their speeds.
    Every event is a method that returns a motion to send, or raises a `NeedleError`, which ends
    the insertion. `phase` is GUIDING, INSERTING, MEASURING or DONE.
    """

    def __init__(
        self, law: GuardedLaw, motions: MotionControl, settings: ExecutiveSettings
    ) -> None:
        self.law, self._motions, self._settings = law, motions, settings
        self.phase = Phase.GUIDING
        self._rest: tuple[int, float] | None = None  #: stamp [ns] and depth [m] at its start
        self._measured: TipMeasurements | None = None
        self._span = 0, 0  #: stamps between which readings belong to a measurement at rest [ns]

    def begin(self, at: FloatArray, now: int) -> JointMotion | None:
        """Send the guide from joint positions [m, rad] to its zero, or to its last setpoint."""
        if self.law.step:
            self._motions.goal = at.copy()
            return self._begin_step(self.law.setpoint, now)
        self._motions.goal = np.array([self.law.depths[0], *at[1:]])
        straight = self._motions.goal.copy()
        straight[1:3] = 0.0
        return self._send(Phase.GUIDING, straight, now)

    def _send(self, phase: Phase, goal: FloatArray, now: int) -> JointMotion | None:
        self.phase, self._rest = phase, None
        return self._motions.send(goal, now)

    def resume(self, now: int) -> JointMotion | None:
        """Continue after a pause: move on, or measure again."""
        if self.phase is not Phase.MEASURING:
            self._rest = None
            return self._motions.resume(now)
        self._motions.due = now
        self.measure_again(now)
        return None

    def measure_again(self, now: int) -> None:
        """Discard the measurement under way, and wait for rest at the goal."""
        self._check_patience(self._motions.missed(), now)
        self.phase = Phase.INSERTING if self.law.step else Phase.GUIDING
        self._measured = self._rest = None

    def follow(self, stamp: int, now: int) -> JointMotion | None:
        """Process new positions of the joints: wait until needle and guide rest at their goal."""
        motions = self._motions
        if stamp < motions.due:
            return None
        missed = motions.missed()
        if not missed:
            return self._arrive(stamp, now)
        self._rest = None
        self._check_patience(missed, stamp)
        return None

    def _check_patience(self, missed: str, now: int) -> None:
        late = (now - self._motions.due) / NANOSECONDS
        if late > self._settings.patience:
            raise SteeringFaultError(f'{missed}, {late:.1f} s late')

    def _arrive(self, stamp: int, now: int) -> JointMotion | None:
        """Insert the needle after the guide, or wait for rest, then begin a measurement."""
        if self.phase is Phase.GUIDING and self.law.step:
            goal = np.array([self.law.depths[self.law.step], *self._motions.goal[1:]])
            return self._send(Phase.INSERTING, goal, now)
        depth = float(self._motions.at[0])
        if self._rest is None or abs(depth - self._rest[1]) > STILL:
            self._rest = stamp, depth
        elif stamp - self._rest[0] >= self._settings.settle_time * NANOSECONDS:
            self.phase = Phase.MEASURING
            self._measured = TipMeasurements()
            self._span = stamp, stamp + round(self._settings.measurement_time * NANOSECONDS)
        return None

    def tip(self, stamp: int, tip: tuple[float, ...], now: int) -> JointMotion | None:
        """Process a reading of the tip, x, y, z [m]."""
        if self._measured is None:
            return None
        since, until = self._span
        if since < stamp <= until:
            self._measured.take(tip)
        return self._end_measurement(self._measured, now) if stamp >= until else None

    def watch(self, now: int) -> JointMotion | None:
        """End a measurement whose last readings do not arrive."""
        timeout = self._settings.measurement_timeout
        if self._measured is not None and now > self._span[1] + timeout * NANOSECONDS:
            return self._end_measurement(self._measured, now)
        return None

    def _end_measurement(self, measured: TipMeasurements, now: int) -> JointMotion | None:
        k, self._measured = self.law.step, None
        self.law.update(measured, k, float(self._motions.at[0]))
        to = self.law.plan()
        if k == self.law.steps:
            self.phase = Phase.DONE
            return None
        return self._begin_step(to, now)

    def _begin_step(self, to: GuideSetpoint, now: int) -> JointMotion | None:
        goal = self._motions.goal
        goal = np.array([goal[0], to.x, to.z, to.roll])[: len(goal)]
        return self._send(Phase.GUIDING, goal, now)
