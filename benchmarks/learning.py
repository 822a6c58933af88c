# SPDX-License-Identifier: Apache-2.0
"""Laws of the suite and policies learned by PPO in the environments, on the same needles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple, TypeAlias

from benchmarks.episodes import (
    InsertionPolicy,
    Maker,
    Policy,
    ready,
    SteeringPolicy,
    total_rewards,
)
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.policies import EXPERT, expert
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from needle_controller import LAWS, STEERING_LAWS
from needle_dynamics import FloatArray
from needle_dynamics.arrays import BoolArray
from needle_ros.quantities import NORMAL
from needle_study.gym.insertion import InsertionVectorEnv
from needle_study.gym.steering import PRIOR, SteeringVectorEnv
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv
import torch

#: Largest relative deviations of stiffness and friction from the nominal needle.
MISMATCHES: Final = (0.0, 0.5, 1.0)

#: Observations near 0, of this size, are also seen at a larger scale.
FINE: Final = 2e-3

#: Learning rate at the start and at the end, and size of the network.
RATES, LAYERS = (1e-3, 1e-5), (64, 64)

#: Seed of training, and of its first needle: other needles than those of the evaluation.
SEED: Final = 1_000_000

#: Environments at once, and steps in each between two updates of the policy.
ENVIRONMENTS, ROWS = 64, 128

#: Steering laws without turns of the needle, ours first.
STEERED: Final = tuple(law for law in STEERING_LAWS if law != 'roll_to_target')

_NOTES: Final = {
    'NeedleInsertion-v0': 'Mean of {} needles, seeds from 0, and its 95 % interval. By column: '
    'largest deviation of Coulomb friction, viscous friction and tissue stiffness from the '
    'nominal needle, uniform and independent. The laws have the nominal needle as their model, '
    'and a reference of at most 28 mm/s and 1 m/s^2; *nominal model* balances its friction. PPO '
    'of Stable-Baselines3 is trained with {} periods of other needles, with the nominal '
    'constants (0 %) or the largest deviation (100 %).',
    'NeedleSteering-v0': 'Mean of {} needles, seeds from 0, and its 95 % interval: the negative '
    'distance from the target [mm]. By column: largest stiffness of the tissue over the nominal '
    'one, less 1; friction has no effect on the lateral motion. Tilt, bevel, rotation of the '
    'sensor and path are sampled in all columns. The laws have the nominal needle as their model '
    'and their default prior. PPO is trained with {} steps of other needles.',
}


class LearningPlan(NamedTuple):
    """Size of the benchmark."""

    needles: int  #: needles of each mean
    insertions: int  #: steps of training in `NeedleInsertion-v0`
    steerings: int  #: steps of training in `NeedleSteering-v0`


PLANS: Final = {
    'default': LearningPlan(1000, 1_500_000, 2_500_000),
    'quick': LearningPlan(20, 2 * ENVIRONMENTS * ROWS, 2 * ENVIRONMENTS * ROWS),
}


#: Constructor of environments with a mismatch and a number of needles.
Environments: TypeAlias = Callable[[float, int], VectorEnv[Any, Any, Any]]


def inserted(mismatch: float, needles: int) -> InsertionVectorEnv:
    """Return needles whose stiffness and friction deviate by up to the mismatch."""
    return InsertionVectorEnv(needles, spread=mismatch)


def steered(mismatch: float, needles: int) -> SteeringVectorEnv:
    """Return needles in tissue that is up to 1 + mismatch times as stiff as the nominal one."""
    # The stiffness is proportional to the bending length to the power of -4.
    return SteeringVectorEnv(needles, prior=replace(PRIOR, spread=1.0 - (1.0 + mismatch) ** -0.25))


def inputs(observations: FloatArray) -> FloatArray:
    """Return observations, and the same with a logarithmic scale down to `FINE`."""
    both = observations, np.arcsinh(observations / FINE) / 3.0
    return np.concatenate(both, axis=1).astype(np.float32)


class _Training(VecEnv):
    """Environments of Stable-Baselines3: an episode that ends restarts at once."""

    def __init__(self, environments: VectorEnv[Any, Any, Any]) -> None:
        self._environments = environments
        size = 2 * environments.single_observation_space.shape[0]
        seen = spaces.Box(-np.inf, np.inf, (size,))
        super().__init__(environments.num_envs, seen, environments.single_action_space)

    def reset(self) -> FloatArray:
        first, _ = self._environments.reset(seed=SEED)
        return inputs(first)

    def step_async(self, actions: FloatArray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[FloatArray, FloatArray, BoolArray, list[dict[str, Any]]]:
        observations, rewards, over, late, _ = self._environments.step(self._actions)
        seen = inputs(observations)
        done, infos = over | late, [dict[str, Any]() for _ in range(self.num_envs)]
        if done.any():
            for k in np.flatnonzero(done).tolist():
                infos[k]['terminal_observation'] = seen[k]
                infos[k]['TimeLimit.truncated'] = bool(late[k] and not over[k])
            first, _ = self._environments.reset(options={'reset_mask': done})
            seen = inputs(first)
        return seen, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        self._environments.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:  # noqa: ARG002
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f'{attr_name} cannot be set to {value!r} in {indices or "all"}')

    def env_method(self, method_name: str, *_args: Any, **_options: Any) -> list[Any]:
        raise AttributeError(f'the environments have no method {method_name}')

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:  # noqa: ARG002
        return [False] * self.num_envs


def train(make: Callable[[int], VectorEnv[Any, Any, Any]], steps: int) -> Policy:
    """Return the mean actions of a network as a policy, after a number of steps of training."""
    # More threads are slower for networks of this size.
    torch.set_num_threads(1)
    high, low = RATES
    network = PPO(
        'MlpPolicy',
        _Training(make(ENVIRONMENTS)),
        n_steps=ROWS,
        batch_size=1024,
        n_epochs=8,
        gamma=0.998,
        learning_rate=lambda left: low + (high - low) * left,
        policy_kwargs={'net_arch': list(LAYERS), 'log_std_init': -0.5},
        seed=SEED,
        device='cpu',
    )
    network.learn(steps)

    def policy(observations: FloatArray, _running: BoolArray) -> FloatArray:
        actions, _ = network.predict(inputs(observations), deterministic=True)
        return np.asarray(actions, dtype=np.float64)

    return policy


def interval(values: FloatArray) -> tuple[float, float]:
    """Return the mean, and half the width of its 95 % interval."""
    return float(values.mean()), float(NORMAL * values.std(ddof=1) / np.sqrt(len(values)))


def learned(tick: Tick, environments: Environments, steps: int) -> dict[str, Maker]:
    """Train on nominal needles, and on needles with the largest mismatch."""
    found: dict[str, Maker] = {}
    for mismatch in (MISMATCHES[0], MISMATCHES[-1]):
        name = f'PPO, trained at {100.0 * mismatch:g} %'
        tick(f'{name}: {steps} steps')
        found[name] = partial(ready, train(partial(environments, mismatch), steps))
    return found


def measured(
    tick: Tick, environments: Environments, makers: Mapping[str, Maker], needles: int
) -> dict[str, list[FloatArray]]:
    """Return the sums of rewards of each needle, by policy and mismatch."""
    found = dict[str, list[FloatArray]]()
    for name, make in makers.items():
        tick(name)
        found[name] = [total_rewards(environments(each, needles), make) for each in MISMATCHES]
    return found


def tables(
    title: str, totals: Mapping[str, list[FloatArray]], ours: str, notes: str
) -> list[PageSection]:
    """Return the means, and the differences of learned policies and our law on each needle."""
    heads = [f'{100.0 * mismatch:g} %' for mismatch in MISMATCHES]
    rows = [
        (name, *('{:.3f} ± {:.3f}'.format(*interval(one)) for one in each))
        for name, each in totals.items()
    ]
    compared = []
    for name, each in totals.items():
        if not name.startswith('PPO'):
            continue
        cells = []
        for one, other in zip(each, totals[ours], strict=True):
            mean, half = interval(one - other)
            verdict = 'equal' if abs(mean) <= half else 'better' if mean > 0.0 else 'worse'
            cells.append(f'{mean:+.3f} ± {half:.3f}: {verdict}')
        compared.append((name, *cells))
    return [
        PageSection(f'{title}: sums of rewards', ('policy', *heads), rows, notes),
        PageSection(
            f'{title}: learned policies less {ours}',
            ('policy', *heads),
            compared,
            'Mean difference on the same needles, and its 95 % interval.',
        ),
    ]


def compare(tick: Tick, plan: str = 'default') -> Answer:
    """Train, and compare laws and policies in both environments."""
    size = PLANS[plan]
    sections, bars = list[PageSection](), list[Bar]()
    cases: tuple[tuple[str, str, Environments, dict[str, Maker], int], ...] = (
        (
            'NeedleInsertion-v0', '', inserted,
            {
                **{law: partial(InsertionPolicy, law) for law in LAWS},
                EXPERT: partial(ready, expert),
            },
            size.insertions,
        ),
        (
            'NeedleSteering-v0', 'mm', steered,
            {law: partial(SteeringPolicy, law) for law in STEERED},
            size.steerings,
        ),
    )  # fmt: skip
    for title, unit, environments, laws, steps in cases:
        policies: dict[str, Maker] = {**laws, **learned(tick, environments, steps)}
        totals = measured(tick, environments, policies, size.needles)
        ours = next(iter(laws))
        sections += tables(title, totals, ours, _NOTES[title].format(size.needles, steps))
        # No bar for a mismatch: the laws have the nominal needle as their model.
        best = max(each[0].mean() for name, each in totals.items() if name not in laws)
        figure = f'{title}, nominal needles: {ours} less the best learned policy'
        found = float(totals[ours][0].mean() - best)
        bars.append(Bar(figure, found, 0.0, unit, at_least=True))
    return sections, bars
