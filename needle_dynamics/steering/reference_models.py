# SPDX-License-Identifier: Apache-2.0
"""
Needle on springs that pull it to its axis, for comparison with the path of `SteeredNeedle`.

D. Glozman, M. Shoham, "Image-guided robotic flexible needle steering", IEEE Transactions on
Robotics 23, 2007.
"""

from dataclasses import replace

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import SteeredNeedle
from needle_dynamics.steering.parameters import SteeringParameters


def springs(
    needle: NeedleParameters, steering: SteeringParameters, depth: float
) -> tuple[FloatArray, FloatArray]:
    """
    Return tip response and tip compliance at a tip depth [m], without memory of a path.

    The response (2, 2) is deflection [m] and slope of the tip per guide position [m] and tilt, the
    compliance (2, 2) per lateral force [N] and moment [N m] at the tip.
    """
    one = SteeredNeedle(needle, replace(steering, bevel_load=(0.0,), path_noise=0.0))
    # A straight path coincides with the axis.
    one.move(depth=depth)
    return one.authority, one.compliance
