# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environment of a needle that is pushed to a depth, single or vectorized."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final

import gymnasium
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters
from needle_dynamics.compiled.boxed import Boxed
from needle_ros.errors import ParameterError
from needle_ros.settings import check_choice
from needle_study.gym.environment import checked_actions, picture
from needle_study.gym.pushed import BOUND, FORCE, observe, push, Pushed, START, Tissues, UNITS
import numpy as np

TARGETS: Final = (0.03, 0.12)  #: Range of target depths [m].

#: Largest relative deviation from the nominal needle, and the constants that deviate.
SPREAD: Final = 0.3
DRAWN: Final = ('coulomb_friction', 'viscous_friction', 'tissue_stiffness')

_ONE: Final = np.ones(1, dtype=bool)  #: mask of a single environment
_EDGE: Final = 2e-3  #: lateral position at the upper edge of an image [m]


class _Needles:
    def __init__(self, needle: str, number: int) -> None:
        self._nominal = NeedleParameters.preset(needle)
        model = NeedleModel(self._nominal)
        self._start, common = model.state_at(START), model.compiled
        self._needles = Pushed(
            common,
            np.zeros((number, 2)),
            Tissues(*(np.array([one] * number) for one in common.layers)),
            np.zeros(number),
            np.array([self._start] * number),
            np.zeros(number),
        )
        self._boxed = Boxed(self._needles)
        self.forces = np.zeros(number)

    def begin(self, k: int, rng: np.random.Generator) -> None:
        factors = 1.0 + SPREAD * rng.uniform(-1.0, 1.0, len(DRAWN))
        changed: dict[str, Any] = {
            name: float(factor * getattr(self._nominal, name))
            for name, factor in zip(DRAWN, factors, strict=True)
        }
        drawn, all_of = NeedleModel(replace(self._nominal, **changed)).compiled, self._needles
        all_of.friction[k] = drawn.friction.coulomb, drawn.friction.viscous
        for layers, one in zip(all_of.layers, drawn.layers, strict=True):
            layers[k] = one
        all_of.times[k], all_of.states[k] = 0.0, self._start
        all_of.targets[k], self.forces[k] = rng.uniform(*TARGETS), 0.0

    def step(self, actions: FloatArray, which: Any) -> tuple[FloatArray, Any]:
        """Push the selected needles for a period; return rewards and ends as `push`."""
        self.forces = np.where(which, FORCE * actions, 0.0)
        return push(self._boxed, actions, which)

    def info(self, ends: Any) -> dict[str, Any]:
        """Return depth error [m], force [N] and success, shape (n,)."""
        n = self._needles
        errors = n.targets - (n.common.length - n.states[:, 0])
        return {'error': errors, 'force': self.forces.copy(), 'success': ends > 0}

    def picture(self, k: int) -> Any:
        n = self._needles
        depth, tip = n.common.length - n.states[k, 0], 1e-3 * float(self.observe()[k, 3])
        return picture(n.common.length, _EDGE, (depth, tip), (n.targets[k], 0.0))

    def observe(self) -> FloatArray:
        return np.asarray(observe(self._boxed))


class InsertionEnv(gymnasium.Env[FloatArray, FloatArray]):
    """
    Push a needle to a depth; friction and tissue are sampled around a needle in each episode.

    Action: force over 10 ms, as a fraction of 15 N. Observation: error of depth, velocity and
    depth in dm and dm/s, tip deflection in mm. The episode ends at rest at the target, or outside
    the range of the needle.

    Reward: decrease of the error as a fraction of the initial error, minus 0.001 for the period
    and 0.003 times the square of the action; 1 more at the target, 2 less outside the range. The
    sum is below 2, and -0.5 for a needle at rest for 500 periods. Info: ``error`` of depth [m],
    ``force`` [N], ``success``.
    """

    metadata: ClassVar[dict[str, Any]] = {'render_modes': ['rgb_array'], 'render_fps': 25}

    def __init__(self, needle: str = 'phantom', render_mode: str | None = None) -> None:
        if render_mode is not None:
            check_choice('render_mode', render_mode, self.metadata['render_modes'])
        self.render_mode = render_mode
        self._needles, self._begun = _Needles(needle, 1), False
        self.action_space = spaces.Box(-1.0, 1.0, (1,))
        self.observation_space = spaces.Box(-BOUND, BOUND, (len(UNITS),))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._needles.begin(0, self.np_random)
        self._begun = True
        return self._needles.observe()[0], self._info(np.zeros(1))

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Push for 10 ms; the action is clipped to [-1, 1]."""
        if not self._begun:
            raise gymnasium.error.ResetNeeded('no episode has begun: call reset')
        rewards, ends = self._needles.step(checked_actions(action, (1,)), _ONE)
        over = bool(ends[0] != 0)
        return self._needles.observe()[0], float(rewards[0]), over, False, self._info(ends)

    def _info(self, ends: Any) -> dict[str, Any]:
        return {name: values[0].item() for name, values in self._needles.info(ends).items()}

    def render(self) -> Any:
        return None if self.render_mode is None else self._needles.picture(0)


class InsertionVectorEnv(VectorEnv[FloatArray, FloatArray, FloatArray]):
    """Needles as in `InsertionEnv`, each with its own seed, for up to `max_episode_steps`."""

    metadata: ClassVar[dict[str, Any]] = {
        **InsertionEnv.metadata, 'autoreset_mode': AutoresetMode.NEXT_STEP,
    }  # fmt: skip

    def __init__(
        self,
        num_envs: int = 1,
        needle: str = 'phantom',
        max_episode_steps: int = 500,
        render_mode: str | None = None,
    ) -> None:
        single = InsertionEnv(needle, render_mode)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_action_space = single.action_space
        self.single_observation_space = single.observation_space
        self.action_space = batch_space(single.action_space, num_envs)
        self.observation_space = batch_space(single.observation_space, num_envs)
        self._needles, self._longest = _Needles(needle, num_envs), max_episode_steps
        self._rngs = [gymnasium.utils.seeding.np_random()[0] for _ in range(num_envs)]
        self._begun, self._over = np.zeros((2, num_envs), dtype=bool)
        self._steps = np.zeros(num_envs, dtype=int)

    def _begin(self, k: int) -> None:
        self._needles.begin(k, self._rngs[k])
        self._begun[k], self._over[k], self._steps[k] = True, False, 0

    def _info(self, ends: Any) -> dict[str, Any]:
        """Return the info of all environments, with masks of the environments that have it."""
        info = self._needles.info(ends)
        return info | {f'_{name}': np.ones(self.num_envs, dtype=bool) for name in info}

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """
        Start an episode in each environment, or in those of the option ``reset_mask``.

        An integer seed counts up from the first environment. In a sequence, None continues the
        random numbers of its environment.
        """
        super().reset(options=options)
        seeds: list[int | None] = [None] * self.num_envs
        if isinstance(seed, Sequence):
            seeds = list(seed)
        elif seed is not None:
            seeds = [int(seed) + k for k in range(self.num_envs)]
        which = np.array((options or {}).get('reset_mask', [True] * self.num_envs), dtype=bool)
        if len(seeds) != self.num_envs or which.shape != (self.num_envs,):
            raise ParameterError(
                f'seed and reset_mask must be of {self.num_envs} environments, got {len(seeds)} '
                f'and {which.shape}'
            )
        for k in np.flatnonzero(which).tolist():
            if seeds[k] is not None:
                self._rngs[k] = gymnasium.utils.seeding.np_random(seeds[k])[0]
            self._begin(k)
        return self._needles.observe(), self._info(np.zeros(self.num_envs))

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, Any, Any, dict[str, Any]]:
        """Push all needles for 10 ms; where an episode has ended, start the next one instead."""
        if not self._begun.all():
            raise gymnasium.error.ResetNeeded('no episode has begun: call reset')
        again = self._over
        pushes = checked_actions(actions, (self.num_envs, 1))[:, 0]
        rewards, ends = self._needles.step(pushes, ~again)
        self._steps += 1
        for k in np.flatnonzero(again).tolist():
            self._begin(k)
        ended, broken = ends != 0, self._steps >= self._longest
        self._over = ended | broken
        return self._needles.observe(), rewards, ended, broken, self._info(ends)

    def render(self) -> Any:
        if self.render_mode is None:
            return None
        return tuple(map(self._needles.picture, range(self.num_envs)))
