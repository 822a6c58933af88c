"""Gymnasium environments: checker, seeds, and vector environments."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
from gymnasium.utils.env_checker import check_env
from needle_dynamics import Integrator, NeedleModel, NeedleParameters
from needle_dynamics.errors import InsertionDepthError
from needle_ros.errors import ParameterError
from needle_study.gym.insertion import (
    DRAWN,
    InsertionEnv,
    InsertionVectorEnv,
    SPREAD,
    START,
    TARGETS,
)
from needle_study.gym.pushed import FORCE, PERIOD, STEP
from needle_study.gym.steering import SteeringEnv
import numpy as np
import pytest


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('name', ['NeedleInsertion-v0', 'NeedleSteering-v0'])
def test_environments_pass_the_gymnasium_checker(name: str) -> None:
    """Environments are registered by module and name; the same seed gives the same episode."""
    with gymnasium.make(f'needle_study.gym:{name}') as environment:
        check_env(environment.unwrapped, skip_render_check=True)


def test_vector_equals_single_environments_with_separate_seeds() -> None:
    """Bitwise equal at each step, also across truncated episodes."""
    many = InsertionVectorEnv(3, max_episode_steps=20)
    single = [gymnasium.wrappers.TimeLimit(InsertionEnv(), 20) for _ in range(3)]
    observations, _ = many.reset(seed=5)
    for k, one in enumerate(single):
        assert np.array_equal(one.reset(seed=5 + k)[0], observations[k])
    rng, begins = np.random.default_rng(1), np.zeros(3, dtype=bool)
    for _ in range(30):
        actions = rng.uniform(-1.0, 1.0, (3, 1))
        observations, rewards, ended, broken, _ = many.step(actions)
        for k, one in enumerate(single):
            if begins[k]:
                expected, reward, over, late = one.reset()[0], 0.0, False, False
            else:
                expected, reward, over, late, _ = one.step(actions[k])
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
        seen, reward, over, _, _ = environment.step(np.array([force / FORCE]))
        try:
            one.advance(PERIOD, force)
        except InsertionDepthError:
            assert over
            assert reward == -1.0
            break
        assert not over
        assert reward == -abs(target - one.depth) - 1e-5 * force * force
        tip = one.model.tip_deflection(one.state)
        expected = [10.0 * (target - one.depth), 10.0 * one.velocity, 10.0 * one.depth, 1e3 * tip]
        # Observations have the precision of 32 bits.
        np.testing.assert_allclose(seen, expected, rtol=1e-6, atol=1e-9)
    else:
        pytest.fail('the needle did not come out')


def test_force_that_is_not_finite_is_rejected() -> None:
    environment = InsertionEnv()
    environment.reset(seed=1)
    with pytest.raises(ParameterError, match='an action must be finite'):
        environment.step(np.array([np.nan]))


def test_push_toward_the_target_has_a_higher_reward_than_no_push() -> None:
    """The reward distinguishes policies."""

    def earned(law: float) -> float:
        environment = InsertionEnv()
        seen, _ = environment.reset(seed=3)
        total = 0.0
        for _ in range(200):
            seen, reward, over, _, _ = environment.step(np.array([law * seen[0]]))
            total += reward
            if over:
                break
        return total

    assert earned(3.0) > 0.5 * earned(0.0)


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
