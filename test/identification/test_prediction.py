# SPDX-License-Identifier: Apache-2.0
"""Prediction of recordings by others, and tissues that are no ideal spring."""

from __future__ import annotations

from dataclasses import replace
import re

from benchmarks.noises import NoiseKind, recorded
from needle_identification import (
    identify_friction,
    identify_stiffness,
    IndentationRecording,
    summarize,
    summarize_stiffness,
)
import numpy as np
from numpy.testing import assert_allclose
import pytest
from support.presses import presses, STIFFNESS


def test_recordings_that_differ_are_predicted_with_a_warning() -> None:
    made = [recorded(NoiseKind(), np.random.default_rng(seed)) for seed in (1, 2)]
    summary = summarize([identify_friction(recording) for recording, _ in made])
    (first, a), (_, b) = made
    assert summary.prediction is not None
    assert summary.prediction.rms > 2.0 * summary.prediction.residual
    # Each recording has its own mu_s and mu_v.
    off = [a[name] - b[name] for name in ('coulomb_friction', 'viscous_friction')]
    velocity = np.abs(np.gradient(first.depth, first.time))
    expected = np.abs(off[0] + off[1] * velocity[velocity > 1e-3]).mean()
    assert summary.prediction.rms == pytest.approx(expected, rel=0.3)
    assert any('predicted from the others' in words for words in summary.warnings)
    alike = summarize([identify_friction(replace(first, name=name)) for name in 'ab'])
    assert alike.prediction is not None
    assert alike.prediction.rms == pytest.approx(alike.prediction.residual, rel=1e-6)
    assert alike.warnings == ()


def test_axes_that_differ_by_a_rotation_are_reported() -> None:
    time, position, force = presses(3)
    angle = np.radians(10.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    recording = IndentationRecording(time=time, position=position, force=force @ turn.T)
    found = identify_stiffness(recording)
    for level, matrix in zip(found.levels, STIFFNESS.values(), strict=True):
        assert not level.is_spring
        own = np.arctan2(matrix[1, 0] - matrix[0, 1], np.trace(matrix))
        low, high = level.rotation.interval
        assert low < angle + own < high
        assert re.search(
            r'not a spring unless .* a rotation of [0-9.]+ ± [0-9.]+ deg', level.words
        )


@pytest.mark.parametrize('kind', ['creep', 'set'])
def test_intervals_contain_the_stiffness_of_a_tissue_with_memory(kind: str) -> None:
    """A tissue that creeps during a hold, or keeps a part of its deformation until it is left."""
    time, position, force = presses(4)
    step = time[1] - time[0]
    state = np.zeros(2)
    moved = position.copy()
    for k in range(1, len(time)):
        rate = step / 1.0 if kind == 'creep' else step / 0.5
        state = state + rate * (0.1 * position[k] - state)
        moved[k] = position[k] + state
    found = identify_stiffness(IndentationRecording(time=time, position=moved, force=force))
    assert any('creep' in words for words in found.warnings)
    for level, matrix in zip(found.levels, STIFFNESS.values(), strict=True):
        for name, value in (('k_xx', matrix[0, 0]), ('k_zz', matrix[1, 1])):
            low, high = level[name].interval
            assert low <= value <= high


def test_places_are_predicted_from_the_others() -> None:
    made = [
        IndentationRecording(name=f'{seed}', time=time, position=position * scale, force=force)
        for seed, scale in ((1, 1.0), (2, 1.2))
        for time, position, force in [presses(seed)]
    ]
    summary = summarize_stiffness([identify_stiffness(one) for one in made])
    for level in summary.levels:
        assert level.prediction is not None
        # A fifth of the force, per axis.
        assert_allclose(level.prediction.rms, 0.2 * level.force / np.sqrt(2.0), rtol=0.3)
    assert any('predicted from the others' in words for words in summary.warnings)
