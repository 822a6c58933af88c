# SPDX-License-Identifier: Apache-2.0
"""Limits of the measurements, as parameters."""

from dataclasses import dataclass

from needle_ros.settings import CheckedSettings, constant, flag


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyLimits(CheckedSettings):
    """
    Limits of the measurements; beyond them the controller stops until ``~/clear_stop``.

    The range of the paper's force sensor is 100 N and 5 N m. Friction keeps the needle of the
    presets `phantom` and `paper_mm` below 0.05 m/s at 15 N; `paper_si` has almost no friction.
    """

    speed: float = constant(
        0.1, 'm/s', 'largest insertion speed, in both directions', open_low=True
    )
    tracking_error: float = constant(
        0.01, 'm', 'largest distance of the needle from the reference', open_low=True
    )
    depth_tolerance: float = constant(
        2e-3, 'm', 'allowed insertion depth beyond lowest_depth and highest_depth'
    )
    angular_speed: float = constant(
        100.0, 'rad/s', 'largest angular speed of the base, in both directions', open_low=True
    )
    angle: float = constant(
        1000.0, 'rad', 'largest angle of the base, in both directions', open_low=True
    )
    tip_deflection: float = constant(
        0.05,
        'm',
        'largest deflection of the tip in any direction, and distance of its depth '
        'from the range of depths',
        open_low=True,
    )
    axial_load: float = constant(
        30.0, 'N', 'largest axial force on the force sensor, in both directions', open_low=True
    )
    lateral_load: float = constant(
        10.0, 'N', 'largest lateral force on the force sensor, in any direction', open_low=True
    )
    moment_load: float = constant(
        1.0, 'N m', 'largest bending moment on the force sensor, in any direction', open_low=True
    )
    torsion_load: float = constant(
        1.0, 'N m', 'largest torque about the needle on the force sensor, in both directions',
        open_low=True,
    )  # fmt: skip
    tip_jump: float = constant(
        0.02, 'm', 'change of tip_deflection between two samples that is a sensor fault',
        open_low=True,
    )  # fmt: skip
    lateral_jump: float = constant(
        5.0, 'N', 'change of the lateral force between two samples that is a sensor fault',
        open_low=True,
    )  # fmt: skip
    moment_jump: float = constant(
        0.5, 'N m', 'change of the moment between two samples that is a sensor fault',
        open_low=True,
    )  # fmt: skip
    sensor_timeout: float = constant(
        1.0, 's', 'age at which base_wrench and tip_deflection are stale; time without a '
        'reading, or without a change of a noisy reading, that is reported',
        open_low=True, high=3600.0,
    )  # fmt: skip
    sensors_required: bool = flag(
        False, 'stop when base_wrench or tip_deflection, which the observer expects, are stale; '
        'else the observer continues without them',
    )  # fmt: skip
