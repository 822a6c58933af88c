# SPDX-License-Identifier: Apache-2.0
"""
Friction adaptation: corrections of the friction model by recursive least squares.

In each direction of motion three corrections are estimated: of dry friction, of viscous friction,
and of dry friction per insertion depth. Their prior is zero with a standard deviation of half
their bound. Each period of sliding is a measurement: the force of the period, less inertia and
modeled friction at the mean speed. Corrections without excitation do not change. While the law
learns, the covariance grows slowly, up to the prior.
"""

from math import sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled
import numpy as np

#: Corrections of one direction, and the size of their estimate with its covariance.
TERMS: Final = 3
BLOCK: Final = TERMS + TERMS * TERMS

LENGTH: Final = 0.05  #: Insertion depth over which dry friction may change by its bound [m].
_CORRELATED: Final = 0.01  #: Correlation time of the measurement noise [s].
_MEMORY: Final = 60.0  #: Time in which a covariance grows to its prior, without measurements [s].


@compiled
def bounds(share: float, coulomb: float, viscous: float) -> tuple[float, float, float]:
    """Return the largest modulus of each correction [N], [N s/m], [N/m], relative to the model."""
    return share * coulomb, share * viscous, share * coulomb / LENGTH


@compiled
def correction(
    block: FloatArray, limits: tuple[float, float, float], depth: float, speed: float
) -> float:
    """Return the learned friction [N] of a block (BLOCK,) at a depth [m] and a speed [m/s]."""
    dry, viscous, slope = limits
    dry_part = min(max(block[2], -slope), slope) * (depth - LENGTH) + block[0]
    return float(min(max(dry_part, -dry), dry) + min(max(block[1], -viscous), viscous) * speed)


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
    Update the estimate of one direction, shape (BLOCK,), with one period of sliding.

    ``missing`` is the friction beyond the model [N], and ``noise`` its standard deviation.
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
