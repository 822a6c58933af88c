# SPDX-License-Identifier: Apache-2.0
"""Probability of contact along a plan: exact, calibrated, and acted on in time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_controller import (
    MultiHypothesisLaw,
    SIMULATION_LIMITS,
    SteeringLimits,
    SteeringModel,
    SteeringPrior,
)
from needle_controller.steering.contact import MonitoredLaw
from needle_controller.steering.free_space import most_clearance, probability_outside, UNITS
from needle_controller.steering.insertion_plan import DIRECTIONS, Plan
from needle_controller.steering.law import build_law, ContactError
from needle_controller.steering.settings import ContactSettings
from needle_controller.steering.simulation import simulate_steering, SteeringPlant
from needle_dynamics import FloatArray, NEEDLES, SteeredNeedle
from needle_ros.errors import ParameterError
from needle_ros.status import SteeringPhase as Phase
from needle_ros.system_state import Mode
import numpy as np
from numpy.testing import assert_allclose
import pytest
from support.plans import bowed_plan, tube
from support.steered_robot import Robot

NEEDLE, STEERING, _ = NEEDLES['bending_35mm']
PLAN = bowed_plan()
PRIOR = SteeringPrior(noise=5e-5)
MODEL = SteeringModel(NEEDLE, STEERING, PLAN.depths, PRIOR)
NEVER = ContactSettings(limit=1.0 - 1e-12)


def plan_with(change: dict[tuple[float, float], FloatArray | float]) -> Plan:
    """Return a plan in free space but for the free distances between two depths [m]."""
    free = tube(PLAN.length, 0.01)
    for (low, high), distance in change.items():
        free[(free[:, 0] >= low) & (free[:, 0] < high), 1:] = distance
    return replace(PLAN, free=free)


def wall(side: float, distance: float) -> FloatArray:
    """Return the free distances beside a wall at a distance along x [m]; ``side`` is 1 or -1."""
    towards = side * UNITS[:, 0]
    # Beyond 10 mm, free space is not stated.
    far = np.divide(distance, towards, out=np.full(DIRECTIONS, 0.01), where=towards > 1e-9)
    return np.asarray(np.minimum(far, 0.01))


def monitored_law(
    plan: Plan, contact: ContactSettings, limits: SteeringLimits = SIMULATION_LIMITS
) -> MonitoredLaw:
    path = plan.tip_path
    law = build_law('multi_hypothesis', MODEL, path.tips[-1], limits, path=path)
    assert isinstance(law, MultiHypothesisLaw)
    return MonitoredLaw(law, MODEL, plan, path, limits, contact)


def plant_of(tilt: float = 0.0, stiffness: float = 1.0) -> SteeringPlant:
    needle = replace(NEEDLE, tissue_stiffness=stiffness * NEEDLE.tissue_stiffness)
    return SteeringPlant(SteeredNeedle(needle, STEERING, tilt=(tilt, 0.0)), PLAN.depths)


# Probability of a polygon.


def test_probability_of_a_circle_is_that_of_rayleigh() -> None:
    """Between the circles inside and around the polygon, for any common scale."""
    r = np.linspace(0.1, 4.0, 20)
    free, off = np.repeat(1e-3 * r[:, np.newaxis], DIRECTIONS, 1), np.zeros((len(r), 2))
    found = probability_outside(free, off, np.tile(1e-6 * np.eye(2), (len(r), 1, 1)))
    inner = r * np.cos(np.pi / DIRECTIONS)
    assert (np.exp(-0.5 * r**2) <= found).all()
    assert (found <= np.exp(-0.5 * inner**2)).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_probability_is_the_fraction_of_samples(seed: int) -> None:
    """Of any polygon and distribution, within five standard errors; also with a mean outside."""
    rng, count = np.random.default_rng(seed), 20_000
    free, off = rng.uniform(0.0, 3.0, (1, DIRECTIONS)), 1.5 * rng.standard_normal((1, 2))
    factor = rng.standard_normal((2, 2))
    covariance = factor @ factor.T + 0.05 * np.eye(2)
    found = float(probability_outside(free, off, covariance[np.newaxis])[0])
    points = rng.multivariate_normal(off[0], covariance, count)
    # In the triangle of the two directions around a point.
    k = np.floor(np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi / DIRECTIONS)).astype(int)
    a, b = (
        free[0, (k + i) % DIRECTIONS, np.newaxis] * UNITS[(k + i) % DIRECTIONS] for i in (0, 1)
    )
    edge, to = b - a, points - a
    outside = (edge[:, 0] * to[:, 1] - edge[:, 1] * to[:, 0] < 0.0).mean()
    assert abs(outside - found) < 5.0 * np.sqrt(0.25 / count)


def test_no_free_space_is_certain_contact() -> None:
    zero = np.zeros((1, DIRECTIONS))
    assert_allclose(probability_outside(zero, np.zeros((1, 2)), np.eye(2)[np.newaxis]), 1.0)


# Law.


def test_free_space_without_obstacles_changes_nothing() -> None:
    """The same setpoints as without monitoring."""
    found = []
    for contact in (ContactSettings(), None):
        law: Any = monitored_law(plan_with({}), contact or NEVER)
        law = law.law if contact is None else law
        plant = plant_of(0.02)
        simulate_steering(law, plant, lambda tip: tip)
        found.append(plant.tip)
    assert np.array_equal(found[0], found[1])


@pytest.mark.requirement('S-316')
@pytest.mark.parametrize('depth', [0.012, 0.03, 0.05])
def test_needle_stops_before_a_wall_across_the_path(depth: float) -> None:
    """At the latest before the motion that would reach it; the line has depth and probability."""
    law, plant = monitored_law(plan_with({(depth, 0.06): 0.0}), ContactSettings()), plant_of()
    with pytest.raises(ContactError, match=r'contact at a depth of \d+\.\d mm has a probabi') as c:
        simulate_steering(law, plant, lambda tip: tip)
    assert plant.needle.depth < depth
    assert '100%, at most 20% are permitted' in str(c.value)


def test_mirrored_needle_and_walls_have_mirrored_probabilities() -> None:
    """The law is symmetric to rounding; a probability may be steep in the deviation."""
    found: list[list[float]] = []
    for sign in (1.0, -1.0):
        plan = plan_with({(0.02, 0.04): wall(sign, 6e-4)})
        mirror = np.eye(3) - (1.0 - sign) * np.outer(PLAN.axes[0], PLAN.axes[0])
        tips = PLAN.entry + (PLAN.path - PLAN.entry) @ mirror
        law = monitored_law(replace(plan, guide=sign * PLAN.guide, path=tips), NEVER)
        plant, probabilities = plant_of(sign * 0.02), list[float]()

        def watch(
            _plant: SteeringPlant, law: MonitoredLaw = law, seen: list[float] = probabilities
        ) -> None:
            seen.append(law.status()['contact_probability'])

        simulate_steering(law, plant, lambda tip: tip, watch)
        found.append(probabilities)
    assert max(found[0]) > 1e-3
    assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-9)


def test_probability_is_calibrated() -> None:
    """No more touch than stated, within three standard errors, and more of those above 50 %."""
    rng = np.random.default_rng(5)
    stated, touched = [], []
    for _ in range(40):
        side, distance = float(rng.choice([-1.0, 1.0])), float(rng.uniform(2e-4, 2e-3))
        low = float(rng.uniform(0.01, 0.04))
        plan = plan_with({(low, low + 0.01): wall(side, distance)})
        law = monitored_law(plan, replace(NEVER, registration=0.0))
        plant = plant_of(0.02 * float(rng.standard_normal()), float(np.exp(0.3 * rng.normal())))
        path, worst = plan.tip_path, [0.0]
        seen: list[float] = []

        def watch(
            at: SteeringPlant, path: Any = path, low: float = low, side: float = side,
            law: MonitoredLaw = law, worst: list[float] = worst, seen: list[float] = seen,
        ) -> None:  # fmt: skip
            seen.append(law.status()['contact_probability'])
            depth = at.needle.depth
            if low <= depth < low + 0.01:
                center = np.interp(depth, path.depths, path.tips[:, 0])
                worst[0] = max(worst[0], side * (float(at.tip[0]) - center))

        simulate_steering(law, plant, lambda tip: tip + 5e-5 * rng.standard_normal(2), watch)
        stated.append(max(seen))
        touched.append(worst[0] > distance)
    # The largest of all steps is above the probability at any one of them.
    assert np.mean(touched) <= np.mean(stated) + 3.0 * 0.5 / np.sqrt(len(touched))
    high = np.array(stated) > 0.5
    assert np.mean(np.array(touched)[high]) > np.mean(np.array(touched)[~high])


@pytest.mark.requirement('S-316')
@pytest.mark.parametrize('side', [1.0, -1.0])
def test_replanned_path_avoids_a_wall_that_the_needle_approaches(side: float) -> None:
    """Where the law stops without another path; the tip keeps clear, and ends at the target."""
    plan = plan_with({(0.035, 0.05): wall(side, 3e-4)})
    stops, plant = monitored_law(plan, ContactSettings()), plant_of(side * 0.02)
    with pytest.raises(ContactError):
        simulate_steering(stops, plant, lambda tip: tip)
    other = ContactSettings(limit=0.2, action='replan')
    law, plant = monitored_law(plan, other), plant_of(side * 0.02)
    tips = []
    run = simulate_steering(
        law, plant, lambda tip: tip, lambda at: tips.append((at.needle.depth, at.tip[0]))
    )
    assert 'another path is followed' in run.warning
    path = plan.tip_path
    for depth, x in tips:
        if 0.035 <= depth < 0.05:
            assert side * (x - np.interp(depth, path.depths, path.tips[:, 0])) < 3e-4
    # 0.5 mm of the path, and the remaining error of the law.
    assert np.abs(plant.tip - path.tips[-1]).max() < 7e-4


@pytest.mark.requirement('S-316')
@pytest.mark.parametrize('load_limit', [0.3, 0.6, 8.0])
def test_replanned_setpoint_keeps_the_limits_of_the_guide(load_limit: float) -> None:
    """Position, change and force on the nominal needle, to the tolerance of the program."""
    limits = SteeringLimits(load_limit=load_limit)
    free, rng = np.full((20, DIRECTIONS), 1e-3), np.random.default_rng(4)
    off, response = 5e-4 * rng.standard_normal((20, 2)), rng.uniform(0.0, 1.0, (20, 6))
    guide, load = 2e-4 * rng.standard_normal((7, 2)), np.array([0.2, -0.1])
    found = most_clearance(
        free, off, response, response[-1], np.zeros(2), guide, limits, load, 300.0
    )
    assert found is not None
    moved = guide[1:] + found
    assert np.abs(moved).max() <= limits.guide_limit + 1e-8
    assert np.abs(np.diff(np.vstack([guide[:1], moved]), axis=0)).max() <= limits.guide_step + 1e-8
    assert np.abs(load + 300.0 * found[0]).max() <= load_limit + 1e-6
    assert np.abs(response[-1] @ found).max() <= 5e-4 + 1e-8
    # Not less clearance than without a change.

    def least(change: FloatArray) -> float:
        return float((free - (off + response @ change) @ UNITS.T).min())

    assert least(found) >= min(least(np.zeros((6, 2))), 2e-3) - 1e-8


def test_law_without_a_forecast_needs_a_limit_of_one() -> None:
    law: Any = build_law('springs', MODEL, (0.0, 0.0), SIMULATION_LIMITS)
    with pytest.raises(
        ParameterError, match=r'contact\.limit must be 1 with a law that has no for'
    ):
        MonitoredLaw(law, MODEL, PLAN, PLAN.tip_path, SIMULATION_LIMITS, ContactSettings())


def test_plan_without_free_space_needs_a_limit_of_one() -> None:
    with pytest.raises(ParameterError, match=r'contact\.limit must be 1 for a plan without free'):
        monitored_law(replace(PLAN, free=np.zeros((0, 17))), ContactSettings())


# Executive.


def inserted(contact: ContactSettings, plan: Plan) -> Robot:
    robot = Robot(plan=plan, prior=PRIOR, contact=contact)
    robot.tick(20)
    x, z = plan.tip_path.tips[-1].tolist()
    assert robot.aim((x, plan.length, z)) == ''
    for _ in range(8000):
        robot.tick()
        if robot.loop.phase in (Phase.DONE, Phase.STOPPED, Phase.IDLE):
            break
    return robot


WALL = plan_with({(0.03, 0.04): 0.0})


@pytest.mark.requirement('S-316')
def test_executive_stops_before_contact() -> None:
    robot = inserted(ContactSettings(), WALL)
    assert robot.loop.phase is Phase.STOPPED
    assert robot.loop.fault.startswith('contact at a depth of ')
    assert robot.loop.authority.mode is Mode.STOPPED
    assert robot.needle.depth < 0.03


@pytest.mark.requirement('S-316')
def test_executive_withdraws_before_contact() -> None:
    robot = inserted(ContactSettings(action='retract'), WALL)
    assert robot.loop.phase is Phase.IDLE
    assert robot.loop.authority.mode is Mode.RETRACTING
    assert robot.loop.fault.startswith('contact at a depth of ')
    # `retract_depth`; the needle rests within 0.3 mm of it.
    assert abs(robot.needle.depth - 5e-3) < 1e-3
    assert robot.needle.deepest < 0.03


def test_unmonitored_insertion_passes_the_wall() -> None:
    robot = inserted(ContactSettings(limit=1.0), WALL)
    assert robot.loop.phase is Phase.DONE
