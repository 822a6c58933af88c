# SPDX-License-Identifier: Apache-2.0
"""
Arcs of bounded curvature by RRT* of OMPL.

A state is a position and a direction of the needle. Its coordinates are those of the arc through
it that ends at the target: direction at the target, curvature in two components, and length. The
tree begins at the target, with the direction to each entry voxel as a start state, and its goal
is any direction at any entry point. Two states are connected by two arcs of bounded curvature
(exact steering), and the objective is the least clearance. Coordinates of states between which
two arcs exist are near to each other.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import inf
from time import process_time
from typing import Any, Final

from benchmarks.arcs import Arc, arc_clearance, biarc, bowed_arc
from needle_controller.steering.insertion_plan import guide_axes
from needle_dynamics import FloatArray
from needle_planning.clearance import Clearance
from needle_planning.search import EntryRegion
import numpy as np
from ompl import base, geometric, util
from scipy.spatial import cKDTree

_SPACING: Final = 2e-3  #: Distance of the points of a motion [m].
_KEPT: Final = 1e-9  #: Tolerance of the curvature, relative.
_MOST: Final = 10**9  #: Number of states of the goal region.
_GOAL_BIAS: Final = 0.5  #: Fraction of the samples at the entry.
#: Weights of curvature and length in the distance of states, relative to the entry position [m]
#: for the largest curvature and for the whole length.
_BEND: Final = 1e-3
_ALONG: Final = 1e-3


class ArcStates:
    """Coordinates of states, and motions between them."""

    def __init__(
        self, clearance: Clearance, region: EntryRegion, target: FloatArray, most: float
    ) -> None:
        self.clearance, self.region, self.target, self.most = clearance, region, target, most
        self.axes = guide_axes(region.centers.mean(axis=0) - target)
        away = np.linalg.norm(region.centers - target, axis=1)
        self.height = float(away.max()) + region.radius
        self._tree = cKDTree(region.frame.of_patient(region.centers))
        self._half = float(np.abs(region.halves).max()) * (1.0 + 1e-6)
        #: Arc to each state, and least clearance of each motion, by coordinates.
        self._arcs: dict[tuple[float, ...], Arc] = {}
        self._motions: dict[tuple[float, ...], float] = {}

    def coordinates(self, arc: Arc) -> list[float]:
        """Return the coordinates of the end of an arc from the target."""
        x, y, z = self.axes
        tangent = arc.tangent / (arc.tangent @ y)
        ex, _, ez = guide_axes(arc.tangent)
        bend = _BEND * arc.curvature / self.most
        return [
            self.height * float(tangent @ x),
            self.height * float(tangent @ z),
            bend * float(arc.normal @ ex),
            bend * float(arc.normal @ ez),
            _ALONG * arc.length / self.height,
        ]

    def arc(self, values: tuple[float, ...]) -> Arc:
        """Return the arc from the target to a state."""
        found = self._arcs.get(values)
        if found is None:
            x, y, z = self.axes
            tangent = y + (values[0] * x + values[1] * z) / self.height
            tangent = tangent / np.linalg.norm(tangent)
            ex, _, ez = guide_axes(tangent)
            bend = values[2] * ex + values[3] * ez
            size = float(np.linalg.norm(bend))
            normal = bend / size if size > 0.0 else ez
            length = values[4] / _ALONG * self.height
            found = Arc(self.target, tangent, normal, size / _BEND * self.most, length)
            self._arcs[values] = found
        return found

    def limits(self) -> list[tuple[float, float]]:
        """Return the range of each coordinate."""
        straight = np.array(
            [self.coordinates(bowed_arc(self.target, one, np.zeros(2)))
             for one in self.region.centers]
        )  # fmt: skip
        wider = self.region.radius + 0.5 * self.most * self.height**2
        low, high = straight.min(axis=0)[:2] - wider, straight.max(axis=0)[:2] + wider
        return [
            *zip(low.tolist(), high.tolist(), strict=True),
            (-_BEND, _BEND),
            (-_BEND, _BEND),
            (0.0, _ALONG),
        ]

    def motion(self, first: tuple[float, ...], second: tuple[float, ...]) -> list[Arc]:
        """Return the arcs from a state to another one that is further from the target."""
        if not second[4] > first[4]:
            return []
        one, other = self.arc(first), self.arc(second)
        arcs = biarc(one.end, one.axes_at_end()[0], other.end, other.axes_at_end()[0])
        bound = self.most * (1.0 + _KEPT)
        return list(arcs) if max(arc.curvature for arc in arcs) <= bound else []

    def least(self, first: tuple[float, ...], second: tuple[float, ...]) -> float:
        """Return the least clearance of a motion, -inf without arcs [m]."""
        key = first + second
        found = self._motions.get(key)
        if found is None:
            found = -inf
            if arcs := self.motion(first, second):
                lengths = (
                    np.linspace(0.0, one.length, int(one.length / _SPACING) + 2) for one in arcs
                )
                points = [one.points(at) for one, at in zip(arcs, lengths, strict=True)]
                found = float(self.clearance.at(np.concatenate(points)).min())
            self._motions[key] = found
        return found

    def from_entry(self, values: tuple[float, ...]) -> float:
        """Return the distance of a state from the entry region, in units of the voxels [m]."""
        place = self.region.frame.of_patient(self.arc(values).end)
        distance, _ = self._tree.query(place, p=np.inf)
        return max(0.0, float(distance) - self._half)


def best_path(
    clearance: Clearance,
    region: EntryRegion,
    target: FloatArray,
    most: float,
    *,
    seconds: float,
    seed: int,
) -> list[Arc]:
    """
    Return the arcs from entry to target with the largest clearance, none without a positive one.

    ``most`` is the largest curvature [1/m]; the search ends after a processor time [s].
    """
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed + 1)
    rng, end = np.random.default_rng(seed), process_time() + seconds
    states = ArcStates(clearance, region, target, most)
    space, bounds = base.RealVectorStateSpace(5), base.RealVectorBounds(5)
    for k, (low, high) in enumerate(states.limits()):
        bounds.setLow(k, low)
        bounds.setHigh(k, high)
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(lambda _: True)
    motions = _motions_of(states)(information)
    information.setMotionValidator(motions)
    information.setup()
    problem = base.ProblemDefinition(information)
    for entry in states.region.centers:
        start = information.allocState()
        straight = bowed_arc(states.target, entry, np.zeros(2))
        _set(start, [*states.coordinates(straight)[:4], 0.0])
        problem.addStartState(start)
    goal = _goal_of(states, rng)(information)
    problem.setGoal(goal)
    objective = _objective_of(states)(information)
    # The search uses all of its time.
    objective.setCostThreshold(base.Cost(-_MOST))
    problem.setOptimizationObjective(objective)
    planner = geometric.RRTstar(information)
    planner.setRange(1.0)
    planner.setGoalBias(_GOAL_BIAS)
    planner.setProblemDefinition(problem)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(lambda: process_time() > end))
    if not problem.hasExactSolution():
        return []
    path = problem.getSolutionPath()
    every = [_values(path.getState(k)) for k in range(path.getStateCount())]
    found: list[Arc] = []
    for first, second in pairwise(every):
        found += states.motion(first, second)
    reverse = [one.reverse() for one in reversed(found)]
    return reverse if arc_clearance(clearance, reverse) > 0.0 else []


def _values(state: Any) -> tuple[float, ...]:
    return tuple(state[k] for k in range(5))


def _set(state: Any, values: list[float]) -> None:
    for k, value in enumerate(values):
        state[k] = value


def _motions_of(states: ArcStates) -> Callable[[Any], Any]:
    class Motions(base.MotionValidator):
        def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802
            return states.least(_values(first), _values(second)) > 0.0

    return Motions


def _goal_of(states: ArcStates, rng: np.random.Generator) -> Callable[[Any], Any]:
    region = states.region

    class Entries(base.GoalSampleableRegion):
        def sampleGoal(self, state: Any) -> None:  # noqa: N802
            center = region.centers[rng.integers(len(region.centers))]
            entry = center + rng.uniform(-1.0, 1.0, 3) @ region.halves
            size, turn = states.most * rng.uniform() ** 0.5, rng.uniform(0.0, 2.0 * np.pi)
            bend = size * np.array([np.cos(turn), np.sin(turn)])
            _set(state, states.coordinates(bowed_arc(states.target, entry, bend)))

        def distanceGoal(self, state: Any) -> float:  # noqa: N802
            return states.from_entry(_values(state))

        def maxSampleCount(self) -> int:  # noqa: N802
            return _MOST

    return Entries


def _objective_of(states: ArcStates) -> Callable[[Any], Any]:
    class LeastClearance(base.OptimizationObjective):
        def stateCost(self, _: Any) -> Any:  # noqa: N802
            return base.Cost(-inf)

        def motionCost(self, first: Any, second: Any) -> Any:  # noqa: N802
            return base.Cost(-states.least(_values(first), _values(second)))

        def combineCosts(self, one: Any, other: Any) -> Any:  # noqa: N802
            return base.Cost(max(one.value(), other.value()))

        def identityCost(self) -> Any:  # noqa: N802
            return base.Cost(-inf)

        def isSymmetric(self) -> bool:  # noqa: N802
            return False

    return LeastClearance
