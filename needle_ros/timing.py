"""Time stamps as integers of nanoseconds, and rates."""

from __future__ import annotations

from typing import Any, Final

NANOSECONDS: Final = 1_000_000_000

#: Two clocks of this machine are farther apart, two of the same kind are not [ns].
_DAYS: Final = 10 * 24 * 3600 * NANOSECONDS


def nanoseconds(time: Any) -> int:
    """
    Convert a time or a duration of a message.

    Parameters
    ----------
    time : builtin_interfaces Time or Duration
        Whatever has ``sec`` and ``nanosec``.

    Returns
    -------
    int
        Time [ns].

    """
    return int(time.sec) * NANOSECONDS + int(time.nanosec)


def seconds(time: Any) -> float:
    """
    Convert a time or a duration of a message.

    Parameters
    ----------
    time : builtin_interfaces Time or Duration
        Whatever has ``sec`` and ``nanosec``.

    Returns
    -------
    float
        Time [s].

    """
    return float(time.sec + time.nanosec / NANOSECONDS)


def apart(age: int) -> str:
    """
    Say how far a stamp is from now.

    Parameters
    ----------
    age : int
        Now minus the stamp [ns].

    Returns
    -------
    str
        Its age; or that it is of another clock, if it is off by days.

    """
    if abs(age) > _DAYS:
        return 'of another clock: use_sim_time must be alike in all nodes, with a /clock if true'
    return f'{abs(age) / NANOSECONDS:.3f} s {"old" if age > 0 else "ahead"}'


class RateCounter:
    """Counts events by the second: how many there were, and which share of them was marked."""

    def __init__(self) -> None:
        self._start: int | None = None
        self._count = self._marked = 0
        self._rate = self._share = 0.0

    def add(self, now: int, marked: bool = False) -> None:
        """
        Count an event.

        Parameters
        ----------
        now : int
            Its time [ns].
        marked : bool
            Whether it is marked.

        """
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
        """
        Return the rate in the last full second.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        float
            Events per second [Hz].

        """
        self._roll(now)
        return self._rate

    def share(self, now: int) -> float:
        """
        Return which share of the events was marked in the last full second.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        float
            Share, from 0 to 1.

        """
        self._roll(now)
        return self._share
