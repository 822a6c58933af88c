"""
Recordings from bags: the topics of force and motion as arrays on the time base of the force.

Samples are sorted by stamp. Of those that come denser than 800 Hz means over bins of 1/400 s are
taken, of their stamps as of their values, which delays nothing; see `series.Series`. Motion is
interpolated to the stamps of the force.

Whether force and motion were stamped by clocks that differ is seen from the times of reception,
all by the clock of the recorder: a topic is received later than stamped by its latency, less what
its clock is ahead. The latency at which 5 % of the messages come hardly varies. Where that of the
two topics differs by more than `LARGEST_LATENCY` their clocks do, and the stamps of the force are
moved; a smaller difference may be one of latency, and they stay.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

from needle_dynamics import FloatArray
from needle_identification.bags.bag import Bag, deserialize
from needle_identification.bags.storage import Batch, Topic
from needle_identification.errors import RecordingError
from needle_identification.recordings.recording import IndentationRecording, Recording
from needle_identification.recordings.series import FINEST, Series
from needle_ros import wire
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

#: What a stamp may be taken from: the header of the message, or the time of its reception.
TIMES: Final = ('header', 'receive')

#: More than this [s] no driver, network or tracker delays its messages beyond those of another:
#: an optical tracker or an imager takes up to 0.2 s. Clocks nobody set differ by more.
LARGEST_LATENCY: Final = 0.25

#: A difference of latencies from which on it is worth mentioning [s].
_NOTABLE_LATENCY: Final = 0.05

#: The clocks of two topics must differ by this many times what their latencies vary.
_CERTAINTY: Final = 3.0

#: Latencies that are kept of a batch, and of a topic.
_LATENCIES: Final = (64, 2**16)

#: What is larger is no measurement [SI].
_LARGEST: Final = 1e100

#: A longer step between samples is a gap; motion is not interpolated over it [sample periods].
_GAP: Final = 10.0

#: Names of joints that are kept, for messages.
_NAMES: Final = 100

_AXES: Final = ('x', 'y', 'z')


class _Wanted(NamedTuple):
    """A topic: the option that names it, types it may have, and usual last names of it."""

    option: str
    types: tuple[str, ...]
    usual: tuple[str, ...]


_WRENCH: Final = _Wanted('wrench_topic', (wire.WRENCH,), ('base_wrench',))
_FRICTION_MOTION: Final = _Wanted(
    'motion_topic',
    (wire.JOINT_STATE, wire.POSE, wire.POINT, wire.TWIST, wire.ODOMETRY),
    ('joint_states', 'end_effector_pose'),
)
_INDENTATION_MOTION: Final = _Wanted(
    'motion_topic',
    (wire.POSE, wire.POINT, wire.ODOMETRY, wire.JOINT_STATE),
    ('end_effector_pose', 'joint_states'),
)


def read_friction_recording(
    path: Path,
    *,
    wrench_topic: str | None = None,
    motion_topic: str | None = None,
    force_axis: str = 'y',
    motion_axis: str | None = None,
    time: str = 'header',
) -> Recording:
    """
    Read force and motion of the needle base from a bag, on the time base of the force.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, an ``.mcap`` or a ``.db3`` file; the end may be missing.
    wrench_topic : str, optional
        Topic of type WrenchStamped; if not given, the only one, or else that whose last name is
        base_wrench.
    motion_topic : str, optional
        Topic of type JointState, PoseStamped, PointStamped, TwistStamped or Odometry; if not
        given, the only one, or else that whose last name is joint_states or end_effector_pose.
    force_axis : str
        Component of the force that points into the tissue: x, y, z, or one of them after ``-``.
    motion_axis : str, optional
        Component of the motion that points into the tissue, likewise, if not given y; of a
        JointState the joint, if not given insertion or the only one there is.
    time : str
        Stamps to go by, one of `TIMES`.

    Returns
    -------
    Recording
        `Recording.losses` says what was left out or repaired. Speeds alone are integrated.

    Raises
    ------
    RecordingError
        If the bag is not readable or lacks what is needed.

    """
    sign, axis = _signed(force_axis, 'force axis')
    bag = Bag(path)
    topics = bag.topics()
    wrench = _chosen(bag, topics, _WRENCH, wrench_topic)
    motion = _chosen(bag, topics, _FRICTION_MOTION, motion_topic)
    source, direction = _motion(motion.type_name, motion_axis)
    streams, configuration = _read(bag, {wrench: _Numbers(axis), motion: source}, time)
    force = streams[wrench].samples(bag)
    moved = streams[motion].samples(bag)
    if motion.type_name == wire.TWIST:
        moved = _integrated(moved, bag)
    elif motion.type_name in (wire.JOINT_STATE, wire.ODOMETRY):
        moved = _with_speed(moved, bag)
    else:
        bag.losses.append(f'{motion.name} has no velocity')
    merged = _merged(bag, force, moved._replace(values=direction * moved.values))
    return Recording(
        name=str(path),
        time=merged.time,
        depth=merged.motion[:, 0],
        speed=merged.motion[:, 1] if merged.motion.shape[1] > 1 else None,
        force=sign * merged.force[:, 0],
        losses=tuple(bag.losses),
        configuration=configuration,
        clock_offset=merged.clock_offset,
    )


def read_indentation_recording(
    path: Path,
    *,
    wrench_topic: str | None = None,
    motion_topic: str | None = None,
    axes: tuple[str, str] = ('x', 'z'),
    time: str = 'header',
) -> IndentationRecording:
    """
    Read force and position of an end-effector from a bag, on the time base of the force.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, an ``.mcap`` or a ``.db3`` file; the end may be missing.
    wrench_topic : str, optional
        Topic of type WrenchStamped; if not given, the only one, or else that whose last name is
        base_wrench.
    motion_topic : str, optional
        Topic of type PoseStamped, PointStamped or Odometry, or JointState with joints x, y and
        z; if not given, the only one, or else that whose last name is end_effector_pose or
        joint_states.
    axes : (str, str)
        The plane: x, y or z, or one of them after ``-``, which turns both force and position.
    time : str
        Stamps to go by, one of `TIMES`.

    Returns
    -------
    IndentationRecording
        `IndentationRecording.losses` says what was left out or repaired.

    Raises
    ------
    RecordingError
        If the bag is not readable or lacks what is needed.

    """
    signs, plane = zip(*(_signed(axis, 'axis of the plane') for axis in axes), strict=True)
    if len(set(plane)) != 2:
        raise RecordingError(f'axes must be two different ones of x, y, z, got {axes!r}')
    across = next(axis for axis in _AXES if axis not in plane)
    bag = Bag(path)
    topics = bag.topics()
    wrench = _chosen(bag, topics, _WRENCH, wrench_topic)
    motion = _chosen(bag, topics, _INDENTATION_MOTION, motion_topic)
    source: _Source = _Numbers(*plane, across)
    if motion.type_name == wire.JOINT_STATE:
        source = _Joints(*plane, across)
    streams, configuration = _read(bag, {wrench: _Numbers(*plane), motion: source}, time)
    merged = _merged(bag, streams[wrench].samples(bag), streams[motion].samples(bag))
    return IndentationRecording(
        name=str(path),
        time=merged.time,
        position=merged.motion[:, :2] * signs,
        off_plane=merged.motion[:, 2],
        force=merged.force * signs,
        losses=tuple(bag.losses),
        configuration=configuration,
        clock_offset=merged.clock_offset,
    )


def _signed(text: str, what: str) -> tuple[float, str]:
    """Take an axis apart into its sign and its name."""
    sign, axis = (-1.0, text[1:]) if text.startswith('-') else (1.0, text)
    if axis not in _AXES:
        raise RecordingError(f'{what} must be x, y, z, -x, -y or -z, got {text!r}')
    return sign, axis


def _chosen(bag: Bag, topics: Sequence[Topic], wanted: _Wanted, name: str | None) -> Topic:
    """Return the topic asked for, or the one that must be meant."""
    fitting = [topic for topic in topics if topic.type_name in wanted.types]
    short = ', '.join(type_name.rsplit('/', 1)[-1] for type_name in wanted.types)
    if name is not None:
        meant = [topic for topic in fitting if topic.name == name]
        lacking = f'topic {name} of type {short}'
    else:
        named = ([t for t in fitting if t.name.rsplit('/', 1)[-1] == n] for n in wanted.usual)
        meant = fitting if len(fitting) == 1 else next(filter(None, named), [])
        lacking = f'topic of type {short}'
    if len(meant) == 1:
        return meant[0]
    if name is None and fitting:
        raise RecordingError(
            f'{bag.path} has several topics of type {short}; {wanted.option} must name one of '
            f'{", ".join(topic.name for topic in meant or fitting)}'
        )
    listing = ', '.join(map(str, topics))
    raise RecordingError(
        '; '.join([f'{bag.path} has no {lacking}; it has {listing}', *bag.losses])
    )


class _Source(ABC):
    """
    What to take from the messages of a topic.

    ``columns`` numbers of each message, of which `measured` makes ``width`` values.
    """

    columns: int
    width: int

    @abstractmethod
    def __call__(self, template: wire.Template) -> Sequence[int] | None:
        """Choose the positions of the numbers, as `wire.decode` wants them."""

    def measured(self, numbers: FloatArray) -> FloatArray:
        """Return the values from the numbers, which may be nan."""
        return numbers

    def complaint(self) -> str:
        """Say what is wrong with the topic as a whole."""
        return ''


class _Numbers(_Source):
    """Numbers of a message without names, of the first three by axis."""

    def __init__(self, *axes: str) -> None:
        self.columns = self.width = len(axes)
        self._offsets = [8 * _AXES.index(axis) for axis in axes]

    def __call__(self, template: wire.Template) -> list[int]:
        begin, _ = template.arrays[0]
        return [begin + offset for offset in self._offsets]


class _Odometry(_Source):
    """Position, speed and whether there is one: the pose is in a frame, the twist in the body."""

    columns, width = 10, 3

    def __init__(self, axis: str) -> None:
        self._axis = _AXES.index(axis)

    def __call__(self, template: wire.Template) -> list[int]:
        begin, _ = template.arrays[0]
        # Position and orientation, their covariance, twist.
        return [begin + 8 * k for k in (*range(7), *range(43, 46))]

    def measured(self, numbers: FloatArray) -> FloatArray:
        imaginary, real, body = numbers[:, 3:6], numbers[:, 6:7], numbers[:, 7:]
        twice = 2.0 * np.cross(imaginary, body)
        velocity = body + real * twice + np.cross(imaginary, twice)
        return _position_and_speed(numbers[:, self._axis], velocity[:, self._axis])


class _Joint(_Source):
    """Position, speed and whether there is one of a joint; by default that of the plant."""

    columns, width = 2, 3

    def __init__(self, joint: str | None) -> None:
        self._joint = joint
        self._seen: set[str] = set()
        self._used: set[str] = set()
        self._has_position = self._has_speed = False

    def __call__(self, template: wire.Template) -> list[int] | None:
        if len(self._seen) < _NAMES:
            self._seen.update(template.names)
        joint = self._joint or 'insertion'
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
        position, speed = numbers.T
        return _position_and_speed(position if self._has_position else 0.0 * speed, speed)

    def complaint(self) -> str:
        if len(self._used) != 1:
            what = 'several joints' if self._used else f'no joint {self._joint or "insertion"!r}'
            names = f'motion_axis must name one of {_listing(self._seen)}'
            return f'has {what}; {names}' if self._seen else 'has joints without names'
        if not (self._has_position or self._has_speed):
            return f'has neither position nor velocity of {_listing(self._used)}'
        return ''


class _Joints(_Source):
    """Positions of the joints that move an end-effector in a plane, and across if there is one."""

    columns = width = 3

    def __init__(self, *joints: str) -> None:
        self._joints = joints
        self._seen: set[str] = set()
        self._used = False
        self.flat = False

    def __call__(self, template: wire.Template) -> list[int] | None:
        if len(self._seen) < _NAMES:
            self._seen.update(template.names)
        if not set(self._joints[:2]) <= set(template.names):
            return None
        self._used = True
        self.flat |= self._joints[2] not in template.names
        return [
            _element(template.arrays[0], template.names.index(joint))
            if joint in template.names
            else -1
            for joint in self._joints
        ]

    def measured(self, numbers: FloatArray) -> FloatArray:
        if self.flat:
            numbers[:, 2] = np.nan_to_num(numbers[:, 2])
        return numbers

    def complaint(self) -> str:
        if self._used:
            return ''
        wanted = ' and '.join(self._joints[:2])
        return f'must have the joints {wanted}, has {_listing(self._seen)}'


def _listing(names: Set[str]) -> str:
    shown = (' '.join(name.split()) for name in sorted(names)[:_NAMES])
    return ', '.join(shown) or 'none'


def _element(array: tuple[int, int], index: int) -> int:
    begin, length = array
    return begin + 8 * index if index < length else -1


def _position_and_speed(position: FloatArray, speed: FloatArray) -> FloatArray:
    known = np.abs(speed) < _LARGEST
    return np.column_stack([position, np.where(known, speed, 0.0), known])


def _motion(type_name: str, axis: str | None) -> tuple[_Source, float]:
    """Return what to take for a motion along an axis or joint, and its sign."""
    if type_name == wire.JOINT_STATE:
        backward = axis is not None and axis.startswith('-')
        return _Joint(axis[1:] if axis and backward else axis), -1.0 if backward else 1.0
    sign, name = _signed('y' if axis is None else axis, 'motion axis')
    return (_Odometry if type_name == wire.ODOMETRY else _Numbers)(name), sign


class _Samples(NamedTuple):
    """Samples of a topic: stamps [ns], shape (n,), and values, shape (n, k)."""

    topic: str
    stamps: NDArray[np.int64]
    values: FloatArray
    latency: NDArray[np.int64]


class _Stream:
    """The samples of one topic, gathered while its bag is read."""

    def __init__(self, topic: Topic, source: _Source, *, by_header: bool) -> None:
        self._topic = topic
        self._source = source
        self._by_header = by_header
        self._series = Series(source.width)
        self._latencies: list[NDArray[np.int64]] = []
        self._unstamped = self._broken = self._unusable = 0
        self._fault = ''

    def add(self, batch: Batch) -> None:
        """Take in the messages of a batch."""
        decoded = wire.decode(
            batch.data,
            batch.begin,
            batch.end,
            self._topic.type_name,
            self._source,
            self._source.columns,
        )
        self._broken += decoded.invalid
        self._fault = self._fault or decoded.fault
        stamps = received = batch.received[decoded.used]
        if self._by_header:
            stamped = decoded.stamps != 0
            self._unstamped += int(np.count_nonzero(~stamped))
            stamps = np.where(stamped, decoded.stamps, received)
        with np.errstate(all='ignore'):
            values = self._source.measured(decoded.values)
        usable = (np.abs(values) < _LARGEST).all(axis=1)
        self._unusable += int(np.count_nonzero(~usable))
        self._series.add(stamps[usable], values[usable])
        few, many = _LATENCIES
        self._latencies.append((received - stamps)[:: max(1, len(stamps) // few)])
        if len(self._latencies) * few > many:
            self._latencies = [np.concatenate(self._latencies)[::2]]

    def samples(self, bag: Bag) -> _Samples:
        """Return what was gathered, and tell the bag's losses what was left out."""
        name, series = self._topic.name, self._series
        if complaint := self._source.complaint():
            self._refuse(bag, complaint)
        series.compact()
        for count, what in (
            (self._broken, f'not readable, left out: the first one {self._fault}'),
            (self._unstamped, 'without a stamp, taken at the time of reception'),
            (series.late, 'out of order, sorted by stamp'),
            (self._unusable, 'not finite, left out'),
            (series.repeated, 'with the stamp of another, left out'),
        ):
            if count:
                bag.losses.append(f'{count} of {name} {what}')
        if series.width > FINEST:
            bag.losses.append(
                f'{name} is averaged over {1e-9 * series.width:g} s, it is too long for less'
            )
        if len(series.stamps) < 2:
            self._refuse(
                bag, f'must have >= 2 samples at different times, has {len(series.stamps)}'
            )
        steps = np.diff(series.stamps)
        gaps = steps[_are_gaps(steps)]
        if len(gaps):
            places = '1 place' if len(gaps) == 1 else f'{len(gaps)} places'
            bag.losses.append(f'{name} pauses in {places}, {1e-9 * gaps.sum():.3g} s in all')
        if isinstance(self._source, _Joints) and self._source.flat:
            bag.losses.append(f'{name} has no joint across the plane: off-plane motion unknown')
        latency = np.concatenate(self._latencies)
        return _Samples(name, series.stamps, series.values, latency)

    def _refuse(self, bag: Bag, complaint: str) -> NoReturn:
        what = f'{bag.path}: {self._topic.name} {complaint}'
        raise RecordingError('; '.join([what, *bag.losses]))


def _read(
    bag: Bag, sources: Mapping[Topic, _Source], time: str
) -> tuple[Mapping[Topic, _Stream], str]:
    """Go through a bag; return what it holds of some topics, and the plant's configuration."""
    if time not in TIMES:
        raise RecordingError(f'time must be one of {", ".join(TIMES)}, got {time!r}')
    streams = {
        topic: _Stream(topic, source, by_header=time == 'header')
        for topic, source in sources.items()
    }
    configuration = ''
    for batch in bag.batches(lambda topic: topic in streams or _is_configuration(topic)):
        if batch.topic in streams:
            streams[batch.topic].add(batch)
        else:
            with suppress(RecordingError):
                *_, (_, data) = batch.messages()
                configuration = str(deserialize(batch.topic, data).data)
    return streams, configuration


def _is_configuration(topic: Topic) -> bool:
    return topic.type_name == 'std_msgs/msg/String' and topic.name.endswith('plant/configuration')


def _with_speed(samples: _Samples, bag: Bag) -> _Samples:
    """Turn position, speed and whether there is one into what was measured of them."""
    topic, _, values, _ = samples
    position, speed, share = values.T
    known = share > 0.0
    if speed.any() and not position.any():
        paces = (speed[known] / share[known])[:, np.newaxis]
        return _integrated(samples._replace(stamps=samples.stamps[known], values=paces), bag)
    if np.count_nonzero(known) < max(2.0, 0.5 * len(known)):
        bag.losses.append(f'{topic} has no velocity')
    elif not speed.any() and np.ptp(position) > 0.0:
        bag.losses.append(f'{topic} moves at the velocity 0, which is left out')
    else:
        if not known.all():
            bag.losses.append(f'{np.count_nonzero(~known)} of {topic} without velocity, left out')
        # A bin may hold some samples with a speed and some without.
        both = np.column_stack([position[known], speed[known] / share[known]])
        return samples._replace(stamps=samples.stamps[known], values=both)
    return samples._replace(values=values[:, :1])


def _integrated(samples: _Samples, bag: Bag) -> _Samples:
    """Turn speed into position and speed."""
    bag.losses.append(f'{samples.topic} has no position: depth is the integral of speed from 0')
    time = (samples.stamps - samples.stamps[0]) * 1e-9
    speed = samples.values[:, 0]
    depth = cumulative_trapezoid(speed, time, initial=0.0)
    return samples._replace(values=np.column_stack([depth, speed]))


class _Merged(NamedTuple):
    """Force, shape (n, k), and motion, shape (n, m), at the stamps of the force [s]."""

    time: FloatArray
    force: FloatArray
    motion: FloatArray
    clock_offset: float


def _merged(bag: Bag, force: _Samples, motion: _Samples) -> _Merged:
    """Put force and motion on the time base of the force."""
    offset = _clock_offset(bag, force, motion)
    stamps = force.stamps - offset
    covered = _covered(stamps, motion.stamps)
    if np.count_nonzero(covered) < 2:
        spans = ' and '.join(
            f'from {span[0] * 1e-9:.3f} to {span[-1] * 1e-9:.3f} s'
            for span in (stamps, motion.stamps)
        )
        raise RecordingError(
            f'{bag.path}: {force.topic} and {motion.topic} do not overlap in time; they last '
            f'{spans}'
        )
    if not covered.all():
        bag.losses.append(
            f'{np.count_nonzero(~covered)} of {force.topic} not covered by {motion.topic}'
        )
    start = stamps[covered][0]
    time = (stamps[covered] - start) * 1e-9
    # Far from the start seconds do not tell nanoseconds apart.
    told = np.diff(time, prepend=-1.0) > 0.0
    time = time[told]
    motion_time = (motion.stamps - start) * 1e-9
    columns = [np.interp(time, motion_time, column) for column in motion.values.T]
    return _Merged(time, force.values[covered][told], np.column_stack(columns), offset * 1e-9)


def _clock_offset(bag: Bag, force: _Samples, motion: _Samples) -> int:
    """Estimate what the clock of the force is ahead [ns]; 0 if latency explains it."""
    quantiles = [
        np.quantile(samples.latency, (0.05, 0.5), method='lower') for samples in (force, motion)
    ]
    (force_low, force_mid), (motion_low, motion_mid) = quantiles
    offset = int(motion_low - force_low)
    spread = float(force_mid - force_low) + float(motion_mid - motion_low)
    words = f'by the times of reception {force.topic} is stamped {offset * 1e-9:.3f} s'
    if abs(offset) > max(1e9 * LARGEST_LATENCY, _CERTAINTY * spread):
        bag.losses.append(f'{words} after {motion.topic}: clocks differ, corrected')
        return offset
    if abs(offset) > max(1e9 * _NOTABLE_LATENCY, _CERTAINTY * spread):
        bag.losses.append(
            f'{words} after {motion.topic}: may be latency, left as it is; time receive would '
            'correct it'
        )
    return 0


def _covered(stamps: NDArray[np.int64], motion: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark the stamps at which motion can be interpolated."""
    steps = np.diff(motion)
    after = np.clip(np.searchsorted(motion, stamps), 1, len(steps))
    inside = (motion[0] <= stamps) & (stamps <= motion[-1])
    return np.asarray(inside & ~_are_gaps(steps)[after - 1])


def _are_gaps(steps: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.asarray(steps > _GAP * np.median(steps))
