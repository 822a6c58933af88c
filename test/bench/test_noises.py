# SPDX-License-Identifier: Apache-2.0
"""Noise simulator and damaged files: generated data and reports."""

from __future__ import annotations

from pathlib import Path

from benchmarks import damage, noises
from benchmarks.noises import FURTHER, LINES, NoiseKind, recorded
from needle_identification import identify_friction, read_friction_recording
from needle_ros.process_pool import processes
import numpy as np
from numpy.testing import assert_allclose
import pytest


def test_force_without_noise_equals_ground_truth() -> None:
    kind = NoiseKind(white=0.0, position_counts=0.0)
    recording, truth = recorded(kind, np.random.default_rng(0))
    moving = np.abs(recording.velocity) > 0.0
    expected = truth['coulomb_friction'] * np.sign(recording.velocity)
    expected += truth['viscous_friction'] * recording.velocity
    assert_allclose(recording.force[moving], expected[moving], rtol=1e-12)
    # The trapezoidal rule is exact for piecewise linear velocity, except at its corners.
    assert_allclose(np.gradient(recording.depth, recording.time), recording.velocity, atol=1e-3)


@pytest.mark.parametrize('name', ['AR(1), 20 ms', 'AR(1), 0.2 s', 'AR(1), 1 s'])
def test_colored_noise_has_configured_correlation_time(name: str) -> None:
    kind = LINES[name].kind
    noise = noises._noise(kind, np.random.default_rng(0), 500_000)
    later = round(kind.memory * kind.rate)
    alike = np.mean(noise[:-later] * noise[later:]) / (np.var(noise) - kind.white**2)
    # Mean of 500,000 products of noise with a correlation length of at most 250 samples.
    assert abs(alike - np.exp(-1.0)) < 0.1


def test_table_has_row_for_each_noise_and_bars() -> None:
    sections, bars = noises.compare(print, recordings=2, seed=1)
    assert [[row[0] for row in one.rows] for one in sections] == [list(LINES), list(FURTHER)]
    figures = {bar.figure: bar for bar in bars}
    assert figures['largest share of false advice'].limit == 2.0
    assert figures['lowest coverage of mu_s and mu_v'].at_least


def test_all_file_formats_contain_same_recording(tmp_path: Path) -> None:
    found = {
        form: identify_friction(read_friction_recording(path))['viscous_friction'].value
        for form, path in damage.forms(tmp_path).items()
    }
    assert len(found) == 6
    # Seven digits of the table.
    assert_allclose(list(found.values()), found['mcap, zstd'], rtol=1e-5)


def test_damaged_recordings_are_read_or_rejected() -> None:
    # In a separate process, because memory is measured.
    with processes(1) as pool:
        [section], bars = pool.submit(damage.compare, print, files=120, seed=3).result()
    assert sum(int(count) for row in section.rows for count in row[2:]) == 120
    assert all(not bar.missed for bar in bars), (bars, section.notes)
