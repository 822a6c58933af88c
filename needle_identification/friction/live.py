"""Online friction identification from running topics: synchronizes force and motion by stamp."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from itertools import pairwise
from math import inf, isfinite, nan
from statistics import median
from typing import Final

from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.friction.recursive import RecursiveFriction
from needle_identification.friction.settings import FrictionSettings

#: Number of pairs that determine the sampling rate.
_FIRST: Final = 50

#: Largest step for interpolation of the motion [s].
_LARGEST_STEP: Final = 0.1

#: Backward step of a stamp above which the clock was set back [s]; after a smaller step, the
#: message arrived late.
_SET_BACK: Final = 1.0

#: Largest plausible values: forces [N]; depths [m] or velocities [m/s].
_LARGEST: Final = {'force': 1e4, 'motion': 100.0}

#: Largest number of samples that wait for the other topic.
_MAX_WAITING: Final = 20_000


class LiveFriction:
    """
    Estimate friction from messages as they arrive, with the motion at the stamps of the force.

    Samples that are not finite, out of order, or within a gap of the motion are discarded and
    counted. Estimation restarts when the clock is set back. ``forgetting`` is the time of steady
    motion in which the weight of a sample falls to 1 / e [s].
    """

    def __init__(self, settings: FrictionSettings, forgetting: float) -> None:
        # Checks the arguments except the sampling rate, which is determined later.
        RecursiveFriction(settings, 1.0, forgetting)
        self._settings, self._forgetting = settings, forgetting
        self._dropped: Counter[str] = Counter()
        self._restart()

    def _restart(self) -> None:
        self._start: int | None = None
        self._motion: deque[tuple[float, float]] = deque(maxlen=_MAX_WAITING)
        self._force: deque[tuple[float, float]] = deque(maxlen=_MAX_WAITING)
        self._last = {'force': -inf, 'motion': -inf}
        self._last_depth: tuple[float, float] | None = None
        self._first: list[tuple[float, float, float]] = []
        self._estimator: RecursiveFriction | None = None
        self.samples = 0

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of discarded samples by reason."""
        return dict(self._dropped)

    def take_motion(self, stamp: int, depth: float, speed: float | None) -> None:
        """Add depth [m] and velocity [m/s], or depth to differentiate, at a stamp [ns]."""
        time = self._time('motion', stamp, depth if speed is None else speed)
        if time is None:
            return
        if speed is None:
            before, self._last_depth = self._last_depth, (time, depth)
            if before is None:
                return
            # The difference quotient is the velocity at the midpoint.
            speed = (depth - before[1]) / (time - before[0])
            time = (time + before[0]) / 2.0
        self._motion.append((time, speed))
        self._pair()

    def take_force(self, stamp: int, force: float) -> None:
        """Add the base force on the needle [N], positive into the tissue, at a stamp [ns]."""
        time = self._time('force', stamp, force)
        if time is not None:
            self._force.append((time, force))
            self._pair()

    def estimate(self) -> tuple[ParameterEstimate, ...]:
        """Return the current friction parameters; empty until the sampling rate is determined."""
        return () if self._estimator is None else self._estimator.estimate()

    def _time(self, topic: str, stamp: int, value: float) -> float | None:
        """Return the time since the start [s], or None if the sample is discarded."""
        if not abs(value) <= _LARGEST[topic]:
            self._dropped['absurd' if isfinite(value) else 'not finite'] += 1
            return None
        if self._start is None:
            self._start = stamp
        time = 1e-9 * (stamp - self._start)
        if time < self._last[topic] - _SET_BACK:
            self._restart()
            self._dropped['clock set back'] += 1
            return None
        if time <= self._last[topic]:
            self._dropped['out of order'] += 1
            return None
        self._last[topic] = time
        return time

    def _pair(self) -> None:
        """Process force samples up to the latest motion sample."""
        motion = self._motion
        while self._force and motion and motion[-1][0] >= self._force[0][0]:
            time, force = self._force.popleft()
            while len(motion) > 1 and motion[1][0] <= time:
                motion.popleft()
            speed = _interpolated(motion, time)
            if isfinite(speed):
                self._pass_on(time, speed, force)
            else:
                self._dropped['no motion at their time'] += 1

    def _pass_on(self, time: float, speed: float, force: float) -> None:
        self.samples += 1
        if self._estimator is not None:
            self._estimator.update(time, speed, force)
            return
        self._first.append((time, speed, force))
        if len(self._first) == _FIRST:
            period = median(after[0] - before[0] for before, after in pairwise(self._first))
            self._estimator = RecursiveFriction(self._settings, 1.0 / period, self._forgetting)
            for sample in self._first:
                self._estimator.update(*sample)


def _interpolated(motion: deque[tuple[float, float]], time: float) -> float:
    before, speed = motion[0]
    if before == time:
        return speed
    if before > time or motion[1][0] - before > _LARGEST_STEP:
        return nan
    after, later = motion[1]
    return speed + (later - speed) * (time - before) / (after - before)
