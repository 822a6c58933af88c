# SPDX-License-Identifier: Apache-2.0
"""
Normal modes of the inserted part at a frozen depth, and their motion.

In their coordinates a, with q = N a, the modal mass is the identity and the stiffness is diagonal:
N^T rho A G N = 1 and N^T (E I_y H + k_a G) N = omega^2.
"""

from math import cos, exp, expm1, sin, sqrt
from typing import NamedTuple

from needle_dynamics.arrays import FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import compiled, kernel
from needle_dynamics.compiled.integrals import ModeIntegrals
from needle_dynamics.compiled.matrices import backward, cholesky, copy, diagonalize, forward
from needle_dynamics.compiled.tissue import Layers
import numpy as np


class NormalModes(NamedTuple):
    """Normal modes of the inserted part."""

    #: N, one mode per column [kg^-1/2 m^1/2]: q = N a. Generalized forces and values at the tip
    #: transform with N^T: N^T Q and N^T phi, shape (n, n).
    shapes: Matrix
    inverse: Matrix  #: N^-1: a = N^-1 q. Momenta are p = N^-T a_dot, shape (n, n)
    squares: Vector  #: squares of the natural frequencies [1/s^2], ascending, shape (n,)


@compiled
def empty_normal_modes(n: int) -> NormalModes:
    return NormalModes(np.zeros((n, n)), np.zeros((n, n)), np.zeros(n))


@compiled
def modal_stiffness(
    bending: float,
    at: ModeIntegrals,
    stiffness: float,
    growth: float,
    layers: Layers,
    layer: int,
    out: FloatArray,
) -> None:
    """Compute E I_y H plus the integral of k phi phi^T [N/m], shape (n, n)."""
    # ``stiffness`` is that of the tissue at the tip [N/m^2], ``growth`` its factor by swelling.
    n = out.shape[0]
    for i in range(n):
        for j in range(n):
            tissue = stiffness * at.gram[i, j] + growth * layers.gram[layer, i, j]
            out[i, j] = bending * at.curvature_gram[i, j] + tissue


@compiled
def normal_modes(
    density: float, at: ModeIntegrals, stiffness: FloatArray, modes: NormalModes
) -> None:
    """Compute the normal modes of the pair (stiffness, rho A G); ``stiffness`` is destroyed."""
    n = stiffness.shape[0]
    # The Cholesky factor overwrites the mass, in the memory of the inverse.
    factor = modes.inverse
    for i in range(n):
        for j in range(n):
            factor[i, j] = density * at.gram[i, j]
    cholesky(factor, factor)
    # L^-1 K L^-T, by columns and then by rows.
    for i in range(n):
        forward(factor, stiffness[:, i])
    for i in range(n):
        forward(factor, stiffness[i])
    for i in range(n):
        for j in range(i):
            stiffness[i, j] = stiffness[j, i] = 0.5 * (stiffness[i, j] + stiffness[j, i])
    diagonalize(stiffness, modes.shapes)
    for k in range(n):
        modes.squares[k] = stiffness[k, k]
    for k in range(n):
        for i in range(n):
            stiffness[k, i] = 0.0
            for j in range(i + 1):
                stiffness[k, i] += modes.shapes[j, k] * factor[i, j]
    for k in range(n):
        backward(factor, modes.shapes[:, k])
    copy(stiffness, modes.inverse)


@compiled
def swing(damping: float, square: float, t: float) -> tuple[float, float, float, float]:
    """Solve x_ddot + damping x_dot + square x = 0 for a time t [s], exactly."""
    # Returns pp, pv [s], vp [1/s], vv: after t, x is pp x + pv v, and v is vp x + vv v.
    half = 0.5 * damping
    apart = square - half * half
    if apart >= 0.0:
        w = sqrt(apart)
        fall = exp(-half * t)
        pv = fall * (sin(w * t) / w if w > 0.0 else t)
        pp = fall * cos(w * t) + half * pv
        return pp, pv, -square * pv, pp - damping * pv
    # Two real poles, the slow pole in a form without cancellation.
    r = sqrt(-apart)
    fast = -(half + r)
    slow = square / fast
    pv = exp(slow * t) * -expm1(-2.0 * r * t) / (2.0 * r)
    return exp(slow * t) - slow * pv, pv, -square * pv, exp(slow * t) + fast * pv


@kernel
def coupling(
    density: float, bending: float, stiffness: float, bend: float, tip: float, rate: float
) -> float:
    """Return the force of the bent needle against insertion, -N_d of (13) [N]."""
    # Half of E I_y w''^2 + k w^2 - rho A (phi q_dot)^2, with ``bend`` = phi''(s) q [1/m], ``tip``
    # = phi(s) q [m] and ``rate`` = phi(s) q_dot [m/s].
    return 0.5 * (bending * bend * bend + stiffness * tip * tip - density * rate * rate)
