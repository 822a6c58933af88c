# SPDX-License-Identifier: Apache-2.0
"""Insert three times, identify the needle, and steer it with the parameter file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from benchmarks.steering_fit import FitTruth, insertion, NEEDLE
from needle_controller.steering.laws.multi_hypothesis import MultiHypothesisLaw
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import SteeringLimits, SteeringPrior
from needle_controller.steering.simulation import simulate_steering, SteeringPlant
from needle_dynamics import find_needle, SteeredNeedle, SteeringParameters
from needle_dynamics.steering.parameters import tissue_of
from needle_identification import identify_steering
from needle_identification.result import steering_yaml
import numpy as np
import yaml

#: A needle that bends over half the length of the default one, behind a skin.
TRUTH = FitTruth(
    length=0.018, skin=0.02, tilt=(0.02, -0.01), path_noise=1e-5, noise=6e-5, guide_first=True
)

DEPTHS = 5e-3 * np.arange(21.0)

#: Standard deviation of the tracker [m].
SENSOR = 4e-5


def model(parameters: Mapping[str, Any]) -> SteeringModel:
    """Return the model of a law with the default needle and these parameters of the node."""
    given = dict(parameters)
    needle = find_needle(given.pop('needle', 'bending_35mm'))
    groups: dict[str, dict[str, Any]] = {'model': {}, 'steering': {}, 'prior': {}}
    for name, value in given.items():
        group, _, key = name.partition('.')
        groups[group][key] = value
    preset = needle.changed({**groups['model'], **groups['steering']})
    prior = SteeringPrior(**groups['prior'])
    return SteeringModel(preset.needle, preset.steering, DEPTHS, prior)


def miss(steered: SteeringModel, target: tuple[float, float], seed: int) -> float:
    """Steer the true needle to a target; return the distance of its tip [m]."""
    tissue = tissue_of(NEEDLE.bending_stiffness, TRUTH.length)
    steering = SteeringParameters(
        free_length=TRUTH.free, skin_stiffness=TRUTH.skin * tissue, path_noise=TRUTH.path_noise
    )
    true = replace(NEEDLE, tissue_stiffness=tissue)
    needle = SteeredNeedle(true, steering, tilt=TRUTH.tilt, seed=seed)
    plant, rng = SteeringPlant(needle, DEPTHS, np.zeros(2)), np.random.default_rng(seed)
    law = MultiHypothesisLaw(steered, np.array(target), SteeringLimits())
    simulate_steering(law, plant, lambda tip: tip + SENSOR * rng.standard_normal(2))
    return float(np.hypot(*(plant.tip - target)))


def test_an_identified_needle_is_steered_better() -> None:
    """Without a stop, which would raise."""
    found = identify_steering([insertion(seed, TRUTH) for seed in range(3)])
    parameters = yaml.safe_load(steering_yaml(found))['/**/steering']['ros__parameters']
    identified, default = model(parameters), model({})
    targets = [(3e-3, 0.0), (-2e-3, 2e-3), (0.0, -3e-3), (-1e-3, -2e-3)]
    misses = [
        [miss(one, target, seed) for seed, target in enumerate(targets)]
        for one in (identified, default)
    ]
    better, worse = np.mean(misses, axis=1)
    assert better < worse
    # Each within the radius of a hit.
    assert max(misses[0]) < 1e-3
