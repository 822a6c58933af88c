# SPDX-License-Identifier: Apache-2.0
"""Fastest motion to a target, path through points, and a motion that joins it from anywhere."""

from collections.abc import Sequence
from math import copysign, isfinite, sqrt

from needle_controller.reference.quintic import halt, MinimumJerk, Quintic
from needle_controller.reference.setpoint import (
    around,
    LONGER,
    Reference,
    ReferenceLimits,
    ROUNDING,
    Setpoint,
    SHORTEST,
)
from needle_dynamics.arrays import FloatArray
from needle_ros.errors import ParameterError
from needle_ros.trajectories import check_times
import numpy as np


class Step(Reference):
    """Step to the target [m], as in the paper; start and limits are ignored."""

    duration = 0.0

    def __init__(self, start: Setpoint, target: float, limits: ReferenceLimits) -> None:
        del start, limits
        self._target = target

    def at(self, time: float) -> Setpoint:
        del time
        return Setpoint(self._target)


class Trapezoid(Reference):
    """
    Fastest motion to a target [m] within the limits: accelerate, constant speed, brake.

    The acceleration at the start is ignored; a start faster than the limit first brakes.
    """

    def __init__(self, start: Setpoint, target: float, limits: ReferenceLimits) -> None:
        top, ramp = limits.speed, limits.acceleration
        position, velocity = start.position, start.velocity
        parts: list[tuple[float, float]] = []  #: (duration, acceleration) of each part.
        # First brake a motion in the wrong direction, too fast, or too far.
        stop = position + copysign(velocity * velocity / (2.0 * ramp), velocity)
        sign = copysign(1.0, target - stop)
        if velocity * sign < 0.0:
            parts.append((abs(velocity) / ramp, -copysign(ramp, velocity)))
            position, velocity = stop, 0.0
        elif abs(velocity) > top:
            slowing = (abs(velocity) - top) / ramp
            parts.append((slowing, -sign * ramp))
            position += sign * slowing * (abs(velocity) + top) / 2.0
            velocity = sign * top
        v0 = abs(velocity)
        distance = abs(target - position)
        peak = min(top, sqrt(ramp * distance + 0.5 * v0 * v0))
        cruise = distance - (2.0 * peak * peak - v0 * v0) / (2.0 * ramp)
        parts.append((max(0.0, peak - v0) / ramp, sign * ramp))
        parts.append((max(0.0, cruise) / peak if peak > 0.0 else 0.0, 0.0))
        parts.append((peak / ramp, -sign * ramp))
        self._start, self._target, self._parts = start, target, parts
        self.duration = sum(part[0] for part in parts)

    def at(self, time: float) -> Setpoint:
        if time >= self.duration:
            return Setpoint(self._target)
        position, velocity = self._start.position, self._start.velocity
        if time <= 0.0:
            return Setpoint(position, velocity)
        for duration, acceleration in self._parts:
            t = min(time, duration)
            position += t * (velocity + 0.5 * t * acceleration)
            velocity += t * acceleration
            time -= t
            if time <= 0.0:
                break
        return Setpoint(position, velocity, acceleration)

    def sampled(self, times: FloatArray) -> FloatArray:
        """Return the setpoints of `at` as rows, shape (k, 3), for times [s] of shape (k,)."""
        left, found = np.maximum(times, 0.0), np.zeros((3, len(times)))
        position, velocity, acceleration = found
        position[:], velocity[:] = self._start.position, self._start.velocity
        for duration, change in self._parts:
            t = np.minimum(left, duration)
            position += t * (velocity + 0.5 * t * change)
            velocity += t * change
            acceleration[left > 0.0] = change
            left -= t
        found[:, times >= self.duration] = np.array([[self._target], [0.0], [0.0]])
        return found.T


class Path:
    """
    Path through given points: straight lines between positions, or cubics if velocities are given.

    Corners between lines are rounded by parabolas at the acceleration limit. The points define the
    duration of the path: times [s] increase from 0 or later, with an insertion depth [m] each, and
    the last velocity [m/s] is zero.
    """

    def __init__(
        self,
        times: Sequence[float],
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        limits: ReferenceLimits,
        depths: tuple[float, float],
    ) -> None:
        if not times or len(times) != len(positions):
            raise ParameterError(
                f'path needs one position for each of at least one time, got {len(positions)} '
                f'positions and {len(times)} times'
            )
        if velocities is not None and len(velocities) != len(times):
            raise ParameterError(
                f'path needs a velocity for each of its {len(times)} points or none, '
                f'got {len(velocities)}'
            )
        if not all(map(isfinite, (*times, *positions, *(velocities or ())))):
            raise ParameterError('times, positions and velocities must be finite')
        check_times(times)
        low, high = depths
        for at, time in zip(positions, times, strict=True):
            if not low <= at <= high:
                raise ParameterError(
                    f'positions must be in [{low:g}, {high:g}] m, got {at:g} m at {time:g} s'
                )
        #: Start time, position, velocity, acceleration and jerk of each piece.
        self._pieces: list[tuple[float, float, float, float, float]] = []
        #: Times of the first point and of the end [s], and insertion depth at the end [m].
        self.begin, self.end, self.last = float(times[0]), float(times[-1]), float(positions[-1])
        self.depths, self._limits = depths, limits
        if velocities is None:
            self._join_lines(times, positions)
        else:
            self._join_cubics(times, positions, velocities)
        self._starts = np.array([piece[0] for piece in self._pieces])

    def _join_lines(self, times: Sequence[float], positions: Sequence[float]) -> None:
        limits = self._limits
        slopes = [*(np.diff(positions) / np.diff(times)).tolist(), 0.0]
        # At the first point the velocity equals the slope of the first line.
        velocity, free = slopes[0], times[0]
        for time, position, following in zip(times, positions, slopes, strict=True):
            if abs(following) > limits.speed * (1.0 + ROUNDING):
                raise ParameterError(
                    f'velocity after {time:g} s must be within {limits.speed:g} m/s, got '
                    f'{following:g} m/s'
                )
            half = 0.5 * abs(following - velocity) / limits.acceleration
            start = time - half
            if start < free - ROUNDING:
                raise ParameterError(
                    f'velocity changes from {velocity:g} to {following:g} m/s at {time:g} s '
                    f'faster than the acceleration limit {limits.acceleration:g} m/s^2 allows'
                )
            turn = copysign(limits.acceleration, following - velocity)
            self._pieces.append((start, position - half * velocity, velocity, turn, 0.0))
            free, velocity = time + half, following
            self._pieces.append((free, position + half * velocity, velocity, 0.0, 0.0))
        self.end = free
        # Exactly at the last position, and at rest.
        self._pieces[-1] = (free, positions[-1], 0.0, 0.0, 0.0)

    def _join_cubics(
        self, times: Sequence[float], positions: Sequence[float], velocities: Sequence[float]
    ) -> None:
        if velocities[-1] != 0.0:
            raise ParameterError(f'velocity at the end must be 0, got {velocities[-1]:g} m/s')
        (low, high), limits = self.depths, self._limits
        start, all_p, all_v = (np.array(x, dtype=float) for x in (times, positions, velocities))
        t, p, d, v0, v1 = np.diff(start), all_p[:-1], np.diff(all_p), all_v[:-1], all_v[1:]
        # Without a jerk, an acceleration or a turn, quotients are infinite or NaN: outside of t.
        with np.errstate(all='ignore'):
            a = (6.0 * d / t - 4.0 * v0 - 2.0 * v1) / t
            jerk = (6.0 * (v0 + v1) - 12.0 * d / t) / (t * t)
            peak = -a / jerk
            between = np.where((peak > 0.0) & (peak < t), v0 + 0.5 * a * peak, 0.0)
            q = -0.5 * (a + np.copysign(np.sqrt(a * a - 2.0 * jerk * v0), a))
            turns = np.stack([2.0 * q / jerk, v0 / q])
            last = a + jerk * t
            turning = p + turns * (v0 + turns * (0.5 * a + turns * jerk / 6.0))
        for name, unit, values, bound in (
            ('speed', 'm/s', (v0, v1, between), limits.speed),
            ('acceleration', 'm/s^2', (a, last), limits.acceleration),
        ):
            found = np.abs(values).max(axis=0)
            for k in np.flatnonzero(~(found <= bound * (1.0 + ROUNDING)))[:1].tolist():
                raise ParameterError(
                    f'{name} after {times[k]:g} s must be within {bound:g} {unit}, got '
                    f'{found[k]:g} {unit}'
                )
        inside = (turns > 0.0) & (turns < t)
        for at in turning[inside & ~((low <= turning) & (turning <= high))][:1].tolist():
            raise ParameterError(
                f'path must stay in [{low:g}, {high:g}] m, got {at:g} m between its points'
            )
        pieces = (one.tolist() for one in (start[:-1], p, v0, a, jerk))
        self._pieces += zip(*pieces, strict=True)
        self._pieces.append((times[-1], positions[-1], 0.0, 0.0, 0.0))

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at a time since the start [s], at least of the first point."""
        k = max(int(np.searchsorted(self._starts, time, side='right')) - 1, 0)
        start, p, v, a, jerk = self._pieces[k]
        t = max(time - start, 0.0)
        return Setpoint(
            p + t * (v + t * (0.5 * a + t * jerk / 6.0)),
            v + t * (a + 0.5 * t * jerk),
            a + t * jerk,
        )


class Joined(Reference):
    """
    Motion that joins a path without a jump in position, velocity or acceleration.

    If limits and range of depths allow it, the motion reaches the path at its first point in time.
    Otherwise it reaches the path later, with a delay of half of the additional time. ``since`` is
    the present time on the path [s].
    """

    def __init__(self, start: Setpoint, path: Path, since: float, limits: ReferenceLimits) -> None:
        self.path = path
        self._halt: Reference | None = None
        depths = around(path.depths, start)
        if start.acceleration:
            # A quintic with an initial acceleration is only possible for a short time: stop first.
            stopped = halt(start, limits, depths)
            self._halt, start = stopped, stopped.end
        found = _join(start, path, since, limits, depths)
        if found is None and start.velocity:
            self._halt = brake(start, limits, depths)
            start = self._halt.at(self._halt.duration)
            found = _join(start, path, since, limits, depths)
        # If no quintic joins the path, move from rest to rest to its end.
        joining, entry = found or (MinimumJerk(start, path.last, limits), path.end)
        self._joining = joining
        self._halting = self._halt.duration if self._halt else 0.0
        self._joined = self._halting + (joining.duration if joining else 0.0)
        self.offset = self._joined - entry  #: Time of this motion at time zero of the path [s].
        self.duration = max(path.end + self.offset, self._joined)

    def at(self, time: float) -> Setpoint:
        if time >= self.duration:
            return Setpoint(self.path.last)
        if self._halt is not None and time < self._halting:
            return self._halt.at(time)
        if self._joining is not None and time < self._joined:
            return self._joining.at(time - self._halting)
        return self.path.at(time - self.offset)


def brake(start: Setpoint, limits: ReferenceLimits, depths: tuple[float, float]) -> Reference:
    """Return the shortest motion to rest; the end of the range may need more acceleration."""
    low, high = depths
    stop = start.position + 0.5 * start.velocity * abs(start.velocity) / limits.acceleration
    slack = ROUNDING * (high - low)
    if low - slack <= stop <= high + slack:
        return Trapezoid(start, min(max(stop, low), high), limits)
    return halt(start, limits, depths)


def _join(
    start: Setpoint, path: Path, since: float, limits: ReferenceLimits, depths: tuple[float, float]
) -> tuple[Reference | None, float] | None:
    """
    Return the quintic to a path, and the time on the path at its end [s].

    The quintic is None if the start is on the path; the result is None if there is no quintic.
    """
    first = max(since, path.begin)
    least, entry = first - since, first
    if least == 0.0 and start == path.at(first):
        return None, first
    duration = max(least, SHORTEST)
    # Time that is sufficient to reach the end of the path within the limits.
    braking = abs(start.velocity) / limits.acceleration
    distance = abs(path.last - start.position)
    enough = distance / limits.speed + braking + sqrt(distance / limits.acceleration)
    longest = max(least, path.end - since) + 100.0 * enough
    while duration < longest:
        joining = Quintic(start, path.at(entry), duration)
        if joining.within(limits) and joining.stays(depths):
            return joining, entry
        duration *= LONGER
        entry = first + 0.5 * (duration - least)
    return None
