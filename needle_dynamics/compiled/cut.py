"""Insertion of a bevel-tip needle: cutting, rest, withdrawal, reinsertion along the cut path."""

from __future__ import annotations

from math import ceil, cos, inf, sin
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import Array3, FloatArray, IntVector, Matrix, Vector
from needle_dynamics.compiled.beam import (
    begin,
    carry,
    cross,
    Crossing,
    element,
    follow,
    shape,
    SpringSupports,
)
from needle_dynamics.compiled.cache import compiled, inlined, kernel
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Indices of `Cut.pose`.
DEPTH: Final = 0
ROLL: Final = 1
TIP_ROLL: Final = 2
FREE: Final = 3
DEEPEST: Final = 4

#: Indices of `Cut.counts`: row of the last node, and whether the path restarts there.
LAST: Final = 0
ANEW: Final = 1

#: Withdrawal over which the lateral load of the tip fades [m]: a third of the length of a bevel of
#: 25 degrees at 18 gauge, so that position noise of some micrometers does not make the tip jump.
_RELEASE: Final = 1e-3

#: Shift of the tip at rest that restarts the path [m]: above rounding, negligible in size.
SHIFT: Final = 1e-9

#: Least fraction of an element that is cut before the path may restart within it.
_PART: Final = 0.5

#: Placeholder for the output ``felt`` of `insert`: guide forces are not computed.
NOT_FELT: Final = np.empty((0, 0, 2))

#: Length below which a piece of path is ignored [m].
_NOTHING: Final = 1e-12


class Steered(NamedTuple):
    """
    Constants of a needle that cuts its path.

    Attributes
    ----------
    ei : float
        Bending stiffness [N m^2].
    element : float
        Longest element [m].
    skin : float
        Stiffness of the skin [N/m].
    twist : float
        Torsional compliance of the needle per length [rad/(N m^2)].
    turning : float
        Friction torque per length [N m/m].
    length : float
        Length of the needle [m].
    starts : ndarray, shape (layers,)
        Depths at which the layers begin [m].
    stiffness : ndarray, shape (layers,)
        Stiffness of each layer [N/m^2].
    bevel : ndarray, shape (layers,)
        Lateral load of the bevel in each layer [N].
    cell : float
        Distance between the loads of `wander` [m].
    wander : ndarray, shape (cells, 2)
        Lateral loads on the tip by depth, in planes x and z [N], for non-uniform tissue; linear
        interpolation.

    """

    ei: float
    element: float
    skin: float
    twist: float
    turning: float
    length: float
    starts: Vector
    stiffness: Vector
    bevel: Vector
    cell: float
    wander: Matrix


class Cut(NamedTuple):
    """
    State of a needle that cuts its path.

    Attributes
    ----------
    springs : SpringSupports
        Rows of the nodes; the row after the last node is the tip.
    guide : ndarray, shape (2, 2)
        By plane (x, z): position [m] and tilt of the guide.
    pose : ndarray, shape (5,)
        Depth of the tip [m], roll of base and tip [rad], free length, greatest depth [m].
    entry : ndarray, shape (2,)
        Entry point in the skin, by plane [m].
    tip : ndarray, shape (2, 2)
        By plane: deflection [m] and slope of the tip.
    load : ndarray, shape (2,)
        Lateral load on the tip, by plane [N].
    counts : ndarray of int, shape (2,)
        Row of the last node, and whether the path restarts there.

    """

    springs: SpringSupports
    guide: Matrix
    pose: Vector
    entry: Vector
    tip: Matrix
    load: Vector
    counts: IntVector


class CuttingNeedle(NamedTuple):
    """Constants and state of a needle that cuts its path."""

    constants: Steered
    state: Cut


class GuidePose(NamedTuple):
    """
    Commanded pose of the needle.

    Attributes
    ----------
    depth : float
        Depth of the tip [m].
    x, tilt_x, z, tilt_z : float
        Position [m] and tilt of the guide, by plane.
    roll : float
        Roll of the base [rad].

    """

    depth: float
    x: float
    tilt_x: float
    z: float
    tilt_z: float
    roll: float


@kernel
def start(n: Steered, c: Cut, to: GuidePose, free: float) -> None:
    """Place the tip on the skin with a free length from the guide [m]; ignores ``to.depth``."""
    c.pose[DEPTH] = c.pose[DEEPEST] = 0.0
    c.pose[ROLL] = c.pose[TIP_ROLL] = to.roll
    c.pose[FREE] = free
    c.guide[0, 0], c.guide[0, 1], c.guide[1, 0], c.guide[1, 1] = to.x, to.tilt_x, to.z, to.tilt_z
    c.counts[LAST], c.counts[ANEW] = 0, 1
    # The bevel bends the needle before the skin supports it.
    _load(n, c, 0)
    for plane in range(2):
        c.entry[plane] = c.guide[plane, 0] + free * c.guide[plane, 1]
        c.entry[plane] += free**3 / (3.0 * n.ei) * c.load[plane]
        c.springs.path[0, plane, 0] = c.entry[plane]
        c.springs.path[0, plane, 1] = c.springs.path[0, plane, 2] = 0.0
    begin(c.springs, n.ei, free, n.skin, c.entry)
    place(n, c)


@inlined
def move(n: Steered, c: Cut, to: GuidePose) -> None:
    """
    Move the needle to a pose, in place; guide and roll change in proportion to the depth.

    The depth of the pose must be at least 0 and within the capacity of the rows.
    """
    begun, deepest = c.pose[DEPTH], c.pose[DEEPEST]
    x, tilt_x, z, tilt_z = c.guide[0, 0], c.guide[0, 1], c.guide[1, 0], c.guide[1, 1]
    roll = c.pose[ROLL]
    if to.depth > deepest:
        far = to.depth - begun
        if begun < deepest:
            part = (deepest - begun) / far
            _set(n, c, to, x, tilt_x, z, tilt_z, roll, part, deepest)
            place(n, c)
        _resume(n, c)
        while True:
            last = c.counts[LAST]
            end = _next_node(n, c.springs.depths[last])
            depth = min(end, to.depth)
            _set(n, c, to, x, tilt_x, z, tilt_z, roll, (depth - begun) / far, depth)
            _cut(n, c)
            if depth == end:
                _keep(c)
                if n.bevel[_layer(n, end)] != n.bevel[_layer(n, c.springs.depths[last])]:
                    # Different bevel load in the next layer: the tip jumps.
                    place(n, c)
                    _resume(n, c)
            if depth == to.depth:
                break
    else:
        _set(n, c, to, x, tilt_x, z, tilt_z, roll, 1.0, to.depth)
        place(n, c)


@inlined
def _set(
    n: Steered,
    c: Cut,
    to: GuidePose,
    x: float,
    tilt_x: float,
    z: float,
    tilt_z: float,
    roll: float,
    part: float,
    depth: float,
) -> None:
    """Set depth [m], and guide and roll at a fraction of the motion to the pose."""
    c.pose[DEPTH] = depth
    c.guide[0, 0] = x + part * (to.x - x)
    c.guide[0, 1] = tilt_x + part * (to.tilt_x - tilt_x)
    c.guide[1, 0] = z + part * (to.z - z)
    c.guide[1, 1] = tilt_z + part * (to.tilt_z - tilt_z)
    c.pose[ROLL] = roll + part * (to.roll - roll)
    # Friction torque holds the tip within the windup; exact at constant depth.
    torque = n.turning * depth
    windup = torque * n.twist * max(0.0, n.length - 0.5 * depth)
    low, high = c.pose[ROLL] - windup, c.pose[ROLL] + windup
    c.pose[TIP_ROLL] = min(max(c.pose[TIP_ROLL], low), high)


@inlined
def _layer(n: Steered, depth: float) -> int:
    """Return the index of the layer that starts at or above a depth [m]."""
    layer = 0
    while layer + 1 < len(n.starts) and n.starts[layer + 1] <= depth:
        layer += 1
    return layer


@inlined
def _next_node(n: Steered, depth: float) -> float:
    """Return the end of the element that starts at a depth [m]; it stays within its layer."""
    layer = _layer(n, depth)
    border = n.starts[layer + 1] if layer + 1 < len(n.starts) else inf
    # Equal elements in a layer, so that the nodes do not depend on the steps.
    left = border - depth
    if left > 1e6 * n.element:
        return depth + n.element
    count = ceil(left / n.element - 1e-9)
    return border if count <= 1 else depth + left / count


@inlined
def _load(n: Steered, c: Cut, layer: int) -> None:
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
def _path_end(s: SpringSupports, i: int, plane: int, h: float) -> float:
    """Return the path of an element at a distance from its start [m]."""
    p, d, b = s.path[i, plane, 0], s.path[i, plane, 1], s.path[i, plane, 2]
    return float(p + h * (d + 0.5 * h * b))


@inlined
def _unloaded(c: Cut, row: int, plane: int, k: int) -> float:
    """Return deflection (k = 0) or slope (k = 1) of the unloaded end of a row."""
    s = c.springs
    b, tilt = c.guide[plane, 0], c.guide[plane, 1]
    return float(s.rest[row, plane, k] + s.response[row, k, 0] * b + s.response[row, k, 1] * tilt)


@inlined
def _resume(n: Steered, c: Cut) -> None:
    """Restart the path at the tip if the tip was shifted since the last cut."""
    s, last = c.springs, c.counts[LAST]
    part = c.pose[DEPTH] - s.depths[last]
    shift = 0.0
    for plane in range(2):
        if part > _NOTHING:
            shift = max(shift, abs(c.tip[plane, 0] - _path_end(s, last, plane, part)))
        else:
            shift = max(shift, abs(c.tip[plane, 0] - s.path[last, plane, 0]))
    if shift <= SHIFT:
        return
    if part > _NOTHING:
        if part < _PART * (_next_node(n, s.depths[last]) - s.depths[last]):
            # A path this short is cut again.
            return
        _keep(c)
    last = c.counts[LAST]
    for plane in range(2):
        s.path[last, plane, 0] = c.tip[plane, 0]
    c.counts[ANEW] = 1


@inlined
def _cut(n: Steered, c: Cut) -> None:
    """Cut from the last node to the depth of the tip: compute the path of this element."""
    s, last = c.springs, c.counts[LAST]
    h = c.pose[DEPTH] - s.depths[last]
    c.pose[DEEPEST] = c.pose[DEPTH]
    layer = _layer(n, s.depths[last])
    _load(n, c, layer)
    s.stiffness[last] = n.stiffness[layer]
    e = _over(n, s, last, h)
    carry(s, last, e)
    anew = c.counts[ANEW] == 1
    before = 0.0 if anew else s.depths[last] - s.depths[last - 1]
    for plane in range(2):
        # A parabola through the previous node, this node and the tip; or a straight line. The tip
        # lies on the path: linear equation for its offset from the line.
        value, lean = s.path[last, plane, 0], 0.0
        slope, bend = 1.0 / h, 0.0
        if not anew:
            lean = (value - s.path[last - 1, plane, 0]) / before
            bend = 2.0 / (h * (h + before))
            slope = 0.5 * before * bend
        base = (
            _unloaded(c, last + 1, plane, 0)
            + e.c00 * c.load[plane]
            + value * e.value[0]
            + lean * e.slope[0]
        )
        share = slope * e.slope[0] + bend * e.bend[0]
        off = (base - value - lean * h) / (1.0 - share)
        s.path[last, plane, 1] = lean + slope * off
        s.path[last, plane, 2] = bend * off
        follow(s, last, plane, e)
        load = c.load[plane]
        c.tip[plane, 0] = _unloaded(c, last + 1, plane, 0) + e.c00 * load
        c.tip[plane, 1] = _unloaded(c, last + 1, plane, 1) + e.c01 * load
    s.depths[last + 1] = c.pose[DEPTH]


@inlined
def _keep(c: Cut) -> None:
    """Make the tip a node: the path up to it is final."""
    s, last = c.springs, c.counts[LAST]
    h = s.depths[last + 1] - s.depths[last]
    for plane in range(2):
        s.path[last + 1, plane, 0] = _path_end(s, last, plane, h)
        s.path[last + 1, plane, 1] = s.path[last + 1, plane, 2] = 0.0
    c.counts[LAST], c.counts[ANEW] = last + 1, 0


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
def _over(n: Steered, s: SpringSupports, i: int, h: float) -> Crossing:
    """Return the crossing of an element or of its first part of length h [m]."""
    return cross(
        element(n.ei, s.stiffness[i], h),
        s.compliance[i, 0],
        s.compliance[i, 1],
        s.compliance[i, 2],
    )


@kernel
def place(n: Steered, c: Cut) -> tuple[float, float, float]:
    """
    Compute load, deflection and slope of the tip at the present depth.

    Returns the compliance c00, c01, c11 of the tip [m/N, 1/N, rad/(N m)].
    """
    s, depth = c.springs, c.pose[DEPTH]
    i = node_before(s, c.counts[LAST], depth)
    e = _over(n, s, i, depth - s.depths[i])
    _load(n, c, _layer(n, s.depths[i]))
    for plane in range(2):
        w, turn = _unloaded(c, i, plane, 0), _unloaded(c, i, plane, 1)
        p, d, b = s.path[i, plane, 0], s.path[i, plane, 1], s.path[i, plane, 2]
        load = c.load[plane]
        first = e.t00 * w + e.t01 * turn + e.c00 * load
        second = e.t10 * w + e.t11 * turn + e.c01 * load
        c.tip[plane, 0] = first + p * e.value[0] + d * e.slope[0] + b * e.bend[0]
        c.tip[plane, 1] = second + p * e.value[1] + d * e.slope[1] + b * e.bend[1]
    return e.c00, e.c01, e.c11


@kernel
def respond(n: Steered, c: Cut, found: Matrix) -> None:
    """Compute deflection and slope of the tip per position and tilt of the guide, shape (2, 2)."""
    s, depth = c.springs, c.pose[DEPTH]
    i = node_before(s, c.counts[LAST], depth)
    e = _over(n, s, i, depth - s.depths[i])
    for k in range(2):
        w, turn = s.response[i, 0, k], s.response[i, 1, k]
        found[0, k] = e.t00 * w + e.t01 * turn
        found[1, k] = e.t10 * w + e.t11 * turn


@inlined
def _bend(n: Steered, c: Cut, found: FloatArray, felt: FloatArray) -> int:
    """Compute the shape of the needle and the load on the guide; return the last node."""
    depth = c.pose[DEPTH]
    last = node_before(c.springs, c.counts[LAST], depth)
    shape(c.springs, last, depth, n.ei, c.pose[FREE], c.guide, c.load, found, felt)
    return last


@kernel
def bring(held: Boxed[CuttingNeedle], to: GuidePose) -> None:
    """Apply `move` to a held needle."""
    move(held.value.constants, held.value.state, to)


@kernel
def bend(held: Boxed[CuttingNeedle], found: Array3, felt: Matrix) -> int:
    """
    Compute the shape of a held needle and the load on the guide; return the node before the tip.

    ``found``, shape (2, rows, 2), takes deflections [m] and slopes by plane and node; ``felt``,
    shape (2, 2), force [N] and moment [N m] of the needle on the guide by plane.
    """
    return _bend(held.value.constants, held.value.state, found, felt)


@kernel
def remember(draws: Matrix, part: float) -> None:
    """Correlate draws, shape (k, 2), in place: add a fraction of the previous draw to each."""
    for i in range(1, len(draws)):
        for plane in range(2):
            draws[i, plane] += part * draws[i - 1, plane]


@kernel
def set_free(n: Steered, c: Cut, free: float) -> None:
    """Change the free length between guide and skin [m], in place."""
    s = c.springs
    c.pose[FREE] = free
    begin(s, n.ei, free, n.skin, c.entry)
    for i in range(c.counts[LAST]):
        e = _over(n, s, i, s.depths[i + 1] - s.depths[i])
        carry(s, i, e)
        follow(s, i, 0, e)
        follow(s, i, 1, e)
    place(n, c)


@kernel
def insert(
    constants: Matrix,
    layers: Array3,
    cell: float,
    wander: Array3,
    poses: Array3,
    runs: IntVector,
    c: Cut,
    tips: Array3,
    felt: Array3,
) -> None:
    """
    Insert needles from the skin through sequences of poses; arrays with one row apply to all runs.

    Parameters
    ----------
    constants : ndarray, shape (runs or 1, 7)
        The fields of `Steered` up to ``length``, and the free length.
    layers : ndarray, shape (runs or 1, 3, layers)
        Start, stiffness and bevel load of each layer; a start of inf marks an unused layer.
    cell : float
        Distance between the loads of `wander` [m].
    wander : ndarray, shape (runs or 1, cells, 2)
        As in `Steered`.
    poses : ndarray, shape (runs or 1, k, 6)
        The fields of `GuidePose`; the first pose places the tip on the skin.
    runs : ndarray of int, shape (m,)
        Indices of the runs to compute.
    c : Cut
        Work memory: the state of one needle.
    tips : ndarray, shape (runs, k, 2)
        Output: deflections of the tip in x and z [m].
    felt : ndarray, shape (runs, k, 2)
        Output: forces of the needle on the guide in x and z [N]; not computed if empty.

    """
    nodes, of_guide = np.empty((2, len(c.springs.depths), 2)), np.empty((2, 2))
    for run in runs:
        v = constants[run % len(constants)]
        layer = layers[run % len(layers)]
        n = Steered(
            v[0], v[1], v[2], v[3], v[4], v[5],
            layer[0], layer[1], layer[2], cell, wander[run % len(wander)],
        )  # fmt: skip
        way = poses[run % len(poses)]
        for i in range(len(way)):
            p = way[i]
            to = GuidePose(p[0], p[1], p[2], p[3], p[4], p[5])
            if i == 0:
                start(n, c, to, v[6])
            move(n, c, to)
            tips[run, i, 0], tips[run, i, 1] = c.tip[0, 0], c.tip[1, 0]
            if len(felt) > 0:
                _bend(n, c, nodes, of_guide)
                felt[run, i, 0], felt[run, i, 1] = of_guide[0, 0], of_guide[1, 0]
