# SPDX-License-Identifier: Apache-2.0
"""Sample, steer and observe many steered needles in one call of compiled code."""

from __future__ import annotations

from math import atan2, cos, hypot, sin, sqrt
from typing import Any, Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import Array3, BoolVector, FloatArray, IntVector, Matrix, Vector
from needle_dynamics.compiled.beam import cross, Crossing, element
from needle_dynamics.compiled.cache import compiled, inlined, kernel
from needle_dynamics.compiled.cut import (
    correlate,
    GuidePose,
    node_after,
    NOTHING,
    PART,
    SHIFT,
    start,
)
from needle_dynamics.compiled.cutting_needle import Cut, Steered
from needle_dynamics.compiled.tissue import layer_at
from needle_study.gym.pushed import BOUND
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Rows of normal numbers for tilt, frame and bevel, before those of measurements and path.
CAUSES: Final = 3

LANES: Final = 32  #: number of lanes per group

# Offset of each row of the lanes. Depth of the tip, of the last node and of the node before [m],
# whether the path restarts at the last node, bending stiffness, sine and cosine of the roll, and
# stiffness of the tissue after the last node.
(
    DEPTH, _NODE, _BEFORE, _RESTARTS, _EI, _SINE, _COSINE, _STIFFNESS,
    # One motion: depth of its end, length to cut or 0, whether the tip becomes a node, and tissue.
    _TO, _LENGTH, _KEEPS, _TISSUE,
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


class Population(NamedTuple):
    """Distribution of needles and targets, as in `sample_truth`."""

    nominal: Steered  #: nominal constants, with the largest length of an element
    free: float  #: free length [m]
    spread: float  #: relative uncertainty of the bending length and the skin
    #: Standard deviations of tilt [rad], rotation of the sensor [rad] and bevel load [N].
    tilt: float
    frame: float
    bevel: float
    noise: float  #: standard deviation of a tip measurement [m]
    #: Correlation of neighboring loads of the path noise, and their standard deviation over the
    #: load that turns the path by 1/m [1/m].
    keep: float
    turn: float
    aside: float  #: largest position of the target along x and along z [m]
    limit: float  #: largest position of the guide along x and along z [m]


class SteeredNeedles(NamedTuple):
    """Constants and state of n needles."""

    population: Population
    depths: Vector  #: depths of the tip measurements [m], shape (steps + 1,)
    #: Fields of `Steered` up to ``length``, shape (n, 6); by layer its start [m], stiffness
    #: [N/m^2] and load of the bevel [N], shape (n, 3, layers); loads of `Steered.wander`.
    constants: Matrix
    layers: Array3
    wander: Array3
    lanes: Matrix  #: state in the lanes of vector registers, shape (groups, ROWS * LANES)
    scratch: Cut  #: memory for the start of an insertion
    frame: Matrix  #: shift of the tip in x and z per depth by the sensor [rad], shape (n, 2)
    noise: Array3  #: errors of the tip measurements [m], shape (n, steps + 1, 2)
    targets: Matrix  #: target positions in x and z [m], shape (n, 2)
    steps: IntVector  #: number of the present depth, shape (n,)


@inlined
def _bending_length(ei: float, tissue: float) -> float:
    return float((4.0 * ei / tissue) ** 0.25)


@inlined
def _needle(a: SteeredNeedles, k: int) -> Steered:
    v, layer = a.constants[k], a.layers[k]
    return Steered(
        v[0], v[1], v[2], v[3], v[4], v[5],
        layer[0], layer[1], layer[2], a.population.nominal.cell, a.wander[k],
    )  # fmt: skip


@inlined
def _begin(a: SteeredNeedles, k: int, tilt_x: float, tilt_z: float, roll: float) -> None:
    n, c, w, i = _needle(a, k), a.scratch, a.lanes[k // LANES], k % LANES
    start(n, c, GuidePose(0.0, 0.0, tilt_x, 0.0, tilt_z, roll), a.population.free)
    a.steps[k] = 0
    s = c.springs
    w[_EI + i], w[_SINE + i], w[_COSINE + i] = n.ei, sin(roll), cos(roll)
    w[DEPTH + i] = w[_NODE + i] = w[_BEFORE + i] = w[_STIFFNESS + i] = 0.0
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
def _sample(a: SteeredNeedles, k: int, uniform: FloatArray, normal: FloatArray) -> None:
    p, n = a.population, a.population.nominal
    stiffer = (1.0 + p.spread * (2.0 * uniform[0] - 1.0)) ** -4.0
    skin = n.skin * stiffer * (1.0 + p.spread * (2.0 * uniform[1] - 1.0))
    bevel_x, bevel_z = p.bevel * normal[2, 0], p.bevel * normal[2, 1]
    layers, constants = a.layers[k], a.constants[k]
    element = n.element
    for i in range(layers.shape[1]):
        layers[0, i], layers[1, i] = n.starts[i], n.stiffness[i] * stiffer
        layers[2, i] = hypot(bevel_x, bevel_z)
        if layers[1, i] > 0.0:
            element = min(element, _bending_length(n.ei, layers[1, i]))
    constants[0], constants[1], constants[2] = n.ei, element, skin
    constants[3], constants[4], constants[5] = n.twist, n.turning, n.length
    measured = CAUSES + len(a.depths)
    wander = a.wander[k]
    size = 1.0
    for i in range(len(wander)):
        for plane in range(2):
            wander[i, plane] = size * normal[measured + i, plane]
        size = sqrt(1.0 - p.keep * p.keep)
    correlate(wander, p.keep)
    layer, load = -1, 0.0
    for i in range(len(wander)):
        while layer + 1 < layers.shape[1] and n.starts[layer + 1] <= i * n.cell:
            layer += 1
            # As `turning_load`.
            tissue = layers[1, layer]
            load = p.turn * n.ei / _bending_length(n.ei, tissue) if tissue > 0.0 else 0.0
        for plane in range(2):
            wander[i, plane] *= load
    for plane in range(2):
        for i in range(len(a.depths)):
            a.noise[k, i, plane] = p.noise * normal[CAUSES + i, plane]
        a.frame[k, plane] = p.frame * normal[1, plane]
        a.targets[k, plane] = p.aside * (2.0 * uniform[2 + plane] - 1.0)
    _begin(a, k, p.tilt * normal[0, 0], p.tilt * normal[0, 1], atan2(bevel_x, bevel_z))


@kernel
def sample(
    boxed: Boxed[SteeredNeedles], which: BoolVector, uniform: Matrix, normal: Array3
) -> None:
    """
    Sample the needles of the mask `which` and their targets, and place them on the skin.

    ``uniform``, shape (n, 4), is in [0, 1): bending length, skin, target in x and z. ``normal``,
    shape (n, rows, 2), has rows of tilt, frame and bevel, of each measurement, and of the path.
    """
    for k in range(len(which)):
        if which[k]:
            _sample(boxed.value, k, uniform[k], normal[k])


@kernel
def begin(boxed: Boxed[SteeredNeedles], k: int, tilt: Vector, roll: float) -> None:
    """Place needle k on the skin, with a tilt of the guide in x and z, shape (2,)."""
    _begin(boxed.value, k, tilt[0], tilt[1], roll)


@inlined
def _tip(a: SteeredNeedles, k: int, plane: int) -> float:
    """Return the position of the tip in the frame of the sensor [m]."""
    w, i = a.lanes[k // LANES], k % LANES
    return float(w[TIP + plane * PLANE + i] + a.frame[k, plane] * w[DEPTH + i])


@inlined
def _miss(a: SteeredNeedles, k: int) -> float:
    return hypot(_tip(a, k, 0) - a.targets[k, 0], _tip(a, k, 1) - a.targets[k, 1])


@inlined
def _set_load(n: Steered, w: FloatArray, i: int, layer: int, depth: float) -> None:
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
    w[TIP + x] = tip if w[_LENGTH + i] > 0.0 else w[TIP + x]


@compiled
def _place(w: FloatArray, first: int, end: int) -> None:
    """Place the tip at its depth in the lanes with a length, as `place`."""
    for i in range(first, end):
        e = _crossing(w, i, w[_STIFFNESS + i], w[DEPTH + i] - w[_NODE + i])
        _place_plane(w, i, i, e)
        _place_plane(w, i, PLANE + i, e)


@inlined
def _cut_plane(w: FloatArray, i: int, x: int, e: Crossing, r00: float, r01: float) -> None:
    h, restarts = w[_LENGTH + i], w[_RESTARTS + i] > 0.0
    cuts, keeps = h > 0.0, w[_KEEPS + i] > 0.0
    before = w[_NODE + i] - w[_BEFORE + i]
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
    w[row + _TIP + i] = value if w[_LENGTH + i] > 0.0 else w[row + _TIP + i]
    w[row + i] = value if w[_KEEPS + i] > 0.0 else w[row + i]


@compiled
def _cut(w: FloatArray, n: int) -> None:
    """Cut from the last node to the tip in the lanes with a length, as in `cut.move`."""
    for i in range(n):
        e = _crossing(w, i, w[_TISSUE + i], w[_LENGTH + i])
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
        keeps = w[_KEEPS + i] > 0.0
        w[_STIFFNESS + i] = w[_TISSUE + i] if w[_LENGTH + i] > 0.0 else w[_STIFFNESS + i]
        w[_BEFORE + i] = w[_NODE + i] if keeps else w[_BEFORE + i]
        w[_NODE + i] = w[DEPTH + i] if keeps else w[_NODE + i]
        w[_RESTARTS + i] = 0.0 if keeps else w[_RESTARTS + i]


@compiled
def _resume(n: Steered, w: FloatArray, i: int) -> None:
    """Restart the path at the tip if the tip was shifted since the last cut."""
    node, part = w[_NODE + i], w[DEPTH + i] - w[_NODE + i]
    h, shift = part if part > NOTHING else 0.0, 0.0
    for x in (i, PLANE + i):
        end = w[_PATH + x] + h * (w[_LEAN + x] + 0.5 * h * w[_BEND + x])
        shift = max(shift, abs(w[TIP + x] - end))
    if shift <= SHIFT:
        return
    if part > NOTHING:
        if part < PART * (node_after(n, node) - node):
            return
        w[_BEFORE + i], w[_NODE + i] = node, w[DEPTH + i]
        for row in range(_C, _C + _TIP, LANES):
            w[row + i] = w[row + _TIP + i]
        for x in (i, PLANE + i):
            w[_REST + x], w[_TURN + x] = w[_TIP_REST + x], w[_TIP_TURN + x]
            w[_LAST + x], w[_LEAN + x], w[_BEND + x] = w[_PATH + x], 0.0, 0.0
    for x in (i, PLANE + i):
        w[_PATH + x] = w[TIP + x]
    w[_RESTARTS + i] = 1.0


@inlined
def _aim(a: SteeredNeedles, w: FloatArray, first: int, count: int) -> bool:
    """Set the next length to cut in each lane; return whether there is one."""
    found = False
    for i in range(count):
        w[_LENGTH + i] = w[_KEEPS + i] = 0.0
        if w[DEPTH + i] < w[_TO + i]:
            n, node = _needle(a, first + i), w[_NODE + i]
            layer, end = layer_at(n.starts, node), node_after(n, node)
            depth = min(end, w[_TO + i])
            _set_load(n, w, i, layer, depth)
            w[DEPTH + i], w[_LENGTH + i], w[_TISSUE + i] = depth, depth - node, n.stiffness[layer]
            w[_KEEPS + i] = 1.0 if depth == end else 0.0
            found = True
    return found


@inlined
def _enter(a: SteeredNeedles, w: FloatArray, first: int, count: int) -> None:
    """Let the tip jump where the bevel has a different load in the next layer."""
    for i in range(count):
        if w[_KEEPS + i] > 0.0 and a.layers.shape[2] > 1:
            n = _needle(a, first + i)
            layer = layer_at(n.starts, w[_NODE + i])
            if n.bevel[layer] != n.bevel[layer_at(n.starts, w[_BEFORE + i])]:
                _set_load(n, w, i, layer, w[DEPTH + i])
                _place(w, i, i + 1)
                _resume(n, w, i)


@kernel
def steer(
    boxed: Boxed[SteeredNeedles], actions: Matrix, which: BoolVector
) -> tuple[FloatArray, Any]:
    """
    Move the guides of the needles of the mask `which`, then insert these needles by a step.

    Actions, shape (n, 2), are fractions of the limit in [-1, 1]. Returns rewards, 0 before the
    last depth, and 1 where it is reached, else 0.
    """
    a = boxed.value
    limit, last, n = a.population.limit, len(a.depths) - 1, len(which)
    rewards, ends = np.zeros(n), np.zeros(n, dtype=np.int8)
    for group in range(len(a.lanes)):
        w, first = a.lanes[group], group * LANES
        count = min(LANES, n - first)
        for i in range(count):
            k = first + i
            w[_TO + i], w[_LENGTH + i] = w[DEPTH + i], 0.0
            if which[k]:
                a.steps[k] += 1
                w[_TO + i], w[_LENGTH + i] = a.depths[a.steps[k]], 1.0
                w[GUIDE + i] = limit * actions[k, 0]
                w[GUIDE + PLANE + i] = limit * actions[k, 1]
                needle = _needle(a, k)
                layer = layer_at(needle.starts, w[_NODE + i])
                _set_load(needle, w, i, layer, w[DEPTH + i])
        _place(w, 0, count)
        for i in range(count):
            if which[first + i]:
                _resume(_needle(a, first + i), w, i)
        while _aim(a, w, first, count):
            _cut(w, count)
            _enter(a, w, first, count)
        for k in range(first, first + count):
            if which[k] and a.steps[k] == last:
                rewards[k], ends[k] = -1e3 * _miss(a, k), 1
    return rewards, ends


@kernel
def observe(boxed: Boxed[SteeredNeedles]) -> tuple[Any, FloatArray]:
    """
    Return observations, shape (n, 7), and true tips in x and z with their misses, shape (n, 3).

    Depth over the target depth; measured tip, target and guide over the limit of the guide, each
    x and z.
    """
    a = boxed.value
    count = len(a.steps)
    limit, deepest = a.population.limit, a.depths[-1]
    observed, tips = np.empty((count, 7), dtype=np.float32), np.empty((count, 3))
    for k in range(count):
        w, i = a.lanes[k // LANES], k % LANES
        observed[k, 0] = w[DEPTH + i] / deepest
        for plane in range(2):
            tips[k, plane] = _tip(a, k, plane)
            measured = tips[k, plane] + a.noise[k, a.steps[k], plane]
            guide = w[GUIDE + plane * PLANE + i]
            for j, value in enumerate((measured, a.targets[k, plane], guide)):
                observed[k, 1 + 2 * j + plane] = min(max(value / limit, -BOUND), BOUND)
        tips[k, 2] = _miss(a, k)
    return observed, tips
