# SPDX-License-Identifier: Apache-2.0
"""Selection of the commanded force that acts on the needle from one sample to the next."""

from math import exp, inf
from typing import NamedTuple

from needle_ros.contract import BASE
from needle_ros.timing import apart, NANOSECONDS


class AppliedForces(NamedTuple):
    """Force command."""

    stamp: int = 0  #: time from which the command is valid [ns]
    force: float = 0.0  #: insertion force [N], positive into the tissue
    torque: float = 0.0  #: torque about the insertion axis [N m]


class Commands:
    """Zero-order hold of force commands with timeout, limits and detection of several sources."""

    # The newest command at a sample acts until the next sample. A command is accepted if its stamp
    # is within the timeout of the present time and not older than the newest stamp. It counts as
    # zero force if it is invalid, when it exceeds the timeout, while several nodes publish
    # commands, and while commands have supplied too much energy. A force may end at once, but its
    # growth rate is limited. Arguments are in s, N, N m, N/s and W; limits apply to either sign.

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
        #: Largest growth of the force from one sample to the next [N].
        self._growth = force_rate_limit * interval
        #: Largest energy [J], and its decay factor per sample with a time constant of 1 s.
        self._most_energy, self._left = power_limit, exp(-interval)
        #: Number of commands that were invalid, had a stamp outside the timeout, and arrived after
        #: a newer one (out of order).
        self.refused = self.stale = self.overtaken = 0
        self.stopped = False
        self.begin()

    def begin(self) -> None:
        """Discard all commands and their senders, as at an activation."""
        #: Command that acts until the next sample, and command that acts from then on, unless it
        #: exceeds the timeout by then.
        self.acting = self.newest = AppliedForces()
        #: Number of nodes that publish commands in addition to the first, and of all of them.
        self.duplicates = self._number = 0
        self._ignored_until = 0
        #: Stamps of the samples to which a command may respond, and whether commands do.
        self._samples: dict[int, None] = {}
        self._answers = False
        #: Whether commands have supplied more than the permitted energy; reset at half of it.
        self.exhausted = False
        #: Supplied energy with exponential decay [J].
        self._energy = 0.0

    def forget(self) -> None:
        """Reset the force to zero; commands older than the newest are still discarded."""
        self.acting = self.newest = AppliedForces(self.newest.stamp)

    def offer(
        self, stamp: int, frame: str, force: float, torque: float, now: int
    ) -> tuple[bool, str]:
        """Process a command; return whether it is accepted, and the error message or ''."""
        # ``stamp`` and ``now`` in ns (stamp 0: now). An invalid command is accepted as zero force.
        # The stamp is the only identification of the sender: a command with the stamp of a sample
        # responds to this sample. After such a response, a force with any other stamp is from
        # another node, however short its lifetime, and is rejected until their number changes.
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
                'command ignored, its stamp matches no sample: it is not from the node that '
                'answers samples'
            )
        self._answers |= answers
        # A newest stamp in the future dates from before the clock was set back.
        if stamp < self.newest.stamp <= now + self._timeout:
            self.overtaken += 1
            return False, ''
        error = self._error(frame, force, torque)
        if error:
            self.refused += 1
        # While several nodes publish commands no force acts, and their commands must expire.
        acts = not error and self.may_move(now)
        self.newest = AppliedForces(stamp, force, torque) if acts else AppliedForces(stamp)
        return True, error

    def _error(self, frame: str, force: float, torque: float) -> str:
        if frame not in ('', BASE):
            return f'a command must be in {BASE}, got {frame!r}; no force is applied'
        largest, strongest = self._limits
        # Written so that NaN is rejected too.
        if not (abs(force) <= largest and abs(torque) <= strongest):
            return (
                f'a command must be within force_limit, {largest:g} N, and torque_limit, '
                f'{strongest:g} N m, got {force} N and {torque} N m; no force is applied'
            )
        return ''

    def refuse(self) -> None:
        self.refused += 1
        self.newest = AppliedForces(self.newest.stamp)

    def may_move(self, now: int) -> bool:
        """Return whether commands may act at a time [ns], with a single sender."""
        return not (self.stopped or self.duplicates) and now >= self._ignored_until

    def stop(self) -> None:
        """End the force; no command acts while `stopped`."""
        self.stopped = True
        self.newest = AppliedForces(self.newest.stamp)

    def ignore(self, now: int) -> None:
        """Ignore commands for the timeout; a short-lived node may have sent some."""
        self._ignored_until = now + round(self._timeout)
        self._answers = False
        self.newest = AppliedForces(self.newest.stamp)

    def count_commanders(self, number: int) -> bool:
        """Update the number of publishers; return whether a conflict has begun or ended."""
        # Then no force acts until the next command.
        duplicates = max(0, number - 1)
        if number != self._number:
            self._number, self._answers = number, False
        if duplicates == self.duplicates:
            return False
        self.duplicates = duplicates
        self.newest = AppliedForces(self.newest.stamp)
        return True

    def hold(self, stamp: int, distance: float = 0.0) -> None:
        """Hold the newest command from a stamp [ns] on, unless it exceeds the timeout."""
        # ``distance`` is the displacement under the previous command [m], for the supplied energy.
        samples, before, newest = self._samples, self.acting.force, self.newest
        samples[stamp] = None
        while (first := next(iter(samples))) < stamp - self._timeout or first > stamp:
            del samples[first]
        self._energy = self._left * self._energy + max(0.0, before * distance)
        self.exhausted = self._energy > (0.5 if self.exhausted else 1.0) * self._most_energy
        if self.exhausted or stamp - newest.stamp > self._timeout:
            self.acting = AppliedForces(newest.stamp)
            return
        growth = self._growth
        force = min(max(newest.force, min(before, 0.0) - growth), max(before, 0.0) + growth)
        self.acting = newest if force == newest.force else newest._replace(force=force)
