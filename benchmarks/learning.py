# SPDX-License-Identifier: Apache-2.0
"""Laws of the suite and policies learned by PPO in the environments, on the same needles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple, TypeAlias

from benchmarks import learner
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.policies import EXPERT, expert
from gymnasium.vector import VectorEnv
from needle_controller import (
    Controller,
    ControllerSettings,
    LAWS,
    Measurement,
    ReferenceLimits,
    SIMULATION_LIMITS,
    STEERING_LAWS,
    SteeringFaultError,
    SteeringModel,
)
from needle_controller.steering.law import build_law
from needle_controller.steering.simulation import step_depths
from needle_dynamics import DEFAULT_NEEDLE, find_needle, FloatArray, NeedleParameters
from needle_dynamics.arrays import BoolArray
from needle_study.gym.insertion import InsertionVectorEnv
from needle_study.gym.pushed import FORCE, PERIOD, UNITS
from needle_study.gym.steering import PRIOR, SteeringVectorEnv
import numpy as np

#: Largest relative deviations of stiffness and friction from the nominal needle.
MISMATCHES: Final = (0.0, 0.5, 1.0)

#: Limits of the reference of the control laws: about the cheapest velocity.
LIMITS: Final = ReferenceLimits(speed=0.028, acceleration=1.0)

#: Steering laws without turns of the needle, ours first.
STEERED: Final = tuple(law for law in STEERING_LAWS if law != 'roll_to_target')

_NOTES: Final = {
    'NeedleInsertion-v0': 'Mean of {} needles, seeds from 0, and its 95 % interval. By column: '
    'largest deviation of Coulomb friction, viscous friction and tissue stiffness from the '
    'nominal needle, uniform and independent. The laws have the nominal needle as their model, '
    'and a reference of at most 28 mm/s and 1 m/s^2; *nominal model* is that of the study page. '
    'PPO of Stable-Baselines3 is trained with {} periods of other needles, with the nominal '
    'constants (0 %) or the largest deviation (100 %).',
    'NeedleSteering-v0': 'Mean of {} needles, seeds from 0, and its 95 % interval: the negative '
    'distance from the target [mm]. By column: largest stiffness of the tissue over the nominal '
    'one, less 1; friction has no effect on the lateral motion. Tilt, bevel, rotation of the '
    'sensor and path are sampled in all columns. The laws have the nominal needle as their model '
    'and their default prior. PPO is trained with {} steps of other needles.',
}

#: Standard normal quantile of a 95 % interval.
_NORMAL: Final = 1.96


class LearningPlan(NamedTuple):
    """Size of the benchmark."""

    needles: int  #: needles of each mean
    insertions: int  #: steps of training in `NeedleInsertion-v0`
    steerings: int  #: steps of training in `NeedleSteering-v0`


PLANS: Final = {
    'default': LearningPlan(1000, 1_500_000, 2_500_000),
    'quick': LearningPlan(20, 2 * 64 * learner.ROWS, 2 * 64 * learner.ROWS),
}


#: Actions, shape (n, m), for observations of n needles, from the start of their episodes on, and a
#: mask of those whose episode has not ended; the actions of the others have no effect.
Policy: TypeAlias = Callable[[FloatArray, BoolArray], FloatArray]

#: Constructor of a policy from the first observations.
Maker: TypeAlias = Callable[[FloatArray], Policy]

#: Constructor of environments with a mismatch and a number of needles.
Environments: TypeAlias = Callable[[float, int], VectorEnv[Any, Any, Any]]


def inserted(mismatch: float, needles: int) -> InsertionVectorEnv:
    """Return needles whose stiffness and friction deviate by up to the mismatch."""
    return InsertionVectorEnv(needles, spread=mismatch)


def steered(mismatch: float, needles: int) -> SteeringVectorEnv:
    """Return needles in tissue that is up to 1 + mismatch times as stiff as the nominal one."""
    # The stiffness is proportional to the bending length to the power of -4.
    return SteeringVectorEnv(needles, prior=replace(PRIOR, spread=1.0 - (1.0 + mismatch) ** -0.25))


def _ready(policy: Policy, _first: FloatArray) -> Policy:
    return policy


def _balanced(observations: FloatArray, _running: BoolArray) -> FloatArray:
    return expert(observations)


class Inserting:
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


class Steering:
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


def returns(environments: VectorEnv[Any, Any, Any], make: Maker) -> FloatArray:
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


def interval(values: FloatArray) -> tuple[float, float]:
    """Return the mean, and half the width of its 95 % interval."""
    return float(values.mean()), float(_NORMAL * values.std(ddof=1) / np.sqrt(len(values)))


def learned(tick: Tick, environments: Environments, steps: int) -> dict[str, Maker]:
    """Train on nominal needles, and on needles with the largest mismatch."""
    found: dict[str, Maker] = {}
    for mismatch in (MISMATCHES[0], MISMATCHES[-1]):
        name = f'PPO, trained at {100.0 * mismatch:g} %'
        tick(f'{name}: {steps} steps')
        policy = learner.train(partial(environments, mismatch), steps)
        found[name] = partial(_ready, policy)
    return found


def measured(
    tick: Tick, environments: Environments, makers: Mapping[str, Maker], needles: int
) -> dict[str, list[FloatArray]]:
    """Return the sums of rewards of each needle, by policy and mismatch."""
    found = dict[str, list[FloatArray]]()
    for name, make in makers.items():
        tick(name)
        found[name] = [returns(environments(each, needles), make) for each in MISMATCHES]
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
            {**{law: partial(Inserting, law) for law in LAWS}, EXPERT: partial(_ready, _balanced)},
            size.insertions,
        ),
        (
            'NeedleSteering-v0', 'mm', steered,
            {law: partial(Steering, law) for law in STEERED},
            size.steerings,
        ),
    )  # fmt: skip
    for title, unit, environments, laws, steps in cases:
        policies: dict[str, Maker] = {**laws, **learned(tick, environments, steps)}
        totals = measured(tick, environments, policies, size.needles)
        ours = next(iter(laws))
        sections += tables(title, totals, ours, _NOTES[title].format(size.needles, steps))
        for k, mismatch in enumerate(MISMATCHES):
            best = max(one[k].mean() for name, one in totals.items() if name not in laws)
            found = float(totals[ours][k].mean() - best)
            figure = f'{title}, {100.0 * mismatch:g} %: {ours} less the best learned policy'
            bars.append(Bar(figure, found, 0.0, unit, at_least=True))
    return sections, bars
