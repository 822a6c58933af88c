"""
Friction learned on the way: corrections of the modeled friction, by recursive least squares.

In each direction of motion three corrections are estimated: of dry friction, of viscous friction,
and of dry friction per inserted length. Before any motion they are zero, with a standard
deviation of half their bound. A period in which the axis slides is one measurement: the force that
acted, less that of the inertia and of the modeled friction at the mean speed. What a motion does
not excite stays as it was. While it learns, the covariance grows slowly, up to its beginning.
"""

from __future__ import annotations

from math import sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled
import numpy as np

#: Corrections of one direction, and the size of their estimate with its covariance.
TERMS: Final = 3
BLOCK: Final = TERMS + TERMS * TERMS

#: Inserted length over which dry friction may change by its bound [m].
LENGTH: Final = 0.05

#: Time in which the measurements of one noise are counted as one [s].
_CORRELATED: Final = 0.01

#: Time in which the covariance of a correction grows to its beginning, without measurements [s].
_MEMORY: Final = 60.0


@compiled
def bounds(share: float, coulomb: float, viscous: float) -> tuple[float, float, float]:
    """
    Return the largest modulus of each correction.

    Parameters
    ----------
    share : float
        Relative bound of the corrections.
    coulomb, viscous : float
        Modeled friction [N], [N s/m].

    Returns
    -------
    tuple of float
        Bounds [N], [N s/m], [N/m].

    """
    return share * coulomb, share * viscous, share * coulomb / LENGTH


@compiled
def correction(
    block: FloatArray, limits: tuple[float, float, float], depth: float, speed: float
) -> float:
    """
    Return the learned friction beyond the modeled one, for a motion in the direction of a block.

    Parameters
    ----------
    block : ndarray, shape (BLOCK,)
        Estimate of this direction.
    limits : tuple of float
        As from `bounds`.
    depth : float
        Position of the axis [m]; the depth counts from `LENGTH`.
    speed : float
        Modulus of its speed [m/s].

    Returns
    -------
    float
        Force [N]; no larger than the bounds of dry and viscous friction allow.

    """
    dry, viscous, slope = limits
    held = min(max(block[2], -slope), slope) * (depth - LENGTH) + block[0]
    return float(min(max(held, -dry), dry) + min(max(block[1], -viscous), viscous) * speed)


@compiled
def learn(
    block: FloatArray,
    limits: tuple[float, float, float],
    depth: float,
    speed: float,
    missing: float,
    noise: float,
    period: float,
) -> None:
    """
    Take in one period of sliding.

    Parameters
    ----------
    block : ndarray, shape (BLOCK,)
        Estimate of this direction; updated. Zeros begin.
    limits : tuple of float
        As from `bounds`.
    depth, speed : float
        Position [m] and modulus of the mean speed of the period [m/s].
    missing : float
        Friction beyond the modeled one in this period [N].
    noise : float
        Standard deviation of that force [N].
    period : float
        Period [s].

    """
    covariance = block[TERMS:].reshape((TERMS, TERMS))
    prior = (0.5 * limits[0], 0.5 * limits[1], 0.5 * limits[2])
    for i in range(TERMS):
        if covariance[i, i] == 0.0:
            covariance[i, i] = prior[i] * prior[i]
        covariance[i, i] += prior[i] * prior[i] * period / _MEMORY
    for i in range(TERMS):
        most = prior[i] * prior[i]
        if covariance[i, i] > most:
            shrink = sqrt(most / covariance[i, i])
            for j in range(TERMS):
                covariance[i, j] *= shrink
            for j in range(TERMS):
                covariance[j, i] *= shrink
    regressors = (1.0, speed, depth - LENGTH)
    weights = np.zeros(TERMS)
    variance = noise * noise * max(_CORRELATED / period, 1.0)
    error = missing
    for i in range(TERMS):
        for j in range(TERMS):
            weights[i] += covariance[i, j] * regressors[j]
        variance += regressors[i] * weights[i]
        error -= regressors[i] * block[i]
    for i in range(TERMS):
        gain = weights[i] / variance
        block[i] += gain * error
        for j in range(TERMS):
            covariance[i, j] -= gain * weights[j]
