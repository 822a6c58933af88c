# SPDX-License-Identifier: Apache-2.0
"""Benchmark of identification: equality of the read data; times are not tested."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks import identification as bench_identification
from benchmarks import measure as bench_measure
from needle_identification import read_friction_recording
from needle_identification.bags.bag import message_counts
import numpy as np
from numpy.testing import assert_allclose
import pytest


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('bag') / 'strokes'
    bench_identification.write_bag(path, 5000)
    return path


def test_bag_contains_friction_of_its_generator(bag: Path) -> None:
    recording = read_friction_recording(bag)
    assert recording.losses == ()
    assert_allclose(np.diff(recording.time), 1.0 / 250.0, rtol=1e-6)
    # The velocity is the derivative of the insertion depth, to second order of the step.
    slope = np.gradient(recording.depth, recording.time)[1:-1]
    assert_allclose(slope, recording.velocity[1:-1], atol=2e-5)
    estimate = bench_identification.ours(bag)
    for name, true in (('coulomb_friction', 0.56), ('viscous_friction', 300.0)):
        # Five standard errors.
        assert abs(estimate[name].value - true) < 5.0 * estimate[name].error


def test_bag_has_requested_number_of_messages(tmp_path: Path) -> None:
    # More than a block of messages.
    bench_identification.write_bag(tmp_path / 'bag', 2**16 + 3)
    assert set(message_counts(tmp_path / 'bag').values()) == {2**16 + 3}


def test_rosbags_reads_same_numbers(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: dict[str, Any] = {}
    monkeypatch.setattr(bench_identification, '_arrays', taken.update)
    bench_identification.any_reader(bag)
    recording = read_friction_recording(bag)
    force = np.array(taken['/base_wrench'])
    motion = np.array(taken['/joint_states'])
    assert_allclose(force[:, 1], recording.force, rtol=0.0, atol=0.0)
    assert_allclose(motion[:, 1:].T, [recording.depth, recording.velocity], rtol=1e-12)


def test_mcap_ros2_support_reads_same_numbers(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('mcap_ros2.reader')
    taken: dict[str, Any] = {}
    monkeypatch.setattr(bench_identification, '_arrays', taken.update)
    bench_identification.mcap_ros2(bag)
    assert_allclose(np.array(taken['/base_wrench'])[:, 1], read_friction_recording(bag).force)


def test_separate_process_reports_time_and_memory(bag: Path) -> None:
    figures = bench_identification.measured('needle_identification', bag, bag)
    assert figures['seconds'] > 0.0
    # NumPy alone needs 10 MB.
    assert 1e7 < figures['before'] <= figures['memory'] < 1e10


def test_missing_readers_are_reported_and_others_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_identification, 'optional', lambda _name: None)
    monkeypatch.setattr(bench_identification, 'LONGER', (1, 2))
    asked = []

    def measured(reader: str, warm: Path, path: Path) -> dict[str, float]:
        asked.append((reader, path.name))
        speed = 1.0 if reader == 'needle_identification' else 4.0
        return {'seconds': speed, 'memory': 2e8, 'before': 1e8}

    monkeypatch.setattr(bench_identification, 'measured', measured)
    sections, bars = bench_identification.compare(lambda _stage: None, 3000)
    assert bench_measure.NOT_INSTALLED in str(sections[0])
    # The readers take turns.
    rounds = 3 * [
        ('needle_identification', 'times_1'),
        ('needle_identification, reading', 'times_1'),
        ('rosbags AnyReader', 'times_1'),
    ]
    assert asked == [
        *rounds,
        ('needle_identification', 'times_1'),
        ('needle_identification', 'times_2'),
    ]
    assert [bar.found for bar in bars] == [4.0, 1.0]
    assert [bar.verdict for bar in bars] == ['met', 'met']
