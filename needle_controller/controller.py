# SPDX-License-Identifier: Apache-2.0
"""Axial controller: reference, control laws and limits; one command per measurement."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, isnan, nan
from typing import Final, NamedTuple, TypeAlias

from needle_controller.gains import AllGains, AXES, completed, Gains, LAW_OF, LAWS
from needle_controller.laws.law import Axis, Law, require_complete, SampledLoop
from needle_controller.reference.generator import LONGEST_BURST, ReferenceGenerator, ReferenceHold
from needle_controller.reference.setpoint import ReferenceLimits, Setpoint
from needle_controller.safety.input_monitor import DisplacementMonitor
from needle_controller.stability import (
    check_stability,
    delay_margin,
    HIGHEST_RATE,
    Limit,
    MARGIN,
    Uncertainty,
)
from needle_dynamics import NeedleParameters
from needle_ros.contract import INSERTION, ROTATION
from needle_ros.errors import ParameterError
from needle_ros.settings import CheckedSettings, constant, flag, positive
from needle_ros.status import ControllerStatus
from needle_ros.timing import NANOSECONDS
from needle_ros.trajectories import joint_values, JointPath
from needle_ros.wire import Reading

#: Law, needle and tissue, and all gains of a controller.
_Wanted: TypeAlias = tuple[str, NeedleParameters, dict[str, dict[str, Gains]]]
#: Its laws, and its limits of stability and of the age of measurements by axis.
_Checked: TypeAlias = tuple[list[Law], dict[str, Limit], dict[str, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings(CheckedSettings):
    """Rate, delay and limits of a controller."""

    rate: float = constant(1000.0, 'Hz', 'rate of joint_states', low=1.0, high=HIGHEST_RATE)
    delay: float = constant(
        1.0, 'periods', 'number of whole periods from a measurement to the effect of its command',
        high=20.0, whole=True,
    )  # fmt: skip
    force_limit: float = positive(15.0, 'N', 'largest insertion force')
    torque_limit: float = positive(0.01, 'N m', 'largest torque')
    measurement_timeout: float = positive(0.1, 's', 'age from which a measurement is stale')
    jump: float = positive(
        2e-3,
        'm',
        'displacement, at once or within 2 s, that is inconsistent with the measured '
        'velocity and is a fault; a displacement of this size during a fault clears the target',
    )
    stability_margin: float = constant(
        MARGIN, '1', 'required relative decrease of every control error per period', high=0.5
    )
    rotation: bool = flag(
        True, 'whether the robot rotates the needle; if false, the torque is zero'
    )
    lowest_depth: float = constant(
        0.0, 'm', 'least insertion depth to control; minimum_depth if that is larger'
    )
    highest_depth: float = positive(
        10.0, 'm', 'largest insertion depth to control; the needle length if that is smaller'
    )

    @property
    def longest_gap(self) -> float:
        """Longest time between two measurements that can be compared [s]."""
        return self.measurement_timeout + 1.0 / self.rate

    def depths(self, parameters: NeedleParameters) -> tuple[float, float]:
        """Return the least and largest insertion depth to control [m]; reject an empty range."""
        low = max(self.lowest_depth, parameters.minimum_depth)
        high = min(self.highest_depth, parameters.length)
        if not low < high:
            raise ParameterError(
                f'lowest_depth and highest_depth must leave a part of '
                f'[{parameters.minimum_depth:g}, {parameters.length:g}] m, got '
                f'{self.lowest_depth:g} and {self.highest_depth:g} m'
            )
        return low, high


class BaseState(NamedTuple):
    """State of a needle base that the law controls, see `Admittance`."""

    depth: float  #: insertion depth [m]
    velocity: float  #: velocity [m/s]
    waits: bool = False  #: whether it waits for the robot that follows it
    behind: bool = False  #: whether the robot has not come to it


class Measurement(NamedTuple):
    """Readings of the encoders."""

    time: float  #: time of the sample [s]
    depth: float  #: insertion depth [m]
    velocity: float  #: insertion velocity [m/s], positive into the tissue
    angle: float = 0.0  #: rotation of the base about x [rad]
    angular_velocity: float = 0.0  #: its velocity [rad/s]
    #: Axial force on the needle as reported by the robot [N]; NaN if not reported.
    force: float = nan
    base: BaseState | None = None  #: state that the law controls, if it is not the measured one

    @property
    def behind(self) -> bool | None:
        """Whether a robot that follows positions is behind its command; None for others."""
        return None if self.base is None else self.base.behind

    @classmethod
    def from_reading(cls, reading: Reading, origin: int = 0) -> Measurement:
        """
        Convert a joint state to a measurement, with the stamp of the time zero [ns].

        `rotation` and efforts may be missing.
        """
        found = reading.joint(INSERTION)
        positions, velocities, _ = reading.values
        if found is None or min(len(positions), len(velocities)) < len(reading.names):
            raise ParameterError(
                "joint_states needs position and velocity of 'insertion', got names "
                f'{list(reading.names)}, {len(positions)} positions, {len(velocities)} velocities'
            )
        depth, velocity, force = found
        angle, angular_velocity, _ = reading.joint(ROTATION) or (0.0, 0.0, nan)
        time = (reading.stamp - origin) / NANOSECONDS
        return cls(time, depth, velocity, angle, angular_velocity, force)

    def is_finite(self) -> bool:
        """Return whether every number is finite; the force may be missing."""
        insertion = isfinite(self.depth) and isfinite(self.velocity)
        return insertion and isfinite(self.angle) and isfinite(self.angular_velocity)


NO_SETPOINT: Final = Setpoint(nan)  #: Setpoint of a command without a reference.
_REST: Final = Setpoint(0.0)  #: Setpoint of the rotation.


class ControllerOutput(NamedTuple):
    """Command of a controller in response to a measurement."""

    force: float  #: f_y [N], positive into the tissue
    torque: float = 0.0  #: tau about x [N m]
    setpoint: Setpoint = NO_SETPOINT  #: of the measurement; NaN without a reference
    fault: str | None = None  #: why no force is commanded
    notice: str | None = None  #: message for the user
    refusal: str | None = None  #: why the motion is refused and the system must stop

    def is_finite(self) -> bool:
        return isfinite(self.force) and isfinite(self.torque)


class Controller:
    """
    Drive the needle to a target depth or along a path of depths.

    Parameters
    ----------
    parameters : NeedleParameters
        Nominal needle and tissue.
    law : str
        Control law, one of `LAWS`.
    gains : Mapping[str, Mapping[str, Gains]], optional
        Gains by law and axis, such as ``{'pid': {'insertion': PidGains(kp=2000.0)}}``. Missing
        gains have the values of `DEFAULT_GAINS`.
    settings : ControllerSettings, optional
        Rate, delay and limits.
    reference : str
        Reference generator, a key of `REFERENCES`.
    limits : ReferenceLimits, optional
        Limits of the reference.
    uncertainty : Uncertainty, optional
        Uncertainty of the nominal constants; the gains must be stable within it.

    Examples
    --------
    >>> from needle_controller import Controller, Measurement
    >>> from needle_dynamics import NeedleParameters
    >>> controller = Controller(NeedleParameters.preset('phantom'))
    >>> controller.set_target(0.05)
    >>> command = controller.command(Measurement(time=0.0, depth=0.02, velocity=0.0))
    >>> command.setpoint.position
    0.02
    >>> 0.0 < command.force < 15.0
    True

    """

    def __init__(
        self,
        parameters: NeedleParameters,
        law: str = LAWS[0],
        *,
        gains: AllGains | None = None,
        settings: ControllerSettings | None = None,
        reference: str = 'trapezoid',
        limits: ReferenceLimits | None = None,
        uncertainty: Uncertainty | None = None,
    ) -> None:
        self._uncertainty = uncertainty or Uncertainty()
        self.settings = settings = settings or ControllerSettings()
        #: Sample period [s], and periods from a measurement to the effect of its command.
        self.period, self.delay = 1.0 / settings.rate, int(settings.delay)
        #: Targets, paths and pauses.
        self.guide = ReferenceGenerator(
            reference, limits or ReferenceLimits(), settings.depths(parameters)
        )
        self.law, self.parameters, self._gains = law, parameters, completed(gains or {})
        #: Stability limit of each axis, and age of measurements up to which it is stable [s].
        self.limits: dict[str, Limit]
        self.age_limits: dict[str, float]
        (insertion, rotation), self.limits, self.age_limits = self._checked(
            law, parameters, self._gains
        )
        #: Law, constants and gains of the last `check_change`, and its result or error.
        self._examined: tuple[_Wanted, _Checked | ParameterError] | None = None
        #: Ages of the last measurements, and the least of them [s]; after a gap, all but one may
        #: have waited.
        self._ages = deque([0.0] * (LONGEST_BURST + 1), maxlen=LONGEST_BURST + 1)
        self._age = 0.0
        self._insertion = SampledLoop(insertion, self.delay, settings.force_limit)
        self._rotation = SampledLoop(rotation, self.delay, settings.torque_limit)
        self._hold = ReferenceHold(self.guide, self.period, self.delay)
        self._displacement = DisplacementMonitor(settings.jump, settings.longest_gap)
        self._last_depth: float | None = None
        self.relaxed = False  #: Whether the insertion force is zero although there is a target.
        #: Check before the first motion: answers a measurement, and whether a motion is requested,
        #: with a command; None without a check.
        self.check: Callable[[Measurement, bool], ControllerOutput | None] | None = None
        self.forget()

    def _checked(self, name: str, parameters: NeedleParameters, gains: AllGains) -> _Checked:
        """Return the laws, and the limits of each axis; reject unstable gains."""
        if name not in LAWS:
            raise ParameterError(f'unknown law {name!r}; valid: {", ".join(LAWS)}')
        require_complete(parameters)
        axes = Axis.insertion(parameters), Axis.rotation(parameters)
        laws: list[Law] = []
        limits: dict[str, Limit] = {}
        ages: dict[str, float] = {}
        for axis, where in zip(axes, AXES, strict=True):
            chosen = gains[name][where]
            law = LAW_OF[type(chosen)](axis=axis, gains=chosen, period=self.period)
            laws.append(law)
            if where == 'insertion' or self.settings.rotation:
                plants = self._uncertainty.axes(axis, carriage=where == 'insertion')
                limits[where] = check_stability(
                    law,
                    self.delay,
                    f'{name}.{where} gains',
                    margin=self.settings.stability_margin,
                    plants=plants,
                )
                late = self.delay + delay_margin(law, self.delay, plants)
                ages[where] = late * self.period
        return laws, limits, ages

    def _wanted(
        self, parameters: NeedleParameters | None, law: str | None, gains: AllGains | None
    ) -> _Wanted:
        return law or self.law, parameters or self.parameters, completed(gains or {}, self._gains)

    def check_change(
        self,
        parameters: NeedleParameters | None = None,
        *,
        law: str | None = None,
        gains: AllGains | None = None,
    ) -> None:
        """Check the stability before `change`, which then takes no time; in any thread."""
        self._examined = self._examine(self._wanted(parameters, law, gains))

    def _examine(self, wanted: _Wanted) -> tuple[_Wanted, _Checked | ParameterError]:
        try:
            return wanted, self._checked(*wanted)
        except ParameterError as error:
            return wanted, error

    def change(
        self,
        parameters: NeedleParameters | None = None,
        *,
        law: str | None = None,
        gains: AllGains | None = None,
    ) -> None:
        """
        Continue with other constants, gains or another law; target, reference and memory stay.

        Missing gains stay. During a motion the switch is bumpless: the force is continuous. If the
        gains are unstable with the changes, nothing is changed.
        """
        wanted, examined = self._wanted(parameters, law, gains), self._examined
        if examined is None or examined[0] != wanted:
            examined = self._examine(wanted)
        _, found = examined
        if isinstance(found, ParameterError):
            raise found
        (insertion, rotation), self.limits, self.age_limits = found
        self.law, self.parameters, self._gains = wanted
        if self.guide.moves:
            self._insertion.switch(insertion)
            self._rotation.switch(rotation)
        else:
            self._insertion.law, self._rotation.law = insertion, rotation

    @property
    def target(self) -> float | None:
        """Target insertion depth [m]; None without a target."""
        return self.guide.target

    @property
    def learned(self) -> dict[str, tuple[float, float]]:
        """Learned correction of the insertion friction; see `SampledLoop.learned`."""
        return self._insertion.learned

    def status(self) -> ControllerStatus:
        name, limit = max(self.limits.items(), key=lambda item: item[1].radius - item[1].bound)
        return ControllerStatus(
            target=self.target,
            law=self.law,
            least_stable_axis=name,
            spectral_radius=limit.radius,
            spectral_radius_limit=limit.bound,
            learned=self.learned,
        )

    def set_target(self, depth: float) -> None:
        """Set the target insertion depth [m]; see `ReferenceGenerator.aim`."""
        self.guide.aim(depth)
        # A new target is valid, also if the needle has moved before.
        self._last_depth = None

    def follow(
        self,
        times: Sequence[float],
        positions: Sequence[float],
        velocities: Sequence[float] | None = None,
    ) -> None:
        """Follow a path of insertion depths from now on; see `ReferenceGenerator.follow`."""
        self.guide.follow(times, positions, velocities)
        self._last_depth = None

    def follow_joints(self, path: JointPath, elapsed: float) -> None:
        """Follow the insertion in a path, at a time after its start [s]; without points, stop."""
        path = path.after(elapsed)
        if path.stops:
            if path.joints:
                joint_values(INSERTION, path.joints, ())
            self.stop_motion()
            return
        depths, rates = (
            [one for one in joint_values(INSERTION, path.joints, values) if one is not None]
            for values in (path.positions, path.velocities)
        )
        self.follow(path.times, depths, rates or None)

    def stop_motion(self) -> None:
        """Brake to rest and hold; see `ReferenceGenerator.stop_motion`."""
        self.guide.stop_motion()
        self._last_depth = None

    def forget(self) -> None:
        """Discard target, motion, measurements and the memory of the laws."""
        self._discard_motion()
        self._displacement.forget()

    def _discard_motion(self) -> None:
        self.guide.forget()
        self._insertion.reset()
        self._rotation.reset()
        self._last_depth = None
        self._stopped = self.relaxed = False

    def release(self) -> None:
        """Discard the motion, freeze the integrals; the next motion starts at the needle."""
        self.guide.release()
        self._insertion.stop()
        self._rotation.stop()
        self._stopped = True

    def unwind(self) -> None:
        """Reset the integrals of the laws, for times when their force has no effect."""
        self._insertion.unwind()
        self._rotation.unwind()

    def command(
        self, measured: Measurement, load: float = 0.0, age: float = 0.0
    ) -> ControllerOutput:
        """
        Return the command that answers a measurement of an age [s], with a known load [N].

        The force is zero without a target, or on a fault of the measurement: a value is not
        finite, the displacement is inconsistent with the velocity, or this and the last four are
        older than `age_limits`, as for the torque. After a gap or a step back in time the motion
        restarts from the measured depth.
        """
        notice, guide = None, self.guide
        gap = self._displacement.gap(measured.time)
        if gap:
            if guide.moves:
                notice = f'measurements continued after {gap:.3f} s; the motion starts again'
            self.release()
        if measured.is_finite() and isfinite(load):
            fault = self._displacement.fault(measured.time, measured.depth, measured.velocity)
        else:
            fault = f'joint_states and load must be finite, got {measured}, {load:g} N'
        if fault is None:
            notice = self._returned(measured) or notice
            moves = guide.target is not None and not guide.paused
            answer = self.check(measured, moves) if self.check is not None else None
            if answer is not None:
                return answer
            if guide.target is not None:
                self._ages.append(age)
                self._age = min(self._ages)
                fault = self._too_old()
        if fault is not None:
            self.release()
        if fault is not None or guide.target is None:
            return ControllerOutput(
                force=0.0, setpoint=Setpoint(measured.depth), fault=fault, notice=notice
            )
        loop, sample = self._insertion, (measured.time, measured.velocity, measured.force)
        base = measured.base or BaseState(measured.depth, measured.velocity)
        if self._hold.measure(sample, age, loop.law.axis.coulomb):
            if self._hold.missing or self._hold.repeated:
                loop.unwind()
            else:
                # The robot holds the last force.
                loop.stop(loop.last if isnan(measured.force) else measured.force)
        now = guide.at(measured.time, base.depth, base.velocity)
        ahead = guide.ahead(measured.time + self.delay * self.period)
        torque = self._torque(measured)
        if self.relaxed:
            loop.unwind()
        force = 0.0 if self.relaxed else loop.command(base.depth, base.velocity, ahead, load)
        limited = base.waits or abs(force) >= loop.limit
        self._hold.command(now, base.depth, force, limited=limited)
        return ControllerOutput(force=force, torque=torque, setpoint=now, notice=notice)

    def _torque(self, measured: Measurement) -> float:
        if not self.settings.rotation:
            return 0.0
        if self._age > self.age_limits['rotation']:
            self._rotation.stop()
            return 0.0
        return self._rotation.command(measured.angle, measured.angular_velocity, _REST)

    def _too_old(self) -> str | None:
        """Return a line if the insertion is unstable at the age of the measurements."""
        limit = self.age_limits['insertion']
        if self._age <= limit:
            return None
        return (
            f'measurements are {1e3 * self._age:.3g} ms old, the insertion is stable up to '
            f'{1e3 * limit:.3g} ms: free the machine, lower rate, or synchronize the clocks'
        )

    def _returned(self, measured: Measurement) -> str | None:
        """Clear the target if the needle moved during a fault; return a message then."""
        last, self._last_depth = self._last_depth, measured.depth
        moved = abs(measured.depth - last) if last is not None else 0.0
        elsewhere = self._stopped and moved > self.settings.jump and self.target is not None
        self._stopped = False
        if not elsewhere:
            return None
        self._discard_motion()
        self._last_depth = measured.depth
        return f'the needle has moved by {moved:.6f} m since the fault; the target is cleared'
