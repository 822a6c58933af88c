"""A needle that is pushed to a depth, as an environment of Gymnasium: one, or many at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final

import gymnasium
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters
from needle_dynamics.errors import InsertedLengthError
import numpy as np

#: Time of a step [s], longest step of the integrator [s], and largest force [N].
PERIOD, STEP, FORCE = 0.01, 1e-3, 15.0

#: Depth at the start, and depths of targets [m].
START: Final = 0.02
TARGETS: Final = (0.03, 0.12)

#: Part by which friction and tissue of a needle may differ from the preset, and what does.
SPREAD: Final = 0.3
DRAWN: Final = ('coulomb_friction', 'viscous_friction', 'tissue_stiffness')

#: A needle is there when it is nearer [m] and slower [m/s].
_NEAR, _SLOW = 2e-4, 1e-3

#: Units of an observation: error [m], velocity [m/s], depth [m], deflection [m].
_UNITS: Final = np.array([0.1, 0.1, 0.1, 1e-3])

#: Observations are cut here, which nothing sane comes near.
BOUND: Final = 1e3

#: Price of force in the reward [1/N^2].
_PRICE: Final = 1e-5


class _Needle:
    """A needle of an episode, with its target."""

    def __init__(self, preset: NeedleParameters, rng: np.random.Generator) -> None:
        factors = 1.0 + SPREAD * rng.uniform(-1.0, 1.0, len(DRAWN))
        changed: dict[str, Any] = {
            name: float(factor * getattr(preset, name))
            for name, factor in zip(DRAWN, factors, strict=True)
        }
        parameters = replace(preset, **changed)
        model = NeedleModel(parameters)
        self._integrator = Integrator(parameters, model.state_at(START), STEP)
        self.target = float(rng.uniform(*TARGETS))

    def step(self, action: float) -> tuple[float, bool]:
        """Push for a period; return the reward, and whether the episode has ended."""
        one, force = self._integrator, FORCE * min(max(float(action), -1.0), 1.0)
        try:
            one.advance(PERIOD, force)
        except InsertedLengthError:
            return -1.0, True
        error = abs(self.target - one.depth)
        there = error < _NEAR and abs(one.velocity) < _SLOW
        return -error - _PRICE * force * force, there

    def observe(self) -> FloatArray:
        """Return what is seen of it, shape (4,)."""
        one = self._integrator
        tip = float(one.model.tip_deflections(one.state))
        seen = np.array([self.target - one.depth, one.velocity, one.depth, tip])
        return np.asarray(np.clip(seen / _UNITS, -BOUND, BOUND), dtype=np.float32)


class InsertionEnv(gymnasium.Env[FloatArray, FloatArray]):
    """
    Push a needle to a depth; friction and tissue differ from episode to episode.

    The action is the force over 10 ms, in parts of 15 N. The observation is the error of depth,
    velocity and depth in dm and dm/s, and the deflection of the tip in mm. The reward is the
    error with a minus [m], and a small price of force. The episode ends where the needle rests at
    its target, or leaves its range.

    Parameters
    ----------
    preset : str
        Needle and tissue in the middle.

    """

    metadata: ClassVar[dict[str, Any]] = {'render_modes': []}

    def __init__(self, preset: str = 'phantom') -> None:
        self._preset = NeedleParameters.preset(preset)
        self.action_space = spaces.Box(-1.0, 1.0, (1,))
        self.observation_space = spaces.Box(-BOUND, BOUND, (len(_UNITS),))
        self._needle: _Needle | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """
        Begin an episode with another needle.

        Parameters
        ----------
        seed : int, optional
            Seed of all that follows.
        options : dict, optional
            Not used.

        Returns
        -------
        observation : ndarray, shape (4,)
            As the class says.
        info : dict
            Empty.

        """
        super().reset(seed=seed, options=options)
        self._needle = _Needle(self._preset, self.np_random)
        return self._needle.observe(), {}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """
        Push for 10 ms.

        Parameters
        ----------
        action : ndarray, shape (1,)
            Force, in parts of 15 N; what is beyond is cut.

        Returns
        -------
        observation : ndarray, shape (4,)
            As the class says.
        reward : float
            As the class says.
        terminated : bool
            Whether the needle rests at its target, or has left its range.
        truncated : bool
            False.
        info : dict
            Empty.

        """
        if self._needle is None:
            raise gymnasium.error.ResetNeeded('no episode has begun: call reset')
        reward, over = self._needle.step(action[0])
        return self._needle.observe(), reward, over, False, {}


class InsertionVectorEnv(VectorEnv[FloatArray, FloatArray, FloatArray]):
    """
    Many needles at once, each as in `InsertionEnv` with a seed of its own.

    Parameters
    ----------
    num_envs : int
        How many.
    preset : str
        As in `InsertionEnv`.
    max_episode_steps : int
        Steps after which an episode is broken off.

    """

    metadata: ClassVar[dict[str, Any]] = {
        'render_modes': [], 'autoreset_mode': AutoresetMode.NEXT_STEP,
    }  # fmt: skip

    def __init__(
        self, num_envs: int = 1, preset: str = 'phantom', max_episode_steps: int = 500
    ) -> None:
        single = InsertionEnv(preset)
        self.num_envs = num_envs
        self.single_action_space = single.action_space
        self.single_observation_space = single.observation_space
        self.action_space = batch_space(single.action_space, num_envs)
        self.observation_space = batch_space(single.observation_space, num_envs)
        self._preset, self._longest = NeedleParameters.preset(preset), max_episode_steps
        self._rngs: list[np.random.Generator] = []
        self._needles: list[_Needle] = []

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """
        Begin an episode in each.

        Parameters
        ----------
        seed : int or sequence of int, optional
            Seed of the first, the next one of the second, and so on; or of each.
        options : dict, optional
            Not used.

        Returns
        -------
        observations : ndarray, shape (n, 4)
            As in `InsertionEnv`.
        infos : dict
            Empty.

        """
        super().reset(options=options)
        seeds: Sequence[int | None] = (
            [None if seed is None else seed + k for k in range(self.num_envs)]
            if seed is None or isinstance(seed, int)
            else seed
        )
        if any(one is not None for one in seeds) or not self._rngs:
            self._rngs = [gymnasium.utils.seeding.np_random(one)[0] for one in seeds]
        self._needles = [_Needle(self._preset, rng) for rng in self._rngs]
        self._steps = np.zeros(self.num_envs, dtype=int)
        self._over = np.zeros(self.num_envs, dtype=bool)
        return self._observe(), {}

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, Any, Any, dict[str, Any]]:
        """
        Push all for 10 ms; where an episode is over, the next one begins instead.

        Parameters
        ----------
        actions : ndarray, shape (n, 1)
            Forces, in parts of 15 N.

        Returns
        -------
        observations : ndarray, shape (n, 4)
            As in `InsertionEnv`.
        rewards : ndarray, shape (n,)
            As there.
        terminations, truncations : ndarray of bool, shape (n,)
            Which episodes have ended, and which are broken off.
        infos : dict
            Empty.

        """
        if not self._needles:
            raise gymnasium.error.ResetNeeded('no episode has begun: call reset')
        rewards, ended = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)
        again = self._over
        for k, needle in enumerate(self._needles):
            if again[k]:
                self._needles[k] = _Needle(self._preset, self._rngs[k])
            else:
                rewards[k], ended[k] = needle.step(actions[k, 0])
        self._steps = np.where(again, 0, self._steps + 1)
        broken = (self._steps >= self._longest) & ~ended
        self._over = ended | broken
        return self._observe(), rewards, ended, broken, {}

    def _observe(self) -> FloatArray:
        return np.array([needle.observe() for needle in self._needles])
