"""A needle whose guide steers its tip, as an environment of Gymnasium."""

from __future__ import annotations

from typing import Any, ClassVar, Final

import gymnasium
from gymnasium import spaces
from needle_controller import SteeringBelief
from needle_controller.steering.trial import drawn, Truth
from needle_dynamics import FloatArray, SteeredNeedle, STEERING_PRESETS
from needle_insertion.gym.pushed import BOUND
from needle_ros.errors import ParameterError
import numpy as np

#: What nobody knows of a needle, by default.
BELIEF: Final = SteeringBelief(tilt=0.02, frame=0.03, bevel=0.1)

#: Seeds of paths are below.
_SEEDS: Final = 2**63


class SteeringEnv(gymnasium.Env[FloatArray, FloatArray]):
    """
    Bring the tip to a target: one step of the needle for each action.

    Each episode has a needle of its own in tissue of its own, and a target. The action is where
    the guide goes before the needle goes on, in parts of its limit. The observation is what a
    robot and a tracker know: depth over that of the target, and in parts of the guide's limit the
    tip as it is seen, the target, and the guide, each x and z. The reward is the distance of the
    tip from the target at the end, in mm, with a minus.

    Parameters
    ----------
    needle : str
        A key of `STEERING_PRESETS`.
    depth, step : float
        Depth of the target, and way of a step [m].
    guide_limit : float
        Farthest position of the guide along x and z [m].
    aside : float
        Largest distance of the target from the axis, along x and z [m].
    belief : SteeringBelief
        How needles differ.

    Raises
    ------
    ParameterError
        If a value is not valid.

    """

    metadata: ClassVar[dict[str, Any]] = {'render_modes': []}

    def __init__(
        self,
        needle: str = 'bending_35mm',
        *,
        depth: float = 0.1,
        step: float = 5e-3,
        guide_limit: float = 6e-3,
        aside: float = 4e-3,
        belief: SteeringBelief = BELIEF,
    ) -> None:
        if needle not in STEERING_PRESETS:
            raise ParameterError(
                f'needle must be one of {", ".join(STEERING_PRESETS)}, got {needle!r}'
            )
        for name, value in (
            ('depth', depth), ('step', step), ('guide_limit', guide_limit), ('aside', aside),
        ):  # fmt: skip
            if not 0.0 < value < np.inf:
                raise ParameterError(f'{name} must be positive and finite, got {value!r} m')
        self._needle, self._steering, _ = STEERING_PRESETS[needle]
        reach = self._needle.length - self._steering.free_length
        if depth > reach:
            raise ParameterError(f'depth must be <= {reach:g} m with this needle, got {depth!r} m')
        self._depths = np.linspace(0.0, depth, max(1, round(depth / step)) + 1)
        self._limit, self._aside, self._belief = guide_limit, aside, belief
        self.action_space = spaces.Box(-1.0, 1.0, (2,))
        self.observation_space = spaces.Box(-BOUND, BOUND, (7,))
        self._truth: Truth | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """
        Begin an episode with another needle.

        Parameters
        ----------
        seed, options
            As in `InsertionEnv.reset`.

        Returns
        -------
        observation : ndarray, shape (7,)
            As the class says.
        info : dict
            Empty.

        """
        super().reset(seed=seed, options=options)
        rng = self.np_random
        self._truth = drawn(
            self._needle, self._steering, self._belief, rng, int(rng.integers(_SEEDS))
        )
        self._one, self._at = self._truth.start(), 0
        self._target = rng.uniform(-self._aside, self._aside, 2)
        return self._observe(self._truth, self._one), {}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """
        Move the guide, then the needle.

        Parameters
        ----------
        action : ndarray, shape (2,)
            Where the guide goes, in parts of its limit; what is beyond is cut.

        Returns
        -------
        observation : ndarray, shape (7,)
            As the class says.
        reward : float
            0 before the end.
        terminated : bool
            Whether the needle is at the depth of the target.
        truncated : bool
            False.
        info : dict
            At the end ``miss``, the distance of the tip from the target [m].

        """
        truth = self._truth
        if truth is None or self._at == len(self._depths) - 1:
            raise gymnasium.error.ResetNeeded('the episode is over, or none has begun: call reset')
        x, z = (self._limit * np.clip(action, -1.0, 1.0)).tolist()
        self._one.move(guide=(x, z))
        self._at += 1
        self._one.move(depth=float(self._depths[self._at]))
        seen = self._observe(truth, self._one)
        if self._at < len(self._depths) - 1:
            return seen, 0.0, False, False, {}
        miss = float(np.hypot(*(truth.tip(self._one) - self._target)))
        return seen, -1e3 * miss, True, False, {'miss': miss}

    def _observe(self, truth: Truth, one: SteeredNeedle) -> FloatArray:
        seen = truth.tip(one) + self._belief.noise * self.np_random.standard_normal(2)
        depth = one.depth / self._depths[-1]
        lengths = np.concatenate([seen, self._target, one.guide]) / self._limit
        numbers = np.clip(np.concatenate([[depth], lengths]), -BOUND, BOUND)
        return np.asarray(numbers, dtype=np.float32)
