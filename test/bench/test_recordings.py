# SPDX-License-Identifier: Apache-2.0
"""Steering and identification on recorded insertions, here on tables that the test writes."""

from __future__ import annotations

from collections.abc import Sequence
import csv
from dataclasses import replace
import json
from pathlib import Path

from benchmarks.recordings.__main__ import main
from benchmarks.recordings.folder import read_folder, read_insertion
from benchmarks.recordings.plants import (
    BeamMedium,
    disturbance_of,
    FREE,
    Medium,
    recorded_plant,
    ResponseMedium,
)
from benchmarks.recordings.replay import figures, follow, LAWS, replay, ReplaySettings
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray, SteeredNeedle, SteeringParameters
from needle_dynamics.needles import NEEDLES
from needle_dynamics.steering.parameters import tissue_of
from needle_identification import RecordingError, SteeringRecording
from needle_identification.steering.search import predict, Prediction, rms_of, Search, Tips
from needle_ros.errors import ParameterError
import numpy as np
import pytest

_HEAD = (
    'Timestamp sec', 'Tip x', 'Tip y', 'Tip z', 'Base x', 'Base y', 'Base z', 'Base sec',
    'Base nanosec', 'Robot x',
)  # fmt: skip
_STEPS = 20
_DEPTHS = np.linspace(0.0, 0.1, _STEPS + 1)
_LENGTH, _TILT = 0.03, (0.03, -0.02)

#: The tables have six digits after the point [mm].
_ROUNDING = 1e-9


def _insertion(seed: int, *, moves: bool = True) -> tuple[FloatArray, FloatArray]:
    """Simulate guide and tip (n + 1, 2) [m] of a needle in steps; the guide moves first."""
    rng = np.random.default_rng(seed)
    guide = np.cumsum(rng.normal(0.0, 1e-3, (_STEPS + 1, 2)), axis=0) * moves
    guide -= guide[0]
    nominal = NEEDLES['phantom'].needle
    tissue = tissue_of(nominal.bending_stiffness, _LENGTH)
    needle = SteeredNeedle(
        replace(nominal, tissue_stiffness=tissue), SteeringParameters(free_length=FREE), tilt=_TILT
    )
    tips = [needle.tip[[0, 2]]]
    for depth, to in zip(_DEPTHS[1:].tolist(), guide[1:], strict=True):
        needle.move(guide=to)
        needle.move(depth=depth)
        tips.append(needle.tip[[0, 2]])
    return guide, np.array(tips)


def _write(path: Path, guide: FloatArray, tip: FloatArray, frozen: int = _STEPS + 1) -> None:
    """Write a table with rows before the first step and four rows a step, in mm."""
    with path.open('w', newline='', encoding='utf-8') as file:
        table = csv.writer(file)
        table.writerow(_HEAD)
        table.writerow([0.0, 1.0, 2.0, 3.0, 0, 0, 0, 0, 0, 0.0])
        for k, depth in enumerate(_DEPTHS.tolist()):
            x, z = (1e3 * tip[min(k, frozen)] + [-20.0, 20.0]).tolist()
            b, d = (1e3 * guide[k] + [-25.0, 22.0]).tolist()
            for row in range(4):
                # Only the first row of a step counts: then guide and needle move on.
                off = 0.3 * row * (k < frozen)
                at = [f'{value:.6f}' for value in (x + off, -1e3 * depth, z - off)]
                base = [f'{b:.6f}', f'{-1e3 * depth:.6f}', f'{d:.6f}', 1666031078 + k, 500]
                table.writerow([4 * k + row, *at, *base, 0.0])


def _folder(folder: Path, seeds: Sequence[int]) -> Path:
    """Write tables of one medium, the first with a fixed guide."""
    for k, seed in enumerate(seeds):
        _write(folder / f'gel_{k:02d}.csv', *_insertion(seed, moves=k > 0))
    return folder


@pytest.fixture(scope='module')
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[SteeringRecording]:
    """Six recordings of one medium."""
    folder = _folder(tmp_path_factory.mktemp('tables'), range(6))
    return read_folder(folder).media['gel']


def test_steps_of_a_table_are_its_first_rows(tmp_path: Path) -> None:
    guide, tip = _insertion(1)
    _write(tmp_path / 'liver_part_03.csv', guide, tip)
    found = read_insertion(tmp_path / 'liver_part_03.csv')
    assert found.medium == 'liver_part'
    np.testing.assert_allclose(found.depth, _DEPTHS, atol=_ROUNDING)
    np.testing.assert_allclose(found.guide, guide, atol=_ROUNDING)
    np.testing.assert_allclose(found.tip, tip - tip[0], atol=_ROUNDING)


def test_frozen_and_short_recordings_are_left_out(tmp_path: Path) -> None:
    _folder(tmp_path, range(2))
    _write(tmp_path / 'gel_09.csv', *_insertion(9), frozen=12)
    (tmp_path / 'gel_10.csv').write_text(
        ''.join((tmp_path / 'gel_01.csv').read_text('utf-8').splitlines(keepends=True)[:50])
    )
    media, left_out = read_folder(tmp_path)
    assert len(media['gel']) == 2
    frozen, short = left_out
    assert 'frozen sensor' in frozen
    assert '11 steps, at least 20' in short


def test_number_and_media_are_selected(tmp_path: Path) -> None:
    _folder(tmp_path, range(4))
    found = read_folder(tmp_path, ['gel'], 1).media['gel']
    # One with a fixed and one with a moving guide.
    assert [Path(one.name).name for one in found] == ['gel_00.csv', 'gel_01.csv']
    with pytest.raises(ParameterError, match='no insertion in liver'):
        read_folder(tmp_path, ['liver'])


def test_table_without_a_column_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / 'gel_00.csv'
    path.write_text('Tip x,Base x,Base y,Base z\n1,3,4,5\n', encoding='utf-8')
    with pytest.raises(RecordingError, match='no column found for tip_z'):
        read_insertion(path)


@pytest.mark.parametrize('of_plant', [BeamMedium, ResponseMedium])
def test_recorded_guide_repeats_the_recording(
    of_plant: type[BeamMedium | ResponseMedium], recordings: list[SteeringRecording]
) -> None:
    """The tip repeats the recording under its guide, and differs under another guide."""
    medium: Medium = of_plant.fit(recordings)
    one = recordings[-1]
    for factor in (1.0, -1.0):
        plant, tips = recorded_plant(medium, one), []
        for x, z in (factor * one.guide[1:]).tolist():
            tips.append(plant.tip)
            plant.guide(GuideSetpoint(x, z))
            plant.insert()
        off = np.abs(np.array([*tips, plant.tip]) - one.tip).max()
        assert plant.done
        # The same computation twice; the other guide is millimeters away.
        assert off < 1e-12 if factor > 0.0 else off > 1e-3


def test_beam_of_a_medium_is_found(recordings: list[SteeringRecording]) -> None:
    medium = BeamMedium.fit(recordings)
    # The fit has longer elements than the plant: 3 um in the tip.
    assert medium.length == pytest.approx(_LENGTH, rel=0.01)
    assert medium.tilt == pytest.approx(_TILT, rel=0.01)
    assert medium.rms < 5e-6
    # The offset of a recording is part of its disturbance.
    left = disturbance_of(medium, recordings[1])
    assert np.ptp(left, axis=0).max() < 2e-5


def test_response_is_found_without_a_model(recordings: list[SteeringRecording]) -> None:
    true = ResponseMedium(
        jumps=np.array([0.1, -0.2, -0.1, 0.2]),
        slopes=np.array([-20.0, -18.0, -10.0, -5.0]),
        drift=np.array([[0.05, 0.1], [-0.02, 0.3]]),
        rms=0.0,
    )
    made = []
    for one in recordings:
        tips = [true.tip(one.depth[: k + 1], one.guide[: k + 1]) for k in range(len(one.depth))]
        made.append(replace(one, tip=np.array(tips) + 1e-3))
    found = ResponseMedium.fit(made)
    np.testing.assert_allclose(found.jumps, true.jumps, atol=1e-9)
    np.testing.assert_allclose(found.slopes, true.slopes, atol=1e-7)
    np.testing.assert_allclose(found.drift, true.drift, atol=1e-7)


def test_laws_steer_a_medium_within_the_prior(recordings: list[SteeringRecording]) -> None:
    """Our law reaches the target and follows the recordings; a fixed guide does neither."""
    media = {'gel': recordings}
    fitted = {'gel': BeamMedium.fit(recordings)}
    settings = ReplaySettings()
    misses = {}
    for law in LAWS:
        found = figures(replay(media, fitted, settings, law))
        assert found['insertions'] == len(recordings)
        assert found['stopped'] == 0
        misses[law] = found['mean']
    # The bending length is a sixth below the nominal one, within the prior.
    assert misses['multi_hypothesis'] < 0.1
    assert misses['open_loop'] > 2.0
    for one in recordings:
        followed = follow(settings.model(one.depth), one)
        assert followed.stopped == ''
        assert followed.steps == _STEPS


def test_prediction_of_a_recording_that_is_not_fitted(recordings: list[SteeringRecording]) -> None:
    fitted = Search(Tips(recordings[:-1], 'guide first'), ('tilt',), None)
    best = fitted.optima()[0]

    def predicted(one: SteeringRecording) -> Prediction:
        search = Search(Tips([*recordings[:-1], one], 'guide first'), ('tilt',), None)
        return predict(search, fitted, best, 0, len(recordings) - 1)

    assert rms_of([predicted(recordings[-1]).errors]) < 1e-5
    # A recording of another medium is not predicted.
    wrong = predicted(replace(recordings[-1], tip=0.5 * recordings[-1].tip))
    assert rms_of([wrong.errors]) > 1e-4
    assert (np.abs(wrong.errors) > 2.0 * wrong.deviations).mean() > 0.5


def test_command_prints_tables_and_writes_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _folder(tmp_path, range(2))
    output = tmp_path / 'found.json'
    main([str(tmp_path), '-o', str(output)])
    printed = capsys.readouterr().out
    found = json.loads(output.read_text(encoding='utf-8'))
    assert {*found} == {'follow', 'steering', 'identification', 'left out'}
    [medium] = found['identification']
    low, high = medium['lambda']['interval']
    assert low <= _LENGTH <= high
    for title in ('Closed loop', 'Identification', 'Bars'):
        assert f'## {title}' in printed


def test_command_rejects_a_folder_without_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path)]) == 2
    assert 'has no insertion in any medium' in capsys.readouterr().err
