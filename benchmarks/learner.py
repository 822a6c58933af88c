# SPDX-License-Identifier: Apache-2.0
"""Policies learned by PPO of Stable-Baselines3, which this file imports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from gymnasium import spaces
from gymnasium.vector import VectorEnv
from needle_dynamics.arrays import BoolArray, FloatArray
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv
import torch

#: Observations near 0, of this size, are also seen at a larger scale.
FINE: Final = 2e-3

#: Learning rate at the start and at the end, and size of the network.
RATES, LAYERS = (1e-3, 1e-5), (64, 64)

#: Seed of training, and of its first needle: other needles than those of the evaluation.
SEED: Final = 1_000_000

#: Environments at once, and steps in each between two updates of the policy.
ENVIRONMENTS, ROWS = 64, 128


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
        raise NotImplementedError

    def env_method(self, method_name: str, *_args: Any, **_options: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:  # noqa: ARG002
        return [False] * self.num_envs


def train(
    make: Callable[[int], VectorEnv[Any, Any, Any]], steps: int
) -> Callable[[FloatArray, BoolArray], FloatArray]:
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
