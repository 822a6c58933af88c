"""The environments of Gymnasium: its own checks, seeds, and many at once."""

from __future__ import annotations

import gymnasium
from gymnasium.utils.env_checker import check_env
from needle_insertion.gym.insertion import InsertionEnv, InsertionVectorEnv
from needle_insertion.gym.steering import SteeringEnv
from needle_ros.errors import ParameterError
import numpy as np
import pytest


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('name', ['NeedleInsertion-v0', 'NeedleSteering-v0'])
def test_gymnasium_has_nothing_to_complain_of(name: str) -> None:
    """It finds them by module and name; the same seed gives the same episode."""
    with gymnasium.make(f'needle_insertion.gym:{name}') as environment:
        check_env(environment.unwrapped, skip_render_check=True)


def test_a_vector_is_single_environments_with_seeds_of_their_own() -> None:
    """Step by step, to the bit, over the end of episodes that are broken off."""
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


def test_a_push_towards_the_target_earns_more_than_none() -> None:
    """So there is something to learn."""

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


def test_a_guide_that_is_moved_reaches_what_one_at_rest_does_not() -> None:
    """On a mean of needles; the miss is told at the end, and then a reset is needed."""
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


@pytest.mark.parametrize(
    ('options', 'complaint'),
    [({'needle': 'bone'}, 'needle must be one of'), ({'depth': 0.0}, 'depth must be positive')],
)
def test_what_cannot_be_is_named(options: dict[str, object], complaint: str) -> None:
    with pytest.raises(ParameterError, match=complaint):
        SteeringEnv(**options)  # type: ignore[arg-type]
