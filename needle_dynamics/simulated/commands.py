# SPDX-License-Identifier: Apache-2.0
"""Commands to a simulated plant: force from one sample to the next, and `joint_commands`."""

from collections.abc import Mapping
from math import exp, inf, isnan
from typing import Final, NamedTuple

from needle_ros.contract import BASE, INSERTION, ROTATION, STEERING_JOINTS
from needle_ros.errors import ParameterError
from needle_ros.timing import apart, NANOSECONDS
from needle_ros.wire import Reading

_POSITION: Final = 'position'
_VELOCITY: Final = 'velocity'
_EFFORT: Final = 'effort'

_KINDS: Final = (_POSITION, _VELOCITY, _EFFORT)  #: in the order of the message

#: Names of the joints of the guide, in the order of the message.
GUIDE_JOINTS: Final = tuple(joint.name for joint in STEERING_JOINTS)


class AppliedForces(NamedTuple):
    """Force command."""

    stamp: int = 0  #: time from which the command is valid [ns]
    force: float = 0.0  #: insertion force [N], positive into the tissue
    torque: float = 0.0  #: torque about the insertion axis [N m]


class Commands:
    """Zero-order hold of force commands with timeout, limits and detection of several sources."""

    # The newest command at a sample acts until the next sample. A command is accepted if its stamp
    # is within the timeout of the present time and not older than the newest stamp. It counts as
    # zero force if it is invalid, when it exceeds the timeout, while several nodes publish
    # commands, and while commands have supplied too much energy. A force may end at once, but its
    # growth rate is limited. Arguments are in s, N, N m, N/s and W; limits apply to either sign.

    def __init__(
        self,
        timeout: float,
        force_limit: float,
        torque_limit: float,
        *,
        interval: float = 1e-3,
        force_rate_limit: float = inf,
        power_limit: float = inf,
    ) -> None:
        self._timeout = timeout * NANOSECONDS
        self._limits = force_limit, torque_limit
        #: Largest growth of the force from one sample to the next [N].
        self._growth = force_rate_limit * interval
        #: Largest energy [J], and its decay factor per sample with a time constant of 1 s.
        self._most_energy, self._left = power_limit, exp(-interval)
        #: Number of commands that were invalid, had a stamp outside the timeout, and arrived after
        #: a newer one (out of order).
        self.refused = self.stale = self.overtaken = 0
        self.stopped = False
        self.begin()

    def begin(self) -> None:
        """Discard all commands and their senders, as at an activation."""
        #: Command that acts until the next sample, and command that acts from then on, unless it
        #: exceeds the timeout by then.
        self.acting = self.newest = AppliedForces()
        #: Number of nodes that publish commands in addition to the first, and of all of them.
        self.duplicates = self._number = 0
        self._ignored_until = 0
        #: Stamps of the samples to which a command may respond, and whether commands do.
        self._samples: dict[int, None] = {}
        self._answers = False
        #: Whether commands have supplied more than the permitted energy; reset at half of it.
        self.exhausted = False
        #: Supplied energy with exponential decay [J].
        self._energy = 0.0

    def forget(self) -> None:
        """Reset the force to zero; commands older than the newest are still discarded."""
        self.acting = self.newest = AppliedForces(self.newest.stamp)

    def offer(
        self, stamp: int, frame: str, force: float, torque: float, now: int
    ) -> tuple[bool, str]:
        """Process a command; return whether it is accepted, and the error message or ''."""
        # ``stamp`` and ``now`` in ns (stamp 0: now). An invalid command is accepted as zero force.
        # The stamp is the only identification of the sender: a command with the stamp of a sample
        # responds to this sample. After such a response, a force with any other stamp is from
        # another node, however short its lifetime, and is rejected until their number changes.
        answers = stamp in self._samples
        stamp = stamp or now
        age = now - stamp
        if abs(age) > self._timeout:
            self.stale += 1
            return False, (
                f'command ignored, its stamp is {apart(age)}: command_timeout is '
                f'{self._timeout / NANOSECONDS:g} s'
            )
        if self._answers and not answers and (force or torque):
            self.refused += 1
            return False, (
                'command ignored, its stamp matches no sample: it is not from the node that '
                'answers samples'
            )
        self._answers |= answers
        # A newest stamp in the future dates from before the clock was set back.
        if stamp < self.newest.stamp <= now + self._timeout:
            self.overtaken += 1
            return False, ''
        error = self._error(frame, force, torque)
        if error:
            self.refused += 1
        # While several nodes publish commands no force acts, and their commands must expire.
        acts = not error and self.may_move(now)
        self.newest = AppliedForces(stamp, force, torque) if acts else AppliedForces(stamp)
        return True, error

    def _error(self, frame: str, force: float, torque: float) -> str:
        if frame not in ('', BASE):
            return f'a command must be in {BASE}, got {frame!r}; no force is applied'
        largest, strongest = self._limits
        # Written so that NaN is rejected too.
        if not (abs(force) <= largest and abs(torque) <= strongest):
            return (
                f'a command must be within force_limit, {largest:g} N, and torque_limit, '
                f'{strongest:g} N m, got {force} N and {torque} N m; no force is applied'
            )
        return ''

    def refuse(self) -> None:
        self.refused += 1
        self.newest = AppliedForces(self.newest.stamp)

    def may_move(self, now: int) -> bool:
        """Return whether commands may act at a time [ns], with a single sender."""
        return not (self.stopped or self.duplicates) and now >= self._ignored_until

    def stop(self) -> None:
        """End the force; no command acts while `stopped`."""
        self.stopped = True
        self.newest = AppliedForces(self.newest.stamp)

    def ignore(self, now: int) -> None:
        """Ignore commands for the timeout; a short-lived node may have sent some."""
        self._ignored_until = now + round(self._timeout)
        self._answers = False
        self.newest = AppliedForces(self.newest.stamp)

    def count_commanders(self, number: int) -> bool:
        """Update the number of publishers; return whether a conflict has begun or ended."""
        # Then no force acts until the next command.
        duplicates = max(0, number - 1)
        if number != self._number:
            self._number, self._answers = number, False
        if duplicates == self.duplicates:
            return False
        self.duplicates = duplicates
        self.newest = AppliedForces(self.newest.stamp)
        return True

    def hold(self, stamp: int, distance: float = 0.0) -> None:
        """Hold the newest command from a stamp [ns] on, unless it exceeds the timeout."""
        # ``distance`` is the displacement under the previous command [m], for the supplied energy.
        samples, before, newest = self._samples, self.acting.force, self.newest
        samples[stamp] = None
        while (first := next(iter(samples))) < stamp - self._timeout or first > stamp:
            del samples[first]
        self._energy = self._left * self._energy + max(0.0, before * distance)
        self.exhausted = self._energy > (0.5 if self.exhausted else 1.0) * self._most_energy
        if self.exhausted or stamp - newest.stamp > self._timeout:
            self.acting = AppliedForces(newest.stamp)
            return
        growth = self._growth
        force = min(max(newest.force, min(before, 0.0) - growth), max(before, 0.0) + growth)
        self.acting = newest if force == newest.force else newest._replace(force=force)


def moved_joints(mode: str, *, steered: bool) -> tuple[str, ...]:
    """Return the joints of a needle that follow positions."""
    insertion = (INSERTION,) if mode == 'robot' else ()
    return (*insertion, *GUIDE_JOINTS) if steered else insertion


class JointSetpoints(NamedTuple):
    """Target positions [m or rad] by joint, with the time to reach them [s]."""

    goals: dict[str, float]
    within: float


class Asked(NamedTuple):
    """Content of a `joint_commands` message."""

    #: Axial force [N] and torque [N m]; NaN if an effort that was a number is now NaN.
    force: float
    torque: float
    motions: list[JointSetpoints]  #: joint motions, only where the message has new values
    stamp: int  #: stamp of the message [ns]
    given: dict[tuple[str, str], float]  #: latest numbers by kind and joint


class JointCommands:
    """Parser of successive `joint_commands` messages, for a period and a command timeout [s]."""

    def __init__(self, mode: str, *, steered: bool, shortest: float, longest: float) -> None:
        # The hardware interface sends all interfaces at its own rate: a value not yet set is NaN
        # and has no effect, but a number must remain a number. A position is the end of a linear
        # motion since the last message. A velocity without a position lasts for the timeout.
        moved, pushed = moved_joints(mode, steered=steered), tuple[str, ...]()
        if mode == 'simulation':
            pushed = (INSERTION,) if steered else (INSERTION, ROTATION)
        #: Joints that accept each kind of command.
        self._takes = {_POSITION: moved, _VELOCITY: moved, _EFFORT: pushed}
        self._shortest, self._longest = shortest, longest
        self.forget()

    def forget(self) -> None:
        """Discard all messages, as at an activation."""
        self._stamp: int | None = None
        #: Latest numbers by kind and joint.
        self._given: dict[tuple[str, str], float] = {}

    def read(self, reading: Reading, at: Mapping[str, float], now: int) -> Asked:
        """Parse a message, without effect before `accept`; ``now`` [ns] replaces a zero stamp."""
        stamp = reading.stamp or now
        new = {
            (kind, joint): value
            for kind, values in zip(_KINDS, self._by_joint(reading), strict=True)
            for joint, value in values.items()
            if self._is_asked(kind, joint, value)
        }
        goals, lasting = {}, {}
        for (kind, joint), value in new.items():
            before = self._given.get((kind, joint))
            if kind == _POSITION and value != before:
                goals[joint] = value
            # A zero velocity is sent once.
            if kind == _VELOCITY and (_POSITION, joint) not in new and (value or before):
                lasting[joint] = at.get(joint, 0.0) + value * self._longest
        motions = [
            JointSetpoints(goals, self._passed(stamp)),
            JointSetpoints(lasting, self._longest),
        ]
        return Asked(
            force=new.get((_EFFORT, INSERTION), 0.0),
            torque=new.get((_EFFORT, ROTATION), 0.0),
            motions=[motion for motion in motions if motion.goals],
            stamp=stamp,
            given={**self._given, **new},
        )

    def accept(self, asked: Asked) -> None:
        """Accept a message as reference for the next one."""
        self._stamp, self._given = asked.stamp, asked.given

    def _passed(self, stamp: int) -> float:
        """Return the time since the previous message [s], limited to the range of motion times."""
        passed = self._longest if self._stamp is None else (stamp - self._stamp) / NANOSECONDS
        return min(max(passed, self._shortest), self._longest)

    @staticmethod
    def _by_joint(reading: Reading) -> list[dict[str, float]]:
        names = reading.names
        if len({*names}) < len(names):
            raise ParameterError(f'names a joint twice: {", ".join(names)}')
        for kind, values in zip(_KINDS, reading.values, strict=True):
            if len(values) not in (0, len(names)):
                raise ParameterError(
                    f'must have no {kind} or one for each of its {len(names)} joints, got '
                    f'{len(values)}: declare the same command interfaces for all joints of the '
                    'hardware'
                )
        # An array may be empty.
        return [dict(zip(names, values, strict=False)) for values in reading.values]

    def _is_asked(self, kind: str, joint: str, value: float) -> bool:
        """Return whether a value has an effect; it must be accepted by the joint."""
        if isnan(value) and (kind, joint) not in self._given:
            return False
        if joint in self._takes[kind]:
            return True
        # Value left by a controller when it ends.
        if kind != _POSITION and not value:
            return False
        joints = ', '.join(self._takes[kind]) or 'no joint'
        raise ParameterError(
            f'got the {kind} {value:g} of {joint}; in this mode the plant takes it for {joints}'
        )
