r"""
Models of others beside `SteeredNeedle`: what they say about the tip, and what they leave out.

`unicycle` and `bicycle` of [Webster2006]_ know no tissue and no guide: the tip goes where it
points and turns by its bevel. `intrinsic_curvature` of [Lezcano2020]_ is the shape of a needle at
one depth, without the way there. `springs` of [Glozman2007]_ knows guide and tissue, but its
tissue pulls the needle to the axis instead of the path that was cut.

References
----------
.. [Webster2006] R. J. Webster, J. S. Kim, N. J. Cowan, G. S. Chirikjian, A. M. Okamura,
   "Nonholonomic modeling of needle steering", International Journal of Robotics Research 25, 2006.
.. [Lezcano2020] D. A. Lezcano, I. Iordachita, J. S. Kim, "Trajectory generation of FBG-sensorized
   needles for insertions into multi-layer tissue", IEEE Sensors, 2020.
.. [Glozman2007] D. Glozman, M. Shoham, "Image-guided robotic flexible needle steering", IEEE
   Transactions on Robotics 23, 2007.

"""

from __future__ import annotations

from dataclasses import replace
from math import inf, tan

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import SteeredNeedle
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.errors import ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike


def unicycle(lengths: ArrayLike, rolls: ArrayLike, curvature: float) -> FloatArray:
    """
    Tip of a needle that follows arcs of one curvature in the direction of its bevel.

    Parameters
    ----------
    lengths : array_like, shape (k,)
        Inserted lengths, increasing from the first [m].
    rolls : array_like, shape () or (k,)
        Roll over the way to each of them, right-handed about y [rad]; at 0 the needle bends to z.
    curvature : float
        Curvature of the arcs [1/m].

    Returns
    -------
    ndarray, shape (k, 3)
        Where the tip is, in x, y and z [m]; it starts at zero, along y.

    Raises
    ------
    ShapeError, ParameterError
        If the lengths do not increase, or there is not one roll for each.

    """
    return bicycle(lengths, rolls, curvature, 0.0)


def bicycle(lengths: ArrayLike, rolls: ArrayLike, curvature: float, lead: float) -> FloatArray:
    """
    Tip of a needle whose rear wheel follows arcs, with the tip ahead of it.

    Parameters
    ----------
    lengths : array_like, shape (k,)
        Ways of the rear wheel, increasing from the first [m].
    rolls : array_like, shape () or (k,)
        As in `unicycle`.
    curvature : float
        Curvature of its arcs [1/m]: tan(phi) / l1 for a front wheel turned by phi at a distance
        l1, see `bicycle_curvature`.
    lead : float
        Distance l2 of the tip from the rear wheel [m].

    Returns
    -------
    ndarray, shape (k, 3)
        Where the tip is, in x, y and z [m]; it starts at zero, with the needle along y.

    Raises
    ------
    ShapeError, ParameterError
        As `unicycle`.

    """
    ways = np.atleast_1d(np.array(lengths, dtype=np.float64))
    turns = np.array(rolls, dtype=np.float64)
    if ways.ndim != 1 or turns.shape not in ((), ways.shape):
        raise ShapeError(
            f'lengths must have shape (k,) and rolls the same or (), got {ways.shape} and '
            f'{turns.shape}'
        )
    steps = np.diff(ways, prepend=0.0)
    if not (np.isfinite(ways).all() and np.isfinite(turns).all() and (steps >= 0.0).all()):
        raise ParameterError('lengths must be finite, >= 0 and increase; rolls must be finite')
    place, frame = np.array([0.0, -lead, 0.0]), np.eye(3)
    found = np.empty((len(ways), 3))
    for k, (step, roll) in enumerate(zip(steps, np.broadcast_to(turns, ways.shape), strict=True)):
        # Along the frame's y, bending to the side that the roll has turned from z towards x.
        side = np.array([np.sin(roll), 0.0, np.cos(roll)])
        angle = curvature * step
        ahead = step * np.sinc(angle / np.pi)
        aside = step * np.sinc(angle / (2.0 * np.pi)) * np.sin(0.5 * angle)
        place = place + frame @ (np.array([0.0, ahead, 0.0]) + aside * side)
        frame = frame @ _turn(np.array([0.0, 1.0, 0.0]), side, angle)
        found[k] = place + lead * frame[:, 1]
    return found


def _turn(ahead: FloatArray, side: FloatArray, angle: float) -> FloatArray:
    """Return the rotation by an angle that takes one direction towards another."""
    both = np.outer(side, ahead) - np.outer(ahead, side)
    within = np.outer(ahead, ahead) + np.outer(side, side)
    return np.asarray(np.eye(3) + np.sin(angle) * both + (np.cos(angle) - 1.0) * within)


def bicycle_curvature(wheelbase: float, angle: float) -> float:
    """
    Return the curvature of the way of the rear wheel of a bicycle.

    Parameters
    ----------
    wheelbase : float
        Distance l1 of the wheels [m].
    angle : float
        Angle phi of the front wheel [rad].

    Returns
    -------
    float
        Curvature [1/m].

    """
    return tan(angle) / wheelbase


def intrinsic_curvature(depth: float, curvature: float, at: ArrayLike = inf) -> FloatArray:
    """
    Shape of a needle whose curvature falls with the square of the distance to the tip.

    Parameters
    ----------
    depth : float
        Inserted length L [m].
    curvature : float
        Intrinsic curvature kappa_c at the entry [1/m]: kappa(y) = kappa_c (1 - y / L)^2.
    at : array_like
        Where to evaluate [m], in [0, L]; the tip if not given.

    Returns
    -------
    ndarray
        Deflection [m] for each, kappa_c L^2 / 4 at the tip.

    Raises
    ------
    ParameterError
        If the depth is not positive and finite.

    """
    if not 0.0 < depth < inf:
        raise ParameterError(f'depth must be positive and finite, got {depth!r} m')
    part = np.minimum(np.asarray(at, dtype=np.float64) / depth, 1.0)
    # Twice the integral of (1 - u)^2.
    return np.asarray(curvature * depth**2 * ((1.0 - part) ** 4 - 1.0 + 4.0 * part) / 12.0)


def springs(
    needle: NeedleParameters, steering: SteeringParameters, depth: float
) -> tuple[FloatArray, FloatArray]:
    """
    Tip of a needle on springs that pull it to the axis.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue.
    steering : SteeringParameters
        Its free length, skin and element.
    depth : float
        Depth of the tip [m].

    Returns
    -------
    response : ndarray, shape (2, 2)
        Deflection [m] and slope of the tip per position [m] and tilt of the guide.
    compliance : ndarray, shape (2, 2)
        Deflection and slope of the tip per lateral force [N] and moment [N m] there.

    Raises
    ------
    ParameterError
        If the needle does not reach so deep.

    """
    one = SteeredNeedle(needle, replace(steering, bevel_load=(0.0,), path_noise=0.0))
    # A straight path is the axis, whatever cut it.
    one.move(depth=depth)
    return one.authority, one.compliance
