# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environment of a needle that is pushed to a depth, single or vectorized."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

from gymnasium import spaces
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters
from needle_dynamics.arrays import BoolArray
from needle_dynamics.compiled.boxed import Boxed
from needle_ros.settings import checked
from needle_study.gym.environment import NeedleEnv, NeedleVectorEnv, picture
from needle_study.gym.pushed import BOUND, FORCE, observe, push, Pushed, START, Tissues, UNITS
import numpy as np

TARGETS: Final = (0.03, 0.12)  #: Range of target depths [m].

#: Largest relative deviation from the nominal needle, and the constants that deviate.
SPREAD: Final = 0.3
DRAWN: Final = ('coulomb_friction', 'viscous_friction', 'tissue_stiffness')

_EDGE: Final = 2e-3  #: lateral position at the upper edge of an image [m]


class _Needles:
    options = ()

    def __init__(self, needle: str, spread: float, number: int) -> None:
        checked('spread', spread, low=0.0, high=1.0)
        self._nominal, self._spread = NeedleParameters.preset(needle), spread
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
        self._boxed, self._forces = Boxed(self._needles), np.zeros(number)
        self.action_space = spaces.Box(-1.0, 1.0, (1,))
        self.observation_space = spaces.Box(-BOUND, BOUND, (len(UNITS),))

    def begin(
        self, which: BoolArray, rngs: Sequence[np.random.Generator], _options: Mapping[str, Any]
    ) -> None:
        for k in np.flatnonzero(which).tolist():
            self._sample(k, rngs[k])

    def _sample(self, k: int, rng: np.random.Generator) -> None:
        factors = 1.0 + self._spread * rng.uniform(-1.0, 1.0, len(DRAWN))
        changed: dict[str, Any] = {
            name: float(factor * getattr(self._nominal, name))
            for name, factor in zip(DRAWN, factors, strict=True)
        }
        drawn, all_of = NeedleModel(replace(self._nominal, **changed)).compiled, self._needles
        all_of.friction[k] = drawn.friction.coulomb, drawn.friction.viscous
        for layers, one in zip(all_of.layers, drawn.layers, strict=True):
            layers[k] = one
        all_of.times[k], all_of.states[k] = 0.0, self._start
        all_of.targets[k], self._forces[k] = rng.uniform(*TARGETS), 0.0

    def step(self, actions: FloatArray, which: BoolArray) -> tuple[FloatArray, Any]:
        pushes = actions[:, 0].copy()
        self._forces = np.where(which, FORCE * pushes, 0.0)
        return push(self._boxed, pushes, which)

    def info(self, ends: Any) -> dict[str, Any]:
        n = self._needles
        errors = n.targets - (n.common.length - n.states[:, 0])
        success = ends > 0
        return {
            'error': errors, 'force': self._forces.copy(),
            'success': success, 'is_success': success.copy(),
        }  # fmt: skip

    def picture(self, k: int) -> Any:
        n = self._needles
        depth, tip = n.common.length - n.states[k, 0], 1e-3 * float(self.observe()[k, 3])
        return picture(n.common.length, _EDGE, (depth, tip), (n.targets[k], 0.0))

    def observe(self) -> FloatArray:
        return np.asarray(observe(self._boxed))


class InsertionEnv(NeedleEnv):
    """
    Push a needle to a depth; friction and tissue are sampled around a needle in each episode.

    ``needle`` is the name of a preset, and ``spread`` the largest relative deviation of Coulomb
    friction, viscous friction and tissue stiffness. Action: force over 10 ms, as a fraction of
    15 N. Observation: error of depth, velocity and depth in dm and dm/s, tip deflection in mm. The
    episode ends at rest at the target, or outside the range of the needle.

    Reward: decrease of the error as a fraction of the initial error, minus 0.001 for the period
    and 0.003 times the square of the action; 1 more at the target, 2 less outside the range. The
    sum is below 2, and -0.5 for a needle at rest for 500 periods. Info: ``error`` of depth [m],
    ``force`` [N], ``success`` and its common name ``is_success``.
    """

    def __init__(
        self, needle: str = 'phantom', render_mode: str | None = None, *, spread: float = SPREAD
    ) -> None:
        super().__init__(_Needles(needle, spread, 1), render_mode)


class InsertionVectorEnv(NeedleVectorEnv):
    """Needles as in `InsertionEnv`, each with its own seed, for up to `max_episode_steps`."""

    def __init__(
        self,
        num_envs: int = 1,
        needle: str = 'phantom',
        max_episode_steps: int | None = 500,
        render_mode: str | None = None,
        *,
        spread: float = SPREAD,
    ) -> None:
        needles = partial(_Needles, needle, spread)
        super().__init__(num_envs, needles, render_mode, max_episode_steps)
