"""Which commanded force acts on the needle, from one sample of the plant to the next."""

from __future__ import annotations

from math import exp, inf
from typing import NamedTuple

from needle_ros.contract import BASE
from needle_ros.timing import apart, NANOSECONDS


class Command(NamedTuple):
    """
    Forces on the needle.

    Attributes
    ----------
    stamp : int
        Time from which they count [ns].
    force : float
        Insertion force [N], positive into the tissue.
    torque : float
        Torque about the insertion axis [N m].

    """

    stamp: int = 0
    force: float = 0.0
    torque: float = 0.0


class Commands:
    """
    Decides from when, and how long, a command acts.

    The command that is newest when a sample is taken acts until the next sample: a zero-order
    hold. A command counts if its stamp is within the timeout of now and not older than that of
    the newest. It stands for no force if it is invalid, when it is older than the timeout, while
    several nodes command, and while commands have put in too much energy. A force may end at
    once, but grows no faster than it may.

    Nothing else tells who sent a command: one whose stamp is that of a sample answers it. After
    such an answer a force under another stamp is of another node, however short that lives, and
    is refused until the number of nodes changes.

    Parameters
    ----------
    timeout : float
        Age at which a command no longer counts [s].
    force_limit : float
        Largest valid force [N], either sign.
    torque_limit : float
        Largest valid torque [N m], either sign.
    interval : float, optional
        Time from one sample to the next [s].
    force_rate_limit : float, optional
        Fastest growth of the force, either sign [N/s].
    power_limit : float, optional
        Energy that may be put in within a second [W].

    Attributes
    ----------
    held : Command
        The command that acts until the next sample.
    newest : Command
        The command that will act from the next sample on, if it is not too old by then.
    refused : int
        Number of invalid commands.
    stale : int
        Number of commands that were too old, or too far in the future.
    overtaken : int
        Number of commands that came after a newer one.
    rivals : int
        Number of nodes that command beyond the one that may.
    exhausted : bool
        Whether commands have put in more energy than they may; they act again at half of it.

    """

    def __init__(
        self,
        timeout: float,
        force_limit: float,
        torque_limit: float,
        *,
        interval: float = 1e-3,
        force_rate_limit: float = inf,
        power_limit: float = inf,
    ) -> None:
        self._timeout = timeout * NANOSECONDS
        self._limits = force_limit, torque_limit
        #: Most that a force may grow from one sample to the next [N].
        self._growth = force_rate_limit * interval
        #: Most energy [J], and what is left of it after a sample; a second is its time constant.
        self._most_energy, self._left = power_limit, exp(-interval)
        self.refused = self.stale = self.overtaken = 0
        self.begin()

    def begin(self) -> None:
        """Forget the commands and who gave them, as at an activation."""
        self.held = self.newest = Command()
        self.rivals = self._number = 0
        self._quiet = 0
        #: Stamps of the samples that a command may answer, and whether commands do.
        self._samples: dict[int, None] = {}
        self._answers = False
        self.exhausted = False
        #: Energy put in, less what is long ago [J].
        self._energy = 0.0

    def forget(self) -> None:
        """Let no force act; commands older than the newest still do not count."""
        self.held = self.newest = Command(self.newest.stamp)

    def offer(
        self, stamp: int, frame: str, force: float, torque: float, now: int
    ) -> tuple[bool, str]:
        """
        Take in a command.

        Parameters
        ----------
        stamp : int
            Its stamp [ns]; 0 stands for now.
        frame : str
            Its frame.
        force : float
            Insertion force [N].
        torque : float
            Torque [N m].
        now : int
            Simulated time [ns].

        Returns
        -------
        counts : bool
            Whether it counts; an invalid command counts as no force.
        complaint : str
            What is wrong with it, '' for nothing.

        """
        answers = stamp in self._samples
        stamp = stamp or now
        age = now - stamp
        if abs(age) > self._timeout:
            self.stale += 1
            return False, (
                f'command ignored, its stamp is {apart(age)}: command_timeout is '
                f'{self._timeout / NANOSECONDS:g} s'
            )
        if self._answers and not answers and (force or torque):
            self.refused += 1
            return False, (
                'command ignored, its stamp is that of no sample: it is not from the node that '
                'answers them'
            )
        self._answers |= answers
        # A newest one from the future is of the time before the clock was set back.
        if stamp < self.newest.stamp <= now + self._timeout:
            self.overtaken += 1
            return False, ''
        complaint = self._complaint(frame, force, torque)
        if complaint:
            self.refused += 1
        # While several nodes command none of them may; then what they said must be over.
        acts = not complaint and self.may_move(now)
        self.newest = Command(stamp, force, torque) if acts else Command(stamp)
        return True, complaint

    def _complaint(self, frame: str, force: float, torque: float) -> str:
        """Return what is wrong with a command."""
        if frame not in ('', BASE):
            return f'a command must be in {BASE}, got {frame!r}; no force is applied'
        largest, strongest = self._limits
        # Written so that NaN is refused too.
        if not (abs(force) <= largest and abs(torque) <= strongest):
            return (
                f'a command must be within force_limit, {largest:g} N, and torque_limit, '
                f'{strongest:g} N m, got {force} N and {torque} N m; no force is applied'
            )
        return ''

    def refuse(self) -> None:
        """Count a command that is invalid but for its force, which then does not act either."""
        self.refused += 1
        self.newest = Command(self.newest.stamp)

    def may_move(self, now: int) -> bool:
        """
        Tell whether what a command asks for may happen: who commands is alone.

        Parameters
        ----------
        now : int
            Simulated time [ns].

        Returns
        -------
        bool
            Whether nobody else commands, and nobody has come and gone within the timeout.

        """
        return not self.rivals and now >= self._quiet

    def hush(self, now: int) -> None:
        """
        Let no command act for the timeout: one of a node that has come and gone may be among them.

        Parameters
        ----------
        now : int
            Simulated time [ns].

        """
        self._quiet = now + round(self._timeout)
        self._answers = False
        self.newest = Command(self.newest.stamp)

    def count_commanders(self, number: int) -> bool:
        """
        Take note of how many nodes publish commands.

        Parameters
        ----------
        number : int
            Their number.

        Returns
        -------
        bool
            Whether it has changed from one to several or back; then no force acts until the next
            command.

        """
        rivals = max(0, number - 1)
        if number != self._number:
            self._number, self._answers = number, False
        if rivals == self.rivals:
            return False
        self.rivals = rivals
        self.newest = Command(self.newest.stamp)
        return True

    def hold(self, stamp: int, distance: float = 0.0) -> None:
        """
        Let the newest command act until the next sample, unless it is too old.

        Parameters
        ----------
        stamp : int
            Time of the sample that was just taken [ns].
        distance : float, optional
            How far the needle has moved under the command that was held [m].

        """
        samples, before, newest = self._samples, self.held.force, self.newest
        samples[stamp] = None
        while (first := next(iter(samples))) < stamp - self._timeout or first > stamp:
            del samples[first]
        self._energy = self._left * self._energy + max(0.0, before * distance)
        self.exhausted = self._energy > (0.5 if self.exhausted else 1.0) * self._most_energy
        if self.exhausted or stamp - newest.stamp > self._timeout:
            self.held = Command(newest.stamp)
            return
        growth = self._growth
        force = min(max(newest.force, min(before, 0.0) - growth), max(before, 0.0) + growth)
        self.held = newest if force == newest.force else newest._replace(force=force)
