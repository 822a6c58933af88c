# SPDX-License-Identifier: Apache-2.0
"""Inputs of a controller, limits of measurements, the latched stop, duplicate publishers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import hypot, isnan, nan
from operator import le
from typing import Final

from needle_controller.controller import ControllerSettings, Measurement
from needle_controller.safety.input_monitor import InputMonitor
from needle_dynamics import euler_loads, NeedleParameters
from needle_ros.contract import BASE, ENTRY
from needle_ros.settings import CheckedSettings, constant, flag, positive
from needle_ros.status import ControllerStatus
from needle_ros.timing import NANOSECONDS, RateCounter

_IN_A_ROW: Final = 2  #: Readings in a row that violate a limit: one may be a sensor fault.

#: By topic: quantity, unit and name of the limit of each reading.
_READINGS: Final = {
    'joint_states': (
        ('insertion speed', 'm/s', 'speed'), ('angle', 'rad', 'angle'),
        ('angular speed', 'rad/s', 'angular_speed'),
    ),
    'reference': (
        ('tracking error', 'm', 'tracking_error'),
        ('motion away from the target', 'm', 'tracking_error'),
    ),
    'base_wrench': (
        ('axial force', 'N', 'axial_load'), ('lateral force', 'N', 'lateral_load'),
        ('moment', 'N m', 'moment_load'), ('torque about the needle', 'N m', 'torsion_load'),
    ),
    'tip_deflection': (
        ('tip deflection', 'm', 'tip_deflection'),
        ('distance of the tip from the depth range', 'm', 'tip_deflection'),
    ),
}  # fmt: skip

_SENSORS: Final = ('base_wrench', 'tip_deflection')
_VITAL: Final = ('wrench_command', 'joint_states')  #: Topics that need exactly one publisher.
_LATE: Final = 0.5  #: Fraction of messages out of order for a warning.
_MIXED: Final = 0.9  #: Fraction of messages out of order for a stop.
_FEW: Final = 10.0  #: Least rate for both [Hz].


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyLimits(CheckedSettings):
    """
    Limits of the measurements; beyond them the controller stops until ``~/clear_stop``.

    The range of the paper's force sensor is 100 N and 5 N m. Friction keeps the needle of the
    presets `phantom` and `paper_mm` below 0.05 m/s at 15 N; `paper_si` has almost no friction.
    """

    speed: float = positive(0.1, 'm/s', 'largest insertion speed, in both directions')
    tracking_error: float = positive(
        0.01, 'm', 'largest distance of the needle from the reference'
    )
    depth_tolerance: float = constant(
        2e-3, 'm', 'allowed insertion depth beyond lowest_depth and highest_depth'
    )
    angular_speed: float = positive(
        100.0, 'rad/s', 'largest angular speed of the base, in both directions'
    )
    angle: float = positive(1000.0, 'rad', 'largest angle of the base, in both directions')
    tip_deflection: float = positive(
        0.05,
        'm',
        'largest deflection of the tip in any direction, and distance of its depth '
        'from the range of depths',
    )
    axial_load: float = positive(
        30.0, 'N', 'largest axial force on the force sensor, in both directions'
    )
    lateral_load: float = positive(
        10.0, 'N', 'largest lateral force on the force sensor, in any direction'
    )
    moment_load: float = positive(
        1.0, 'N m', 'largest bending moment on the force sensor, in any direction'
    )
    torsion_load: float = positive(
        1.0, 'N m', 'largest torque about the needle on the force sensor, in both directions'
    )
    tip_jump: float = positive(
        0.02, 'm', 'change of tip_deflection between two samples that is a sensor fault'
    )
    lateral_jump: float = positive(
        5.0, 'N', 'change of the lateral force between two samples that is a sensor fault'
    )
    moment_jump: float = positive(
        0.5, 'N m', 'change of the moment between two samples that is a sensor fault'
    )
    sensor_timeout: float = positive(
        1.0,
        's',
        'age at which base_wrench and tip_deflection are stale; time without a '
        'reading, or without a change of a noisy reading, that is reported',
        high=3600.0,
    )
    sensors_required: bool = flag(
        False, 'stop when base_wrench, or tip_deflection of the observer, is stale or rejected; '
        'else the controller continues without it',
    )  # fmt: skip


class Guard:
    """
    Compare measurements with the limits; two readings in a row beyond a limit violate it.

    ``depths`` are the least and largest insertion depth to control [m]. Each check returns the
    description of a violated limit, or None.
    """

    def __init__(self, limits: SafetyLimits, depths: tuple[float, float]) -> None:
        #: Limits of `_READINGS`.
        self._limits = {
            'joint_states': (limits.speed, limits.angle, limits.angular_speed),
            'reference': (limits.tracking_error, limits.tracking_error),
            'base_wrench': (
                limits.axial_load, limits.lateral_load, limits.moment_load, limits.torsion_load
            ),
            'tip_deflection': (limits.tip_deflection, limits.tip_deflection),
        }  # fmt: skip
        low, high = depths
        self._depths = low - limits.depth_tolerance, high + limits.depth_tolerance
        #: By topic: description of the limit, and readings in a row beyond it.
        self._beyond: dict[str, tuple[str, int]] = {}

    def _hold(self, topic: str, *values: float) -> str | None:
        limits = self._limits[topic]
        # Written so that NaN is beyond every limit.
        if all(map(le, map(abs, values), limits)):
            self._beyond.pop(topic, None)
            return None
        compared = zip(values, limits, _READINGS[topic], strict=True)
        value, limit, (quantity, unit, name) = next(
            one for one in compared if not abs(one[0]) <= one[1]
        )
        return self._count(
            topic,
            f'{quantity} {value:.6g} {unit} is beyond the limit of {limit:g} {unit} '
            f'(safety.{name})',
        )

    def _count(self, topic: str, line: str) -> str | None:
        count = self._beyond.get(topic, ('', 0))[1] + 1
        self._beyond[topic] = line, count
        return line if count >= _IN_A_ROW else None

    def is_beyond(self, topic: str) -> bool:
        """Return whether the last reading of a topic is beyond a limit, also a single reading."""
        return topic in self._beyond

    def encoders(self, measured: Measurement) -> str | None:
        """Check insertion depth, angle and their velocities."""
        low, high = self._depths
        depth = measured.depth
        if not low <= depth <= high:
            return self._count(
                'joint_states',
                f'insertion depth {depth:.6g} m is outside [{low:g}, {high:g}] m '
                '(lowest_depth, highest_depth, safety.depth_tolerance)',
            )
        return self._hold(
            'joint_states', measured.velocity, measured.angle, measured.angular_velocity
        )

    def tracking(self, error: float, receded: float = 0.0) -> str | None:
        """Check the distance from the reference, and the motion away from the target [m]."""
        return self._hold('reference', error, receded)

    def wrench(self, force: Sequence[float], torque: Sequence[float]) -> str | None:
        """Check force [N] and torque [N m] along x, y (needle) and z; NaN counts as zero."""
        values = [0.0 if isnan(one) else one for one in (*force, *torque)]
        x, axial, z, around_x, torsion, around_z = values
        lateral, moment = hypot(x, z), hypot(around_x, around_z)
        return self._hold('base_wrench', axial, lateral, moment, torsion)

    def tip(self, deflection: float, depth: float = nan, lateral: float = 0.0) -> str | None:
        """Check the position of the tip along z, y and x [m]; NaN if it is not measured."""
        low, high = self._depths
        # Zero first: the maximum ignores NaN after it.
        outside = max(0.0, low - depth, depth - high)
        across = hypot(deflection, 0.0 if isnan(lateral) else lateral)
        return self._hold('tip_deflection', across, outside)

    def forget(self, topic: str) -> None:
        """Discard the last reading of a topic."""
        self._beyond.pop(topic, None)

    @property
    def violated(self) -> str | None:
        """Description of the last reading beyond a limit; None without one."""
        return next((line for line, _ in self._beyond.values()), None)


class FaultKind(Enum):
    """Kind of a fault: no force is commanded, or the reference waits."""

    STOP = 'stop'
    WAITING = 'no measurement yet'
    CLOCK = 'clock'
    INPUT = 'joint_states'
    PUBLISHERS = 'duplicate publishers'
    CONTROL = 'control'
    RESPONSE = 'response'


class Safety:
    """
    Conditions for a force command: valid inputs, limits, no latched stop, one publisher per topic.

    `expected` are the topics that must be published continuously, as must those of `noise`: the
    noise of the sensor values by topic. `wrench_frame` is the frame of the force sensor. With
    `simulated` time a message may arrive before the /clock of its stamp.
    """

    def __init__(
        self,
        limits: SafetyLimits,
        settings: ControllerSettings,
        parameters: NeedleParameters,
        *,
        expected: Sequence[str] = (),
        noise: Mapping[str, Sequence[float]] | None = None,
        wrench_frame: str = BASE,
        simulated: bool = False,
    ) -> None:
        self.limits = limits
        self.stop: str | None = None  #: Reason of the latched stop.
        self.stops = 0  #: Number of stops so far.
        #: Topics with duplicate publishers of commands or measurements.
        self.duplicate_publishers: str | None = None
        self.guard = Guard(limits, settings.depths(parameters))
        self._settings, self._parameters = settings, parameters
        self.saturation = RateCounter()
        noise = noise or {}
        #: Timeout, valid frames and implausible changes of each input.
        inputs: dict[str, tuple[float, tuple[str, ...], tuple[float, ...]]] = {
            'joint_states': (settings.measurement_timeout, (), ()),
            'ground_truth': (settings.measurement_timeout, (), ()),
            'base_wrench': (
                limits.sensor_timeout,
                (wrench_frame,),
                (limits.lateral_jump, limits.moment_jump),
            ),
            'tip_deflection': (limits.sensor_timeout, (ENTRY,), (limits.tip_jump,)),
        }
        # A stamp in the future would make the stamps of the true source late.
        ahead = settings.measurement_timeout if simulated else 1.0 / settings.rate
        self.streams = {
            name: InputMonitor(
                name, timeout, frames=frames, jumps=jumps, noise=noise.get(name, ()), ahead=ahead
            )
            for name, (timeout, frames, jumps) in inputs.items()
        }
        required = ['base_wrench'] if limits.sensors_required else []
        self._expected = {*expected, *noise, *required}
        #: Start of encoder measurements without a gap [ns]; 0: no /clock yet.
        self._begun: int | None = None
        self._stale: set[str] = set()

    def begin(self, now: int) -> None:
        """Discard all readings, and expect new readings from a time [ns] on; a stop stays."""
        self._begun = now or None
        self._stale.clear()
        for stream in self.streams.values():
            stream.forget()
            self.guard.forget(stream.name)
        self.guard.forget('reference')

    @property
    def watch_period(self) -> float:
        """Longest time between two checks for missing inputs [s]."""
        return min(0.1, 0.5 * self.streams['joint_states'].timeout / NANOSECONDS)

    def latch(self, reason: str) -> None:
        """Latch a stop for a reason; the first reason stays."""
        if self.stop is not None:
            return
        self.stop = reason
        self.stops += 1
        # A stop discards the reference, and so the tracking error.
        self.guard.forget('reference')

    def clear(self, now: int) -> str | None:
        """Release the stop, or return why not; see `obstacle`."""
        reason = self.obstacle(now)
        if reason is None:
            self.stop = None
        return reason

    def obstacle(self, now: int) -> str | None:
        for stream in self.streams.values():
            # Readings from before the silence are outdated.
            if not stream.is_current(now):
                self.guard.forget(stream.name)
        return self.guard.violated or self.missing(now)

    def missing(self, now: int) -> str | None:
        """Return the warning if the sensors are required."""
        return self.warning(now) if self.limits.sensors_required else None

    def check_force(self, stamp: int, depth: float, force: float, torque: float) -> str | None:
        """Count a command at its limit; return a warning if its force bends the free part."""
        limits = self._settings
        full = abs(force) >= limits.force_limit or abs(torque) >= limits.torque_limit
        self.saturation.add(stamp, full)
        most = euler_loads(self._parameters, max(depth, 0.0)).pinned
        if force <= most:
            return None
        return (
            f"{force:.3g} N exceeds Euler's load {most:.3g} N of the part outside of the tissue: "
            'without a guide it buckles; lower force_limit'
        )

    def count_publishers(self, publishers: Mapping[str, int]) -> None:
        """Set the number of publishers by topic, including this controller."""
        for name, count in publishers.items():
            if name in self.streams:
                self.streams[name].publishers = count
        vital = (
            f'{count} nodes publish {name}'
            for name, count in publishers.items()
            if count > 1 and name in _VITAL
        )
        self.duplicate_publishers = ', '.join(vital) or None

    def mixed_sources(self, now: int) -> str | None:
        """Return a fault if nearly all encoder messages are out of order (several sources)."""
        window = self.streams['joint_states'].window
        share = window.share(now)
        if share <= _MIXED or window.rate(now) < _FEW:
            return None
        return f'joint_states has {share:.0%} of its messages out of order'

    def _silent(self, now: int) -> dict[str, str]:
        """Return a line for each sensor without valid messages while the encoders have some."""
        joints = self.streams['joint_states']
        if joints.counted is None or now - joints.counted > joints.timeout:
            self._begun = now or None
            return {}
        begun = self._begun = self._begun or joints.counted
        lines = {}
        for name in _SENSORS:
            stream = self.streams[name]
            silence = (now - max(stream.counted or 0, begun)) / NANOSECONDS
            rejected = stream.refused and stream.window.rate(now) > 0.0
            if silence > self.limits.sensor_timeout and (rejected or name in self._expected):
                lines[name] = stream.stale(silence)
        return lines

    def new_warnings(self, now: int) -> dict[str, str]:
        """Return a line for each sensor that has become stale since the last call."""
        silent = self._silent(now)
        lines = {name: line for name, line in silent.items() if name not in self._stale}
        self._stale = set(silent)
        return lines

    def warning(self, now: int) -> str | None:
        """Return the sensors that are stale or frozen, and the topics out of order."""
        frozen = (
            f'{name} has not changed for {self.limits.sensor_timeout:g} s'
            for name in _SENSORS
            if self.streams[name].frozen
        )
        silent = {
            name: line for name, line in self._silent(now).items() if not self.streams[name].frozen
        }
        late = (
            f'{name} has {share:.0%} of its messages out of order'
            for name, stream in self.streams.items()
            if (share := stream.window.share(now)) > _LATE and stream.window.rate(now) >= _FEW
        )
        return '; '.join((*frozen, *silent.values(), *late)) or None

    def status(self, status: ControllerStatus, now: int) -> ControllerStatus:
        return replace(
            status,
            stop=self.stop or '',
            stops=self.stops,
            duplicate_publishers=self.duplicate_publishers or '',
            command_rate=self.saturation.rate(now),
            saturated_fraction=self.saturation.share(now),
            input={name: one.status(now) for name, one in self.streams.items() if one.counts},
        )
