# SPDX-License-Identifier: Apache-2.0
"""Friction that the terms do not describe at constant speeds is named, and no other friction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
import re
from typing import Any

from needle_dynamics import FloatArray
from needle_identification import FrictionEstimate, FrictionSettings, identify_friction, Recording
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import lfilter

RATE = 250.0
SPEEDS = (2e-3, 5e-3, 10e-3, 20e-3, 40e-3)
ACCELERATION, LENGTH, REST, NOISE = 0.15, 0.03, 0.5, 0.02
COULOMB, VISCOUS, EXCESS = 0.5, 80.0, 0.3
MISFIT = 'do not describe the friction at constant speeds'

#: Friction [N] at a speed [m/s].
Law = Callable[[FloatArray], FloatArray]


def straight(speed: FloatArray) -> FloatArray:
    return COULOMB + VISCOUS * speed


def root(speed: FloatArray) -> FloatArray:
    return COULOMB + 15.0 * np.sqrt(speed)


def stribeck(turn: float) -> Law:
    return lambda speed: straight(speed) + EXCESS * np.exp(-((speed / turn) ** 2))


@cache
def motion(order: tuple[float, ...]) -> FloatArray:
    """Return the velocity [m/s] of strokes there and back with constant acceleration."""
    rows = [np.zeros(round(REST * RATE))]
    for speed in order:
        rise = np.arange(0.0, speed, ACCELERATION / RATE)
        cruise = np.full(round((LENGTH / speed - speed / ACCELERATION) * RATE), speed)
        stroke = np.concatenate([rise, cruise, rise[::-1]])
        rows += [stroke, rows[0], -stroke, rows[0]]
    return np.concatenate(rows)


def trapezoids(law: Law, seed: int, *, memory: float = 0.0, rounds: int = 1) -> Recording:
    """Record strokes; noise of the force with a correlation time [s]."""
    rng = np.random.default_rng(seed)
    velocity = motion(tuple(s for _ in range(rounds) for s in rng.permutation(SPEEDS).tolist()))
    noise = rng.normal(scale=NOISE, size=len(velocity))
    if memory:
        kept = np.exp(-1.0 / RATE / memory)
        noise = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], noise)
    return Recording(
        name='trapezoids',
        time=np.arange(len(velocity)) / RATE,
        depth=0.1 + np.cumsum(velocity) / RATE,
        velocity=velocity,
        force=np.sign(velocity) * law(np.abs(velocity)) + noise,
    )


def settings(*terms: str, **changes: Any) -> FrictionSettings:
    return FrictionSettings(terms=('coulomb', 'viscous', *terms), **changes)


def holds(found: FrictionEstimate, **truths: float) -> bool:
    return all(found[n].interval[0] <= t <= found[n].interval[1] for n, t in truths.items())


def has_remark(found: FrictionEstimate) -> bool:
    return any(MISFIT in words for words in found.warnings)


def shown_speed(found: FrictionEstimate) -> float:
    """Return the Stribeck speed [m/s] of the advice."""
    [speed] = re.findall(r'--stribeck-speed (\S+)mm/s', ' '.join(found.warnings))
    return 1e-3 * float(speed)


@pytest.mark.parametrize('turn', [3e-3, 5e-3, 10e-3])
def test_the_advice_names_the_stribeck_speed(turn: float) -> None:
    held = 0
    for seed in range(5):
        recording = trapezoids(stribeck(turn), seed)
        found = identify_friction(recording)
        assert has_remark(found)
        assert any('add the term stribeck' in words for words in found.warnings)
        assert not any('consider' in w or 'the noise' in w for w in found.warnings)
        speed = shown_speed(found)
        # Five times the scatter of the speed, at least.
        assert_allclose(speed, turn, rtol=0.05)
        taken = identify_friction(recording, settings('stribeck', stribeck_speed=speed))
        assert not any('--stribeck-speed' in words for words in taken.warnings)
        held += holds(taken, coulomb_friction=COULOMB, viscous_friction=VISCOUS)
    # 95 % of 5 less three standard deviations.
    assert held >= 3


def test_another_stribeck_speed_that_fits_better_is_named() -> None:
    recording = trapezoids(stribeck(3e-3), 0)
    found = identify_friction(recording, settings('stribeck'))
    assert_allclose(shown_speed(found), 3e-3, rtol=0.05)
    # A given speed is kept.
    assert shown_speed(identify_friction(recording, settings(stribeck_speed=6e-3))) == 6e-3


def test_a_root_of_the_speed_is_not_two_constants() -> None:
    for seed in range(3):
        found = identify_friction(trapezoids(root, seed))
        assert has_remark(found)
        assert not any('consider' in w or 'the noise' in w for w in found.warnings)
        assert [test.name for test in found.tests] == ['speed']


@pytest.mark.parametrize(
    ('term', 'memory', 'offset', 'withdrawal'),
    [
        ('', 0.0, 0.0, 1.0),
        ('', 0.3, 0.0, 1.0),
        ('', 3.0, 0.0, 1.0),
        ('', 0.0, 0.2, 1.3),
        ('offset', 0.0, 0.2, 1.0),
        ('direction', 0.0, 0.0, 1.3),
    ],
    ids=['white', '0.3 s', '3 s', 'offset and direction missing', 'offset', 'direction'],
)
def test_straight_friction_has_no_remark(
    term: str, memory: float, offset: float, withdrawal: float
) -> None:
    """Also not with one stroke for each speed and direction."""
    remarks = 0
    for seed in range(10):
        made = trapezoids(straight, seed, memory=memory, rounds=1 + seed % 2)
        more = np.where(made.velocity < 0.0, withdrawal - 1.0, 0.0)
        more *= COULOMB * np.sign(made.velocity) + VISCOUS * made.velocity
        recording = replace(made, force=made.force + more + offset)
        remarks += has_remark(identify_friction(recording, settings(*filter(None, [term]))))
    # 1e-4 of 60 recordings.
    assert remarks == 0
