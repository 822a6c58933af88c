# SPDX-License-Identifier: Apache-2.0
"""`needle plan`: result, file, and errors of invalid input."""

from __future__ import annotations

import json
from pathlib import Path

from needle_insertion.cli import main
from needle_planning import read_plan
import numpy as np
import pytest

LIVER = Path(__file__).parents[2] / 'examples' / 'liver'
WORDS = ('plan', str(LIVER / 'liver.seg.nrrd'), '--labels', str(LIVER / 'labels.yaml'))
TARGET = '62mm,12mm,10mm'


def test_plan_of_the_example(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Text, JSON and file have the same plan."""
    file = tmp_path / 'plan.yaml'
    assert main([*WORDS, '--target', TARGET, '--straight', '-o', str(file)]) == 0
    text, warnings = capsys.readouterr()
    assert warnings == ''
    assert text.startswith('path found in ')
    assert text.endswith(f'wrote {file}\n')
    assert main([*WORDS, '--target', TARGET, '--straight', '--json']) == 0
    found, plan = json.loads(capsys.readouterr().out), read_plan(file)
    assert found['entry [m]'] == plan.entry.tolist()
    assert found['clearance [m]'] == plan.clearance > 0.0
    assert f'clearance {1e3 * plan.clearance:.2f} mm to {plan.structure}' in text
    assert np.allclose(plan.target, [0.062, 0.012, 0.01])
    assert plan.resolution == 5e-4


@pytest.mark.parametrize(
    ('target', 'place'), [('90mm,10mm,-5mm', 'liver'), ('120mm,-80mm,10mm', 'no structure')]
)
def test_target_beside_its_structure_is_a_warning(
    target: str, place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / 'plan.html'
    words = [*WORDS, '--target', target, '--straight', '--page', str(page), '--json']
    assert main(words) == 0
    said = capsys.readouterr()
    line = f'the target is not in tumor (it is in {place})'
    assert f'warning: {line}\n' in said.err
    assert json.loads(said.out)['warnings'] == [line]
    assert f'Warning: {line}.' in page.read_text(encoding='utf-8')


def test_entry_point_below_the_skin_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / 'plan.html'
    words = [*WORDS, '--target', TARGET, '--entry', '100mm,17mm,14mm', '--entry-radius', '1mm']
    assert main([*words, '--straight', '--resolution', '2mm', '--page', str(page), '--json']) == 0
    said = capsys.readouterr()
    (line,) = json.loads(said.out)['warnings']
    assert line.startswith('the needle passes through ')
    assert said.err == f'warning: {line}\n'
    assert f'Warning: {line}.' in page.read_text(encoding='utf-8')


def test_input_is_not_an_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The files are as before, under any name."""
    labels, image = tmp_path / 'labels.yaml', tmp_path / 'liver.seg.nrrd'
    labels.write_bytes((LIVER / 'labels.yaml').read_bytes())
    image.write_bytes((LIVER / 'liver.seg.nrrd').read_bytes())
    link = tmp_path / 'plan.yaml'
    link.symlink_to(labels)
    words = ['plan', str(image), '--labels', str(labels), '--target', TARGET, '--straight']
    for more in (['-o', str(labels)], ['-o', str(link)], ['-o', str(image)]):
        assert main([*words, *more]) == 2
        assert capsys.readouterr().err == f'error: {more[1]} cannot be written: it is an input\n'
    assert labels.read_bytes() == (LIVER / 'labels.yaml').read_bytes()
    assert image.read_bytes() == (LIVER / 'liver.seg.nrrd').read_bytes()


def test_bound_holds_for_bows_that_are_not_searched(capsys: pytest.CaptureFixture[str]) -> None:
    """Of a guide that does not move, straight needles are the only ones."""
    found = []
    for more in (['--straight'], ['--straight', '--limit', '0'], []):
        region = ['--entry', '132mm,37mm,-1mm', '--entry-radius', '4mm']
        assert main([*WORDS, '--target', TARGET, *region, '--json', *more]) == 0
        found.append(json.loads(capsys.readouterr().out))
    clearance, straight, every = (
        [one[f'{name} [m]'] for one in found]
        for name in ('clearance', 'largest straight clearance', 'largest clearance')
    )
    assert straight[0] < clearance[2] <= every[0]
    assert straight[1] == every[1]


@pytest.mark.parametrize(
    ('words', 'status', 'message'),
    [
        ((f'--target={TARGET}', '--entry', '150mm,0,0'), 1, 'no straight path to a resolution'),
        (('--target', '-0.4,0,0'), 2, 'the target -400.00, 0.00, 0.00 mm is outside the image'),
        (('--target', '55mm,0,-20mm'), 2, 'the target is in portal vein'),
        (('--target', '55mm,0'), 2, '--target must be R,A,S, such as'),
        ((f'--target={TARGET}', '--resolution', '20mm'), 1, '; use a finer --resolution: a str'),
        ((f'--target={TARGET}', '--entry', 'skin'), 2, 'entry must be one of body, entry,'),
        ((f'--target={TARGET}', '--entry=-1,0,0,2'), 2, '--entry must be R,A,S, such as'),
        ((f'--target={TARGET}', '--entry', '0.3,0,0'), 2, 'is too short: the nearest entry'),
        ((f'--target={TARGET}', '--needle', 'none'), 2, 'needle must be one of'),
        ((f'--target={TARGET}', '--skin-limit=-1mm'), 2, 'skin_limit must be >= 0 m'),
        ((f'--target={TARGET}', '-o', '/none/plan.yaml'), 2, 'its folder does not exist'),
        ((f'--target={TARGET}', '--page', '/none/plan.html'), 2, 'its folder does not exist'),
        ((f'--target={TARGET}', '-o', 'p.txt'), 2, '--output must be a file .yaml, got p.txt'),
        ((f'--target={TARGET}', '-o', 'p.html', '--page', 'p.html'), 2, 'must be a file .yaml'),
        ((f'--target={TARGET}', '--page', 'p.txt'), 2, '--page must be a file .html, got p.txt'),
        ((f'--target={TARGET}', '--entry', 'tumor'), 2, 'entry: tumor has the role target'),
        ((f'--target={TARGET}', '--entry-radius', '3mm'), 2, 'add --entry R,A,S'),
        ((f'--target={TARGET}', '--entry=entry', '--entry-radius=3mm'), 2, 'add --entry R,A,S'),
        ((f'--target={TARGET}', '--step', '500mm'), 2, '--step must be finite, > 0 and <= 0.16'),
    ],
)
def test_invalid_request_is_one_line(
    words: tuple[str, ...], status: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*WORDS, *words]) == status
    said = capsys.readouterr()
    assert said.out == ''
    assert said.err.startswith('error: ')
    assert message in said.err
    assert len(said.err.splitlines()) == 1
