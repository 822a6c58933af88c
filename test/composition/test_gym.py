# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environments: checker, seeds, and vector environments."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.episodes import Maker, Policy, ready, SteeringPolicy, total_rewards
from benchmarks.policies import EXPERT, policies, returns
import gymnasium
from gymnasium.utils.env_checker import check_env
from needle_controller import GuideSetpoint, SIMULATION_LIMITS, SteeringPrior
from needle_controller.steering.settings import step_depths
from needle_controller.steering.simulation import GroundTruth
from needle_dynamics import (
    DEFAULT_NEEDLE,
    find_needle,
    FloatArray,
    Integrator,
    NeedleModel,
    NeedleParameters,
)
from needle_dynamics.compiled.lane_rows import LANES
from needle_dynamics.errors import InsertionDepthError
from needle_dynamics.steering.needle import wandering
from needle_dynamics.steering.parameters import with_layers, with_lengths
from needle_ros.errors import NeedleError, ParameterError, ShapeError
from needle_study.gym.insertion import DRAWN, InsertionEnv, InsertionVectorEnv, SPREAD, TARGETS
from needle_study.gym.pushed import FORCE, PERIOD, START, STEP
from needle_study.gym.steering import PRIOR, SteeringEnv, SteeringVectorEnv
import numpy as np
import pytest


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('name', ['NeedleInsertion-v0', 'NeedleSteering-v0'])
def test_environments_pass_the_gymnasium_checker(name: str) -> None:
    """Environments are registered by module and name; the same seed gives the same episode."""
    with gymnasium.make(f'needle_study.gym:{name}', render_mode='rgb_array') as environment:
        check_env(environment.unwrapped)


@pytest.mark.parametrize('name', ['NeedleInsertion-v0', 'NeedleSteering-v0'])
def test_vector_equals_single_environments_with_separate_seeds(name: str) -> None:
    """Bitwise equal at each step, also across episodes that end or are truncated."""
    options = {'max_episode_steps': 20} if name == 'NeedleInsertion-v0' else {}
    # More than one group of lanes.
    number = LANES + 3
    many = gymnasium.make_vec(f'needle_study.gym:{name}', number, **options)
    single = [gymnasium.make(f'needle_study.gym:{name}', **options) for _ in range(number)]
    observations, infos = many.reset(seed=5)

    def equal(info: dict[str, Any], k: int) -> bool:
        return all(np.array_equal(value, infos[name][k]) for name, value in info.items())

    for k, one in enumerate(single):
        observation, info = one.reset(seed=5 + k)
        assert np.array_equal(observation, observations[k])
        assert equal(info, k)
    rng, begins = np.random.default_rng(1), np.zeros(number, dtype=bool)
    ends = 0
    for _ in range(50):
        actions = rng.uniform(-1.0, 1.0, many.action_space.shape)
        observations, rewards, ended, broken, infos = many.step(actions)
        for k, one in enumerate(single):
            if begins[k]:
                expected, info = one.reset()
                reward, over, late = 0.0, False, False
            else:
                expected, reward, over, late, info = one.step(actions[k])
            assert equal(info, k)
            assert all(infos[f'_{name}'][k] for name in info)
            assert np.array_equal(observations[k], expected)
            assert (rewards[k], ended[k], broken[k]) == (reward, over, late)
        begins = ended | broken
        ends += begins.sum()
    assert ends >= 2 * number
    many.close()


def test_needles_in_other_lanes_do_not_matter() -> None:
    """Bitwise equal, although some needles began later and restart at other steps."""
    many, other = SteeringVectorEnv(5), SteeringVectorEnv(5)
    for one in (many, other):
        one.reset(seed=1)
    rng, late = np.random.default_rng(2), np.array([True, False, True, False, False])
    for k in range(45):
        if k == 3:
            many.reset(options={'reset_mask': late})
        actions = rng.uniform(-1.0, 1.0, (5, 2))
        found, rewards, *_ = many.step(actions)
        expected, others, *_ = other.step(actions)
        assert np.array_equal(found[~late], expected[~late])
        assert np.array_equal(rewards[~late], others[~late])
        assert k < 3 or (found[late, 0] != expected[late, 0]).all()


def sampled_truth(
    prior: SteeringPrior, seed: int, name: str = DEFAULT_NEEDLE
) -> tuple[GroundTruth, FloatArray, FloatArray]:
    """Return needle, target and normal numbers of the first episode of `SteeringEnv`."""
    rng, _ = gymnasium.utils.seeding.np_random(seed)
    nominal, steering, _ = find_needle(name)
    length, skin, *aside = rng.uniform(-1.0, 1.0, 4).tolist()
    # 3 causes, 21 measurements, loads of the path up to the cell after the target depth, layers.
    normal = rng.standard_normal((3 + 21 + 102 + len(prior.layer_spread), 2))
    needle, steering = with_lengths(
        nominal, steering, 1.0 + prior.spread * length, 1.0 + prior.spread * skin
    )
    if prior.layer_spread:
        needle = with_layers(needle, np.exp(np.array(prior.layer_spread) * normal[126:, 0]))
    tilt, frame, bevel = (
        size * row
        for size, row in zip((prior.tilt, prior.frame, prior.bevel), normal, strict=False)
    )
    most = max(steering.bevel_load)
    loads = np.array(steering.bevel_load) / most if most else np.ones(1)
    steering = replace(
        steering, bevel_load=tuple((np.hypot(*bevel) * loads).tolist()), path_noise=0.0,
        path_noise_length=prior.path_noise_length,
    )  # fmt: skip
    x, z = tilt.tolist()
    truth = GroundTruth(
        needle=needle, steering=steering, tilt=(x, z), bevel=bevel, frame=frame, seed=0
    )
    return truth, 4e-3 * np.array(aside), normal[3:]


@pytest.mark.parametrize('kind', ['sampled', 'nominal layers', 'given', 'layers'])
def test_steering_environment_equals_the_simulated_needle(tmp_path: Path, kind: str) -> None:
    """Layers have other bevels, and borders that are not depths of steps."""
    # The path noise of a sampled needle is negligible.
    prior, name = replace(PRIOR, path_noise=1e-300), DEFAULT_NEEDLE
    if kind == 'nominal layers':
        prior, name = replace(prior, layer_spread=(0.3, 0.5, 0.0)), str(tmp_path / 'needle.yaml')
        Path(name).write_text(
            'bevel_load: [0.1, 0.4, 0.0]\nlayer_depths: [0.0123, 0.05]\n'
            'layer_stiffnesses: [2.0e+4, 3.0e+5]\n'
        )
    truth, target, normal = sampled_truth(prior, 4, name)
    if kind == 'layers':
        truth = replace(
            truth,
            needle=replace(
                truth.needle, layer_depths=(0.0123, 0.05), layer_stiffnesses=(2e4, 3e5)
            ),
            steering=replace(truth.steering, bevel_load=(0.1, 0.4, 0.0), path_noise=1e-4),
            seed=7,
        )
    environment = SteeringEnv(name, prior=prior)
    given = {'truth': truth, 'target': target}
    options = given if kind in {'given', 'layers'} else None
    seen, info = environment.reset(seed=4, options=options)
    plant, limit = truth.plant(step_depths(0.1, 5e-3)), SIMULATION_LIMITS.guide_limit
    rng = np.random.default_rng(1)
    for k in range(21):
        tip = plant.tip
        # The simulated needle interpolates the position of the guide, with rounding.
        np.testing.assert_allclose(info['tip'], tip, rtol=1e-12, atol=1e-15)
        assert info['miss'] == pytest.approx(np.hypot(*(tip - target)), rel=1e-12)
        measured = tip + prior.noise * normal[k]
        expected = np.concatenate([measured, target, plant.needle.guide]) / limit
        # Observations have the precision of 32 bits.
        np.testing.assert_allclose(seen, [k / 20, *expected], rtol=1e-6, atol=1e-9)
        if plant.done:
            break
        # The guide rests from time to time: then the path does not restart.
        action = rng.uniform(-1.0, 1.0, 2) if k % 3 else plant.needle.guide / limit
        plant.guide(GuideSetpoint(*(limit * action).tolist()))
        plant.insert()
        seen, reward, over, _, info = environment.step(action)
        assert over == plant.done
        assert reward == (-1e3 * info['miss'] if over else 0.0)
    with pytest.raises(gymnasium.error.ResetNeeded, match='call reset'):
        environment.step(np.zeros(2))


def test_path_noise_of_the_environment_has_the_density_of_its_prior() -> None:
    """As `wandering`: the loads of 200 needles have its standard deviation and correlation."""
    environments = SteeringVectorEnv(200, prior=replace(PRIOR, spread=0.0))
    environments.reset(seed=1)
    nominal, steering, _ = find_needle(DEFAULT_NEEDLE)
    steering = replace(steering, path_noise=PRIOR.path_noise)
    expected = np.array([wandering(nominal, steering, seed) for seed in range(200)])[:, :102]
    needles: Any = environments._needles
    found = needles._needles.wander
    assert found.shape == expected.shape
    # 200 needles of 40 correlation lengths in two planes: 1 % of their size.
    assert found.std() == pytest.approx(expected.std(), rel=0.05)
    both = [
        np.corrcoef(one[:, 1:].ravel(), one[:, :-1].ravel())[0, 1] for one in (found, expected)
    ]
    assert both[0] == pytest.approx(both[1], abs=0.02)


def test_next_episode_has_the_population_again() -> None:
    """Bitwise, after an episode with a given needle of more layers."""
    environment, other = SteeringEnv(), SteeringEnv()
    truth, _, _ = sampled_truth(PRIOR, 4)
    layers = replace(truth.needle, layer_depths=(0.03,), layer_stiffnesses=(1e4,))
    environment.reset(options={'truth': replace(truth, needle=layers)})
    environment.step(np.ones(2))
    assert np.array_equal(environment.reset(seed=3)[0], other.reset(seed=3)[0])
    action = np.ones(2)
    assert np.array_equal(environment.step(action)[0], other.step(action)[0])
    for target in ((1.0, 2.0, 3.0), (np.nan, 0.0), (4.0, 0.0), (0.0, -0.21)):
        with pytest.raises(NeedleError, match='target must'):
            environment.reset(options={'target': target})


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
    listed, _ = other.reset(seed=[3, 9, 4])
    for seed in ((3, 9, 4), np.array([3, 9, 4])):
        assert np.array_equal(many.reset(seed=seed)[0], listed)
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
        assert info == {'error': target - one.depth, 'force': force} | dict.fromkeys(
            ('success', 'is_success'), False
        )
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
        ('in', ShapeError, r"actions must be real numbers, got 'in'"),
        (
            1j * np.ones((64, 1)),
            ShapeError,
            r'actions must be real numbers, got an array of complex128',
        ),
        (None, ShapeError, r'actions must have shape \(64, 1\), got \(\)'),
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
    with pytest.raises(ParameterError, match=r'render_mode must be one of rgb_array, got .human'):
        InsertionVectorEnv(3, render_mode='human')


def test_spread_of_the_needles_is_an_option() -> None:
    """Without a spread all needles are alike, and only their targets differ."""
    environments = InsertionVectorEnv(4, spread=0.0)
    first, _ = environments.reset(seed=1)
    after, *_ = environments.step(np.full((4, 1), 0.5))
    assert len(set(first[:, 0])) == 4
    assert len(set(after[:, 1])) == 1
    with pytest.raises(ParameterError, match=r'^spread must be finite, >= 0 and <= 1, got 1\.5$'):
        InsertionEnv(spread=1.5)
    with pytest.raises(ParameterError, match=r"^spread must be a number, got '0\.3'$"):
        InsertionEnv(spread='0.3')  # type: ignore[arg-type]


@pytest.mark.parametrize('name', ['NeedleInsertion-v0', 'NeedleSteering-v0'])
@pytest.mark.parametrize('mode', ['sync', 'vector_entry_point'])
def test_vectors_truncate_after_max_episode_steps(name: str, mode: str) -> None:
    many = gymnasium.make_vec(
        f'needle_study.gym:{name}', 2, vectorization_mode=mode, max_episode_steps=5
    )
    many.reset(seed=1)
    for k in range(1, 12):
        _, _, over, late, _ = many.step(np.zeros(many.action_space.shape))
        assert not over.any()
        # A truncated episode restarts at the next step.
        assert late.all() == late.any() == (k % 6 == 5)
    many.close()
    with pytest.raises(ParameterError, match=r'^max_episode_steps must be an integer from 1 '):
        InsertionVectorEnv(2, max_episode_steps=0)
    with pytest.raises(ParameterError, match=r'^max_episode_steps must be an integer from 1 '):
        SteeringVectorEnv(2, max_episode_steps=0)


def test_success_is_an_end_at_the_target() -> None:
    """True only at the end: of steering within 1 mm, of insertion at rest at the target."""
    needle, steering, _ = find_needle(DEFAULT_NEEDLE)
    none = np.zeros(2)
    straight = GroundTruth(
        needle=needle, steering=steering, tilt=(0.0, 0.0), bevel=none, frame=none, seed=0
    )
    for aside, success in ((0.9e-3, True), (1.1e-3, False)):
        environment, over = SteeringEnv(), False
        environment.reset(seed=1, options={'truth': straight, 'target': (aside, 0.0)})
        while not over:
            *_, over, _, info = environment.step(np.zeros(2))
            assert info['is_success'] == (over and success)
    many, ends, policy = InsertionVectorEnv(8, spread=0.0), 0, policies(8)[EXPERT]
    running = np.ones(8, dtype=bool)
    seen, _ = many.reset(seed=1)
    for _ in range(400):
        seen, rewards, over, _, info = many.step(policy(seen, running))
        assert np.array_equal(info['is_success'], info['success'])
        # The reward of an end at the target is above 0, of one outside the range below.
        assert np.array_equal(info['is_success'], over & (rewards > 0.0))
        assert info['_is_success'].all()
        ends += info['is_success'].sum()
    assert ends >= 8


def test_a_good_controller_earns_more_than_every_trivial_policy() -> None:
    """For each of 100 needles; the benchmark of studies has a thousand."""
    totals = returns(100)
    best = totals.pop(EXPERT)
    for name, values in totals.items():
        assert (best > values).all(), name
    # All needles arrive: progress and arrival are 2, less time and force.
    assert best.min() > 0.5


def test_steering_law_misses_by_a_tenth_of_every_trivial_policy() -> None:
    """Mean of 100 needles; on a single needle a trivial policy may hit by accident."""
    number, rng = 100, np.random.default_rng(1)

    def corrected(gain: float, kept: float, seen: FloatArray, _running: Any) -> FloatArray:
        return kept * seen[:, 5:] + gain * (seen[:, 3:5] - seen[:, 1:3])

    trivial: dict[str, Policy] = {
        'stay': lambda _seen, _running: np.zeros((number, 2)),
        'limit': lambda _seen, _running: np.ones((number, 2)),
        'random': lambda _seen, _running: rng.uniform(-1.0, 1.0, (number, 2)),
        'target': lambda seen, _running: seen[:, 3:5],
    }
    for gain in (-1.0, -0.3, -0.1, 0.1, 0.3, 1.0):
        trivial[f'P {gain}'] = partial(corrected, gain, 0.0)
        trivial[f'I {gain}'] = partial(corrected, gain, 1.0)

    def mean(make: Maker) -> float:
        return float(total_rewards(SteeringVectorEnv(number), make).mean())

    ours = mean(partial(SteeringPolicy, 'multi_hypothesis'))
    assert ours > -0.2
    for name, policy in trivial.items():
        assert mean(partial(ready, policy)) < 10.0 * ours, name


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
    ('made', 'option', 'valid'),
    [
        (SteeringEnv, 'traget', "did you mean 'target'"),
        (InsertionEnv, 'target', 'valid: none'),
        (lambda: SteeringVectorEnv(2), 'target', 'valid: reset_mask'),
    ],
)
def test_unknown_options_of_reset_are_rejected(made: Any, option: str, valid: str) -> None:
    with pytest.raises(ParameterError, match=f"options: unknown parameter '{option}'; {valid}"):
        made().reset(options={option: [0.0, 0.0]})


@pytest.mark.parametrize(
    ('options', 'complaint'),
    [
        ({'needle': 'bone'}, 'needle must be one of'),
        ({'depth': 0.0}, 'depth must be finite, > 0 m'),
        ({'depth': 1.0}, 'depth must be <='),
        ({'aside': 4.0}, 'aside must be finite, <= 0.2 m, got 4.0'),
    ],
)
def test_invalid_options_are_rejected(options: dict[str, object], complaint: str) -> None:
    with pytest.raises(ParameterError, match=complaint):
        SteeringEnv(**options)  # type: ignore[arg-type]
