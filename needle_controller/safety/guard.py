# SPDX-License-Identifier: Apache-2.0
"""Comparison of measurements with their limits."""

from collections.abc import Sequence
from math import hypot, isnan, nan
from operator import le
from typing import Final

from needle_controller.controller import Measurement
from needle_controller.safety.limits import SafetyLimits
from needle_dynamics import euler_loads, NeedleParameters

_IN_A_ROW: Final = 2  #: Readings in a row that violate a limit: one may be a sensor fault.

#: By topic: quantity, unit and name of the limit of each reading.
_READINGS: Final = {
    'joint_states': (
        ('insertion speed', 'm/s', 'speed'), ('angle', 'rad', 'angle'),
        ('angular speed', 'rad/s', 'angular_speed'),
    ),
    'reference': (('tracking error', 'm', 'tracking_error'),),
    'base_wrench': (
        ('axial force', 'N', 'axial_load'), ('lateral force', 'N', 'lateral_load'),
        ('moment', 'N m', 'moment_load'), ('torque about the needle', 'N m', 'torsion_load'),
    ),
    'tip_deflection': (
        ('tip deflection', 'm', 'tip_deflection'),
        ('distance of the tip from the depth range', 'm', 'tip_deflection'),
    ),
}  # fmt: skip


def buckling_warning(parameters: NeedleParameters, depth: float, force: float) -> str | None:
    """Return a warning if a force [N] bends the part outside of the tissue, without a guide."""
    most = euler_loads(parameters, max(depth, 0.0)).pinned
    if force <= most:
        return None
    return (
        f"{force:.3g} N exceeds Euler's load {most:.3g} N of the part outside of the tissue: "
        'without a guide it buckles; lower force_limit'
    )


def _measured(value: float) -> float:
    return 0.0 if isnan(value) else value


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
            'reference': (limits.tracking_error,),
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

    def tracking(self, error: float) -> str | None:
        """Check the distance from the reference [m]."""
        return self._hold('reference', error)

    def wrench(self, force: Sequence[float], torque: Sequence[float]) -> str | None:
        """Check force [N] and torque [N m] along x, y (needle) and z; NaN counts as zero."""
        x, axial, z = map(_measured, force)
        around_x, torsion, around_z = map(_measured, torque)
        lateral, moment = hypot(x, z), hypot(around_x, around_z)
        return self._hold('base_wrench', axial, lateral, moment, torsion)

    def tip(self, deflection: float, depth: float = nan, lateral: float = 0.0) -> str | None:
        """Check the position of the tip along z, y and x [m]; NaN if it is not measured."""
        low, high = self._depths
        outside = max(_measured(low - depth), _measured(depth - high), 0.0)
        across = hypot(deflection, _measured(lateral))
        return self._hold('tip_deflection', across, outside)

    def forget(self, topic: str) -> None:
        """Discard the last reading of a topic."""
        self._beyond.pop(topic, None)

    @property
    def violated(self) -> str | None:
        """Description of the last reading beyond a limit; None without one."""
        return next((line for line, _ in self._beyond.values()), None)
