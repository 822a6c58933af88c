"""The plant as an object: needle, base and force sensor advanced one sample at a time."""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, sqrt
from typing import Final

from needle_dynamics.errors import ParameterError
from needle_dynamics.force_sensor import ForceSensor
from needle_dynamics.integrators import Integrator
from needle_dynamics.kernels import FloatArray
from needle_dynamics.parameters import check_constants, constant
import numpy as np

#: Error at the end of a trajectory with which the base is content to rest [m].
_SETTLED: Final = 1e-8


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseParameters:
    """Limits of a motion-controlled base: the robot that carries the needle."""

    speed_limit: float = constant(0.05, 'm/s', 'highest speed of the base', open_low=True)
    acceleration_limit: float = constant(
        0.5, 'm/s^2', 'highest acceleration of the base', open_low=True
    )
    position_gain: float = constant(
        20.0, '1/s', 'rate at which the base closes a position error', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)


class BaseMotion:
    """
    A base that follows a trajectory of inserted lengths within its limits.

    Parameters
    ----------
    parameters : BaseParameters
        Limits.
    depth : float
        Inserted length to hold until a trajectory comes [m].
    reach : tuple of float
        Least and largest inserted length [m].

    """

    def __init__(
        self, parameters: BaseParameters, depth: float, reach: tuple[float, float]
    ) -> None:
        self._limits = parameters
        self._range = reach
        self._times = np.array([0.0])
        self._depths = np.array([depth])

    def follow(self, start: float, depth: float, times: FloatArray, depths: FloatArray) -> None:
        """
        Take a new trajectory, straight lines in time between its points.

        Parameters
        ----------
        start : float
            Time at which it begins [s], on the clock of `speed`.
        depth : float
            Inserted length at that time [m].
        times : ndarray, shape (n,)
            Times of the points from the start [s], increasing from zero or later.
        depths : ndarray, shape (n,)
            Inserted lengths [m].

        Raises
        ------
        ParameterError
            If times do not increase, or a depth is out of reach or not finite.

        """
        if times.shape != depths.shape or times.size == 0:
            raise ParameterError(
                f'trajectory needs as many times as depths, got {times.size} and {depths.size}'
            )
        if not (np.isfinite(times).all() and np.isfinite(depths).all()):
            raise ParameterError('trajectory must be finite')
        if times[0] < 0.0 or (np.diff(times) <= 0.0).any():
            raise ParameterError(
                f'trajectory times must be >= 0 and increasing, got {times.tolist()} s'
            )
        low, high = self._range
        if depths.min() < low or depths.max() > high:
            raise ParameterError(
                f'trajectory must stay in [{low:g}, {high:g}] m, got {depths.tolist()} m'
            )
        if times[0] > 0.0:
            times, depths = np.append(0.0, times), np.append(depth, depths)
        self._times, self._depths = start + times, depths

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
        limits = self._limits
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """
    What the plant shows at the end of one sample interval.

    Attributes
    ----------
    state : ndarray, shape (8,)
        Whole state.
    depth, speed : float
        Inserted length [m] and insertion speed [m/s].
    force : float
        True axial force of the base on the needle [N], positive into the tissue.
    wrench : ndarray, shape (6,)
        Reading of the base sensor: force x y z [N], torque x y z [N m].
    tip_deflection : float
        Mean deflection of the tip over the interval [m].

    """

    state: FloatArray
    depth: float
    speed: float
    force: float
    wrench: FloatArray
    tip_deflection: float


class Plant:
    """
    The needle under a commanded wrench, or carried by a motion-controlled base.

    Parameters
    ----------
    integrator : Integrator
        The needle in its tissue.
    sensor : ForceSensor
        Sensor at the needle base.
    rate : float
        Samples per second [Hz].
    base : BaseMotion, optional
        The robot that moves the base; without it the commanded wrench does.

    """

    def __init__(
        self,
        integrator: Integrator,
        sensor: ForceSensor,
        rate: float,
        base: BaseMotion | None = None,
    ) -> None:
        self.integrator = integrator
        self.base = base
        self.interval = 1.0 / rate
        self.time = 0.0
        self._sensor = sensor
        self._count = 0

    def advance(self, force: float = 0.0, torque: float = 0.0) -> Sample:
        """
        Advance by one sample interval.

        Parameters
        ----------
        force : float
            Commanded insertion force [N]; not used when a base moves the needle.
        torque : float
            Commanded torque about x [N m]; likewise.

        Returns
        -------
        Sample
            What the sensors report at the end of the interval.

        Raises
        ------
        InsertedLengthError
            If the needle left the tissue.

        """
        needle = self.integrator
        if self.base is None:
            seen = needle.advance(self.interval, force, torque)
        else:
            speed = self.base.speed(self.time, needle.depth, needle.speed, self.interval)
            seen = needle.advance_moved(self.interval, speed)
        self._count += 1
        self.time = self._count * self.interval
        wrench = np.array([0.0, seen.axial_force, seen.lateral_force, seen.moment, 0.0, 0.0])
        state = needle.state
        return Sample(
            state=state,
            depth=needle.depth,
            speed=needle.speed,
            force=seen.axial_force,
            wrench=self._sensor.measure(wrench),
            tip_deflection=seen.tip_deflection,
        )
