# SPDX-License-Identifier: Apache-2.0
"""Gather the samples of one topic while its bag is read, by time and in bounded memory."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence, Set
from itertools import pairwise
from math import inf
from typing import Final, NamedTuple, NoReturn, Protocol

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.bags.bag import Bag
from needle_identification.bags.topics import BagTopic, MessageBatch
from needle_identification.errors import RecordingError
from needle_identification.recordings.recording import integrated
from needle_ros import wire
from needle_ros.contract import INSERTION
from needle_ros.quantities import AXES
import numpy as np

FINEST: Final = 2_500_000  #: finest bin [ns]: 400 Hz, above the cutoff of the friction filter
MOST_SAMPLES: Final = 2**20  #: largest number of samples that are kept
RUN: Final = 100  #: least mean number of samples of each of several runs in one recording
_GATHERED: Final = 2**16  # smallest number of added samples that is sorted
_LARGEST: Final = 1e100  # upper limit of a plausible measurement [SI]
_MAX_NAMES: Final = 100  # largest number of joint names kept for error messages
_GAP: Final = 10.0  # shortest gap between samples [sampling periods]
_NEAR: Final = 0.1  # latest time at which a second run starts, as a part of all times
_OVERLAP: Final = 10  # least number of samples of a second run at times of the one before
_STRAY: Final = 0.1  # smaller fractions of messages with other joint names are reported as faults
_LATENCIES: Final = (64, 2**16)  # largest number of latencies kept of a batch, and of a topic


class Series:
    """Samples in order of stamp, after `compact`; ``late``, ``repeated`` count their stamps."""

    # More than two samples per bin of ``width`` [ns] are averaged, stamps and values alike; above
    # `MOST_SAMPLES` samples, neighbors are.

    def __init__(self, columns: int) -> None:
        self.stamps = np.empty(0, dtype=np.int64)
        self.values: FloatArray = np.empty((0, columns))
        self.late = self.repeated = self.width = 0
        self._weights: FloatArray = np.empty(0)
        self._gathered: list[tuple[IntArray, FloatArray]] = []
        self._count = 0
        self._last = -(2**63)

    def add(self, stamps: IntArray, values: FloatArray) -> None:
        """Add samples in order of reception: stamps [ns], (n,), and values, (n, columns)."""
        if len(stamps) == 0:
            return
        self.late += int(np.count_nonzero(stamps[1:] < stamps[:-1])) + int(stamps[0] < self._last)
        self._last = int(stamps[-1])
        self._gathered.append((stamps, values))
        self._count += len(stamps)
        # In proportion to the number of samples, for a constant cost per sample.
        if self._count > max(_GATHERED, len(self.stamps)):
            self.compact()

    def compact(self) -> None:
        """Sort the added samples, and average where the samples are too dense or too many."""
        stamps = np.concatenate([self.stamps, *(stamps for stamps, _ in self._gathered)])
        values = np.concatenate([self.values, *(values for _, values in self._gathered)])
        weights = np.concatenate([self._weights, np.ones(self._count)])
        self._gathered, self._count = [], 0
        if (stamps[1:] < stamps[:-1]).any():
            order = np.argsort(stamps, kind='stable')
            stamps, values, weights = stamps[order], values[order], weights[order]
        again = np.zeros(len(stamps), dtype=np.bool_)
        again[1:] = stamps[1:] == stamps[:-1]
        if again.any():
            self.repeated += int(np.count_nonzero(again))
            stamps, values, weights = stamps[~again], values[~again], weights[~again]
        if not self.width and len(stamps) > 2 and np.median(np.diff(stamps)) < FINEST / 2:
            self.width = FINEST
        if self.width:
            stamps, values, weights = _binned(stamps, values, weights, self.width)
        while len(stamps) > MOST_SAMPLES:
            self.width = 2 * self.width or FINEST
            stamps, values, weights = _binned(stamps, values, weights, self.width)
        self.stamps, self.values, self._weights = stamps, values, weights

    def losses(self, name: str) -> list[str]:
        """Return the repaired, discarded and missing data of the topic `name`."""
        steps = np.diff(self.stamps)
        gaps = steps[are_gaps(steps)] if len(steps) else steps
        places = '1 place' if len(gaps) == 1 else f'{len(gaps)} places'
        return [
            words
            for found, words in (
                (self.late, f'{self.late} of {name} out of order, sorted by stamp'),
                (self.repeated, f'{self.repeated} of {name} with the stamp of another, left out'),
                (
                    self.width > FINEST,
                    f'averaged {name} over {1e-9 * self.width:g} s, because there are so many',
                ),
                (len(gaps), f'pauses of {name} in {places}, {1e-9 * gaps.sum():.3g} s in all'),
            )
            if found
        ]

    def keep(self, kept: BoolArray) -> None:
        """Discard all samples except some, (n,), after `compact`."""
        self.stamps, self.values = self.stamps[kept], self.values[kept]
        self._weights = self._weights[kept]


def _binned(
    stamps: IntArray, values: FloatArray, weights: FloatArray, width: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Average the samples of each bin; keep a single sample of a bin unchanged."""
    bins = stamps // width
    first = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    if len(first) == len(stamps):
        return stamps, values, weights
    total = np.add.reduceat(weights, first)
    number = np.diff(first, append=len(stamps))
    since = (stamps - np.repeat(stamps[first], number)) * weights
    mean_stamps = stamps[first] + np.rint(np.add.reduceat(since, first) / total).astype(np.int64)
    means = np.add.reduceat(values * weights[:, None], first, axis=0) / total[:, None]
    means[number == 1] = values[first[number == 1]]
    return mean_stamps, means, total


class SignalSource(ABC):
    """Selects ``columns`` numbers of each message, and computes ``width`` values from them."""

    columns: int
    width: int

    @abstractmethod
    def __call__(self, template: wire.Template) -> Sequence[int] | None:
        """Return the positions of the numbers [bytes] by a template; None: message not needed."""

    def values(self, numbers: FloatArray) -> FloatArray:
        """Compute the values from the numbers, (n, columns), nan where missing in a message."""
        return numbers

    def fault(self) -> str:
        """Return the fault of the topic as a whole, if any."""
        return ''

    def losses(self) -> list[str]:
        """Return the missing data of the topic."""
        return []


class _Vector(SignalSource):
    def __init__(self, *axes: str) -> None:
        self.columns = self.width = len(axes)
        self._offsets = [8 * AXES.index(axis) for axis in axes]

    def __call__(self, template: wire.Template) -> list[int]:
        begin, _ = template.arrays[0]
        return [begin + offset for offset in self._offsets]


class ObliqueVector(_Vector):
    """An axis, and the two others, which may be not finite: then they are 0.0."""

    def __init__(self, axis: str) -> None:
        self.axes = [axis, *(other for other in AXES if other != axis)]
        super().__init__(*self.axes)

    def values(self, numbers: FloatArray) -> FloatArray:
        numbers[:, 1:] = np.where(np.abs(numbers[:, 1:]) < _LARGEST, numbers[:, 1:], 0.0)
        return numbers


class _Odometry(SignalSource):
    """Position, velocity and its validity; the pose is in the frame, the twist in the body."""

    columns, width = 10, 3

    def __init__(self, axis: str) -> None:
        self._axis = AXES.index(axis)

    def __call__(self, template: wire.Template) -> list[int]:
        begin, _ = template.arrays[0]
        # Position and orientation (7 numbers), their covariance (36), velocity (3).
        return [begin + 8 * k for k in (*range(7), *range(43, 46))]

    def values(self, numbers: FloatArray) -> FloatArray:
        imaginary, real, body = numbers[:, 3:6], numbers[:, 6:7], numbers[:, 7:]
        twice = 2.0 * np.cross(imaginary, body)
        velocity = body + real * twice + np.cross(imaginary, twice)
        return _position_and_velocity(numbers[:, self._axis], velocity[:, self._axis])


class EachJoint(SignalSource):
    """Positions of joints by name; nan where missing in a message that has the first ones."""

    def __init__(self, *joints: str, required: int = 0) -> None:
        self.columns = self.width = len(joints)
        self._joints, self._required = joints, required
        self._names: set[str] = set()
        self._is_used = False

    def __call__(self, template: wire.Template) -> list[int] | None:
        names = template.names
        if len(self._names) < _MAX_NAMES:
            self._names.update(names)
        if not {*self._joints[: self._required]} <= {*names}:
            return None
        self._is_used = True
        at = [names.index(joint) if joint in names else inf for joint in self._joints]
        return self._positions(template, at)

    def _positions(self, template: wire.Template, at: Sequence[float]) -> list[int]:
        return [_element(template.arrays[0], index) for index in at]


class _Joint(EachJoint):
    """Position, velocity and its validity of a joint; default: the joint of the plant."""

    def __init__(self, joint: str | None) -> None:
        super().__init__(joint or INSERTION, required=1)
        self.columns, self.width = 2, 3
        self._has_position = self._has_velocity = False

    def _positions(self, template: wire.Template, at: Sequence[float]) -> list[int]:
        position, velocity = (_element(array, at[0]) for array in template.arrays[:2])
        self._has_position |= position >= 0
        self._has_velocity |= velocity >= 0
        return [position, velocity]

    def values(self, numbers: FloatArray) -> FloatArray:
        position, velocity = numbers.T
        return _position_and_velocity(position if self._has_position else 0.0 * velocity, velocity)

    def fault(self) -> str:
        (joint,) = self._joints
        if not self._is_used:
            names = f'motion_axis (--motion-axis) must name one of {_listing(self._names)}'
            return (
                f'has no joint {joint!r}; {names}' if self._names else 'has joints without names'
            )
        if not (self._has_position or self._has_velocity):
            return f'has neither position nor velocity of {joint}'
        return ''


class _PlaneJoints(EachJoint):
    """Positions of two joints of an end-effector in a plane, and of the off-plane joint."""

    def __init__(self, *joints: str) -> None:
        super().__init__(*joints, required=2)
        self._is_flat = False

    def _positions(self, template: wire.Template, at: Sequence[float]) -> list[int]:
        self._is_flat |= at[2] == inf
        return super()._positions(template, at)

    def values(self, numbers: FloatArray) -> FloatArray:
        if self._is_flat:
            numbers[:, 2] = np.nan_to_num(numbers[:, 2])
        return numbers

    def fault(self) -> str:
        wanted = ' and '.join(self._joints[:2])
        names = _listing(self._names)
        return '' if self._is_used else f'must have the joints {wanted}, has {names}'

    def losses(self) -> list[str]:
        return ['has no joint out of the plane: off-plane motion unknown'] if self._is_flat else []


def _listing(names: Set[str]) -> str:
    shown = (' '.join(name.split()) for name in sorted(names)[:_MAX_NAMES])
    return ', '.join(shown) or 'none'


def _element(array: tuple[int, int], index: float) -> int:
    begin, length = array
    return begin + 8 * int(index) if index < length else -1


def _position_and_velocity(position: FloatArray, velocity: FloatArray) -> FloatArray:
    known = np.abs(velocity) < _LARGEST
    return np.column_stack([position, np.where(known, velocity, 0.0), known])


def source_of(type_name: str, axes: Sequence[str], joint: str | None = None) -> SignalSource:
    """Return the source of an axis, of a plane (two axes and the third), or of a joint."""
    if type_name == wire.JOINT_STATE:
        return _PlaneJoints(*axes) if len(axes) == 3 else _Joint(joint)
    if type_name == wire.ODOMETRY and len(axes) == 1:
        return _Odometry(*axes)
    return _Vector(*axes)


class SampleOrigin(Protocol):
    """Bag or running topics: its name for messages, and its discarded and repaired data."""

    @property
    def losses(self) -> list[str]: ...

    @property
    def path(self) -> object: ...


class Samples(NamedTuple):
    """Samples of a topic."""

    topic: str
    stamps: IntArray  # (n,), strictly increasing [ns]
    values: FloatArray  # (n, k)
    latency: IntArray  # some receive times minus stamps [ns]


class Gathering:
    """Gathers the samples of one topic, stamped by message headers or by receive times."""

    def __init__(self, topic: BagTopic, source: SignalSource, *, by_header: bool) -> None:
        self._topic = topic
        self._source = source
        self._by_header = by_header
        self._series = Series(source.width)
        self._latencies: list[IntArray] = []
        #: Stamps in order of reception, of every message or fewer.
        self._received: list[IntArray] = []
        self._every, self._count = 1, 0
        self._unstamped = self._invalid = self._unusable = self._unwanted = self._messages = 0
        self._fault = ''

    def add(self, batch: MessageBatch) -> None:
        kind, source = self._topic.type_name, self._source
        decoded = wire.decode(batch.data, batch.begin, batch.end, kind, source, source.columns)
        self._invalid += decoded.invalid
        self._messages += len(batch.begin)
        self._unwanted += len(batch.begin) - len(decoded.used) - decoded.invalid
        self._fault = self._fault or decoded.fault
        stamps = received = batch.received[decoded.used]
        if self._by_header:
            # A simulation may begin at the time 0.
            stamped = (decoded.stamps != 0) | (received == 0)
            self._unstamped += int(np.count_nonzero(~stamped))
            stamps = np.where(stamped, decoded.stamps, received)
        with np.errstate(all='ignore'):
            values = source.values(decoded.values)
        usable = (np.abs(values) < _LARGEST).all(axis=1)
        self._unusable += int(np.count_nonzero(~usable))
        self._series.add(stamps[usable], values[usable])
        self._keep(stamps[usable])
        few, many = _LATENCIES
        self._latencies.append((received - stamps)[:: max(1, len(stamps) // few)])
        if len(self._latencies) * few > many:
            self._latencies = [np.concatenate(self._latencies)[::2]]

    def _keep(self, stamps: IntArray) -> None:
        self._received.append(stamps[:: self._every])
        self._count += len(self._received[-1])
        if self._count > MOST_SAMPLES:
            self._received = [np.concatenate(self._received)[::2]]
            self._every, self._count = 2 * self._every, len(self._received[0])

    @property
    def has_no_values(self) -> bool:
        """Whether there are messages, but none with finite values."""
        return self._unusable > 0 and not len(self._series.stamps)

    def samples(self, bag: Bag) -> Samples:
        """Return the samples; add discarded data to the losses of the bag; raise on a fault."""
        name, series = self._topic.name, self._series
        if fault := self._source.fault():
            self._reject(bag, fault)
        series.compact()
        for count, what in (
            (self._invalid, f'not readable, left out: the first one {self._fault}'),
            (self._unstamped, 'without a stamp, the receive time is used'),
            (self._unusable, 'not finite, left out'),
        ):
            if count:
                bag.losses.append(f'{count} of {name} {what}')
        # A larger fraction is another robot on the same topic.
        if 0 < self._unwanted < _STRAY * self._messages:
            bag.losses.append(f'{self._unwanted} of {name} name other joints, left out')
        if len(series.stamps) < 2:
            fault = f'must have >= 2 samples at different times, has {len(series.stamps)}'
            self._reject(bag, fault)
        received = np.concatenate(self._received)
        if first := restart_of(received):
            place = f'message {first * self._every + 1} of {self._messages}'
            remedy = 'use --time receive, or split the bag' if self._by_header else 'split the bag'
            self._reject(bag, f'time restarts at {place}: {remedy}')
        remedy = '; time receive would correct it' if self._by_header else ''
        bag.losses += [
            f'the clock of {name} was set back by {1e-9 * (received[k - 1] - received[k]):.3g} s: '
            f'for this time the samples from before and after are mixed{remedy}'
            for k in _steps_back(received)
        ]
        bag.losses += series.losses(name)
        bag.losses += [f'{name} {loss}' for loss in self._source.losses()]
        return Samples(name, series.stamps, series.values, np.concatenate(self._latencies))

    def _reject(self, bag: Bag, fault: str) -> NoReturn:
        what = f'{bag.path}: {self._topic.name} {fault}'
        raise RecordingError('; '.join([what, *bag.losses]))


def are_gaps(steps: IntArray | FloatArray) -> BoolArray:
    """Return which steps between samples, (n,), are gaps, without interpolation."""
    return np.asarray(steps > _GAP * np.median(steps))


def are_covered(stamps: IntArray | FloatArray, others: IntArray | FloatArray) -> BoolArray:
    """Return which stamps, (n,), lie between two others, in order, that are no gap."""
    steps = np.diff(others)
    after = np.clip(np.searchsorted(others, stamps), 1, len(steps))
    inside = (others[0] <= stamps) & (stamps <= others[-1])
    return np.asarray(inside & ~are_gaps(steps)[after - 1])


def restart_of(time: IntArray | FloatArray, least: int = RUN) -> int:
    """Return the first sample of a second run, whose time begins again, else 0."""
    latest = time.min() + _NEAR * np.ptp(time) if len(time) else 0
    return next((begin for begin in _steps_back(time, least) if time[begin] <= latest), 0)


def _steps_back(time: IntArray | FloatArray, least: int = RUN) -> Iterator[int]:
    """Yield the first samples of parts whose times lie between those before."""
    steps = np.diff(time)
    back = np.flatnonzero(are_gaps(np.abs(steps)) & (steps < 0)) + 1
    # Samples in any order are sorted.
    if len(back) > len(time) // least:
        return
    for begin, end in pairwise([*back, len(time)]):
        run, before = time[begin:end], np.unique(time[:begin]).astype(np.float64)
        # Neither a part that was stored in another place or came late, nor single wrong times.
        enough = len(before) >= _OVERLAP
        if enough and np.count_nonzero(are_covered(run, before)) >= _OVERLAP:
            yield int(begin)


def position_and_velocity(samples: Samples, bag: SampleOrigin) -> Samples:
    """Return the position and, if measured, the velocity; a velocity alone is integrated."""
    topic, _, values, _ = samples
    if values.shape[1] == 1:
        return _from_velocity(samples, bag)
    position, velocity, share = values.T
    known = share > 0.0
    if velocity.any() and not position.any():
        alone = (velocity[known] / share[known])[:, np.newaxis]
        return _from_velocity(samples._replace(stamps=samples.stamps[known], values=alone), bag)
    if np.count_nonzero(known) < max(2.0, 0.5 * len(known)):
        bag.losses.append(f'{topic} has no velocity')
    elif not velocity.any() and np.ptp(position) > 0.0:
        bag.losses.append(f'{topic} moves with the velocity 0, which is left out')
    else:
        if not known.all():
            bag.losses.append(f'{np.count_nonzero(~known)} of {topic} without velocity, left out')
        # A bin may contain samples with and without velocity.
        both = np.column_stack([position[known], velocity[known] / share[known]])
        return samples._replace(stamps=samples.stamps[known], values=both)
    return samples._replace(values=values[:, :1])


def _from_velocity(samples: Samples, bag: SampleOrigin) -> Samples:
    bag.losses.append(f'{samples.topic} has no position: depth is the integral of speed from 0')
    time = (samples.stamps - samples.stamps[0]) * 1e-9
    velocity = samples.values[:, 0]
    return samples._replace(values=np.column_stack([integrated(time, velocity), velocity]))
