# SPDX-License-Identifier: Apache-2.0
"""Needle in the path that its tip has cut: state, load on the tip, tip position and shape."""

from __future__ import annotations

from math import cos, sin
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import Array3, FloatArray, IntVector, Matrix, Vector
from needle_dynamics.compiled.beam import (
    begin,
    carry,
    cross,
    Crossing,
    element,
    follow,
    load_transfer,
    SpringSupports,
)
from needle_dynamics.compiled.cache import compiled, inlined, kernel
from needle_dynamics.compiled.tissue import layer_at

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

DEPTH, ROLL, TIP_ROLL, FREE, DEEPEST = range(5)  #: Indices of `Cut.pose`.

#: Indices of `Cut.counts`: row of the last node, and whether the path restarts there.
LAST, RESTARTS = range(2)

#: Withdrawal over which the lateral load of the tip fades [m]: a third of the length of a bevel of
#: 25 degrees at 18 gauge, so that position noise of some micrometers does not make the tip jump.
_RELEASE: Final = 1e-3


class Steered(NamedTuple):
    """Constants of a needle that cuts its path."""

    ei: float  #: bending stiffness [N m^2]
    element: float  #: longest element [m]
    skin: float  #: stiffness of the skin [N/m]
    twist: float  #: torsional compliance of the needle per length [rad/(N m^2)]
    turning: float  #: friction torque per length [N m/m]
    length: float  #: length of the needle [m]
    starts: Vector  #: depths at which the layers begin [m], shape (layers,)
    stiffness: Vector  #: stiffness of each layer [N/m^2], shape (layers,)
    bevel: Vector  #: lateral load of the bevel in each layer [N], shape (layers,)
    cell: float  #: distance between the loads of `wander` [m]
    #: Lateral loads on the tip by depth, in planes x and z [N], for non-uniform tissue; linear
    #: interpolation, shape (cells, 2).
    wander: Matrix


class Cut(NamedTuple):
    """State of a needle that cuts its path."""

    springs: SpringSupports  #: rows of the nodes; the row after the last node is the tip
    guide: Matrix  #: by plane (x, z): position [m] and tilt of the guide, shape (2, 2)
    #: Depth of the tip [m], roll of base and tip [rad], free length, greatest depth [m],
    #: shape (5,).
    pose: Vector
    entry: Vector  #: entry point in the skin, by plane [m], shape (2,)
    tip: Matrix  #: by plane: deflection [m] and slope of the tip, shape (2, 2)
    load: Vector  #: lateral load on the tip, by plane [N], shape (2,)
    counts: IntVector  #: row of the last node, and whether the path restarts there, shape (2,)


class CuttingNeedle(NamedTuple):
    """Constants and state of a needle that cuts its path."""

    constants: Steered
    state: Cut


@inlined
def set_tip_load(n: Steered, c: Cut, layer: int) -> None:
    """Set the lateral load on the tip [N]; zero without contact to uncut tissue."""
    c.load[0] = c.load[1] = 0.0
    touch = 1.0 - (c.pose[DEEPEST] - c.pose[DEPTH]) / _RELEASE
    if touch <= 0.0:
        return
    c.load[0] = n.bevel[layer] * sin(c.pose[TIP_ROLL])
    c.load[1] = n.bevel[layer] * cos(c.pose[TIP_ROLL])
    if len(n.wander) > 0:
        at = c.pose[DEPTH] / n.cell
        cell = min(int(at), len(n.wander) - 2)
        part = at - cell
        for plane in range(2):
            low, high = n.wander[cell, plane], n.wander[cell + 1, plane]
            c.load[plane] += low + part * (high - low)
    c.load[0] *= touch
    c.load[1] *= touch


@inlined
def unloaded_end(c: Cut, row: int, plane: int, k: int) -> float:
    """Return deflection (k = 0) or slope (k = 1) of the unloaded end of a row."""
    s = c.springs
    b, tilt = c.guide[plane, 0], c.guide[plane, 1]
    return float(s.rest[row, plane, k] + s.response[row, k, 0] * b + s.response[row, k, 1] * tilt)


@compiled
def node_before(s: SpringSupports, last: int, depth: float) -> int:
    """Return the row of the last node at or above a depth [m], by bisection."""
    low, high = 0, last
    while low < high:
        middle = (low + high + 1) // 2
        if s.depths[middle] <= depth:
            low = middle
        else:
            high = middle - 1
    return low


@inlined
def crossing(n: Steered, s: SpringSupports, i: int, h: float) -> Crossing:
    """Return the crossing of an element or of its first part of length h [m]."""
    c = s.compliance[i]
    return cross(element(n.ei, s.stiffness[i], h), c[0], c[1], c[2])


@kernel
def place(n: Steered, c: Cut) -> tuple[float, float, float]:
    """Place the tip at the present depth; return its compliance [m/N, 1/N, rad/(N m)]."""
    s, depth = c.springs, c.pose[DEPTH]
    i = node_before(s, c.counts[LAST], depth)
    e = crossing(n, s, i, depth - s.depths[i])
    set_tip_load(n, c, layer_at(n.starts, s.depths[i]))
    for plane in range(2):
        w, turn = unloaded_end(c, i, plane, 0), unloaded_end(c, i, plane, 1)
        p, d, b = s.path[i, plane, 0], s.path[i, plane, 1], s.path[i, plane, 2]
        load = c.load[plane]
        first = e.t00 * w + e.t01 * turn + e.c00 * load
        second = e.t10 * w + e.t11 * turn + e.c01 * load
        c.tip[plane, 0] = first + p * e.value[0] + d * e.slope[0] + b * e.bend[0]
        c.tip[plane, 1] = second + p * e.value[1] + d * e.slope[1] + b * e.bend[1]
    return e.c00, e.c01, e.c11


@kernel
def guide_response(n: Steered, c: Cut, found: Matrix) -> None:
    """Compute deflection and slope of the tip per position and tilt of the guide, shape (2, 2)."""
    s, depth = c.springs, c.pose[DEPTH]
    i = node_before(s, c.counts[LAST], depth)
    e = crossing(n, s, i, depth - s.depths[i])
    for k in range(2):
        w, turn = s.response[i, 0, k], s.response[i, 1, k]
        found[0, k] = e.t00 * w + e.t01 * turn
        found[1, k] = e.t10 * w + e.t11 * turn


@compiled
def compute_shape(n: Steered, c: Cut, found: FloatArray, guide_load: FloatArray) -> int:
    """Compute the shape and the load on the guide; return the node before the tip."""
    # ``found``, shape (rows, 2, 2), takes deflections [m] and slopes by node and plane;
    # ``guide_load``, shape (2, 2), force [N] and moment [N m] on the guide by plane.
    s, free = c.springs, c.pose[FREE]
    last = node_before(s, c.counts[LAST], c.pose[DEPTH])
    for plane in range(2):
        v, m, end = c.load[plane], 0.0, c.pose[DEPTH]
        for i in range(last, -1, -1):
            c00, c01, c11 = s.compliance[i, 0], s.compliance[i, 1], s.compliance[i, 2]
            w0, t0 = unloaded_end(c, i, plane, 0), unloaded_end(c, i, plane, 1)
            # Loads at the start of the element, from the loads at its end.
            k = s.stiffness[i]
            e = element(n.ei, k, end - s.depths[i])
            p, d, b = s.path[i, plane, 0], s.path[i, plane, 1], s.path[i, plane, 2]
            v -= k * (e.p1 * (w0 - p) + e.p2 * (t0 - d) - e.p3 * b)
            m += k * (e.p2 * (w0 - p) + e.p3 * (t0 - d) - e.p4 * b)
            w00, w01, w10, w11, inverse = load_transfer(e, c00, c01, c11)
            v, m = (w11 * v - w01 * m) * inverse, (w00 * m - w10 * v) * inverse
            found[i, plane, 0] = c00 * v + c01 * m + w0
            found[i, plane, 1] = c01 * v + c11 * m + t0
            end = s.depths[i]
        guide_load[plane, 0], guide_load[plane, 1] = v, m
        if free > 0.0:
            # The force jumps at the skin; the free length is loaded at its ends only.
            tilt = c.guide[plane, 1]
            away = found[0, plane, 0] - c.guide[plane, 0] - tilt * free
            turn = found[0, plane, 1] - tilt
            shear = 6.0 * n.ei / free**3 * (2.0 * away - free * turn)
            bend = 2.0 * n.ei / free * (2.0 * turn - 3.0 * away / free)
            guide_load[plane, 0], guide_load[plane, 1] = shear, bend + shear * free
    return last


@kernel
def solve_shape(boxed: Boxed[CuttingNeedle], found: Array3, guide_load: Matrix) -> int:
    """Call `compute_shape` for a boxed needle."""
    return compute_shape(boxed.value.constants, boxed.value.state, found, guide_load)


@kernel
def set_free(n: Steered, c: Cut, free: float) -> None:
    """Change the free length between guide and skin [m], in place."""
    s = c.springs
    c.pose[FREE] = free
    begin(s, n.ei, free, n.skin, c.entry)
    for i in range(c.counts[LAST]):
        e = crossing(n, s, i, s.depths[i + 1] - s.depths[i])
        carry(s, i, e)
        follow(s, i, 0, e)
        follow(s, i, 1, e)
    place(n, c)
