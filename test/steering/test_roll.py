# SPDX-License-Identifier: Apache-2.0
"""Needles that are steered by roll along arcs, with windup: responses, estimates and errors."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.worlds.scenarios import Case
from needle_controller import MultiHypothesisLaw, SteeringLimits, SteeringModel, SteeringPrior
from needle_controller.steering.law import SteeringLaw
from needle_controller.steering.laws.roll_to_target import RollToTargetLaw
from needle_controller.steering.simulation import simulate_steering
from needle_dynamics import NEEDLES
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from support.reference_models import bicycle

NEEDLE, _STEERING, _ = NEEDLES['bending_35mm']
STEERING = replace(_STEERING, bevel_load=(0.8,))
DEPTHS = np.linspace(0.0, 0.1, 21)
MODEL = SteeringModel(NEEDLE, STEERING, DEPTHS)


@pytest.mark.parametrize(('point', 'lead'), [(0, 0.0), (3, 0.025)])
def test_kinematic_points_are_unicycle_and_bicycle(point: int, lead: float) -> None:
    """For small curvatures they equal the reference model, turned in every step."""
    rolls, curvature = np.append(0.0, 0.5 * np.arange(20.0)), 1e-3
    there = bicycle(DEPTHS, rolls, curvature, lead)[:, [0, 2]] @ [1.0, 1.0j]
    directions = 1j * np.exp(-1j * rolls)
    # A load F bends the path by F lambda / (E I).
    load = curvature * NEEDLE.bending_stiffness / 0.035
    at = np.flatnonzero(MODEL.rolled)[point]
    tip = MODEL.responses.bevel[at, :, :] @ (load * directions)
    assert np.abs(tip).max() > 1e-6
    # The reference has large rotations: errors of third order in the curvature.
    assert_allclose(tip, there, rtol=0.0, atol=1e-10)
    assert not MODEL.responses.guide[at].any()


def test_kinematic_path_is_linear_between_depths() -> None:
    """A constant curvature of the path equals the path of a bevel with the corresponding load."""
    at = np.flatnonzero(MODEL.rolled)[0]
    causes, load = MODEL.responses.causes[at], NEEDLE.bending_stiffness / 0.035
    assert_allclose(causes[:, 4:].sum(axis=1), load * causes[:, 3], rtol=1e-9)


def test_arcs_follow_the_load_of_each_layer() -> None:
    """Half of the load in a layer with the same stiffness halves the curvature there."""
    needle = replace(NEEDLE, layer_depths=(0.05,), layer_stiffnesses=(NEEDLE.tissue_stiffness,))
    halved = SteeringModel(needle, replace(STEERING, bevel_load=(0.8, 0.4)), DEPTHS)
    at = np.flatnonzero(MODEL.rolled)[0]
    parts = np.repeat([1.0, 0.5], (11, 10))
    assert_allclose(halved.responses.bevel[at], parts * MODEL.responses.bevel[at], atol=1e-15)


def test_known_needle_and_trocar_have_no_kinematic_hypotheses() -> None:
    exact = SteeringModel(NEEDLE, STEERING, DEPTHS, SteeringPrior(spread=0.0))
    trocar = SteeringModel(NEEDLE, _STEERING, DEPTHS)
    assert MODEL.rolled.sum() == 54
    assert not exact.rolled.any()
    assert not trocar.rolled.any()


def test_needle_that_is_not_turned_is_steered_by_the_guide() -> None:
    """Without turns kinematic hypotheses have no weight, with turns a twentieth of the others."""
    fixed = MultiHypothesisLaw(MODEL, (2e-3, 1e-3), SteeringLimits())
    assert_array_equal(fixed.weights > 0.0, ~MODEL.rolled)
    turned = MultiHypothesisLaw(MODEL, (2e-3, 1e-3), SteeringLimits(turns=3))
    relative = np.exp(MODEL.logs - 3.0 * MODEL.rolled)
    assert_allclose(turned.weights, relative / relative.sum())


@pytest.mark.parametrize('world', ['unicycle', 'bicycle'])
def test_roll_is_never_worse_than_towards_the_target(world: str) -> None:
    """12 needles with 45 degrees of windup at 10 cm; the windup is identified."""
    misses: dict[type[SteeringLaw], list[float]] = {MultiHypothesisLaw: [], RollToTargetLaw: []}
    windups = []
    for seed in range(12):
        case = Case(world, seed)
        model = case.model()
        for of_class, found in misses.items():
            plant = case.world()
            law = of_class(model, case.target, case.limits(roll=True))  # type: ignore[call-arg]
            simulate_steering(law, plant, case.sensor())  # type: ignore[arg-type]
            found.append(float(np.hypot(*(plant.tip - case.target))))
            if isinstance(law, MultiHypothesisLaw):
                assert law.weights[model.rolled].sum() > 0.99
                lags = model.responses.lags[:, -1] / case.depths[-1]
                windups.append(law.weights @ np.tile(lags, len(law.weights) // len(lags)))
    ours, towards = misses.values()
    assert np.mean(ours) < 0.8 * np.mean(towards)
    assert max(ours) < max(towards)
    # 7.9 rad/m; hypotheses are 4 rad/m apart.
    assert np.median(windups) == pytest.approx(7.9, abs=2.0)
