"""Whether answers come as late as the delay that the laws are made for."""

from __future__ import annotations

from typing import Final

from needle_ros.timing import RateCounter

#: Share of answers that may be later, and how many per second in any case [Hz].
_BORNE: Final = 0.05
_FEW: Final = 3.0


class Lateness:
    """
    Counts the answers that come later than the laws take them to.

    Parameters
    ----------
    delay : int
        Periods from a measurement to the effect of its answer that the laws count on.
    period : float
        Period [s].

    """

    def __init__(self, delay: int = 0, period: float = 1.0) -> None:
        self._delay, self._longest = delay, (delay + 1) * period
        self._answered = self._late = 0
        self._oldest = 0.0
        self._window = RateCounter()

    def add(self, now: int, age: float) -> None:
        """
        Take in an answer.

        Parameters
        ----------
        now : int
            Time [ns].
        age : float
            Age of the measurement that it answers [s].

        """
        late = age > self._longest
        self._answered += 1
        self._late += late
        self._oldest = max(self._oldest, age)
        self._window.add(now, late)

    def warning(self, now: int) -> str | None:
        """
        Return which share of the answers of the last second was late, if it was too large.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        str or None
            The share; None if all is well.

        """
        share = self._window.share(now)
        if share <= _BORNE or share * self._window.rate(now) < _FEW:
            return None
        return (
            f'{share:.0%} of the answers come too late for delay {self._delay}: raise it, lower '
            'the rate, or free the machine'
        )

    def describe(self) -> dict[str, object]:
        """Return what diagnostics say of it."""
        return {
            'measurements answered': self._answered,
            'answered too late for the delay': self._late,
            'oldest measurement answered [s]': f'{self._oldest:.4f}',
        }
