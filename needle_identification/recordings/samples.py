"""Samples of one topic, gathered while its bag is read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence, Set
from typing import Final, NamedTuple, NoReturn

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.bags.bag import Bag
from needle_identification.bags.batch import Batch
from needle_identification.bags.topics import Topic
from needle_identification.errors import RecordingError
from needle_identification.recordings.recording import integrated
from needle_identification.recordings.series import FINEST, Series
from needle_ros import wire
from needle_ros.contract import INSERTION
import numpy as np
from numpy.typing import NDArray

#: Axes of a frame, in the order of messages.
AXES: Final = ('x', 'y', 'z')

#: A larger number is no measurement [SI].
_LARGEST: Final = 1e100

#: Names of joints that are kept, for messages.
_MAX_NAMES: Final = 100

#: A longer step between samples is a gap [sampling periods].
_GAP: Final = 10.0

#: A smaller part of messages that name other joints is damaged.
_STRAY: Final = 0.1

#: Latencies that are kept of a batch, and of a topic.
_LATENCIES: Final = (64, 2**16)


class Source(ABC):
    """
    What to take from the messages of a topic.

    It is called with the template of messages, and returns the positions of the numbers to take
    [bytes], as `wire.decode` needs them.

    Attributes
    ----------
    columns, width : int
        How many numbers are taken of each message, and how many values are made of them.

    """

    columns: int
    width: int

    @abstractmethod
    def __call__(self, template: wire.Template) -> Sequence[int] | None:
        """Choose numbers; None if the messages are not wanted."""

    def _measured(self, numbers: FloatArray) -> FloatArray:
        """Return the values from the numbers, (n, columns), nan where a message lacks one."""
        return numbers

    def _complaint(self) -> str:
        """Say what is wrong with the topic as a whole."""
        return ''

    def _losses(self) -> list[str]:
        """Say what the topic lacks."""
        return []


class _Vector(Source):
    """Components of the first vector of a message."""

    def __init__(self, *axes: str) -> None:
        self.columns = self.width = len(axes)
        self._offsets = [8 * AXES.index(axis) for axis in axes]

    def __call__(self, template: wire.Template) -> list[int]:
        begin, _ = template.arrays[0]
        return [begin + offset for offset in self._offsets]


class _Odometry(Source):
    """Position, speed and whether there is one: the pose is in a frame, the twist in the body."""

    columns, width = 10, 3

    def __init__(self, axis: str) -> None:
        self._axis = AXES.index(axis)

    def __call__(self, template: wire.Template) -> list[int]:
        begin, _ = template.arrays[0]
        # Position and orientation (7 numbers), their covariance (36), velocity (3).
        return [begin + 8 * k for k in (*range(7), *range(43, 46))]

    def _measured(self, numbers: FloatArray) -> FloatArray:
        imaginary, real, body = numbers[:, 3:6], numbers[:, 6:7], numbers[:, 7:]
        twice = 2.0 * np.cross(imaginary, body)
        velocity = body + real * twice + np.cross(imaginary, twice)
        return _position_and_speed(numbers[:, self._axis], velocity[:, self._axis])


class _Joint(Source):
    """Position, speed and whether there is one of a joint; by default that of the plant."""

    columns, width = 2, 3

    def __init__(self, joint: str | None) -> None:
        self._joint = joint
        self._seen: set[str] = set()
        self._is_used = False
        self._has_position = self._has_speed = False

    def __call__(self, template: wire.Template) -> list[int] | None:
        if len(self._seen) < _MAX_NAMES:
            self._seen.update(template.names)
        joint = self._joint or INSERTION
        if joint not in template.names:
            return None
        self._is_used = True
        index = template.names.index(joint)
        position, speed = (_element(array, index) for array in template.arrays[:2])
        self._has_position |= position >= 0
        self._has_speed |= speed >= 0
        return [position, speed]

    def _measured(self, numbers: FloatArray) -> FloatArray:
        position, speed = numbers.T
        return _position_and_speed(position if self._has_position else 0.0 * speed, speed)

    def _complaint(self) -> str:
        joint = self._joint or INSERTION
        if not self._is_used:
            names = f'motion_axis (--motion-axis) must name one of {_listing(self._seen)}'
            return f'has no joint {joint!r}; {names}' if self._seen else 'has joints without names'
        if not (self._has_position or self._has_speed):
            return f'has neither position nor velocity of {joint}'
        return ''


class _PlaneJoints(Source):
    """Positions of two joints that move an end-effector in a plane, and of one out of it."""

    columns = width = 3

    def __init__(self, *joints: str) -> None:
        self._joints = joints
        self._seen: set[str] = set()
        self._is_used = self._is_flat = False

    def __call__(self, template: wire.Template) -> list[int] | None:
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

    def _measured(self, numbers: FloatArray) -> FloatArray:
        if self._is_flat:
            numbers[:, 2] = np.nan_to_num(numbers[:, 2])
        return numbers

    def _complaint(self) -> str:
        if self._is_used:
            return ''
        wanted = ' and '.join(self._joints[:2])
        return f'must have the joints {wanted}, has {_listing(self._seen)}'

    def _losses(self) -> list[str]:
        return ['has no joint out of the plane: off-plane motion unknown'] if self._is_flat else []


class _EachJoint(Source):
    """Positions of joints by name; nan where a message lacks one."""

    def __init__(self, *joints: str) -> None:
        self.columns = self.width = len(joints)
        self._joints = joints

    def __call__(self, template: wire.Template) -> list[int]:
        positions, names = template.arrays[0], template.names
        return [
            _element(positions, names.index(joint)) if joint in names else -1
            for joint in self._joints
        ]


def each_joint(joints: Sequence[str]) -> Source:
    """
    Take the positions of joints.

    Parameters
    ----------
    joints : sequence of str
        Their names.

    Returns
    -------
    Source
        Its values are the positions.

    """
    return _EachJoint(*joints)


def _listing(names: Set[str]) -> str:
    shown = (' '.join(name.split()) for name in sorted(names)[:_MAX_NAMES])
    return ', '.join(shown) or 'none'


def _element(array: tuple[int, int], index: int) -> int:
    begin, length = array
    return begin + 8 * index if index < length else -1


def _position_and_speed(position: FloatArray, speed: FloatArray) -> FloatArray:
    known = np.abs(speed) < _LARGEST
    return np.column_stack([position, np.where(known, speed, 0.0), known])


def source_of(type_name: str, axes: Sequence[str], joint: str | None = None) -> Source:
    """
    Choose what to take from the messages of a type.

    Parameters
    ----------
    type_name : str
        Message type.
    axes : sequence of str
        One axis along the motion, or two of a plane and the one across; of `AXES`. Of a
        JointState with three axes the joints of that name.
    joint : str, optional
        Joint along the motion of a JointState; default that of the plant, or the only one.

    Returns
    -------
    Source
        Its values are the components; or, for a motion of a JointState or Odometry, position,
        speed, and whether there is a speed.

    """
    if type_name == wire.JOINT_STATE:
        return _PlaneJoints(*axes) if len(axes) == 3 else _Joint(joint)
    if type_name == wire.ODOMETRY and len(axes) == 1:
        return _Odometry(*axes)
    return _Vector(*axes)


class Samples(NamedTuple):
    """
    Samples of a topic.

    Attributes
    ----------
    topic : str
        Its name.
    stamps : ndarray of int64, shape (n,)
        Strictly increasing stamps [ns].
    values : ndarray, shape (n, k)
        Values of its source.
    latency : ndarray of int64, shape (l,)
        Some of the receive times minus stamps [ns].

    """

    topic: str
    stamps: NDArray[np.int64]
    values: FloatArray
    latency: NDArray[np.int64]


class Gathering:
    """
    Gathers the samples of one topic.

    Parameters
    ----------
    topic : Topic
        The topic.
    source : Source
        What to take from its messages.
    by_header : bool
        Whether the stamps are those of the headers, or the receive times.

    """

    def __init__(self, topic: Topic, source: Source, *, by_header: bool) -> None:
        self._topic = topic
        self._source = source
        self._by_header = by_header
        self._series = Series(source.width)
        self._latencies: list[NDArray[np.int64]] = []
        self._unstamped = self._invalid = self._unusable = self._unwanted = self._messages = 0
        self._fault = ''

    def add(self, batch: Batch) -> None:
        """
        Add the messages of a batch.

        Parameters
        ----------
        batch : Batch
            Messages of the topic.

        """
        decoded = wire.decode(
            batch.data,
            batch.begin,
            batch.end,
            self._topic.type_name,
            self._source,
            self._source.columns,
        )
        self._invalid += decoded.invalid
        self._messages += len(batch.begin)
        self._unwanted += len(batch.begin) - len(decoded.used) - decoded.invalid
        self._fault = self._fault or decoded.fault
        stamps = received = batch.received[decoded.used]
        if self._by_header:
            stamped = decoded.stamps != 0
            self._unstamped += int(np.count_nonzero(~stamped))
            stamps = np.where(stamped, decoded.stamps, received)
        with np.errstate(all='ignore'):
            values = self._source._measured(decoded.values)
        usable = (np.abs(values) < _LARGEST).all(axis=1)
        self._unusable += int(np.count_nonzero(~usable))
        self._series.add(stamps[usable], values[usable])
        few, many = _LATENCIES
        self._latencies.append((received - stamps)[:: max(1, len(stamps) // few)])
        if len(self._latencies) * few > many:
            self._latencies = [np.concatenate(self._latencies)[::2]]

    def samples(self, bag: Bag) -> Samples:
        """
        Return what was gathered.

        Parameters
        ----------
        bag : Bag
            The bag; what was left out is added to its losses.

        Returns
        -------
        Samples
            The samples.

        Raises
        ------
        RecordingError
            If there are fewer than two, or the source complains.

        """
        name, series = self._topic.name, self._series
        if complaint := self._source._complaint():
            self._reject(bag, complaint)
        series.compact()
        for count, what in (
            (self._invalid, f'not readable, left out: the first one {self._fault}'),
            (self._unstamped, 'without a stamp, the receive time is used'),
            (series.late, 'out of order, sorted by stamp'),
            (self._unusable, 'not finite, left out'),
            (series.repeated, 'with the stamp of another, left out'),
        ):
            if count:
                bag.losses.append(f'{count} of {name} {what}')
        # More of them are another robot on the same topic.
        if 0 < self._unwanted < _STRAY * self._messages:
            bag.losses.append(f'{self._unwanted} of {name} name other joints, left out')
        if series.width > FINEST:
            bag.losses.append(
                f'{name} is averaged over {1e-9 * series.width:g} s, because it is very long'
            )
        if len(series.stamps) < 2:
            self._reject(
                bag, f'must have >= 2 samples at different times, has {len(series.stamps)}'
            )
        steps = np.diff(series.stamps)
        gaps = steps[are_gaps(steps)]
        if len(gaps):
            places = '1 place' if len(gaps) == 1 else f'{len(gaps)} places'
            bag.losses.append(f'{name} pauses in {places}, {1e-9 * gaps.sum():.3g} s in all')
        bag.losses += [f'{name} {loss}' for loss in self._source._losses()]
        return Samples(name, series.stamps, series.values, np.concatenate(self._latencies))

    def _reject(self, bag: Bag, complaint: str) -> NoReturn:
        what = f'{bag.path}: {self._topic.name} {complaint}'
        raise RecordingError('; '.join([what, *bag.losses]))


def are_gaps(steps: NDArray[np.int64]) -> BoolArray:
    """
    Mark the gaps between samples.

    Parameters
    ----------
    steps : ndarray of int64, shape (n,)
        Steps from one sample to the next [ns].

    Returns
    -------
    ndarray of bool, shape (n,)
        Whether the step is a gap, over which nothing is interpolated.

    """
    return np.asarray(steps > _GAP * np.median(steps))


def position_and_speed(samples: Samples, bag: Bag) -> Samples:
    """
    Take position and speed as far as they were measured; a speed alone is integrated.

    Parameters
    ----------
    samples : Samples
        Values are position, speed, and whether there is a speed; or the speed alone.
    bag : Bag
        The bag; what is missing is added to its losses.

    Returns
    -------
    Samples
        Values are position and speed, or position alone.

    """
    topic, _, values, _ = samples
    if values.shape[1] == 1:
        return _from_speed(samples, bag)
    position, speed, share = values.T
    known = share > 0.0
    if speed.any() and not position.any():
        alone = (speed[known] / share[known])[:, np.newaxis]
        return _from_speed(samples._replace(stamps=samples.stamps[known], values=alone), bag)
    if np.count_nonzero(known) < max(2.0, 0.5 * len(known)):
        bag.losses.append(f'{topic} has no velocity')
    elif not speed.any() and np.ptp(position) > 0.0:
        bag.losses.append(f'{topic} moves with the velocity 0, which is left out')
    else:
        if not known.all():
            bag.losses.append(f'{np.count_nonzero(~known)} of {topic} without velocity, left out')
        # A bin may hold some samples with a speed and some without.
        both = np.column_stack([position[known], speed[known] / share[known]])
        return samples._replace(stamps=samples.stamps[known], values=both)
    return samples._replace(values=values[:, :1])


def _from_speed(samples: Samples, bag: Bag) -> Samples:
    bag.losses.append(f'{samples.topic} has no position: depth is the integral of speed from 0')
    time = (samples.stamps - samples.stamps[0]) * 1e-9
    speed = samples.values[:, 0]
    return samples._replace(values=np.column_stack([integrated(time, speed), speed]))
