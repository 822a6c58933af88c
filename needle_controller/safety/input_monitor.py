# SPDX-License-Identifier: Apache-2.0
"""Input monitor: check stamp, frame and values of messages, and displacements."""

from collections import Counter
from collections.abc import Sequence
from math import exp, isfinite
from operator import gt, sub
from typing import Final, NamedTuple

from needle_ros.status import InputStatus
from needle_ros.timing import apart, NANOSECONDS, RateCounter

#: Kind of accepted messages, and kinds of discarded messages that are harmless.
ACCEPTED: Final = 'accepted'
REPEATED: Final = 'repeated'
DROPPED: Final = 'dropped'

#: Changes above noise level after which a sensor is noisy, and identical readings are a fault.
_LIVELY: Final = 10

_ROUNDING: Final = 2  #: Stamps are rounded to nanoseconds [ns].

MEMORY: Final = 2.0  #: Time over which positions and velocities are compared [s].


class Refusal(NamedTuple):
    """Reason to discard a message: a kind for counters, and a line for the log."""

    kind: str
    line: str

    @property
    def harmless(self) -> bool:
        """Whether the message is only counted, and not reported."""
        return self.kind in (REPEATED, DROPPED)


class InputMonitor:
    """
    Check the messages of one topic; stamps and times are in ns.

    A message is stale from the age ``timeout`` on, or if its stamp leads by more than ``ahead``,
    by default the timeout [s]. ``frames`` are the valid frames, none: any. ``jumps`` are the
    implausible changes of each value between two messages. ``noise`` is the noise of each value: a
    noisy stream with constant values is ``frozen``; without noise, constant values are valid.

    ``last`` is the stamp of the newest message that was in time, -1 before the first, and ``step``
    the time since the message before. ``counted`` is the time at which the last valid message was
    received, ``counts`` the messages by result of the check, and ``refused`` why the newest one is
    not valid or missing. With several ``publishers`` no
    message is valid. ``window`` counts messages, and marks those out of order.
    """

    def __init__(
        self,
        name: str,
        timeout: float,
        *,
        frames: Sequence[str] = (),
        jumps: Sequence[float] = (),
        noise: Sequence[float] = (),
        ahead: float | None = None,
    ) -> None:
        self.name = name
        self.timeout = round(timeout * NANOSECONDS)
        self._ahead = self.timeout if ahead is None else round(ahead * NANOSECONDS) + _ROUNDING
        self.publishers = 1
        self._frames = frames
        self._jumps, self._lowest = jumps, [0.1 * one for one in noise]
        self.counts: Counter[str] = Counter()
        self.window = RateCounter()
        self.forget()

    def forget(self) -> None:
        """Discard all messages, except for the counts."""
        self.last = -1
        self.step = 0
        self.counted: int | None = None
        self._values: Sequence[float] | None = None
        self._lively, self._changed = 0, 0
        self.frozen, self.refused = False, ''

    def check(
        self, stamp: int, now: int, frame: str = '', values: Sequence[float] = ()
    ) -> Refusal | None:
        """Check stamp, frame and values, always as many; None for a valid message."""
        refusal = self._judge(stamp, now, frame, values)
        self.window.add(now, refusal is not None and refusal.kind == DROPPED)
        if refusal is None:
            self.counts[ACCEPTED] += 1
            self.counted, self.refused = now, ''
        else:
            if not refusal.harmless:
                self.refused = refusal.line
            self.counts[refusal.kind] += 1
        return refusal

    def _judge(self, stamp: int, now: int, frame: str, values: Sequence[float]) -> Refusal | None:
        if self.publishers > 1:
            return Refusal('disputed', f'{self.publishers} nodes publish {self.name}')
        age = now - stamp
        if not -self._ahead <= age <= self.timeout:
            if stamp == 0:
                return Refusal(
                    'not stamped', f'{self.name} is stale: it is not stamped (hardware.stamps)'
                )
            return Refusal('stale', f'{self.name} is stale: its stamp is {apart(age)}')
        if stamp == self.last:
            return Refusal(REPEATED, f'{self.name} received twice')
        if stamp < self.last:
            return Refusal(DROPPED, f'{self.name} received out of order')
        self.step, self.last = stamp - self.last, stamp
        if self._frames and frame not in self._frames:
            valid = ' or '.join(map(repr, self._frames))
            return Refusal('frame', f'{self.name} must be in frame {valid}, got {frame!r}')
        if not values:
            return None
        if not all(map(isfinite, values)):
            return Refusal('not finite', f'{self.name} must be finite, got {list(values)}')
        return self._judge_change(stamp, values)

    def _judge_change(self, stamp: int, values: Sequence[float]) -> Refusal | None:
        before, self._values = self._values, values
        if before is None or (not self._jumps and not self._lowest):
            self._changed = stamp
            return None
        steps = [*map(abs, map(sub, values, before))]
        if any(steps):
            noisy = any(map(gt, steps, self._lowest))
            self._lively = min(max(self._lively + (1 if noisy else -1), 0), _LIVELY)
            self._changed, self.frozen = stamp, False
        elif self._lively == _LIVELY and stamp - self._changed > self.timeout:
            self.frozen = True
            since = self.timeout / NANOSECONDS
            return Refusal('frozen', f'{self.name} has not changed for {since:g} s')
        if any(map(gt, steps, self._jumps)):
            step, jump = next(one for one in zip(steps, self._jumps, strict=False) if gt(*one))
            return Refusal('jump', f'{self.name} jumped by {step:.6g}, more than {jump:g}')
        return None

    def silence(self, now: int) -> float:
        """Return the time since the last valid message [s]; zero before the first."""
        return (now - self.counted) / NANOSECONDS if self.counted is not None else 0.0

    def stale(self, silence: float) -> str:
        """Describe a time without a valid message [s], with the reason if it is known."""
        line = f'{self.name} is stale: no valid message for {silence:.3f} s'
        return '; '.join(filter(None, (line, self.refused)))

    def is_current(self, now: int) -> bool:
        """Return whether the last valid message is not older than the timeout."""
        return self.silence(now) * NANOSECONDS <= self.timeout

    def status(self, now: int) -> InputStatus:
        counted = (ACCEPTED, REPEATED, DROPPED)
        return InputStatus(
            rate=self.window.rate(now),
            age=None if self.counted is None else self.silence(now),
            accepted=self.counts[ACCEPTED],
            repeated=self.counts[REPEATED],
            out_of_order=self.counts[DROPPED],
            rejected={kind: n for kind, n in self.counts.items() if kind not in counted},
        )


class DisplacementMonitor:
    """
    Compare the displacement between two measurements with their velocities.

    `jump` is the largest inconsistent displacement [m], at once or within the last seconds, and
    `longest` the longest time between two measurements that can be compared [s].
    """

    def __init__(self, jump: float, longest: float) -> None:
        self._jump, self._longest = jump, longest
        self.forget()

    def forget(self) -> None:
        #: Time [s], insertion depth [m] and velocity [m/s] of the last measurement.
        self._last: tuple[float, float, float] | None = None
        #: Displacement unexplained by the velocities of the last seconds [m].
        self._unexplained = 0.0

    def gap(self, time: float) -> float:
        """Return the time since the last measurement [s] if it is too long or negative; else 0."""
        elapsed = time - self._last[0] if self._last is not None else 0.0
        return 0.0 if 0.0 <= elapsed <= self._longest else elapsed

    def fault(self, time: float, depth: float, velocity: float) -> str | None:
        """Add a measurement; return why its displacement is inconsistent, or None."""
        gap, before, self._last = self.gap(time), self._last, (time, depth, velocity)
        if before is None or gap:
            self._unexplained = 0.0
            return None
        last, old, earlier = before
        elapsed, moved = time - last, depth - old
        rest = moved - 0.5 * (earlier + velocity) * elapsed
        if not abs(rest) <= self._jump:
            # The position jumped; the next measurements may be consistent.
            self._unexplained = 0.0
            return (
                f'insertion moved by {moved:.6g} m in {elapsed:.6g} s at velocities of '
                f'{earlier:.6g} and {velocity:.6g} m/s'
            )
        unexplained = exp(-elapsed / MEMORY) * self._unexplained + rest
        # Clipped, so that the fault ends as soon as position and velocity agree again.
        self._unexplained = min(max(unexplained, -self._jump), self._jump)
        if abs(unexplained) > self._jump:
            return (
                f'insertion and its velocity contradict each other: {1e3 * abs(unexplained):.3g} '
                f'mm too {"much" if unexplained > 0.0 else "little"} within {MEMORY:g} s'
            )
        return None
