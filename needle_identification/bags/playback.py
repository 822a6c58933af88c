"""Playback of a bag: which message is due when, in the time of the recording."""

from __future__ import annotations

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

#: Longest pause between two messages that is believed: a day [ns].
_LONGEST_PAUSE: Final = 24 * 3600 * NANOSECONDS


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaybackSettings:
    """
    Which part of a recording is played, and how fast; each field says its meaning and unit.

    Raises
    ------
    ParameterError
        If a setting is out of range, or end is not after start.

    """

    rate: float = constant(
        1.0, '1', 'playback speed relative to the recording; 0: as fast as possible'
    )
    start: float = constant(0.0, 's', 'time in the recording at which to begin')
    end: float = constant(0.0, 's', 'time in the recording at which to end; 0: its end')
    delay: float = constant(
        0.5, 's', 'time before the first message, for readers to find the publishers'
    )

    def __post_init__(self) -> None:
        check_constants(self)
        if 0.0 < self.end <= self.start:
            raise ParameterError(
                f'end must be beyond start = {self.start:g} s, or 0, got {self.end:g} s'
            )


class Playback:
    """
    Goes through the messages of a bag in the order in which they were received.

    Parameters
    ----------
    bag : Bag
        The recording.
    topics : set of str
        Names of the topics to play.
    latched : mapping
        Number of messages that are kept for late readers, by name of each latched topic. Those
        from before the start are played first.
    settings : PlaybackSettings
        Which part is played, and how fast.

    Attributes
    ----------
    bag : Bag
        The recording.
    is_paused, is_ended : bool
        Whether the recorded time stands still, or all is played.
    late, latest : float
        Delay of the last message, and the largest delay so far [s].
    loops : int
        How often it began again.

    Raises
    ------
    RecordingError
        If there is no message to play.

    """

    def __init__(
        self, bag: Bag, topics: Set[str], latched: Mapping[str, int], settings: PlaybackSettings
    ) -> None:
        self.bag = bag
        self._topics, self._latched, self._settings = topics, latched, settings
        #: Time at which the recording begins [ns].
        self._origin = next(bag.messages(lambda _topic: True)).received
        self.start(paused=True)

    def start(self, *, paused: bool) -> None:
        """
        Play from the start.

        Parameters
        ----------
        paused : bool
            Whether to begin paused.

        Raises
        ------
        RecordingError
            If there is no message to play.

        """
        self._rewind()
        self.is_paused, self.is_ended = paused, False
        self.late = self.latest = 0.0
        self.loops = 0
        self._set_position(self.begin, self._settings.delay)

    @property
    def begin(self) -> int:
        """Time of the recording at which to begin [ns]."""
        return self._origin + round(self._settings.start * NANOSECONDS)

    @property
    def settings(self) -> PlaybackSettings:
        """Which part is played, and how fast; the rate may change while playing."""
        return self._settings

    @settings.setter
    def settings(self, settings: PlaybackSettings) -> None:
        self._set_position(self.position)
        self._settings = settings

    def _set_position(self, position: int, delay: float = 0.0) -> None:
        """Let a time of the recording [ns] be now, or after a delay [s]."""
        self._at, self._since = position, time.monotonic() + delay

    @property
    def position(self) -> int:
        """Present time of the recording [ns]."""
        if self.is_paused or self.is_ended or self._settings.rate == 0.0:
            return self._at
        elapsed = max(0.0, time.monotonic() - self._since)
        return self._at + round(elapsed * self._settings.rate * NANOSECONDS)

    def seconds(self, position: int) -> float:
        """
        Return a time of the recording relative to its begin.

        Parameters
        ----------
        position : int
            Time of the recording [ns].

        Returns
        -------
        float
            Time [s].

        """
        return (position - self._origin) / NANOSECONDS

    def pause(self, paused: bool) -> None:
        """
        Let the recorded time stand still, or go on.

        Parameters
        ----------
        paused : bool
            Whether to stand still.

        """
        self._set_position(self.position)
        self.is_paused = paused

    def _rewind(self) -> None:
        """Go to the start: keep what was latched before, and have the first message ready."""
        settings = self._settings
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
        """Whether the recorded time runs."""
        return not (self.is_paused or self.is_ended) and time.monotonic() >= self._since

    @property
    def has_next(self) -> bool:
        """Whether there is a message left."""
        return self._next is not None

    def is_due(self) -> bool:
        """
        Tell whether the next message is due, and note how late it is.

        Returns
        -------
        bool
            Whether it is due; False if there is none.

        Raises
        ------
        RecordingError
            If it is so much later than the one before that its receive time must be wrong.

        """
        if self._next is None:
            return False
        pause = self._next.received - self._last
        if pause > _LONGEST_PAUSE:
            days, name = pause / _LONGEST_PAUSE, self._next.topic.name
            raise RecordingError(
                f'{self.bag.path} has a damaged receive time at {self.seconds(self._last):.3f} s: '
                f'a message of {name} came {days:.3g} days later'
            )
        if self._settings.rate > 0.0:
            late = self.position - self._next.received
            if late < 0:
                return False
            self.late = late / self._settings.rate / NANOSECONDS
            self.latest = max(self.latest, self.late)
        return True

    def take(self) -> list[Recorded]:
        """
        Take the next message.

        Returns
        -------
        list of Recorded
            The message, after those that were latched before the start; empty if there is none.

        """
        if self._next is None:
            return []
        taken = [*self._before, self._next]
        self._before = []
        self._last = self._next.received
        if self.is_paused or self._settings.rate == 0.0:
            self._at = self._last
        self._next = next(self._messages, None)
        if self._next is not None and self._end is not None and self._next.received > self._end:
            self._next = None
        return taken

    def finish(self, *, loop: bool) -> None:
        """
        At the end of the recording, begin again or end.

        Parameters
        ----------
        loop : bool
            Whether to begin again.

        Raises
        ------
        RecordingError
            If the recording is no longer readable.

        """
        if loop:
            self.loops += 1
            self._rewind()
            self._set_position(self.begin)
        else:
            self._at = self._last
            self.is_ended = True
