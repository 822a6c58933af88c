# SPDX-License-Identifier: Apache-2.0
"""`needle plan --insertions`: probabilities in text, JSON and file, and invalid options."""

from __future__ import annotations

import json
from pathlib import Path

from needle_insertion.cli import main
from needle_planning import read_plan
from needle_ros.files import read_document
import pytest

LIVER = Path(__file__).parents[2] / 'examples' / 'liver'
WORDS = ('plan', str(LIVER / 'liver.seg.nrrd'), '--labels', str(LIVER / 'labels.yaml'))
TARGET = ('--target', '62mm,12mm,10mm', '--straight')


def test_text_json_and_file_have_the_same_probabilities(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file of another uncertainty replaces the default: an exact patient is hit."""
    population, file = tmp_path / 'population.yaml', tmp_path / 'plan.yaml'
    population.write_text('population: {registration_x: 2mm, path_noise: 1e-9}\n', 'utf-8')
    words = [*WORDS, *TARGET, '--insertions', '16', '--population', str(population)]
    words += ['--radius', '3mm', '-o', str(file), '--json']
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)['simulation']
    assert found == read_document(file.read_text('utf-8'))['simulation']
    assert (found['insertions'], found['radius']) == (16, 0.003)
    # All tips are 2 mm from the target, and a law moves them by less than 1 mm.
    assert found['hit'][0] == 1.0
    assert read_plan(file).clearance > 0.0
    assert main([*WORDS, *TARGET, '--insertions', '16', '--population', str(population)]) == 0
    text = capsys.readouterr().out
    assert 'tip within 1 mm of the target' in text
    assert '16 insertions' in text
    assert 'tolerated error of the entry point' in text
    assert 'fraction of its variance: at least 100 insertions are needed' in text


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (('--insertions', '-1'), '--insertions must be an integer from 0'),
        (('--insertions', '10', '--radius', '0'), '--radius must be finite, > 0 m'),
        (('--insertions', '10', '--seed', '-1'), '--seed must be an integer from 0'),
        (('--insertions', '10', '--population', 'none.yaml'), 'none.yaml cannot be read'),
        (('--population', 'none.yaml'), 'add --insertions'),
        (('--radius', '-1mm'), '--radius is of simulated insertions: add --insertions'),
        (('--seed', '1'), '--seed is of simulated insertions: add --insertions'),
    ],
)
def test_invalid_option_is_one_line(
    words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*WORDS, *TARGET, *words]) == 2
    said = capsys.readouterr()
    assert said.out == ''
    assert message in said.err
    assert len(said.err.splitlines()) == 1
