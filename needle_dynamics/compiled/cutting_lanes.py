# SPDX-License-Identifier: Apache-2.0
"""
Many steered needles, in the lanes of vector registers: the cut of `cut`, without its history.

The path before the last node does not change, so that the state of a needle is that of its last
node and its tip. Loops over lanes have no branches, as in `lanes`.
"""

from math import cos, sin
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.beam import cross, Crossing, element
from needle_dynamics.compiled.cache import compiled, inlined
from needle_dynamics.compiled.cut import node_after, NOTHING, PART, SHIFT
from needle_dynamics.compiled.cutting_needle import Cut, Steered
from needle_dynamics.compiled.lane_rows import LANES

# Offset of each row of the lanes. Depth of the tip, of the last node and of the node before [m],
# whether the path restarts at the last node, bending stiffness, sine and cosine of the roll, and
# stiffness of the tissue after the last node.
(
    DEPTH, NODE, BEFORE, _RESTARTS, _EI, _SINE, _COSINE, _STIFFNESS,
    # One motion: depth of its end, length to cut or 0, whether the tip becomes a node, and tissue.
    TO, LENGTH, KEEPS, TISSUE,
    # Compliance and response at the last node, as in `SpringSupports`; then the same at the tip.
    _C, _C01, _C11, _R00, _R01, _R10, _R11,
) = range(0, 19 * LANES, LANES)  # fmt: skip
_TIP: Final = 7 * LANES

# By plane: position and tilt of the guide, load and deflection of the tip; path at the last node
# and at the node before, its slope and bend; deflection and slope of the unloaded end at the last
# node and at the tip.
(
    GUIDE, _TILT, _LOAD, TIP, _PATH, _LAST, _LEAN, _BEND, _REST, _TURN, _TIP_REST, _TIP_TURN,
) = range(26 * LANES, 38 * LANES, LANES)  # fmt: skip
PLANE: Final = 12 * LANES
ROWS: Final = 50


@inlined
def load_cut(w: FloatArray, i: int, n: Steered, c: Cut, roll: float) -> None:
    """Load a needle on the skin, of `start` and with a roll [rad], into a lane."""
    s = c.springs
    w[_EI + i], w[_SINE + i], w[_COSINE + i] = n.ei, sin(roll), cos(roll)
    w[DEPTH + i] = w[NODE + i] = w[BEFORE + i] = w[_STIFFNESS + i] = 0.0
    w[_RESTARTS + i] = 1.0
    w[_C + i], w[_C01 + i], w[_C11 + i] = s.compliance[0]
    w[_R00 + i], w[_R01 + i] = s.response[0, 0]
    w[_R10 + i], w[_R11 + i] = s.response[0, 1]
    for plane in range(2):
        x = plane * PLANE + i
        w[_REST + x], w[_TURN + x] = s.rest[0, plane]
        w[_PATH + x], w[TIP + x] = s.path[0, plane, 0], c.tip[plane, 0]
        w[GUIDE + x], w[_TILT + x] = c.guide[plane]
        w[_LAST + x] = w[_LEAN + x] = w[_BEND + x] = 0.0


@inlined
def set_tip_force(n: Steered, w: FloatArray, i: int, layer: int, depth: float) -> None:
    """Set the lateral load on the tip [N] as `set_tip_load`."""
    at = depth / n.cell
    cell = min(int(at), len(n.wander) - 2)
    part, bevel = at - cell, n.bevel[layer]
    w[_LOAD + i] = bevel * w[_SINE + i]
    w[_LOAD + PLANE + i] = bevel * w[_COSINE + i]
    for plane in range(2):
        low, high = n.wander[cell, plane], n.wander[cell + 1, plane]
        w[_LOAD + plane * PLANE + i] += low + part * (high - low)


@inlined
def _crossing(w: FloatArray, i: int, k: float, h: float) -> Crossing:
    return cross(element(w[_EI + i], k, h), w[_C + i], w[_C01 + i], w[_C11 + i])


@inlined
def _place_plane(w: FloatArray, i: int, x: int, e: Crossing) -> None:
    b, tilt = w[GUIDE + x], w[_TILT + x]
    rest = w[_REST + x] + w[_R00 + i] * b + w[_R01 + i] * tilt
    turn = w[_TURN + x] + w[_R10 + i] * b + w[_R11 + i] * tilt
    first = e.t00 * rest + e.t01 * turn + e.c00 * w[_LOAD + x]
    path = w[_PATH + x] * e.value[0]
    tip = first + path + w[_LEAN + x] * e.slope[0] + w[_BEND + x] * e.bend[0]
    w[TIP + x] = tip if w[LENGTH + i] > 0.0 else w[TIP + x]


@compiled
def place_lanes(w: FloatArray, first: int, end: int) -> None:
    """Place the tip at its depth in the lanes with a length, as `place`."""
    for i in range(first, end):
        e = _crossing(w, i, w[_STIFFNESS + i], w[DEPTH + i] - w[NODE + i])
        _place_plane(w, i, i, e)
        _place_plane(w, i, PLANE + i, e)


@inlined
def _cut_plane(w: FloatArray, i: int, x: int, e: Crossing, r00: float, r01: float) -> None:
    h, restarts = w[LENGTH + i], w[_RESTARTS + i] > 0.0
    cuts, keeps = h > 0.0, w[KEEPS + i] > 0.0
    before = w[NODE + i] - w[BEFORE + i]
    value, b, tilt, load = w[_PATH + x], w[GUIDE + x], w[_TILT + x], w[_LOAD + x]
    straight = (value - w[_LAST + x]) / before
    bent = 2.0 / (h * (h + before))
    lean = 0.0 if restarts else straight
    bend = 0.0 if restarts else bent
    slope = 1.0 / h if restarts else 0.5 * before * bent
    rest = e.t00 * w[_REST + x] + e.t01 * w[_TURN + x]
    turn = e.t10 * w[_REST + x] + e.t11 * w[_TURN + x]
    end = rest + r00 * b + r01 * tilt
    base = end + e.c00 * load + value * e.value[0] + lean * e.slope[0]
    share = slope * e.slope[0] + bend * e.bend[0]
    off = (base - value - lean * h) / (1.0 - share)
    lean, bend = lean + slope * off, bend * off
    rest += value * e.value[0] + lean * e.slope[0] + bend * e.bend[0]
    turn += value * e.value[1] + lean * e.slope[1] + bend * e.bend[1]
    tip = rest + r00 * b + r01 * tilt + e.c00 * load
    w[TIP + x] = tip if cuts else w[TIP + x]
    w[_TIP_REST + x] = rest if cuts else w[_TIP_REST + x]
    w[_TIP_TURN + x] = turn if cuts else w[_TIP_TURN + x]
    w[_REST + x] = rest if keeps else w[_REST + x]
    w[_TURN + x] = turn if keeps else w[_TURN + x]
    w[_LAST + x] = value if keeps else w[_LAST + x]
    w[_PATH + x] = value + h * (lean + 0.5 * h * bend) if keeps else value
    w[_LEAN + x] = 0.0 if keeps else (lean if cuts else w[_LEAN + x])
    w[_BEND + x] = 0.0 if keeps else (bend if cuts else w[_BEND + x])


@inlined
def _renew(w: FloatArray, i: int, row: int, value: float) -> None:
    w[row + _TIP + i] = value if w[LENGTH + i] > 0.0 else w[row + _TIP + i]
    w[row + i] = value if w[KEEPS + i] > 0.0 else w[row + i]


@compiled
def cut_lanes(w: FloatArray, n: int) -> None:
    """Cut from the last node to the tip in the lanes with a length, as in `cut.move`."""
    for i in range(n):
        e = _crossing(w, i, w[TISSUE + i], w[LENGTH + i])
        r00 = e.t00 * w[_R00 + i] + e.t01 * w[_R10 + i]
        r01 = e.t00 * w[_R01 + i] + e.t01 * w[_R11 + i]
        r10 = e.t10 * w[_R00 + i] + e.t11 * w[_R10 + i]
        r11 = e.t10 * w[_R01 + i] + e.t11 * w[_R11 + i]
        _cut_plane(w, i, i, e, r00, r01)
        _cut_plane(w, i, PLANE + i, e, r00, r01)
        _renew(w, i, _C, e.c00)
        _renew(w, i, _C01, e.c01)
        _renew(w, i, _C11, e.c11)
        _renew(w, i, _R00, r00)
        _renew(w, i, _R01, r01)
        _renew(w, i, _R10, r10)
        _renew(w, i, _R11, r11)
        keeps = w[KEEPS + i] > 0.0
        w[_STIFFNESS + i] = w[TISSUE + i] if w[LENGTH + i] > 0.0 else w[_STIFFNESS + i]
        w[BEFORE + i] = w[NODE + i] if keeps else w[BEFORE + i]
        w[NODE + i] = w[DEPTH + i] if keeps else w[NODE + i]
        w[_RESTARTS + i] = 0.0 if keeps else w[_RESTARTS + i]


@compiled
def resume_lane(n: Steered, w: FloatArray, i: int) -> None:
    """Restart the path at the tip if the tip was shifted since the last cut."""
    node, part = w[NODE + i], w[DEPTH + i] - w[NODE + i]
    h, shift = part if part > NOTHING else 0.0, 0.0
    for x in (i, PLANE + i):
        end = w[_PATH + x] + h * (w[_LEAN + x] + 0.5 * h * w[_BEND + x])
        shift = max(shift, abs(w[TIP + x] - end))
    if shift <= SHIFT:
        return
    if part > NOTHING:
        if part < PART * (node_after(n, node) - node):
            return
        w[BEFORE + i], w[NODE + i] = node, w[DEPTH + i]
        for row in range(_C, _C + _TIP, LANES):
            w[row + i] = w[row + _TIP + i]
        for x in (i, PLANE + i):
            w[_REST + x], w[_TURN + x] = w[_TIP_REST + x], w[_TIP_TURN + x]
            w[_LAST + x], w[_LEAN + x], w[_BEND + x] = w[_PATH + x], 0.0, 0.0
    for x in (i, PLANE + i):
        w[_PATH + x] = w[TIP + x]
    w[_RESTARTS + i] = 1.0
