# SPDX-License-Identifier: Apache-2.0
"""Command line: accepted and rejected arguments, exit status and messages."""

from hashlib import sha256
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys

from needle_dynamics.plant_node import PlantNode
from needle_identification import identify_friction, read_friction_recording
from needle_insertion.cli import main
import pytest
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn
from reproduction.protocol import SHIPPED_BAGS
import yaml

BAGS = [str(path) for path in sorted(SHIPPED_BAGS.glob('friction_*'))]


def test_shipped_bags_give_their_true_friction() -> None:
    """Each recording contains its ground truth; the errors match their standard errors."""
    scores = []
    for bag in BAGS:
        recording = read_friction_recording(Path(bag))
        estimate = identify_friction(recording)
        for name in ('coulomb_friction', 'viscous_friction'):
            found, truth = estimate[name], recording.truth[f'model.{name}']
            scores.append((found.value - truth) / found.error)
            # Accuracy: 2 % of the ground truth.
            assert found.error < 0.02 * truth
    assert len(scores) >= 8
    # 4.5: exceeded in 1 of 50 sets of 40 scores with 10 or more degrees of freedom.
    assert max(map(abs, scores)) < 4.5


def test_result_file_configures_the_plant(tmp_path: Path) -> None:
    """The plant loads the file with --params-file and has the identified values."""
    file = tmp_path / 'friction.yaml'
    assert main(['identify', 'friction', *BAGS[:2], '-o', str(file)]) == 0
    given = yaml.safe_load(file.read_text())['/**/plant']['ros__parameters']
    context = Context()
    context.init(args=[])
    plant = PlantNode(context=context, cli_args=['--ros-args', '--params-file', str(file)])
    try:
        assert plant.trigger_configure() == TransitionCallbackReturn.SUCCESS
        assert plant.model_parameters().viscous_friction == given['model.viscous_friction']
        assert plant.model_parameters().coulomb_friction == given['model.coulomb_friction']
    finally:
        plant.destroy_node()
        context.try_shutdown()


@pytest.mark.parametrize('what', ['friction', 'stiffness'])
@pytest.mark.parametrize(
    ('content', 'complaint'),
    [(None, 'does not exist'), (b'not a bag at all', 'MCAP'), (b'', 'MCAP')],
    ids=['missing', 'corrupt', 'empty'],
)
def test_unreadable_bags_are_reported_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    what: str,
    content: bytes | None,
    complaint: str,
) -> None:
    """An unreadable bag is named in one line, exit status 2, without output files."""
    bag, file = tmp_path / 'bag.mcap', tmp_path / 'result.yaml'
    if content is not None:
        bag.write_bytes(content)
    assert main(['identify', what, str(bag), '-o', str(file)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert captured.err.count('\n') == 1
    assert str(bag) in captured.err
    assert complaint in captured.err
    assert not file.exists()


@pytest.mark.parametrize(
    'words',
    [
        [],
        ['identify'],
        ['identify', 'mass', 'x'],
        ['identify', 'friction', 'x', '--time', 'now'],
        ['identify', 'friction', 'x', '--force-axis'],
        ['bench', 'luck'],
        ['demo', '--fast'],
        ['experiment', 'luck'],
    ],
)
def test_invalid_usage_exits_with_status_2(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Unknown commands and options are rejected in one line."""
    with pytest.raises(SystemExit) as refused:
        main(words)
    assert refused.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(r'needle( \w+)*: error: ', line)


def test_shipped_bags_match_their_checksums() -> None:
    """Each file of the shipped recordings matches SHA256SUMS."""
    lines = (SHIPPED_BAGS / 'SHA256SUMS').read_text().splitlines()
    listed = {name: digest for digest, name in (line.split() for line in lines)}
    files = [path for path in SHIPPED_BAGS.glob('*_*/*') if path.is_file()]
    assert {str(path.relative_to(SHIPPED_BAGS)) for path in files} == set(listed)
    for path in files:
        name = str(Path(path).relative_to(SHIPPED_BAGS))
        assert sha256(path.read_bytes()).hexdigest() == listed[name]


@pytest.mark.parametrize('which', ['friction', 'stiffness'])
@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (['--repeats', '0'], '--repeats must be in [1, 1000], got 0'),
        (['--seed', '-3'], '--seed must be >= 0'),
        (['--rate', 'nan'], '--rate must be in'),
        (['--rate', '-5'], '--rate must be in'),
        (['--speed', '0'], '--speed must be in'),
        (['--speed', 'nan'], '--speed must be in'),
    ],
)
def test_invalid_experiments_are_rejected_before_writing(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    which: str,
    words: list[str],
    complaint: str,
) -> None:
    """Invalid numbers are reported with exit status 2, and no folder is created."""
    assert main(['experiment', which, str(tmp_path / 'out'), *words]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('output', ['.', '/', ''])
def test_output_must_be_a_file_name(output: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder as output is rejected in one line."""
    assert main(['identify', 'friction', BAGS[0], '-o', output]) == 2
    assert 'it is not the name of a file' in capsys.readouterr().err


def test_copies_of_a_bag_are_used_once(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A duplicate recording under any name would underestimate the error."""
    copy = tmp_path / 'copy'
    shutil.copytree(BAGS[0], copy)
    words = ['identify', 'friction', *[BAGS[0]] * 2, BAGS[0] + '/', str(copy), '--all-warnings']
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert err.count('counts once') == 3
    assert len([line for line in out.splitlines() if 'friction_01' in line or 'copy' in line]) == 1


def test_unwritable_outputs_are_reported_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """An error of the operating system is reported in one line."""
    assert main(['demo', '-o', '/dev/null/demo']) == 2
    assert capsys.readouterr().err.count('\n') == 1


def test_signal_during_import_exits_without_traceback() -> None:
    """A user may press Ctrl-C during the imports."""
    code = """
import os, signal, sys
from needle_insertion.cli import main

class Interrupt:
    def find_spec(self, name, path, target=None):
        if name == 'numpy':
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
main(['identify', 'friction', 'nowhere'])
"""
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, done.stderr) == (-signal.SIGINT, '')


@pytest.mark.parametrize('speed', ['-5e-3', '-0.005', '-.5E-2'])
def test_negative_numbers_are_option_values(
    speed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also in scientific notation, which argparse parses as an option."""
    assert main(['analyze', '--speed', speed]) == 0
    assert '-5 mm/s' in capsys.readouterr().out


def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a subprocess."""
    return subprocess.run(
        [sys.executable, '-m', 'needle_insertion.cli', *words],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, **environment},
    )


def test_negative_numbers_in_scientific_notation_are_accepted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Single and multiple values."""
    assert main(['analyze', '--speed', '-5e-3', '-1e-2', '--tip-deflection', '-5e-4']) == 0
    out = capsys.readouterr().out
    assert '10 cm, -0.5 mm, -5 mm/s' in out
    assert '10 cm, -0.5 mm, -10 mm/s' in out
    assert main(['identify', 'friction', BAGS[0], '--cutoff', '-1e-3']) == 2
    assert 'cutoff must be' in capsys.readouterr().err


@pytest.mark.parametrize('value', ['nan', 'inf', '-inf'])
@pytest.mark.parametrize(
    'words',
    [
        ['identify', 'stiffness', str(SHIPPED_BAGS / 'stiffness_01'), '--level'],
        ['identify', 'friction', BAGS[0], '--cutoff'],
        ['analyze', '--speed'],
        ['simulate', '--needle', 'phantom', '--duration', '0.002', '--force'],
        ['simulate', '--needle', 'phantom', '--duration'],
    ],
)
def test_numbers_must_be_finite(
    words: list[str], value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """NaN and infinity are rejected in one line."""
    assert main([*words, value]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert captured.err.count('\n') == 1


def test_cutoff_outside_the_range_of_the_recording_is_reported(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Too low for the duration is rejected; above the Nyquist rate gives a warning."""
    for cutoff in ('1e-9', '1e-310'):
        assert main(['identify', 'friction', BAGS[0], '--cutoff', cutoff]) == 2
        err = capsys.readouterr().err
        assert err.count('\n') == 1
        assert 'the cutoff must be above 0.' in err
    assert main(['identify', 'friction', BAGS[0], '--cutoff', '1e300']) == 0
    assert 'beyond half the sampling rate, 50 Hz' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('line', 'offered'),
    [
        ('needle simu', ['simulate']),
        ('needle simulate --nee', ['--needle']),
        ('needle identify friction --estimator h', ['huber']),
    ],
)
def test_shell_completes_commands_options_and_values(line: str, offered: list[str]) -> None:
    """As after ``eval "$(register-python-argcomplete needle)"``: answers go to descriptor 8."""
    asked = subprocess.run(
        ['/bin/bash', '-c', f'exec {sys.executable} -m needle_insertion 8>&1 >/dev/null'],
        env={
            **os.environ,
            '_ARGCOMPLETE': '1',
            '_ARGCOMPLETE_IFS': ' ',
            'COMP_LINE': line,
            'COMP_POINT': str(len(line)),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert asked.stdout.split() == offered


@pytest.mark.parametrize(('closed', 'other'), [('1', 'stderr'), ('2', 'stdout')])
def test_closed_stream_has_no_effect_on_the_other(closed: str, other: str, tmp_path: Path) -> None:
    """As of a program that is started without a terminal; files are complete."""
    file = tmp_path / 'run.csv'
    line = f'exec "$0" -m needle_insertion.cli simulate -o "$1" {closed}>&-'
    done = subprocess.run(
        ['/bin/sh', '-c', line, sys.executable, str(file)],
        capture_output=True, text=True, timeout=300.0, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said = {'stdout': done.stdout, 'stderr': done.stderr}
    assert ('wrote' in said['stdout']) == (other == 'stdout')
    assert 'Traceback' not in said['stderr']
    assert file.read_text('utf-8').count('\n') > 100


def test_full_disk_is_a_failed_job() -> None:
    """In one line; the input is valid."""
    with Path('/dev/full').open('w', encoding='utf-8') as full:
        done = subprocess.run(
            [sys.executable, '-m', 'needle_insertion.cli', 'steer', '--json'],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=300.0, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == 'error: [Errno 28] No space left on device\n'


def test_terminal_without_unicode_shows_a_result() -> None:
    """Unsupported characters are replaced."""
    done = run('identify', 'friction', BAGS[0], PYTHONIOENCODING='ascii')
    assert (done.returncode, done.stderr) == (0, '')
    assert 'mean +- SE' in done.stdout


def test_wrong_kind_of_recording_suggests_the_correct_subcommand(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Friction from presses, and stiffness from strokes."""
    stiffness = str(SHIPPED_BAGS / 'stiffness_01')
    for wrong, right, bag in (
        ('friction', 'stiffness', stiffness),
        ('stiffness', 'friction', BAGS[0]),
    ):
        assert main(['identify', wrong, bag]) == 2
        assert f'{bag}: try needle identify {right}\n' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('words', 'meant'),
    [
        (['identfy', 'friction', 'x'], 'identify'),
        (['identify', 'frction', 'x'], 'friction'),
        (['identify', 'friction', 'x', '--repot', 'y'], '--report'),
    ],
)
def test_misspelled_words_suggest_the_nearest(
    words: list[str], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Subcommands, options and choices."""
    with pytest.raises(SystemExit):
        main(words)
    assert capsys.readouterr().err.endswith(f'did you mean {meant}?\n')


@pytest.mark.parametrize(
    'words',
    [
        ['identify', 'friction', BAGS[0], '-o', 'missing/result.yaml'],
        ['identify', 'friction', BAGS[0], '--report', 'file/report'],
        ['identify', 'stiffness', BAGS[0], '--report', 'locked/report'],
        ['simulate', '-o', 'missing/run.csv'],
        ['simulate', '-o', 'locked/run.csv'],
        ['reproduce', 'figure-4', '-o', 'locked'],
        ['demo', '-o', 'locked/demo'],
        ['experiment', 'friction', 'locked/bags'],
    ],
)
def test_output_paths_are_checked_before_the_computation(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The folder is missing, is a file, or is not writable."""
    monkeypatch.chdir(tmp_path)
    Path('file').touch()
    Path('locked').mkdir()
    # Permissions do not apply to root.
    monkeypatch.setattr(os, 'access', lambda path, _mode: Path(path).name != 'locked')
    assert main(words) == 2
    err = capsys.readouterr().err
    assert 'cannot be written: ' in err
    assert err.count('\n') == 1
    assert sorted(path.name for path in tmp_path.rglob('*')) == ['file', 'locked']
