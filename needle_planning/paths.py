# SPDX-License-Identifier: Apache-2.0
"""
Mechanics of a planned path: the bow that a guide can give to a needle, and the best bow.

The needle pierces the skin at the entry point and is inserted along a line in equal steps. At the
start of each step but the first the guide moves while the needle rests. The deflection of the
whole shaft, at all depths of the insertion, is linear in the guide setpoints and in the load of
the bevel (docs/steering.md). The least clearance of the shaft is therefore maximized by a sequence
of linear programs, each with a linearized clearance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from math import ceil, cos, inf, pi, sin, sqrt
from typing import Any, Final, NamedTuple

from needle_controller.steering.settings import SteeringLimits, step_depths
from needle_dynamics.arrays import FloatArray, IntArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import inserted_shape, SteeredNeedle
from needle_dynamics.steering.parameters import SteeringParameters
from needle_planning.clearance import Clearance
import numpy as np

#: Largest slope of a planned needle relative to its line: the model is for small slopes, and its
#: relative error grows with the square of the slope.
STEEPEST: Final = 0.1

#: Largest sideways displacement of a planned needle at the skin, along x and along z [m]. An
#: assumption: 1.6 diameters of a needle of 18 gauge.
SKIN_LIMIT: Final = 2e-3

_SAME: Final = 1e-9  #: Tolerance of equal depths [m].
_UNIT: Final = 1e-3  #: Guide motion of a computed response [m].
_POINTS: Final = 4e-3  #: Distance of the points of the shaft in the linear programs [m].
_TRAVEL: Final = 0.01  #: Cost of guide travel relative to clearance: 10 um per millimeter.
_ROUNDS: Final = 12  #: Most linear programs of a path.
_GAIN: Final = 1e-5  #: Least gain of clearance by a linear program [m].
_LEAST_MOVE: Final = 5e-5  #: Trust region at which the search ends [m].
_BEFORE: Final = 0.9  #: Fraction of the line that a first bow can move.


def needle_radius(needle: NeedleParameters) -> float:
    """Return the outer radius of a tube with the area and area moment of a needle [m]."""
    # A = pi (R^2 - r^2), I = A (R^2 + r^2) / 4.
    return sqrt(2.0 * needle.area_moment / needle.area + needle.area / (2.0 * pi))


class Line(NamedTuple):
    """Line of an insertion."""

    entry: FloatArray  #: entry point in patient coordinates [m], shape (3,)
    axes: FloatArray  #: axes of the guide, see `guide_axes`, shape (3, 3)

    def points(self, depths: FloatArray, deflections: FloatArray) -> FloatArray:
        """Return positions at depths (k,) with deflections in x and z (k, 2) [m], shape (k, 3)."""
        x, y, z = self.axes
        along = np.outer(depths, y)
        return np.asarray(self.entry + along + deflections @ np.stack([x, z]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PathResponses:
    """
    Deflection of the shaft per guide setpoint in each of n steps, equal in x and z.

    A row is a point of the shaft at an insertion depth, after a motion of the guide or at the end
    of a step. The bevel, if any, pushes along z at zero roll.
    """

    depths: FloatArray  #: depths of the steps from the skin to the target [m], shape (n + 1,)
    rows: FloatArray  #: position of each row along the line [m], shape (m,)
    last: IntArray  #: rows of the complete insertion, shape (p,)
    tips: IntArray  #: rows of the tip at each depth, shape (n + 1,)
    shaft: FloatArray  #: deflection per setpoint, shape (m, n)
    slopes: FloatArray  #: slope per setpoint [1/m], shape (m, n)
    loads: FloatArray  #: force on the guide per setpoint, after each motion [N/m], shape (n, n)
    shaft_bevel: FloatArray  #: deflection by the bevel [m], shape (m,)
    slopes_bevel: FloatArray  #: slope by the bevel, shape (m,)
    loads_bevel: FloatArray  #: force on the guide by the bevel [N], shape (n,)

    @property
    def tip(self) -> int:
        """Row of the tip at the target."""
        return int(self.tips[-1])


def path_responses(
    needle: NeedleParameters, steering: SteeringParameters, length: float, step: float
) -> PathResponses:
    """
    Compute the responses of the shaft by simulated insertions, two planes at once.

    Parameters
    ----------
    needle, steering : NeedleParameters, SteeringParameters
        Constants; path noise is ignored.
    length : float
        Depth of the target [m].
    step : float
        Longest step [m].

    Returns
    -------
    PathResponses
        Responses for the steps of `InsertionPlanner`.

    """
    depths = step_depths(length, step)
    steps = len(depths) - 1
    points = [np.linspace(0.0, s, max(1, ceil(s / _POINTS)) + 1) for s in depths]
    # After the motion of the guide at each depth but the last, and at the end of each step.
    rows = np.concatenate([np.zeros(1), *(points[k] for k in range(1, steps) for _ in '12'),
                           points[-1]])  # fmt: skip
    plain = replace(steering, bevel_load=(0.0,), path_noise=0.0)
    found = [_inserted(needle, plain, depths, points, cause) for cause in range(0, steps, 2)]
    shaft, slopes, loads = (
        np.concatenate(one, axis=-1)[..., :steps] / _UNIT for one in zip(*found, strict=True)
    )
    if max(steering.bevel_load) > 0.0:
        pushed = _inserted(needle, replace(steering, path_noise=0.0), depths, points, None)
    else:
        pushed = np.zeros((len(rows), 2)), np.zeros((len(rows), 2)), np.zeros((steps, 2))
    return PathResponses(
        depths=depths,
        rows=rows,
        last=np.arange(len(rows) - len(points[-1]), len(rows)),
        # A depth inside has two groups of rows, and the tip is the last row of each.
        tips=np.cumsum([1, *(len(one) * 2 for one in points[1:-1]), len(points[-1])])
        - [1, *(len(one) + 1 for one in points[1:-1]), 1],
        shaft=shaft,
        slopes=slopes,
        loads=loads,
        shaft_bevel=pushed[0][:, 1],
        slopes_bevel=pushed[1][:, 1],
        loads_bevel=pushed[2][:, 1],
    )


def _inserted(
    needle: NeedleParameters,
    steering: SteeringParameters,
    depths: FloatArray,
    points: list[FloatArray],
    cause: int | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return deflections and slopes (m, 2) and loads (n, 2) with the guide moved in two steps."""
    one = SteeredNeedle(needle, steering)
    steps = len(depths) - 1
    shaft, slopes, loads = [], [], []
    for k in range(steps):
        if cause is not None:
            one.move(guide=(_UNIT * (k == cause), _UNIT * (k == cause + 1)))
        values, turns = inserted_shape(one, points[k] if k else np.zeros(1))
        shaft.append(values)
        slopes.append(turns)
        loads.append(one.guide_load[0])
        one.move(depth=float(depths[k + 1]))
        values, turns = inserted_shape(one, points[k + 1])
        shaft.append(values)
        slopes.append(turns)
    return np.concatenate(shaft), np.concatenate(slopes), np.array(loads)


class _Program:
    """Linear constraints on the guide setpoints, equal in x and z but for the bevel."""

    def __init__(
        self,
        responses: PathResponses,
        limits: SteeringLimits,
        roll: float,
        skin_limit: float,
        *,
        slopes: bool = True,
    ) -> None:
        from scipy.sparse import csr_array, eye_array, vstack

        self.responses, r, n = responses, responses, len(responses.depths) - 1
        self.steps, self.push = n, np.array([sin(roll), cos(roll)])
        self.change = csr_array(eye_array(n) - eye_array(n, k=-1))
        rows, offsets, most = [self.change], [np.zeros(n)], [np.full(n, limits.guide_step)]
        # Each plane has an equal part of the largest slope; every fourth point is enough.
        some = np.union1d(np.arange(0, len(r.rows), 4), r.last)[: None if slopes else 0]
        skin = np.flatnonzero(r.rows == 0.0)
        rows += [r.loads, r.shaft[skin], r.slopes[some]]
        offsets += [r.loads_bevel, r.shaft_bevel[skin], r.slopes_bevel[some]]
        most += [np.full(n, limits.load_limit), np.full(len(skin), skin_limit)]
        most += [np.full(len(some), STEEPEST / sqrt(2.0))]
        matrix, offset, bound = (
            csr_array(vstack(rows)),
            np.concatenate(offsets),
            np.concatenate(most),
        )
        # Without the limits that the range of the guide implies.
        largest = limits.guide_limit * abs(matrix).sum(axis=1) + np.abs(offset)
        binding = largest > bound
        #: Constraints of one plane, and their bounds in x and z.
        self.matrix = vstack([matrix[binding], -matrix[binding]])
        off = np.outer(self.push, offset[binding])
        self.bounds = np.hstack([bound[binding] - off, bound[binding] + off])
        # The guide is at zero while the needle pierces the skin: at the entry point.
        self.most = np.append(0.0, np.full(n - 1, limits.guide_limit))
        self.tip = r.shaft[r.tip][np.newaxis]
        self.at_target = -self.push * r.shaft_bevel[r.tip]

    @property
    def symmetric(self) -> bool:
        """Whether the needle is straight with the guide at zero."""
        return not self.responses.shaft_bevel.any()

    def deflections(self, guide: FloatArray) -> FloatArray:
        """Return the deflections of all rows for setpoints (2 n,), shape (m, 2) [m]."""
        r = self.responses
        return np.asarray(r.shaft @ guide.reshape(2, -1).T + np.outer(r.shaft_bevel, self.push))

    def extreme(self, row: FloatArray, axis: int, sign: float) -> FloatArray | None:
        """Return the setpoints (n,) along an axis with the largest deflection of a row (n,)."""
        box = [(-most, most) for most in self.most]
        return _linear_program(
            -sign * row, self.matrix, self.bounds[axis], self.tip, self.at_target[axis : axis + 1],
            box,
        )  # fmt: skip

    def improve(
        self, guide: FloatArray, values: FloatArray, gradients: FloatArray, trust: float
    ) -> FloatArray | None:
        """Return the setpoints with the largest linearized clearance within a trust region."""
        from scipy.sparse import block_diag, csr_array, eye_array, hstack, vstack

        n, r = self.steps, self.responses
        # Only rows that can limit the clearance: it changes at most as the deflection.
        moved = sqrt(2.0) * trust * np.abs(r.shaft).sum(axis=1)
        active = values - moved <= (values + moved).min()
        some = r.shaft[active]
        gain = np.hstack([gradients[active, :1] * some, gradients[active, 1:] * some])
        # Variables: guide in x and z, travel of both, clearance.
        change = block_diag([self.change] * 2)
        travel = eye_array(2 * n)
        # Only limits within the trust region.
        limits = csr_array(block_diag([self.matrix] * 2))
        slack = self.bounds.ravel() - limits @ guide
        near = slack <= trust * abs(limits).sum(axis=1)
        rows = vstack(
            [
                hstack([csr_array(-gain), csr_array((len(gain), 2 * n)), np.ones((len(gain), 1))]),
                hstack([change, -travel, csr_array((2 * n, 1))]),
                hstack([-change, -travel, csr_array((2 * n, 1))]),
                self._wide(limits[near]),
            ]
        )
        bounds = [values[active] - gain @ guide, np.zeros(4 * n), self.bounds.ravel()[near]]
        low, high = np.maximum(guide - trust, -self.both), np.minimum(guide + trust, self.both)
        box = [*zip(low, high, strict=True), *[(0.0, None)] * (2 * n), (None, None)]
        cost = np.concatenate([np.zeros(2 * n), np.full(2 * n, _TRAVEL), [-1.0]])
        tip = self._wide(block_diag([self.tip] * 2))
        found = _linear_program(cost, rows, np.concatenate(bounds), tip, self.at_target, box)
        return None if found is None else found[: 2 * n]

    @property
    def both(self) -> FloatArray:
        """Largest position of the guide in each step, in x and then in z [m]."""
        return np.tile(self.most, 2)

    def _wide(self, matrix: Any) -> Any:
        """Append the columns of travel and clearance."""
        from scipy.sparse import csr_array, hstack

        return hstack([matrix, csr_array((matrix.shape[0], 2 * self.steps + 1))])


def _linear_program(
    cost: FloatArray, rows: Any, bounds: Any, equal: Any, to: FloatArray, box: list[Any]
) -> FloatArray | None:
    """Minimize a cost by HiGHS; None without a solution."""
    from scipy.optimize import linprog

    # Millimeters: the tolerance of the solver is 1e-7, absolute.
    found = linprog(
        cost, rows, None if bounds is None else 1e3 * bounds, equal, 1e3 * to,
        [tuple(None if one is None else 1e3 * one for one in pair) for pair in box],
        method='highs',
    )  # fmt: skip
    return 1e-3 * np.asarray(found.x) if found.status == 0 else None


def bow_profile(
    responses: PathResponses,
    limits: SteeringLimits,
    roll: float,
    parts: int,
    skin_limit: float = SKIN_LIMIT,
) -> FloatArray:
    """
    Return the largest deflection of any path at equal fractions of a line, from entry to target.

    At each place it is the smaller one of the deflections of the complete needle, and of the tip
    when it is there. Both planes have the same limits, so that the deflection in any direction is
    at most the root of 2 times the largest one along an axis. Between two fractions the largest
    deflection is at most the linear interpolation. Shape (parts + 1,) [m].
    """
    # Without the limit of the slope, which changes the bound by a few percent.
    program, r = _Program(responses, limits, roll, skin_limit, slopes=False), responses

    def largest(row: int) -> float:
        found = 0.0
        for axis, sign in [(0, 1.0)] if program.symmetric else product((0, 1), (1.0, -1.0)):
            guide = program.extreme(r.shaft[row], axis, sign)
            if guide is None:
                # The guide cannot bring the tip of the bevel to the target.
                return -inf
            off = r.shaft[row] @ guide + r.shaft_bevel[row] * program.push[axis]
            found = max(found, abs(float(off)))
        return sqrt(2.0) * found

    # Every second point of the complete needle, and the tip at each depth.
    shaft = np.append(r.last[:-1:2], r.last[-1])
    bounds = np.full(parts, inf)
    ends = np.linspace(0.0, r.depths[-1], parts + 1)
    for rows in (shaft, r.tips):
        at, values = r.rows[rows], np.array([largest(int(row)) for row in rows])
        first = np.searchsorted(at, ends[:-1] + _SAME, side='right') - 1
        last = np.searchsorted(at, ends[1:] - _SAME)
        each = [values[a : b + 1].max() for a, b in zip(first, last, strict=True)]
        bounds = np.minimum(bounds, each)
    # At both ends the needle is on the line.
    return np.concatenate([[0.0], np.maximum(bounds[1:], bounds[:-1]), [0.0]])


class BowedNeedle(NamedTuple):
    """Guide setpoints of a path, and its clearance in the linear model."""

    guide: FloatArray  #: position of the guide in each step, x and z [m], shape (n, 2)
    clearance: float  #: least clearance at the rows of the responses [m]


def best_bow(
    clearance: Clearance,
    line: Line,
    responses: PathResponses,
    limits: SteeringLimits,
    roll: float = 0.0,
    skin_limit: float = SKIN_LIMIT,
) -> BowedNeedle | None:
    """
    Maximize the least clearance of the shaft at all depths, from several first bows.

    Parameters
    ----------
    clearance : Clearance
        Clearance around the line.
    line : Line
        Line from the entry point to the target.
    responses : PathResponses
        Responses for the length of the line.
    limits : SteeringLimits
        Limits of guide position, guide motion and lateral load.
    roll : float
        Roll of the needle [rad].
    skin_limit : float
        Largest sideways displacement of the shaft at the skin, along x and along z [m].

    Returns
    -------
    BowedNeedle or None
        A local optimum; None if no guide setpoints bring the tip to the target.

    """
    program = _Program(responses, limits, roll, skin_limit)
    x, _, z = line.axes
    lateral = np.stack([x, z])

    def evaluate(guide: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        points = line.points(responses.rows, program.deflections(guide))
        values, gradients = clearance.gradient(points)
        return float(values.min()), values, gradients @ lateral.T

    zero = np.zeros(program.steps)
    _, values, _ = evaluate(np.tile(zero, 2))
    # First bows: largest where the straight needle has the least clearance, in eight directions.
    middle = int(responses.last[values[responses.last].argmin()])
    if responses.rows[middle] > _BEFORE * responses.depths[-1]:
        middle = int(responses.last[len(responses.last) // 2])
    row = responses.shaft[middle]
    planes = []
    for axis in range(2):
        rest = zero if program.symmetric else program.extreme(zero, axis, 1.0)
        bent = [program.extreme(row, axis, sign) for sign in (1.0, -1.0)]
        every = [one for one in (rest, *bent) if one is not None]
        if len(every) < len(bent) + 1:
            return None
        planes.append(every)
    starts: list[FloatArray] = [np.concatenate(pair) for pair in product(*planes)]
    ranked = sorted(((evaluate(one)[0], k) for k, one in enumerate(starts)), reverse=True)
    return _climb(program, evaluate, starts[ranked[0][1]])


def _climb(program: _Program, evaluate: Any, guide: FloatArray) -> BowedNeedle:
    """Improve setpoints by linear programs until the trust region is small."""
    least, values, gradients = evaluate(guide)
    trust = min(2e-3, max(float(program.most.max()), _LEAST_MOVE))
    for _ in range(_ROUNDS):
        other = program.improve(guide, values, gradients, trust)
        if other is None or trust < _LEAST_MOVE:
            break
        found = evaluate(other)
        if found[0] > least + _GAIN:
            guide, (least, values, gradients) = other, found
        else:
            trust *= 0.3
    return BowedNeedle(guide.reshape(2, -1).T, least)
