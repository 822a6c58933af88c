"""References from where the needle is to a target, within limits of speed and acceleration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import copysign, inf, isfinite, sqrt
from typing import Final, Protocol

from needle_controller.compiled.laws import quintic_extremes
from needle_controller.laws.axis import Setpoint
from needle_dynamics import (
    FloatArray,
)
from needle_ros.errors import (
    ParameterError,
)
from needle_ros.settings import check_constants, constant
import numpy as np

#: Rounding that a limit may be exceeded by.
_ROUNDING: Final = 1e-9

#: Factor by which a motion is made longer until it is within its limits.
_LONGER: Final = 1.1

#: Shortest time in which a motion is changed [s].
_SHORTEST: Final = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceLimits:
    """Limits of the reference."""

    speed: float = constant(0.01, 'm/s', 'highest speed of the reference', open_low=True)
    acceleration: float = constant(
        0.1, 'm/s^2', 'highest acceleration of the reference', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)


class Reference(Protocol):
    """A motion that ends at rest; times count from its start [s]."""

    @property
    def duration(self) -> float:
        """Time to the end [s]."""

    def at(self, time: float) -> Setpoint:
        """Return where the reference is; before the start and after the end it rests."""


class Step:
    """
    The target at once: what the source regulates to.

    Parameters
    ----------
    start : Setpoint
        Not used.
    target : float
        Where it is [m].
    limits : ReferenceLimits
        Not used.

    """

    duration: Final = 0.0

    def __init__(self, start: Setpoint, target: float, limits: ReferenceLimits) -> None:
        del start, limits
        self._target = target

    def at(self, time: float) -> Setpoint:
        """Return where the reference is."""
        del time
        return Setpoint(self._target)


class Trapezoid:
    """
    The fastest motion within the limits: ramp up, cruise, ramp down.

    Parameters
    ----------
    start : Setpoint
        Where it begins; its acceleration does not count.
    target : float
        Where it ends, at rest [m].
    limits : ReferenceLimits
        Limits; a higher initial speed is braked first.

    """

    def __init__(self, start: Setpoint, target: float, limits: ReferenceLimits) -> None:
        top, ramp = limits.speed, limits.acceleration
        position, speed = start.position, start.speed
        #: (duration, acceleration) of each part.
        parts: list[tuple[float, float]] = []
        # Brake what cannot belong to the motion: the wrong way, too fast, or too far.
        stop = position + copysign(speed * speed / (2.0 * ramp), speed)
        sign = copysign(1.0, target - stop)
        if speed * sign < 0.0:
            parts.append((abs(speed) / ramp, -copysign(ramp, speed)))
            position, speed = stop, 0.0
        elif abs(speed) > top:
            slowing = (abs(speed) - top) / ramp
            parts.append((slowing, -sign * ramp))
            position += sign * slowing * (abs(speed) + top) / 2.0
            speed = sign * top
        v0 = abs(speed)
        distance = abs(target - position)
        peak = min(top, sqrt(ramp * distance + 0.5 * v0 * v0))
        cruise = distance - (2.0 * peak * peak - v0 * v0) / (2.0 * ramp)
        parts.append((max(0.0, peak - v0) / ramp, sign * ramp))
        parts.append((max(0.0, cruise) / peak if peak > 0.0 else 0.0, 0.0))
        parts.append((peak / ramp, -sign * ramp))
        self._start = start
        self._target = target
        self._parts = parts
        self.duration = sum(part[0] for part in parts)

    def at(self, time: float) -> Setpoint:
        """Return where the reference is."""
        if time >= self.duration:
            return Setpoint(self._target)
        position, speed = self._start.position, self._start.speed
        if time <= 0.0:
            return Setpoint(position, speed)
        for duration, acceleration in self._parts:
            t = min(time, duration)
            position += t * (speed + 0.5 * t * acceleration)
            speed += t * acceleration
            time -= t
            if time <= 0.0:
                break
        return Setpoint(position, speed, acceleration)


class Quintic:
    """
    The motion of least integrated squared jerk from one setpoint to another in a given time.

    Parameters
    ----------
    start, end : Setpoint
        Ends, with their speeds and accelerations.
    duration : float
        Time between them [s].

    """

    def __init__(self, start: Setpoint, end: Setpoint, duration: float) -> None:
        t = duration
        self.duration = t
        self.start, self.end = start, end
        v0, a0 = start.speed * t, start.acceleration * t * t
        v1, a1 = end.speed * t, end.acceleration * t * t
        d = end.position - start.position
        # Powers of time over duration.
        c3 = 10.0 * d - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1
        c4 = -15.0 * d + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1
        c5 = 6.0 * d - 3.0 * (v0 + v1) - 0.5 * (a0 - a1)
        self._c = start.position, v0, 0.5 * a0, c3, c4, c5

    def at(self, time: float) -> Setpoint:
        """Return where the motion is; it is held at the ends."""
        if time >= self.duration:
            return self.end
        if time <= 0.0:
            return self.start
        t = self.duration
        x = time / t
        p, v, a, c3, c4, c5 = self._c
        return Setpoint(
            p + x * (v + x * (a + x * (c3 + x * (c4 + x * c5)))),
            (v + x * (2.0 * a + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))) / t,
            (2.0 * a + x * (6.0 * c3 + x * (12.0 * c4 + x * 20.0 * c5))) / (t * t),
        )

    def within(self, limits: ReferenceLimits) -> bool:
        """Return whether it keeps the limits; what an end exceeds is not held against it."""
        ends = self.start, self.end
        top = max(limits.speed, *(abs(end.speed) for end in ends)) * (1.0 + _ROUNDING)
        ramp = max(limits.acceleration, *(abs(end.acceleration) for end in ends))
        ramp *= 1.0 + _ROUNDING
        _, speed, acceleration = self.extremes
        return bool(np.abs(acceleration).max() <= ramp and np.abs(speed).max() <= top)

    def stays(self, reach: tuple[float, float]) -> bool:
        """Return whether it stays in a range of positions [m], ends and rounding included."""
        low, high = reach
        least, largest = self.extremes[0]
        slack = _ROUNDING * (high - low) if high - low < inf else 0.0
        return bool(low - slack <= least and largest <= high + slack)

    @property
    def extremes(self) -> FloatArray:
        """Least and largest position, speed and acceleration, shape (3, 2)."""
        t = self.duration
        return np.asarray(quintic_extremes(np.array(self._c)) / [[1.0], [t], [t * t]])


def _around(reach: tuple[float, float], start: Setpoint) -> tuple[float, float]:
    """Return a range of positions [m] that has the start in it: one outside has to come back."""
    return min(reach[0], start.position), max(reach[1], start.position)


class MinimumJerk:
    """
    The quintic of least integrated squared jerk, as short as the limits allow.

    Parameters
    ----------
    start : Setpoint
        Where it begins, with its speed and acceleration.
    target : float
        Where it ends, at rest [m].
    limits : ReferenceLimits
        Limits; what the start already exceeds is not held against it.
    reach : tuple of float
        Least and largest position on the way [m]; a start outside counts as in it.

    """

    def __init__(
        self,
        start: Setpoint,
        target: float,
        limits: ReferenceLimits,
        reach: tuple[float, float] = (-inf, inf),
    ) -> None:
        reach = _around(reach, start)
        distance = abs(target - start.position)
        # Rest to rest: the peaks of the quintic are 15/8 D/T and 10/sqrt(3) D/T^2.
        shortest = max(
            1.875 * distance / limits.speed,
            sqrt(10.0 / sqrt(3.0) * distance / limits.acceleration),
            2.0 * abs(start.speed) / limits.acceleration,
            _SHORTEST,
        )
        end = Setpoint(target)
        motion = Quintic(start, end, shortest)
        at_rest = start.speed == 0.0 and start.acceleration == 0.0

        def fits() -> bool:
            return at_rest or (motion.within(limits) and motion.stays(reach))

        while not fits() and motion.duration < 100.0 * shortest:
            motion = Quintic(start, end, _LONGER * motion.duration)
        self._halt: Quintic | None = None
        self._motion = motion
        if not fits():
            # No quintic does it: to rest first.
            self._halt = halt(start, limits, reach)
            distance = abs(target - self._halt.end.position)
            least = max(
                1.875 * distance / limits.speed,
                sqrt(10.0 / sqrt(3.0) * distance / limits.acceleration),
                _SHORTEST,
            )
            self._motion = Quintic(self._halt.end, end, least)
        self.duration = self._motion.duration + (self._halt.duration if self._halt else 0.0)

    def at(self, time: float) -> Setpoint:
        """Return where the reference is."""
        if self._halt is not None:
            if time < self._halt.duration:
                return self._halt.at(time)
            time -= self._halt.duration
        return self._motion.at(time)


def halt(
    start: Setpoint, limits: ReferenceLimits, reach: tuple[float, float] = (-inf, inf)
) -> Quintic:
    """
    Return the motion to rest that does not turn, within the limit of acceleration.

    Where that would leave the reach it ends where the reach does, braked as much harder as that
    takes.

    Parameters
    ----------
    start : Setpoint
        Where it begins. An acceleration goes on for a while: by 4/27 of it times the duration
        the speed may go up at first.
    limits : ReferenceLimits
        Limits.
    reach : tuple of float
        Least and largest position on the way [m]; a start outside counts as in it.

    Returns
    -------
    Quintic
        Motion.

    """
    reach = _around(reach, start)
    v, a = start.speed, start.acceleration
    time = max(1.5 * abs(v) / limits.acceleration, _SHORTEST)

    def motion() -> Quintic:
        end = Setpoint(start.position + time * (0.5 * v + time * a / 12.0))
        return Quintic(start, end, time)

    # Its speed is a cubic: with more time its acceleration goes to that of the start.
    for _ in range(40):
        peak = np.abs(motion().extremes[2]).max()
        if peak <= max(limits.acceleration, abs(a)) * (1.0 + _ROUNDING):
            break
        time *= _LONGER
    found = motion()
    if found.stays(reach):
        return found
    end = Setpoint(reach[1] if v > 0.0 or (v == 0.0 and a > 0.0) else reach[0])
    # The longest time in which it does not pass the end first.
    short, long = 0.0, time
    for _ in range(30):
        middle = 0.5 * (short + long)
        if Quintic(start, end, middle).stays(reach):
            short = middle
        else:
            long = middle
    return Quintic(start, end, short or long)


def _brake(start: Setpoint, limits: ReferenceLimits, reach: tuple[float, float]) -> Reference:
    """Return the shortest motion to rest, whose acceleration begins and ends at once."""
    low, high = reach
    stop = start.position + 0.5 * start.speed * abs(start.speed) / limits.acceleration
    slack = _ROUNDING * (high - low)
    if low - slack <= stop <= high + slack:
        return Trapezoid(start, min(max(stop, low), high), limits)
    return halt(start, limits, reach)


#: References to a target by name.
REFERENCES: dict[str, type[Trapezoid] | type[MinimumJerk] | type[Step]] = {
    'trapezoid': Trapezoid,
    'minimum_jerk': MinimumJerk,
    'step': Step,
}


class Path:
    """
    A motion given by points: straight lines between positions, cubics where speeds are given.

    Corners between lines are rounded by parabolas with the acceleration limit. The time of a
    path is that of its points; it ends at rest.

    Parameters
    ----------
    times : sequence of float
        Times of the points [s], increasing from zero or later.
    positions : sequence of float
        Inserted lengths [m].
    speeds : sequence of float, optional
        Insertion speeds [m/s], zero at the end.
    limits : ReferenceLimits
        Limits.
    reach : tuple of float
        Least and largest inserted length [m].

    Raises
    ------
    ParameterError
        If numbers are missing, not finite or beyond a limit, or times do not increase.

    """

    def __init__(
        self,
        times: Sequence[float],
        positions: Sequence[float],
        speeds: Sequence[float] | None,
        limits: ReferenceLimits,
        reach: tuple[float, float],
    ) -> None:
        if not times or len(times) != len(positions):
            raise ParameterError(
                f'needs one position for each of at least one time, got {len(positions)} for '
                f'{len(times)}'
            )
        if speeds is not None and len(speeds) != len(times):
            raise ParameterError(
                f'needs a speed for each of its {len(times)} points or none, got {len(speeds)}'
            )
        if not all(map(isfinite, (*times, *positions, *(speeds or ())))):
            raise ParameterError('times, positions and speeds must be finite')
        if times[0] < 0.0 or any(late <= early for early, late in pairwise(times)):
            raise ParameterError(f'times must be >= 0 and increasing, got {list(times)} s')
        low, high = reach
        if not all(low <= at <= high for at in positions):
            raise ParameterError(
                f'positions must be in [{low:g}, {high:g}] m, got {list(positions)} m'
            )
        #: Start time, position, speed, acceleration and jerk of each piece.
        self._pieces: list[tuple[float, float, float, float, float]] = []
        if speeds is None:
            self._join_lines(times, positions, limits)
        else:
            self._join_cubics(times, positions, speeds, limits)
            self._check_reach(low, high)
        self._starts, self.reach = np.array([piece[0] for piece in self._pieces]), reach
        self.begin, self.last = float(times[0]), float(positions[-1])

    def _join_lines(
        self, times: Sequence[float], positions: Sequence[float], limits: ReferenceLimits
    ) -> None:
        """Join lines by parabolas."""
        ramp = limits.acceleration
        speed, free = 0.0, times[0]
        # At the first point it has the speed of the first line already.
        if len(times) > 1:
            speed = (positions[1] - positions[0]) / (times[1] - times[0])
            self._pieces.append((times[0], positions[0], speed, 0.0, 0.0))
        for k in range(len(times)):
            following = 0.0
            if k + 1 < len(times):
                following = (positions[k + 1] - positions[k]) / (times[k + 1] - times[k])
            if abs(following) > limits.speed * (1.0 + _ROUNDING):
                raise ParameterError(
                    f'speed after {times[k]:g} s must be within {limits.speed:g} m/s, got '
                    f'{following:g} m/s'
                )
            if k > 0:
                half = 0.5 * abs(following - speed) / ramp
                start = times[k] - half
                if start < free - _ROUNDING:
                    raise ParameterError(
                        f'speed changes from {speed:g} to {following:g} m/s at {times[k]:g} s '
                        f'within less time than the acceleration limit {ramp:g} m/s^2 takes'
                    )
                turn = copysign(ramp, following - speed)
                self._pieces.append((start, positions[k] - half * speed, speed, turn, 0.0))
                free = times[k] + half
                at = positions[k] + half * following
                self._pieces.append((free, at, following, 0.0, 0.0))
            speed = following
        self.end = free
        # To the bit, and at rest.
        self._pieces[len(self._pieces) - 1 :] = [(free, positions[-1], 0.0, 0.0, 0.0)]

    def _join_cubics(
        self,
        times: Sequence[float],
        positions: Sequence[float],
        speeds: Sequence[float],
        limits: ReferenceLimits,
    ) -> None:
        """Join cubics."""
        if speeds[-1] != 0.0:
            raise ParameterError(f'speed at the end must be 0, got {speeds[-1]:g} m/s')
        for k in range(len(times) - 1):
            t = times[k + 1] - times[k]
            d, v0, v1 = positions[k + 1] - positions[k], speeds[k], speeds[k + 1]
            a = (6.0 * d / t - 4.0 * v0 - 2.0 * v1) / t
            jerk = (6.0 * (v0 + v1) - 12.0 * d / t) / (t * t)
            inside = -a / jerk if jerk else -1.0
            peaks = [abs(v0), abs(v1)]
            if 0.0 < inside < t:
                peaks.append(abs(v0 + 0.5 * a * inside))
            for name, unit, found, bound in (
                ('speed', 'm/s', max(peaks), limits.speed),
                ('acceleration', 'm/s^2', max(abs(a), abs(a + jerk * t)), limits.acceleration),
            ):
                if found > bound * (1.0 + _ROUNDING):
                    raise ParameterError(
                        f'{name} after {times[k]:g} s must be within {bound:g} {unit}, got '
                        f'{found:g} {unit}'
                    )
            self._pieces.append((times[k], positions[k], v0, a, jerk))
        self._pieces.append((times[-1], positions[-1], 0.0, 0.0, 0.0))
        self.end = float(times[-1])

    def _check_reach(self, low: float, high: float) -> None:
        """Refuse cubics that leave the reach between their points."""
        for (start, p, v, a, jerk), after in pairwise(self._pieces):
            span = after[0] - start
            for turn in np.roots([0.5 * jerk, a, v]):
                t = float(turn.real)
                at = p + t * (v + t * (0.5 * a + t * jerk / 6.0))
                if turn.imag == 0.0 and 0.0 < t < span and not low <= at <= high:
                    raise ParameterError(
                        f'path must stay in [{low:g}, {high:g}] m, got {at:g} m between its points'
                    )

    def at(self, time: float) -> Setpoint:
        """Return where the path is; before its first point it is there."""
        k = max(int(np.searchsorted(self._starts, time, side='right')) - 1, 0)
        start, p, v, a, jerk = self._pieces[k]
        t = max(time - start, 0.0)
        return Setpoint(
            p + t * (v + t * (0.5 * a + t * jerk / 6.0)),
            v + t * (a + 0.5 * t * jerk),
            a + t * jerk,
        )


class Joined:
    """
    A path joined from elsewhere without a jump in position, speed or acceleration.

    The path is reached at its first point in time if the limits and the reach of the path allow
    that, else later, and is then late by half of what the joining took longer.

    Parameters
    ----------
    start : Setpoint
        Where it begins.
    path : Path
        Path to join.
    since : float
        Time of the path that is now [s].
    limits : ReferenceLimits
        Limits of the motion that joins it.

    """

    def __init__(self, start: Setpoint, path: Path, since: float, limits: ReferenceLimits) -> None:
        self._path = path
        self._halt: Reference | None = None
        reach = _around(path.reach, start)
        if start.acceleration:
            # No quintic goes far with an acceleration at its start: to rest first.
            stopped = halt(start, limits, reach)
            self._halt, start = stopped, stopped.end
        found = _join(start, path, since, limits, reach)
        if found is None and start.speed:
            self._halt = _brake(start, limits, reach)
            start = self._halt.at(self._halt.duration)
            found = _join(start, path, since, limits, reach)
        # What no quintic joins is met from rest to rest, where it ends.
        joining, entry = found or (MinimumJerk(start, path.last, limits), path.end)
        self._joining = joining
        self._halting = self._halt.duration if self._halt else 0.0
        self._joined = self._halting + (joining.duration if joining else 0.0)
        #: Time of this motion that belongs to the time zero of the path.
        self.offset = self._joined - entry
        self.duration = max(path.end + self.offset, self._joined)

    def at(self, time: float) -> Setpoint:
        """Return where the reference is."""
        if time >= self.duration:
            return Setpoint(self._path.last)
        if self._halt is not None and time < self._halting:
            return self._halt.at(time)
        if self._joining is not None and time < self._joined:
            return self._joining.at(time - self._halting)
        return self._path.at(time - self.offset)


def _join(
    start: Setpoint,
    path: Path,
    since: float,
    limits: ReferenceLimits,
    reach: tuple[float, float],
) -> tuple[Reference | None, float] | None:
    """Return the quintic to a path, none if it is there, with the time of the path it leads to."""
    first = max(since, path.begin)
    least, entry = first - since, first
    if least == 0.0 and start == path.at(first):
        return None, first
    duration = max(least, _SHORTEST)
    longest = max(least, path.end - since) + _enough(start, path, limits)
    while duration < longest:
        joining = Quintic(start, path.at(entry), duration)
        if joining.within(limits) and joining.stays(reach):
            return joining, entry
        duration *= _LONGER
        entry = first + 0.5 * (duration - least)
    return None


def _enough(start: Setpoint, path: Path, limits: ReferenceLimits) -> float:
    """Return a time in which the end of a path is reached from anywhere within the limits."""
    distance = abs(path.last - start.position)
    pace = abs(start.speed) / limits.acceleration
    return 100.0 * (distance / limits.speed + pace + sqrt(distance / limits.acceleration))


class Guide:
    """
    What a controller aims at over time: a target or a path, with pauses, without a jump.

    Every change is planned from where the reference then is, with the next call of `at`.

    Parameters
    ----------
    kind : str
        Motion to a target, a key of `REFERENCES`.
    limits : ReferenceLimits
        Limits.
    reach : tuple of float
        Least and largest inserted length [m].

    Raises
    ------
    ParameterError
        If the kind is unknown.

    """

    def __init__(self, kind: str, limits: ReferenceLimits, reach: tuple[float, float]) -> None:
        if kind not in REFERENCES:
            raise ParameterError(f'unknown {kind!r}; valid: {", ".join(REFERENCES)}')
        self._kind = REFERENCES[kind]
        self.limits = limits
        self.reach = reach
        self.paused = False
        self._target: float | None = None
        self._path: Path | None = None
        #: Time of the path that has passed at the last change [s].
        self._passed = 0.0
        self._motion: Reference | None = None
        self._motion_path: Path | None = None
        self._start = self._now = 0.0
        self.forget()

    def forget(self) -> None:
        """Aim at nothing."""
        self._target, self._path, self.paused = None, None, False
        self.release()

    def release(self) -> None:
        """Start anew from wherever the needle is, towards the same aim."""
        self._mark()
        self._motion = self._motion_path = None
        self._change: Callable[[Setpoint], Reference] | None = self._plan

    def _mark(self) -> None:
        """Keep how far the path has come."""
        if isinstance(self._motion, Joined) and self._motion_path is self._path:
            self._passed = max(self._now - self._start - self._motion.offset, self._passed)

    @property
    def aims(self) -> bool:
        """Whether there is something to aim at."""
        return self._target is not None

    @property
    def moves(self) -> bool:
        """Whether a motion has been planned."""
        return self._motion is not None

    @property
    def target(self) -> float | None:
        """Inserted length where it ends [m], None without an aim."""
        return self._target

    def aim(self, depth: float) -> None:
        """
        Aim at an inserted length, from wherever the reference is now.

        Parameters
        ----------
        depth : float
            Inserted length [m].

        Raises
        ------
        ParameterError
            If it is not finite or out of reach.

        """
        low, high = self.reach
        if not low <= depth <= high:
            raise ParameterError(f'target depth must be in [{low:g}, {high:g}] m, got {depth!r}')
        self._target, self._path = depth, None
        self._replan()

    def follow(
        self,
        times: Sequence[float],
        positions: Sequence[float],
        speeds: Sequence[float] | None = None,
    ) -> None:
        """
        Follow a path from now on; see `Path` and `Joined`.

        Raises
        ------
        ParameterError
            If it is not a valid path.

        """
        path = Path(times, positions, speeds, self.limits, self.reach)
        self._target, self._path, self._passed = path.last, path, 0.0
        self._replan()

    def pause(self) -> None:
        """Brake to rest within the limits and stay there."""
        if not self.paused:
            self.paused = True
            self._change = self._brake

    def resume(self) -> None:
        """Go on to the target, or along the path from where it was left."""
        if self.paused:
            self.paused = False
            self._change = self._plan

    def _replan(self) -> None:
        # A pause outlasts a new aim.
        if not self.paused:
            self._change = self._plan

    def at(self, time: float, depth: float) -> Setpoint:
        """
        Return where the reference is, planning a change that is due.

        Parameters
        ----------
        time : float
            Time now [s].
        depth : float
            Where the needle is [m], for a motion that starts anew.

        Returns
        -------
        Setpoint
            Reference now.

        """
        self._now = time
        if self._change is not None:
            # A step is nowhere on its way.
            anew = self._motion is None or isinstance(self._motion, Step)
            now = Setpoint(depth) if anew else self.ahead(time)
            self._mark()
            change, self._change = self._change, None
            self._motion, self._motion_path, self._start = change(now), self._path, time
        return self.ahead(time)

    def ahead(self, time: float) -> Setpoint:
        """Return where the reference will be if nothing changes."""
        return self._motion.at(time - self._start) if self._motion else Setpoint(0.0)

    def left(self, time: float) -> float:
        """Return how long the motion still takes [s]."""
        return max(self._start + self._motion.duration - time, 0.0) if self._motion else 0.0

    def _plan(self, now: Setpoint) -> Reference:
        if self.paused:
            return self._brake(now)
        if self._path is not None:
            if self._kind is not MinimumJerk:
                now = Setpoint(now.position, now.speed)
            return Joined(now, self._path, self._passed, self.limits)
        target = now.position if self._target is None else self._target
        if self._kind is MinimumJerk:
            return MinimumJerk(now, target, self.limits, self.reach)
        return self._kind(now, target, self.limits)

    def _brake(self, now: Setpoint) -> Reference:
        """Stop within the acceleration limit, without passing the end of the motion."""
        motion: Reference
        if self._kind is MinimumJerk:
            motion = halt(now, self.limits, self.reach)
        else:
            motion = _brake(now, self.limits, self.reach)
        if self._path is not None:
            # Half of the braking counts: so long the path takes to where the needle stops.
            self._passed += 0.5 * motion.duration
        return motion
