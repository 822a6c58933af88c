# SPDX-License-Identifier: Apache-2.0
"""Steps per second of the Gymnasium environments, compared with two built-in environments."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

from benchmarks.measure import Bar, least_times, number
from benchmarks.page import Answer, PageSection, Tick
import gymnasium

#: Environments of the suite, and two of classic control.
NAMES: Final = (
    'needle_study.gym:NeedleInsertion-v0', 'needle_study.gym:NeedleSteering-v0',
    'CartPole-v1', 'Pendulum-v1',
)  # fmt: skip

#: Size of a vector environment.
MANY: Final = 64

#: Steps per turn, of a single and of a vector environment: several episodes.
STEPS: Final = {'single': 1000, 'vector': 100}

_REPEATS: Final = {'default': 10, 'quick': 1}


def steps(environment: Any, actions: list[Any]) -> None:
    """Take steps in an environment, with a reset after each episode."""
    environment.reset()
    for action in actions:
        _, _, over, late, _ = environment.step(action)
        if over or late:
            environment.reset()


def vector_steps(environments: Any, actions: list[Any]) -> None:
    """Take steps in a vector environment, which resets automatically."""
    environments.reset()
    for action in actions:
        environments.step(action)


def compare(tick: Tick, plan: str = 'default') -> Answer:
    """Take random actions in single and vector environments."""
    tick('environments')
    jobs: dict[str, Callable[[], object]] = {}
    for name in NAMES:
        one, many = gymnasium.make(name), gymnasium.make_vec(name, num_envs=MANY)
        for kind, environment, take in (('single', one, steps), ('vector', many, vector_steps)):
            environment.reset(seed=1)
            environment.action_space.seed(1)
            actions = [environment.action_space.sample() for _ in range(STEPS[kind])]
            jobs[f'{name} {kind}'] = partial(take, environment, actions)
    times = least_times(jobs, _REPEATS[plan])
    rows, ratios = [], {}
    for name in NAMES:
        single = STEPS['single'] / times[f'{name} single']
        many_at_once = MANY * STEPS['vector'] / times[f'{name} vector']
        ratios[name] = many_at_once / single
        rates = map(number, (single, many_at_once, ratios[name]))
        rows.append((name.rpartition(':')[2], *rates))
    section = PageSection(
        'Environments of Gymnasium: steps per second',
        ('environment', 'one', f'{MANY} at once', 'ratio'),
        rows,
        'One core, random actions, with resets, least time of all rounds. `gymnasium.make` and '
        '`gymnasium.make_vec` make them with their defaults: `Pendulum-v1` has no vector form of '
        'its own, and is taken one by one. A step of `NeedleInsertion-v0` is 10 ms of a needle '
        'with its modes, and one of `NeedleSteering-v0` is 5 mm of a beam in tissue.',
    )
    bar = Bar(f'{MANY} steered needles over one', ratios[NAMES[1]], 10.0, 'x', at_least=True)
    return [section], [bar]
