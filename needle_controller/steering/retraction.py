# SPDX-License-Identifier: Apache-2.0
"""Retraction of a steered needle: the guide returns to its zero as the needle is withdrawn."""

from needle_controller.steering.law import SteeringFaultError
from needle_controller.steering.monitor import MotionRefusal
from needle_controller.steering.motion import JointMotion
from needle_controller.steering.motion_control import MotionControl, STILL
from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics.arrays import FloatArray
from needle_ros.contract import INSERTION
from needle_ros.event_log import EventLog, Severity
from needle_ros.requests import REPEAT_AFTER, Verdict
from needle_ros.timing import NANOSECONDS
import numpy as np


class Retraction:
    """
    Withdraw a needle to `retract_depth`, and reduce the guide offset with the insertion depth.

    It begins with the first positions, and is one motion of needle and guide in proportion, so
    that the needle leaves along its path. If a controller withdraws the needle by itself, which
    supersedes the motion, the guide follows the depth, and the retraction ends where the needle
    rests. `ended` is whether needle and guide rest at the end, or it has failed, with the reason
    `failure`.
    """

    def __init__(
        self, motions: MotionControl, settings: ExecutiveSettings, events: EventLog
    ) -> None:
        self._motions, self._settings, self._events = motions, settings, events
        self.ended, self.failure = False, ''
        events.add(Severity.INFO, 'the needle is withdrawn')
        self._begin: FloatArray | None = None  #: positions at the begin [m, rad], shape (joints,)
        self._end = settings.retract_depth  #: depth at the end [m]
        #: Whether another node withdraws the needle; time of the last guide motion then [ns].
        self._follows, self._guided = False, 0
        self._rest = 0, np.inf  #: stamp [ns] and insertion depth [m] since which the needle rests

    def follow(self, stamp: int, now: int) -> JointMotion | None:
        try:
            return None if self.ended else self._follow(stamp, now)
        except SteeringFaultError as error:
            self._fail(str(error))
            return None

    def refuse(self, refusal: MotionRefusal) -> None:
        """Process that a node does not execute the motion."""
        if self.ended:
            return
        if refusal.verdict is Verdict.REJECTED:
            self._fail(str(refusal))
        elif refusal.joints == (INSERTION,):
            self._follows = self._is_deep
        # A motion that another node supersedes does not begin, and is sent again.

    def watch(self, silent: str) -> None:
        """Process that the positions of the joints are not received, if that is not ''."""
        if silent and self._begin is not None and not self.ended:
            self._fail(silent)

    def _fail(self, why: str) -> None:
        self.ended, self.failure = True, f'the retraction has failed: {why}'
        self._events.add(Severity.ERROR, self.failure)

    def _follow(self, stamp: int, now: int) -> JointMotion | None:
        motions, settings = self._motions, self._settings
        if self._begin is None:
            self._begin = motions.at.copy()
            return self._withdraw(now)
        depth = float(motions.at[0])
        if abs(depth - self._rest[1]) > STILL:
            self._rest = stamp, depth
        rest = (stamp - self._rest[0]) / NANOSECONDS
        if self._follows and rest < REPEAT_AFTER:
            return self._follow_depth(now)
        if self._follows:
            # The needle rests at the depth of the other node: the guide returns to its zero.
            self._follows, self._end = False, depth
            return self._withdraw(now)
        if self._is_deep or np.abs(motions.at[1:3]).max() > settings.guide_tolerance:
            late = stamp > motions.due + settings.patience * NANOSECONDS
            overdue = late or motions.monitor.is_late(motions.at, stamp)
            return motions.repeat(now) if overdue else None
        self.ended = rest >= settings.settle_time
        return None

    @property
    def _is_deep(self) -> bool:
        return bool(self._motions.at[0] > self._end + self._settings.depth_tolerance)

    def _withdraw(self, now: int, *, again: bool = False) -> JointMotion | None:
        """Send needle and guide to the end; a needle is never moved into the tissue."""
        motions = self._motions
        self._end = min(self._end, float(motions.at[0]))
        goal = motions.at.copy()
        goal[:3] = self._end, 0.0, 0.0
        move = motions.go(goal, now, again=again)
        motions.again = lambda later: self._withdraw(later, again=True)
        return move

    # Another node withdraws the needle.

    def _follow_depth(self, now: int) -> JointMotion | None:
        motions, interval = self._motions, 1.0 / self._settings.rate
        if self._begin is None or now - self._guided < interval * NANOSECONDS:
            return None
        self._guided = now
        begin, *guide = self._begin[:3]
        # At the end of the guide motion.
        depth = motions.at[0] + motions.velocity * interval
        part = (depth - self._end) / max(begin - self._end, self._settings.depth_tolerance)
        to = min(max(part, 0.0), 1.0) * np.array(guide)
        distance = float(np.hypot(*(to - motions.at[1:3])))
        duration = max(interval, distance / self._settings.guide_speed)
        move = motions.guide_to(to, np.zeros(2), duration, now)
        motions.monitor.stream(move)
        return move
