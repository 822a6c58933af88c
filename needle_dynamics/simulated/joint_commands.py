"""What a message of `joint_commands` asks for, as ros2_control fills it."""

from __future__ import annotations

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

#: In the order of the message.
_KINDS: Final = (_POSITION, _VELOCITY, _EFFORT)


class Motion(NamedTuple):
    """
    Where joints shall go.

    Attributes
    ----------
    goals : dict
        Position [m or rad] by joint.
    within : float
        Time in which they shall be there [s].

    """

    goals: dict[str, float]
    within: float


class Asked(NamedTuple):
    """
    What a message asks for.

    Attributes
    ----------
    force, torque : float
        Force along the needle [N] and torque [N m]; NaN if an effort that was a number is none.
    motions : list of Motion
        Where joints shall go, as far as the message says anything new.
    stamp : int
        Its time [ns].
    given : dict
        Numbers given so far, by kind and joint.

    """

    force: float
    torque: float
    motions: list[Motion]
    stamp: int
    given: dict[tuple[str, str], float]


class JointCommands:
    """
    Reads the messages of `joint_commands` one after the other.

    The hardware interface sends all interfaces at its own rate, whether a controller sets them or
    not: what nobody has set yet is NaN and asks for nothing. What has been a number must stay one.
    A position is the end of a line that begins where the joint is and takes as long as it was
    from the last message to this one. A velocity without a position lasts for the timeout.

    Parameters
    ----------
    mode : str
        Mode of the plant.
    steered : bool
        Whether its needle is steered.
    shortest, longest : float
        Period of the plant, and time after which a command is too old [s].

    """

    def __init__(self, mode: str, *, steered: bool, shortest: float, longest: float) -> None:
        guide = tuple(joint.name for joint in STEERING_JOINTS) if steered else ()
        #: Joints that take each kind of command.
        self._takes: dict[str, tuple[str, ...]] = {_POSITION: (), _EFFORT: ()}
        if mode == 'simulation':
            self._takes = {
                _POSITION: guide,
                _EFFORT: (INSERTION,) if steered else (INSERTION, ROTATION),
            }
        elif mode == 'robot':
            self._takes = {_POSITION: (INSERTION, *guide), _EFFORT: ()}
        self._takes[_VELOCITY] = self._takes[_POSITION]
        self._shortest, self._longest = shortest, longest
        self.forget()

    def forget(self) -> None:
        """Forget all messages, as at an activation."""
        self._stamp: int | None = None
        #: Numbers that were given last, by kind and joint.
        self._given: dict[tuple[str, str], float] = {}

    def read(self, reading: Reading, at: Mapping[str, float], now: int) -> Asked:
        """
        Read the next message, which does not count before `accept`.

        Parameters
        ----------
        reading : Reading
            The message.
        at : Mapping[str, float]
            Where the joints are [m or rad], zero for others.
        now : int
            Time that stands for a stamp of zero [ns].

        Returns
        -------
        Asked
            What it asks for.

        Raises
        ------
        ParameterError
            If values cannot be told apart, or a joint cannot do what it is asked for.

        """
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
            # A joint that rests is told so once.
            if kind == _VELOCITY and (_POSITION, joint) not in new and (value or before):
                lasting[joint] = at.get(joint, 0.0) + value * self._longest
        motions = [Motion(goals, self._passed(stamp)), Motion(lasting, self._longest)]
        return Asked(
            force=new.get((_EFFORT, INSERTION), 0.0),
            torque=new.get((_EFFORT, ROTATION), 0.0),
            motions=[motion for motion in motions if motion.goals],
            stamp=stamp,
            given={**self._given, **new},
        )

    def accept(self, asked: Asked) -> None:
        """
        Let a message count, so that the next one is compared with it.

        Parameters
        ----------
        asked : Asked
            What it asked for.

        """
        self._stamp, self._given = asked.stamp, asked.given

    def _passed(self, stamp: int) -> float:
        """Return the time since the message before [s], within what a motion may take."""
        passed = self._longest if self._stamp is None else (stamp - self._stamp) / NANOSECONDS
        return min(max(passed, self._shortest), self._longest)

    @staticmethod
    def _by_joint(reading: Reading) -> list[dict[str, float]]:
        """Return positions, velocities and efforts by joint."""
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
        """Tell whether a value asks for anything, or raise ParameterError if it cannot be."""
        if isnan(value) and (kind, joint) not in self._given:
            return False
        if joint in self._takes[kind]:
            return True
        # What a controller leaves when it ends.
        if kind != _POSITION and not value:
            return False
        joints = ', '.join(self._takes[kind]) or 'no joint'
        raise ParameterError(
            f'got the {kind} {value:g} of {joint}; in this mode the plant takes that of {joints}'
        )
