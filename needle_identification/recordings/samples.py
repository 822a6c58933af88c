"""Samples of one topic, gathered while its bag is read."""

from __future__ import annotations

from typing import Final, NamedTuple, NoReturn

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.bags.bag import Bag
from needle_identification.bags.batch import Batch
from needle_identification.bags.topics import Topic
from needle_identification.errors import RecordingError
from needle_identification.recordings.recording import integrated
from needle_identification.recordings.series import FINEST, Series
from needle_identification.recordings.sources import LARGEST, Source
from needle_ros import wire
import numpy as np
from numpy.typing import NDArray

#: A longer step between samples is a gap [sampling periods].
_GAP: Final = 10.0

#: Latencies that are kept of a batch, and of a topic.
_LATENCIES: Final = (64, 2**16)


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
        self._unstamped = self._invalid = self._unusable = 0
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
        self._fault = self._fault or decoded.fault
        stamps = received = batch.received[decoded.used]
        if self._by_header:
            stamped = decoded.stamps != 0
            self._unstamped += int(np.count_nonzero(~stamped))
            stamps = np.where(stamped, decoded.stamps, received)
        with np.errstate(all='ignore'):
            values = self._source.measured(decoded.values)
        usable = (np.abs(values) < LARGEST).all(axis=1)
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
        if complaint := self._source.complaint():
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
        bag.losses += [f'{name} {loss}' for loss in self._source.losses()]
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


def with_speed(samples: Samples, bag: Bag) -> Samples:
    """
    Keep what was measured of position and speed.

    Parameters
    ----------
    samples : Samples
        Values are position, speed, and whether there is a speed.
    bag : Bag
        The bag; what is missing is added to its losses.

    Returns
    -------
    Samples
        Values are position and speed, or position alone.

    """
    topic, _, values, _ = samples
    position, speed, share = values.T
    known = share > 0.0
    if speed.any() and not position.any():
        alone = (speed[known] / share[known])[:, np.newaxis]
        return from_speed(samples._replace(stamps=samples.stamps[known], values=alone), bag)
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


def from_speed(samples: Samples, bag: Bag) -> Samples:
    """
    Integrate a speed.

    Parameters
    ----------
    samples : Samples
        Values are the speed alone.
    bag : Bag
        The bag; that there is no position is added to its losses.

    Returns
    -------
    Samples
        Values are position, from zero, and speed.

    """
    bag.losses.append(f'{samples.topic} has no position: depth is the integral of speed from 0')
    time = (samples.stamps - samples.stamps[0]) * 1e-9
    speed = samples.values[:, 0]
    return samples._replace(values=np.column_stack([integrated(time, speed), speed]))
