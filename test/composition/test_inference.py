# SPDX-License-Identifier: Apache-2.0
"""Example of inference: simulation and summary statistics, without the optional package sbi."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import runpy
import sys

from needle_dynamics import FloatArray, NEEDLES, SteeredNeedle
import numpy as np
import pytest

EXAMPLE = runpy.run_path(str(Path(__file__).parents[2] / 'examples/inference.py'))


def drawn(count: int, **values: float) -> dict[str, FloatArray]:
    """Return plants of the population with some values fixed."""
    found: dict[str, FloatArray] = EXAMPLE['population'](count, seed=1)
    return {**found, **{name: np.full(count, value) for name, value in values.items()}}


def test_tip_measurements_equal_single_needles() -> None:
    """Without path noise, the difference is the noise of the averaged tip measurements."""
    quiet = {'path_noise': 0.0, 'bending_length': 1.0, 'skin': 1.0, 'bevel_x': 0.0, 'bevel_z': 0.3}
    seen = EXAMPLE['looks'](
        drawn(20, **quiet, tilt_x=0.0, tilt_z=0.01, frame_x=0.0, frame_z=0.02), 2
    )
    depths, layer, stiffer = (EXAMPLE[name] for name in ('DEPTHS', 'LAYER', 'STIFFER'))
    needle, steering, _ = NEEDLES['bending_35mm']
    k = needle.tissue_stiffness
    one = SteeredNeedle(
        replace(needle, layer_depths=(layer,), layer_stiffnesses=(stiffer * k,)),
        replace(steering, skin_stiffness=0.02 * k, bevel_load=(0.3,)),
        tilt=(0.0, 0.01),
    )
    for depth, guide, found in zip(depths, EXAMPLE['guides'](), seen.swapaxes(0, 1), strict=True):
        one.move(depth=float(depth), guide=guide)
        expected = one.tip[[0, 2]] + np.array([0.0, 0.02]) * depth
        # Mean of 20 averaged tip measurements: five standard errors.
        near = 5.0 * EXAMPLE['NOISE'] / np.sqrt(20.0)
        assert np.abs(found.mean(axis=0) - expected).max() < near


def test_same_seeds_give_the_same_tip_measurements() -> None:
    needles = drawn(5)
    assert np.array_equal(EXAMPLE['looks'](needles, 2), EXAMPLE['looks'](needles, 2))
    assert not np.array_equal(EXAMPLE['looks'](needles, 2), EXAMPLE['looks'](needles, 3))


def test_path_noise_increases_the_summary_of_curvature() -> None:
    """Over long distances the last values of the summary grow with the path noise."""
    still = {'tilt_x': 0.0, 'tilt_z': 0.0, 'frame_x': 0.0, 'frame_z': 0.0}
    summaries = [
        EXAMPLE['summary'](EXAMPLE['looks'](drawn(50, path_noise=noise, **still), 2))
        for noise in (1e-5, 1e-2)
    ]
    assert summaries[0].shape == (50, 24)
    # By 0.2, with a standard error of 0.03 for fifty needles.
    assert (summaries[1][:, -2:].mean(axis=0) > summaries[0][:, -2:].mean(axis=0) + 0.1).all()


def test_inferred_parameters() -> None:
    needles = drawn(4, bending_length=1.0, path_noise=1e-3)
    assert np.array_equal(EXAMPLE['unknown'](needles), np.tile([0.0, -3.0], (4, 1)))


def test_missing_sbi_gives_installation_instructions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'sbi', None)
    with pytest.raises(SystemExit, match='this example needs sbi: pip install sbi'):
        EXAMPLE['learn'](np.zeros((4, 2)), np.zeros((4, 24)))


def test_figure_shows_the_coverage_of_intervals() -> None:
    """For posterior samples from the ground truth the curve is near the diagonal."""
    rng = np.random.default_rng(1)
    truths, draws = rng.standard_normal((500, 2)), rng.standard_normal((200, 500, 2))
    ranks = np.mean(draws < truths, axis=0)
    figure = EXAMPLE['show'](truths, draws, ranks)
    for axes in (figure.axes[2], figure.axes[5]):
        levels, held = axes.lines[0].get_data()
        # Five standard errors at the middle.
        assert np.abs(held - levels).max() < 5.0 * 100.0 * np.sqrt(0.25 / 500)
