# SPDX-License-Identifier: Apache-2.0
"""
State of the whole system: running, paused, retracting or stopped, equal in all its nodes.

Every node that moves needle or guide has an `Authority`, and merges each state that it receives
into its own: the order of the messages, a repetition or a loss do no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from itertools import islice
from time import time_ns
from typing import Final, NamedTuple

from needle_ros.errors import printable
from needle_ros.timing import NANOSECONDS, parse_nanoseconds

#: Keys of a state as values of a DiagnosticStatus, and beginnings of keys.
_MODE, _MOTION, _STOP, _CLEARED = 'mode', 'motion', 'stop ', 'cleared '

_MOST_NODES: Final = 64  #: Maximum number of nodes in a state.
_MOST_VALUES: Final = 2 * _MOST_NODES + 2  #: Maximum number of values in a message.
_LONGEST_KEY: Final = len(_CLEARED) + 255  #: A word, and the longest name of a node in ROS.

#: Maximum time of an entry after the present [ns], 100 years: later requests follow each entry,
#: and clocks that begin in 1970 are accepted.
_LARGEST_LEAD: Final = 100 * 365 * 24 * 3600 * NANOSECONDS

RETRACT_DEPTH: Final = 0.01  #: Default insertion depth at the end of a retraction [m].

#: Requests of a user.
STOP: Final = 'stop'
CLEAR_STOP: Final = 'clear_stop'
PAUSE: Final = 'pause'
RESUME: Final = 'resume'
RETRACT: Final = 'retract'
#: Begin of the reason for which each node of a stopped system rejects a motion.
STOPPED: Final = 'stopped: '
REQUESTS: Final = (STOP, CLEAR_STOP, PAUSE, RESUME, RETRACT)


class Mode(Enum):
    """Mode of the system."""

    RUNNING = 'running'
    PAUSED = 'paused'  #: Needle and guide rest until a user resumes the motion.
    RETRACTING = 'retracting'  #: The needle is withdrawn, until a user requests another motion.
    STOPPED = 'stopped'  #: No force and no motion of the guide until a user clears the stop.


class Stop(NamedTuple):
    """Stop of a node: its time [ns], which identifies it, and its reason."""

    time: int
    reason: str


class _Motion(NamedTuple):
    """Latest request for the motion: its time [ns]; of two at the same time the later mode."""

    time: int = 0
    retracts: bool = False
    paused: bool = False


@dataclass(frozen=True, slots=True)
class SystemState:
    """Latest stop and latest cleared stop of each node, and latest request of a user."""

    stops: Mapping[str, Stop] = field(default_factory=dict)
    cleared: Mapping[str, int] = field(default_factory=dict)
    motion: _Motion = field(default_factory=_Motion)

    @property
    def reason(self) -> str:
        """Reasons of the stops in effect, the earliest first; '' without a stop."""
        active = sorted(
            stop for node, stop in self.stops.items() if stop.time > self.cleared.get(node, 0)
        )
        return '; '.join(dict.fromkeys(stop.reason for stop in active))

    @property
    def mode(self) -> Mode:
        if self.reason:
            return Mode.STOPPED
        if self.motion.paused:
            return Mode.PAUSED
        return Mode.RETRACTING if self.motion.retracts else Mode.RUNNING

    @property
    def newest(self) -> int:
        """Time of the newest entry [ns]."""
        times = [stop.time for stop in self.stops.values()]
        return max(self.motion.time, *self.cleared.values(), *times, 0)

    def merged(self, other: SystemState) -> SystemState:
        """Return the newest entries of two states; stops in effect are kept before others."""
        stops, cleared = dict(self.stops), dict(self.cleared)
        for node, stop in other.stops.items():
            stops[node] = max(stop, stops.get(node, stop))
        for node, time in other.cleared.items():
            cleared[node] = max(time, cleared.get(node, time))
        names = {*stops, *cleared}
        if len(names) > _MOST_NODES:

            def priority(node: str) -> tuple[bool, int, str]:
                stop, end = stops.get(node, Stop(0, '')).time, cleared.get(node, 0)
                return stop > end, max(stop, end), node

            for node in sorted(names, key=priority)[:-_MOST_NODES]:
                stops.pop(node, None)
                cleared.pop(node, None)
        return SystemState(stops, cleared, max(self.motion, other.motion))

    def to_values(self) -> dict[str, str]:
        time, retracts, paused = self.motion
        words = [str(time), Mode.RETRACTING.value * retracts, Mode.PAUSED.value * paused]
        return {
            _MODE: self.mode.value,
            _MOTION: ' '.join(filter(None, words)),
            **{f'{_STOP}{node}': f'{one.time} {one.reason}' for node, one in self.stops.items()},
            **{f'{_CLEARED}{node}': str(time) for node, time in self.cleared.items()},
        }

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> SystemState:
        """Parse a state from values of a DiagnosticStatus; invalid entries are ignored."""
        stops, cleared, motion = {}, {}, _Motion()
        for key, value in islice(values.items(), _MOST_VALUES):
            number, _, rest = value.partition(' ')
            time = parse_nanoseconds(number)
            if time is None or len(key) > _LONGEST_KEY:
                continue
            if key.startswith(_STOP) and rest:
                stops[key[len(_STOP) :]] = Stop(time, printable(rest))
            elif key.startswith(_CLEARED):
                cleared[key[len(_CLEARED) :]] = time
            elif key == _MOTION:
                words = rest.split()
                motion = _Motion(time, Mode.RETRACTING.value in words, Mode.PAUSED.value in words)
        return cls(stops, cleared, motion)


class Authority:
    """System state in one node, and the requests that change it, ordered by ``time`` [ns]."""

    def __init__(self, node: str = '', time: Callable[[], int] = time_ns) -> None:
        self.node, self._time = node, time
        self.state = SystemState()
        self.changed = True  #: Whether the state has changed since the node published it.

    @property
    def mode(self) -> Mode:
        return self.state.mode

    @property
    def reason(self) -> str:
        return self.state.reason

    def _next(self) -> int:
        """Return a time [ns] after all entries of the state, also if a clock is set back."""
        return max(self._time(), self.state.newest + 1)

    def receive(self, state: SystemState) -> None:
        """Merge the state of another node, unless its time is one that no clock has."""
        if state.newest <= self._time() + _LARGEST_LEAD:
            self._merge(state)

    def _merge(self, state: SystemState) -> None:
        merged = self.state.merged(state)
        self.changed |= merged != self.state
        self.state = merged

    def stop(self, reason: str) -> None:
        """Stop the system, for a reason that is not empty; a stop of this node is kept."""
        own = self.state.stops.get(self.node)
        if own is None or own.time <= self.state.cleared.get(self.node, 0):
            self._merge(SystemState(stops={self.node: Stop(self._next(), printable(reason))}))

    def clear(self) -> None:
        """Clear all stops that this node knows: nothing moves until the next request."""
        cleared = {node: stop.time for node, stop in self.state.stops.items()}
        self._merge(SystemState(cleared=cleared, motion=_Motion(self._next())))

    def compare(self, mode: Mode, retracted: int) -> tuple[bool, int]:
        """
        Return whether a node in a mode must act, and the time of the last retraction [ns].

        A second retraction is new although its mode is not; ``retracted`` is the last time.
        """
        if self.mode is not Mode.RETRACTING:
            return self.mode is not mode, retracted
        time = self.state.motion.time
        return self.mode is not mode or time != retracted, time

    def run(self) -> None:
        """End a retraction, for another motion that a user has requested."""
        if self.state.motion.retracts:
            self._change(retracts=False)

    def _change(self, **change: bool) -> None:
        motion = self.state.motion._replace(time=self._next(), **change)
        self._merge(SystemState(motion=motion))

    def request(self, word: str, obstacle: str = '') -> tuple[bool, str]:
        """Execute a word of `REQUESTS`; return whether it is executed, and a line for the user."""
        stopped = self.reason
        if word == STOP:
            self.stop('requested by a user')
            return True, 'stopped; ~/clear_stop releases'
        if word == CLEAR_STOP and not stopped:
            return True, 'there was no stop'
        if word != CLEAR_STOP and stopped:
            obstacle = f'{STOPPED}{stopped}; ~/clear_stop releases'
        if obstacle:
            return False, f'{word} refused: {obstacle}'
        if word == CLEAR_STOP:
            self.clear()
            return True, 'cleared; nothing moves until the next request'
        if word == RETRACT:
            self._change(retracts=True, paused=False)
            return True, 'retracting'
        self._change(paused=word == PAUSE)
        return True, 'paused' if word == PAUSE else 'resumed'
