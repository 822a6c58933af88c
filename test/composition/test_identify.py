# SPDX-License-Identifier: Apache-2.0
"""Output, warnings, written files and exit status of `needle identify`."""

import json
from pathlib import Path
import re
import shutil
from typing import Any

from needle_identification import identify_friction, TERMS
from needle_insertion.cli import main
from needle_insertion.report.identify_figures import friction_data, friction_each
import numpy as np
import pytest
from reproduction.protocol import SHIPPED_BAGS
from support.pages import look_at
from support.presses import STIFFNESS, write_presses
from support.samples import simulated
import yaml

BAGS = [str(path) for path in sorted(SHIPPED_BAGS.glob('friction_*'))][:4]


@pytest.fixture(scope='module')
def places(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return recordings of presses at two places."""
    folder = tmp_path_factory.mktemp('places')
    for seed in (1, 2):
        write_presses(folder / f'place_{seed}', seed)
    return [str(folder / f'place_{seed}') for seed in (1, 2)]


def identify(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> tuple[str, ...]:
    """Run the command; return its output and warnings."""
    assert main(['identify', *words]) == status
    said = capsys.readouterr()
    return said.out, said.err


def as_json(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> dict[str, Any]:
    """Run the command with JSON output; the output must be standard JSON."""

    def refuse(word: Any) -> None:
        raise AssertionError(f'{word} is no JSON')

    out, _ = identify(capsys, *words, '--json', status=status)
    return json.loads(out, parse_constant=refuse)


# Friction.


def test_tables_contain_every_parameter_with_error_and_interval(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Means over the bags with 95 % interval and STD, and each bag; breakaway follows mu_s."""
    out, _ = identify(capsys, 'friction', *BAGS)
    whole, each, predicted = out.split('\n\n')
    assert predicted.startswith('force of a recording predicted from the others: error ')
    heads = whole.splitlines()[0]
    assert re.split(r' {2,}', heads) == [
        'parameter', 'mean ± SE', '95 % interval', 'STD over bags', 'bags',
    ]  # fmt: skip
    for symbol in ('mu_s', 'mu_v'):
        (line,) = [line for line in whole.splitlines() if f' {symbol} [' in line]
        cells = re.split(r' {2,}', line)
        mean, error = map(float, cells[1].split(' ± '))
        low, high = map(float, cells[2].split(' to '))
        assert low < mean < high
        assert 0.0 < error < high - low
        assert cells[4] == str(len(BAGS))
    assert all(bag in each for bag in BAGS)


def test_json_is_complete_and_has_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    """Statistics and parameters by name, with settings, files and checksums."""
    found = as_json(capsys, 'friction', *BAGS, '--terms', 'coulomb,viscous,offset')
    assert {'coulomb_friction', 'viscous_friction', 'offset'} <= set(found['statistics'])
    assert set(found['statistics']['coulomb_friction']) == {
        'name', 'symbol', 'unit', 'mean', 'deviation', 'error', 'interval', 'count',
    }  # fmt: skip
    assert [one['name'] for one in found['estimates']] == BAGS
    assert found['estimates'][0]['parameters']['offset']['unit'] == 'N'
    assert 'fit' not in found['estimates'][0]
    assert found['settings']['terms'] == ['coulomb', 'viscous', 'offset']
    assert found['reading']['force_axis'] == 'y'
    (path, digest), *_ = found['recordings'][0]['files']
    assert path.startswith(BAGS[0])
    assert re.fullmatch('[0-9a-f]{64}', digest)
    assert found['failures'] == []


def test_terms_are_a_list_or_repeated(capsys: pytest.CaptureFixture[str]) -> None:
    """Both notations are equivalent."""
    one = as_json(capsys, 'friction', BAGS[0], '--terms', 'coulomb,viscous,offset')
    two = as_json(capsys, 'friction', BAGS[0], '--terms', 'coulomb', '--terms', 'viscous, offset')
    assert one == two


def test_files_of_several_recordings_in_a_folder_are_all_used(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for name, bag in zip(('gel', 'liver'), BAGS, strict=False):
        shutil.copy(next(Path(bag).glob('*.mcap')), tmp_path / f'{name}.mcap')
    found = as_json(capsys, 'friction', str(tmp_path))
    assert found == as_json(capsys, 'friction', *map(str, sorted(tmp_path.iterdir())))
    assert len(found['recordings']) == 2


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (['--terms', 'coulomb,drag'], f'terms must be one of {", ".join(TERMS)}'),
        (['--cutoff', '-1'], 'cutoff must be'),
        (['--force-axis', 'w'], "'w'"),
        (['--wrench-topic', '/force'], '/base_wrench'),
        (['--motion-axis', '-slide'], 'slide'),
        (['--decay-time', '3s'], '--decay-time is for the term decay, got the terms coulomb, v'),
    ],
)
def test_invalid_options_are_reported_in_one_line(
    capsys: pytest.CaptureFixture[str], words: list[str], complaint: str
) -> None:
    """Exit status 2; the message names the invalid and the valid values."""
    out, err = identify(capsys, 'friction', BAGS[0], *words, status=2)
    assert out == ''
    assert err.count('\n') == 1
    assert complaint in err


@pytest.mark.parametrize(
    'words',
    [
        ['--force-axis', '-y', '--motion-axis', '-insertion'],
        ['--force-axis=-y', '--motion-axis=-insertion'],
    ],
)
def test_signed_axes_are_accepted_in_both_forms(
    capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    """Reversing force and motion does not change friction."""
    turned = as_json(capsys, 'friction', BAGS[0], *words)['statistics']
    straight = as_json(capsys, 'friction', BAGS[0])['statistics']
    for name in ('coulomb_friction', 'viscous_friction'):
        # The search for the lag stops within 1 % of its error.
        tolerance = 0.1 * straight[name]['error']
        assert turned[name]['mean'] == pytest.approx(straight[name]['mean'], abs=tolerance)


def test_force_of_the_wrong_sign_is_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    """Friction must be positive."""
    _, err = identify(capsys, 'friction', BAGS[0], '--force-axis', '-y', status=2)
    assert 'must not be negative' in err


def test_invalid_bag_is_reported_and_the_others_are_used(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The result is from the other bags; exit status 2 indicates that bags are missing."""
    bad, file = str(tmp_path / 'bad.mcap'), tmp_path / 'result.yaml'
    Path(bad).write_bytes(b'not a bag')
    found = as_json(capsys, 'friction', BAGS[0], bad, BAGS[1], '-o', str(file), status=2)
    assert [one['name'] for one in found['estimates']] == BAGS[:2]
    assert [one['name'] for one in found['failures']] == [bad]
    assert f'# from {BAGS[1]}' in file.read_text()
    assert bad not in file.read_text()
    out, err = identify(capsys, 'friction', BAGS[0], bad, status=2)
    assert BAGS[0] in out
    assert [bad in line for line in err.splitlines() if line.startswith('error: ')] == [True]


def test_nothing_is_written_without_a_usable_bag(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """No file, no folder, and only the reasons are printed."""
    bad = [str(tmp_path / name) for name in ('one', 'two')]
    file, page = tmp_path / 'result.yaml', tmp_path / 'report'
    out, err = identify(capsys, 'friction', *bad, '-o', str(file), '--report', str(page), status=2)
    assert out == ''
    assert err.count('does not exist') == 2
    assert not list(tmp_path.iterdir())


def test_undetermined_parameters_are_reported(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """An unidentifiable term for a single speed is undetermined, and not in the file."""
    file = tmp_path / 'result.yaml'
    words = ('friction', BAGS[0], '-o', str(file), '--terms', 'coulomb,viscous,stribeck')
    out, _ = identify(capsys, *words, '--stribeck-speed', '10')
    assert 'not determined by the data' in out
    found = as_json(capsys, *words, '--stribeck-speed', '10')
    unknown = [one for one in found['statistics'].values() if one['mean'] is None]
    assert unknown
    assert all(one['interval'] == [None, None] and one['error'] is None for one in unknown)


def test_friction_page_shows_the_results(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The page shows numbers, pictures and recordings, and loads no other files."""
    file, folder = tmp_path / 'result.yaml', tmp_path / 'new' / 'report'
    bags = [*BAGS, str(tmp_path / 'missing')]
    out, _ = identify(
        capsys, 'friction', *bags, '-o', str(file), '--report', str(folder), status=2
    )
    assert out.endswith(f'wrote {file}\nwrote {folder / "friction.html"}\n')
    seen = look_at(folder / 'friction.html')
    found = as_json(capsys, 'friction', *BAGS)
    for name in ('coulomb_friction', 'viscous_friction'):
        one = found['statistics'][name]
        assert re.search(rf'\b{one["mean"]:.3f}'[:-1], seen.text)
    for words in (
        'Coulomb friction', 'Table 1', '0.56 ± 0.0374', 'could not be used', 'missing',
        'Lost or corrected',
        found['recordings'][0]['files'][0][1], str(file), 'ros2 param set', *BAGS,
    ):  # fmt: skip
        assert words in seen.text
    assert len(seen.images) == 4
    assert all(alt and width > 500 for alt, width in seen.images)
    assert seen.requests == []
    assert seen.overflow == 0
    pictures = {path.stem for path in folder.glob('*.png')}
    assert pictures == {
        'friction_data', 'friction_each', 'friction_residuals', 'friction_spread',
    }  # fmt: skip


def test_same_recordings_give_the_same_page(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bytes are equal, for comparison and version control."""
    monkeypatch.setenv('SOURCE_DATE_EPOCH', '1700000000')
    pages = []
    for _ in range(2):
        identify(capsys, 'friction', BAGS[0], '--report', str(tmp_path / 'report'))
        pages.append((tmp_path / 'report' / 'friction.html').read_bytes())
        shutil.rmtree(tmp_path / 'report')
    assert pages[0] == pages[1]


def test_table_and_page_are_written_without_determined_parameters(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A single speed determines no parameter; the parameter file is not written."""
    time = np.arange(0.0, 20.0, 0.01)
    depth = 0.1 + 0.01 * np.abs((time / 4.0) % 2.0 - 1.0)
    force = np.sign(np.gradient(depth)) + 0.01 * np.sin(37.0 * time)
    table = tmp_path / 'one_speed.csv'
    np.savetxt(
        table, np.column_stack([time, depth, force]), delimiter=',', header='time,depth,force',
        comments='',
    )  # fmt: skip
    words = ('friction', str(table), '-o', str(tmp_path / 'x.yaml'), '--report', str(tmp_path))
    out, err = identify(capsys, *words, status=2)
    assert 'not determined by the data' in out
    assert 'wrote' in out
    assert 'the data determine no parameter' in err.splitlines()[-1]
    assert (tmp_path / 'friction.html').exists()
    assert not (tmp_path / 'x.yaml').exists()


def test_similar_warnings_are_grouped(capsys: pytest.CaptureFixture[str]) -> None:
    """A line has the number of similar warnings; an option lists all."""
    bags = sorted(str(path) for path in SHIPPED_BAGS.glob('stiffness_0*'))
    _, short = identify(capsys, 'stiffness', *bags)
    _, full = identify(capsys, 'stiffness', *bags, '--all-warnings')
    assert len(short.splitlines()) <= 5 < 20 < len(full.splitlines())
    assert 'more like it' in short
    assert '--all-warnings' in short.splitlines()[-1]


def test_folder_that_cannot_be_created_is_reported_in_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The message has the reason of the operating system; exit status 2."""
    _, err = identify(capsys, 'friction', BAGS[0], '--report', '/dev/null/report', status=2)
    assert '/dev/null/report cannot be written' in err.splitlines()[-1]


# Stiffness.


def test_stiffness_table_has_a_column_per_force_as_table_2(
    capsys: pytest.CaptureFixture[str], places: list[str]
) -> None:
    """Each entry of the matrix at each force, and k_a at the largest force."""
    out, _ = identify(capsys, 'stiffness', *places)
    matrices, intervals, predicted, spring, result = out.strip().split('\n\n')
    assert re.match('place_1, 1.10 N: a spring: antisymmetric part .*; 3 more like it$', spring)
    assert re.findall(r'^1\.\d\d N: force of a recording', predicted, re.MULTILINE)
    assert re.split(r' {2,}', matrices.splitlines()[0])[1:] == ['1.10 N', '1.50 N']
    assert re.findall(r'^1\.\d\d N', intervals, re.MULTILINE) == ['1.10 N', '1.50 N']
    for i, entry in enumerate(('k_xx', 'k_xz', 'k_zx', 'k_zz')):
        (line,) = [line for line in matrices.splitlines() if line.startswith(f'{entry} ')]
        told = [float(cell.split(' ±')[0]) for cell in re.split(r' {2,}', line)[1:]]
        truth = [stiffness.flat[i] for stiffness in STIFFNESS.values()]
        # Noise of 1 um and 2 mN over 30 samples and 8 presses: a few N/m.
        assert told == pytest.approx(truth, abs=5.0)
    assert result.startswith('k_a = 5')


@pytest.mark.parametrize('what', ['friction', 'stiffness', 'steering'])
def test_the_help_lists_tables_where_they_are_read(
    capsys: pytest.CaptureFixture[str], what: str
) -> None:
    """Presses are read from bags only."""
    with pytest.raises(SystemExit):
        main(['identify', what, '--help'])
    (recordings,) = re.findall(r'RECORDING  .*?status', capsys.readouterr().out, re.DOTALL)
    assert ('.csv' in recordings) == (what != 'stiffness')


def test_force_level_of_the_result_can_be_selected(
    capsys: pytest.CaptureFixture[str], places: list[str], tmp_path: Path
) -> None:
    """The parameter file has k_a at this force, over the contact length."""
    file = tmp_path / 'result.yaml'
    words = ('--level', '1.1', '--contact-length', '2', '-o', str(file))
    found = as_json(capsys, 'stiffness', *places, *words)
    values = yaml.safe_load(file.read_text())['/**/plant']['ros__parameters']
    assert values['model.tissue_stiffness'] == pytest.approx(505.0, abs=5.0)
    assert found['tissue_stiffness']['mean'] == pytest.approx(505.0, abs=5.0)
    assert [level['force'] for level in found['levels']] == pytest.approx([1.1, 1.5], abs=0.01)
    spring = found['estimates'][0]['levels'][0]['spring']
    assert found['estimates'][0]['levels'][0]['presses'] == 8
    assert spring['value'] == pytest.approx(20.0 / 1625.0, abs=5e-3)
    _, err = identify(capsys, 'stiffness', *places, '--level', '3', status=2)
    assert 'no level at 3 N' in err


def test_plane_of_the_presses_can_be_selected(
    capsys: pytest.CaptureFixture[str], places: list[str]
) -> None:
    """Swapped and reversed axes transform the matrix."""
    found = as_json(capsys, 'stiffness', *places, '--axes', '-z,x')['levels'][0]['statistics']
    k = STIFFNESS[1.1]
    assert found['k_xx']['mean'] == pytest.approx(k[1, 1], abs=5.0)
    assert found['k_xz']['mean'] == pytest.approx(-k[1, 0], abs=5.0)
    _, err = identify(capsys, 'stiffness', *places, '--axes', 'x', status=2)
    assert '--axes must name two axes' in err


def test_rotated_axes_of_the_force_are_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """In the terminal and in JSON, for each force or for forces alike."""
    path, angle = str(tmp_path / 'place'), 0.3
    c, s = np.cos(angle), np.sin(angle)
    write_presses(Path(path), turn_force=((c, -s), (s, c)))
    out, _ = identify(capsys, 'stiffness', path)
    (told,) = re.findall(r'^place, 1\.10 N: not a spring unless .* rotation of (\S+) ', out, re.M)
    # Without the rotation the presses have a curl of -20 N/m in 2270 N/m, -0.5 degrees.
    # Twice its printed error.
    assert float(told) == pytest.approx(np.degrees(angle - 20.0 / 2270.0), abs=0.04)
    (one,) = as_json(capsys, 'stiffness', path)['estimates']
    assert all('not a spring unless' in level['words'] for level in one['levels'])


def test_presses_with_a_reversed_force_are_rejected(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The sign is named, also if the kind is not given."""
    path, file = str(tmp_path / 'place'), tmp_path / 'result.yaml'
    write_presses(Path(path), turn_force=((-1, 0), (0, -1)))
    for words in (['stiffness', path, '-o', str(file)], [path]):
        _, err = identify(capsys, *words, status=2)
        assert 'stiffness must not be negative, got k_xx = -' in err
    assert not file.exists()


def test_friction_figures_draw_excluded_samples() -> None:
    """Each sample is drawn against velocity, those without a part in the fit by their name."""
    estimate = identify_friction(simulated())
    fit = estimate.fit
    for figure in (friction_data(estimate), friction_each([estimate], ['one'])):
        against = figure.axes[-1]
        lines = {str(line.get_label()): line for line in against.get_lines()}
        speeds = np.asarray(lines['excluded from the fit'].get_xdata())
        assert np.isin(speeds, 1e3 * fit.velocity[~fit.used]).all()
        assert len(speeds) >= min(300, int(np.count_nonzero(~fit.used)))


def test_stiffness_page_shows_the_results(
    capsys: pytest.CaptureFixture[str], places: list[str], tmp_path: Path
) -> None:
    """The page shows matrices, Table 2, the test for a spring, and the pictures."""
    folder = tmp_path / 'report'
    identify(capsys, 'stiffness', *places, '--report', str(folder))
    seen = look_at(folder / 'stiffness.html')
    for words in (
        'ka',
        'Table 2',
        '1260 (80)',
        'Symmetric stiffness matrices',
        'principal',
        *places,
    ):
        assert words in seen.text
    assert len(seen.images) == 4
    assert all(alt and width > 500 for alt, width in seen.images)
    assert seen.requests == []
    assert seen.overflow == 0
