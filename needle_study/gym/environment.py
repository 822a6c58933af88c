# SPDX-License-Identifier: Apache-2.0
"""Environment of one needle, and of many with their own seeds, without a graphics library."""

from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import Any, ClassVar, Final, Protocol

import gymnasium
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from needle_dynamics import FloatArray
from needle_dynamics.arrays import BoolArray, floats, IntArray
from needle_ros.errors import ParameterError
from needle_ros.settings import check_choice, check_whole, LARGEST_SEED
from needle_study.scenario import check_names
import numpy as np

_WIDTH, _HEIGHT, _MARGIN = 320, 120, 20  #: size of an image and depth 0 [pixels]

_TISSUE, _AIR, _NEEDLE, _TARGET = (
    (240, 205, 190), (255, 255, 255), (40, 40, 60), (200, 30, 30),
)  # fmt: skip

_SPOT: Final = 3  #: half of the size of the target [pixels]

_ONE: Final = np.ones(1, dtype=bool)  #: mask of a single environment

_MASK: Final = 'reset_mask'  #: option of a vector environment

_NO_EPISODE: Final = 'the episode is over, or none has begun: call reset'


def checked_actions(actions: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return actions as floats clipped to [-1, 1]; they must be finite and have the shape."""
    return floats('actions', actions, shape).clip(-1.0, 1.0)


def picture(length: float, deflection: float, tip: Any, target: Any) -> Any:
    """
    Return an image of tip and target, shape (height, width, 3), bytes.

    ``tip`` and ``target`` are depth and lateral position [m]. ``length`` is the depth at the right
    edge and ``deflection`` the lateral position at the upper edge [m].
    """
    image = np.full((_HEIGHT, _WIDTH, 3), _TISSUE, dtype=np.uint8)
    image[:, :_MARGIN] = _AIR

    def pixel(depth: float, lateral: float) -> tuple[int, int]:
        column = _MARGIN + (_WIDTH - 1 - _MARGIN) * depth / length
        row = 0.5 * (_HEIGHT - 1) * (1.0 - lateral / deflection)
        return int(np.clip(row, 0, _HEIGHT - 1)), int(np.clip(column, 0, _WIDTH - 1))

    row, column = pixel(*target)
    low, left = max(row - _SPOT, 0), max(column - _SPOT, 0)
    image[low : row + _SPOT + 1, left : column + _SPOT + 1] = _TARGET
    row, column = pixel(*tip)
    middle, columns = 0.5 * (_HEIGHT - 1), np.arange(column + 1)
    # A clamped beam with a load at its end, from the left edge to the tip.
    part = columns / max(column, 1)
    rows = middle + (row - middle) * 0.5 * part**2 * (3.0 - part)
    image[np.rint(rows).astype(int), columns] = _NEEDLE
    return image


class Needles(Protocol):
    """State of n needles in compiled code."""

    action_space: spaces.Box  #: of one needle
    observation_space: spaces.Box

    @property
    def options(self) -> Sequence[str]:
        """Names of the options of `reset` for a single environment."""

    def begin(
        self, which: BoolArray, rngs: Sequence[np.random.Generator], options: Mapping[str, Any]
    ) -> None:
        """Start episodes of a mask, with generators of all needles and options of `reset`."""

    def step(self, actions: FloatArray, which: BoolArray) -> tuple[FloatArray, Any]:
        """Move the needles of a mask; return rewards and ends of episodes (not 0), shape (n,)."""

    def observe(self) -> FloatArray:
        """Return observations, shape (n, m)."""

    def info(self, ends: Any) -> dict[str, Any]:
        """Return values by name, shape (n, ...), after `observe`."""

    def picture(self, k: int) -> Any:
        """Return an image of needle k."""


class NeedleEnv(gymnasium.Env[FloatArray, FloatArray]):
    """Environment of a needle."""

    metadata: ClassVar[dict[str, Any]] = {'render_modes': ['rgb_array'], 'render_fps': 25}

    def __init__(self, needles: Needles, render_mode: str | None) -> None:
        if render_mode is not None:
            check_choice('render_mode', render_mode, self.metadata['render_modes'])
        self.render_mode = render_mode
        self._needles, self._running = needles, False
        self.action_space = needles.action_space
        self.observation_space = needles.observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        given = options or {}
        check_names('options: ', given, self._needles.options)
        self._needles.begin(_ONE, [self.np_random], given)
        self._running = True
        return self._needles.observe()[0], self._info(np.zeros(1))

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Take an action, clipped to [-1, 1]."""
        if not self._running:
            raise gymnasium.error.ResetNeeded(_NO_EPISODE)
        actions = checked_actions(action, self.action_space.shape)
        rewards, ends = self._needles.step(actions[np.newaxis], _ONE)
        over = bool(ends[0])
        self._running = not over
        return self._needles.observe()[0], float(rewards[0]), over, False, self._info(ends)

    def _info(self, ends: Any) -> dict[str, Any]:
        found = self._needles.info(ends)
        return {name: v[0] if v.ndim > 1 else v.item() for name, v in found.items()}

    def render(self) -> Any:
        return None if self.render_mode is None else self._needles.picture(0)


class NeedleVectorEnv(VectorEnv[FloatArray, FloatArray, FloatArray]):
    """Environments of n needles, each with its own seed, for up to ``longest`` steps if given."""

    metadata: ClassVar[dict[str, Any]] = {
        **NeedleEnv.metadata, 'autoreset_mode': AutoresetMode.NEXT_STEP,
    }  # fmt: skip

    def __init__(
        self,
        num_envs: int,
        needles: Callable[[int], Needles],
        render_mode: str | None,
        longest: int | None,
    ) -> None:
        if render_mode is not None:
            check_choice('render_mode', render_mode, self.metadata['render_modes'])
        if longest is not None:
            check_whole('max_episode_steps', longest, 1, LARGEST_SEED)
        self.num_envs, self.render_mode = num_envs, render_mode
        self._needles, self._longest = needles(num_envs), longest or inf
        self.single_action_space = self._needles.action_space
        self.single_observation_space = self._needles.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._rngs = [np_random()[0] for _ in range(num_envs)]
        self._begun, self._over = np.zeros((2, num_envs), dtype=bool)
        self._steps = np.zeros(num_envs, dtype=int)

    def _begin(self, which: BoolArray) -> None:
        self._needles.begin(which, self._rngs, {})
        self._steps[which] = 0

    def _info(self, ends: Any) -> dict[str, Any]:
        """Return the info of all environments, with masks of the environments that have it."""
        info = self._needles.info(ends)
        return info | {f'_{name}': np.ones(self.num_envs, dtype=bool) for name in info}

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | IntArray | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """
        Start an episode in each environment, or in those of the option ``reset_mask``.

        An integer seed counts up from the first environment. In a sequence or array, None
        continues the random numbers of its environment.
        """
        super().reset(options=options)
        seeds: list[int | None] = [None] * self.num_envs
        seed = seed.tolist() if isinstance(seed, np.ndarray) else seed
        if isinstance(seed, Sequence):
            seeds = list(seed)
        elif seed is not None:
            seeds = [int(seed) + k for k in range(self.num_envs)]
        given = options or {}
        check_names('options: ', given, [_MASK])
        which = np.array(given.get(_MASK, [True] * self.num_envs), dtype=bool)
        if len(seeds) != self.num_envs or which.shape != (self.num_envs,):
            raise ParameterError(
                f'seed and reset_mask must be of {self.num_envs} environments, got {len(seeds)} '
                f'and {which.shape}'
            )
        for k in np.flatnonzero(which).tolist():
            if seeds[k] is not None:
                self._rngs[k] = np_random(seeds[k])[0]
        self._begin(which)
        self._begun |= which
        self._over &= ~which
        return self._needles.observe(), self._info(np.zeros(self.num_envs))

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, Any, Any, dict[str, Any]]:
        """Take actions; where an episode has ended, start the next one instead."""
        if not self._begun.all():
            raise gymnasium.error.ResetNeeded(_NO_EPISODE)
        again = self._over
        found = checked_actions(actions, self.action_space.shape)
        rewards, ends = self._needles.step(found, ~again)
        self._steps += 1
        if again.any():
            self._begin(again)
        ended, broken = ends != 0, self._steps >= self._longest
        self._over = ended | broken
        return self._needles.observe(), rewards, ended, broken, self._info(ends)

    def render(self) -> Any:
        if self.render_mode is None:
            return None
        return tuple(map(self._needles.picture, range(self.num_envs)))
