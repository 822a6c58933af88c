# SPDX-License-Identifier: Apache-2.0
"""Needles as arcs of constant curvature, without mechanics; and their insertion in the plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from math import asin, cos, hypot, sin
from typing import Final, NamedTuple

from needle_controller.steering.insertion_plan import guide_axes
from needle_dynamics import find_needle, FloatArray, SteeredNeedle
from needle_dynamics.needles import NeedlePreset
from needle_dynamics.steering.needle import inserted_shape
from needle_planning.clearance import Clearance
from needle_planning.paths import Line
from needle_planning.search import EntryRegion
import numpy as np

#: Load of the bevel [N]. The guide is tilted by 0.09 against its path; the model of the plant is
#: for slopes up to 0.1.
LOAD: Final = 1.0
_CURVATURES, _ROLLS = 4, 24  #: Curvatures above zero, and directions of each.
_SPACING: Final = 1e-3  #: Distance of the points of an arc, and of an inserted needle [m].
_COARSE: Final = 6e-3  #: Distance of the points of an arc that is soon excluded [m].
_FINE: Final = 1e-4  #: Distance of the points of the arc that was chosen [m].
_ENTRIES: Final = 32  #: Entry points that are examined at once.
_POLISHED: Final = 6  #: Halvings of the grid around the best arc.
_FITTED: Final = 0.1  #: Depth to which the curvature of the bevel is fitted [m].
_ROUNDING: Final = 1e-6  #: Least curvature of a formula of arcs [1/m].


class Arc(NamedTuple):
    """Arc of constant curvature in patient coordinates."""

    start: FloatArray  #: first point [m], shape (3,)
    tangent: FloatArray  #: unit vector, shape (3,)
    normal: FloatArray  #: unit vector to the center, shape (3,)
    curvature: float  #: [1/m]
    length: float  #: [m]

    @property
    def end(self) -> FloatArray:
        """Last point [m], shape (3,)."""
        return np.asarray(self.points(np.array([self.length]))[0])

    def axes_at_end(self) -> tuple[FloatArray, FloatArray]:
        """Return tangent and normal at the end."""
        turn = self.curvature * self.length
        return (
            cos(turn) * self.tangent + sin(turn) * self.normal,
            cos(turn) * self.normal - sin(turn) * self.tangent,
        )

    def reverse(self) -> Arc:
        """Return the same arc from its end to its start."""
        tangent, normal = self.axes_at_end()
        return self._replace(start=self.end, tangent=-tangent, normal=normal)

    def points(self, lengths: FloatArray) -> FloatArray:
        """Return positions at lengths from the start (k,) [m], shape (k, 3)."""
        c = max(self.curvature, _ROUNDING)
        along, across = np.sin(c * lengths) / c, 2.0 * np.sin(0.5 * c * lengths) ** 2 / c
        return np.asarray(
            self.start + np.outer(along, self.tangent) + np.outer(across, self.normal)
        )


def arc_to(start: FloatArray, tangent: FloatArray, end: FloatArray) -> Arc:
    """Return the arc from a point with a tangent to another point."""
    chord = end - start
    square, along = float(chord @ chord), float(chord @ tangent)
    across = chord - along * tangent
    size = float(np.linalg.norm(across))
    curvature = 2.0 * size / square
    normal = across / size if size > 0.0 else guide_axes(tangent)[2]
    half = 0.5 * curvature * square**0.5
    # Half of the angle of the arc; less than a right angle for a needle.
    length = square**0.5 * (asin(min(half, 1.0)) / half if half > 1e-9 else 1.0)
    return Arc(start, tangent, normal, curvature, length)


def bowed_arc(entry: FloatArray, target: FloatArray, curvature: FloatArray) -> Arc:
    """Return the arc between two points with curvatures along x and z of its guide [1/m]."""
    x, y, z = guide_axes(target - entry)
    size = float(np.hypot(*curvature))
    to = (curvature[0] * x + curvature[1] * z) / size if size > 0.0 else z
    angle = asin(0.5 * size * float(np.linalg.norm(target - entry)))
    return arc_to(entry, cos(angle) * y - sin(angle) * to, target)


def arc_clearance(clearance: Clearance, arcs: Sequence[Arc]) -> float:
    """Return the least clearance of consecutive arcs at fine points [m]."""
    lengths = (np.linspace(0.0, one.length, int(one.length / _FINE) + 2) for one in arcs)
    every = [one.points(at) for one, at in zip(arcs, lengths, strict=True)]
    return float(clearance.at(np.concatenate(every)).min())


def _least(
    clearance: Clearance,
    entries: FloatArray,
    target: FloatArray,
    bends: FloatArray,
    spacing: float = _SPACING,
) -> FloatArray:
    """Return the clearance of arcs from entries (m, 3) with curvatures (m, 2), shape (m,)."""
    x, y, z = np.moveaxis(np.array([guide_axes(target - one) for one in entries]), 1, 0)
    length = np.linalg.norm(target - entries, axis=1)[:, np.newaxis]
    s = np.linspace(0.0, 1.0, int(length.max() / spacing) + 2)
    c = np.maximum(np.hypot(*bends.T), _ROUNDING)[:, np.newaxis]
    # The chord has the angle alpha to the tangent; phi runs from -alpha to alpha.
    alpha = np.arcsin(0.5 * c * length)
    phi = alpha * (2.0 * s - 1.0)
    along = (np.sin(phi) + np.sin(alpha)) / c
    away = (np.cos(alpha) - np.cos(phi)) / c
    to = (bends[:, :1] * x + bends[:, 1:] * z) / c
    points = entries[:, np.newaxis] + along[..., np.newaxis] * y[:, np.newaxis]
    points = points + away[..., np.newaxis] * to[:, np.newaxis]
    return np.asarray(clearance.at(points.reshape(-1, 3)).reshape(along.shape).min(axis=1))


def _pairs(entries: FloatArray, bends: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return every entry point with every curvature."""
    return np.repeat(entries, len(bends), axis=0), np.tile(bends, (len(entries), 1))


def best_arc(
    clearance: Clearance, region: EntryRegion, target: FloatArray, most: float
) -> list[Arc]:
    """
    Return the arc to a target with the largest clearance, none without a positive one.

    ``most`` is the largest curvature [1/m].

    Every entry point with every curvature and direction of a grid is examined, or excluded by the
    bound of a straight line whose points may move by the bow of an arc. The best one is improved
    on finer grids around it.
    """
    radii = np.linspace(0.0, most, _CURVATURES + 1)[1:]
    turns = 2.0 * np.pi * np.arange(_ROLLS) / _ROLLS
    grid = np.array([(r * sin(t), r * cos(t)) for r, t in product(radii, turns)])
    bends = np.vstack([np.zeros((1, 2)), grid])
    entries = region.centers
    longest = float(np.linalg.norm(entries - target, axis=1).max())
    s = np.linspace(0.0, 1.0, 33)
    # Two percent for the circle over its parabola, and the line between two fractions.
    bow = 1.02 * most * longest**2 / 2.0 * s * (1.0 - s) + 1e-5
    bound = clearance.lines(entries, target, bow=bow, tolerance=1e-4).least + 1e-4
    order = np.argsort(-bound, kind='stable')
    best, found = -np.inf, (entries[order[0]], np.zeros(2))
    for begin in range(0, len(order), _ENTRIES):
        some = order[begin : begin + _ENTRIES]
        if bound[some[0]] <= max(best, 0.0):
            break
        starts, turned = _pairs(entries[some], bends)
        # Few points exclude most arcs.
        values = _least(clearance, starts, target, turned, _COARSE)
        left = np.append(np.flatnonzero(values > max(best, 0.0)), values.argmax())
        values = _least(clearance, starts[left], target, turned[left])
        first = int(values.argmax())
        if values[first] > best:
            best, found = float(values[first]), (starts[left[first]], turned[left[first]])
    entry, bend = found
    step = 0.5
    offsets = np.array(list(product((-1.0, 0.0, 1.0), repeat=2)))
    middle = entry
    for _ in range(_POLISHED):
        step *= 0.5
        # Along the axes of the voxel, within it.
        moved = np.concatenate(
            [entry + 2.0 * step * (offsets @ region.halves[list(pair)])
             for pair in ((0, 1), (0, 2), (1, 2))]
        )  # fmt: skip
        inside = np.abs((moved - middle) @ region.frame.axes) <= np.abs(region.halves).max() + 1e-9
        turned = bend + step * most / _CURVATURES * offsets
        starts, turned = _pairs(moved[inside.all(axis=1)], turned[np.hypot(*turned.T) <= most])
        values = _least(clearance, starts, target, turned)
        first = int(values.argmax())
        if values[first] > best:
            best, entry, bend = float(values[first]), starts[first], turned[first]
    arc = bowed_arc(entry, target, bend)
    return [arc] if arc_clearance(clearance, [arc]) > 0.0 else []


class Bevel(NamedTuple):
    """Path of a bevel in the plant, as an arc that begins at an angle, per load."""

    angle: float  #: [rad/N]
    curvature: float  #: [1/(m N)]


@lru_cache
def fitted_bevel(needle: str) -> Bevel:
    """Fit the path of a needle in the plant, which a user of arcs would measure."""
    one = SteeredNeedle(*find_needle(needle).changed({'bevel_load': (1.0,)})[:2])
    depths, tips = np.linspace(_SPACING, _FITTED, round(_FITTED / _SPACING)), []
    for depth in depths.tolist():
        one.move(depth=depth)
        tips.append(one.tip[2])
    design = np.stack([depths, 0.5 * depths**2], axis=1)
    return Bevel(*np.linalg.lstsq(design, np.array(tips), rcond=None)[0].tolist())


class Inserted(NamedTuple):
    """Needle inserted in the plant without uncertainty."""

    clearance: float  #: least clearance of the whole shaft at all depths, at its points [m]
    final: float  #: least clearance of the complete needle [m]
    miss: float  #: distance of the tip from the target [m]


def insert(
    clearance: Clearance,
    preset: NeedlePreset,
    line: Line,
    target: FloatArray,
    depths: FloatArray,
    guide: FloatArray,
    rolls: FloatArray,
) -> Inserted:
    """Insert a needle in steps with guide setpoints (n, 2) [m] and rolls (n,) [rad]."""
    one = SteeredNeedle(preset.needle, replace(preset.steering, path_noise=0.0), roll=rolls[0])
    least, final = np.inf, np.inf
    for k, setpoint in enumerate(guide):
        one.move(guide=setpoint.tolist(), roll=float(rolls[k]))
        count = int((depths[k + 1] - depths[k]) / _SPACING) + 1
        for depth in np.linspace(depths[k], depths[k + 1], count + 1).tolist():
            one.move(depth=depth)
            points = np.append(np.arange(0.0, depth, _SPACING), depth)
            shape = line.points(points, inserted_shape(one, points)[0])
            final = float(clearance.at(shape).min())
            least = min(least, final)
    return Inserted(least, final, float(np.linalg.norm(shape[-1] - target)))


def insert_arcs(
    clearance: Clearance, needle: str, arcs: Sequence[Arc], target: FloatArray
) -> Inserted:
    """
    Insert a needle with a bevel that is turned to the center of each arc.

    Its load is scaled to the curvature of each arc (ideal rotation in a duty cycle), and the guide
    is tilted so that the fitted path of the bevel begins along the first arc.
    """
    bevel, first = fitted_bevel(needle), arcs[0]
    load = first.curvature / bevel.curvature
    line = Line(first.start, guide_axes(first.tangent - bevel.angle * load * first.normal))
    x, y, z = line.axes
    ends = [float((one.end - line.entry) @ y) for one in arcs]
    loads, tissue = [one.curvature / bevel.curvature for one in arcs], find_needle(needle)
    preset = tissue.changed(
        {
            'layer_depths': ends[:-1],
            'layer_stiffnesses': [tissue.needle.tissue_stiffness] * (len(arcs) - 1),
            'bevel_load': loads,
        }
    )
    rolls = np.array([np.arctan2(one.normal @ x, one.normal @ z) for one in arcs])
    depths = np.array([0.0, *ends])
    guide = np.zeros((len(arcs), 2))
    return insert(clearance, preset, line, target, depths, guide, rolls)


def biarc(p: FloatArray, t: FloatArray, q: FloatArray, u: FloatArray) -> tuple[Arc, Arc]:
    """Return two arcs of equal tangent lengths from a point with a tangent to another one."""
    # Bolton 1975; with d the length of the tangents.
    v, w = q - p, t + u
    a, b, c = 2.0 * (1.0 - float(t @ u)), float(v @ w), float(v @ v)
    d = c / (hypot(b, (a * c) ** 0.5) + b)
    middle = 0.5 * (p + q + d * (t - u))
    one = arc_to(p, t, middle)
    return one, arc_to(middle, one.axes_at_end()[0], q)
