"""What to take from the messages of a topic: numbers of a vector, a joint, or an odometry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence, Set
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_ros.wire import Template
import numpy as np

#: Axes of a frame, in the order of messages.
AXES: Final = ('x', 'y', 'z')

#: A larger number is no measurement [SI].
LARGEST: Final = 1e100

#: Joint of the plant that moves the needle.
_INSERTION: Final = 'insertion'

#: Names of joints that are kept, for messages.
_MAX_NAMES: Final = 100


class Source(ABC):
    """
    What to take from the messages of a topic.

    Attributes
    ----------
    columns : int
        How many numbers are taken from each message.
    width : int
        How many values `measured` makes of them.

    """

    columns: int
    width: int

    @abstractmethod
    def __call__(self, template: Template) -> Sequence[int] | None:
        """
        Choose the numbers of the messages of a template.

        Parameters
        ----------
        template : Template
            The messages.

        Returns
        -------
        sequence of int, or None
            Positions of the numbers [bytes], as `wire.decode` needs them.

        """

    def measured(self, numbers: FloatArray) -> FloatArray:
        """
        Make the measured values of the numbers.

        Parameters
        ----------
        numbers : ndarray, shape (n, columns)
            Numbers of the messages; nan where a message does not have one.

        Returns
        -------
        ndarray, shape (n, width)
            Values.

        """
        return numbers

    def complaint(self) -> str:
        """
        Say what is wrong with the topic as a whole.

        Returns
        -------
        str
            The fault; '' if there is none.

        """
        return ''

    def losses(self) -> list[str]:
        """
        Say what the topic lacks.

        Returns
        -------
        list of str
            In words.

        """
        return []


class Vector(Source):
    """
    Components of the first vector of a message.

    Parameters
    ----------
    *axes : str
        The components, of `AXES`.

    """

    def __init__(self, *axes: str) -> None:
        self.columns = self.width = len(axes)
        self._offsets = [8 * AXES.index(axis) for axis in axes]

    def __call__(self, template: Template) -> list[int]:
        """Choose the numbers, as `Source` says."""
        begin, _ = template.arrays[0]
        return [begin + offset for offset in self._offsets]


class Odometry(Source):
    """
    Position and speed of an odometry; its pose is in a frame, its twist in that of the body.

    The values are position, speed, and whether there is a speed.

    Parameters
    ----------
    axis : str
        Axis of the motion, of `AXES`.

    """

    columns, width = 10, 3

    def __init__(self, axis: str) -> None:
        self._axis = AXES.index(axis)

    def __call__(self, template: Template) -> list[int]:
        """Choose the numbers, as `Source` says."""
        begin, _ = template.arrays[0]
        # Position and orientation (7 numbers), their covariance (36), velocity (3).
        return [begin + 8 * k for k in (*range(7), *range(43, 46))]

    def measured(self, numbers: FloatArray) -> FloatArray:
        """Make the measured values, as `Source` says."""
        imaginary, real, body = numbers[:, 3:6], numbers[:, 6:7], numbers[:, 7:]
        twice = 2.0 * np.cross(imaginary, body)
        velocity = body + real * twice + np.cross(imaginary, twice)
        return _position_and_speed(numbers[:, self._axis], velocity[:, self._axis])


class Joint(Source):
    """
    Position and speed of a joint.

    The values are position, speed, and whether there is a speed.

    Parameters
    ----------
    joint : str or None
        Name of the joint; None for that of the plant, or the only one there is.

    """

    columns, width = 2, 3

    def __init__(self, joint: str | None) -> None:
        self._joint = joint
        self._seen: set[str] = set()
        self._used: set[str] = set()
        self._has_position = self._has_speed = False

    def __call__(self, template: Template) -> list[int] | None:
        """Choose the numbers, as `Source` says."""
        if len(self._seen) < _MAX_NAMES:
            self._seen.update(template.names)
        joint = self._joint or _INSERTION
        if self._joint is None and joint not in template.names and len(template.names) == 1:
            [joint] = template.names
        if joint not in template.names:
            return None
        self._used.add(joint)
        index = template.names.index(joint)
        position, speed = (_element(array, index) for array in template.arrays[:2])
        self._has_position |= position >= 0
        self._has_speed |= speed >= 0
        return [position, speed]

    def measured(self, numbers: FloatArray) -> FloatArray:
        """Make the measured values, as `Source` says."""
        position, speed = numbers.T
        return _position_and_speed(position if self._has_position else 0.0 * speed, speed)

    def complaint(self) -> str:
        """Say what is wrong with the topic, or nothing."""
        if len(self._used) != 1:
            what = 'several joints' if self._used else f'no joint {self._joint or _INSERTION!r}'
            names = f'motion_axis must name one of {_listing(self._seen)}'
            return f'has {what}; {names}' if self._seen else 'has joints without names'
        if not (self._has_position or self._has_speed):
            return f'has neither position nor velocity of {_listing(self._used)}'
        return ''


class PlaneJoints(Source):
    """
    Positions of the joints that move an end-effector in a plane, and out of it if there is one.

    Parameters
    ----------
    *joints : str
        Two joints of the plane and the one out of it.

    """

    columns = width = 3

    def __init__(self, *joints: str) -> None:
        self._joints = joints
        self._seen: set[str] = set()
        self._is_used = self._is_flat = False

    def __call__(self, template: Template) -> list[int] | None:
        """Choose the numbers, as `Source` says."""
        if len(self._seen) < _MAX_NAMES:
            self._seen.update(template.names)
        if not set(self._joints[:2]) <= set(template.names):
            return None
        self._is_used = True
        self._is_flat |= self._joints[2] not in template.names
        positions = template.arrays[0]
        return [
            _element(positions, template.names.index(joint)) if joint in template.names else -1
            for joint in self._joints
        ]

    def measured(self, numbers: FloatArray) -> FloatArray:
        """Make the measured values, as `Source` says."""
        if self._is_flat:
            numbers[:, 2] = np.nan_to_num(numbers[:, 2])
        return numbers

    def complaint(self) -> str:
        """Say what is wrong with the topic, or nothing."""
        if self._is_used:
            return ''
        wanted = ' and '.join(self._joints[:2])
        return f'must have the joints {wanted}, has {_listing(self._seen)}'

    def losses(self) -> list[str]:
        """Say what the topic lacks."""
        return ['has no joint out of the plane: off-plane motion unknown'] if self._is_flat else []


def _listing(names: Set[str]) -> str:
    shown = (' '.join(name.split()) for name in sorted(names)[:_MAX_NAMES])
    return ', '.join(shown) or 'none'


def _element(array: tuple[int, int], index: int) -> int:
    begin, length = array
    return begin + 8 * index if index < length else -1


def _position_and_speed(position: FloatArray, speed: FloatArray) -> FloatArray:
    known = np.abs(speed) < LARGEST
    return np.column_stack([position, np.where(known, speed, 0.0), known])
