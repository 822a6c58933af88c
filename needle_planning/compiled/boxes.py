# SPDX-License-Identifier: Apache-2.0
"""Exact distance from points and lines to many axis-aligned boxes, less their margins."""

from __future__ import annotations

from math import inf, sqrt
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import IntVector, Matrix, Vector
from needle_dynamics.compiled.cache import inlined, kernel
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

LEAF: Final = 4  #: Boxes of a leaf.
_DEEPEST: Final = 64  #: Largest number of nodes that wait: one for each level of a tree.
_FIRST: Final = 16  #: Points of a line that are examined first.


class BoxTree(NamedTuple):
    """
    Boxes in a complete binary tree: node 1 is the root, node i has the children 2 i and 2 i + 1.

    Node 0 is the region of the tree. The leaves are the second half of the nodes. Leaf i has the
    `LEAF` boxes from `LEAF` i on. A box that only fills its leaf has the margin -inf.
    """

    low: Matrix  #: lower corner of each box [m], shape (n, 3)
    high: Matrix  #: upper corner [m], shape (n, 3)
    margin: Vector  #: margin of each box [m], shape (n,)
    node_low: Matrix  #: lower corner of all boxes of a node [m], shape (nodes, 3)
    node_high: Matrix  #: upper corner [m], shape (nodes, 3)
    node_margin: Vector  #: largest margin in a node [m], shape (nodes,)
    cap: float  #: largest clearance that is distinguished [m]


@inlined
def _square(low: Matrix, high: Matrix, i: int, x: float, y: float, z: float) -> float:
    """Return the squared distance from a point to a box [m^2]."""
    dx = max(low[i, 0] - x, 0.0, x - high[i, 0])
    dy = max(low[i, 1] - y, 0.0, y - high[i, 1])
    dz = max(low[i, 2] - z, 0.0, z - high[i, 2])
    return float(dx * dx + dy * dy + dz * dz)


@inlined
def _may_be_less(square: float, margin: float, least: float) -> bool:
    """Return whether a distance, given as square, less a margin is below the least clearance."""
    allowed = least + margin
    return allowed > 0.0 and square < allowed * allowed


@inlined
def _nearest(
    t: BoxTree, x: float, y: float, z: float, guess: int, stack: IntVector
) -> tuple[float, int]:
    """Return clearance [m] and nearest box (-1: beyond the cap) of a point, from a first guess."""
    least, found = t.cap, -1
    if guess >= 0:
        value = sqrt(_square(t.low, t.high, guess, x, y, z)) - t.margin[guess]
        if value < least:
            least, found = value, guess
    half, count = len(t.node_margin) // 2, 0
    square = _square(t.node_low, t.node_high, 1, x, y, z)
    if _may_be_less(square, t.node_margin[1], least):
        stack[0], count = 1, 1
    while count > 0:
        count -= 1
        i = stack[count]
        if i >= half:
            begin = (i - half) * LEAF
            for k in range(begin, begin + LEAF):
                square = _square(t.low, t.high, k, x, y, z)
                if _may_be_less(square, t.margin[k], least):
                    least, found = sqrt(square) - t.margin[k], k
            continue
        a = 2 * i
        b = a + 1
        near = _square(t.node_low, t.node_high, a, x, y, z)
        far = _square(t.node_low, t.node_high, b, x, y, z)
        if far < near:
            a, b, near, far = b, a, far, near
        # The nearer child is examined first.
        if _may_be_less(far, t.node_margin[b], least):
            stack[count] = b
            count += 1
        if _may_be_less(near, t.node_margin[a], least):
            stack[count] = a
            count += 1
    return least, found


@inlined
def _depth(gaps: BoxTree, x: float, y: float, z: float, stack: IntVector) -> float:
    """Return the distance from a point to the boxes, or to the border of the region [m]."""
    depth, _ = _nearest(gaps, x, y, z, -1, stack)
    low, high = gaps.node_low[0], gaps.node_high[0]
    depth = min(depth, x - low[0], high[0] - x)
    return float(min(depth, y - low[1], high[1] - y, z - low[2], high[2] - z))


@inlined
def _between(values: Vector, s: float) -> float:
    """Return values at equal fractions, interpolated at a fraction."""
    at = s * (len(values) - 1)
    k = min(int(at), max(len(values) - 2, 0))
    return float(values[k] + (at - k) * (values[min(k + 1, len(values) - 1)] - values[k]))


@inlined
def _steepest(values: Vector) -> float:
    """Return the largest slope of `_between`."""
    found = 0.0
    for k in range(1, len(values)):
        found = max(found, abs(values[k] - values[k - 1]))
    return found * (len(values) - 1)


@kernel
def point_clearances(
    boxed: Boxed[BoxTree], points: Matrix, clearances: Vector, nearest: IntVector
) -> None:
    """Compute clearance [m] and nearest box (-1: beyond the cap) of points, shape (k, 3) [m]."""
    t, stack, guess = boxed.value, np.empty(_DEEPEST, np.int64), -1
    for i in range(len(points)):
        clearances[i], guess = _nearest(t, points[i, 0], points[i, 1], points[i, 2], guess, stack)
        nearest[i] = guess


@kernel
def line_clearances(
    boxed: Boxed[BoxTree],
    free: Boxed[BoxTree],
    entries: Matrix,
    target: Vector,
    radii: Vector,
    bow: Vector,
    tolerance: float,
    enough: float,
    found: Matrix,
) -> None:
    """Bound the least clearance of lines from entry points to a target, with a gain by a bow."""
    # ``free`` are the boxes of its region without an obstacle: obstacles fill a ball in the region
    # that does not reach these boxes.
    # ``entries``, shape (m, 3), and ``target``, shape (3,) [m]; ``bow``, shape (p,): gain at equal
    # fractions of each line, from entry to target [m]; ``radii``, shape (m,): distance of further
    # entry points. Outputs in ``found``, shape (m, 3): least value of clearance and gain at the
    # examined points of the line; upper bound on the clearance of all needles from an entry point
    # within the radius, deflected by the gain at most; fraction of the line at the least value.
    # The true least value is within ``tolerance`` of the first. A line ends early, with -inf, when
    # its upper bound is at most ``enough``.
    t, gaps, stack = boxed.value, free.value, np.empty(_DEEPEST, np.int64)
    for i in range(len(entries)):
        x, y, z = entries[i, 0], entries[i, 1], entries[i, 2]
        dx, dy, dz = target[0] - x, target[1] - y, target[2] - z
        length = sqrt(dx * dx + dy * dy + dz * dz)
        # Slope of the clearance and of the gain along the line.
        steepest = 1.0 + _steepest(bow) / length
        least, upper, place, guess = inf, inf, 1.0, -1
        s, first, ended = 0.0, _FIRST, False
        while True:
            # First at equal distances, from the target on; then everywhere else.
            if first >= 0:
                s = first / _FIRST
            value, guess = _nearest(t, x + s * dx, y + s * dy, z + s * dz, guess, stack)
            gain = _between(bow, s)
            if guess >= 0 and value <= -t.margin[guess]:
                # In an obstacle: all needles of the cell may pass through obstacles here.
                px, py, pz = x + s * dx, y + s * dy, z + s * dz
                if _depth(gaps, px, py, pz, stack) > gain + (1.0 - s) * radii[i]:
                    upper = min(upper, 0.0)
            value += gain
            if value < least:
                least, place = value, s
            upper = min(upper, value + (1.0 - s) * radii[i])
            if upper <= enough:
                ended = True
                break
            if first >= 0:
                first -= 1
                if first < 0:
                    s, first = 0.0, -1
                continue
            if s >= 1.0:
                break
            s = min(s + (value - least + tolerance) / (steepest * length), 1.0)
        found[i, 0] = -inf if ended else least
        found[i, 1] = upper
        found[i, 2] = place
