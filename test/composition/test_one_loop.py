# SPDX-License-Identifier: Apache-2.0
"""`needle steer`, a study, an environment and the steering executive steer a needle alike."""

from __future__ import annotations

from dataclasses import asdict, replace
import json
from math import inf
from typing import Any

from needle_controller import MultiHypothesisLaw, SIMULATION_LIMITS, SteeringModel, SteeringPrior
from needle_controller.steering.settings import step_depths
from needle_controller.steering.simulation import GroundTruth
from needle_dynamics import FloatArray
from needle_insertion.cli import main
from needle_insertion.commands.steer import sample_needle
from needle_study.gym.steering import SteeringEnv
from needle_study.study import build_study
import numpy as np
from numpy.testing import assert_allclose
import pytest
from support.steered_robot import NEEDLE, Robot, SETTINGS, STEERING, TARGET

#: Path and sensor with almost no noise: the four draw it in their own order.
PRIOR = SteeringPrior(path_noise=1e-12, noise=1e-8)
DEPTHS = step_depths(TARGET[1], 5e-3)


def by_command(seed: int, capsys: pytest.CaptureFixture[str]) -> FloatArray:
    values = asdict(PRIOR).items()
    words = [word for name, value in values for word in ('--prior', f'{name}={json.dumps(value)}')]
    target = ','.join(map(str, TARGET))
    assert main(['steer', '--json', f'--target={target}', '--seed', str(seed), *words]) == 0
    return np.array(json.loads(capsys.readouterr().out)['tip [m]'])


def by_study(truth: GroundTruth, seed: int) -> FloatArray:
    # As in `sample_truth`.
    length, skin = 1.0 + PRIOR.spread * np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
    values = {'bending_length': length, 'skin': skin}
    for name in ('tilt', 'bevel', 'frame'):
        values |= {f'{name}_{axis}': getattr(truth, name)[k] for k, axis in enumerate('xz')}
    values |= {'target_x': TARGET[0], 'target_z': TARGET[2]}
    study = build_study({
        'scenario': 'steering', 'samples': 1, 'seed': seed,
        'settings': {'depth': TARGET[1], 'prior': asdict(PRIOR)},
        'population': {name: float(value) for name, value in values.items()},
    })  # fmt: skip
    found = study.rows(0, 1)
    return np.array([found['tip_x'][0], found['tip_z'][0]])


def by_environment(truth: GroundTruth) -> FloatArray:
    """Steer by the observations and actions of the environment only."""
    environment = SteeringEnv(depth=TARGET[1], prior=PRIOR)
    limit = SIMULATION_LIMITS.guide_limit
    options: dict[str, Any] = {'truth': truth, 'target': (TARGET[0], TARGET[2])}
    seen, _ = environment.reset(options=options)
    model = SteeringModel(NEEDLE, STEERING, DEPTHS, PRIOR)
    law, over = MultiHypothesisLaw(model, seen[3:5] * limit, SIMULATION_LIMITS), False
    while not over:
        law.update(seen[1:3] * limit, law.step)
        to = law.plan()
        seen, _, over, _, _ = environment.step(np.array([to.x, to.z]) / limit)
    return np.asarray(seen[1:3] * limit)


def by_executive(truth: GroundTruth) -> FloatArray:
    """Steer by messages; the robot moves guide and needle in small steps."""
    robot = Robot(replace(SETTINGS, guide_step=inf, load_limit=inf), PRIOR)
    plant = truth.plant(DEPTHS)
    robot.needle = plant.needle
    robot.sees = lambda _tip: (plant.tip[0], robot.needle.depth, plant.tip[1])
    robot.steer()
    assert robot.loop.fault == ''
    return plant.tip


@pytest.mark.parametrize('seed', [3, 4])
def test_all_users_of_a_law_end_at_the_same_tip(
    seed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Within 0.1 um: noise of 0.01 um, and single precision of the environment's observations."""
    truth = sample_needle(NEEDLE, STEERING, PRIOR, seed)
    alone = truth.plant(DEPTHS[[0, -1]])
    alone.insert()
    tips = {
        'study': by_study(truth, seed),
        'environment': by_environment(truth),
        'executive': by_executive(truth),
    }
    command = by_command(seed, capsys)
    target = np.array(TARGET)[[0, 2]]
    assert np.hypot(*(command - target)) < 5e-5 < 1e-3 < np.hypot(*(alone.tip - target))
    for name, tip in tips.items():
        assert_allclose(tip, command, rtol=0.0, atol=1e-7, err_msg=name)
