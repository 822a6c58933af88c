# SPDX-License-Identifier: Apache-2.0
"""Motion-controlled base that moves the needle in mode `robot`, and its trajectories."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from math import copysign, inf, nan, sqrt
from typing import Final

from needle_ros.errors import ParameterError
from needle_ros.settings import CheckedSettings, constant, positive
from needle_ros.trajectories import check_times, JointReference
import numpy as np

#: Parts of a sample interval with constant push force: with friction the velocity follows the
#: force at once, and a present velocity with a mean force would be delayed by half an interval.
PUSHES: Final = 4

_SETTLED: Final = 1e-8  #: position error below which the base rests at the end of a trajectory [m]
_ROUNDING: Final = 1e-9  #: tolerance of times due to rounding [s]
_LATE: Final = 1e-4  #: position error above which the base is late [m]


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseParameters(CheckedSettings):
    """Limits of the motion-controlled base (the robot that moves the needle)."""

    speed_limit: float = positive(0.05, 'm/s', 'highest speed of the base')
    acceleration_limit: float = positive(
        0.5, 'm/s^2', 'highest acceleration of the motion-controlled base'
    )
    position_gain: float = positive(20.0, '1/s', 'rate at which the base closes a position error')
    encoder_resolution: float = constant(1e-6, 'm', 'length per count of the joint position')


def on_grid(value: float, resolution: float) -> float:
    """Round a value to multiples of a resolution in the same unit; 0 disables rounding."""
    return round(value / resolution) / (1.0 / resolution) if resolution > 0.0 else value


class BaseMotion:
    """Tracking of trajectories of a joint, or pushing with a force, within limits."""

    def __init__(
        self,
        parameters: BaseParameters,
        depth: float,
        reach: tuple[float, float],
        force_limit: float = inf,
        joint: str = 'trajectory',
        unit: str = 'm',
    ) -> None:
        # ``depth`` is held until a trajectory arrives; ``joint`` and ``unit`` are for messages.
        self.limits = parameters
        self._joint, self._unit = joint, unit
        self._range = reach
        self._force_limit = force_limit
        #: Force of the active push [N].
        self._force = 0.0
        # The segment that ends at each point is a push or a motion; the last point is held.
        self._times = np.array([0.0])
        self._depths = np.array([depth])
        self._forces = np.array([0.0])
        self._pushes = np.array([False])
        self._find_ranges()

    def follow(
        self,
        start: float,
        depth: float,
        times: Sequence[float],
        depths: Sequence[float | None],
        forces: Sequence[float | None] = (),
    ) -> None:
        """Start a new trajectory at a time and depth, linear in time between its points."""
        # A point without a depth (None) ends a push, during which the force changes linearly from
        # that of the previous point, zero if that was no push. A motion after a push starts at the
        # actual position of the base, a new trajectory with the force of the active push.
        check_times(times)
        low, high = self._range
        ends = [force for at, force in zip_longest(depths, forces) if at is None]
        # Written so that NaN is rejected too.
        unit = self._unit
        for at in depths:
            if at is not None and not low <= at <= high:
                raise ParameterError(
                    f'{self._joint} must stay in [{low:g}, {high:g}] {unit}, got {at:g} {unit}'
                )
        for force in ends:
            if force is None:
                raise ParameterError('each point needs a position or an effort')
            if not abs(force) <= self._force_limit:
                raise ParameterError(
                    f'a push must be within {self._force_limit:g} N, got {force:g} N'
                )
        # A point at the start time replaces the point for the present position.
        first = [] if times[0] == 0.0 else [(0.0, depth, self._force, False)]
        points = [
            (time, depth, force, True) if at is None else (time, at, 0.0, False)
            for time, at, force in zip_longest(times, depths, forces)
        ]
        columns = zip(*first, *points, strict=True)
        offsets, self._depths, self._forces, self._pushes = map(np.array, columns)
        self._times = start + offsets
        self._find_ranges()

    def _find_ranges(self) -> None:
        """Find the smallest and the largest depth of each point and the points after it."""
        reverse = self._depths[::-1]
        self._lowest = np.minimum.accumulate(reverse)[::-1]
        self._highest = np.maximum.accumulate(reverse)[::-1]

    @property
    def end(self) -> float:
        """Time of the last point [s], on the clock of `velocity`."""
        return float(self._times[-1])

    def reference(self, time: float) -> JointReference:
        """Return the reference at a time [s]; a push has no position, a motion no effort."""
        times, last = self._times, len(self._times) - 1
        # Clock rounding must not delay the end.
        arrived = time >= self.end - _ROUNDING
        k = min(int(np.searchsorted(times, time, side='right')), last)
        if self._pushes[k]:
            force = float(np.interp(time, times, self._forces))
            return JointReference(nan, nan, force, arrived)
        velocity = 0.0
        if k > 0 and not arrived:
            step = self._depths[k] - self._depths[k - 1]
            velocity = float(step / (times[k] - times[k - 1]))
        position = float(np.interp(time, times, self._depths))
        return JointReference(position, velocity, nan, arrived)

    def push(self, time: float, depth: float, interval: float) -> float | None:
        """Return the mean push force over an interval [N] at a depth [m]; None in a motion."""
        last = len(self._times) - 1
        # Clock rounding must not add an interval.
        k = int(np.searchsorted(self._times, time + 1e-6 * interval, side='right'))
        if self._pushes[min(k, last)]:
            middle = min(time + 0.5 * interval, float(self._times[min(k, last)]))
            self._force = float(np.interp(middle, self._times, self._forces))
            return self._force
        if k > 0 and self._pushes[k - 1]:
            # The push has ended: the segment of insertion depths starts here.
            self._depths[k - 1], self._pushes[k - 1] = depth, False
            self._find_ranges()
        self._force = 0.0
        return None

    def pushes(self, time: float, interval: float, depth: Callable[[], float]) -> Iterator[float]:
        """Yield the push force of each part of an interval [N]; nothing during a motion."""
        part = interval / PUSHES
        force: float | None = None
        for k in range(PUSHES):
            push = self.push(time + k * part, depth(), part)
            force = force if push is None else push
            if force is None:
                return
            yield force

    def velocity(self, time: float, depth: float, velocity: float, interval: float) -> float:
        """Return the velocity [m/s] after an interval [s] that tracks the trajectory in limits."""
        limits = self.limits
        now = float(np.interp(time, self._times, self._depths))
        ahead = float(np.interp(time + interval, self._times, self._depths))
        change = limits.acceleration_limit * interval
        error = now - depth
        if ahead == now and abs(error) < _SETTLED and abs(velocity) <= change:
            return 0.0
        # Reduce the error no faster than the base can brake; half the limit leaves a margin.
        gain = min(limits.position_gain, 1.0 / interval)
        closing = min(gain * abs(error), sqrt(limits.acceleration_limit * abs(error)))
        forward = (ahead - now) / interval
        if abs(error) > _LATE:
            # It catches up, but brakes within the rest of the trajectory.
            k = min(int(np.searchsorted(self._times, time, side='right')), len(self._times) - 1)
            end = self._highest[k] if error > 0.0 else self._lowest[k]
            rest = (float(end) - depth - 0.5 * interval * velocity) * copysign(1.0, error)
            fastest = self._braking_speed(max(0.0, rest), interval)
            closing = min(closing, max(0.0, fastest - copysign(forward, forward * error)))
        wanted = forward + copysign(closing, error)
        wanted = min(max(wanted, -limits.speed_limit), limits.speed_limit)
        return min(max(wanted, velocity - change), velocity + change)

    def _braking_speed(self, distance: float, interval: float) -> float:
        """Return the highest speed [m/s] after an interval [s] to brake within a distance [m]."""
        limit, half = self.limits.acceleration_limit, 0.5 * interval
        return limit * (sqrt(half**2 + 2.0 * distance / limit) - half)
