"""Friction from running topics: pairs force and motion by stamp and keeps estimating."""

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

#: Pairs from which the sampling rate is determined.
_FIRST: Final = 50

#: Motion is not interpolated over a longer step [s].
_LARGEST_STEP: Final = 0.1

#: A stamp that goes back by more means that the clock was set back; by less, that a message
#: arrived late [s].
_SET_BACK: Final = 1.0

#: What no recording holds: forces [N], and depths [m] or speeds [m/s].
_LARGEST: Final = {'force': 1e4, 'motion': 100.0}

#: Samples that may wait for the other topic.
_MAX_WAITING: Final = 20_000


class LiveFriction:
    """
    Estimates friction from messages as they arrive.

    Motion is interpolated to the stamps of the force. A sample that is not finite, out of order,
    or within a gap of the motion is dropped and counted. When the clock is set back, estimation
    starts again.

    Parameters
    ----------
    settings : FrictionSettings
        Terms and filter.
    forgetting : float
        Time of steady motion in which the weight of a sample falls to 1 / e [s].

    Attributes
    ----------
    samples : int
        Number of samples of the force that were paired with the motion.

    Raises
    ------
    ParameterError
        If `RecursiveFriction` rejects the settings or the time.

    """

    def __init__(self, settings: FrictionSettings, forgetting: float) -> None:
        # The rate is not known yet; the other arguments are checked now.
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
        """Number of dropped samples by reason."""
        return dict(self._dropped)

    def take_motion(self, stamp: int, depth: float, speed: float | None) -> None:
        """
        Add a sample of the motion.

        Parameters
        ----------
        stamp : int
            Time [ns].
        depth : float
            Inserted length [m].
        speed : float or None
            Insertion speed [m/s]; None to differentiate the depth.

        """
        time = self._time('motion', stamp, depth if speed is None else speed)
        if time is None:
            return
        if speed is None:
            before, self._last_depth = self._last_depth, (time, depth)
            if before is None:
                return
            # The slope between two samples is the speed in their middle.
            speed = (depth - before[1]) / (time - before[0])
            time = (time + before[0]) / 2.0
        self._motion.append((time, speed))
        self._pair()

    def take_force(self, stamp: int, force: float) -> None:
        """
        Add a sample of the force.

        Parameters
        ----------
        stamp : int
            Time [ns].
        force : float
            Force of the base on the needle [N], positive into the tissue.

        """
        time = self._time('force', stamp, force)
        if time is not None:
            self._force.append((time, force))
            self._pair()

    def estimate(self) -> tuple[ParameterEstimate, ...]:
        """
        Return the present friction.

        Returns
        -------
        tuple of ParameterEstimate
            As `RecursiveFriction.estimate`; empty before the sampling rate is known.

        """
        return () if self._estimator is None else self._estimator.estimate()

    def _time(self, topic: str, stamp: int, value: float) -> float | None:
        """Return the time from the start [s], or None if the sample is dropped."""
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
        """Pass on the samples of the force that the motion has reached."""
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
