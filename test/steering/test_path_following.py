# SPDX-License-Identifier: Apache-2.0
"""Laws of steering along a planned path."""

from __future__ import annotations

from dataclasses import replace

from needle_controller import MultiHypothesisLaw, SteeringLimits, SteeringModel, SteeringPrior
from needle_controller.steering.law import build_law, STEERING_LAWS
from needle_controller.steering.planned_path import PlannedPath
from needle_controller.steering.simulation import sample_truth, simulate_steering, SteeringPlant
from needle_dynamics import FloatArray, NEEDLES, ParameterError, ShapeError, SteeredNeedle
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

NEEDLE, _STEERING, _ = NEEDLES['bending_35mm']
STEERING = replace(_STEERING, skin_stiffness=0.02 * NEEDLE.tissue_stiffness, bevel_load=(0.1,))
DEPTHS = np.linspace(0.0, 0.08, 17)
LIMITS = SteeringLimits()
#: Uncertainty of a registered robot.
PRIOR = SteeringPrior(spread=0.15, tilt=0.01, frame=0.01, bevel=0.1)
MODEL = SteeringModel(NEEDLE, STEERING, DEPTHS, PRIOR)
#: Guide that bows the needle.
GUIDE = np.column_stack([5e-3 * np.sin(np.linspace(0.3, 4.0, 16)), np.linspace(-2e-3, 3e-3, 16)])


def inserted(needle: SteeredNeedle, guide: FloatArray) -> FloatArray:
    """Return the tip at each depth for guide setpoints."""
    tips = [needle.tip[[0, 2]]]
    for depth, setpoint in zip(DEPTHS[1:].tolist(), guide, strict=True):
        needle.move(guide=setpoint.tolist())
        needle.move(depth=depth)
        tips.append(needle.tip[[0, 2]])
    return np.array(tips)


PATH = PlannedPath(
    depths=DEPTHS, tips=inserted(SteeredNeedle(NEEDLE, STEERING), GUIDE), guide=GUIDE
)


def steered(plant: SteeringPlant, path: PlannedPath | None, noise: float, seed: int) -> FloatArray:
    """Return the tip at each depth under the law, in the frame of the sensor."""
    rng = np.random.default_rng(seed)
    law = build_law('multi_hypothesis', MODEL, PATH.tips[-1], LIMITS, path=path)
    tips = [plant.tip]
    simulate_steering(
        law,
        plant,
        lambda tip: np.asarray(tip + noise * rng.standard_normal(2)),
        lambda plant: tips.append(plant.tip),
    )
    return np.array(tips)


def test_nominal_needle_follows_the_path() -> None:
    """With the planned guide: the law has nothing to correct."""
    tips = steered(SteeringPlant(SteeredNeedle(NEEDLE, STEERING), DEPTHS), PATH, 1e-7, 0)
    # Noise, and a tenth of a candidate position of the guide.
    assert_allclose(tips, PATH.tips, atol=1e-5)


def test_sampled_needles_deviate_less_from_a_path_that_they_follow() -> None:
    """Less than half as much in the mean square, and they end at the target."""
    rng = np.random.default_rng(1)
    found = []
    for seed in range(16):
        truth = sample_truth(NEEDLE, STEERING, PRIOR, rng, seed)
        found.append([
            steered(truth.plant(DEPTHS), path, PRIOR.noise, seed) - PATH.tips
            for path in (PATH, None)
        ])  # fmt: skip
    # By path or none, depth and axis.
    squares = (np.array(found) ** 2).mean(axis=(0, 3))
    assert squares[0].mean() < 0.5 * squares[1].mean()
    # The tip is measured to 0.04 mm; the path turns until the end.
    assert squares[0, -1] < 2e-4**2


def test_moved_target_moves_the_path_in_proportion_to_the_depth() -> None:
    """The tip ends at the new target."""
    plant, target = SteeringPlant(SteeredNeedle(NEEDLE, STEERING), DEPTHS), PATH.tips[-1] + 1e-3
    law = MultiHypothesisLaw(MODEL, PATH.tips[-1], LIMITS)
    law.follow(PATH)
    law.aim(target)
    simulate_steering(law, plant, lambda tip: tip + 1e-9 * plant.step)
    # Half the distance of the compared positions, and the remaining uncertainty.
    assert_allclose(plant.tip, target, atol=2e-4)


def test_path_may_begin_at_any_depth() -> None:
    """A later path has the same waypoints and setpoints; the first is between two of them."""
    for depth, steps in ((0.0, 16), (0.003, 16), (0.0045, 15), (0.005, 15), (0.0751, 1)):
        path = PATH.since(depth)
        assert len(path.guide) == len(path.tips) - 1 == len(path.depths) - 1 == steps
        assert path.depths[0] == depth
        assert_array_equal(path.tips[1:], PATH.tips[-steps:])
        assert_array_equal(path.guide, PATH.guide[-steps:])
        for k in range(2):
            assert path.tips[0, k] == np.interp(depth, DEPTHS, PATH.tips[:, k])


def test_path_that_does_not_fit_is_rejected() -> None:
    """A path with other steps, and a law that cannot follow one."""
    with pytest.raises(ShapeError, match='must have the 16 steps of the model'):
        build_law('multi_hypothesis', MODEL, (0.0, 0.0), LIMITS, path=PATH.since(0.01))
    follow = {'multi_hypothesis', 'open_loop'}
    assert follow < set(STEERING_LAWS)
    turning = replace(LIMITS, turns=1)
    for name in sorted(set(STEERING_LAWS) - follow):
        with pytest.raises(ParameterError, match=f"law '{name}' cannot follow a planned path"):
            build_law(name, MODEL, (0.0, 0.0), turning, path=PATH)
