"""Times as integers of nanoseconds, as stamps have them, and how often something happens."""

from __future__ import annotations

from typing import Any, Final

NANOSECONDS: Final = 1_000_000_000


def nanoseconds(time: Any) -> int:
    """Return a time or duration with ``sec`` and ``nanosec``, as messages have it [ns]."""
    return int(time.sec) * NANOSECONDS + int(time.nanosec)


def seconds(time: Any) -> float:
    """Return a time or duration with ``sec`` and ``nanosec``, as messages have it [s]."""
    return float(time.sec + time.nanosec / NANOSECONDS)


class Window:
    """How many per second, and which share of them was marked, over the last full second."""

    def __init__(self) -> None:
        self._start: int | None = None
        self._count = self._marked = 0
        self._rate = self._share = 0.0

    def add(self, now: int, marked: bool = False) -> None:
        """Count one at a time [ns]."""
        self._roll(now)
        self._count += 1
        self._marked += marked

    def _roll(self, now: int) -> None:
        elapsed = now - self._start if self._start is not None else -1
        if 0 <= elapsed < NANOSECONDS:
            return
        if elapsed > 0:
            self._rate = self._count * NANOSECONDS / elapsed
            self._share = self._marked / self._count if self._count else 0.0
        self._start, self._count, self._marked = now, 0, 0

    def rate(self, now: int) -> float:
        """Return the rate [Hz] of the last full second before a time [ns]."""
        self._roll(now)
        return self._rate

    def share(self, now: int) -> float:
        """Return the marked part of the last full second before a time [ns]."""
        self._roll(now)
        return self._share
