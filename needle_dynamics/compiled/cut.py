"""The needle that cuts its path: the tip goes in, and holds still, out, and in again along it."""

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
    Springs,
)
from needle_dynamics.compiled.cache import compiled, inlined, kernel
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.held import Held

#: Places in `Cut.pose`.
DEPTH: Final = 0
ROLL: Final = 1
TIP_ROLL: Final = 2
FREE: Final = 3
DEEPEST: Final = 4

#: Places in `Cut.counts`: row of the last node, and whether the path begins anew there.
LAST: Final = 0
ANEW: Final = 1

#: Way back over which uncut tissue lets go of the tip [m]: a third of the length of a bevel of 25
#: degrees at 18 gauge. A robot that rests to some micrometers does not make the tip jump.
_RELEASE: Final = 1e-3

#: Shift of the tip at rest that begins a new path [m]: more than rounding, less than matters.
SHIFT: Final = 1e-9

#: A path begins anew within an element only if that is then at least this part of its length.
_PART: Final = 0.5

#: Where `insert` shall not say what the guide feels.
NOT_FELT: Final = np.empty((0, 0, 2))

#: Shorter pieces of path than this are none [m].
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
        Friction torque per inserted length [N m/m].
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
        Lateral loads on the tip by depth, in planes x and z [N]: what is not uniform in tissue;
        straight lines between them.

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
    springs : Springs
        Rows of the nodes; the row after the last node is the tip's.
    guide : ndarray, shape (2, 2)
        By plane (x, z): position [m] and tilt of the guide.
    pose : ndarray, shape (5,)
        Depth of the tip [m], roll of base and tip [rad], free length, greatest depth [m].
    entry : ndarray, shape (2,)
        Where the skin was pierced, by plane [m].
    tip : ndarray, shape (2, 2)
        By plane: deflection [m] and slope of the tip.
    load : ndarray, shape (2,)
        Lateral load on the tip, by plane [N].
    counts : ndarray of int, shape (2,)
        Row of the last node, and whether the path begins anew there.

    """

    springs: Springs
    guide: Matrix
    pose: Vector
    entry: Vector
    tip: Matrix
    load: Vector
    counts: IntVector


class Needle(NamedTuple):
    """
    A needle that cuts its path.

    Attributes
    ----------
    constants : Steered
        Its constants.
    state : Cut
        Its state.

    """

    constants: Steered
    state: Cut


class Pose(NamedTuple):
    """
    Where the needle is to be brought.

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
def start(n: Steered, c: Cut, to: Pose, free: float) -> None:
    """
    Set the tip on the skin.

    Parameters
    ----------
    n : Steered
        Constants.
    c : Cut
        State, overwritten.
    to : Pose
        Pose; its depth does not count.
    free : float
        Free length between guide and skin [m].

    """
    c.pose[DEPTH] = c.pose[DEEPEST] = 0.0
    c.pose[ROLL] = c.pose[TIP_ROLL] = to.roll
    c.pose[FREE] = free
    c.guide[0, 0], c.guide[0, 1], c.guide[1, 0], c.guide[1, 1] = to.x, to.tilt_x, to.z, to.tilt_z
    c.counts[LAST], c.counts[ANEW] = 0, 1
    # The bevel bends the needle before the skin holds it.
    _load(n, c, 0)
    for plane in range(2):
        c.entry[plane] = c.guide[plane, 0] + free * c.guide[plane, 1]
        c.entry[plane] += free**3 / (3.0 * n.ei) * c.load[plane]
        c.springs.path[0, plane, 0] = c.entry[plane]
        c.springs.path[0, plane, 1] = c.springs.path[0, plane, 2] = 0.0
    begin(c.springs, n.ei, free, n.skin, c.entry)
    place(n, c)


@inlined
def move(n: Steered, c: Cut, to: Pose) -> None:
    """
    Bring the needle to a pose; guide and roll change evenly with the depth.

    Parameters
    ----------
    n : Steered
        Constants.
    c : Cut
        State, overwritten.
    to : Pose
        The pose. Its depth must be at least 0 and within what the rows can hold.

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
                    # Another load in the next layer: the tip springs over.
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
    to: Pose,
    x: float,
    tilt_x: float,
    z: float,
    tilt_z: float,
    roll: float,
    part: float,
    depth: float,
) -> None:
    """Set depth, guide and roll to a part of the way."""
    c.pose[DEPTH] = depth
    c.guide[0, 0] = x + part * (to.x - x)
    c.guide[0, 1] = tilt_x + part * (to.tilt_x - tilt_x)
    c.guide[1, 0] = z + part * (to.z - z)
    c.guide[1, 1] = tilt_z + part * (to.tilt_z - tilt_z)
    c.pose[ROLL] = roll + part * (to.roll - roll)
    # Friction holds the tip while the base takes up the windup; exact for the tip at one depth.
    torque = n.turning * depth
    windup = torque * n.twist * max(0.0, n.length - 0.5 * depth)
    low, high = c.pose[ROLL] - windup, c.pose[ROLL] + windup
    c.pose[TIP_ROLL] = min(max(c.pose[TIP_ROLL], low), high)


@inlined
def _layer(n: Steered, depth: float) -> int:
    """Return the layer below a depth."""
    layer = 0
    while layer + 1 < len(n.starts) and n.starts[layer + 1] <= depth:
        layer += 1
    return layer


@inlined
def _next_node(n: Steered, depth: float) -> float:
    """Return where the element that starts at a depth ends: it stays within its layer."""
    layer = _layer(n, depth)
    border = n.starts[layer + 1] if layer + 1 < len(n.starts) else inf
    # Whole multiples of the element, so that the nodes do not depend on the steps taken.
    left = border - depth
    if left > 1e6 * n.element:
        return depth + n.element
    count = ceil(left / n.element - 1e-9)
    return border if count <= 1 else depth + left / count


@inlined
def _load(n: Steered, c: Cut, layer: int) -> None:
    """Set the lateral load on the tip in a layer: none if it does not touch uncut tissue."""
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
def _path_end(s: Springs, i: int, plane: int, h: float) -> float:
    """Return the value of the path of an element at a distance from its start."""
    p, d, b = s.path[i, plane, 0], s.path[i, plane, 1], s.path[i, plane, 2]
    return float(p + h * (d + 0.5 * h * b))


@inlined
def _unloaded(c: Cut, row: int, plane: int, k: int) -> float:
    """Return deflection or slope of the unloaded end of a row."""
    s = c.springs
    b, tilt = c.guide[plane, 0], c.guide[plane, 1]
    return float(s.rest[row, plane, k] + s.response[row, k, 0] * b + s.response[row, k, 1] * tilt)


@inlined
def _resume(n: Steered, c: Cut) -> None:
    """Begin to cut: where the tip now stands, if it was shifted since it last cut."""
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
            # Path this short is cut anew.
            return
        _keep(c)
    last = c.counts[LAST]
    for plane in range(2):
        s.path[last, plane, 0] = c.tip[plane, 0]
    c.counts[ANEW] = 1


@inlined
def _cut(n: Steered, c: Cut) -> None:
    """Bring the tip to its depth by cutting on from the last node: find the path up to it."""
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
        # A parabola through the node before, this one and the tip; or a straight line. The tip
        # stands on the path: what it leaves the line by follows from what that does to it.
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
    """Make the tip a node: the path up to it is cut for good."""
    s, last = c.springs, c.counts[LAST]
    h = s.depths[last + 1] - s.depths[last]
    for plane in range(2):
        s.path[last + 1, plane, 0] = _path_end(s, last, plane, h)
        s.path[last + 1, plane, 1] = s.path[last + 1, plane, 2] = 0.0
    c.counts[LAST], c.counts[ANEW] = last + 1, 0


@compiled
def node_before(s: Springs, last: int, depth: float) -> int:
    """
    Return the row of the node before a depth.

    Parameters
    ----------
    s : Springs
        Rows.
    last : int
        Row of the last node.
    depth : float
        Depth [m].

    Returns
    -------
    int
        The row.

    """
    low, high = 0, last
    while low < high:
        middle = (low + high + 1) // 2
        if s.depths[middle] <= depth:
            low = middle
        else:
            high = middle - 1
    return low


@inlined
def _over(n: Steered, s: Springs, i: int, h: float) -> Crossing:
    """Return the crossing of an element, or of its first part."""
    return cross(
        element(n.ei, s.stiffness[i], h),
        s.compliance[i, 0],
        s.compliance[i, 1],
        s.compliance[i, 2],
    )


@kernel
def place(n: Steered, c: Cut) -> tuple[float, float, float]:
    """
    Find the tip: its load, its deflection and slope, and its compliance.

    Parameters
    ----------
    n : Steered
        Constants.
    c : Cut
        State; `tip` and `load` are overwritten.

    Returns
    -------
    c00, c01, c11 : float
        Compliance of the tip [m/N, 1/N, rad/(N m)].

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
    """
    Find what the tip does per change of the guide, at rest.

    Parameters
    ----------
    n : Steered
        Constants.
    c : Cut
        State.
    found : ndarray, shape (2, 2)
        For deflection and slope of the tip, per position and tilt of the guide.

    """
    s, depth = c.springs, c.pose[DEPTH]
    i = node_before(s, c.counts[LAST], depth)
    e = _over(n, s, i, depth - s.depths[i])
    for k in range(2):
        w, turn = s.response[i, 0, k], s.response[i, 1, k]
        found[0, k] = e.t00 * w + e.t01 * turn
        found[1, k] = e.t10 * w + e.t11 * turn


@inlined
def _bend(n: Steered, c: Cut, found: FloatArray, felt: FloatArray) -> int:
    """Find the needle at its nodes, and what the guide feels; return the last node."""
    depth = c.pose[DEPTH]
    last = node_before(c.springs, c.counts[LAST], depth)
    shape(c.springs, last, depth, n.ei, c.pose[FREE], c.guide, c.load, found, felt)
    return last


@kernel
def bring(held: Held[Needle], to: Pose) -> None:
    """
    Do what `move` does with a needle that is held.

    Parameters
    ----------
    held : Held of Needle
        The needle, overwritten.
    to : Pose
        As for `move`.

    """
    move(held.value.constants, held.value.state, to)


@kernel
def bend(held: Held[Needle], found: Array3, felt: Matrix) -> int:
    """
    Find the needle from the guide to the node before the tip, and what the guide feels.

    Parameters
    ----------
    held : Held of Needle
        The needle.
    found : ndarray, shape (2, rows, 2)
        For deflections [m] and slopes, by plane and node.
    felt : ndarray, shape (2, 2)
        For force [N] and moment [N m] of the needle on the guide, by plane.

    Returns
    -------
    int
        Row of the node before the tip.

    """
    return _bend(held.value.constants, held.value.state, found, felt)


@kernel
def remember(draws: Matrix, part: float) -> None:
    """
    Add to each draw a part of the one before it.

    Parameters
    ----------
    draws : ndarray, shape (k, 2)
        Independent draws; overwritten.
    part : float
        The part.

    """
    for i in range(1, len(draws)):
        for plane in range(2):
            draws[i, plane] += part * draws[i - 1, plane]


@kernel
def set_free(n: Steered, c: Cut, free: float) -> None:
    """
    Change the free length: the skin came towards the guide, or went away from it.

    Parameters
    ----------
    n : Steered
        Constants.
    c : Cut
        State, overwritten.
    free : float
        Free length between guide and skin [m].

    """
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
    Bring needles from the skin through poses. Of arrays with one row that row is for all runs.

    Parameters
    ----------
    constants : ndarray, shape (runs or 1, 7)
        The numbers of `Steered`, to `length`, and the free length.
    layers : ndarray, shape (runs or 1, 3, layers)
        Start, stiffness and load of the bevel of each layer; a start of inf is of no layer.
    cell : float
        Distance between the loads of `wander` [m].
    wander : ndarray, shape (runs or 1, cells, 2)
        As in `Steered`.
    poses : ndarray, shape (runs or 1, k, 6)
        The numbers of `Pose`; the first one sets the tip on the skin.
    runs : ndarray of int, shape (m,)
        Which of the runs to do.
    c : Cut
        Room for the state of one needle.
    tips : ndarray, shape (runs, k, 2)
        For the deflections of the tip in x and z [m].
    felt : ndarray, shape (runs, k, 2)
        For the forces of the needle on the guide in x and z [N]; not wanted if it is empty.

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
            to = Pose(p[0], p[1], p[2], p[3], p[4], p[5])
            if i == 0:
                start(n, c, to, v[6])
            move(n, c, to)
            tips[run, i, 0], tips[run, i, 1] = c.tip[0, 0], c.tip[1, 0]
            if len(felt) > 0:
                _bend(n, c, nodes, of_guide)
                felt[run, i, 0], felt[run, i, 1] = of_guide[0, 0], of_guide[1, 0]
