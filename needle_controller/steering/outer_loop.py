"""
The outer loop that steers: look at the tip, move the guide, insert the needle; without ROS.

It asks for motions of needle and guide, whoever makes them: a robot that follows positions, or an
axis law that turns the insertion into forces. The guide moves while the needle rests, and the
needle once the guide has arrived: so the path does not depend on how fast either is. If it is
continuous, the needle goes in without rests, and the guide follows its measured depth.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from math import ceil, sqrt
from time import monotonic
from typing import Final

from needle_controller.safety.stream import Stream
from needle_controller.steering.belief import SteeringBelief
from needle_controller.steering.controller import (
    Guidance,
    SteeringController,
    SteeringFaultError,
    TipEstimate,
)
from needle_controller.steering.look import Look, Seen
from needle_controller.steering.motion import duration_of, Move, smooth
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import OuterLoopSettings
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.contract import ENTRY, JOINT_STATES, ROLL, TIP_DEFLECTION
from needle_ros.errors import JobError, NeedleError, ParameterError
from needle_ros.journal import Journal, Severity
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading
import numpy as np

#: Time in which needle and guide come to rest where something is wrong [s].
_BRAKING: Final = 0.2

#: Time over which the insertion speed is measured [s].
_SPAN: Final = 0.05

#: Time after which a needle that rests is sent again [s], and how often it is sent.
_AGAIN, _TRIES = 1.0, 3

#: Changes from one message to the next that are not believed [m, rad].
_JUMPS: Final = (5e-3, 5e-3, 5e-3, 1.0)

#: How many times the tolerance of a joint at rest one on its way may be off.
_LAGGING: Final = 5.0

#: A needle that moves by less while it settles, rests [m].
_STILL: Final = 1e-4

#: The needle counts as outside tissue up to this depth: there the guide may move at will [m].
_OUTSIDE: Final = 1e-3

#: Depths that are the same [m].
_SAME: Final = 1e-6

#: A plan of so many steps takes some seconds.
_MOST_STEPS: Final = 200

#: What to look at when nothing moves.
_ASKED: Final = 'does what moves it take joint_trajectory?'

#: Readings that scatter so much more than is believed are worth a word.
_SCATTERED: Final = 3.0

#: Half of an interval of 95 % over the standard deviation.
_NORMAL: Final = 1.96


class Phase(Enum):
    """What the loop does."""

    IDLE = 'waits for a target'
    GUIDING = 'the guide moves'
    INSERTING = 'the needle goes in'
    LOOKING = 'looks at the tip'
    DONE = 'is at the target depth'
    STOPPED = 'has stopped'


class OuterLoop:
    """
    Brings the tip to a target in steps, as long as all is well.

    Every event is a method: it takes the time now [ns] of the clock that stamps the messages, and
    returns how needle and guide shall move because of it; None leaves them to what was asked for
    last. `journal` has what there is to say.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue as they are believed.
    steering : SteeringParameters
        What they have beyond.
    belief : SteeringBelief
        How far all that may be wrong.
    settings : OuterLoopSettings
        Steps, looks and limits.
    steady : callable
        As for `Journal`.

    Attributes
    ----------
    settings : OuterLoopSettings
        As given.
    journal : Journal
        What there is to say.
    phase : Phase
        What it does.
    fault : str
        Why it has stopped, '' if it has not.
    control : SteeringController or None
        The controller of the latest insertion.
    expected : TipEstimate or None
        Where the tip will be at the target depth; a new one after each look.

    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters,
        belief: SteeringBelief,
        settings: OuterLoopSettings,
        steady: Callable[[], float] = monotonic,
    ) -> None:
        self._needle, self._steering, self._belief = needle, steering, belief
        self.settings = settings
        self._steady = steady
        self.journal = Journal(steady)
        timeout = settings.measurement_timeout
        frames = ('', ENTRY)
        self._joint_stream = Stream(JOINT_STATES.name, timeout, jumps=_JUMPS)
        self._tip_stream = Stream(TIP_DEFLECTION.name, timeout, frames=frames)
        self._target_stream = Stream('target', timeout, frames=frames, stamped=False)
        self.phase, self.fault = Phase.IDLE, ''
        self.control: SteeringController | None = None
        self.expected: TipEstimate | None = None
        self._depths = np.zeros(1)
        #: Inserted length where the latest insertion began [m].
        self._begun = 0.0
        #: Where the joints are, were sent, and when they shall be there.
        self._at: FloatArray | None = None
        self._origin = self._goal = np.zeros(len(settings.joints))
        self._due = 0
        #: How it was asked to rest, and stamp [ns] and inserted length [m] since then.
        self._halt: Move | None = None
        self._halted: tuple[int, float] | None = None
        #: Largest deviation of a reading of the tip that was seen [m].
        self._scatter = 0.0
        #: Stamp [ns] and inserted length [m] since which the needle rests.
        self._rest: tuple[int, float] | None = None
        self._look: Look | None = None
        #: Stamps between which readings belong to it [ns].
        self._span = 0, 0
        #: On the way: looks at the depths, the last depth that was passed, where the guide is
        #: before and after the next one [m], and when it was sent on, and
        #: when the needle should have gone some way [ns].
        self._passing: dict[int, Look] = {}
        self._passed = self._tries = 0
        self._between = np.zeros((2, 2))
        self._sent = self._overdue = 0
        #: Stamp [ns] and inserted length [m] of some time ago, and insertion speed [m/s].
        self._before: tuple[int, float] | None = None
        self._speed = 0.0
        self._seen: Seen | None = None
        #: Depth of the tip less the inserted length, at the first look [m].
        self._ahead: float | None = None
        self._warned = False
        self._time = 0
        #: A plan takes a moment, in which messages wait: when the first look after it was [ns].
        self._planned: int | None = 0

    @property
    def steers(self) -> bool:
        """Whether an insertion is under way."""
        return self.phase in (Phase.GUIDING, Phase.INSERTING, Phase.LOOKING)

    @property
    def depth(self) -> float:
        """Depth of the target of the latest insertion [m]."""
        return float(self._depths[-1])

    # Wishes of the user.

    def target(
        self, stamp: int, frame: str, point: tuple[float, float, float], now: int
    ) -> Move | None:
        """
        Begin to steer to a target; while steering to its depth, go on to the new one.

        Parameters
        ----------
        stamp : int
            Stamp of the message [ns]; 0 if it has none.
        frame : str
            Its frame.
        point : tuple of float
            Where the tip shall be, x, y, z [m].
        now : int
            Time [ns].

        Returns
        -------
        Move or None
            How to move.

        """
        refusal = self._target_stream.check(stamp, now, frame, point)
        try:
            if refusal is not None:
                raise ParameterError(refusal.line)
            if self.steers:
                self._aim(point)
                return None
            return self._begin(point, now)
        except NeedleError as error:
            self.journal.refuse(f'target refused: {error}')
            return None

    def _aim(self, point: tuple[float, float, float]) -> None:
        depth = self.depth
        if abs(point[1] - depth) > _SAME or self.control is None:
            raise ParameterError(
                f'it steers to a depth of {1e3 * depth:.2f} mm, got {1e3 * point[1]:.2f} mm; '
                '~/stop ends that'
            )
        self.control.aim((point[0], point[2]))
        self._warned = False
        self.journal.say(Severity.INFO, f'steers to {_words(point)} from now on')

    def _begin(self, point: tuple[float, float, float], now: int) -> Move | None:
        settings = self.settings
        for stream in (self._joint_stream, self._tip_stream):
            if stream.publishers > 1:
                raise JobError(f'{stream.publishers} nodes publish {stream.name}')
            if stream.counted is None or stream.silence(now) > settings.measurement_timeout:
                raise JobError(f'{stream.name} does not come')
        if self._at is None:
            raise JobError('where needle and guide are is not known')
        if self._at[0] < -_OUTSIDE:
            raise JobError(f'the needle is {-1e3 * self._at[0]:.2f} mm before the skin')
        depth = max(0.0, float(self._at[0]))
        if self.control is not None and depth > self._begun + _OUTSIDE:
            raise JobError(
                f'the needle is at {1e3 * depth:.2f} mm and has been steered; retract it to '
                f'{1e3 * self._begun:.2f} mm first'
            )
        off = np.abs(self._at[1:3]).max()
        begun = self._begun if self.control is not None else 0.0
        if depth > begun + _OUTSIDE and off > settings.guide_tolerance:
            raise JobError(
                f'the guide is {1e3 * off:.2f} mm off its zero with the needle at '
                f'{1e3 * depth:.2f} mm; a needle has to be straight at the start'
            )
        if point[1] < depth + min(settings.step_length, _OUTSIDE):
            raise ParameterError(
                f'the needle is at {1e3 * depth:.2f} mm already, the target at '
                f'{1e3 * point[1]:.2f} mm'
            )
        steps = max(1, ceil((point[1] - depth) / settings.step_length - _SAME))
        if steps > _MOST_STEPS:
            raise ParameterError(
                f'it would take {steps} steps of {1e3 * settings.step_length:g} mm; {_MOST_STEPS} '
                'may be: make step_length larger'
            )
        depths = np.linspace(depth, point[1], steps + 1)
        asked = self._steady()
        model = SteeringModel(
            self._needle,
            self._steering,
            depths,
            self._belief,
            together=settings.continuous,
        )
        roll = float(self._at[3]) if settings.turns else 0.0
        self.control = SteeringController(
            model,
            (point[0], point[2]),
            settings.guide_limit,
            settings.turns,
            settings.load_limit,
            roll,
            settings.farthest((point[1] - depth) / steps),
        )
        self._planned = None
        self._depths, self._begun = depths, depth
        self.expected, self.fault = None, ''
        self._ahead, self._warned, self._scatter = None, False, 0.0
        self.journal.say(Severity.INFO, f'steers to {_words(point)} in {steps} steps')
        self._goal = np.array([depth, *self._at[1:]])
        straight = self._goal.copy()
        straight[1:3] = 0.0
        # Time has gone on since.
        return self._send(Phase.GUIDING, straight, now + round(1e9 * (self._steady() - asked)))

    def stop(self, why: str, silence: float = 0.0) -> Move | None:
        """
        End the insertion: needle and guide come to rest where they are.

        Parameters
        ----------
        why : str
            For people.
        silence : float
            Age of what is known of where they are [s].

        Returns
        -------
        Move or None
            How to move; None if nothing was under way.

        """
        if not self.steers:
            return None
        moves = self.phase is not Phase.LOOKING
        self.phase, self.fault, self._look = Phase.STOPPED, why, None
        self.journal.say(Severity.ERROR, f'stopped: {why}')
        if not moves or self._at is None:
            return None
        end, limit = self._at.copy(), self.settings.guide_limit
        # It cannot rest at once where it is, and what is said of it may be absurd.
        end[0] += (0.5 * _BRAKING + silence) * self.settings.speed
        end[0] = min(max(end[0], self._origin[0]), self._goal[0])
        end[1:3] = np.clip(end[1:3], -limit, limit)
        joints = self.settings.joints
        self._halt = Move(joints, np.array([_BRAKING]), end[np.newaxis], np.zeros((1, len(end))))
        self._halted, self._tries = None, _TRIES
        return self._halt

    def _still_moves(self, stamp: int, depth: float) -> Move | None:
        """Ask a needle to rest again that goes on after a stop."""
        if self._halted is None:
            self._halted = stamp, depth
        since, before = self._halted
        if self._halt is None or stamp - since < _AGAIN * NANOSECONDS:
            return None
        self._halted, halt = (stamp, depth), self._halt
        self._tries -= 1
        if abs(depth - before) < _STILL or not self._tries:
            self._halt = None
            return None
        self.journal.say(Severity.ERROR, 'the needle goes on after the stop; it is asked again')
        return halt

    # What is measured.

    def joints(self, reading: Reading, now: int) -> Move | None:
        """
        Take in `joint_states`.

        Parameters
        ----------
        reading : Reading
            The message.
        now : int
            Time [ns].

        Returns
        -------
        Move or None
            How to move.

        """
        names, (positions, *_) = reading.names, reading.values
        found = dict(zip(names, positions, strict=False))
        joints = self.settings.joints
        missing = [name for name in joints if name not in found]
        if missing:
            self.journal.refuse(
                f'joint_states lacks a position of {", ".join(missing)}, got names {list(names)}'
            )
            return None
        at = [found[name] for name in joints]
        refusal = self._joint_stream.check(reading.stamp, now, values=at)
        if refusal is not None:
            if not refusal.harmless:
                self.journal.refuse(f'joint_states refused: {refusal.line}')
            return None
        self._at = np.array(at)
        if self.phase is Phase.STOPPED:
            return self._still_moves(reading.stamp, float(self._at[0]))
        if self._astray():
            return self.stop(self._astray())
        if self.phase is Phase.INSERTING and self.settings.continuous:
            return self._follow(reading.stamp, now)
        if self.phase in (Phase.GUIDING, Phase.INSERTING):
            return self._wait(reading.stamp, now)
        if self.phase is Phase.LOOKING and self._missed():
            return self.stop(f'while it looks at the tip {self._missed()}')
        return None

    def _astray(self) -> str:
        """Say which joint has left its way, '' if none has."""
        if not self.steers or self._at is None:
            return ''
        low, high = np.minimum(self._origin, self._goal), np.maximum(self._origin, self._goal)
        room = _LAGGING * self.settings.tolerances
        for k, name in enumerate(self.settings.joints[:3]):
            if not low[k] - room[k] <= self._at[k] <= high[k] + room[k]:
                return (
                    f'{name} is at {1e3 * self._at[k]:.3f} mm, and was sent from '
                    f'{1e3 * self._origin[k]:.3f} to {1e3 * self._goal[k]:.3f} mm'
                )
        return ''

    def _missed(self) -> str:
        """Say which joint is not where it was sent, '' if all are."""
        settings, at, goal = self.settings, self._at, self._goal
        if at is None:
            return ''
        far = np.abs(at - goal) > settings.tolerances
        missed = []
        for k, name in enumerate(settings.joints):
            scale, unit = (1.0, 'rad') if name == ROLL else (1e3, 'mm')
            if far[k]:
                missed.append(
                    f'{name} is at {scale * at[k]:.3f} {unit}, not at {scale * goal[k]:.3f} {unit}'
                )
        return ' and '.join(missed)

    def _wait(self, stamp: int, now: int) -> Move | None:
        """Wait until needle and guide rest where they were sent."""
        if stamp < self._due or self._at is None:
            return None
        missed, depth = self._missed(), float(self._at[0])
        if missed:
            self._rest = None
            late = (stamp - self._due) / NANOSECONDS
            if late > self.settings.patience:
                return self.stop(f'{missed}, {late:.1f} s after it should be; {_ASKED}')
        elif self.phase is Phase.GUIDING and self.control is not None and self.control.step:
            depth = float(self._depths[self.control.step])
            return self._send(Phase.INSERTING, np.array([depth, *self._goal[1:]]), now)
        elif self._rest is None or abs(depth - self._rest[1]) > _STILL:
            self._rest = stamp, depth
        elif stamp - self._rest[0] >= self.settings.settle_time * NANOSECONDS:
            self.phase = Phase.LOOKING
            self._look = Look()
            self._span = stamp, stamp + round(self.settings.look_time * NANOSECONDS)
        return None

    def tip(self, reading: Reading, now: int) -> Move | None:
        """
        Take in `tip_deflection`.

        Parameters
        ----------
        reading, now
            As for `joints`.

        Returns
        -------
        Move or None
            How to move.

        """
        tip = reading.values[0]
        refusal = self._tip_stream.check(reading.stamp, now, reading.frame, tip)
        if refusal is not None:
            if not refusal.harmless:
                self.journal.refuse(f'tip_deflection refused: {refusal.line}')
            return None
        if self._look is not None:
            since, until = self._span
            if since < reading.stamp <= until:
                self._look.take(tip)
            return self._step(now) if reading.stamp >= until else None
        if self.phase is Phase.INSERTING and self.settings.continuous and self._at is not None:
            # Where the needle was then.
            depth = float(self._at[0]) - self._speed * (now - reading.stamp) / NANOSECONDS
            at = int(np.searchsorted(self._depths, depth))
            if 0 < at < len(self._depths):
                look = self._passing.setdefault(at, Look())
                look.take(tip, float(self._depths[at]) - depth)
        return None

    def watch(self, now: int) -> Move | None:
        """
        Look for what does not come, ten times a second or so.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        Move or None
            How to move.

        """
        timeout = self.settings.measurement_timeout
        back, self._time = (self._time - now) / NANOSECONDS, now
        if back > timeout:
            for stream in (self._joint_stream, self._tip_stream, self._target_stream):
                stream.forget()
            return self.stop(f'the clock went back by {back:.3f} s')
        if self._planned is None:
            self._planned = now
        if not self.steers:
            return None
        for stream in (self._joint_stream, self._tip_stream):
            if stream.publishers > 1:
                return self.stop(f'{stream.publishers} nodes publish {stream.name}')
        silence = min(self._joint_stream.silence(now), (now - self._planned) / NANOSECONDS)
        if silence > timeout:
            return self.stop(f'no joint_states for {silence:.2f} s', silence)
        if self._look is not None and now > self._span[1] + timeout * NANOSECONDS:
            return self._step(now)
        return None

    def count_publishers(self, joint_states: int, tip_deflection: int) -> None:
        """
        Take note of how many nodes publish what may have one source only.

        Parameters
        ----------
        joint_states, tip_deflection : int
            Publishers of each.

        """
        self._joint_stream.publishers = joint_states
        self._tip_stream.publishers = tip_deflection

    # Steps.

    def _step(self, now: int) -> Move | None:
        """End a look, and go on by a step."""
        control, look, self._look = self.control, self._look, None
        if control is None or look is None or self._at is None:
            return None
        k = control.step
        try:
            # What came late on the way.
            self._take(control, self._passing.pop(k - 1, None), k - 1)
            self._take(control, look, k, depth=float(self._at[0]))
        except SteeringFaultError as error:
            return self.stop(str(error))
        to = self._planned_at(control, k)
        if k == len(self._depths) - 1:
            self.phase = Phase.DONE
            self.journal.say(Severity.INFO, f'done: {self._outcome()}')
            return None
        if self.settings.continuous:
            self._between = np.array([[0.0, 0.0], [to.x, to.z]])
            self._tries = _TRIES
            return self._set_out(now)
        goal = np.array([self._goal[0], to.x, to.z, to.roll])[: len(self._goal)]
        return self._send(Phase.GUIDING, goal, now)

    def _take(
        self, control: SteeringController, look: Look | None, at: int, depth: float | None = None
    ) -> None:
        """Pass a look on, if there is one; without readings it is one that saw nothing."""
        if look is None:
            return
        self._seen = seen = look.seen(self._belief.noise)
        slip = self._slip(seen, float(self._depths[at]) if depth is None else depth)
        if slip:
            raise SteeringFaultError(slip)
        if seen is None:
            control.see(None, at)
            return
        self._scatter = max(self._scatter, seen.error * sqrt(seen.readings))
        control.see(seen.tip[[0, 2]], at, max(seen.error, self._scatter / sqrt(seen.readings)))

    def _planned_at(self, control: SteeringController, k: int) -> Guidance:
        """Plan the next step, and say what is to be said of it."""
        to = control.plan()
        self.expected = control.expected()
        if k < len(self._depths) - 1 and control.warning and not self._warned:
            self._warned = True
            depth = 1e3 * self._depths[k]
            self.journal.say(Severity.WARNING, f'at {depth:.2f} mm: {control.warning}')
        return to

    # On the way, if it is continuous.

    def _set_out(self, now: int) -> Move:
        """Send the needle to the target depth."""
        begin, end = self._depths[[0]], self._depths[[-1]]
        self.phase, self._rest, self._sent = Phase.INSERTING, None, 0
        self._passing, self._passed, self._before, self._speed = {}, 0, None, 0.0
        self._goal = np.array([end[0], *self._between[1]])
        duration = duration_of(np.array([end[0] - begin[0], 0.0, 0.0]), self.settings)
        self._origin = np.array([begin[0], *self._between[0]])
        self._due = now + round(duration * NANOSECONDS)
        # A smooth motion begins slowly: when it should have gone some way.
        part = (10.0 * _STILL / (10.0 * float(end[0] - begin[0]))) ** (1.0 / 3.0)
        self._overdue = now + round((_AGAIN + min(part, 1.0) * duration) * NANOSECONDS)
        return smooth(self.settings.joints[:1], begin, end, duration)

    def _set_out_again(self, stamp: int, now: int) -> Move | None:
        """Send a needle that does not move again: the message may have been lost."""
        if stamp < self._overdue:
            return None
        self._tries -= 1
        if self._tries:
            return self._set_out(now)
        return self.stop(f'the needle does not move; {_ASKED}')

    def _follow(self, stamp: int, now: int) -> Move | None:
        """Send the guide on as the needle goes, and plan at each depth that it passes."""
        control, at = self.control, self._at
        if control is None or at is None:
            return None
        depth, last = float(at[0]), len(self._depths) - 1
        if self._before is None:
            if depth < self._begun + _STILL:
                return self._set_out_again(stamp, now)
            self._before = stamp, depth
        since = (stamp - self._before[0]) / NANOSECONDS
        if since >= _SPAN:
            self._speed, self._before = (depth - self._before[1]) / since, (stamp, depth)
        while self._passed < last - 1 and depth >= self._depths[self._passed + 1]:
            self._passed += 1
            fault = self._pass(control, at)
            if fault:
                return self.stop(fault)
        if self._passed == last:
            return self._wait(stamp, now)
        if depth >= self._depths[last] - self.settings.depth_tolerance:
            # To the end of the last step, once.
            self._passed, self._due = last, stamp
            return self._guide_to(self._between[1], np.zeros(2), _BRAKING)
        if stamp > self._due + self.settings.patience * NANOSECONDS:
            # The guide is where this depth has it.
            self._goal[1:] = at[1:]
            return self._wait(stamp, now)
        interval = 1.0 / self.settings.rate
        if stamp - self._sent < interval * NANOSECONDS:
            return None
        self._sent = stamp
        low, high = self._depths[self._passed : self._passed + 2].tolist()
        begin, end = self._between
        part = min(max((depth + self._speed * interval - low) / (high - low), 0.0), 1.0)
        way = end - begin
        return self._guide_to(begin + part * way, way * self._speed / (high - low), interval)

    def _guide_to(self, position: FloatArray, velocity: FloatArray, duration: float) -> Move:
        return Move(
            self.settings.joints[1:3],
            np.array([duration]),
            position[np.newaxis],
            velocity[np.newaxis],
        )

    def _pass(self, control: SteeringController, at: FloatArray) -> str:
        """Look back at the depth before one that is passed, and plan; return what is wrong."""
        k, there = self._passed, self._between[1]
        if np.abs(at[1:3] - there).max() > _LAGGING * self.settings.guide_tolerance:
            x, z = 1e3 * at[1:3]
            return (
                f'the guide is at x = {x:.3f} mm, z = {z:.3f} mm at a depth of '
                f'{1e3 * at[0]:.2f} mm, not at {1e3 * there[0]:.3f} mm, {1e3 * there[1]:.3f} mm'
            )
        try:
            if k > 1:
                self._take(control, self._passing.pop(k - 1, Look()), k - 1)
        except SteeringFaultError as error:
            return str(error)
        to = self._planned_at(control, k)
        self._between = np.array([there, [to.x, to.z]])
        self._origin[1:], self._goal[1:] = there, self._between[1]
        return ''

    # What is wrong, and where to.

    def _slip(self, seen: Seen | None, depth: float) -> str:
        """Say that the tip is not as deep as the needle is inserted, '' if it is."""
        if seen is None:
            return ''
        ahead = float(seen.tip[1]) - depth
        if self._ahead is None:
            self._ahead = ahead
        slipped = ahead - self._ahead
        if abs(slipped) <= self.settings.slip_tolerance:
            return ''
        if seen.frozen:
            return f'the sensor of the tip is frozen: {seen.readings} readings are the same'
        return (
            f'the tip is {1e3 * abs(slipped):.2f} mm {"less" if slipped < 0.0 else "more"} deep '
            'than the needle was inserted: it slips, or the sensor is not that of this needle'
        )

    def _send(self, phase: Phase, goal: FloatArray, now: int) -> Move | None:
        """Send needle and guide somewhere."""
        self._origin = begin = self._goal
        self._goal = goal
        self.phase, self._rest = phase, None
        duration = duration_of(goal - begin, self.settings)
        self._due = now + round(duration * NANOSECONDS)
        return smooth(self.settings.joints, begin, goal, duration) if duration > 0.0 else None

    # What is said.

    def _outcome(self) -> str:
        """Say where the tip is thought to be at the end."""
        control, there = self.control, self.expected
        if control is None or there is None:
            return ''
        half = _NORMAL * np.sqrt(np.diag(there.covariance))
        (x, z), off = there.mean, float(np.hypot(*(there.mean - control.target)))
        return (
            f'the tip is at x = {1e3 * x:.2f} ± {1e3 * half[0]:.2f} mm, z = {1e3 * z:.2f} ± '
            f'{1e3 * half[1]:.2f} mm (95 %), {1e3 * off:.2f} mm from the target'
        )

    def diagnose(self, now: int) -> tuple[Severity, str, dict[str, object]]:
        """
        Return how bad it is, the state in one line, and values by name.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        severity : Severity
            How bad it is.
        state : str
            For people.
        values : dict
            Values by name.

        """
        values: dict[str, object] = {}
        control, warning = self.control, ''
        if control is not None:
            x, z = control.target.tolist()
            values['target x, y, z [m]'] = f'{x:.6f}, {self.depth:.6f}, {z:.6f}'
            steps = len(self._depths) - 1
            values['step'] = f'{min(control.step, steps)} of {steps}'
            values['guide x, z [m]'] = f'{self._goal[1]:.6f}, {self._goal[2]:.6f}'
            values['turns left'] = control.turns
            values['chance to come within 1 mm'] = f'{control.chance:.3f}'
            values['bending length over the believed one'] = f'{control.bending:.3f}'
            if self.expected is not None:
                half = _NORMAL * np.sqrt(np.diag(self.expected.covariance))
                for name, mean, wide in zip('xz', self.expected.mean, half, strict=True):
                    values[f'{name} expected at the target depth [m]'] = (
                        f'{mean:.6f} +- {wide:.6f}'
                    )
            if self.steers:
                warning = control.warning
        if self._seen is not None:
            seen, noise = self._seen, self._belief.noise
            values['readings of the last look'] = seen.readings
            values['standard error of the last look [m]'] = f'{seen.error:.2g}'
            if not warning and seen.error > _SCATTERED * noise:
                warning = (
                    f'readings of the tip scatter: a look is good to {1e3 * seen.error:.2f} mm, '
                    f'believed are {1e3 * noise:.2f} mm (belief.noise)'
                )
        values['phase'] = self.phase.value
        values['inputs refused'] = self.journal.refused
        values['last complaint'] = self.journal.complaint
        for stream in (self._joint_stream, self._tip_stream):
            values[f'input {stream.name}'] = stream.describe(now)
        if self.phase is Phase.STOPPED:
            return Severity.ERROR, f'stopped: {self.fault}', values
        if warning:
            return Severity.WARNING, warning, values
        if self.phase is Phase.DONE:
            return Severity.INFO, f'done: {self._outcome()}', values
        return Severity.INFO, self.phase.value, values


def _words(point: tuple[float, float, float]) -> str:
    x, y, z = (1e3 * one for one in point)
    return f'x = {x:.2f} mm, z = {z:.2f} mm at a depth of {y:.2f} mm'
