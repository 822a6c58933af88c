# SPDX-License-Identifier: Apache-2.0
"""
Guaranteed clearance of a simulated insertion: of the whole shaft, at all depths.

The shaft sweeps a surface while the guide moves and the needle advances. The surface is divided
into patches, bilinear between two shapes. A patch has at least the clearance of its center less
its radius, since the clearance is 1-Lipschitz; patches are divided until this bound is tight.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import Final, NamedTuple

from needle_controller.steering.free_space import UNITS
from needle_dynamics.arrays import FloatArray, IntArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import inserted_shape, SteeredNeedle
from needle_dynamics.steering.parameters import SteeringParameters
from needle_planning.clearance import Clearance
from needle_planning.paths import Line
import numpy as np

_CHECKED: Final = 1e-3  #: Distance of the points of the shaft, and of the depths [m].
#: Largest difference between the bound and the true clearance, bowed and straight [m].
_TIGHT: Final = (5e-5, 5e-6)
#: Largest free distance [m], distance of its samples along the path [m], samples of a place,
#: tolerance of the distance [m], and most steps to it.
_FREE, _SAMPLED, _SAMPLES, _REACHED, _TRIES = 0.01, 1e-4, 20, 1e-5, 100
_ROUNDS: Final = 24  #: Divisions of a patch into halves.


class SimulatedInsertion(NamedTuple):
    """Simulated insertion along a line, with its clearance."""

    path: FloatArray  #: position of the tip at each depth [m], shape (n + 1, 3)
    clearances: FloatArray  #: least clearance up to each depth since the last one [m], (n + 1,)
    clearance: float  #: least clearance of the insertion [m]
    place: FloatArray  #: point of the least clearance [m], shape (3,)
    bow: float  #: largest deflection of the shaft from the line [m]
    slope: float  #: largest slope of the shaft relative to the line
    load: float  #: largest lateral force on the guide along an axis [N]
    skin: float  #: largest sideways displacement at the skin along an axis [m]


def simulate_insertion(
    clearance: Clearance,
    line: Line,
    needle: NeedleParameters,
    steering: SteeringParameters,
    depths: FloatArray,
    guide: FloatArray,
    roll: float = 0.0,
) -> SimulatedInsertion:
    """
    Insert a needle without uncertainty, and bound its clearance from below.

    Parameters
    ----------
    clearance : Clearance
        Clearance around the line.
    line : Line
        Line of the insertion.
    needle, steering : NeedleParameters, SteeringParameters
        Constants; path noise is ignored.
    depths : ndarray, shape (n + 1,)
        Depths of the steps [m].
    guide : ndarray, shape (n, 2)
        Position of the guide in x and z in each step [m].
    roll : float
        Roll of the needle [rad].

    Returns
    -------
    SimulatedInsertion
        Clearances are lower bounds, at most 50 um below the true ones, 5 um for a straight needle.

    """
    one = SteeredNeedle(needle, replace(steering, path_noise=0.0), roll=roll)
    along = np.append(np.arange(0.0, depths[-1] - 0.5 * _CHECKED, _CHECKED), depths[-1])
    tips, loads, slope = [one.tip[[0, 2]]], [0.0], 0.0
    sag = skin = 0.0
    shapes: list[FloatArray] = []
    steps: list[int] = []

    def keep(step: int) -> None:
        nonlocal slope, sag, skin
        # Points ahead of the tip are at the tip.
        points = np.minimum(along, one.depth)
        deflections, slopes = inserted_shape(one, points)
        slope = max(slope, float(np.hypot(*slopes.T).max()))
        skin = max(skin, float(np.abs(deflections[0]).max()))
        sag = max(sag, sag_of(slopes[along <= one.depth], _CHECKED))
        shapes.append(line.points(points, deflections))
        steps.append(step)

    keep(1)
    for k, setpoint in enumerate(guide, 1):
        one.move(guide=setpoint.tolist())
        loads.append(float(np.abs(one.guide_load[0]).max()))
        keep(k)
        begin, end = depths[k - 1], depths[k]
        count = ceil((end - begin) / _CHECKED)
        for depth in np.linspace(begin, end, count + 1)[1:].tolist():
            one.move(depth=depth)
            keep(k)
        tips.append(one.tip[[0, 2]])
    surface = np.stack(shapes)
    away = surface - line.entry
    across = away - (away @ line.axes[1])[..., np.newaxis] * line.axes[1]
    bow = float(np.linalg.norm(across, axis=2).max())
    straight = not guide.any() and max(steering.bevel_load) == 0.0
    if straight:
        # A straight needle only adds its tip in each step.
        surface = np.stack([surface[-1]] * 2)
        step = np.searchsorted(depths, along[1:] - 1e-9)[np.newaxis]
    else:
        step = np.array(steps[1:])[:, np.newaxis]
    least, place = least_clearances(clearance, surface, step, len(depths), _TIGHT[straight])
    least = (np.minimum.accumulate(least) if straight else least) - sag
    return SimulatedInsertion(
        path=line.points(depths, np.array(tips)),
        clearances=least,
        clearance=float(least.min()),
        place=place,
        bow=bow,
        slope=slope,
        load=max(loads),
        skin=skin,
    )


def free_space(
    clearance: Clearance, line: Line, depths: FloatArray, path: FloatArray
) -> FloatArray:
    """
    Return the free distance around a path, in the plane across the line.

    Parameters
    ----------
    clearance : Clearance
        Clearance around the line.
    line : Line
        Line of the insertion.
    depths : ndarray, shape (n + 1,)
        Depths of the steps [m].
    path : ndarray, shape (n + 1, 3)
        Position of the tip at each depth [m].

    Returns
    -------
    ndarray, shape (places, 17)
        Depth of each place, 2 mm apart, and least free distance in its samples 0.1 mm apart, in
        16 directions from x to z, at most 10 mm [m].

    """
    count = max(1, ceil(depths[-1] / (_SAMPLES * _SAMPLED)))
    edges = np.linspace(0.0, depths[-1], count * _SAMPLES + 1)
    along = 0.5 * (edges[1:] + edges[:-1])
    middle = np.array([np.interp(along, depths, one) for one in path.T]).T
    units = UNITS @ line.axes[[0, 2]]
    distance = np.zeros((len(along), len(units)))
    # Outwards by the clearance, which no obstacle is nearer than.
    active = np.ones(distance.shape, dtype=np.bool_)
    for _ in range(_TRIES):
        at, direction = np.nonzero(active)
        points = middle[at] + distance[active][:, np.newaxis] * units[direction]
        step = clearance.at(points)
        distance[active] = np.clip(distance[active] + np.maximum(step, 0.0), 0.0, _FREE)
        active[active] = (step > _REACHED) & (distance[active] < _FREE)
        if not active.any():
            break
    least = distance.reshape(count, _SAMPLES, -1).min(axis=1)
    return np.column_stack([along.reshape(count, _SAMPLES).mean(axis=1), least])


def sag_of(slopes: FloatArray, spacing: float) -> float:
    """Return the largest deviation of a shaft from the lines between its points [m]."""
    turns = np.diff(slopes, axis=0)
    return spacing / 8.0 * float(np.hypot(*turns.T).max(initial=0.0))


def least_clearances(
    clearance: Clearance, surface: FloatArray, steps: IntArray, count: int, tight: float
) -> tuple[FloatArray, FloatArray]:
    """Return the least clearance in each step, shape (count,), and the point of the least one."""
    # Corners of the patches: pose and next pose, point and next point.
    a, b = surface[:-1], surface[1:]
    corners = np.stack([a[:, :-1], a[:, 1:], b[:, :-1], b[:, 1:]], axis=2)
    step = np.broadcast_to(steps, corners.shape[:2]).ravel()
    patches = corners.reshape(-1, 4, 3)
    least, bounds = np.full(count, np.inf), np.full(count, np.inf)
    least[0] = bounds[0] = clearance.at(surface[0, :1])[0]
    place, smallest = surface[0, 0], float(least[0])
    for left in range(_ROUNDS, -1, -1):
        centers = patches.mean(axis=1)
        values = clearance.at(centers)
        radii = np.linalg.norm(patches - centers[:, np.newaxis], axis=2).max(axis=1)
        np.minimum.at(least, step, values)
        first = int(values.argmin())
        if values[first] < smallest:
            smallest, place = float(values[first]), centers[first]
        lower = values - radii
        divided = lower < least[step] - tight
        if left == 0:
            divided[:] = False
        np.minimum.at(bounds, step[~divided], lower[~divided])
        if not divided.any():
            break
        patches, step = _halves(patches[divided]), np.tile(step[divided], 2)
    return np.minimum(bounds, least), place


def _halves(patches: FloatArray) -> FloatArray:
    """Divide bilinear patches, corners (m, 4, 3), across their longer side, shape (2 m, 4, 3)."""
    p, q, r, s = patches.transpose(1, 0, 2)
    shaft = np.linalg.norm(q - p, axis=1) + np.linalg.norm(s - r, axis=1)
    sweep = np.linalg.norm(r - p, axis=1) + np.linalg.norm(s - q, axis=1)
    # The same corners with the longer side first.
    long = (shaft >= sweep)[:, np.newaxis]
    q, r = np.where(long, q, r), np.where(long, r, q)
    middle, other = 0.5 * (p + q), 0.5 * (r + s)
    return np.concatenate(
        [np.stack([p, middle, r, other], axis=1), np.stack([middle, q, other, s], axis=1)]
    )
