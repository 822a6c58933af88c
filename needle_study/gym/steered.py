# SPDX-License-Identifier: Apache-2.0
"""Sample, steer and observe many steered needles in one call of compiled code."""

from __future__ import annotations

from math import atan2, hypot, sqrt
from typing import Any, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import (
    Array3,
    Array4,
    BoolVector,
    FloatArray,
    IntMatrix,
    IntVector,
    Matrix,
    Vector,
)
from needle_dynamics.compiled.beam import SpringSupports
from needle_dynamics.compiled.cache import inlined, kernel
from needle_dynamics.compiled.cut import correlate, GuidePose, move, start
from needle_dynamics.compiled.cutting_needle import Cut, DEPTH, ROLL, Steered
from needle_study.gym.pushed import BOUND
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Rows of normal numbers for tilt, frame and bevel, before those of measurements and path.
CAUSES = 3


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


class Springs(NamedTuple):
    """`SpringSupports` of n needles: its fields, each with a leading axis n."""

    depths: Matrix
    stiffness: Matrix
    compliance: Array3
    response: Array4
    rest: Array4
    path: Array4


class Cuts(NamedTuple):
    """`Cut` of n needles: its fields, each with a leading axis n."""

    springs: Springs
    guide: Array3
    pose: Matrix
    entry: Matrix
    tip: Array3
    load: Matrix
    counts: IntMatrix


class SteeredNeedles(NamedTuple):
    """Constants and state of n needles."""

    population: Population
    depths: Vector  #: depths of the tip measurements [m], shape (steps + 1,)
    #: Fields of `Steered` up to ``length``, shape (n, 6); by layer its start [m], stiffness
    #: [N/m^2] and load of the bevel [N], shape (n, 3, layers); loads of `Steered.wander`.
    constants: Matrix
    layers: Array3
    wander: Array3
    cuts: Cuts
    frame: Matrix  #: shift of the tip in x and z per depth by the sensor [rad], shape (n, 2)
    noise: Array3  #: errors of the tip measurements [m], shape (n, steps + 1, 2)
    targets: Matrix  #: target positions in x and z [m], shape (n, 2)
    steps: IntVector  #: number of the present depth, shape (n,)


@inlined
def _needle(a: SteeredNeedles, k: int) -> tuple[Steered, Cut]:
    """Return the constants of a needle, and a view of its state."""
    v, layer, c = a.constants[k], a.layers[k], a.cuts
    s = c.springs
    springs = SpringSupports(
        s.depths[k], s.stiffness[k], s.compliance[k], s.response[k], s.rest[k], s.path[k]
    )
    return (
        Steered(
            v[0], v[1], v[2], v[3], v[4], v[5],
            layer[0], layer[1], layer[2], a.population.nominal.cell, a.wander[k],
        ),
        Cut(springs, c.guide[k], c.pose[k], c.entry[k], c.tip[k], c.load[k], c.counts[k]),
    )  # fmt: skip


@inlined
def _bending_length(ei: float, tissue: float) -> float:
    return float((4.0 * ei / tissue) ** 0.25)


@inlined
def _begin(a: SteeredNeedles, k: int, tilt_x: float, tilt_z: float, roll: float) -> None:
    n, c = _needle(a, k)
    a.steps[k] = 0
    start(n, c, GuidePose(0.0, 0.0, tilt_x, 0.0, tilt_z, roll), a.population.free)


@kernel
def sample(boxed: Boxed[SteeredNeedles], k: int, uniform: Vector, normal: Matrix) -> None:
    """
    Sample needle k and its target, and place it on the skin.

    ``uniform``, shape (4,), is in [-1, 1]: bending length, skin, target in x and z. ``normal``,
    shape (rows, 2), has rows of tilt, frame and bevel, of each measurement, and of the path.
    """
    a = boxed.value
    p, n = a.population, a.population.nominal
    stiffer = (1.0 + p.spread * uniform[0]) ** -4.0
    skin = n.skin * stiffer * (1.0 + p.spread * uniform[1])
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
        a.targets[k, plane] = p.aside * uniform[2 + plane]
    _begin(a, k, p.tilt * normal[0, 0], p.tilt * normal[0, 1], atan2(bevel_x, bevel_z))


@kernel
def begin(boxed: Boxed[SteeredNeedles], k: int, tilt: Vector, roll: float) -> None:
    """Place needle k on the skin, with a tilt of the guide in x and z, shape (2,)."""
    _begin(boxed.value, k, tilt[0], tilt[1], roll)


@inlined
def _tip(a: SteeredNeedles, k: int, plane: int) -> float:
    """Return the position of the tip in the frame of the sensor [m]."""
    return float(a.cuts.tip[k, plane, 0] + a.frame[k, plane] * a.cuts.pose[k, DEPTH])


@inlined
def _miss(a: SteeredNeedles, k: int) -> float:
    return hypot(_tip(a, k, 0) - a.targets[k, 0], _tip(a, k, 1) - a.targets[k, 1])


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
    limit, last = a.population.limit, len(a.depths) - 1
    rewards, ends = np.zeros(len(which)), np.zeros(len(which), dtype=np.int8)
    for k in range(len(which)):
        if not which[k]:
            continue
        n, c = _needle(a, k)
        tilt_x, tilt_z, roll = c.guide[0, 1], c.guide[1, 1], c.pose[ROLL]
        depth, x, z = c.pose[DEPTH], limit * actions[k, 0], limit * actions[k, 1]
        a.steps[k] += 1
        for to in (depth, a.depths[a.steps[k]]):
            move(n, c, GuidePose(to, x, tilt_x, z, tilt_z, roll))
        if a.steps[k] == last:
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
        observed[k, 0] = a.cuts.pose[k, DEPTH] / deepest
        for plane in range(2):
            tips[k, plane] = _tip(a, k, plane)
            measured = tips[k, plane] + a.noise[k, a.steps[k], plane]
            for i, value in enumerate((measured, a.targets[k, plane], a.cuts.guide[k, plane, 0])):
                observed[k, 1 + 2 * i + plane] = min(max(value / limit, -BOUND), BOUND)
        tips[k, 2] = _miss(a, k)
    return observed, tips
