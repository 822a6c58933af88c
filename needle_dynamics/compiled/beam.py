# SPDX-License-Identifier: Apache-2.0
r"""
Needle as a beam on an elastic foundation about the path cut by its tip.

Between two nodes the needle obeys

.. math:: E I w'''' + k (w - p) = 0

with a path p that is a polynomial of degree two; this is solved exactly. The needle between the
guide and a node acts on the deeper part as a spring: its deflection and slope at the node depend
on the force and the moment ``f = (V, M)`` of the deeper part,

.. math:: x = C f + x_0 , \quad x = (w, w') .

The spring at a node follows from the spring at the previous node only. The cost of an additional
element does therefore not depend on the length. C is the same in both planes. In terms of
estimation, C and x_0 are the covariance and the mean of a Kalman filter, and the shape of the
needle is its smoother.
"""

from typing import NamedTuple

from needle_dynamics.arrays import Array3, FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import compiled, inlined


class SpringSupports(NamedTuple):
    """Equivalent spring of the needle up to each node; row i is node i."""

    depths: Vector  #: distance from the entry point [m]; node 0 is the entry point, shape (m,)
    #: Stiffness of the tissue between this node and the next one [N/m^2], shape (m,).
    stiffness: Vector
    #: The entries 00, 01 and 11 of the symmetric C [m/N, 1/N, rad/(N m)], shape (m, 3).
    compliance: Matrix
    #: Deflection and slope of the unloaded end per position and tilt of the guide,
    #: shape (m, 2, 2).
    response: Array3
    #: By plane (x, z): deflection [m] and slope of the unloaded end with the guide at zero,
    #: shape (m, 2, 2).
    rest: Array3
    #: By plane: value [m], slope and second derivative [1/m] of the path at this node, towards the
    #: next one, shape (m, 2, 3).
    path: Array3


class Element(NamedTuple):
    """Exact transfer of deflection, slope, shear force and moment over an element."""

    #: The functions h^j sum_m z^m / (4m + j)! with z = -k h^4 / (E I), in m^j.
    p0: float
    p1: float
    p2: float
    p3: float
    p4: float
    p5: float
    p6: float
    ei: float  #: bending stiffness [N m^2]
    k: float  #: stiffness of the tissue [N/m^2]


class Crossing(NamedTuple):
    """Transfer of the spring from the start to the end of an element."""

    #: Compliance at the end.
    c00: float
    c01: float
    c11: float
    #: Transfer of deflection and slope of the unloaded end from the start to the end.
    t00: float
    t01: float
    t10: float
    t11: float
    #: Deflection and slope at the end per value, slope and second derivative of the path.
    value: tuple[float, float]
    slope: tuple[float, float]
    bend: tuple[float, float]


@inlined
def element(ei: float, k: float, h: float) -> Element:
    """Return the transfer over h [m] <= (4 E I / k)^(1/4); its series are exact to rounding."""
    z = -k / ei * h**4
    # Coefficients of z^m: j! / (4m + j)!, by ratios of neighbors.
    p0 = 1.0 + z / 24 * (1.0 + z / 1680 * (1.0 + z / 11880 * (1.0 + z / 43680)))
    p1 = 1.0 + z / 120 * (1.0 + z / 3024 * (1.0 + z / 17160 * (1.0 + z / 57120)))
    p2 = 1.0 + z / 360 * (1.0 + z / 5040 * (1.0 + z / 24024 * (1.0 + z / 73440)))
    p3 = 1.0 + z / 840 * (1.0 + z / 7920 * (1.0 + z / 32760 * (1.0 + z / 93024)))
    p4 = 1.0 + z / 1680 * (1.0 + z / 11880 * (1.0 + z / 43680 * (1.0 + z / 116280)))
    p5 = 1.0 + z / 3024 * (1.0 + z / 17160 * (1.0 + z / 57120 * (1.0 + z / 143640)))
    p6 = 1.0 + z / 5040 * (1.0 + z / 24024 * (1.0 + z / 73440 * (1.0 + z / 175560)))
    return Element(
        p0, p1 * h, p2 * h**2 / 2, p3 * h**3 / 6, p4 * h**4 / 24, p5 * h**5 / 120,
        p6 * h**6 / 720, ei, k,
    )  # fmt: skip


@inlined
def load_transfer(
    e: Element, c00: float, c01: float, c11: float
) -> tuple[float, float, float, float, float]:
    """Return W = Phi_fx C + Phi_ff, from loads at the start to loads at the end, and 1 / det W."""
    w00 = e.k * (e.p1 * c00 + e.p2 * c01) + e.p0
    w01 = e.k * (e.p1 * c01 + e.p2 * c11) + e.k / e.ei * e.p3
    w10 = -e.k * (e.p2 * c00 + e.p3 * c01) - e.p1
    w11 = -e.k * (e.p2 * c01 + e.p3 * c11) + e.p0
    return w00, w01, w10, w11, 1.0 / (w00 * w11 - w01 * w10)


@inlined
def cross(e: Element, c00: float, c01: float, c11: float) -> Crossing:
    """Return the transfer over an element; c00, c01 and c11 are the compliance at its start."""
    a = e.k / e.ei
    w00, w01, w10, w11, inverse = load_transfer(e, c00, c01, c11)
    # The transfer is symplectic: deflections transform with the transpose of the inverse of W.
    t00, t01, t10, t11 = w11 * inverse, -w10 * inverse, -w01 * inverse, w00 * inverse
    # Phi_xx C + Phi_xf, times the inverse of W.
    v00 = e.p0 * c00 + e.p1 * c01 - e.p3 / e.ei
    v01 = e.p0 * c01 + e.p1 * c11 + e.p2 / e.ei
    v10 = -a * e.p3 * c00 + e.p0 * c01 - e.p2 / e.ei
    v11 = -a * e.p3 * c01 + e.p0 * c11 + e.p1 / e.ei
    n00 = v00 * t00 + v01 * t01
    n01 = 0.5 * (v00 * t10 + v01 * t11 + v10 * t00 + v11 * t01)
    n11 = v10 * t10 + v11 * t11
    value = _loaded(e, n00, n01, n11, e.p1, e.p2, e.p3, e.p4)
    slope = _loaded(e, n00, n01, n11, e.p2, e.p3, e.p4, e.p5)
    bend = _loaded(e, n00, n01, n11, e.p3, e.p4, e.p5, e.p6)
    return Crossing(n00, n01, n11, t00, t01, t10, t11, value, slope, bend)


@inlined
def _loaded(
    e: Element, n00: float, n01: float, n11: float, q1: float, q2: float, q3: float, q4: float
) -> tuple[float, float]:
    """Return deflection and slope at the end per unit of the path, with its integrals q1 to q4."""
    a = e.k / e.ei
    # Load of the path on a needle with zero start values: w, w', V and M at the end.
    shear, moment = -e.k * q1, e.k * q2
    return (a * q4 - n00 * shear - n01 * moment, a * q3 - n01 * shear - n11 * moment)


@compiled
def begin(s: SpringSupports, ei: float, free: float, skin: float, entry: FloatArray) -> None:
    """Fill the first row: over the free length [m] to the entry point (2,), and the skin [N/m]."""
    c00, c01, c11 = free**3 / (3.0 * ei), free**2 / (2.0 * ei), free / ei
    support = skin / (1.0 + skin * c00)
    s.depths[0] = 0.0
    s.compliance[0, 0] = c00 - c00 * support * c00
    s.compliance[0, 1] = c01 - c00 * support * c01
    s.compliance[0, 2] = c11 - c01 * support * c01
    s.response[0, 0, 0] = 1.0 - c00 * support
    s.response[0, 0, 1] = free - c00 * support * free
    s.response[0, 1, 0] = -c01 * support
    s.response[0, 1, 1] = 1.0 - c01 * support * free
    for plane in range(2):
        s.rest[0, plane, 0] = c00 * support * entry[plane]
        s.rest[0, plane, 1] = c01 * support * entry[plane]


@inlined
def carry(s: SpringSupports, i: int, c: Crossing) -> None:
    """Fill row i + 1, at the end of the element from row i, without the load of the path."""
    j = i + 1
    s.compliance[j, 0], s.compliance[j, 1], s.compliance[j, 2] = c.c00, c.c01, c.c11
    for k in range(2):
        w, turn = s.response[i, 0, k], s.response[i, 1, k]
        s.response[j, 0, k] = c.t00 * w + c.t01 * turn
        s.response[j, 1, k] = c.t10 * w + c.t11 * turn
        w, turn = s.rest[i, k, 0], s.rest[i, k, 1]
        s.rest[j, k, 0] = c.t00 * w + c.t01 * turn
        s.rest[j, k, 1] = c.t10 * w + c.t11 * turn


@inlined
def follow(s: SpringSupports, i: int, plane: int, c: Crossing) -> None:
    """Add the load of the path of an element to row i + 1, in plane 0 (x) or 1 (z)."""
    p, d, b = s.path[i, plane, 0], s.path[i, plane, 1], s.path[i, plane, 2]
    for k in range(2):
        s.rest[i + 1, plane, k] += p * c.value[k] + d * c.slope[k] + b * c.bend[k]
