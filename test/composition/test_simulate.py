# SPDX-License-Identifier: Apache-2.0
"""`needle simulate`: the same run as table, CSV, picture and bag."""

import csv
import json
from pathlib import Path
import re

from needle_dynamics import NeedleModel, NeedleParameters, simulate
from needle_identification.bags.bag import message_counts, read_topic
from needle_insertion.cli import main
import numpy as np
from numpy.testing import assert_allclose
import pytest

SHORT = ['simulate', '--needle', 'paper_si', '--duration', '0.005', '--interval', '1e-4']


def test_csv_and_bag_contain_the_run(tmp_path: Path) -> None:
    """Both contain the states of `simulate` at every sample, exactly."""
    outputs = [str(tmp_path / name) for name in ('run.csv', 'run.png', 'bag')]
    words = [word for output in outputs for word in ('-o', output)]
    assert main([*SHORT, *words]) == 0
    p = NeedleParameters.preset('paper_si')
    start = NeedleModel(p).state_at(0.02, 5e-4)
    run = simulate(p, start, 3.0, duration=0.005, interval=1e-4)
    with (tmp_path / 'run.csv').open() as file:
        rows = list(csv.reader(file))
    # Each with its unit, as of the other model.
    assert all(re.fullmatch(r'\w+ \[\S+\]', name) for name in rows[0])
    values = dict(zip(rows[0], np.array(rows[1:], dtype=float).T, strict=True))
    heads = ['d [m]', 'theta [rad]', 'q1 [m^3/2]', 'q2 [m^3/2]', 'd_dot [m/s]']
    heads += ['theta_dot [rad/s]', 'q1_dot [m^3/2/s]', 'q2_dot [m^3/2/s]']
    assert np.array_equal(np.transpose([values.pop(name) for name in heads]), run.states)
    expected = run.columns()
    assert [*values] == [name for name in expected if name[0] != 'q']
    assert all(np.array_equal(value, expected[name]) for name, value in values.items())
    truth = read_topic(tmp_path / 'bag', '/ground_truth')
    states = np.array([[*m.position, *m.velocity] for _, m in truth])
    assert np.array_equal(states, run.states)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in truth]
    # Whole nanoseconds.
    assert_allclose(stamps, run.time, atol=1e-9)
    assert set(message_counts(tmp_path / 'bag').values()) == {51}
    assert (tmp_path / 'run.png').read_bytes().startswith(b'\x89PNG')


def test_json_contains_the_summary(capsys: pytest.CaptureFixture[str]) -> None:
    """A changed constant changes the summary."""
    ends = []
    for change in (
        [],
        ['--set', 'coulomb_friction=1'],
        ['--set', 'modes=3', '--set', 'minimum_depth=0.02'],
    ):
        assert main([*SHORT, '--json', *change]) == 0
        ends.append(json.loads(capsys.readouterr().out)['insertion depth at the end [m]'])
    assert len(set(ends)) == 3


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (['--set', 'modes=7'], '7 modes cannot be distinguished'),
        (['--set', 'mass=1'], "unknown parameter 'mass'"),
        (['--set', 'modes'], '--set takes NAME=VALUE'),
        (['--depth', '0.3'], 'insertion depth 0.3 m is outside'),
        (['--interval', '0'], 'interval must be finite, > 0 s, got 0'),
        (['-o', 'run.xlsx'], 'output must be .csv, .png or a folder'),
        (['--tolerance', '-1'], 'tolerance must be finite, >= 1e-11'),
        (['--tip-deflection', '5'], 'tip_deflection must be finite, >= -0.2 and <= 0.2 m, got 5'),
    ],
)
def test_invalid_input_is_a_one_line_error(
    words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The error names the invalid input, with exit status 2."""
    assert main([*SHORT, *words]) == 2
    captured = capsys.readouterr()
    assert complaint in captured.err
    assert captured.err.count('\n') == 1


def test_output_names_the_run_and_its_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Default values are printed."""
    file = tmp_path / 'run.csv'
    assert main([*SHORT, '-o', str(file)]) == 0
    out = capsys.readouterr().out
    assert out.startswith('paper_si: inserted 0.02 m at the start, force 3 N, for 0.005 s\n')
    assert out.endswith(f'wrote {file}\n')


def test_output_reports_speed_and_accuracy(capsys: pytest.CaptureFixture[str]) -> None:
    """Speed is in the last line, accuracy in table and JSON; a smaller tolerance is met."""
    assert main(SHORT) == 0
    *_, last = capsys.readouterr().out.splitlines()
    pace = re.fullmatch(
        r'0\.005 s simulated in (\S+) s, (\S+) times (faster|slower) than real time', last
    )
    assert pace is not None
    taken, times = float(pace[1]), float(pace[2])
    ratio = 0.005 / taken if pace[3] == 'faster' else taken / 0.005
    # Both are printed to two digits.
    assert times == pytest.approx(ratio, rel=0.1)
    for words, most in (([], 1e-3), (['--tolerance', '1e-6'], 1e-6)):
        assert main([*SHORT, '--json', *words]) == 0
        assert 0.0 < json.loads(capsys.readouterr().out)['stated error [1]'] <= most


def test_limits_of_model_and_sampling_are_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    """A mode beyond half the sampling rate, and a deflection beyond a linear beam."""
    few = ['simulate', '--needle', 'paper_si', '--duration', '0.002', '--depth', '0.05']
    bent = ['--tip-deflection', '0.02']
    assert main([*few, *bent, '--interval', '1e-3']) == 0
    err = capsys.readouterr().err
    assert 'a linear beam is valid up to' in err
    assert 'is beyond half the sampling rate, 0.5 kHz' in err
    assert main([*few, '--interval', '1e-5']) == 0
    assert capsys.readouterr().err == ''


def test_hub_contact_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    """Only if the needle is inserted up to the hub."""
    name = 'hub at the skin at the latest after [s]'
    for preset, time in (('paper_si', 0.0287), ('phantom', 22.13)):
        assert main(['simulate', '--json', '--needle', preset]) == 0
        said = capsys.readouterr()
        # The default is 2000 samples; modes above their Nyquist frequency have decayed.
        assert abs(json.loads(said.out)[name] - time) < 3e-3 * time
        assert said.err == ''
    assert main([*SHORT, '--json']) == 0
    assert name not in json.loads(capsys.readouterr().out)


def test_runs_can_start_from_modal_coordinates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """q1 and q2 replace a tip deflection; both, or a wrong number of values, are rejected."""
    assert main([*SHORT, '--modal', '1e-5', '-2e-6', '-o', str(tmp_path / 'run.csv')]) == 0
    with (tmp_path / 'run.csv').open() as file:
        first = next(csv.DictReader(file))
    assert [float(first[f'q{k} [m^3/2]']) for k in (1, 2)] == [1e-5, -2e-6]
    capsys.readouterr()
    assert main([*SHORT, '--modal', '1e-5']) == 2
    assert 'modal must have 2 numbers' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*SHORT, '--modal', '1e-5', '0', '--tip-deflection', '1e-3'])
    assert 'not allowed with argument' in capsys.readouterr().err
