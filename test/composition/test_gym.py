# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environments: checker, seeds, and vector environments."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.policies import EXPERT, returns
import gymnasium
from gymnasium.utils.env_checker import check_env
from needle_dynamics import Integrator, NeedleModel, NeedleParameters
from needle_dynamics.errors import InsertionDepthError
from needle_ros.errors import ParameterError, ShapeError
from needle_study.gym.insertion import DRAWN, InsertionEnv, InsertionVectorEnv, SPREAD, TARGETS
from needle_study.gym.pushed import FORCE, PERIOD, START, STEP
from needle_study.gym.steering import SteeringEnv
import numpy as np
import pytest


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('name', ['NeedleInsertion-v0', 'NeedleSteering-v0'])
def test_environments_pass_the_gymnasium_checker(name: str) -> None:
    """Environments are registered by module and name; the same seed gives the same episode."""
    with gymnasium.make(f'needle_study.gym:{name}', render_mode='rgb_array') as environment:
        check_env(environment.unwrapped)


def test_vector_equals_single_environments_with_separate_seeds() -> None:
    """Bitwise equal at each step, also across truncated episodes."""
    many = InsertionVectorEnv(3, max_episode_steps=20)
    single = [gymnasium.wrappers.TimeLimit(InsertionEnv(), 20) for _ in range(3)]
    observations, infos = many.reset(seed=5)
    for k, one in enumerate(single):
        observation, info = one.reset(seed=5 + k)
        assert np.array_equal(observation, observations[k])
        assert info == {name: infos[name][k] for name in info}
    rng, begins = np.random.default_rng(1), np.zeros(3, dtype=bool)
    for _ in range(30):
        actions = rng.uniform(-1.0, 1.0, (3, 1))
        observations, rewards, ended, broken, infos = many.step(actions)
        for k, one in enumerate(single):
            if begins[k]:
                expected, info = one.reset()
                reward, over, late = 0.0, False, False
            else:
                expected, reward, over, late, info = one.step(actions[k])
            assert info == {name: infos[name][k] for name in info}
            assert all(infos[f'_{name}'][k] for name in info)
            assert np.array_equal(observations[k], expected)
            assert (rewards[k], ended[k], broken[k]) == (reward, over, late)
        begins = ended | broken
    many.close()


def test_vector_seeds_and_masks() -> None:
    """A seed of None continues, a mask resets a subset, and invalid shapes are rejected."""
    many, other = InsertionVectorEnv(3), InsertionVectorEnv(3)
    with pytest.raises(gymnasium.error.ResetNeeded, match='call reset'):
        many.step(np.zeros((3, 1)))
    for one in (many, other):
        one.reset(seed=np.int64(5))  # type: ignore[arg-type]
        one.step(np.full((3, 1), 0.3))
    first, _ = many.reset(seed=[8, None, 8])
    second, _ = other.reset()
    assert np.array_equal(first[0], first[2])
    assert np.array_equal(first[1], second[1])
    assert not np.array_equal(first[0], second[0])
    before, *_ = many.step(np.full((3, 1), 0.3))
    some, _ = many.reset(options={'reset_mask': np.array([True, False, False])})
    assert np.array_equal(some[1:], before[1:])
    assert some[0][1] == 0.0
    for options in ({'seed': [1, 2]}, {'options': {'reset_mask': np.ones(2, dtype=bool)}}):
        with pytest.raises(ParameterError, match='must be of 3 environments'):
            many.reset(**options)


def test_environment_equals_the_integrator() -> None:
    """Bitwise equal, until the needle leaves its range."""
    environment = InsertionEnv('phantom')
    seen, _ = environment.reset(seed=3)
    rng, _ = gymnasium.utils.seeding.np_random(3)
    preset = NeedleParameters.preset('phantom')
    factors = 1.0 + SPREAD * rng.uniform(-1.0, 1.0, len(DRAWN))
    parameters = replace(
        preset, **{name: f * getattr(preset, name) for name, f in zip(DRAWN, factors, strict=True)}
    )
    target = rng.uniform(*TARGETS)
    one = Integrator(parameters, NeedleModel(parameters).state_at(START), STEP)
    # Insert, withdraw, and leave the range.
    for force in [FORCE] * 20 + [-FORCE] * 200:
        before = abs(target - one.depth)
        seen, reward, over, _, info = environment.step(np.array([force / FORCE]))
        try:
            one.advance(PERIOD, force)
        except InsertionDepthError:
            left = True
        else:
            left = False
        progress = (before - abs(target - one.depth)) / abs(target - START)
        assert reward == progress - 0.001 - 0.003 - (2.0 if left else 0.0)
        assert info == {'error': target - one.depth, 'force': force, 'success': False}
        assert over == left
        if left:
            break
        tip = one.model.tip_deflection(one.state)
        expected = [10.0 * (target - one.depth), 10.0 * one.velocity, 10.0 * one.depth, 1e3 * tip]
        # Observations have the precision of 32 bits.
        np.testing.assert_allclose(seen, expected, rtol=1e-6, atol=1e-9)
    else:
        pytest.fail('the needle did not come out')


@pytest.mark.parametrize(
    ('actions', 'error', 'complaint'),
    [
        (np.full((64, 1), np.nan), ParameterError, r'actions must be finite, got nan'),
        (np.zeros((3, 1)), ShapeError, r'actions must have shape \(64, 1\), got \(3, 1\)'),
        (np.zeros(64), ShapeError, r'actions must have shape \(64, 1\), got \(64,\)'),
        (0.5, ShapeError, r'actions must have shape \(64, 1\), got \(\)'),
        ('in', ShapeError, r"actions must be numbers, got 'in'"),
    ],
)
def test_invalid_actions_are_rejected(
    actions: Any, error: type[Exception], complaint: str
) -> None:
    """With one line, before a needle moves."""
    many = InsertionVectorEnv(64)
    before, _ = many.reset(seed=1)
    with pytest.raises(error, match=f'^{complaint}$'):
        many.step(actions)
    after, *_ = many.step(np.zeros((64, 1)))
    assert np.array_equal(after, before)


@pytest.mark.parametrize('kind', [InsertionEnv, SteeringEnv])
def test_invalid_action_of_one_needle_is_rejected(kind: Any) -> None:
    environment = kind()
    size = environment.action_space.shape[0]
    environment.reset(seed=1)
    with pytest.raises(ParameterError, match=r'^actions must be finite, got nan$'):
        environment.step(np.full(size, np.nan))
    for action, shape in ((0.5, r'\(\)'), (np.zeros(5), r'\(5,\)')):
        with pytest.raises(
            ShapeError, match=rf'^actions must have shape \({size},\), got {shape}$'
        ):
            environment.step(action)


@pytest.mark.parametrize('kind', [InsertionEnv, SteeringEnv])
def test_images_show_needle_and_target(kind: Any) -> None:
    """The needle is longer after an insertion; without a render mode there is no image."""
    environment = kind(render_mode='rgb_array')
    environment.reset(seed=2)
    before = environment.render()
    for _ in range(5):
        environment.step(np.ones(environment.action_space.shape))
    after = environment.render()
    needle, target = (40, 40, 60), (200, 30, 30)
    assert (before == target).all(axis=2).any()
    lengths = [(image == needle).all(axis=2).any(axis=0).sum() for image in (before, after)]
    assert lengths[1] > lengths[0]
    without = kind()
    without.reset(seed=2)
    assert without.render() is None
    with pytest.raises(ParameterError, match=r'render_mode must be one of rgb_array, got .human'):
        kind(render_mode='human')


def test_vector_environment_has_an_image_of_each_needle() -> None:
    many = InsertionVectorEnv(3, render_mode='rgb_array')
    one = InsertionEnv(render_mode='rgb_array')
    many.reset(seed=4)
    one.reset(seed=6)
    assert np.array_equal(many.render()[2], one.render())
    assert InsertionVectorEnv(3).render() is None


def test_a_good_controller_earns_more_than_every_trivial_policy() -> None:
    """For each of 100 needles; the benchmark of studies has a thousand."""
    totals = returns(100)
    best = totals.pop(EXPERT)
    for name, values in totals.items():
        assert (best > values).all(), name
    # All needles arrive: progress and arrival are 2, less time and force.
    assert best.min() > 0.5


def test_moving_guide_reduces_the_mean_miss() -> None:
    """Mean over needles; the miss is reported at the end, and then a reset is required."""
    environment = SteeringEnv()

    def missed(seed: int) -> float:
        environment.reset(seed=seed)
        over, info = False, dict[str, float]()
        while not over:
            _, _, over, _, info = environment.step(np.zeros(2))
        return float(info['miss'])

    assert np.mean([missed(seed) for seed in range(10)]) > 1e-3
    with pytest.raises(gymnasium.error.ResetNeeded, match='call reset'):
        environment.step(np.zeros(2))


def test_position_that_is_not_finite_does_not_move_the_guide() -> None:
    """The next position continues from there."""
    environment = SteeringEnv()
    seen, _ = environment.reset(seed=1)
    with pytest.raises(ParameterError):
        environment.step(np.array([np.nan, 0.0]))
    after, *_ = environment.step(np.zeros(2))
    assert after[0] == pytest.approx(0.05)
    assert seen[0] == 0.0


@pytest.mark.parametrize(
    ('options', 'complaint'),
    [
        ({'needle': 'bone'}, 'needle must be one of'),
        ({'depth': 0.0}, 'depth must be positive'),
        ({'depth': 1.0}, 'depth must be <='),
    ],
)
def test_invalid_options_are_rejected(options: dict[str, object], complaint: str) -> None:
    with pytest.raises(ParameterError, match=complaint):
        SteeringEnv(**options)  # type: ignore[arg-type]
