# SPDX-License-Identifier: Apache-2.0
"""Time stamps in integer nanoseconds, and event rates."""

import sys
from typing import Any, Final

NANOSECONDS: Final = 1_000_000_000

#: Larger differences indicate stamps of different clocks, such as simulated and system time [ns].
_DAYS: Final = 10 * 24 * 3600 * NANOSECONDS


def nanoseconds(time: Any) -> int:
    """Convert a builtin_interfaces Time or Duration to ns."""
    return int(time.sec) * NANOSECONDS + int(time.nanosec)


def set_time(time: Any, ns: int) -> None:
    """Set a builtin_interfaces Time or Duration [ns], as `nanoseconds` reads it."""
    time.sec, time.nanosec = divmod(ns, NANOSECONDS)


def seconds(time: Any) -> float:
    """Convert a builtin_interfaces Time or Duration to s."""
    return float(time.sec + time.nanosec / NANOSECONDS)


def parse_nanoseconds(text: str) -> int | None:
    """Parse a time [ns] of at most 19 decimal digits, as of 64 bits; None if it is invalid."""
    valid = len(text) <= 19 and text.isascii() and text.isdecimal()
    return int(text) if valid else None


def apart(age: int) -> str:
    """Describe the age of a stamp [ns]; a difference of days is reported as a different clock."""
    if abs(age) > _DAYS:
        return 'of another clock: use_sim_time must be alike in all nodes, with a /clock if true'
    return f'{abs(age) / NANOSECONDS:.3f} s {"old" if age > 0 else "ahead"}'


class RateCounter:
    """Rate of events over the last full second, and fraction of marked events."""

    def __init__(self) -> None:
        self._start = sys.maxsize  #: Begin of the counted second [ns]; no event before it.
        self._count = self._marked = 0
        self._rate = self._share = 0.0

    def add(self, now: int, marked: bool = False) -> None:
        """Count an event at time `now` [ns]."""
        if not 0 <= now - self._start < NANOSECONDS:
            self._roll(now)
        self._count += 1
        self._marked += marked

    def _roll(self, now: int) -> None:
        elapsed = now - self._start
        if 0 <= elapsed < NANOSECONDS:
            return
        if elapsed > 0:
            self._rate = self._count * NANOSECONDS / elapsed
            self._share = self._marked / self._count if self._count else 0.0
        self._start, self._count, self._marked = now, 0, 0

    def rate(self, now: int) -> float:
        """Return the event rate in the last full second [Hz]."""
        self._roll(now)
        return self._rate

    def share(self, now: int) -> float:
        """Return the fraction of marked events in the last full second."""
        self._roll(now)
        return self._share
