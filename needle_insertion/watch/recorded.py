# SPDX-License-Identifier: Apache-2.0
"""Frames of a bag at any time."""

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import ceil, isnan, log2, nan
from pathlib import Path
from time import monotonic
from typing import Any, Final, TypeAlias

from needle_identification import Bag, RecordingError
from needle_identification.bags.bag import Recorded
from needle_identification.bags.messages import deserialize
from needle_identification.bags.topics import BagTopic
from needle_identification.recordings import TIMES
from needle_identification.recordings.samples import are_gaps
from needle_insertion.report.content import short_names
from needle_insertion.watch.robot import WatchedRobot
from needle_insertion.watch.view import CONFIGURED, EFFORT, RATE, Signal, signal_of, SIGNALS, View
from needle_ros import contract
from needle_ros.errors import MessageError, ParameterError
from needle_ros.parameter_file import parameters_in
from needle_ros.settings import is_number
from needle_ros.status import read_reports
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import MessageReader, read_line, read_string, Reading
import numpy as np

#: Topics shown on the page; each also in a namespace.
STREAMS: Final = (
    contract.JOINT_STATES, contract.BASE_WRENCH, contract.TIP_DEFLECTION, contract.REFERENCE,
    contract.TRACKING_ERROR, contract.TARGET,
)  # fmt: skip
_OTHERS: Final = (contract.NEEDLE_SHAPE, contract.TIP_EXPECTED, contract.DIAGNOSTICS)

#: Largest number of stored messages per topic; longer recordings are decimated by two.
_MOST: Final = 8192

_GAP: Final = 5.0  #: Shortest pause that is a gap of a thinned signal [intervals of the thinning].

#: Change of the depth that is a motion of the needle [m]: above the noise of encoders.
_MOVED: Final = 1e-4

_SLACK: Final = 10.0  #: Difference of the durations by stamps and by arrival that is reported [s].

SLOWEST, FASTEST = 0.02, 50.0  #: Range of the playback speed, relative to real time.

_Effect: TypeAlias = Callable[[View], object]  #: Effect of a message on the state of the page.


class _Kept:
    """Messages by time, decimated to an interval [s] and to `_MOST`, each as its effect."""

    def __init__(self, interval: float = 0.0) -> None:
        self.interval = interval
        self._times: list[float] = []
        self._effects: list[_Effect] = []

    def add(self, time: float, effect: _Effect) -> None:
        """Store the effect of a message on a view, unless it is too soon after the previous."""
        if self._times and time < self._times[-1] + self.interval:
            return
        self._effects.append(effect)
        self._times.append(time)
        if len(self._times) > _MOST:
            span = self._times[-1] - self._times[0]
            self.interval = max(2.0 * self.interval, 2.0 * span / _MOST)
            del self._times[1::2], self._effects[1::2]

    def show(self, view: View, time: float) -> None:
        """Put the newest message at a time into a view."""
        if k := bisect_right(self._times, time):
            self._effects[k - 1](view)


class _Curve:
    """Values of a signal by time; of many, the smallest and the largest of each interval."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._values: list[float] = []
        self._interval = 0.0

    def add(self, time: float, value: float | None) -> None:
        """Store a value, unless its time is before the newest."""
        if self._times and time < self._times[-1]:
            return
        self._times.append(time)
        self._values.append(nan if value is None else value)
        if len(self._times) > 2 * _MOST:
            self._thin()

    def _thin(self) -> None:
        """Keep the smallest and the largest value of each interval, at most `_MOST` in all."""
        times, values = np.array(self._times), np.array(self._values)
        shortest = 2.0 * max(times[-1] - times[0], 1e-6) / (_MOST - 4)
        # A power of two: each interval consists of whole earlier intervals.
        self._interval = max(self._interval, 2.0 ** ceil(log2(shortest)))
        known = np.flatnonzero(np.isfinite(values))
        interval = np.floor(times[known] / self._interval)
        order = np.lexsort((values[known], interval))
        ends = np.flatnonzero(np.diff(interval[order]))
        chosen = order[np.concatenate(([0], ends, ends + 1, [-1]))] if len(order) else order
        kept = known[np.unique(chosen)]
        self._times, self._values = times[kept].tolist(), values[kept].tolist()

    def points(self) -> list[list[float | None]] | None:
        """Return times [s] and values, None before a gap; None without values."""
        if len(self._times) > _MOST:
            self._thin()
        values = np.array(self._values)
        if not np.isfinite(values).any():
            return None
        times = np.array(self._times)
        steps = np.diff(times, prepend=times[0])
        gaps = steps > _GAP * self._interval if self._interval else are_gaps(steps)
        at = np.flatnonzero(gaps)
        times, values = np.insert(times, at, times[at]), np.insert(values, at, nan)
        known = [None if isnan(value) else value for value in values.tolist()]
        return [[round(time, 6) for time in times.tolist()], known]


#: Signals of each topic.
_OF_TOPIC: Final = {
    topic.name: [one for one in (*SIGNALS.values(), EFFORT) if one.topic == topic.name]
    for topic in STREAMS
}


class ShownRecording:
    """
    Content of a bag for the page by time [s]; `RecordingError` if it has nothing to show.

    ``time`` selects the stamps, one of `TIMES`. A message without a stamp has the time of the
    newest message before it.
    """

    def __init__(self, path: Path, time: str = TIMES[0]) -> None:
        self.path, self.name = path, path.name or str(path)
        self._header = time == TIMES[0]
        #: Messages by topic, and by line or node.
        self._kept: dict[tuple[str, str], _Kept] = {}
        self._curves = defaultdict[Signal, _Curve](_Curve)
        self._invalid = 0
        self._readers = {topic.name: MessageReader(topic.type_name) for topic in STREAMS}

        bag = Bag(path)
        topics = bag.topics()
        self._robot = _robot_of(bag, topics)
        chosen, others = _chosen(topics, self._robot)
        if not chosen:
            known = ', '.join(topic.name for topic in (*STREAMS, *_OTHERS))
            raise RecordingError(
                f'{path} has nothing to show: none of {known}; it has '
                f'{", ".join(topic.name for topic in topics)}'
            )
        self._first: int | None = None
        self._newest = 0.0
        #: Newest time of each topic [s], and number of lost messages by words.
        self._latest: dict[str, float] = {}
        self._dropped = Counter[str]()
        begin = end = 0
        for message in bag.messages(chosen.__contains__):
            begin, end = begin or message.received, message.received
            try:
                self._take(chosen[message.topic], message)
            except (MessageError, RecordingError):
                self._invalid += 1
        self.duration = self._newest
        self.losses = (*bag.losses, *others)
        if self._robot.words:
            self.losses += (self._robot.words,)
        if self._invalid:
            self.losses += (f'{self._invalid} messages do not match the type of their topic',)
        self.losses += tuple(f'{n} messages of {words}' for words, n in self._dropped.items())
        elapsed = (end - begin) / NANOSECONDS
        if self._header and self.duration > 2.0 * elapsed + _SLACK:
            contradiction = (
                f'the stamps of {path} span {self.duration:.4g} s, and its messages arrived '
                f'within {elapsed:.4g} s: use --time receive if clocks differed'
            )
            self.losses += (contradiction,)
        timed = (*self._readers, contract.NEEDLE_SHAPE.name)
        intervals = [kept.interval for (name, _), kept in self._kept.items() if name in timed]
        if not intervals:
            raise RecordingError('; '.join((f'{path} has no readings to show', *self.losses)))
        self._silent = max(1.0, 3.0 * max(intervals))

    def _time(self, stamp: int) -> float:
        """Return the time of a stamp [ns] from the start [s], and store it if it is the newest."""
        if self._first is None:
            self._first = stamp
        time = (stamp - self._first) / NANOSECONDS
        self._newest = max(self._newest, time)
        return time

    def _take(self, name: str, message: Recorded) -> None:
        data = message.data
        time = self._newest if self._header else self._time(message.received)
        if name in self._readers:
            reading = self._readers[name].read(data)
            if self._header and reading.stamp:
                time = self._time(reading.stamp)
            self._keep_reading(name, reading, time)
        elif name == contract.NEEDLE_SHAPE.name:
            which, points = read_line(data)
            if which in ('needle', 'path'):
                line = partial(View.line, name=which, points=points, now=time)
                self._keep((name, which), time, line, 0.75 / RATE)
        elif name == contract.TIP_EXPECTED.name:
            expected = deserialize(message.topic, data)
            self._keep((name, ''), time, lambda view: view.expected(expected))
        elif name == contract.DIAGNOSTICS.name:
            for report in read_reports(deserialize(message.topic, data)):
                effect = partial(View.report, report=report, now=time)
                self._keep((name, report.node), time, effect)
        else:
            parameters = parameters_in(read_string(data))
            self._keep((name, ''), time, lambda view: view.configuration(name, parameters))

    def _keep_reading(self, name: str, reading: Reading, time: float) -> None:
        # Of two publishers, the messages with the insertion joint stay.
        which = ''
        try:
            converted = self._robot.reading(name, reading)
        except ParameterError as error:
            which = 'unusable'
            self._drop(f'{name} are without a depth: {error}')
        else:
            latest = self._latest.get(name, time)
            if time < latest:
                self._drop(
                    f'{name} are not shown: a stamp before has a later time (--time receive shows '
                    'them)'
                )
            self._latest[name] = max(time, latest)
            for signal in _OF_TOPIC[name]:
                self._curves[signal].add(time, signal.of(converted))
        self._keep((name, which), time, lambda view: view.reading(name, reading, time))

    def _drop(self, words: str) -> None:
        self._dropped[words] += 1

    def _keep(
        self, key: tuple[str, str], time: float, effect: _Effect, interval: float = 0.0
    ) -> None:
        self._kept.setdefault(key, _Kept(interval)).add(time, effect)

    def view(self, time: float) -> View:
        """Return the state of the page at a time from the start [s]."""
        view = View(self._silent, self._robot)
        view.invalid = self._invalid
        for kept in self._kept.values():
            kept.show(view, time)
        return view

    def signals(self) -> dict[str, list[list[float | None]]]:
        """Return times [s] and values of each recorded signal; None between them is a gap."""
        topics = {topic for topic, _ in self._kept}
        found = {name: self._curves[signal_of(name, topics)].points() for name in SIGNALS}
        return {name: points for name, points in found.items() if points is not None}

    def start_of_motion(self) -> float | None:
        """Return the time of the first motion of the needle [s]; None without a motion."""
        points = self._curves[SIGNALS['depth']].points()
        known = [pair for pair in zip(*points or ([], []), strict=True) if pair[1] is not None]
        return next((time for time, depth in known if abs(depth - known[0][1]) > _MOVED), None)


@dataclass(frozen=True)
class Comparison:
    """Another recording, by the time of the first: ``shift`` is added to its times [s]."""

    recording: ShownRecording
    shift: float
    words: str  #: description of the shift

    def needle(self, time: float) -> list[list[float]] | None:
        """Return the needle as columns at a time of the first recording [s]; None outside."""
        at = time - self.shift
        if not 0.0 <= at <= self.recording.duration:
            return None
        needle: list[list[float]] | None = self.recording.view(at).frame(at)['needle']
        return needle

    def content(self) -> dict[str, Any]:
        signals = {
            name: [[round(time + self.shift, 6) for time in times if time is not None], values]
            for name, (times, values) in self.recording.signals().items()
        }
        return {
            'name': self.recording.name,
            'words': self.words,
            'begin': self.shift,
            'end': self.shift + self.recording.duration,
            'signals': signals,
        }


def compare(
    first: ShownRecording, other: ShownRecording, shift: float | None = None
) -> Comparison:
    """Align another recording by a shift of its times [s], or at the start of motion."""
    names = short_names([str(one.path) for one in (first, other)])
    for one in (first, other):
        one.name = names[str(one.path)]
    if shift is not None:
        return Comparison(other, shift, f'{other.name}: times shifted by {shift:+.3f} s')
    here, there = first.start_of_motion(), other.start_of_motion()
    if here is None or there is None:
        still = first.name if here is None else other.name
        return Comparison(other, 0.0, f'not aligned: the needle does not move in {still}')
    shift = here - there
    words = f'{other.name}: times shifted by {shift:+.3f} s, so that both move at {here:.3f} s'
    return Comparison(other, shift, words)


class PagePlayback:
    """Playback of a recording of a duration [s] for one reader; `speed` is 1 in real time."""

    def __init__(self, duration: float, steady: Callable[[], float] = monotonic) -> None:
        self._duration = duration
        self._steady = steady
        self.playing = duration > 0.0
        self.speed = 1.0
        self._at, self._since = 0.0, steady()

    @property
    def at(self) -> float:
        """Time from the start [s]; playback stops at the end."""
        if self.playing:
            now = self._steady()
            self._at += self.speed * (now - self._since)
            self._since = now
            if self._at >= self._duration:
                self._at, self.playing = self._duration, False
        return self._at

    def take(self, message: dict[str, Any]) -> None:
        """Process a message ``at`` (a time [s]), ``play`` or ``speed``."""
        now = self.at
        match message:
            case {'at': at, **rest} if not rest and is_number(at):
                self._at = min(max(0.0, float(at)), self._duration)
            case {'play': bool() as play, **rest} if not rest:
                if play and now >= self._duration:
                    self._at = 0.0
                self.playing = play and self._duration > 0.0
            case {'speed': int() | float() as speed, **rest} if (
                not rest and SLOWEST <= speed <= FASTEST
            ):
                self.speed = float(speed)
            case _:
                raise ParameterError(
                    'a recording accepts {"at": seconds}, {"play": true or false} or {"speed": '
                    f'{SLOWEST:g} to {FASTEST:g}}}'
                )
        self._since = self._steady()


def _chosen(
    topics: tuple[BagTopic, ...], robot: WatchedRobot
) -> tuple[dict[BagTopic, str], list[str]]:
    """
    Return the topics to read, by contract name or, for configurations, by node name.

    Of several topics it is the one with the shortest name; the words report the others.
    """
    found = defaultdict[str, list[BagTopic]](list)
    for topic in sorted(topics, key=lambda one: len(one.name)):
        full = '/' + topic.name.strip('/')
        for known in (*STREAMS, *_OTHERS):
            own = '/' + robot.topic(known.name).strip('/')
            if topic.type_name == known.type_name and full.endswith(own):
                found[known.name].append(topic)
        for node in CONFIGURED:
            if full.endswith(f'/{node}/configuration'):
                found[node].append(topic)
    words = [
        f'{", ".join(other.name for other in others)}: not shown, only {one.name}'
        for one, *others in found.values()
        if others
    ]
    return {one: name for name, (one, *_) in found.items()}, words


def _robot_of(bag: Bag, topics: tuple[BagTopic, ...]) -> WatchedRobot:
    """Return the robot of the first configuration of the controller."""
    robot = WatchedRobot()
    own = [topic for topic, name in _chosen(topics, robot)[0].items() if name == 'controller']
    for message in bag.messages(own.__contains__) if own else ():
        with suppress(MessageError, RecordingError):
            robot.configure(parameters_in(read_string(message.data)))
        break
    return robot
