# SPDX-License-Identifier: Apache-2.0
"""
Steering models from the literature, for comparison with `SteeredNeedle`.

`unicycle` and `bicycle` of [Webster2006]_ have neither tissue nor guide: the tip moves along its
axis and turns with its bevel. `intrinsic_curvature` of [Lezcano2020]_ is the shape of a needle at
one depth, without insertion history.

`springs` pull the needle to its axis, without memory of a path [Glozman2007]_.

References
----------
.. [Glozman2007] D. Glozman, M. Shoham, "Image-guided robotic flexible needle steering", IEEE
   Transactions on Robotics 23, 2007.
.. [Webster2006] R. J. Webster, J. S. Kim, N. J. Cowan, G. S. Chirikjian, A. M. Okamura,
   "Nonholonomic modeling of needle steering", International Journal of Robotics Research 25, 2006.
.. [Lezcano2020] D. A. Lezcano, I. Iordachita, J. S. Kim, "Trajectory generation of FBG-sensorized
   needles for insertions into multi-layer tissue", IEEE Sensors, 2020.

"""

from __future__ import annotations

from dataclasses import replace
from math import inf, tan

from needle_dynamics import (
    FloatArray,
    NeedleParameters,
    ParameterError,
    ShapeError,
    SteeredNeedle,
    SteeringParameters,
)
import numpy as np
from numpy.typing import ArrayLike


def unicycle(lengths: ArrayLike, rolls: ArrayLike, curvature: float) -> FloatArray:
    """
    Compute the tip path (k, 3) [m] of a needle that follows arcs of constant curvature [1/m].

    ``rolls`` () or (k,) is the roll up to each depth, right-handed about y [rad]; 0 bends towards
    z.
    """
    return bicycle(lengths, rolls, curvature, 0.0)


def bicycle(lengths: ArrayLike, rolls: ArrayLike, curvature: float, lead: float) -> FloatArray:
    """
    Compute the tip path (k, 3) [m] of a bicycle model over path lengths of its rear wheel [m].

    The curvature of its arcs is tan(phi) / l1 for a front wheel at angle phi and wheelbase l1, see
    `bicycle_curvature`; ``lead`` is the distance l2 of the tip [m], ``rolls`` as in `unicycle`.
    """
    distances = np.atleast_1d(np.array(lengths, dtype=np.float64))
    turns = np.array(rolls, dtype=np.float64)
    if distances.ndim != 1 or turns.shape not in ((), distances.shape):
        raise ShapeError(
            f'lengths must have shape (k,) and rolls the same or (), got {distances.shape} and '
            f'{turns.shape}'
        )
    steps = np.diff(distances, prepend=0.0)
    if not (np.isfinite(distances).all() and np.isfinite(turns).all() and (steps >= 0.0).all()):
        raise ParameterError('lengths must be finite, >= 0 and increase; rolls must be finite')
    place, frame = np.array([0.0, -lead, 0.0]), np.eye(3)
    found = np.empty((len(distances), 3))
    for k, (step, roll) in enumerate(
        zip(steps, np.broadcast_to(turns, distances.shape), strict=True)
    ):
        # Along y of the frame, bending to the side that the roll turns from z towards x.
        side = np.array([np.sin(roll), 0.0, np.cos(roll)])
        angle = curvature * step
        ahead = step * np.sinc(angle / np.pi)
        aside = step * np.sinc(angle / (2.0 * np.pi)) * np.sin(0.5 * angle)
        place = place + frame @ (np.array([0.0, ahead, 0.0]) + aside * side)
        frame = frame @ _turn(np.array([0.0, 1.0, 0.0]), side, angle)
        found[k] = place + lead * frame[:, 1]
    return found


def _turn(ahead: FloatArray, side: FloatArray, angle: float) -> FloatArray:
    """Return the rotation by an angle from one unit vector towards another."""
    both = np.outer(side, ahead) - np.outer(ahead, side)
    within = np.outer(ahead, ahead) + np.outer(side, side)
    return np.asarray(np.eye(3) + np.sin(angle) * both + (np.cos(angle) - 1.0) * within)


def bicycle_curvature(wheelbase: float, angle: float) -> float:
    """Return the path curvature [1/m] for a wheelbase l1 [m] and a front angle phi [rad]."""
    return tan(angle) / wheelbase


def intrinsic_curvature(depth: float, curvature: float, at: ArrayLike = inf) -> FloatArray:
    """Return the deflection [m] at y, by default the tip, for kappa_c (1 - y / L)^2."""
    if not 0.0 < depth < inf:
        raise ParameterError(f'depth must be positive and finite, got {depth!r} m')
    part = np.minimum(np.asarray(at, dtype=np.float64) / depth, 1.0)
    # Twice the integral of (1 - u)^2.
    return np.asarray(curvature * depth**2 * ((1.0 - part) ** 4 - 1.0 + 4.0 * part) / 12.0)


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
