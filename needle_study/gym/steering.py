# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environment of a needle whose guide steers its tip, single or vectorized."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import atan2, ceil, exp, sqrt
from typing import Any, ClassVar, Final

from gymnasium import spaces
from needle_controller import SIMULATION_LIMITS, SteeringPrior
from needle_controller.steering.law import checked_target
from needle_controller.steering.settings import step_depths
from needle_controller.steering.simulation import GroundTruth
from needle_dynamics import (
    DEFAULT_NEEDLE,
    find_needle,
    FloatArray,
    NeedleParameters,
    SteeringParameters,
)
from needle_dynamics.arrays import BoolArray
from needle_dynamics.compiled.boxed import Boxed
from needle_dynamics.compiled.cutting_lanes import DEPTH, ROWS
from needle_dynamics.compiled.lane_rows import LANES
from needle_dynamics.steering.needle import empty_cut, steered, wandering
from needle_dynamics.steering.parameters import by_layer, with_bevel
from needle_ros.errors import ParameterError
from needle_ros.settings import checked
from needle_study.gym.environment import NeedleEnv, NeedleVectorEnv, picture
from needle_study.gym.pushed import BOUND
from needle_study.gym.steered import (
    begin,
    CAUSES,
    observe,
    Population,
    sample,
    steer,
    SteeredNeedles,
)
from needle_study.steering import SteeringStudy
import numpy as np

#: Default distribution of the unknown disturbances of a needle.
PRIOR: Final = SteeringPrior(tilt=0.02, frame=0.03, bevel=0.1)

#: Largest distance from the target of a success [m], as of a hit in studies.
HIT: Final = SteeringStudy().hit_radius

_FPS: Final = {'render_fps': 2}


class _Needles:
    options = 'truth', 'target'

    def __init__(
        self,
        needle: str,
        depth: float,
        step_length: float,
        guide_limit: float,
        aside: float,
        prior: SteeringPrior,
        number: int,
    ) -> None:
        names = 'depth', 'step_length', 'guide_limit', 'aside'
        sizes = dict(zip(names, (depth, step_length, guide_limit, aside), strict=True))
        for name, value in sizes.items():
            checked(name, value, 'm', low=0.0, open_low=True)
        self._needle, steering, _ = find_needle(needle)
        reach = self._needle.length - steering.free_length
        if depth > reach:
            raise ParameterError(f'depth must be <= {reach:g} m with this needle, got {depth!r} m')
        checked('aside', aside, 'm', high=self._needle.length)
        self._steering = replace(
            steering, path_noise=prior.path_noise, path_noise_length=prior.path_noise_length
        )
        self._depths, self._number = step_depths(depth, step_length), number
        self._prior, self._limit, self._aside = prior, guide_limit, aside
        self.action_space = spaces.Box(-1.0, 1.0, (2,))
        self.observation_space = spaces.Box(-BOUND, BOUND, (7,))
        self._allocate(self._needle, self._steering)

    def _allocate(self, needle: NeedleParameters, steering: SteeringParameters) -> None:
        """Allocate needles like this one; it is the nominal one of the population."""
        nominal = steered(needle, with_bevel(steering, 1.0))
        n, prior = self._number, self._prior
        depth, layers, points = self._depths[-1], len(nominal.starts), len(self._depths)
        cells = ceil(depth / nominal.cell) + 2
        self._replaced, spreads = needle is not self._needle, np.zeros(0)
        if prior.layer_spread and not self._replaced:
            spreads = by_layer('prior.layer_spread', prior.layer_spread, layers)
        self._needles = SteeredNeedles(
            population=Population(
                nominal=nominal._replace(element=min(steering.element, nominal.cell)),
                free=steering.free_length,
                spread=prior.spread,
                layers=spreads,
                tilt=prior.tilt,
                frame=prior.frame,
                bevel=prior.bevel,
                noise=prior.noise,
                keep=exp(-nominal.cell / steering.path_noise_length),
                turn=sqrt(steering.path_noise / (2.0 * steering.path_noise_length)),
                aside=self._aside,
                limit=self._limit,
            ),
            depths=self._depths,
            constants=np.zeros((n, 6)),
            layers=np.zeros((n, 3, layers)),
            wander=np.zeros((n, cells, 2)),
            lanes=np.zeros((ceil(n / LANES), ROWS * LANES)),
            scratch=empty_cut(0.0, 1.0, 0),
            frame=np.zeros((n, 2)),
            noise=np.zeros((n, points, 2)),
            targets=np.zeros((n, 2)),
            steps=np.zeros(n, dtype=np.int64),
        )
        self._boxed = Boxed(self._needles)
        rows = CAUSES + points + cells + len(spreads)
        self._uniform, self._normal = np.zeros((n, 4)), np.zeros((n, rows, 2))

    def begin(
        self, which: BoolArray, rngs: Sequence[np.random.Generator], options: Mapping[str, Any]
    ) -> None:
        truth = options.get('truth')
        if truth is not None:
            self._allocate(truth.needle, truth.steering)
        elif self._replaced:
            self._allocate(self._needle, self._steering)
        for k in np.flatnonzero(which).tolist():
            rngs[k].random(out=self._uniform[k])
            rngs[k].standard_normal(out=self._normal[k])
        sample(self._boxed, which, self._uniform, self._normal)
        if truth is not None:
            self._place(0, truth)
        if 'target' in options:
            target, length = checked_target(options['target']), self._needle.length
            if np.abs(target).max() > length:
                raise ParameterError(
                    f'target must be in [-{length:g}, {length:g}] m, the length of the needle, '
                    f'got {target.tolist()}'
                )
            self._needles.targets[:] = target

    def _place(self, k: int, truth: GroundTruth) -> None:
        """Replace needle k, and place it on the skin."""
        n, constants = self._needles, steered(truth.needle, truth.steering)
        n.constants[k] = constants[:6]
        n.layers[k] = constants.starts, constants.stiffness, constants.bevel
        n.wander[k] = 0.0
        if truth.steering.path_noise > 0.0:
            n.wander[k] = wandering(truth.needle, truth.steering, truth.seed)[: n.wander.shape[1]]
        n.frame[k] = truth.frame
        begin(self._boxed, k, np.array(truth.tilt), atan2(*truth.bevel))

    def step(self, actions: FloatArray, which: BoolArray) -> tuple[FloatArray, Any]:
        return steer(self._boxed, actions, which)

    def observe(self) -> FloatArray:
        found, self._tips = observe(self._boxed)
        return np.asarray(found)

    def info(self, ends: Any) -> dict[str, Any]:
        miss = self._tips[:, 2]
        return {'tip': self._tips[:, :2], 'miss': miss, 'is_success': (ends > 0) & (miss <= HIT)}

    def picture(self, k: int) -> Any:
        group, lane = divmod(k, LANES)
        depth, deepest = self._needles.lanes[group, DEPTH + lane], float(self._depths[-1])
        target = deepest, self._needles.targets[k, 1]
        return picture(1.1 * deepest, self._limit, (depth, self._tips[k, 1]), target)


class SteeringEnv(NeedleEnv):
    """
    Steer the tip to a target in steps of a needle; needle, tissue and target are sampled.

    ``needle`` is as for `find_needle`, ``depth`` of the target, ``step_length``, and the
    limits of guide and target (``aside``) along x and z in m, ``prior`` the distribution of the
    needles. The action is the position of the guide for the next step, as a fraction of its limit.
    The observation is the depth over the target depth, and as fractions of the guide limit the
    measured tip, the target and the guide, each x and z. The reward at the end is the negative
    distance of the tip from the target [mm], before it is 0. Info: ``tip``, the true tip in x and
    z [m]; ``miss``, its distance from the target in this plane [m]; ``is_success``, whether the
    episode has ended within 1 mm of the target. Images show the plane of z.

    Options of `reset`: ``truth``, a `GroundTruth`, and ``target``, x and z [m].
    """

    metadata: ClassVar[dict[str, Any]] = {**NeedleEnv.metadata, **_FPS}

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
        needles = _Needles(needle, depth, step_length, guide_limit, aside, prior, 1)
        super().__init__(needles, render_mode)


class SteeringVectorEnv(NeedleVectorEnv):
    """Needles as in `SteeringEnv`, each with its own seed, for up to `max_episode_steps`."""

    metadata: ClassVar[dict[str, Any]] = {**NeedleVectorEnv.metadata, **_FPS}

    def __init__(
        self,
        num_envs: int = 1,
        needle: str = DEFAULT_NEEDLE,
        *,
        depth: float = 0.1,
        step_length: float = SIMULATION_LIMITS.step_length,
        guide_limit: float = SIMULATION_LIMITS.guide_limit,
        aside: float = 4e-3,
        prior: SteeringPrior = PRIOR,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        needles = partial(_Needles, needle, depth, step_length, guide_limit, aside, prior)
        super().__init__(num_envs, needles, render_mode, max_episode_steps)
