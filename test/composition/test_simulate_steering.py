# SPDX-License-Identifier: Apache-2.0
"""`needle simulate --model steering`: outputs, and errors of invalid input."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from needle_insertion.cli import main
import pytest

WAY = 'depth [mm],guide_z [mm],roll [deg]\n0,0,0\n20,4,0\n60,4,0\n61,4,180\n100,-2,180\n'


def said(
    capsys: pytest.CaptureFixture[str], *words: str, status: int = 0
) -> tuple[dict[str, float], str]:
    """Run the command; return its JSON, if it succeeds, and stderr."""
    assert main(['simulate', *words]) == status
    found = capsys.readouterr()
    return (json.loads(found.out) if status == 0 else {}), found.err


def test_identification_recovers_the_constants(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The CSV contains the inputs of the identification of friction and steering."""
    way, run, picture = (tmp_path / name for name in ('way.csv', 'run.csv', 'run.png'))
    way.write_text(WAY)
    steering = ['--model', 'steering', '--set', 'bevel_load=0.4', '--set', 'cutting_force=0.8']
    found, _ = said(
        capsys, *steering, '--motion', str(way), '-o', str(run), '-o', str(picture), '--json'
    )
    # Rounding, over two hundred intervals.
    assert found['depth at the end [m]'] == pytest.approx(0.1, abs=1e-12)
    assert picture.read_bytes().startswith(b'\x89PNG')
    with run.open(newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert float(rows[-1]['tip_z [m]']) == found['tip at the end, z [m]']
    assert float(rows[-1]['guide_z [m]']) == pytest.approx(-2e-3)
    # Friction of the preset plus cutting force, constant within the interval, up to rounding.
    assert float(rows[50]['force [N]']) == pytest.approx(0.56 + 300.0 * 5e-3 + 0.8, rel=1e-9)
    assert main(['identify', 'steering', str(run), '--terms', 'bevel', '--json']) == 0
    identified = json.loads(capsys.readouterr().out)
    [medium] = identified['media'].values()
    # The preset has a bending length of 35 mm and a free length of 40 mm. The samples are not at
    # the corners of the guide motion.
    assert medium['parameters']['bending_length']['value'] == pytest.approx(0.035, rel=5e-3)
    assert identified['free_length']['value'] == pytest.approx(0.04, rel=5e-3)
    # Readings are averages of rows, also across the corners: this is taken for noise.
    curvature = medium['parameters']['curvature_z']
    low, high = curvature['interval']
    assert low < 0.4 * 0.035 / 0.0256 < high
    assert curvature['value'] == pytest.approx(0.4 * 0.035 / 0.0256, rel=0.06)


def test_membranes_start_depth_and_seed_take_effect(capsys: pytest.CaptureFixture[str]) -> None:
    changes = ['membrane_depths=0.05', 'membrane_strengths=2', 'path_noise=1e-4']
    words = [word for change in changes for word in ('--set', change)]
    options = ['--model', 'steering', *words, '--depth', '0.03', '--to', '0.08', '--json']
    found, _ = said(capsys, *options)
    assert found['membranes punctured'] == 1.0
    again, _ = said(capsys, *options)
    other, _ = said(capsys, *options, '--seed', '3')
    assert again == found
    assert other['tip at the end, z [m]'] != found['tip at the end, z [m]']


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (['--force', '3N'], 'the model of bending_35mm; try --model modes'),
        (['--needle', 'phantom', '--to', '9cm'], 'of phantom; try --model steering'),
        (
            ['--model', 'steering', '--force', '3'],
            '--force is an option of --model modes, not of steering',
        ),
        (['--model', 'modes', '--to', '0.1'], '--to is an option of --model steering, not'),
        (['--model', 'steering', '--to', '0.3'], 'the needle reached 160 mm, where its hub stops'),
        (['--model', 'steering', '--speed', '0'], '--speed must be finite, >= 1e-06 m/s'),
        (['--model', 'steering', '--depth', '0.2'], '--to must be beyond --depth'),
        (['--model', 'steering', '--interval', '1e-9'], 'with at most 1000000 samples'),
        (['--model', 'steering', '--seed', '-1'], 'seed must be an integer >= 0, got -1'),
        (['--model', 'steering', '--set', 'modes=3'], "unknown parameter 'modes'; valid: area"),
        (['--model', 'steering', '-o', 'bag'], 'must be .csv or .png'),
        (['--model', 'steering', '--motion', 'none.csv'], 'none.csv cannot be read'),
    ],
)
def test_invalid_input_is_named(
    words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert complaint in said(capsys, *words, status=2)[1]


def test_motion_that_is_not_used_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of columns in mm without a unit or of other names, and rows beyond the target depth."""
    way = tmp_path / 'way.csv'
    words = ['--model', 'steering', '--to', '70mm', '--motion', str(way), '--json']
    way.write_text('depth,guide_x\n0,0\n30,0\n60,3\n')
    _, warnings = said(capsys, *words)
    assert warnings == (
        f'warning: {way}: depth has no unit, taken in SI units: perhaps depth=depth[mm]\n'
        f'warning: {way}: guide_x has no unit, taken in SI units: perhaps guide_x=guide_x[mm]\n'
        f'warning: {way}: its depths, 0 to 60000 mm, continue beyond --to, 70 mm\n'
    )
    # A motion of 0.1 m and less may be in m.
    way.write_text('depth [mm],guide_x [mm],guide_z\n0,0,0\n30,0,0\n70,3,0.003\n')
    assert said(capsys, *words)[1] == ''
    assert said(capsys, *words[:2], *words[4:])[1] == ''
    way.write_text('depth [mm],guide_x [mm],rol [deg],guide [mm]\n0,0,0,0\n30,0,0,0\n70,3,4,5\n')
    assert said(capsys, *words)[1] == (
        f'warning: {way}: columns not used: rol [deg], guide [mm]; valid: depth, guide_x, '
        'guide_z, tilt_x, tilt_z, roll\n'
    )
    way.write_text('depth [mm],guide_x [mm]\n0,0\n30,0\n71,3\n')
    assert 'its depths, 0 to 71 mm, continue beyond --to, 70 mm' in said(capsys, *words)[1]


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('depth,roll\n0,0\n0,1\n', 'depth must increase from row to row'),
        ('depth,force\n0,0\n1,1\n', 'must have the columns depth and any of guide_x'),
        ('depth,roll\n0,0\n0.1,nan\n', 'has values that are not numbers'),
        ('depth,roll [rev]\n0,0\n1,1\n', 'is not one of rad, deg for roll: rename the column\n'),
    ],
)
def test_invalid_guide_tables_are_named(
    text: str, complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    way = tmp_path / 'way.csv'
    way.write_text(text)
    words = ['--model', 'steering', '--motion', str(way)]
    assert complaint in said(capsys, *words, status=2)[1]


@pytest.mark.parametrize(('aside', 'warned'), [(10, False), (50, True)])
def test_slopes_beyond_a_linear_beam_are_warned_of(
    aside: int, warned: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    way = tmp_path / 'way.csv'
    way.write_text(f'depth [mm],guide_z [mm]\n0,0\n50,{aside}\n100,0\n')
    found, err = said(capsys, '--model', 'steering', '--motion', str(way), '--json')
    assert (found['largest slope'] > 0.3) == warned
    assert ('a linear beam is valid up to about 0.3' in err) == warned
