# SPDX-License-Identifier: Apache-2.0
"""Limits of the measurements, as parameters."""

from dataclasses import dataclass

from needle_ros.settings import CheckedSettings, constant, flag, positive


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
        False, 'stop when base_wrench or tip_deflection, which the observer expects, are stale; '
        'else the observer continues without them',
    )  # fmt: skip
