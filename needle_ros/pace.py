"""When samples of a simulation are due: beside a clock, paused, stepped, waiting for answers."""

from __future__ import annotations

from math import ceil
from typing import Final

from needle_ros.errors import (
    JobError,
)
from needle_ros.timing import NANOSECONDS

#: Time between looks that is short enough for whoever listens [s].
_TICK: Final = 1e-3

#: Samples at a tick when there is no pace to keep.
_AT_ONCE: Final = 20


class Pace:
    """
    Simulated time, in samples at exact multiples of the period, beside the time of a clock.

    Samples that a stall left out are made up, as far back as the backlog. Farther back a time of
    its own waits, while the time of the clock goes on and the samples are given up.

    Parameters
    ----------
    rate : float
        Samples per second of simulated time [Hz].
    factor : float
        Simulated seconds per second of the clock; 0: as fast as possible.
    backlog : float
        Delay that is made up after a stall [s].
    own : bool
        Whether simulated time is a time of its own, which may wait, and not that of the clock.
    lockstep : bool
        Whether each sample waits for the answer to the one before it; time then begins at zero.

    Attributes
    ----------
    stamp : int
        Simulated time of the newest sample [ns].
    paused : bool
        Whether time stands still.
    lost : int
        Samples given up.
    waited : int
        Time that simulated time waited for the machine [ns].

    """

    def __init__(
        self, rate: float, factor: float, backlog: float, *, own: bool, lockstep: bool
    ) -> None:
        self._rate, self._factor = rate, factor
        self._own, self._lockstep = own or lockstep or factor != 1.0, lockstep
        self._backlog = max(1, int(backlog * rate * factor))
        # Several samples at a tick are well: no more ticks than in real time are needed.
        self.tick = max(1.0 / (rate * factor), min(1.0 / rate, _TICK)) if factor else _TICK
        #: Most samples at one tick when time may wait: a burst would overrun readers.
        self._burst = ceil(2.0 * rate * factor * self.tick) if factor else _AT_ONCE
        self.begin(0)

    def begin(self, now: int, *, paused: bool = False) -> None:
        """Let time begin at the clock's now [ns]."""
        self.paused = paused
        self.lost = self.waited = 0
        self._awaited: int | None = None
        self._start = 0 if self._lockstep else now
        self._anchor(now)

    def _anchor(self, now: int) -> None:
        """Let the samples to come count from here."""
        #: Clock and simulated time that belong together, and samples since [ns].
        self._clock, self._count = now, 0
        self.stamp = self._start

    def simulated(self, now: int) -> int:
        """Return the simulated time at the clock's now [ns]."""
        if self.paused or not self._factor or self._lockstep:
            return self.stamp
        return self._start + round((now - self._clock) * self._factor)

    def due(self, now: int) -> int:
        """Return how many samples to take at the clock's now [ns]."""
        if self.paused or self._awaited is not None:
            return 0
        if not self._factor:
            return 1 if self._lockstep else self._burst
        rate = self._rate * self._factor
        due = int((now - self._clock) * rate / NANOSECONDS) - self._count
        if self._clock == 0 or due < 0:
            # The first time of a simulated clock has come, or the clock was set back.
            self._start = self.stamp if self._own and self._clock else now
            self._anchor(now)
            return 0
        beyond = due - (1 if self._lockstep else self._backlog)
        if beyond > 0:
            late = round(beyond / rate * NANOSECONDS)
            self._clock += late
            due -= beyond
            if self._own:
                self.waited += late
            else:
                self.lost += beyond
                self._start += late
        return min(due, self._burst) if self._own else due

    def take(self) -> int:
        """Count a sample and return its stamp [ns]."""
        self._count += 1
        self.stamp = self._start + round(self._count / self._rate * NANOSECONDS)
        self._awaited = self.stamp if self._lockstep else None
        return self.stamp

    @property
    def awaited(self) -> int | None:
        """Stamp whose answer the next sample waits for [ns], None if it waits for none."""
        return self._awaited

    def answered(self, stamp: int) -> None:
        """Take note of an answer to the sample of this stamp [ns]."""
        if stamp == self._awaited:
            self._awaited = None

    def pause(self) -> None:
        """Let time stand still."""
        self.paused = True

    def resume(self, now: int) -> None:
        """Let time go on from here; that of the clock has gone on meanwhile [ns]."""
        if self.paused:
            self.paused = False
            self._go_on(now)

    def step(self, now: int) -> int:
        """
        Take one sample while time stands still; return its stamp [ns].

        Raises
        ------
        JobError
            If time does not stand still, or the sample before still waits for its answer.

        """
        if not self.paused:
            raise JobError('time goes on; pause first')
        if self._awaited is not None:
            raise JobError(
                f'no command has answered the sample of {self._awaited / NANOSECONDS:.6f} s'
            )
        self._go_on(now)
        return self.take()

    def _go_on(self, now: int) -> None:
        """Begin anew after a pause: a time of its own where it stood, else at the clock's."""
        # A step's stamp is one period after this.
        period = round(NANOSECONDS / self._rate)
        self._start = self.stamp if self._own else max(self.stamp, now - period)
        self._anchor(now)
