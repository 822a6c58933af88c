"""Whether measurements come at the rate that the laws are made for."""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import Final

from needle_ros.timing import NANOSECONDS

#: Steps that are compared, and how many it takes: a second of them.
_MOST: Final = 40
_FEWEST: Final = 20

#: How far a period may be off, and which share of the periods must be for a word.
_BORNE: Final = 0.2
_SHARE: Final = 0.9


class Pace:
    """
    Compares the time between two measurements, by their stamps, with the period.

    It looks at some of them only, so that it costs nothing per measurement. Lost measurements and
    jitter make some steps longer and others shorter; another rate makes nearly all of them so.

    Parameters
    ----------
    rate : float
        Rate that the laws are made for [Hz].
    longest : float
        Time between two measurements that is a gap [s].

    """

    def __init__(self, rate: float, longest: float) -> None:
        self._rate = rate
        self._longest = round(longest * NANOSECONDS)
        self._steps: deque[float] = deque(maxlen=_MOST)
        self._seen = -1

    def add(self, stamp: int, step: int) -> None:
        """
        Look at the newest measurement, some times per second.

        Parameters
        ----------
        stamp : int
            Its stamp [ns].
        step : int
            How much later it is than the one before [ns].

        """
        if stamp != self._seen and 0 < step <= self._longest:
            self._steps.append(step * self._rate / NANOSECONDS)
        self._seen = stamp

    def warning(self) -> str | None:
        """
        Return at which rate measurements come, if that is another one.

        Returns
        -------
        str or None
            Both rates and what to set; None if all is well, or as long as too few are known.

        """
        steps = self._steps
        if len(steps) < _FEWEST:
            return None
        enough = _SHARE * len(steps)
        slow = sum(step > 1.0 + _BORNE for step in steps) >= enough
        fast = sum(step < 1.0 / (1.0 + _BORNE) for step in steps) >= enough
        if not slow and not fast:
            return None
        found = self._rate / median(steps)
        return (
            f'joint_states comes at {found:.4g} Hz, rate is {self._rate:g} Hz: set rate to '
            f'{found:.3g}, or the robot to {self._rate:g} Hz'
        )
