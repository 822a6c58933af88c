"""The plant as an object: needle, base and force sensor advanced one sample at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, zip_longest
from math import ceil, copysign, inf, sqrt
from statistics import fmean
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.friction import Friction
from needle_dynamics.simulated.force_sensor import ForceSensor
from needle_dynamics.simulated.integrators import Integrator, Interval
from needle_ros.errors import (
    JobError,
    ParameterError,
)
from needle_ros.settings import check_constants, constant
import numpy as np

#: Error at the end of a trajectory with which the base is content to rest [m].
_SETTLED: Final = 1e-8

#: Parts of a sample interval in each of which the force of a push is constant: friction lets the
#: speed follow it at once, and a speed of now beside a mean force would be half an interval late.
_PUSHES: Final = 4

#: Speed below which the sensor may be zeroed [m/s].
AT_REST: Final = 1e-6


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


def joint_values(
    joint: str, joints: Sequence[str], values: Sequence[Sequence[float]]
) -> list[float | None]:
    """
    Pick one joint from the points of a trajectory.

    Parameters
    ----------
    joint : str
        Name of the joint.
    joints : sequence of str
        Names of all joints of the trajectory.
    values : sequence of sequence of float
        Values of the joints at each point; may be empty.

    Returns
    -------
    list of float or None
        Value of the joint at each point, None where it has none.

    Raises
    ------
    ParameterError
        If the joint is not among them.

    """
    if joint not in joints:
        raise ParameterError(f'needs the joint {joint!r}, got {list(joints)}')
    index = list(joints).index(joint)
    return [float(point[index]) if len(point) > index else None for point in values]


def check_times(times: Sequence[float]) -> None:
    """Refuse a trajectory without points, or whose times do not increase from zero or later."""
    if not times:
        raise ParameterError('trajectory has no points')
    if times[0] < 0.0 or any(late <= early for early, late in pairwise(times)):
        raise ParameterError(f'trajectory times must be >= 0 and increasing, got {list(times)} s')


def on_grid(value: float, resolution: float) -> float:
    """Return the nearest whole multiple of a resolution; a resolution of zero leaves the value."""
    return round(value / resolution) / (1.0 / resolution) if resolution > 0.0 else value


def _friction_gained(friction: Friction, before: float, after: float) -> float:
    """
    Return the friction at the end of an evenly accelerated interval over that of its middle.

    The mean over the interval would be the force of half an interval ago, beside a speed of now.
    """
    if after == 0.0:
        return 0.0
    return friction.force(after, 0.0) - friction.force(0.5 * (before + after), 0.0)


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

    """

    def __init__(
        self,
        parameters: BaseParameters,
        depth: float,
        reach: tuple[float, float],
        force_limit: float = inf,
    ) -> None:
        self.limits = parameters
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
                f'trajectory must stay in [{low:g}, {high:g}] m, got {list(depths)} m'
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


@dataclass(frozen=True, slots=True, kw_only=True)
class TipParameters:
    """What sees the tip: a tracker or imager, exposed all the time from one sample to the next."""

    rate: float = constant(0.0, 'Hz', 'samples per second; 0: one with every sample of the plant')
    noise: float = constant(1e-4, 'm', 'standard deviation of a sample')
    delay: float = constant(0.0, 's', 'time from a sample to its message', high=1.0)

    def __post_init__(self) -> None:
        check_constants(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class TipReading:
    """
    A sample of the tip as it leaves its sensor.

    Attributes
    ----------
    age : int
        Samples of the plant since the end of its exposure.
    depth : float
        Inserted length then [m].
    deflection : float
        Mean deflection of the tip over the exposure, with noise [m].

    """

    age: int
    depth: float
    deflection: float


class TipSensor:
    """
    Turns mean deflections of the tip into what its sensor reports, and when.

    Parameters
    ----------
    parameters : TipParameters
        Constants.
    rate : float
        Samples per second of the plant [Hz].
    seed : int
        Seed of the noise.

    Raises
    ------
    ParameterError
        If the plant's rate is not a whole multiple of the sensor's.

    """

    def __init__(self, parameters: TipParameters, rate: float, seed: int) -> None:
        self._noise = parameters.noise
        self._every = round(rate / parameters.rate) if parameters.rate else 1
        if parameters.rate and abs(self._every * parameters.rate - rate) > 1e-6 * rate:
            raise ParameterError(
                f'tip.rate must divide the rate of the plant {rate:g} Hz, got '
                f'{parameters.rate:g} Hz'
            )
        # A message leaves with the first sample of the plant that is late enough.
        self._late = ceil(parameters.delay * rate * (1.0 - 1e-9))
        self._random = np.random.default_rng([seed, 1])
        self._sum = 0.0
        self._count = 0
        self._waiting: deque[tuple[int, float, float]] = deque()

    def measure(self, depth: float, deflection: float) -> TipReading | None:
        """
        Take in a sample of the plant.

        Parameters
        ----------
        depth : float
            Inserted length now [m].
        deflection : float
            Mean deflection of the tip since the sample before [m].

        Returns
        -------
        TipReading or None
            What leaves the sensor now.

        """
        self._count += 1
        self._sum += deflection
        if self._count % self._every == 0:
            value = self._sum / self._every
            if self._noise:
                value += self._noise * float(self._random.standard_normal())
            self._waiting.append((self._count, depth, value))
            self._sum = 0.0
        if not self._waiting or self._count - self._waiting[0][0] < self._late:
            return None
        taken, at, value = self._waiting.popleft()
        return TipReading(age=self._count - taken, depth=at, deflection=value)


class Sample(NamedTuple):
    """
    What the plant shows at the end of one sample interval.

    Attributes
    ----------
    state : ndarray, shape (8,)
        Whole state.
    depth, speed : float
        Inserted length [m] and insertion speed [m/s].
    joint_position : float
        Inserted length as the encoder has it [m].
    force : float
        True axial force of the base on the needle [N], positive into the tissue.
    wrench : ndarray, shape (6,)
        Reading of the base sensor: force x y z [N], torque x y z [N m].
    tip_deflection : float
        Mean deflection of the tip over the interval [m].
    tip : TipReading or None
        What the sensor of the tip reports now.

    """

    state: FloatArray
    depth: float
    speed: float
    joint_position: float
    force: float
    wrench: FloatArray
    tip_deflection: float
    tip: TipReading | None


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
    tip : TipSensor, optional
        Sensor of the tip; without it one that is perfect.

    """

    def __init__(
        self,
        integrator: Integrator,
        sensor: ForceSensor,
        rate: float,
        base: BaseMotion | None = None,
        tip: TipSensor | None = None,
    ) -> None:
        self.integrator = integrator
        self.base = base
        self.interval = 1.0 / rate
        self.time = 0.0
        self._sensor = sensor
        self._tip = tip or TipSensor(TipParameters(noise=0.0), rate, 0)
        self._felt = np.zeros((sensor.samples, 6))
        self._count = 0

    @property
    def report(self) -> dict[str, object]:
        """Where the needle is, for people."""
        return {'inserted length [m]': f'{self.integrator.depth:.6f}'}

    def follow(
        self,
        joints: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        efforts: Sequence[Sequence[float]],
    ) -> None:
        """
        Have the base follow a trajectory of the joint `insertion`, from now.

        Parameters
        ----------
        joints : sequence of str
            Names of the joints.
        times : sequence of float
            Time of each point from now [s].
        positions, efforts : sequence of sequence of float
            Inserted length [m] of each point, or force [N] where a push ends.

        Raises
        ------
        ParameterError
            If there is no base, or it cannot follow.

        """
        if self.base is None:
            raise ParameterError('is followed in the modes robot and indenter only')
        self.base.follow(
            self.time,
            self.integrator.depth,
            times,
            joint_values('insertion', joints, positions),
            joint_values('insertion', joints, efforts),
        )

    def tare(self) -> None:
        """
        Zero the sensor on the mean of its latest readings.

        Raises
        ------
        JobError
            If the needle moves, or has not rested long enough.

        """
        speed = self.integrator.speed
        if abs(speed) > AT_REST:
            raise JobError(f'the needle moves at {1e3 * speed:.3g} mm/s; it must rest')
        self._sensor.tare()

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
        needle, base, interval = self.integrator, self.base, self.interval
        resolution = late = 0.0
        if base is None:
            seen = needle.advance(interval, force, torque, parts=self._sensor.samples)
        else:
            resolution = base.limits.encoder_resolution
            push = base.push(self.time, needle.depth, interval / _PUSHES)
            if push is None:
                before = needle.speed
                speed = base.speed(self.time, needle.depth, before, interval)
                seen = needle.advance_moved(interval, speed)
                late = _friction_gained(needle.model.friction, before, needle.speed)
            else:
                seen, late = self._pushed(base, push)
        self._count += 1
        self.time = self._count * interval
        axial = seen.axial_force + late
        start = None
        if base is None:
            wrench = self._felt
            wrench[:, 1:4] = seen.felt
        else:
            # Force and speed that are recorded beside each other shall be of one instant.
            wrench, start = np.zeros((2, 6))
            wrench[1:4] = start[1:4] = axial, seen.lateral_force, seen.moment
            start[1] -= 2.0 * late
        depth, speed = needle.depth, needle.speed
        return Sample(
            state=needle.state,
            depth=depth,
            speed=speed,
            joint_position=on_grid(depth, resolution),
            force=axial,
            wrench=self._sensor.measure(wrench, start=start, moving=abs(speed) > AT_REST),
            tip_deflection=seen.tip_deflection,
            tip=self._tip.measure(depth, seen.tip_deflection),
        )

    def _pushed(self, base: BaseMotion, force: float) -> tuple[Interval, float]:
        """Push, as the force changes; return means and what it is more at the end."""
        needle, part = self.integrator, self.interval / _PUSHES
        limit = base.limits.speed_limit
        parts = [needle.advance_pushed(part, force, limit)]
        for k in range(1, _PUSHES):
            push = base.push(self.time + k * part, needle.depth, part)
            force = force if push is None else push
            parts.append(needle.advance_pushed(part, force, limit))
        rise = (parts[-1].axial_force - parts[0].axial_force) * _PUSHES / (_PUSHES - 1)
        means = replace(
            parts[-1],
            tip_deflection=fmean(one.tip_deflection for one in parts),
            axial_force=fmean(one.axial_force for one in parts),
            lateral_force=fmean(one.lateral_force for one in parts),
            moment=fmean(one.moment for one in parts),
        )
        return means, 0.5 * rise
