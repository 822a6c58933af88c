# SPDX-License-Identifier: Apache-2.0
"""
Exact flow of the deflections at a frozen depth, between two half steps of tissue damping.

At frozen depth the undamped modal part is linear: it rotates in the normal modes of the inserted
part. With the momenta p = rho A G q_dot as variables, dG/dt needs no separate step. The force of
the modes on the insertion axis and the sensor loads are closed-form integrals over the rotation.
"""

from math import cos, sin, sqrt
from typing import NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled, inlined
from needle_dynamics.compiled.integrals import ModeIntegrals
from needle_dynamics.compiled.normal_modes import empty_normal_modes, modal_stiffness, normal_modes
from needle_dynamics.compiled.tissue import Layers
import numpy as np


class Elasticity(NamedTuple):
    """Needle and tissue constants of one step."""

    #: Mass per length rho A [kg/m] and bending stiffness E I_y [N m^2].
    density: float
    bending: float
    damping: float  #: tissue damping c_a per length [N s/m^2]
    #: Formulation `as_printed`: z are the rates, and the modes exert no force on the axis.
    as_printed: bool
    layer: int  #: index of the layer that contains the tip
    stiffness: float  #: stiffness of the tissue at the tip [N/m^2]
    growth: float  #: stiffness factor of swelling
    decay: float  #: factor of the rates over half a step of damping


class Rotated(NamedTuple):
    """Integrals over one step."""

    impulse: float  #: impulse of the modes on the insertion axis, against insertion [N s]
    tip: float  #: integral of the tip deflection [m s]
    #: Impulse of the tissue's reaction along z [N s] and of its moment about the entry
    #: point [N m s].
    reaction: float
    moment: float
    lost: float  #: energy lost to tissue damping [J]


class NormalPair(NamedTuple):
    """Normal modes of two shape modes, with the transformation of coordinates."""

    #: Cholesky factor L of the modal mass rho A G.
    l11: float
    l21: float
    l22: float
    #: Reciprocals of the diagonal of L.
    i11: float
    i22: float
    #: Rotation that diagonalizes the stiffness in the coordinates y = L^T q.
    cosine: float
    sine: float
    #: Squares of the frequencies [1/s^2], and frequencies [1/s].
    square1: float
    square2: float
    omega1: float
    omega2: float


class Turn(NamedTuple):
    """Rotation of two normal modes through one step: end values and integrals."""

    #: Coordinates y = L^T q at the end, and their rates after the second half step of damping.
    y1: float
    y2: float
    v1: float
    v2: float
    #: Rates of the normal modes at the start and the end of the undamped rotation.
    b1: float
    b2: float
    f1: float
    f2: float
    #: Values of the normal modes at the tip.
    n1: float
    n2: float
    impulse: float  #: impulse of the modes on the insertion axis, against insertion [N s]
    lost: float  #: energy lost to tissue damping [J]


@inlined
def normal_pair(
    rho: float, g11: float, g12: float, g22: float, k11: float, k12: float, k22: float
) -> NormalPair:
    """Compute the normal modes of G [1] and stiffness k [N/m] by one exact Jacobi rotation."""
    l11 = sqrt(rho * g11)
    l21 = rho * g12 / l11
    l22 = sqrt(rho * g22 - l21 * l21)
    i11 = 1.0 / l11
    i22 = 1.0 / l22
    ratio = l21 * i11
    # Stiffness in the coordinates y, where the mass is the identity.
    b11 = k11 * i11 * i11
    b12 = (k12 - ratio * k11) * i11 * i22
    b22 = (k22 - 2.0 * ratio * k12 + ratio * ratio * k11) * i22 * i22
    tau = (b22 - b11) / (2.0 * b12)
    tangent = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + sqrt(1.0 + tau * tau))
    cj = 1.0 / sqrt(1.0 + tangent * tangent)
    square1 = b11 - tangent * b12
    square2 = b22 + tangent * b12
    return NormalPair(
        l11, l21, l22, i11, i22, cj, tangent * cj, square1, square2, sqrt(square1), sqrt(square2)
    )


@inlined
def turn_pair(
    m: NormalPair,
    rho: float,
    ei: float,
    ka: float,
    value: tuple[float, float],
    curvature: tuple[float, float],
    y: tuple[float, float],
    v: tuple[float, float],
    decay: float,
    first: tuple[float, float],
    second: tuple[float, float],
    h: float,
) -> Turn:
    """Rotate two normal modes through a step of h [s], between two half steps of damping."""
    # ``y`` and ``v`` are L^T q and its rate, ``decay`` the factor of half a step of damping,
    # ``first`` and ``second`` sine and cosine of the rotation angle of each mode.
    cj, sj, square1, square2 = m.cosine, m.sine, m.square1, m.square2
    a1 = cj * y[0] - sj * y[1]
    a2 = sj * y[0] + cj * y[1]
    b1 = cj * v[0] - sj * v[1]
    b2 = sj * v[0] + cj * v[1]

    lost = b1 * b1 + b2 * b2
    b1 *= decay
    b2 *= decay

    # Values at the end.
    sin1, cos1 = first
    sin2, cos2 = second
    e1 = a1 * cos1 + b1 * sin1 / m.omega1
    f1 = b1 * cos1 - a1 * m.omega1 * sin1
    e2 = a2 * cos2 + b2 * sin2 / m.omega2
    f2 = b2 * cos2 - a2 * m.omega2 * sin2

    # Integrals over the rotation of a_i a_j and b_i b_j (b = a_dot), from the end values.
    twice1 = (b1 * b1 + square1 * a1 * a1) * h
    twice2 = (b2 * b2 + square2 * a2 * a2) * h
    change1 = e1 * f1 - a1 * b1
    change2 = e2 * f2 - a2 * b2
    aa1 = 0.5 * (twice1 - change1) / square1
    bb1 = 0.5 * (twice1 + change1)
    aa2 = 0.5 * (twice2 - change2) / square2
    bb2 = 0.5 * (twice2 + change2)
    change12 = e1 * f2 - a1 * b2
    change21 = e2 * f1 - a2 * b1
    gap = 1.0 / (square1 - square2)
    aa12 = (change12 - change21) * gap
    bb12 = (square1 * change12 - square2 * change21) * gap

    # Tip value n and tip curvature m of the two normal modes.
    w1 = value[0] * m.i11
    w2 = (value[1] - m.l21 * w1) * m.i22
    n1 = cj * w1 - sj * w2
    n2 = sj * w1 + cj * w2
    w1 = curvature[0] * m.i11
    w2 = (curvature[1] - m.l21 * w1) * m.i22
    m1 = cj * w1 - sj * w2
    m2 = sj * w1 + cj * w2
    elastic = (
        (ei * m1 * m1 + ka * n1 * n1) * aa1
        + (ei * m2 * m2 + ka * n2 * n2) * aa2
        + 2.0 * (ei * m1 * m2 + ka * n1 * n2) * aa12
    )
    inertial = rho * (n1 * n1 * bb1 + n2 * n2 * bb2 + 2.0 * n1 * n2 * bb12)

    lost += f1 * f1 + f2 * f2
    g1, g2 = f1 * decay, f2 * decay
    return Turn(
        cj * e1 + sj * e2, cj * e2 - sj * e1, cj * g1 + sj * g2, cj * g2 - sj * g1,
        b1, b2, f1, f2, n1, n2, 0.5 * (elastic - inertial), 0.5 * lost * (1.0 - decay * decay),
    )  # fmt: skip


@inlined
def rotate_two(
    e: Elasticity, layers: Layers, at: ModeIntegrals, q: FloatArray, z: FloatArray, h: float
) -> Rotated:
    """Advance two modes as `rotate_many`, five times as fast: one Jacobi rotation is exact."""
    rho, ei, ka, layer = e.density, e.bending, e.stiffness, e.layer
    growth = e.growth
    q1, q2, z1, z2 = q[0], q[1], z[0], z[1]
    gram, curved = at.gram, at.curvature_gram
    k11 = ei * curved[0, 0] + ka * gram[0, 0] + growth * layers.gram[layer, 0, 0]
    k12 = ei * curved[0, 1] + ka * gram[0, 1] + growth * layers.gram[layer, 0, 1]
    k22 = ei * curved[1, 1] + ka * gram[1, 1] + growth * layers.gram[layer, 1, 1]
    m = normal_pair(rho, gram[0, 0], gram[0, 1], gram[1, 1], k11, k12, k22)
    if e.as_printed:
        v1 = m.l11 * z1 + m.l21 * z2
        v2 = m.l22 * z2
    else:
        v1 = z1 * m.i11
        v2 = (z2 - m.l21 * v1) * m.i22
    turned = turn_pair(
        m, rho, ei, ka, (at.value[0], at.value[1]), (at.curvature[0], at.curvature[1]),
        (m.l11 * q1 + m.l21 * q2, m.l22 * q2), (v1, v2), e.decay,
        (sin(m.omega1 * h), cos(m.omega1 * h)), (sin(m.omega2 * h), cos(m.omega2 * h)), h,
    )  # fmt: skip

    # Integral of q over the rotation.
    s1 = (turned.b1 - turned.f1) / m.square1
    s2 = (turned.b2 - turned.f2) / m.square2
    tip = turned.n1 * s1 + turned.n2 * s2
    mean2 = (m.cosine * s2 - m.sine * s1) * m.i22
    mean1 = (m.cosine * s1 + m.sine * s2 - m.l21 * mean2) * m.i11

    q[1] = turned.y2 * m.i22
    q[0] = (turned.y1 - m.l21 * q[1]) * m.i11
    moved1 = e.damping * (q[0] - q1)
    moved2 = e.damping * (q[1] - q2)
    # Reaction of the tissue: integrals of the elastic load k w and the damping load c_a w_dot.
    reaction = (
        (ka * at.area[0] + growth * layers.area[layer, 0]) * mean1
        + (ka * at.area[1] + growth * layers.area[layer, 1]) * mean2
        + at.area[0] * moved1
        + at.area[1] * moved2
    )
    moment = (
        (ka * at.moment[0] + growth * layers.moment[layer, 0]) * mean1
        + (ka * at.moment[1] + growth * layers.moment[layer, 1]) * mean2
        + at.moment[0] * moved1
        + at.moment[1] * moved2
    )
    if e.as_printed:
        z[1] = turned.v2 * m.i22
        z[0] = (turned.v1 - m.l21 * z[1]) * m.i11
        return Rotated(0.0, tip, reaction, moment, turned.lost)
    z[0], z[1] = m.l11 * turned.v1, m.l21 * turned.v1 + m.l22 * turned.v2
    return Rotated(turned.impulse, tip, reaction, moment, turned.lost)


@compiled
def rotate_many(
    e: Elasticity, layers: Layers, at: ModeIntegrals, q: FloatArray, z: FloatArray, h: float
) -> Rotated:
    """Advance the deflections q and momenta z (rates if as printed) through h [s], in place."""
    n = q.shape[0]
    modes, rows, stiffness = empty_normal_modes(n), np.zeros((7, n)), np.empty((n, n))
    shapes, inverse, squares = modes.shapes, modes.inverse, modes.squares
    a, b, ends, rates, mean, value, curvature = (
        rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6]
    )  # fmt: skip
    modal_stiffness(e.bending, at, e.stiffness, e.growth, layers, e.layer, stiffness)
    normal_modes(e.density, at, stiffness, modes)
    for j in range(n):
        for i in range(n):
            a[j] += inverse[j, i] * q[i]
            b[j] += (inverse[j, i] if e.as_printed else shapes[i, j]) * z[i]
            value[j] += shapes[i, j] * at.value[i]
            curvature[j] += shapes[i, j] * at.curvature[i]
    tip, lost = 0.0, 0.0
    for j in range(n):
        lost += b[j] * b[j]
        b[j] *= e.decay
        omega = sqrt(squares[j])
        cosine, sine = cos(omega * h), sin(omega * h)
        ends[j] = a[j] * cosine + b[j] * sine / omega
        rates[j] = b[j] * cosine - a[j] * omega * sine
        lost += rates[j] * rates[j]
        mean[j] = (b[j] - rates[j]) / squares[j]
        tip += value[j] * mean[j]
    impulse = 0.0
    if not e.as_printed:
        impulse = _impulse(e, squares, rows, h)
    reaction, moment = 0.0, 0.0
    for i in range(n):
        end, mean_q = 0.0, 0.0
        for j in range(n):
            end += shapes[i, j] * ends[j]
            mean_q += shapes[i, j] * mean[j]
        moved = e.damping * (end - q[i])
        force = e.stiffness * at.area[i] + e.growth * layers.area[e.layer, i]
        torque = e.stiffness * at.moment[i] + e.growth * layers.moment[e.layer, i]
        reaction += force * mean_q + at.area[i] * moved
        moment += torque * mean_q + at.moment[i] * moved
        q[i], z[i] = end, 0.0
        for j in range(n):
            z[i] += (shapes[i, j] if e.as_printed else inverse[j, i]) * rates[j] * e.decay
    return Rotated(impulse, tip, reaction, moment, 0.5 * lost * (1.0 - e.decay * e.decay))


@compiled
def _impulse(e: Elasticity, squares: FloatArray, rows: FloatArray, h: float) -> float:
    """Compute the impulse of the modes on the axis [N s] from both ends of a rotation."""
    a, b, ends, rates, value, curvature = rows[0], rows[1], rows[2], rows[3], rows[5], rows[6]
    impulse = 0.0
    for i in range(squares.shape[0]):
        for j in range(i, squares.shape[0]):
            # Integrals of a_i a_j and b_i b_j; i < j counts for both orders.
            if i == j:
                twice = (b[i] * b[i] + squares[i] * a[i] * a[i]) * h
                change = ends[i] * rates[i] - a[i] * b[i]
                aa, bb = 0.5 * (twice - change) / squares[i], 0.5 * (twice + change)
            else:
                one = ends[i] * rates[j] - a[i] * b[j]
                two = ends[j] * rates[i] - a[j] * b[i]
                gap = 2.0 / (squares[i] - squares[j])
                aa = (one - two) * gap
                bb = (squares[i] * one - squares[j] * two) * gap
            shared = value[i] * value[j]
            bent = e.bending * curvature[i] * curvature[j]
            impulse += 0.5 * ((bent + e.stiffness * shared) * aa - e.density * shared * bb)
    return impulse
