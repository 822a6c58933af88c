# SPDX-License-Identifier: Apache-2.0
"""Prior uncertainty of needle, tissue, path and sensor for a steering law."""

from dataclasses import dataclass

from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.settings import CheckedSettings, constant, same_field


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringPrior(CheckedSettings):
    """Prior uncertainty of needle, tissue, guide, path and sensor."""

    spread: float = constant(
        0.3, '1', 'relative uncertainty of the bending length; 0: bending length and skin known',
        high=0.9,
    )  # fmt: skip
    skin: float = constant(
        0.06, 'm',
        'largest stiffness of the skin relative to that of the tissue; 0: the nominal one',
    )  # fmt: skip
    tilt: float = constant(0.04, 'rad', 'standard deviation of the tilt of the guide')
    frame: float = constant(
        0.06, 'rad', 'standard deviation of the rotation between the frames of guide and sensor'
    )
    bevel: float = constant(0.3, 'N', 'standard deviation of the lateral load of the bevel')
    offset: float = constant(1e-3, 'm', 'standard deviation of the origin of the sensor')
    path_noise: float = constant(
        1e-4, 'rad^2/m', 'least growth of the variance of the path direction per length; up to '
        '100 times as much is considered', open_low=True,
    )  # fmt: skip
    path_noise_length: float = same_field(SteeringParameters, 'path_noise_length')
    noise: float = constant(
        4e-5, 'm', 'standard deviation of a tip measurement, along each axis', open_low=True
    )
    drift: float = constant(
        5e-4, 'm', 'standard deviation of a slow error of the tip sensor; 0, one and three times '
        'as much is considered',
    )  # fmt: skip
