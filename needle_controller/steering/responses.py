# SPDX-License-Identifier: Apache-2.0
r"""
Linear responses of the tip to guide, tilt, bevel and path noise, for each hypothesis.

At given depths the tip is linear in the positions of the guide, in its tilt, in the load of the
bevel, and in the loads that bend its path away from the nominal one:

.. math:: z_k = \sum_j A_{kj} b_j + H_k \theta

with positions :math:`b_j` of the guide in the steps, and unknown constants :math:`\theta`: origin
and rotation of the sensor's frame, tilt, bevel, and a curvature of the path at each depth, linear
between the depths. A and H depend on the bending length and on the stiffness of the skin, which
form a grid. A position between two points of the grid is described by two more unknown constants,
with the difference of A between the points. The logarithm of the stiffness of each layer is one
more, if the prior has a spread for layers. A hypothesis is a point of the grid with a path noise
and a slow error of the sensor: a needle, tissue or sensor that differs from the model is
explained by them. They widen the prediction, and path noise lets each measurement count more. The
slow error is the last unknown constant. It changes from step to step.

The responses are equal in both planes, so that all quantities are complex numbers, x + i z. At a
roll :math:`\varphi` the bevel pushes along :math:`i e^{-i \varphi}`.

A needle with a bevel has kinematic points in addition to the grid, for a needle that is turned:
stiff tissue holds the shaft, which follows the tip along arcs (Webster et al., "Nonholonomic
modeling of needle steering", 2006), and friction winds up the shaft (Reed et al., "Modeling and
control of needles with torsional friction", 2009). The formulas are in docs/steering.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil, exp
from typing import Final

from needle_controller.compiled.hypothesis_model import HypothesisResponses, StatePrior
from needle_controller.steering.settings import SteeringPrior
from needle_dynamics.arrays import FloatArray, IntArray
from needle_dynamics.compiled.cutting_needle import Steered
from needle_dynamics.compiled.superposition import insert_causes
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import steered
from needle_dynamics.steering.parameters import (
    by_layer,
    longest_element,
    longest_insertion,
    SteeringParameters,
    turning_load,
    with_bevel,
    with_lengths,
)
from needle_ros.errors import ParameterError
import numpy as np
from numpy.typing import ArrayLike

#: Constants of `NeedleParameters` and of `SteeringParameters` on which the responses depend.
OF_NEEDLE: Final = (
    'length', 'youngs_modulus', 'area_moment', 'tissue_stiffness', 'layer_depths',
    'layer_stiffnesses',
)  # fmt: skip
OF_STEERING: Final = ('free_length', 'skin_stiffness', 'bevel_load')

#: Hypotheses of the bending length, and of the skin relative to the highest one.
_LENGTHS: Final = 13
_SKINS: Final = (0.0, 0.1, 1.0 / 3.0, 1.0)

#: Kinematic hypotheses: distance of the tip ahead of the arcs [m] (24 mm in Webster et al.), and
#: lag of its roll per depth [rad/m] (45 degrees at 10 cm in Reed et al.).
_LEADS: Final = (0.0, 0.025)
_WINDUPS: Final = (0.0, 4.0, 8.0)

_PATHS: Final = (1.0, 10.0, 100.0)  #: Hypotheses of path noise, relative to the least one.
#: Slow errors of the sensor relative to `SteeringPrior.drift`, and logarithm of their weights.
#: With equal weights, the first measurements of a precise sensor would be doubted.
_DRIFTS: Final = {0.0: 0.0, 1.0: 0.0, 3.0: -2.0}
DRIFT_LENGTH: Final = 0.05  #: Correlation length of the slow error of the sensor [m].
_BEYOND: Final = 1.1  #: Half width of the grid over the spread.
_ELEMENT: Final = 1.25e-3  #: Longest element [m]: good to a few micrometers.
_SAME: Final = 1e-9  #: Tolerance of equal depths [m].
BEVEL: Final = 3  #: Index of the load of the bevel among the causes.
_LEAST_SPREAD: Final = 1e-3  #: Least half width of a difference over the stiffness of a layer.
_EVEN: Final = 12.0**-0.5  #: Standard deviation of a uniform distribution over a cell of the grid.


class SteeringModel:
    """
    Responses of the tip at the ends of the steps, and prior of their causes, by hypothesis.

    Parameters
    ----------
    needle : NeedleParameters
        Nominal needle and tissue.
    steering : SteeringParameters
        Nominal constants of steering; path noise and bevel are taken from the prior.
    depths : array_like, shape (n + 1,)
        Depths of the tip measurements [m], increasing; the needle reaches the first one straight.
    prior : SteeringPrior, optional
        Prior uncertainty.
    together : bool
        Whether the guide moves in proportion to the depth and reaches the position of a step at
        its end; otherwise it moves while the needle rests, and rests during the insertion.
    progress : callable, optional
        Called before each hypothesis, with the number of those done and of all. Its exception
        cancels the construction. A hypothesis of 200 steps takes 10 ms, without the GIL.

    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters,
        depths: ArrayLike,
        prior: SteeringPrior | None = None,
        *,
        together: bool = False,
        progress: Callable[[int, int], object] | None = None,
    ) -> None:
        at = np.array(depths, dtype=np.float64)
        if at.ndim != 1 or len(at) < 2 or not np.isfinite(at).all() or (np.diff(at) <= 0.0).any():
            raise ParameterError(
                'depths must be numbers that increase, two at least, got '
                f'{np.array2string(at, threshold=6)} m'
            )
        reach = longest_insertion(needle, steering)
        if not (at[0] >= 0.0 and at[-1] <= reach):
            raise ParameterError(
                f'depths must be in [0, {reach:g}] m, the length of the needle without its free '
                f'length, got {at[0]:g} to {at[-1]:g} m'
            )
        if not needle.tissue_stiffness > 0.0:
            raise ParameterError(
                'steering needs tissue that bends the needle: tissue_stiffness must be > 0 N/m^2'
            )
        self.needle, self.steering = needle, steering
        self.depths, self.prior = at, prior or SteeringPrior()
        #: Nominal load of the bevel, along z at zero roll [N].
        self.push = most = max(steering.bevel_load)
        b, n = self.prior, self.steps
        width = _BEYOND * b.spread
        lengths = np.geomspace(1.0 - width, 1.0 + width, _LENGTHS if width else 1)
        nominal = steering.skin_stiffness / needle.tissue_stiffness
        skins = np.array([nominal])
        if width and b.skin:
            skins = np.array(_SKINS) * b.skin
            if nominal:
                # The nearest of the points that are not zero becomes the nominal one.
                skins[1 + np.abs(skins[1:] - nominal).argmin()] = nominal
        grid_lengths, grid_skins = (one.ravel() for one in np.meshgrid(lengths, skins))
        spreads = _layer_spreads(b, needle.tissue.starts, float(at[-1]))
        # The responses are per load in the layer with the largest load of the bevel.
        unit = replace(with_bevel(steering, 1.0), element=_ELEMENT, path_noise=0.0)
        shortest = with_lengths(needle, unit, float(lengths[0]))
        rows = _Rows(at, needle.tissue.starts, longest_element(*shortest), together)
        arcs = [(lead, windup) for lead in _LEADS for windup in _WINDUPS if width and most]
        beams, points = len(grid_lengths), len(grid_lengths) + len(arcs)
        arrays: list[FloatArray] = []
        changes: list[FloatArray] = []
        for i in range(points):
            if progress is not None:
                progress(i, points)
            if i < beams:
                stiffness = float(grid_skins[i]) * needle.tissue_stiffness
                skin = replace(unit, skin_stiffness=stiffness)
                point = steered(*with_lengths(needle, skin, float(grid_lengths[i])))
                found = _respond(point, unit, at, rows)
                changes.append(_layer_responses(point, unit, rows, spreads))
            else:
                found = _kinematic(steered(needle, unit), unit, at, arcs[i - beams][0])
            arrays = arrays or [np.empty((points, *one.shape)) for one in found]
            for of_all, one in zip(arrays, found, strict=True):
                of_all[i] = one
        guide, _, bevel, *_ = arrays
        between = np.zeros((2 + len(spreads), *guide.shape))
        grid = len(skins), len(lengths), n + 1, n
        for change, axis in zip(between[:2], (1, 0), strict=True):
            if grid[axis] > 1:
                whole = np.gradient(guide[:beams].reshape(grid), axis=axis)
                change[:beams] = whole.reshape(beams, n + 1, n)
        between[2:, :beams] = np.stack(changes, axis=1)
        lags = np.outer([0.0] * beams + [windup for _, windup in arcs], at)
        later = _sums_from(guide[:, -1], n + 1), _sums_from(bevel[:, -1], n + 3)
        #: Responses at the g points of the grid; hypothesis i has point i modulo g.
        self.responses = HypothesisResponses(*[*arrays, between, lags, *later])
        drifts = _DRIFTS if b.drift else {0.0: 0.0}
        kinds = np.array([
            (q * b.path_noise, d * b.drift, log) for d, log in drifts.items() for q in _PATHS
        ])  # fmt: skip
        self.logs = np.repeat(kinds[:, 2], points)  #: logarithm of the prior weights, shape (h,)
        #: Whether a hypothesis is kinematic, of a needle that is turned; shape (h,).
        self.rolled = np.tile(np.arange(points) >= beams, len(kinds))
        #: Bending length by hypothesis, relative to the nominal one, and stiffness of the skin
        #: relative to that of the tissue [m]; shape (h,).
        self.lengths = np.tile(np.append(grid_lengths, np.ones(len(arcs))), len(kinds))
        self.skins = np.tile(np.append(grid_skins, np.full(len(arcs), nominal)), len(kinds))
        causes = np.concatenate([self.responses.causes, self.responses.causes_load], axis=1)
        known = np.diag([b.offset**2, b.frame**2, b.tilt**2])
        apart = np.abs(at[:, np.newaxis] - at) / b.path_noise_length
        path = np.exp(-apart) / (2.0 * b.path_noise_length)
        self.state_prior = StatePrior(
            known=_covariance(causes[:, :, :BEVEL], known, n + 1),
            wandering=_covariance(causes[:, :, BEVEL + 1 :], path, n + 1),
            deviations=np.array([b.bevel, _EVEN, _EVEN, *spreads]),
            noises=np.repeat(kinds[:, 0], points),
            drifts=np.repeat(kinds[:, 1], points),
            decay=np.exp(-np.diff(at) / DRIFT_LENGTH),
        )

    @property
    def steps(self) -> int:
        """Number of steps n."""
        return len(self.depths) - 1


def _covariance(causes: FloatArray, of_causes: FloatArray, tips: int) -> FloatArray:
    """Return the covariance of tips with tips and forces, shape (g, tips, tips + forces)."""
    return np.asarray(causes[:, :tips] @ of_causes @ causes.transpose(0, 2, 1))


def _respond(
    base: Steered, steering: SteeringParameters, depths: FloatArray, rows: _Rows
) -> tuple[FloatArray, ...]:
    """Insert a needle once for each cause; return its row of the first seven responses."""
    n = len(depths) - 1
    loads = rows.bevel * base.bevel[rows.layers, np.newaxis]
    turning = np.array([turning_load(base.ei, k) for k in base.stiffness.tolist()])
    loads[:, 2 * n + 2 :] = rows.curvature * turning[rows.layers_ahead, np.newaxis]
    tips, forces = np.empty((2, *loads.shape))
    insert_causes(
        base.ei, base.skin, steering.free_length, rows.depths, base.stiffness[rows.layers],
        rows.tilt, rows.guide, loads, tips, forces,
    )  # fmt: skip
    tip, turned = tips[rows.inserted], tips[rows.turned]
    # A turn of the bevel at rest moves the tip elastically.
    elastic = (turned - tip[:-1])[:, n + 2 : 2 * n + 2].diagonal()
    of_tip = _by_cause(tip, np.ones(n + 1), depths)
    # The frame of the sensor has no effect on the force on the guide.
    of_guide = _by_cause(forces[rows.guided], np.zeros(n), np.zeros(n))
    return *of_tip, np.append(elastic, elastic[-1]), *of_guide


def _layer_spreads(prior: SteeringPrior, starts: Sequence[float], last: float) -> FloatArray:
    """Return the spread of each layer that begins above the last depth [m], shape (layers,)."""
    if not prior.layer_spread:
        return np.zeros(0)
    spreads = by_layer('prior.layer_spread', prior.layer_spread, len(starts))
    return spreads[: int(np.searchsorted(starts, last))]


def _layer_responses(
    base: Steered, steering: SteeringParameters, rows: _Rows, spreads: FloatArray
) -> FloatArray:
    """Return the change of the response to the guide per logarithm of the stiffness of layers."""
    n = len(rows.inserted) - 1
    guide, loads = np.ascontiguousarray(rows.guide[:, :n]), np.zeros((len(rows.depths), n))
    found, tips, forces = np.zeros((len(spreads), n + 1, n)), *np.empty((2, *loads.shape))
    for layer, spread in enumerate(spreads.tolist()):
        # Over the range of the prior: the response is not linear in it.
        half = max(spread, _LEAST_SPREAD)
        for sign in (1.0, -1.0):
            stiffness = base.stiffness.copy()
            stiffness[layer] *= exp(sign * half)
            insert_causes(
                base.ei, base.skin, steering.free_length, rows.depths, stiffness[rows.layers],
                np.zeros(n), guide, loads, tips, forces,
            )  # fmt: skip
            found[layer] += sign / (2.0 * half) * tips[rows.inserted]
    return found


def _kinematic(
    base: Steered, steering: SteeringParameters, depths: FloatArray, lead: float
) -> tuple[FloatArray, ...]:
    """Return the responses, as `_respond`, of a tip that is a distance ahead of its arcs [m]."""
    n, edges = len(depths) - 1, np.append(0.0, depths)
    middles = 0.5 * (edges[1:] + edges[:-1])
    layers = _layers(base.starts, middles)
    turning = np.array([turning_load(base.ei, k) for k in base.stiffness[layers].tolist()])
    # A load F bends the path of a long needle by F lambda / (E I).
    bent = np.divide(base.bevel[layers], turning, out=np.zeros(n + 1), where=turning > 0.0)
    left = np.maximum(depths[:, np.newaxis] - edges, 0.0)
    arcs, shifts = -np.diff(0.5 * left**2, axis=1), -np.diff(left, axis=1)
    bevel = (arcs + lead * shifts) * bent
    path = arcs @ np.array([np.interp(middles, depths, one) for one in np.eye(n + 1)]).T
    tilt = steering.free_length + depths
    causes = np.column_stack([np.ones(n + 1), depths, tilt, bevel.sum(axis=1), path])
    rest = np.zeros((n, n)), np.zeros((n, 5 + n)), np.zeros((n, n + 1))
    return np.zeros((n + 1, n)), causes, bevel, np.zeros(n + 1), *rest


def _by_cause(
    found: FloatArray, origin: FloatArray, turn: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Split responses, shape (k, 3 n + 3): to guide, to constant causes and to the bevel."""
    n = found.shape[1] // 3 - 1
    bevel = found[:, n + 1 : 2 * n + 2]
    constants = origin, turn, found[:, n], bevel.sum(axis=1), found[:, 2 * n + 2 :]
    return found[:, :n], np.column_stack(constants), bevel


class _Rows:
    """
    Arguments of `insert_causes` that are the same for all hypotheses.

    Causes are the guide in each step, its tilt, the bevel on the skin and in each step, and the
    curvature of the path at each depth. A row is the end of an element, of a motion at rest, or of
    a layer, where the load of the bevel changes at rest. Pose 2k is the needle at depth k, and in
    pose 2k + 1 guide and roll have changed there. `inserted`, `turned` and `guided` are the rows
    at which the needle is at a depth, the bevel has been turned, and the guide is in position.
    """

    def __init__(
        self, at: FloatArray, starts: Sequence[float], longest: float, together: bool
    ) -> None:
        n, borders = len(at) - 1, np.array(starts)
        found, ends = [(0.0, 0.0, int(_layers(borders, 0.0)))], []
        for pose in range(2 * n + 1):
            begun, _, layer = found[-1]
            to = float(at[pose // 2])
            if to - begun < _SAME:
                found.append((begun, float(pose), layer))
            else:
                inside = borders[(begun + _SAME < borders) & (borders < to - _SAME)]
                for stop in [*inside.tolist(), to]:
                    here, before, layer = found[-1]
                    count = ceil((stop - here) / longest - 1e-9)
                    for depth in np.linspace(here, stop, count + 1)[1:].tolist():
                        before = max(0.0, pose - (to - depth) / (to - begun))
                        found.append((depth, before, layer))
                    if _layers(borders, stop) != layer:
                        found.append((stop, before, int(_layers(borders, stop))))
            ends.append(len(found) - 1)
        depths, poses, layers = zip(*found, strict=True)
        self.inserted, self.turned = np.array(ends[::2]), np.array(ends[1::2])
        self.guided = np.array(ends[2 if together else 1 :: 2])
        self.depths, self.layers = np.array(depths), np.array(layers)
        posed = np.zeros((2, 2 * n + 1, 3 * n + 3))
        posed[1, 0, n + 1] = 1.0
        for k in range(n):
            first = 2 * k + (2 if together else 1)
            posed[0, first : first + 2, k] = 1.0
            posed[1, 2 * k + 1 : 2 * k + 3, n + 2 + k] = 1.0
        whole = np.array(poses).astype(np.int64)
        part = (np.array(poses) - whole)[:, np.newaxis]
        # Linear from pose to pose.
        later = np.minimum(whole + 1, 2 * n)
        posed = (1.0 - part) * posed[:, whole] + part * posed[:, later]
        # Compiled code requires contiguous arrays.
        self.guide, self.bevel = np.ascontiguousarray(posed)
        self.tilt = np.zeros(3 * n + 3)
        self.tilt[n] = 1.0
        # The tip load is the turning load half of the shortest element ahead of the tip.
        smallest = float(np.diff(at).min())
        ahead = self.depths + 0.5 * smallest / ceil(smallest / longest - 1e-9)
        self.layers_ahead = _layers(borders, ahead)
        self.curvature = np.array([np.interp(ahead, at, one) for one in np.eye(n + 1)]).T


def _layers(starts: FloatArray, depths: ArrayLike) -> IntArray:
    return np.asarray(np.searchsorted(starts, np.asarray(depths) + _SAME, side='right') - 1)


def _sums_from(values: FloatArray, count: int) -> FloatArray:
    """Return sums of absolute values from each column to the last, shape (h, count), then 0."""
    found = np.zeros((len(values), count))
    found[:, : values.shape[1]] = np.abs(values)[:, ::-1].cumsum(axis=1)[:, ::-1]
    return found
