# SPDX-License-Identifier: Apache-2.0
"""Parser of `joint_commands` messages from ros2_control."""

from collections.abc import Mapping
from math import isnan
from typing import Final, NamedTuple

from needle_ros.contract import INSERTION, ROTATION, STEERING_JOINTS
from needle_ros.errors import ParameterError
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading

_POSITION: Final = 'position'
_VELOCITY: Final = 'velocity'
_EFFORT: Final = 'effort'

_KINDS: Final = (_POSITION, _VELOCITY, _EFFORT)  #: in the order of the message


#: Names of the joints of the guide, in the order of the message.
GUIDE_JOINTS: Final = tuple(joint.name for joint in STEERING_JOINTS)


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
