# SPDX-License-Identifier: Apache-2.0
"""Trivial policies and a controller in `NeedleInsertion-v0`, on the same needles."""

from __future__ import annotations

from functools import partial
from typing import Final

from benchmarks.episodes import Policy, ready, total_rewards
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import FloatArray, NeedleParameters
from needle_dynamics.arrays import BoolArray
from needle_study.gym.insertion import InsertionVectorEnv
from needle_study.gym.pushed import EFFORT, FORCE, NEAR, PERIOD, START, TIME, UNITS, WAY
import numpy as np

#: Name of the controller.
EXPERT: Final = 'nominal model'

#: Gains of proportional policies: action per error in dm.
GAINS: Final = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)

_NEEDLES: Final = {'default': 1000, 'quick': 20}


def expert(observations: FloatArray, _running: BoolArray) -> FloatArray:
    """
    Return actions from the nominal friction, shape (n, 1).

    The force balances friction at a velocity: the one that costs the least reward for a distance,
    or less near the target, so that the target is reached after one period. Near enough to arrive,
    the force ends if the rest of the way is worth less than another period.
    """
    p = NeedleParameters.preset('phantom')
    error = UNITS[0] * observations[:, :1].astype(np.float64)
    # Least (TIME + EFFORT a^2) / velocity over a, with a velocity of (FORCE a - dry) / viscous.
    dry = p.coulomb_friction
    cheapest = (dry + np.sqrt(dry**2 + TIME / EFFORT * FORCE**2)) / FORCE
    reached = (dry + p.viscous_friction * np.abs(error) / PERIOD) / FORCE
    action = np.sign(error) * np.minimum(reached, cheapest)
    whole = error + UNITS[2] * observations[:, 2:3] - START
    worth = WAY * np.abs(error / whole) + TIME + EFFORT * action**2
    return np.asarray(np.where((np.abs(error) < 0.9 * NEAR) & (worth < 0.0), 0.0, action))


def policies(number: int) -> dict[str, Policy]:
    """Return the policies by name, for a number of needles."""
    rng = np.random.default_rng(1)

    def constant(action: float, _: FloatArray, _running: BoolArray) -> FloatArray:
        return np.full((number, 1), action)

    def proportional(gain: float, observations: FloatArray, _running: BoolArray) -> FloatArray:
        return np.asarray(np.clip(gain * observations[:, :1], -1.0, 1.0))

    return {
        EXPERT: expert,
        'stay': partial(constant, 0.0),
        'leave': partial(constant, -1.0),
        'push': partial(constant, 1.0),
        'random': lambda _, _running: rng.uniform(-1.0, 1.0, (number, 1)),
        **{f'gain {gain:g}': partial(proportional, gain) for gain in GAINS},
    }


def returns(number: int) -> dict[str, FloatArray]:
    """Return the sum of rewards of an episode for each seed from 0 and each policy, by name."""
    return {
        name: total_rewards(InsertionVectorEnv(number), partial(ready, policy))
        for name, policy in policies(number).items()
    }


def compare(tick: Tick, plan: str = 'default') -> Answer:
    """Compare the sums of rewards of all policies."""
    tick('policies')
    totals = returns(_NEEDLES[plan])
    best = totals[EXPERT]
    rows, worse = [], 0.0
    for name, values in totals.items():
        part = float((values >= best).mean()) if name != EXPERT else 0.0
        worse = max(worse, part)
        low, high = np.quantile(values, [0.05, 0.95])
        rows.append(
            (name, f'{values.mean():.3f}', f'{low:.3f}', f'{high:.3f}', f'{100.0 * part:.3g} %')
        )
    section = PageSection(
        'NeedleInsertion-v0: sums of rewards',
        ('policy', 'mean', '5 %', '95 %', 'at least the nominal model'),
        rows,
        f'{len(best)} needles, seeds from 0, without discount. *Nominal model* balances friction '
        'of the preset, of which the needles differ by up to 30 %. *Gain* is the action per dm '
        'of error.',
    )
    bar = Bar('needles for which a trivial policy earns as much', 100.0 * worse, 0.0, '%')
    return [section], [bar]
