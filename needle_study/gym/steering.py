# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environment of a needle whose guide steers its tip."""

from typing import Any, ClassVar, Final

import gymnasium
from gymnasium import spaces
from needle_controller import SIMULATION_LIMITS, SteeringPrior
from needle_controller.steering.law import GuideSetpoint
from needle_controller.steering.simulation import sample_truth, SteeringPlant, step_depths
from needle_dynamics import DEFAULT_NEEDLE, find_needle, FloatArray
from needle_ros.errors import ParameterError
from needle_ros.settings import check_choice
from needle_study.gym.environment import checked_actions, picture
from needle_study.gym.pushed import BOUND
import numpy as np

#: Default distribution of the unknown disturbances of a needle.
PRIOR: Final = SteeringPrior(tilt=0.02, frame=0.03, bevel=0.1)

_SEEDS: Final = 2**63  #: upper bound of the seeds of paths


class SteeringEnv(gymnasium.Env[FloatArray, FloatArray]):
    """
    Steer the tip to a target in steps of a needle; needle, tissue and target are sampled.

    ``needle`` is as for `find_needle`, ``depth`` of the target, ``step_length``, and the
    limits of guide and target (``aside``) along x and z in m, ``prior`` the distribution of the
    needles. The action is the position of the guide for the next step, as a fraction of its limit.
    The observation is the depth over the target depth, and as fractions of the guide limit the
    measured tip, the target and the guide, each x and z. The reward at the end is the negative
    distance of the tip from the target [mm], before it is 0. Then the info has ``miss``, the
    distance [m]; it always has ``tip``, the true tip in x and z [m]. Images show the plane of z.
    """

    metadata: ClassVar[dict[str, Any]] = {'render_modes': ['rgb_array'], 'render_fps': 2}

    def __init__(
        self,
        needle: str = DEFAULT_NEEDLE,
        *,
        depth: float = 0.1,
        step_length: float = SIMULATION_LIMITS.step_length,
        guide_limit: float = SIMULATION_LIMITS.guide_limit,
        aside: float = 4e-3,
        prior: SteeringPrior = PRIOR,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            check_choice('render_mode', render_mode, self.metadata['render_modes'])
        self.render_mode = render_mode
        names = 'depth', 'step_length', 'guide_limit', 'aside'
        sizes = dict(zip(names, (depth, step_length, guide_limit, aside), strict=True))
        for name, value in sizes.items():
            if not 0.0 < value < np.inf:
                raise ParameterError(f'{name} must be positive and finite, got {value!r} m')
        self._needle, self._steering, _ = find_needle(needle)
        reach = self._needle.length - self._steering.free_length
        if depth > reach:
            raise ParameterError(f'depth must be <= {reach:g} m with this needle, got {depth!r} m')
        self._depths = step_depths(depth, step_length)
        self._limit, self._aside, self._prior = guide_limit, aside, prior
        self.action_space = spaces.Box(-1.0, 1.0, (2,))
        self.observation_space = spaces.Box(-BOUND, BOUND, (7,))
        self._plant: SteeringPlant | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Start an episode; options: ``truth``, a `GroundTruth`, and ``target``, x and z [m]."""
        super().reset(seed=seed, options=options)
        rng, given = self.np_random, options or {}
        path_seed = int(rng.integers(_SEEDS))
        truth = sample_truth(self._needle, self._steering, self._prior, rng, path_seed)
        target = rng.uniform(-self._aside, self._aside, 2)
        self._plant = given.get('truth', truth).plant(self._depths)
        self._target = np.array(given.get('target', target))
        return self._observe(self._plant), {'tip': self._plant.tip}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Move the guide, then the needle; the action is clipped to [-1, 1]."""
        plant = self._plant
        if plant is None or plant.done:
            raise gymnasium.error.ResetNeeded('the episode is over, or none has begun: call reset')
        x, z = (self._limit * checked_actions(action, (2,))).tolist()
        plant.guide(GuideSetpoint(x, z))
        plant.insert()
        observation, tip = self._observe(plant), plant.tip
        if not plant.done:
            return observation, 0.0, False, False, {'tip': tip}
        miss = float(np.hypot(*(tip - self._target)))
        return observation, -1e3 * miss, True, False, {'tip': tip, 'miss': miss}

    def render(self) -> Any:
        plant = self._plant
        if self.render_mode is None or plant is None:
            return None
        tip, length = (plant.needle.depth, plant.tip[1]), float(1.1 * self._depths[-1])
        return picture(length, self._limit, tip, (self._depths[-1], self._target[1]))

    def _observe(self, plant: SteeringPlant) -> FloatArray:
        tip = plant.tip + self._prior.noise * self.np_random.standard_normal(2)
        depth = plant.needle.depth / self._depths[-1]
        lengths = np.concatenate([tip, self._target, plant.needle.guide]) / self._limit
        numbers = np.clip(np.concatenate([[depth], lengths]), -BOUND, BOUND)
        return np.asarray(numbers, dtype=np.float32)
