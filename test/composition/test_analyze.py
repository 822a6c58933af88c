# SPDX-License-Identifier: Apache-2.0
"""Output, written files and error messages of `needle analyze`."""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
import re
from typing import Any

from matplotlib.image import imread
from needle_dynamics import analyze, linearize, NeedleError, NeedleModel, NeedleParameters
from needle_dynamics.linearization import operating_point
from needle_insertion.commands import analyze as command
from needle_insertion.report import controllability
import numpy as np
from numpy.testing import assert_array_equal
import pytest


def run(*words: str) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    options = parser.parse_args(words)
    return command.run(options)


def found_by(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert run(*words, '--json') == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_json_contains_the_analysis_of_each_point(capsys: pytest.CaptureFixture[str]) -> None:
    """Every combination of the values has the matrices and metrics of the library."""
    words = ('--needle', 'paper_si', '--formulation', 'as_printed', '--modes', '1')
    points = ('--depth', '0.05', '0.1', '--tip-deflection', '0', '1e-3', '--speed', '0.01')
    found = found_by(capsys, *words, *points, '--force', '2')
    assert [(point['depth'], point['tip_deflection']) for point in found['points']] == [
        (0.05, 0.0),
        (0.05, 1e-3),
        (0.1, 0.0),
        (0.1, 1e-3),
    ]
    model = NeedleModel(NeedleParameters.preset('paper_si', formulation='as_printed', modes=1))
    for point in found['points']:
        state = operating_point(model, point['depth'], point['tip_deflection'], 0.01)
        system = linearize(model, state, 2.0)
        result = analyze(system)
        for name in ('A', 'B', 'C', 'D', 'drift'):
            assert_array_equal(point[name], getattr(system, name))
        assert point['states'] == list(system.names)
        for name, part in (('controllability', result.state), ('observability', result.observed)):
            assert point[name]['rank'] == part.rank
            assert point[name]['lost'] == list(part.lost)
            assert point[name]['distance'] == part.distance
        assert point['output_controllability'] == {
            'controllable': result.output_controllable,
            'gain': result.output_gain,
        }


def test_table_lists_uncontrollable_and_unobservable_states(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A straight and a deflected needle with defaults; long cells are wrapped."""
    assert run() == 0
    lines = capsys.readouterr().out.splitlines()
    first, second = (k for k, line in enumerate(lines) if line.startswith('10 cm'))
    straight, bent = ' '.join(lines[first:second]), lines[second]
    for name in ('q1', 'q2', 'q1_dot', 'q2_dot', 'd', 'theta', 'd_dot', 'theta_dot'):
        assert re.search(rf'\b{name}\b', straight)
    assert lines[first].endswith('none')
    assert bent.startswith('10 cm, 0.5 mm, 5 mm/s')
    assert '8/8' in bent
    assert '6/8' in bent


def test_constants_can_be_set(capsys: pytest.CaptureFixture[str]) -> None:
    """Numeric, list and string constants."""
    words = ('--set', 'friction_law=tanh', '--set', 'layer_depths=[0.05]')
    more = ('--set', 'layer_stiffnesses=[900]', '--set', 'minimum_depth=0.05', '--modes', '4')
    # Only a smooth friction law has a derivative at rest.
    found = found_by(capsys, *words, *more, '--speed', '0')
    assert found['points'][0]['states'][:6] == ['d', 'theta', 'q1', 'q2', 'q3', 'q4']


def test_map_is_written_as_csv_and_png(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map covers the needle length and deflections up to the option; the PNG is not empty."""
    monkeypatch.setattr(controllability, 'DEPTHS', 13)
    monkeypatch.setattr(controllability, 'DEFLECTIONS', 11)
    folder = tmp_path / 'new' / 'folder'
    found = found_by(capsys, '--tip-deflection', '0.001', '--map', '-o', str(folder))
    assert found['files'] == [str(folder / f'controllability.{kind}') for kind in ('csv', 'png')]
    assert sorted(path.name for path in folder.iterdir()) == [
        'controllability.csv',
        'controllability.png',
    ]
    with (folder / 'controllability.csv').open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 13 * 11
    assert (float(rows[0]['depth_m']), float(rows[-1]['depth_m'])) == (0.01, 0.2)
    assert float(rows[-1]['tip_deflection_m']) == 0.001
    for row in rows:
        bent = float(row['tip_deflection_m']) > 0.0
        assert (row['rank'], row['observed_rank']) == (('8', '6') if bent else ('4', '4'))
    picture = imread(folder / 'controllability.png')
    assert picture.shape[0] > 400
    assert len(np.unique(picture[:, :, :3].reshape(-1, 3), axis=0)) > 100


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (('--depth', '0.3'), 'insertion depth 0.3 m is outside'),
        (('--depth', '0'), 'insertion depth 0 m is outside'),
        (('--depth', 'nan'), 'must be finite'),
        (('--tip-deflection', 'inf'), 'must be finite'),
        (('--speed', 'nan'), 'must be finite'),
        (('--force', 'nan'), 'force must be finite'),
        (('--speed', '0'), 'the needle is at rest'),
        (('--modes', '0'), 'modes must be an integer from 1'),
        (('--modes', '4'), 'minimum_depth >='),
        (('--set', 'lenght=1'), "did you mean 'length'"),
        (('--set', 'length'), 'NAME=VALUE'),
        (('--set', 'length=long'), 'length must be a number'),
        (('--map',), '-o DIR'),
        (('--map', '-o', '.', '--speed', '1', '2'), 'single --speed'),
    ],
)
def test_invalid_input_is_reported_in_one_line(
    words: tuple[str, ...], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The error is reported before any output."""
    with pytest.raises(NeedleError) as caught:
        run(*words)
    assert complaint in str(caught.value)
    assert '\n' not in str(caught.value)
    assert capsys.readouterr().out == ''


def test_folder_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    """A file with the same name is reported in one line."""
    (tmp_path / 'taken').write_text('')
    with pytest.raises(NeedleError, match=r'taken.*cannot be written'):
        run('--map', '-o', str(tmp_path / 'taken'))
