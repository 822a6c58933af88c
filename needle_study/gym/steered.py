# SPDX-License-Identifier: Apache-2.0
"""Sample, steer and observe many steered needles in one call of compiled code."""

from __future__ import annotations

from math import atan2, exp, hypot, sqrt
from typing import Any, Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import Array3, BoolVector, FloatArray, IntVector, Matrix, Vector
from needle_dynamics.compiled.cache import inlined, kernel
from needle_dynamics.compiled.cut import correlate, GuidePose, node_after, start
from needle_dynamics.compiled.cutting_lanes import (
    BEFORE,
    cut_lanes,
    DEPTH,
    GUIDE,
    KEEPS,
    LENGTH,
    load_cut,
    NODE,
    place_lanes,
    PLANE,
    resume_lane,
    set_tip_force,
    TIP,
    TISSUE,
    TO,
)
from needle_dynamics.compiled.cutting_needle import Cut, Steered
from needle_dynamics.compiled.lane_rows import LANES
from needle_dynamics.compiled.tissue import layer_at
from needle_study.gym.pushed import BOUND
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Rows of normal numbers for tilt, frame and bevel, before those of measurements and path.
CAUSES: Final = 3


class Population(NamedTuple):
    """Distribution of needles and targets, as in `sample_truth`."""

    #: Nominal constants, with the largest length of an element, and the loads of the bevel per
    #: load in the layer with the largest one.
    nominal: Steered
    free: float  #: free length [m]
    spread: float  #: relative uncertainty of the bending length and the skin
    #: Standard deviation of the logarithm of the stiffness of each layer, shape (layers,) or (0,).
    layers: Vector
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
    load_cut(w, i, n, c, roll)


@inlined
def _sample(a: SteeredNeedles, k: int, uniform: FloatArray, normal: FloatArray) -> None:
    p, n = a.population, a.population.nominal
    stiffer = (1.0 + p.spread * (2.0 * uniform[0] - 1.0)) ** -4.0
    skin = n.skin * stiffer * (1.0 + p.spread * (2.0 * uniform[1] - 1.0))
    bevel_x, bevel_z = p.bevel * normal[2, 0], p.bevel * normal[2, 1]
    layers, constants = a.layers[k], a.constants[k]
    element, measured = n.element, CAUSES + len(a.depths)
    wander = a.wander[k]
    for i in range(layers.shape[1]):
        layers[0, i], layers[1, i] = n.starts[i], n.stiffness[i] * stiffer
        if len(p.layers) > 0:
            layers[1, i] *= exp(p.layers[i] * normal[measured + len(wander) + i, 0])
        layers[2, i] = hypot(bevel_x, bevel_z) * n.bevel[i]
        if layers[1, i] > 0.0:
            element = min(element, _bending_length(n.ei, layers[1, i]))
    constants[0], constants[1], constants[2] = n.ei, element, skin
    constants[3], constants[4], constants[5] = n.twist, n.turning, n.length
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
    shape (n, rows, 2), has rows of tilt, frame and bevel, of each measurement, of the path, and,
    if the population has a spread for layers, of each layer.
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
def _aim(a: SteeredNeedles, w: FloatArray, first: int, count: int) -> bool:
    """Set the next length to cut in each lane; return whether there is one."""
    found = False
    for i in range(count):
        w[LENGTH + i] = w[KEEPS + i] = 0.0
        if w[DEPTH + i] < w[TO + i]:
            n, node = _needle(a, first + i), w[NODE + i]
            layer, end = layer_at(n.starts, node), node_after(n, node)
            depth = min(end, w[TO + i])
            set_tip_force(n, w, i, layer, depth)
            w[DEPTH + i], w[LENGTH + i], w[TISSUE + i] = depth, depth - node, n.stiffness[layer]
            w[KEEPS + i] = 1.0 if depth == end else 0.0
            found = True
    return found


@inlined
def _enter(a: SteeredNeedles, w: FloatArray, first: int, count: int) -> None:
    """Let the tip jump where the bevel has a different load in the next layer."""
    for i in range(count):
        if w[KEEPS + i] > 0.0 and a.layers.shape[2] > 1:
            n = _needle(a, first + i)
            layer = layer_at(n.starts, w[NODE + i])
            if n.bevel[layer] != n.bevel[layer_at(n.starts, w[BEFORE + i])]:
                set_tip_force(n, w, i, layer, w[DEPTH + i])
                place_lanes(w, i, i + 1)
                resume_lane(n, w, i)


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
            w[TO + i], w[LENGTH + i] = w[DEPTH + i], 0.0
            if which[k]:
                a.steps[k] += 1
                w[TO + i], w[LENGTH + i] = a.depths[a.steps[k]], 1.0
                w[GUIDE + i] = limit * actions[k, 0]
                w[GUIDE + PLANE + i] = limit * actions[k, 1]
                needle = _needle(a, k)
                layer = layer_at(needle.starts, w[NODE + i])
                set_tip_force(needle, w, i, layer, w[DEPTH + i])
        place_lanes(w, 0, count)
        for i in range(count):
            if which[first + i]:
                resume_lane(_needle(a, first + i), w, i)
        while _aim(a, w, first, count):
            cut_lanes(w, count)
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
