# SPDX-License-Identifier: Apache-2.0
"""Play back a bag: schedule its messages in recorded time."""

from collections import deque
from collections.abc import Mapping, Set
from dataclasses import dataclass
from itertools import chain
import time
from typing import Final

from needle_identification.bags.bag import Bag, Recorded
from needle_identification.errors import RecordingError
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
from needle_ros.timing import NANOSECONDS

_LONGEST_PAUSE: Final = 24 * 3600 * NANOSECONDS  # longest plausible pause: a day [ns]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaybackSettings:
    """Interval and rate of playback; each field has its meaning and unit."""

    rate: float = constant(
        1.0, '1', 'playback speed relative to the recording; 0: as fast as possible'
    )
    start: float = constant(0.0, 's', 'start time in the recording')
    end: float = constant(0.0, 's', 'end time in the recording; 0: end of the recording')
    delay: float = constant(
        0.5, 's', 'time before the first message, for readers to find the publishers'
    )

    def __post_init__(self) -> None:
        check_constants(self)
        if 0.0 < self.end <= self.start:
            raise ParameterError(
                f'end must be beyond start = {self.start:g} s, or 0, got {self.end:g} s'
            )


class BagPlayback:
    """Iterate over the messages of a bag in recorded time, earlier latched messages first."""

    def __init__(
        self, bag: Bag, topics: Set[str], latched: Mapping[str, int], settings: PlaybackSettings
    ) -> None:
        self.bag = bag
        #: ``latched``: number of messages that are kept for late readers, by name of the topic.
        self._topics, self._latched, self.settings = topics, latched, settings
        #: Receive time of the first message [ns].
        self._origin = next(bag.messages(lambda _topic: True)).received
        self.start(paused=True)

    def start(self, *, paused: bool) -> None:
        """Play from the start; raise a RecordingError if there is no message to play."""
        self._rewind()
        self.is_paused, self.is_ended = paused, False
        #: First damaged receive time that did not end the playback, at rate 0.
        self.damage = ''
        #: Delay of the last message and largest delay [s], and number of restarts at the end.
        self.late = self.latest = 0.0
        self.loops = 0
        self._set_position(self.begin, self.settings.delay)

    @property
    def begin(self) -> int:
        """Recorded time of the start [ns]."""
        return self._origin + round(self.settings.start * NANOSECONDS)

    def change(self, settings: PlaybackSettings) -> None:
        self._set_position(self.position)
        self.settings = settings

    def _set_position(self, position: int, delay: float = 0.0) -> None:
        """Map a recorded time [ns] to the present time plus a delay [s]."""
        self._at, self._since = position, time.monotonic() + delay

    @property
    def position(self) -> int:
        if self.is_paused or self.is_ended or self.settings.rate == 0.0:
            return self._at
        elapsed = max(0.0, time.monotonic() - self._since)
        return self._at + round(elapsed * self.settings.rate * NANOSECONDS)

    def seconds(self, position: int) -> float:
        """Convert a recorded time [ns] to the time since the begin of the recording [s]."""
        return (position - self._origin) / NANOSECONDS

    def pause(self, paused: bool) -> None:
        self._set_position(self.position)
        self.is_paused = paused

    def _rewind(self) -> None:
        """Return to the start: collect earlier latched messages and read the first message."""
        settings = self.settings
        end = self._origin + round(settings.end * NANOSECONDS) if settings.end else None
        before: dict[str, deque[Recorded]] = {}
        messages = self.bag.messages(lambda topic: topic.name in self._topics)
        last, first = self._origin, None
        for message in messages:
            last = message.received
            if last >= self.begin:
                first = message
                break
            name = message.topic.name
            if name in self._latched:
                before.setdefault(name, deque(maxlen=self._latched[name])).append(message)
        if first is None:
            raise RecordingError(
                f'start = {settings.start:g} s is beyond the end of {self.bag.path}, whose topics '
                f'to play end at {self.seconds(last):.3f} s'
            )
        if end is not None and first.received > end:
            raise RecordingError(
                f'{self.bag.path} has no message to play from {settings.start:g} s to '
                f'{settings.end:g} s; the next one is at {self.seconds(last):.3f} s'
            )
        self._before, self._end = [*chain(*before.values())], end
        self._messages = messages
        self._next: Recorded | None = first
        self._last = self.begin

    @property
    def is_running(self) -> bool:
        return not (self.is_paused or self.is_ended) and time.monotonic() >= self._since

    @property
    def has_next(self) -> bool:
        return self._next is not None

    def is_due(self) -> bool:
        """Whether the next message is due; records its delay, and rejects a wait of a day."""
        if self._next is None:
            return False
        pause = self._next.received - self._last
        if pause > _LONGEST_PAUSE:
            days, name = pause / _LONGEST_PAUSE, self._next.topic.name
            damage = (
                f'{self.bag.path} has a damaged receive time at {self.seconds(self._last):.3f} s: '
                f'a message of {name} arrives {days:.3g} days later'
            )
            if self.settings.rate > 0.0:
                raise RecordingError(damage)
            self.damage = self.damage or damage
        if self.settings.rate > 0.0:
            late = self.position - self._next.received
            if late < 0:
                return False
            self.late = late / self.settings.rate / NANOSECONDS
            self.latest = max(self.latest, self.late)
        return True

    def take(self) -> list[Recorded]:
        """Take the next message, after earlier latched messages; empty at the end."""
        if self._next is None:
            return []
        taken = [*self._before, self._next]
        self._before = []
        self._last = self._next.received
        if self.is_paused or self.settings.rate == 0.0:
            self._at = self._last
        self._next = next(self._messages, None)
        if self._next is not None and self._end is not None and self._next.received > self._end:
            self._next = None
        return taken

    def finish(self, *, loop: bool) -> None:
        if loop:
            self.loops += 1
            self._rewind()
            self._set_position(self.begin)
        else:
            self._at = self._last
            self.is_ended = True
