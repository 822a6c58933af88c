# SPDX-License-Identifier: Apache-2.0
"""Friction from all samples: also those whose filter window reaches a reversal."""

from __future__ import annotations

from needle_dynamics import FloatArray
from needle_identification import (
    FrictionEstimate,
    FrictionSettings,
    IdentificationError,
    identify_friction,
    Recording,
)
from needle_ros.errors import ParameterError
import numpy as np
from numpy.testing import assert_allclose
import pytest

RATE = 1000.0
TRUTH = {'coulomb_friction': 0.5, 'viscous_friction': 20.0, 'moving_mass': 2.0}
TERMS = ('coulomb', 'viscous', 'inertia')


def recorded(frequency: float, seed: int, presliding: float = 0.0) -> Recording:
    """Build 8 s of an oscillation; friction changes its sign over a displacement [m]."""
    time = np.arange(round(8.0 * RATE)) / RATE
    turns = 2.0 * np.pi * frequency * time
    # The modulation gives each stroke its own peak velocity.
    velocity = 0.03 * np.sin(turns) * (1.0 + 0.5 * np.sin(2.0 * time))
    sign = np.sign(velocity)
    if presliding:
        sign = gradual(velocity, presliding)
    noise = np.random.default_rng(seed).normal(scale=0.02, size=len(time))
    coulomb, viscous, mass = TRUTH.values()
    force = coulomb * sign + viscous * velocity + mass * np.gradient(velocity, time)
    depth = np.cumsum(velocity) / RATE
    return Recording(time=time, depth=depth, velocity=velocity, force=force + noise)


def gradual(velocity: FloatArray, presliding: float) -> FloatArray:
    """Return the friction of Dahl's model with the Coulomb friction 1."""
    state, found = 0.0, np.empty_like(velocity)
    for k, step in enumerate((velocity / RATE / presliding).tolist()):
        target = np.sign(step)
        state = target + (state - target) * np.exp(-abs(step))
        found[k] = state
    return found


def identified(recording: Recording, *, reversals: bool = True) -> FrictionEstimate:
    return identify_friction(recording, FrictionSettings(terms=TERMS, reversals=reversals))


@pytest.mark.parametrize('frequency', [1.037, 5.037, 12.037])
def test_intervals_of_all_samples_have_their_coverage(frequency: float) -> None:
    """At 12 Hz every sample is within the filter window of a reversal; none is at one."""
    found = [identified(recorded(frequency, seed)) for seed in range(60)]
    inside = [
        one[name].interval[0] <= truth <= one[name].interval[1]
        for one in found
        for name, truth in TRUTH.items()
    ]
    # 95 % less three standard deviations of 60 independent recordings.
    assert np.mean(inside) >= 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / 60.0)
    # One warning in 10,000 recordings.
    assert sum(any('reversals' in line for line in one.warnings) for one in found) == 0


def test_samples_at_reversals_determine_what_others_do_not() -> None:
    recording = recorded(12.037, 0)
    with pytest.raises(IdentificationError, match='steady motion'):
        identified(recording, reversals=False)
    few, more = (identified(recorded(5.037, 0), reversals=one) for one in (False, True))
    assert more.samples > 1.5 * few.samples
    assert all(more[name].error < few[name].error for name in TRUTH)


def test_gradual_change_of_the_sign_is_named() -> None:
    """Presliding over 0.1 mm, of strokes of 2 to 3 mm."""
    found = identified(recorded(5.037, 0, 1e-4))
    assert any('presliding' in line for line in found.warnings)


def test_rest_is_no_reversal() -> None:
    """The sign of friction is unknown at rest: both settings use the same samples."""
    stroke = 0.02 * np.sin(np.linspace(0.0, np.pi, 500))
    velocity = np.tile(np.concatenate([stroke, np.zeros(200), -stroke, np.zeros(200)]), 6)
    time = np.arange(len(velocity)) / RATE
    force = 0.5 * np.sign(velocity) + 20.0 * velocity + 2.0 * np.gradient(velocity, time)
    force += np.random.default_rng(0).normal(scale=0.02, size=len(time))
    depth = np.cumsum(velocity) / RATE
    recording = Recording(time=time, depth=depth, velocity=velocity, force=force)
    few, more = (identified(recording, reversals=one) for one in (False, True))
    assert more.samples == few.samples
    values, others = ([x.value for x in one.parameters] for one in (few, more))
    # The filtered sign is rounded.
    assert_allclose(values, others, rtol=1e-9)


@pytest.mark.parametrize(
    'terms', [('coulomb', 'viscous'), (*TERMS, 'stribeck'), (*TERMS, 'direction')]
)
def test_reversals_need_inertia_and_linear_terms(terms: tuple[str, ...]) -> None:
    with pytest.raises(ParameterError, match='reversals needs the term inertia'):
        FrictionSettings(terms=terms, reversals=True)
