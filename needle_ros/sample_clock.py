"""When the samples of a simulation are due, by a clock that may differ from simulated time."""

from __future__ import annotations

from math import ceil
from typing import Final

from needle_ros.errors import JobError
from needle_ros.timing import NANOSECONDS

#: Longest time between ticks, and so between a sample and its time [s].
_TICK: Final = 1e-3

#: Samples at a tick when time goes as fast as possible.
_AT_ONCE: Final = 20


#: Most samples that a time of its own is ahead of a recorder, in lockstep and else: what waits for
#: the recorder fits into its queues, in lockstep with the messages of others.
_AHEAD: Final = {True: 10, False: 80}

#: Stands for whoever commands, among the names of the nodes that have answered a sample.
COMMAND: Final = ''


class SampleClock:
    """
    Simulated time, which has samples at exact multiples of the period.

    Samples missed in a stall are taken afterwards, as far back as the backlog. What lies further
    back is given up where simulated time is the time of the clock; a simulated time of its own
    waits instead.

    Parameters
    ----------
    rate : float
        Samples per second of simulated time [Hz].
    factor : float
        Simulated seconds per second of the clock; 0: as fast as possible.
    backlog : float
        Delay that is made up after a stall [s].
    own : bool
        Whether simulated time is a time of its own, which may wait, and not that of the clock;
        so it is in any case if the factor is not 1, and in lockstep.
    lockstep : bool
        Whether each sample waits for the answers to the one before it; time then begins at zero.

    Attributes
    ----------
    tick : float
        Time between two looks at what is due [s].
    stamp : int
        Simulated time of the newest sample [ns].
    paused : bool
        Whether time stands still.
    lost : int
        Number of samples given up.
    waited : int
        Time that simulated time waited for the machine [ns].
    participants : int
        Number of nodes that report in lockstep when they have processed a sample: the next one
        waits for all of them, and for a command.
    recorded : dict of str to int
        Stamp of the newest sample of each recorder, by its name [ns]: a time of its own is never
        more than 80 samples ahead of that, in lockstep 10.

    """

    def __init__(
        self, rate: float, factor: float, backlog: float, *, own: bool, lockstep: bool
    ) -> None:
        self._rate, self._factor = rate, factor
        self._own, self._lockstep = own or lockstep or factor != 1.0, lockstep
        self._backlog = max(1, int(backlog * rate * factor))
        self.participants = 0
        self.recorded: dict[str, int] = {}
        # Several samples at a tick are fine: no more ticks than in real time are needed.
        self.tick = max(1.0 / (rate * factor), min(1.0 / rate, _TICK)) if factor else _TICK
        #: Most samples at one tick when time may wait: more would overrun the readers.
        self._burst = ceil(2.0 * rate * factor * self.tick) if factor else _AT_ONCE
        self.begin(0)

    def begin(self, now: int, *, paused: bool = False) -> None:
        """
        Let time begin.

        Parameters
        ----------
        now : int
            Time of the clock [ns].
        paused : bool
            Whether it begins paused.

        """
        self.paused = paused
        self.lost = self.waited = 0
        #: Which nodes have answered the newest sample in lockstep; None if it needs no answer.
        self._answers: set[str] | None = None
        self._start = 0 if self._lockstep else now
        self._anchor(now)

    def _anchor(self, now: int) -> None:
        """Count the samples to come from here."""
        #: Time of the clock at which simulated time was the start [ns], and samples since.
        self._clock, self._count = now, 0
        self.stamp = self._start

    @property
    def commanded(self) -> bool:
        """Whether a command has answered the newest sample, or none has to."""
        return self._answers is None or COMMAND in self._answers

    @property
    def awaited(self) -> int | None:
        """Stamp of the sample whose answers the next one waits for [ns]; None if for none."""
        if self._answers is None:
            return None
        answered = self.commanded and len(self._answers) > self.participants
        return None if answered and self._is_recorded else self.stamp

    @property
    def _is_recorded(self) -> bool:
        """Whether all recorders have samples that are new enough."""
        ahead = round(_AHEAD[self._lockstep] * NANOSECONDS / self._rate)
        first = max(self._start, self.stamp - ahead)
        return all(max(stamp, self._start) >= first for stamp in self.recorded.values())

    @property
    def missing(self) -> str:
        """Which answers to the newest sample are missing, for people."""
        if not self.commanded:
            return 'no command has answered'
        if not self._is_recorded:
            return f'a recorder is {_AHEAD[True]} samples behind'
        done = len(self._answers or ()) - 1
        return f'{done} of {self.participants} nodes have processed'

    def simulated(self, now: int) -> int:
        """
        Return the simulated time.

        Parameters
        ----------
        now : int
            Time of the clock [ns].

        Returns
        -------
        int
            Simulated time [ns].

        """
        if self.paused or not self._factor or self._lockstep:
            return self.stamp
        return self._start + round((now - self._clock) * self._factor)

    def due(self, now: int) -> int:
        """
        Return how many samples are due.

        Parameters
        ----------
        now : int
            Time of the clock [ns].

        Returns
        -------
        int
            Number of samples to take now.

        """
        if self.paused or self.awaited is not None or not self._is_recorded:
            return 0
        if not self._factor:
            return 1 if self._lockstep else self._burst
        rate = self._rate * self._factor
        due = int((now - self._clock) * rate / NANOSECONDS) - self._count
        if self._clock == 0 or due < 0:
            # A clock that is itself simulated begins, or the clock was set back.
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
            # After a stall the others follow at once, each after the answers to the one before.
            return min(due, 1)
        return min(due, self._burst) if self._own else due

    def take(self) -> int:
        """
        Count a sample.

        Returns
        -------
        int
            Its stamp [ns].

        """
        self._count += 1
        self.stamp = self._start + round(self._count / self._rate * NANOSECONDS)
        self._answers = set() if self._lockstep else None
        return self.stamp

    def answered(self, stamp: int, by: str = COMMAND) -> None:
        """
        Take note of an answer.

        Parameters
        ----------
        stamp : int
            Stamp of the sample that was answered [ns].
        by : str
            Name of the node that has processed it; by default it is answered by a command.

        """
        if self._answers is not None and stamp == self.stamp:
            self._answers.add(by)

    def pause(self) -> None:
        """Pause time."""
        self.paused = True

    def resume(self, now: int) -> None:
        """
        Let time go on after a pause.

        Parameters
        ----------
        now : int
            Time of the clock [ns], which has gone on meanwhile.

        """
        if self.paused:
            self.paused = False
            self._go_on(now)

    def step(self, now: int) -> int:
        """
        Take one sample while time is paused.

        Parameters
        ----------
        now : int
            Time of the clock [ns].

        Returns
        -------
        int
            Stamp of the sample [ns].

        Raises
        ------
        JobError
            If time is not paused, or the sample before waits for its answer.

        """
        if not self.paused:
            raise JobError('time is not paused; pause first')
        if self.awaited is not None:
            raise JobError(f'{self.missing} the sample of {self.awaited / NANOSECONDS:.6f} s')
        self._go_on(now)
        return self.take()

    def _go_on(self, now: int) -> None:
        """Begin again after a pause: where it was, or at the clock's now if that is its time."""
        # A step's stamp is one period after this.
        period = round(NANOSECONDS / self._rate)
        self._start = self.stamp if self._own else max(self.stamp, now - period)
        self._anchor(now)
