"""The motion-controlled base that carries the needle in mode `robot`, and its trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from math import copysign, inf, sqrt
from typing import Final

from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
from needle_ros.trajectories import check_times
import numpy as np

#: Error at the end of a trajectory with which the base is content to rest [m].
_SETTLED: Final = 1e-8


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseParameters:
    """Limits of a motion-controlled base: the robot that carries the needle."""

    speed_limit: float = constant(0.05, 'm/s', 'highest speed of the base', open_low=True)
    acceleration_limit: float = constant(
        0.5, 'm/s^2', 'highest acceleration of a base that is motion controlled', open_low=True
    )
    position_gain: float = constant(
        20.0, '1/s', 'rate at which the base closes a position error', open_low=True
    )
    encoder_resolution: float = constant(1e-6, 'm', 'length per count of the joint position')

    def __post_init__(self) -> None:
        check_constants(self)


def on_grid(value: float, resolution: float) -> float:
    """
    Round a value to counts.

    Parameters
    ----------
    value : float
        The value.
    resolution : float
        Size of a count, in the unit of the value; 0 for no rounding.

    Returns
    -------
    float
        The nearest whole multiple of the resolution.

    """
    return round(value / resolution) / (1.0 / resolution) if resolution > 0.0 else value


class BaseMotion:
    """
    A base that follows a trajectory of inserted lengths, or pushes, within its limits.

    Parameters
    ----------
    parameters : BaseParameters
        Limits.
    depth : float
        Inserted length to hold until a trajectory comes [m].
    reach : tuple of float
        Least and largest inserted length [m].
    force_limit : float
        Largest force of a push [N].
    what, unit : str
        What follows a trajectory and its unit, for messages: it may be another joint.

    """

    def __init__(
        self,
        parameters: BaseParameters,
        depth: float,
        reach: tuple[float, float],
        force_limit: float = inf,
        what: str = 'trajectory',
        unit: str = 'm',
    ) -> None:
        self.limits = parameters
        self._what, self._unit = what, unit
        self._range = reach
        self._force_limit = force_limit
        #: Force of the push under way [N].
        self._force = 0.0
        # The line that ends at each point is a push or a motion; after the last it goes on.
        self._times = np.array([0.0])
        self._depths = np.array([depth])
        self._forces = np.array([0.0])
        self._pushes = np.array([False])

    def follow(
        self,
        start: float,
        depth: float,
        times: Sequence[float],
        depths: Sequence[float | None],
        forces: Sequence[float | None] = (),
    ) -> None:
        """
        Take a new trajectory, straight lines in time between its points.

        A point without an inserted length ends a push: until its time the force goes from that
        of the point before, zero if that was no push, to its own. The line after a push begins
        where the base then is. A new trajectory begins with the force of the push under way.

        Parameters
        ----------
        start : float
            Time at which it begins [s], on the clock of `speed`.
        depth : float
            Inserted length at that time [m].
        times : sequence of float
            Times of the points from the start [s], increasing from zero or later.
        depths : sequence of float or None
            Inserted lengths [m], None where a push ends.
        forces : sequence of float or None
            Forces at the ends of pushes [N], positive into the tissue; other entries do not count.

        Raises
        ------
        ParameterError
            If times do not increase, a depth is out of reach, or a point has neither.

        """
        check_times(times)
        low, high = self._range
        ends = [force for at, force in zip_longest(depths, forces) if at is None]
        # Written so that NaN is refused too.
        if not all(low <= at <= high for at in depths if at is not None):
            raise ParameterError(
                f'{self._what} must stay in [{low:g}, {high:g}] {self._unit}, got '
                f'{list(depths)} {self._unit}'
            )
        if None in ends:
            raise ParameterError('each point needs a position or an effort')
        if not all(abs(force) <= self._force_limit for force in ends if force is not None):
            raise ParameterError(
                f'a push must be within {self._force_limit:g} N, got {list(forces)} N'
            )
        # A point at the start itself replaces the one that stands for where the base is.
        first = [] if times[0] == 0.0 else [(0.0, depth, self._force, False)]
        points = [
            (time, depth, force, True) if at is None else (time, at, 0.0, False)
            for time, at, force in zip_longest(times, depths, forces)
        ]
        columns = zip(*first, *points, strict=True)
        offsets, self._depths, self._forces, self._pushes = map(np.array, columns)
        self._times = start + offsets

    @property
    def end(self) -> float:
        """Time of the last point [s], on the clock of `speed`."""
        return float(self._times[-1])

    def push(self, time: float, depth: float, interval: float) -> float | None:
        """
        Return the force to apply over the next interval if the trajectory pushes then.

        Parameters
        ----------
        time : float
            Time now [s].
        depth : float
            Where the base is [m].
        interval : float
            Time until the next call [s].

        Returns
        -------
        float or None
            Mean force over the interval [N]; None if the base is motion controlled.

        """
        last = len(self._times) - 1
        # Rounding of the clock must not make an interval too many.
        k = int(np.searchsorted(self._times, time + 1e-6 * interval, side='right'))
        if self._pushes[min(k, last)]:
            middle = min(time + 0.5 * interval, float(self._times[min(k, last)]))
            self._force = float(np.interp(middle, self._times, self._forces))
            return self._force
        if k > 0 and self._pushes[k - 1]:
            # The push has ended: the line of inserted lengths begins here.
            self._depths[k - 1], self._pushes[k - 1] = depth, False
        self._force = 0.0
        return None

    def speed(self, time: float, depth: float, speed: float, interval: float) -> float:
        """
        Return the speed to have after the next interval to follow the trajectory.

        Parameters
        ----------
        time : float
            Time now [s].
        depth, speed : float
            Where the base is [m] and how fast [m/s].
        interval : float
            Time until the next call [s].

        Returns
        -------
        float
            Speed [m/s], reached within the limits.

        """
        limits = self.limits
        now = float(np.interp(time, self._times, self._depths))
        ahead = float(np.interp(time + interval, self._times, self._depths))
        change = limits.acceleration_limit * interval
        error = now - depth
        if ahead == now and abs(error) < _SETTLED and abs(speed) <= change:
            return 0.0
        # Close the error no faster than the base could brake; half the limit leaves a margin.
        gain = min(limits.position_gain, 1.0 / interval)
        closing = min(gain * abs(error), sqrt(limits.acceleration_limit * abs(error)))
        wanted = (ahead - now) / interval + copysign(closing, error)
        wanted = min(max(wanted, -limits.speed_limit), limits.speed_limit)
        return min(max(wanted, speed - change), speed + change)
