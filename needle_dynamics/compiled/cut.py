# SPDX-License-Identifier: Apache-2.0
"""Motion of a bevel-tip needle: cutting, rest, withdrawal, reinsertion along the cut path."""

from __future__ import annotations

from math import ceil, inf
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import Array3, IntVector, Matrix
from needle_dynamics.compiled.beam import begin, carry, follow, SpringSupports
from needle_dynamics.compiled.cache import inlined, kernel
from needle_dynamics.compiled.cutting_needle import (
    compute_shape,
    crossing,
    Cut,
    CuttingNeedle,
    DEEPEST,
    DEPTH,
    FREE,
    LAST,
    place,
    RESTARTS,
    ROLL,
    set_tip_load,
    Steered,
    TIP_ROLL,
    unloaded_end,
)
from needle_dynamics.compiled.tissue import layer_at
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Shift of the tip at rest that restarts the path [m]: above rounding, negligible in size.
SHIFT: Final = 1e-9

#: Least fraction of an element that is cut before the path may restart within it.
PART: Final = 0.5

#: Placeholder for the output ``forces`` of `insert`: guide forces are not computed.
NO_FORCES: Final = np.empty((0, 0, 2))

NOTHING: Final = 1e-12  #: length below which a piece of path is ignored [m]


class GuidePose(NamedTuple):
    """Commanded pose of the needle."""

    depth: float  #: depth of the tip [m]
    #: Position [m] and tilt of the guide, by plane.
    x: float
    tilt_x: float
    z: float
    tilt_z: float
    roll: float  #: roll of the base [rad]


@kernel
def start(n: Steered, c: Cut, to: GuidePose, free: float) -> None:
    """Place the tip on the skin with a free length from the guide [m]; ignores ``to.depth``."""
    c.pose[DEPTH] = c.pose[DEEPEST] = 0.0
    c.pose[ROLL] = c.pose[TIP_ROLL] = to.roll
    c.pose[FREE] = free
    c.guide[0, 0], c.guide[0, 1], c.guide[1, 0], c.guide[1, 1] = to.x, to.tilt_x, to.z, to.tilt_z
    c.counts[LAST], c.counts[RESTARTS] = 0, 1
    # The bevel bends the needle before the skin supports it.
    set_tip_load(n, c, 0)
    for plane in range(2):
        c.entry[plane] = c.guide[plane, 0] + free * c.guide[plane, 1]
        c.entry[plane] += free**3 / (3.0 * n.ei) * c.load[plane]
        c.springs.path[0, plane, 0] = c.entry[plane]
        c.springs.path[0, plane, 1] = c.springs.path[0, plane, 2] = 0.0
    begin(c.springs, n.ei, free, n.skin, c.entry)
    place(n, c)


@inlined
def move(n: Steered, c: Cut, to: GuidePose) -> None:
    """Move the needle to a pose in its rows, in place; guide and roll change with the depth."""
    begun, deepest, g = c.pose[DEPTH], c.pose[DEEPEST], c.guide
    before = GuidePose(begun, g[0, 0], g[0, 1], g[1, 0], g[1, 1], c.pose[ROLL])
    if to.depth > deepest:
        far = to.depth - begun
        if begun < deepest:
            part = (deepest - begun) / far
            _set(n, c, before, to, part, deepest)
            place(n, c)
        _resume(n, c)
        while True:
            last = c.counts[LAST]
            end = node_after(n, c.springs.depths[last])
            depth = min(end, to.depth)
            _set(n, c, before, to, (depth - begun) / far, depth)
            _cut(n, c)
            if depth == end:
                _keep(c)
                above = n.bevel[layer_at(n.starts, c.springs.depths[last])]
                if n.bevel[layer_at(n.starts, end)] != above:
                    # Different bevel load in the next layer: the tip jumps.
                    place(n, c)
                    _resume(n, c)
            if depth == to.depth:
                break
    else:
        _set(n, c, before, to, 1.0, to.depth)
        place(n, c)


@kernel
def move_boxed(boxed: Boxed[CuttingNeedle], to: GuidePose) -> None:
    move(boxed.value.constants, boxed.value.state, to)


@inlined
def _set(n: Steered, c: Cut, a: GuidePose, b: GuidePose, part: float, depth: float) -> None:
    """Set depth [m], and guide and roll at a fraction of the motion from pose a to pose b."""
    c.pose[DEPTH] = depth
    c.guide[0, 0] = a.x + part * (b.x - a.x)
    c.guide[0, 1] = a.tilt_x + part * (b.tilt_x - a.tilt_x)
    c.guide[1, 0] = a.z + part * (b.z - a.z)
    c.guide[1, 1] = a.tilt_z + part * (b.tilt_z - a.tilt_z)
    c.pose[ROLL] = a.roll + part * (b.roll - a.roll)
    # Friction torque holds the tip within the windup; exact at constant depth.
    torque = n.turning * depth
    windup = torque * n.twist * max(0.0, n.length - 0.5 * depth)
    low, high = c.pose[ROLL] - windup, c.pose[ROLL] + windup
    c.pose[TIP_ROLL] = min(max(c.pose[TIP_ROLL], low), high)


@inlined
def node_after(n: Steered, depth: float) -> float:
    """Return the end of the element that starts at a depth [m]; it stays within its layer."""
    layer = layer_at(n.starts, depth)
    border = n.starts[layer + 1] if layer + 1 < len(n.starts) else inf
    # Equal elements in a layer, so that the nodes do not depend on the steps.
    left = border - depth
    if left > 1e6 * n.element:
        return depth + n.element
    count = ceil(left / n.element - 1e-9)
    return border if count <= 1 else depth + left / count


@inlined
def _path_end(s: SpringSupports, i: int, plane: int, h: float) -> float:
    """Return the path of an element at a distance from its start [m]."""
    p, d, b = s.path[i, plane, 0], s.path[i, plane, 1], s.path[i, plane, 2]
    return float(p + h * (d + 0.5 * h * b))


@inlined
def _resume(n: Steered, c: Cut) -> None:
    """Restart the path at the tip if the tip was shifted since the last cut."""
    s, last = c.springs, c.counts[LAST]
    part = c.pose[DEPTH] - s.depths[last]
    cut, shift = part if part > NOTHING else 0.0, 0.0
    for plane in range(2):
        shift = max(shift, abs(c.tip[plane, 0] - _path_end(s, last, plane, cut)))
    if shift <= SHIFT:
        return
    if part > NOTHING:
        if part < PART * (node_after(n, s.depths[last]) - s.depths[last]):
            # A path this short is cut again.
            return
        _keep(c)
    last = c.counts[LAST]
    for plane in range(2):
        s.path[last, plane, 0] = c.tip[plane, 0]
    c.counts[RESTARTS] = 1


@inlined
def _cut(n: Steered, c: Cut) -> None:
    """Cut from the last node to the depth of the tip: compute the path of this element."""
    s, last = c.springs, c.counts[LAST]
    h = c.pose[DEPTH] - s.depths[last]
    c.pose[DEEPEST] = c.pose[DEPTH]
    layer = layer_at(n.starts, s.depths[last])
    set_tip_load(n, c, layer)
    s.stiffness[last] = n.stiffness[layer]
    e = crossing(n, s, last, h)
    carry(s, last, e)
    restarts = c.counts[RESTARTS] == 1
    before = 0.0 if restarts else s.depths[last] - s.depths[last - 1]
    for plane in range(2):
        # A parabola through the previous node, this node and the tip; or a straight line. The tip
        # lies on the path: linear equation for its offset from the line.
        value, lean = s.path[last, plane, 0], 0.0
        slope, bend = 1.0 / h, 0.0
        if not restarts:
            lean = (value - s.path[last - 1, plane, 0]) / before
            bend = 2.0 / (h * (h + before))
            slope = 0.5 * before * bend
        base = (
            unloaded_end(c, last + 1, plane, 0)
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
        c.tip[plane, 0] = unloaded_end(c, last + 1, plane, 0) + e.c00 * load
        c.tip[plane, 1] = unloaded_end(c, last + 1, plane, 1) + e.c01 * load
    s.depths[last + 1] = c.pose[DEPTH]


@inlined
def _keep(c: Cut) -> None:
    """Make the tip a node: the path up to it is final."""
    s, last = c.springs, c.counts[LAST]
    h = s.depths[last + 1] - s.depths[last]
    for plane in range(2):
        s.path[last + 1, plane, 0] = _path_end(s, last, plane, h)
        s.path[last + 1, plane, 1] = s.path[last + 1, plane, 2] = 0.0
    c.counts[LAST], c.counts[RESTARTS] = last + 1, 0


@kernel
def correlate(draws: Matrix, part: float) -> None:
    """Correlate draws, shape (k, 2), in place: add a fraction of the previous draw to each."""
    for i in range(1, len(draws)):
        for plane in range(2):
            draws[i, plane] += part * draws[i - 1, plane]


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
    forces: Array3,
) -> None:
    """Insert needles through sequences of poses; arrays with one row apply to all runs."""
    # ``constants``, shape (runs, 7): the fields of `Steered` up to ``length``, and the free
    # length; ``layers``, shape (runs, 3, layers): start (inf: unused), stiffness and bevel load;
    # ``wander``, shape (runs, cells, 2); ``poses``, shape (runs, k, 6): fields of `GuidePose`, the
    # first on the skin; ``runs``, shape (m,): indices of the runs to compute; ``c``: work memory.
    # Outputs: ``tips``, shape (runs, k, 2), deflections in x and z [m]; ``forces`` on the guide,
    # likewise [N], not computed if empty.
    nodes, guide_load = np.empty((len(c.springs.depths), 2, 2)), np.empty((2, 2))
    for run in runs:
        v = constants[run % len(constants)]
        layer = layers[run % len(layers)]
        n = Steered(
            v[0], v[1], v[2], v[3], v[4], v[5],
            layer[0], layer[1], layer[2], cell, wander[run % len(wander)],
        )  # fmt: skip
        sequence = poses[run % len(poses)]
        for i in range(len(sequence)):
            p = sequence[i]
            to = GuidePose(p[0], p[1], p[2], p[3], p[4], p[5])
            if i == 0:
                start(n, c, to, v[6])
            move(n, c, to)
            tips[run, i, 0], tips[run, i, 1] = c.tip[0, 0], c.tip[1, 0]
            if len(forces) > 0:
                compute_shape(n, c, nodes, guide_load)
                forces[run, i, 0], forces[run, i, 1] = guide_load[0, 0], guide_load[1, 0]
