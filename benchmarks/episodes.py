# SPDX-License-Identifier: Apache-2.0
"""Sums of rewards in the environments, under the laws of the suite and other policies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeAlias

from gymnasium.vector import VectorEnv
from needle_controller import (
    build_law,
    Controller,
    ControllerSettings,
    Measurement,
    ReferenceLimits,
    SIMULATION_LIMITS,
    SteeringFaultError,
    SteeringModel,
)
from needle_controller.steering.settings import step_depths
from needle_dynamics import DEFAULT_NEEDLE, find_needle, FloatArray, NeedleParameters
from needle_dynamics.arrays import BoolArray
from needle_study.gym.pushed import FORCE, PERIOD, UNITS
import numpy as np

#: Limits of the reference of the control laws: about the cheapest velocity.
LIMITS: Final = ReferenceLimits(speed=0.028, acceleration=1.0)

#: Actions, shape (n, m), for observations of n needles, from the start of their episodes on, and a
#: mask of those whose episode has not ended; the actions of the others have no effect.
Policy: TypeAlias = Callable[[FloatArray, BoolArray], FloatArray]

#: Constructor of a policy from the first observations.
Maker: TypeAlias = Callable[[FloatArray], Policy]


def ready(policy: Policy, _first: FloatArray) -> Policy:
    """Return a policy that has no state, as a `Maker`."""
    return policy


class InsertionPolicy:
    """A control law for each needle, with the nominal needle as its model."""

    def __init__(self, law: str, first: FloatArray) -> None:
        needle = NeedleParameters.preset('phantom')
        settings = ControllerSettings(
            rate=1.0 / PERIOD, delay=0.0, force_limit=FORCE, rotation=False
        )
        self._time, self._loops = 0.0, list[Controller]()
        for error, _, depth, _ in first.astype(np.float64):
            loop = Controller(needle, law, settings=settings, limits=LIMITS)
            loop.set_target(float(UNITS[0] * error + UNITS[2] * depth))
            self._loops.append(loop)

    def __call__(self, observations: FloatArray, running: BoolArray) -> FloatArray:
        actions, seen = np.zeros((len(running), 1)), observations.astype(np.float64)
        for k in np.flatnonzero(running).tolist():
            depth, velocity = float(UNITS[2] * seen[k, 2]), float(UNITS[1] * seen[k, 1])
            output = self._loops[k].command(Measurement(self._time, depth, velocity))
            actions[k] = output.force / FORCE
        self._time += PERIOD
        return np.clip(actions, -1.0, 1.0)


class SteeringPolicy:
    """A steering law for each needle; the guide rests after a fault of the law."""

    def __init__(self, law: str, first: FloatArray) -> None:
        needle, steering, _ = find_needle(DEFAULT_NEEDLE)
        model = SteeringModel(needle, steering, step_depths(0.1, SIMULATION_LIMITS.step_length))
        self._limit = SIMULATION_LIMITS.guide_limit
        targets = self._limit * first[:, 3:5].astype(np.float64)
        self._laws = [build_law(law, model, target, SIMULATION_LIMITS) for target in targets]
        self._actions = np.zeros((len(first), 2))

    def __call__(self, observations: FloatArray, running: BoolArray) -> FloatArray:
        tips = self._limit * observations[:, 1:3].astype(np.float64)
        for k in np.flatnonzero(running).tolist():
            law = self._laws[k]
            try:
                law.update(tips[k], law.step)
            except SteeringFaultError:
                continue
            to = law.plan()
            self._actions[k] = np.array([to.x, to.z]) / self._limit
        return self._actions


def total_rewards(environments: VectorEnv[Any, Any, Any], make: Maker) -> FloatArray:
    """Return the sum of rewards of the first episode for each seed from 0, shape (n,)."""
    observations, _ = environments.reset(seed=0)
    policy = make(observations)
    running = np.ones(environments.num_envs, dtype=bool)
    totals = np.zeros(environments.num_envs)
    while running.any():
        actions = policy(observations, running)
        observations, rewards, over, late, _ = environments.step(actions)
        totals += np.where(running, rewards, 0.0)
        running &= ~(over | late)
    return totals
