# SPDX-License-Identifier: Apache-2.0
"""Frames of a bag at any time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import Any, Final, Generic, TypeVar

from needle_dynamics import FloatArray
from needle_identification import Bag, RecordingError
from needle_identification.bags.bag import Recorded
from needle_identification.bags.messages import deserialize
from needle_identification.bags.topics import BagTopic
from needle_insertion.watch.scene import CONFIGURED, parameters_of
from needle_insertion.watch.view import RATE, row, SPAN, View
from needle_ros import contract
from needle_ros.errors import MessageError, ParameterError
from needle_ros.status import node_of
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import MessageReader, read_line, read_string, Reading

#: Topics shown on the page; each also in a namespace.
STREAMS: Final = (
    contract.JOINT_STATES, contract.BASE_WRENCH, contract.TIP_DEFLECTION, contract.REFERENCE,
    contract.TRACKING_ERROR, contract.TARGET,
)  # fmt: skip
_OTHERS: Final = (contract.NEEDLE_SHAPE, contract.TIP_EXPECTED, contract.DIAGNOSTICS)

#: Largest number of stored messages per topic; longer recordings are decimated by two.
_MOST: Final = 8192

_HISTORY_RATE: Final = 10.0  #: rows of the history per second [Hz]

#: Range of the playback speed, relative to real time.
SLOWEST, FASTEST = 0.02, 50.0

_Item = TypeVar('_Item')


class _Kept(Generic[_Item]):
    """Messages of a topic by time, decimated to an interval [s] and to `_MOST` messages."""

    def __init__(self, interval: float = 0.0) -> None:
        self.interval = interval
        self._times: list[float] = []
        self._items: list[_Item] = []

    def add(self, time: float, make: Callable[[], _Item]) -> None:
        """Store the result of ``make`` unless it is too soon after the previous message."""
        if self._times and time < self._times[-1] + self.interval:
            return
        self._items.append(make())
        self._times.append(time)
        if len(self._times) > _MOST:
            span = self._times[-1] - self._times[0]
            self.interval = max(2.0 * self.interval, 2.0 * span / _MOST)
            del self._times[1::2], self._items[1::2]

    def at(self, time: float) -> tuple[float, _Item] | None:
        """Return time and content of the newest message at a time."""
        k = bisect_right(self._times, time) - 1
        return (self._times[k], self._items[k]) if k >= 0 else None


class ShownRecording:
    """Content of a bag for the page by time [s]; `RecordingError` if it has nothing to show."""

    def __init__(self, path: Path) -> None:
        self.name = path.name or str(path)
        period = 0.75 / RATE
        self._readings: dict[str, _Kept[Reading]] = {}
        self._lines = {name: _Kept[FloatArray](period) for name in ('needle', 'path')}
        self._expected = _Kept[Any]()
        self._configurations = {name: _Kept[dict[str, Any]]() for name in CONFIGURED}
        self._nodes: dict[str, _Kept[Any]] = {}
        self._period = period
        self._invalid = 0
        self._readers = {topic.name: MessageReader(topic.type_name) for topic in STREAMS}

        bag = Bag(path)
        topics = bag.topics()
        chosen = _chosen(topics)
        if not chosen:
            known = ', '.join(topic.name for topic in (*STREAMS, *_OTHERS))
            raise RecordingError(
                f'{path} has nothing to show: none of {known}; it has '
                f'{", ".join(topic.name for topic in topics)}'
            )
        first: int | None = None
        last = 0
        for message in bag.messages(chosen.__contains__):
            first = message.received if first is None else first
            last = max(last, message.received)
            try:
                self._take(chosen[message.topic], message, first)
            except (MessageError, RecordingError):
                self._invalid += 1
        self.duration = (last - (first or 0)) / NANOSECONDS
        self.losses = tuple(bag.losses)
        if self._invalid:
            self.losses += (f'{self._invalid} messages do not match the type of their topic',)
        shown: list[_Kept[Any]] = [*self._readings.values(), *self._lines.values()]
        if not any(kept.at(self.duration) for kept in shown):
            reasons = '; '.join((f'{path} has no readings to show', *self.losses))
            raise RecordingError(reasons)
        longest = max(kept.interval for kept in shown)
        self._silent = max(1.0, 3.0 * longest)

    def _take(self, name: str, message: Recorded, first: int) -> None:
        """Store the content of a message."""
        time, data = (message.received - first) / NANOSECONDS, message.data
        if name in self._readers:
            read = self._readers[name].read
            self._readings.setdefault(name, _Kept(self._period)).add(time, lambda: read(data))
        elif name == contract.NEEDLE_SHAPE.name:
            which, points = read_line(data)
            if which in self._lines:
                self._lines[which].add(time, lambda: points)
        elif name == contract.TIP_EXPECTED.name:
            self._expected.add(time, lambda: deserialize(message.topic, data))
        elif name == contract.DIAGNOSTICS.name:
            for status in deserialize(message.topic, data).status:
                # Called at once.
                self._nodes.setdefault(node_of(status.name), _Kept()).add(time, lambda: status)  # noqa: B023
        else:
            parameters = parameters_of(read_string(data))
            self._configurations[name].add(time, lambda: parameters)

    def view(self, time: float) -> View:
        """Return the state of the page at a time from the start [s]."""
        view = View(self._silent)
        view.invalid = self._invalid
        for topic, readings in self._readings.items():
            if found := readings.at(time):
                view.reading(topic, found[1], found[0])
        for name, lines in self._lines.items():
            if drawn := lines.at(time):
                view.line(name, drawn[1], drawn[0])
        if expected := self._expected.at(time):
            view.expected(expected[1])
        for node, configurations in self._configurations.items():
            if parameters := configurations.at(time):
                view.configuration(node, parameters[1])
        for states in self._nodes.values():
            if state := states.at(time):
                view.status(state[1], state[0])
        return view

    def history(self, time: float) -> list[list[float | None]]:
        """Return the history before a time [s]: rows of `view.row` at 10 Hz."""
        count = int(min(SPAN, time) * _HISTORY_RATE)
        rows = []
        for k in range(count, 0, -1):
            at = time - k / _HISTORY_RATE
            view = View()
            for topic, readings in self._readings.items():
                if found := readings.at(at):
                    view.reading(topic, found[1], found[0])
            rows.append(row(view.frame(at)))
        return rows


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

    def take(self, message: dict[str, Any]) -> bool:
        """Process a message ``at`` (a time [s]), ``play`` or ``speed``; return if time jumped."""
        now = self.at
        match message:
            case {'at': int() | float() as at, **rest} if not rest and at is not True:
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
        return self._at != now


def _chosen(topics: tuple[BagTopic, ...]) -> dict[BagTopic, str]:
    """Return the topics to read, by contract name or, for configurations, by node name."""
    chosen: dict[BagTopic, str] = {}
    for topic in sorted(topics, key=lambda one: len(one.name), reverse=True):
        space, _, last = topic.name.rpartition('/')
        for known in (*STREAMS, *_OTHERS):
            if topic.type_name == known.type_name and last == known.name.rpartition('/')[2]:
                chosen = {one: name for one, name in chosen.items() if name != known.name}
                chosen[topic] = known.name
        node = space.rpartition('/')[2]
        if last == 'configuration' and node in CONFIGURED:
            chosen = {one: name for one, name in chosen.items() if name != node}
            chosen[topic] = node
    return chosen
