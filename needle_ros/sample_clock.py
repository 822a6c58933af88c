# SPDX-License-Identifier: Apache-2.0
"""Schedule of simulation samples, on a clock that may differ from simulated time."""

from math import ceil
from typing import Final

from needle_ros.errors import JobError
from needle_ros.timing import NANOSECONDS

_TICK: Final = 1e-3  #: Maximum tick period, and so the maximum delay of a sample [s].
_AT_ONCE: Final = 20  #: Samples per tick at maximum speed.

#: Maximum lead of an independent time over a recorder, by lockstep [samples]: the pending messages
#: fit into the queues of the recorder, in lockstep together with the messages of other nodes.
_AHEAD: Final = {True: 10, False: 80}

#: Placeholder for the commanding node among the names of nodes that have answered a sample.
COMMAND: Final = ''


class SampleClock:
    """
    Simulated time with samples at exact multiples of the period.

    `rate` is in Hz of simulated time, `factor` in simulated seconds per second of the clock (0: as
    fast as possible). `own` makes simulated time independent of the clock; it always is in
    lockstep, and if the factor is not 1. In lockstep each sample waits for the responses to the
    sample before, and time starts at zero. After a stall, samples are taken later, up to `backlog`
    [s]; beyond it an independent time waits, and other samples are dropped.
    """

    def __init__(
        self, rate: float, factor: float, backlog: float, *, own: bool, lockstep: bool
    ) -> None:
        self._rate, self._factor = rate, factor
        self._own, self._lockstep = own or lockstep or factor != 1.0, lockstep
        self._backlog = max(1, int(backlog * rate * factor))
        self.participants = 0  #: Number of nodes that report processed samples in lockstep.
        self.recorded: dict[str, int] = {}  #: Stamp of the newest sample of each recorder [ns].
        #: Period of the schedule [s]; with several samples per tick it need not exceed real time.
        self.tick = max(1.0 / (rate * factor), min(1.0 / rate, _TICK)) if factor else _TICK
        #: Maximum samples per tick if time may wait: more would overflow the subscribers.
        self._burst = ceil(2.0 * rate * factor * self.tick) if factor else _AT_ONCE
        self.begin(0)

    def begin(self, now: int, *, paused: bool = False) -> None:
        """Start simulated time, optionally paused; `now` is the time of the clock [ns]."""
        self.paused = paused
        #: Number of dropped samples, and delay of simulated time by an overloaded machine [ns].
        self.lost = self.waited = 0
        #: Nodes that have answered the newest sample in lockstep; None if no answer is needed.
        self._answers: set[str] | None = None
        self._start = 0 if self._lockstep else now
        self._anchor(now)

    def _anchor(self, now: int) -> None:
        """Restart the sample count at the time `now` of the clock [ns]."""
        #: Time of the clock at the start of simulated time [ns], and number of samples since.
        self._clock, self._count = now, 0
        #: Simulated time of the newest sample [ns].
        self.stamp = self._start

    @property
    def commanded(self) -> bool:
        """Whether a command has answered the newest sample, or no command is needed."""
        return self._answers is None or COMMAND in self._answers

    @property
    def awaited(self) -> int | None:
        """Stamp of the sample that waits for responses [ns]; None if no sample waits."""
        answers = self._answers
        answered = answers is None or (self.commanded and len(answers) > self.participants)
        return None if answered and self._is_recorded else self.stamp

    def record(self, by: str, stamp: int) -> bool:
        """Set the newest sample of a recorder [ns], 0 at its end; return if it comes or ends."""
        # A new recorder need not have the samples before it.
        before = self.recorded.pop(by, 0)
        if stamp:
            self.recorded[by] = max(stamp, before or self.stamp)
        return (before > 0) != (stamp > 0)

    @property
    def _is_recorded(self) -> bool:
        """Whether all recorders are close enough to the newest sample."""
        ahead = round(_AHEAD[self._lockstep] * NANOSECONDS / self._rate)
        first = max(self._start, self.stamp - ahead)
        return all(max(stamp, self._start) >= first for stamp in self.recorded.values())

    @property
    def missing(self) -> str:
        """Missing responses to the newest sample, as a phrase for messages."""
        if not self.commanded:
            return 'no command has answered'
        if not self._is_recorded:
            return f'a recorder is {_AHEAD[self._lockstep]} samples behind'
        done = len(self._answers or ()) - 1
        return f'{done} of {self.participants} nodes have processed'

    def simulated(self, now: int) -> int:
        """Return the simulated time at a time of the clock [ns]."""
        if self.paused or not self._factor or self._lockstep:
            return self.stamp
        return self._start + round((now - self._clock) * self._factor)

    def due(self, now: int) -> int:
        """Return the number of samples to take at a time of the clock [ns]."""
        if self.paused or self.awaited is not None:
            return 0
        if not self._factor:
            return 1 if self._lockstep else self._burst
        rate = self._rate * self._factor
        due = int((now - self._clock) * rate / NANOSECONDS) - self._count
        if self._clock == 0 or due < 0:
            # A simulated clock has started, or the clock was set back.
            self._start = self.stamp if self._own and self._clock else now
            self._anchor(now)
            return 0
        beyond = due - self._backlog
        if beyond > 0:
            late = round(beyond / rate * NANOSECONDS)
            self._clock += late
            due -= beyond
            if self._own:
                self.waited += late
            else:
                self.lost += beyond
                self._start += late
        if self._lockstep:
            # After a stall, each sample follows the responses to the sample before at once.
            return min(due, 1)
        return min(due, self._burst) if self._own else due

    def take(self) -> int:
        """Count a sample and return its stamp [ns]."""
        self._count += 1
        self.stamp = self._start + round(self._count / self._rate * NANOSECONDS)
        self._answers = set() if self._lockstep else None
        return self.stamp

    def answered(self, stamp: int, by: str = COMMAND) -> None:
        """Record a response to the sample `stamp` [ns]: a command, or the name of a node."""
        if self._answers is not None and stamp == self.stamp:
            self._answers.add(by)

    def pause(self) -> None:
        self.paused = True

    def resume(self, now: int) -> None:
        """Resume time after a pause; `now` is the time of the clock [ns]."""
        if self.paused:
            self.paused = False
            self._go_on(now)

    def step(self, now: int) -> int:
        """Take one sample in paused time, if no sample waits; return its stamp [ns]."""
        if not self.paused:
            raise JobError('time is not paused; pause first')
        if self.awaited is not None:
            raise JobError(f'{self.missing} the sample of {self.awaited / NANOSECONDS:.6f} s')
        self._go_on(now)
        return self.take()

    def _go_on(self, now: int) -> None:
        """Resume at the newest sample, or at the time of the clock if time is not independent."""
        # The stamp of a step is one period later.
        period = round(NANOSECONDS / self._rate)
        self._start = self.stamp if self._own else max(self.stamp, now - period)
        self._anchor(now)
