# SPDX-License-Identifier: Apache-2.0
"""Motion control of an insertion: motions, their repetition, the stop, and the retraction."""

from collections.abc import Callable
from typing import Final

from needle_controller.steering.guarded_law import SAME
from needle_controller.steering.law import SteeringFaultError
from needle_controller.steering.motion import (
    duration_of,
    JointMotion,
    MotionMonitor,
    MotionRefusal,
    smooth,
)
from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics.arrays import BoolArray, FloatArray
from needle_ros.contract import INSERTION, ROLL
from needle_ros.event_log import EventLog, Severity
from needle_ros.requests import REPEAT_AFTER, Verdict
from needle_ros.timing import NANOSECONDS
import numpy as np

BRAKING: Final = 0.2  #: Time in which needle and guide brake to rest after a stop [s].
_OLD: Final = NANOSECONDS  #: Age of positions at which a robot may be elsewhere [ns].
_HELD: Final = 6  #: Number of points of a stop: if it arrives within a second, one is not past.
LAGGING: Final = 5.0  #: Tolerance of a moving joint, as a multiple of its tolerance at rest.

#: Time after which a stop is sent again to a needle that still moves [s], and number of stops.
_STOP_AGAIN, _STOPS = 0.5, 4
_BRAKES: Final = 0.3  #: Time after a stop in which motion is braking, also after a dead time [s].
_SPAN: Final = 0.05  #: Time over which the velocity of the needle is measured [s].
STILL: Final = 1e-4  #: Largest displacement of a needle at rest [m].


class MotionControl:
    """Create the motions of needle and guide, check that they are followed, and stop them."""

    def __init__(self, settings: ExecutiveSettings, events: EventLog) -> None:
        self._settings, self._events = settings, events
        self.monitor = MotionMonitor(settings.joints, settings.tolerances)
        self.at = np.full(len(settings.joints), np.nan)  #: measured positions [m, rad]
        self._measured = 0  #: their stamp [ns]
        #: Velocity of the needle [m/s]; stamp [ns] and depth [m] from which it is measured.
        self.velocity = 0.0
        self._before: tuple[int, float] | None = None
        #: Positions at the start and at the end of the motion [m, rad], shape (joints,); time at
        #: which it should end [ns]; creates it again at a time [ns], from the present positions.
        self.origin = self.goal = np.zeros(len(settings.joints))
        self.due = 0
        self.again: Callable[[int], JointMotion | None] = lambda _now: None
        self._stamp = 0  #: stamp of the newest motion [ns], unique for each motion
        #: Positions of the stop, stamp [ns] and insertion depth [m] of the last check for rest,
        #: and number of stops left to send.
        self._halt: FloatArray | None = None
        self._halted: tuple[int, float] | None = None
        self._stops = 0

    @property
    def known(self) -> bool:
        """Whether the positions have been measured."""
        return bool(np.isfinite(self.at).all())

    def restart(self) -> None:
        """Accept earlier times, after a clock was set back."""
        self._stamp, self._before = 0, None

    def measure(self, at: FloatArray, stamp: int) -> None:
        """Take measured positions of the joints [m, rad] with their stamp [ns]."""
        self.at, self._measured = at, stamp
        before = self._before or (stamp, float(at[0]))
        elapsed = (stamp - before[0]) / NANOSECONDS
        if elapsed >= _SPAN:
            self.velocity = (float(at[0]) - before[1]) / elapsed
        if self._before is None or elapsed >= _SPAN:
            self._before = stamp, float(at[0])

    def depth_at(self, stamp: int) -> float:
        """Return the insertion depth [m] at a time [ns] near the last measurement."""
        return float(self.at[0]) + self.velocity * (stamp - self._measured) / NANOSECONDS

    # Motions.

    def send(self, goal: FloatArray, now: int) -> JointMotion | None:
        """Send needle and guide to positions [m, rad], from their last goal."""
        self.origin, self.goal = self.goal, goal
        return self._move(now, self.origin)

    def go(self, goal: FloatArray, now: int, *, again: bool = False) -> JointMotion | None:
        """Send needle and guide to positions [m, rad], from their present positions."""
        self.origin, self.goal = self.at.copy(), goal
        return self._move(now, self.origin, again=again)

    def _move(self, now: int, begin: FloatArray, *, again: bool = False) -> JointMotion | None:
        duration = duration_of(self.goal - begin, self._settings)
        self.due = now + round(duration * NANOSECONDS)
        if np.abs(self.goal - begin).max() < SAME:
            # Too short: the times of the points would be equal.
            self.monitor.forget()
            return None
        # Repeated from the present positions, without a jump.
        self.again = lambda later: self._move(later, self.at, again=True)
        move = self._stamped(smooth(self._settings.joints, begin, self.goal, duration), now)
        self.monitor.begin(move, self.at, again=again)
        return move

    def insert(self, begin: float, now: int, *, again: bool = False) -> JointMotion:
        """Send the needle alone to its goal, from a depth [m]."""
        end = self.goal[:1].copy()
        duration = duration_of(np.array([end[0] - begin, 0.0, 0.0]), self._settings)
        self.due = now + round(duration * NANOSECONDS)
        joints = self._settings.joints[:1]
        move = self._stamped(smooth(joints, np.array([begin]), end, duration), now)
        self.monitor.begin(move, self.at, again=again)
        return move

    def guide_to(
        self, position: FloatArray, velocity: FloatArray, duration: float, now: int
    ) -> JointMotion:
        """Send the guide to a position [m] with a velocity [m/s] in a duration [s]."""
        guide, times = self._settings.joints[1:3], np.array([duration])
        return self._stamped(JointMotion(guide, times, position[None], velocity[None]), now)

    def _stamped(self, move: JointMotion, now: int) -> JointMotion:
        """Return a motion with a unique stamp: simulated time may stand still."""
        self._stamp = max(now, self._stamp + 1)
        return move._replace(stamp=self._stamp)

    # Checks.

    def repeat(self, now: int) -> JointMotion | None:
        """Send the motion again: the message may have been lost, or was not needed before."""
        if not self.monitor.sent:
            return self.again(now)
        pending = self.monitor.pending
        failure = f'{self.missed(pending if pending.any() else None)}: {self.monitor.failure()}'
        if self.monitor.exhausted:
            raise SteeringFaultError(failure)
        self._events.add(Severity.WARNING, f'{failure}; sent again')
        return self.again(now)

    def departure(self) -> str:
        """Describe the first joint outside its motion, '' if none is."""
        low, high = np.minimum(self.origin, self.goal), np.maximum(self.origin, self.goal)
        room = LAGGING * self._settings.tolerances
        for k, name in enumerate(self._settings.joints[:3]):
            if not low[k] - room[k] <= self.at[k] <= high[k] + room[k]:
                return (
                    f'{name} is at {1e3 * self.at[k]:.3f} mm, outside its motion from '
                    f'{1e3 * self.origin[k]:.3f} to {1e3 * self.goal[k]:.3f} mm'
                )
        return ''

    @property
    def beyond(self) -> bool:
        """Whether the needle is deeper than the end of its motion."""
        return bool(self.at[0] > self.goal[0] + LAGGING * self._settings.depth_tolerance)

    def away(self, factor: float = 1.0) -> BoolArray:
        """Return which joints are beyond a multiple of their tolerance from their goal."""
        return np.asarray(np.abs(self.at - self.goal) > factor * self._settings.tolerances)

    def missed(self, which: BoolArray | None = None) -> str:
        """Describe the joints (or given joints) that are not at their goal, '' if all are."""
        far = self.away() if which is None else which
        scaled = [(1.0, 'rad') if name == ROLL else (1e3, 'mm') for name in self._settings.joints]
        rows = zip(self._settings.joints, scaled, self.at, self.goal, far, strict=True)
        return ' and '.join(
            f'{name} is at {scale * at:.3f} {unit}, not at {scale * goal:.3f} {unit}'
            for name, (scale, unit), at, goal, missed in rows
            if missed
        )

    # Stops.

    def stop(self, now: int) -> JointMotion:
        """Brake needle and guide to rest at their positions, and monitor that they rest."""
        self._halted, self._stops = None, _STOPS
        move = self._send_stop(self._braked(), now)
        if not len(move.times):
            self.discard_stop()
        return move

    def pause(self, now: int) -> JointMotion:
        """Brake needle and guide to rest at their positions."""
        self.discard_stop()
        return self._brake(self._braked(), now)

    def resume(self, now: int) -> JointMotion | None:
        """Continue the motion after a pause."""
        self.monitor.forget()
        return self.again(now)

    def _braked(self) -> FloatArray:
        """Return the positions at which needle and guide come to rest [m, rad]."""
        end = self.at.copy()
        # A needle that rests, or whose positions are implausible, is not moved into the tissue,
        # nor one that is withdrawn: it brakes on its way.
        moving = min(max(self.velocity, -self._settings.speed), self._settings.speed)
        end[0] = min(end[0] + 0.5 * BRAKING * moving, max(self.origin[0], self.goal[0]))
        end[0] = max(end[0], min(self.origin[0], 0.0))
        end[1:3] = np.clip(end[1:3], -self._settings.guide_limit, self._settings.guide_limit)
        return end

    @property
    def _in_range(self) -> bool:
        """Whether the guide is in its range: a position elsewhere is wrong, such as one in mm."""
        room = LAGGING * self._settings.guide_tolerance
        return bool(np.abs(self.at[1:3]).max() <= self._settings.guide_limit + room)

    def discard_stop(self) -> None:
        """Do not send the last stop again: it would end the next motion."""
        self._halt = None

    def _send_stop(self, end: FloatArray, now: int) -> JointMotion:
        self._halt = end
        self._stops -= 1
        return self._brake(end, now)

    def _brake(self, end: FloatArray, now: int) -> JointMotion:
        # Without points, the joints brake and hold where they are.
        count = _HELD if now - self._measured < _OLD and self._in_range else 0
        held = np.tile(end, (count, 1))
        times = BRAKING * np.arange(1.0, count + 1.0)
        move = JointMotion(self._settings.joints, times, held, np.zeros_like(held))
        move = self._stamped(move, now)
        self.monitor.forget()
        self.monitor.stream(move)
        return move

    def stop_again(self, stamp: int, now: int) -> JointMotion | None:
        """Send the stop again to a needle that still advances; never beyond its present depth."""
        depth = float(self.at[0])
        if self._halted is None:
            self._halted = stamp, depth
        since, before = self._halted
        if stamp - since <= _BRAKES * NANOSECONDS:
            self._halted = since, depth
        if self._halt is None or stamp - since < _STOP_AGAIN * NANOSECONDS:
            return None
        self._halted = stamp, depth
        if depth - before < STILL:
            # A needle that is withdrawn, for example by hand, may advance later.
            self._halt = None if depth - before > -STILL else self._halt
            return None
        if not self._stops:
            self._halt = None
            self._events.add(Severity.ERROR, f'the needle still moves after {_STOPS} stops')
            return None
        self._events.add(
            Severity.ERROR, 'the needle still moves after the stop; stop command sent again'
        )
        end = self._halt.copy()
        end[0] = min(end[0], depth)
        return self._send_stop(end, now)


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
        events.add(Severity.INFO, 'the needle is being withdrawn')
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
        if silent and not self.ended:
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
