# SPDX-License-Identifier: Apache-2.0
r"""
Free space around a planned path: probability of a point outside, and the path in its middle.

At each place along the insertion, the free space is a polygon about the planned path, whose
vertices are at a free distance in equally spaced directions. With coordinates in which a normal
distribution is standard, its probability over a polygon is

.. math::
    \frac{1}{2 \pi} \oint (1 - e^{-r^2 / 2}) \, d\varphi
    = \sum \left[ \frac{\arctan t}{2 \pi} - T(h, t) \right]_{t_1}^{t_2},

a sum over the edges with the function T of [Owen1956]_, the signed distance h of an edge from the
mean, and the positions t of its ends along it, relative to h.

References
----------
.. [Owen1956] D. B. Owen, "Tables for computing bivariate normal probabilities", Annals of
   Mathematical Statistics 27, 1956.

"""

from __future__ import annotations

from typing import Final

from needle_controller.steering.insertion_plan import DIRECTIONS
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics.arrays import FloatArray
import numpy as np
from scipy.optimize import linprog
from scipy.special import owens_t

#: Distance of the new path from the target [m], clearance that is enough [m], and clearance that
#: is given up for a motion of the guide.
_LEFT, _ENOUGH, _MOVED = 5e-4, 2e-3, 1e-3
_LEAST: Final = 1e-12  #: Least distance of an edge from the mean, in standard deviations.

_ANGLES: Final = np.linspace(0.0, 2.0 * np.pi, DIRECTIONS, endpoint=False)
#: Unit vectors of the directions in x and z, from x on, shape (16, 2).
UNITS: Final = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


def probability_outside(free: FloatArray, off: FloatArray, covariance: FloatArray) -> FloatArray:
    """
    Return the probability that a normally distributed point is outside its free space.

    Parameters
    ----------
    free : ndarray, shape (m, 16)
        Free distance from the path in the directions `UNITS` [m].
    off : ndarray, shape (m, 2)
        Mean of the point less that of the path [m].
    covariance : ndarray, shape (m, 2, 2)
        Covariance of the point [m^2], positive definite.

    Returns
    -------
    ndarray, shape (m,)
        Probability.

    """
    begin = free[:, :, np.newaxis] * UNITS - off[:, np.newaxis]
    factor = np.linalg.cholesky(covariance)
    begin = np.linalg.solve(factor[:, np.newaxis], begin[..., np.newaxis])[..., 0]
    end = np.roll(begin, -1, axis=1)
    along = end - begin
    length = np.linalg.norm(along, axis=2, keepdims=True)
    unit = np.divide(along, length, out=np.zeros_like(along), where=length > 0.0)
    h = begin[..., 0] * unit[..., 1] - begin[..., 1] * unit[..., 0]
    h = np.where(np.abs(h) < _LEAST, _LEAST, h)
    first, last = ((ends * unit).sum(axis=2) / h for ends in (begin, end))
    angles = (np.arctan(last) - np.arctan(first)) / (2.0 * np.pi)
    inside = (angles - owens_t(h, last) + owens_t(h, first)).sum(axis=1)
    return np.asarray(np.clip(1.0 - inside, 0.0, 1.0))


def most_clearance(
    free: FloatArray,
    off: FloatArray,
    response: FloatArray,
    end: FloatArray,
    miss: FloatArray,
    guide: FloatArray,
    limits: SteeringLimits,
    load: FloatArray,
    stiffness: float,
) -> FloatArray | None:
    """
    Return the change of guide setpoints for the largest clearance of all points.

    A linear program: a point keeps its distance from the lines that cut off the free space beyond
    its free distance in each direction. Clearance above 2 mm gains nothing.

    Parameters
    ----------
    free : ndarray, shape (m, 16)
        Free distances from the path [m].
    off : ndarray, shape (m, 2)
        Points less the path [m].
    response : ndarray, shape (m, n)
        Shift of each point per shift of the guide in each step.
    end : ndarray, shape (n,)
        Shift of the tip at the last depth.
    miss : ndarray, shape (2,)
        Target less the expected tip there [m]; 0.5 mm may be left.
    guide : ndarray, shape (n + 1, 2)
        Guide before these steps, and in each of them [m].
    limits : SteeringLimits
        Limits of the guide.
    load : ndarray, shape (2,)
        Lateral force of the guide in the first step [N].
    stiffness : float
        Change of this force per motion of the guide [N/m].

    Returns
    -------
    ndarray, shape (n, 2), or None
        Change of the guide [m]; None if the target cannot be reached.

    """
    n = response.shape[1]
    # Unknowns: changes in x, then in z; their sizes; clearance.
    size, own = 4 * n + 1, np.eye(4 * n + 1)
    changes, sizes = own[: 2 * n], own[2 * n : 4 * n]
    towards = UNITS[:, :, np.newaxis] * response[:, np.newaxis, np.newaxis]
    apart = np.zeros((towards.shape[0] * DIRECTIONS, size))
    apart[:, : 2 * n], apart[:, -1] = towards.reshape(len(apart), -1), 1.0
    steps = np.eye(n) - np.eye(n, k=-1)
    rows = [apart, changes - sizes, -changes - sizes]
    bounds = [(free - off @ UNITS.T).ravel(), np.zeros(4 * n)]
    for plane in range(2):
        of_plane = changes[plane * n : (plane + 1) * n]
        motion, last = np.diff(guide[:, plane]), end[np.newaxis] @ of_plane
        rows += [last, -last]
        bounds += [np.array([_LEFT + miss[plane], _LEFT - miss[plane]])]
        if np.isfinite(limits.guide_step):
            rows += [steps @ of_plane, -steps @ of_plane]
            bounds += [limits.guide_step - motion, limits.guide_step + motion]
    cost = np.concatenate([np.zeros(2 * n), np.full(2 * n, _MOVED), [-1.0]])
    most = limits.guide_limit
    now, wide = guide[1:].T.ravel(), np.full(2 * n, np.inf)
    low = np.concatenate([-most - now, np.zeros(2 * n), [-np.inf]])
    high = np.concatenate([most - now, wide, [_ENOUGH]])
    if np.isfinite(limits.load_limit) and stiffness > 0.0:
        # The law limits the load of later steps.
        first = [0, n]
        low[first] = np.maximum(low[first], (-limits.load_limit - load) / stiffness)
        high[first] = np.minimum(high[first], (limits.load_limit - load) / stiffness)
        if (low > high).any():
            return None
    ranges = np.column_stack([low, high])
    found = linprog(cost, np.vstack(rows), np.concatenate(bounds), bounds=ranges)
    return found.x[: 2 * n].reshape(2, n).T if found.status == 0 else None
