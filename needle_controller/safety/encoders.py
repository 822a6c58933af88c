# SPDX-License-Identifier: Apache-2.0
"""Encoder measurements of the needle from joint states."""

from math import nan

from needle_controller.controller import Measurement
from needle_ros.errors import ParameterError
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading


def read_encoders(reading: Reading) -> Measurement:
    """Convert a joint state to a measurement; `rotation` and efforts may be missing."""
    names, (positions, velocities, efforts) = reading.names, reading.values
    try:
        i = names.index('insertion')
        depth, velocity = positions[i], velocities[i]
        angle = angular_velocity = 0.0
        if 'rotation' in names:
            j = names.index('rotation')
            angle, angular_velocity = positions[j], velocities[j]
    except (ValueError, IndexError):
        raise ParameterError(
            f"joint_states needs position and velocity of 'insertion', got names {list(names)}, "
            f'{len(positions)} positions, {len(velocities)} velocities'
        ) from None
    return Measurement(
        time=reading.stamp / NANOSECONDS,
        depth=depth,
        velocity=velocity,
        angle=angle,
        angular_velocity=angular_velocity,
        force=efforts[i] if i < len(efforts) else nan,
    )
