# SPDX-License-Identifier: Apache-2.0
"""Tables of other tools are read, or rejected by a one-line error with instructions."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
import re
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_identification import (
    identify_friction,
    inspect_recording,
    read_friction_recording,
    RecordingError,
)
from needle_identification.recordings import samples, tables
from needle_identification.recordings.tables import column_roles, guessed, read_table
from needle_identification.sensor.reading import read_sensor_recording
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.io import savemat
from support.strokes import COULOMB, strokes, VISCOUS

NAMED = {'time': 't', 'depth': 'q', 'force': 'F'}


def lines(head: str, *columns: Any, separator: str = ',', form: str = '.9g') -> str:
    rows = [separator.join(format(x, form) for x in row) for row in zip(*columns, strict=True)]
    return '\n'.join([head, *rows, '']) if head else '\n'.join([*rows, ''])


def dated(time: float) -> str:
    begin = datetime(2024, 2, 28, 23, 59, 55, tzinfo=timezone.utc)
    return (begin + timedelta(seconds=time)).isoformat(timespec='microseconds')


@pytest.fixture(scope='module')
def run() -> tuple[Any, Any, Any]:
    made = strokes(seed=1)
    return made.time, made.depth, made.force


def written(folder: Path, text: str, name: str = 'run.csv', encoding: str = 'utf-8') -> Path:
    path = folder / name
    path.write_text(text, encoding=encoding)
    return path


@pytest.mark.parametrize('encoding', ['utf-8', 'utf-8-sig', 'utf-16', 'cp1252'])
def test_encodings_of_spreadsheets(tmp_path: Path, run: Any, encoding: str) -> None:
    """The micro sign of a unit, and the end of the last line, are found in each."""
    time, depth, force = run
    text = lines('time [s]\tposition [µm]\tforce [N]', time, 1e6 * depth, force, separator='\t')
    path = written(tmp_path, text, encoding=encoding)
    # Nine digits are written.
    assert_allclose(read_friction_recording(path).depth, depth, rtol=1e-8)
    assert read_table(path).losses == []
    cut = read_table(written(tmp_path, text[:-1], encoding=encoding))
    assert cut.losses == ['the last line has no end: the file may be cut off']


@pytest.mark.parametrize(
    ('head', 'unit'),
    [
        ('t [s],q [m],F [V]', 'V'),
        ('t [s],q (deg),F [N]', 'deg'),
        ('t [ticks],q [m],F [N]', 'ticks'),
    ],
)
def test_unknown_unit_is_rejected(tmp_path: Path, run: Any, head: str, unit: str) -> None:
    """Its numbers would be taken as SI units; a unit in the option replaces it."""
    path = written(tmp_path, lines(head, *run))
    roles = dict(zip(('time', 'depth', 'force'), head.split(','), strict=True))
    with pytest.raises(RecordingError, match=f"the unit '{unit}' of the column"):
        read_friction_recording(path, columns=roles)
    assert f"the unit '{unit}'" in inspect_recording(path).lacking
    units = {'time': 's', 'depth': 'm', 'force': 'N'}
    given = {role: f'{name}[{units[role]}]' for role, name in roles.items()}
    # Nine digits are written.
    assert_allclose(read_friction_recording(path, columns=given).force, run[2], rtol=1e-8)


def test_decimal_commas_between_commas_are_named(tmp_path: Path, run: Any) -> None:
    """Each number is two values then; whole numbers in pairs are values if each has a name."""
    time, depth, force = run
    head = 'time [s],depth [m],force [N]'
    rows = lines(head, time, depth, force, separator=';').replace('.', ',').replace(';', ',')
    words = 'rows have 6 values and the header 3 names: with decimal commas, columns need another'
    with pytest.raises(RecordingError, match=words):
        read_table(written(tmp_path, rows))
    whole = '\n'.join(['a,b,c,d', *(f'{k},{k},-{k},{k}' for k in range(9))])
    assert [*read_table(written(tmp_path, whole)).columns] == ['a', 'b', 'c', 'd']


def test_units_of_inches_and_indices(tmp_path: Path, run: Any) -> None:
    """Inches are read in brackets; an index in brackets is no unit, an ending no inch."""
    time, depth, force = run
    path = written(tmp_path, lines('time [s],depth [in],force [N]', time, depth / 0.0254, force))
    # Nine digits are written.
    assert_allclose(read_friction_recording(path).depth, depth, rtol=1e-8)
    for name in ('position[0]', 'q_in'):
        path = written(tmp_path, lines(f'time,{name},force', time, depth, force))
        found = read_friction_recording(path, columns={'depth': name})
        assert_allclose(found.depth, depth, rtol=1e-8)


def test_column_of_time_with_a_colon(tmp_path: Path, run: Any) -> None:
    """A whole name is no pair of seconds and nanoseconds."""
    path = written(tmp_path, lines('t:0,q,F', *run))
    found = read_friction_recording(path, columns={'time': 't:0', 'depth': 'q', 'force': 'F'})
    # Stamps are rounded to nanoseconds, and nine digits are written.
    assert_allclose(found.time, run[0] - run[0][0], atol=1e-8)


FORMS: dict[str, tuple[Callable[..., str], dict[str, str]]] = {
    'usual names': (lambda t, q, f: lines('time,position,force', t, q, f), {}),
    'units in brackets': (
        lambda t, q, f: lines('Time [ms],Position (mm),Force [mN]', 1e3 * t, 1e3 * q, 1e3 * f), {},
    ),
    'units in names': (
        lambda t, q, f: lines('t_ms;pos_mm;force_N', 1e3 * t, 1e3 * q, f, separator=';'), {},
    ),
    'units in a line': (
        lambda t, q, f: lines('time\tpos\tforce\ns\tmm\tN', t, 1e3 * q, f, separator='\t'), {},
    ),
    'comments': (lambda t, q, f: lines('# lab 3\n# t q force', t, q, f, separator=' '), {}),
    'no head': (
        lambda t, q, f: lines('', t, q, f), {'time': '1', 'depth': '2', 'force': '3'},
    ),
    'turned around': (
        lambda t, q, f: lines('t,q,F', t, -q, -2.0 * f),
        {**NAMED, 'depth': '-q', 'force': '-F*0.5[N]'},
    ),
    'decimal commas': (
        lambda t, q, f: lines('t;q;F', t, q, f, separator=';').replace('.', ','), NAMED,
    ),
    'blanks and decimal commas': (
        lambda t, q, f: lines('t q F', t, q, f, separator='  ').replace('.', ','), NAMED,
    ),
    'quoted decimal commas': (
        lambda t, q, f: re.sub('[^,\n]+', r'"\g<0>"', lines('t,q,F', t, q, f)).replace('.', ','),
        NAMED,
    ),
    'seconds and nanoseconds': (
        lambda t, q, f: lines(
            'header.stamp.sec,header.stamp.nanosec,frame_id,q,F',
            1_700_000_000 + np.floor(t), np.rint(1e9 * (t % 1.0)), 0.0 * t, q, f, form='.12g',
        ).replace(',0,', ',base,'),
        {'depth': 'q', 'force': 'F'},
    ),
    'dates': (
        lambda t, q, f: lines('when,q,F', [dated(x) for x in t], q, f, form=''),
        {**NAMED, 'time': 'when'},
    ),
}  # fmt: skip


@pytest.mark.parametrize('form', FORMS)
def test_all_table_formats_give_the_same_friction(
    form: str, run: tuple[Any, Any, Any], tmp_path: Path
) -> None:
    make, columns = FORMS[form]
    path = written(tmp_path, make(*run))
    found = identify_friction(read_friction_recording(path, columns=columns))
    for name, truth in (('coulomb_friction', COULOMB), ('viscous_friction', VISCOUS)):
        assert abs(found[name].value - truth) < 4.0 * found[name].error


def test_matlab_files_have_columns_and_factors(run: tuple[Any, Any, Any], tmp_path: Path) -> None:
    time, depth, force = run
    savemat(
        tmp_path / 'run.mat',
        {
            't': time[:, np.newaxis], 'q': depth[np.newaxis], 'current': force / 35.0, 'k': 35.0,
            'note': 'lab', 'other': np.zeros(3), 'both': np.column_stack([time, force]),
        },
    )  # fmt: skip
    table = read_table(tmp_path / 'run.mat')
    assert {'t', 'q', 'current', 'both1', 'both2'} == set(table.columns)
    assert table.scalars == {'k': 35.0}
    assert table.losses == ['other of another length, left out']
    read = read_friction_recording(tmp_path / 'run.mat', columns={'force': 'current*k'})
    assert_allclose(read.force, force, rtol=1e-12)
    assert_allclose(read.depth, depth)


def test_probable_units_and_forces_are_found(run: tuple[Any, Any, Any], tmp_path: Path) -> None:
    """Times in ms, a depth in mm, and the only column in N under a name of its own."""
    time, depth, force = run
    path = tmp_path / 'run.csv'
    rows = np.column_stack([1e3 * time, 1e3 * depth, force])
    np.savetxt(path, rows, delimiter=',', header='time,depth,Push [N]', comments='')
    read = read_friction_recording(path)
    assert_allclose(read.force, force)
    for hint in ('perhaps time=time[ms]', 'perhaps depth=depth[mm]'):
        assert any(hint in line for line in read.losses), read.losses
    assert 'time=time[ms],depth=depth[mm],force=Push [N]' in inspect_recording(path).command
    rows[:, 2] *= 1e3
    np.savetxt(path, rows, delimiter=',', header='time,depth,force', comments='')
    hint = 'perhaps force=force[mN]'
    assert any(hint in line for line in read_friction_recording(path).losses)


def test_velocities_without_depth_are_integrated(tmp_path: Path) -> None:
    made = strokes(seed=2)
    path = written(
        tmp_path, lines('time,vel_mm/s,force', made.time, 1e3 * made.velocity, made.force)
    )
    read = read_friction_recording(path)
    assert any('integral of the speed' in words for words in read.losses)
    found = identify_friction(read)
    assert abs(found['viscous_friction'].value - VISCOUS) < 4.0 * found['viscous_friction'].error


@given(
    values=st.lists(
        st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=2, max_size=30
    ),
    separator=st.sampled_from([',', ';', '\t', ' ']),
)
def test_numbers_are_read_back_exactly(values: list[tuple[float, float]], separator: str) -> None:
    # A separate file for each example.
    from tempfile import TemporaryDirectory

    first, second = np.transpose(values)
    with TemporaryDirectory() as folder:
        text = lines(f'alpha{separator}beta', first, second, separator=separator, form='.17g')
        table = read_table(written(Path(folder), text))
    assert_allclose(table.columns['alpha'], first, rtol=0.0)
    assert_allclose(table.columns['beta'], second, rtol=0.0)


def test_unusable_rows_are_counted(tmp_path: Path) -> None:
    time = np.arange(500) / 100.0
    text = lines('time,depth,force', time, np.sin(time), np.cos(time)).splitlines()
    text[10] = 'n/a,1,2'
    text[20] = '0.2,oops'
    text[30] = text[29]
    text[40], text[41] = text[41], text[40]
    read = read_friction_recording(written(tmp_path, '\n'.join([*text, ''])))
    assert len(read.time) == 500 - 3
    assert read.losses == (
        '1 lines not readable, left out',
        'columns by their names: time=time, depth=depth, force=force',
        '1 rows with a value that is not a number, left out',
        '1 of the rows out of order, sorted by stamp',
        '1 of the rows with the stamp of another, left out',
    )


def test_probable_millimeters_without_unit_are_reported(tmp_path: Path) -> None:
    time = np.arange(500) / 100.0
    path = written(tmp_path, lines('time,depth,force', time, 30.0 * np.sin(time), np.cos(time)))
    assert any('depth[mm]' in words for words in read_friction_recording(path).losses)


@pytest.mark.parametrize('begin', [0.0, 0.0013, 0.15])
@pytest.mark.parametrize('line', ['', 'time,depth,force'])
def test_a_time_that_restarts_is_named(tmp_path: Path, run: Any, begin: float, line: str) -> None:
    """The rows of two runs are not interleaved, also if a second head is between them."""
    first, second = lines('time,depth,force', *run), lines(line, run[0] + begin, *run[1:])
    path = written(tmp_path, first + second)
    row = len(run[0]) + 1 + bool(line)
    with pytest.raises(RecordingError, match=f'time restarts at row {row} of .*: split the file'):
        read_friction_recording(path)
    assert 'time restarts' in inspect_recording(path).lacking


def test_other_orders_of_rows_are_no_restart(tmp_path: Path, run: Any) -> None:
    """Halves in exchanged order, random order, the newest first, and single times of zero."""
    rows = np.column_stack(run)
    half, random = len(rows) // 2, np.random.default_rng(1).permutation(len(rows))
    for other in (np.vstack([rows[half:], rows[:half]]), rows[random], rows[::-1]):
        read = read_friction_recording(written(tmp_path, lines('time,depth,force', *other.T)))
        # Nine digits are written.
        assert_allclose(read.force, run[2], rtol=1e-8)
    rows[[100, 500], 0] = 0.0
    read = read_friction_recording(written(tmp_path, lines('time,depth,force', *rows.T)))
    assert len(read.time) == len(rows) - 1


@pytest.mark.parametrize('separator', [',', ';', '\t'])
@pytest.mark.parametrize(
    'above',
    [
        'Channels,3',
        'Operator,Meier\nDate,2026-01-02\nSample,12',
        'Port,1\nFrames,3000\n',
        'Sample,1,2',
        '"Test","1"\n',
        'X-Steps 1',
    ],
)
@pytest.mark.parametrize('missing', [False, True])
def test_metadata_above_the_header_do_not_change_a_table(
    tmp_path: Path, run: Any, above: str, separator: str, missing: bool
) -> None:
    """Also if values of the first rows are missing."""
    text = lines('time,depth,force', *run)
    if missing:
        first, second, *rest = text.splitlines()[1:]
        first, second = (
            word.join(row.split(',')[::2]) for word, row in [(',n/a,', first), (',,', second)]
        )
        text = '\n'.join(['time,depth,force', first, second, *rest, ''])
    plain = read_table(written(tmp_path, text.replace(',', separator)))
    table = read_table(written(tmp_path, f'{above}\n{text}'.replace(',', separator)))
    assert [*table.columns] == ['time', 'depth', 'force']
    assert table.losses == plain.losses == []
    for name, column in plain.columns.items():
        assert len(column) == len(run[0])
        assert_array_equal(table.columns[name], column)


@pytest.mark.parametrize(('factor', 'unit'), [(1e3, 'ms'), (1e6, 'us'), (1e9, 'ns')])
def test_dates_without_their_unit_are_rejected(
    tmp_path: Path, run: Any, factor: float, unit: str
) -> None:
    """Times since 1970 in s are read, and with a unit in other units."""
    time, depth, force = run
    path = written(
        tmp_path, lines('time,q,F', factor * (1.76e9 + time), depth, force, form='.17g')
    )
    with pytest.raises(RecordingError, match=rf'time starts at 1.76e.*: is its.*time\[{unit}\]'):
        read_friction_recording(path)
    read = read_friction_recording(path, columns={'time': f'time[{unit}]'})
    # Of a double at 1.76e9 s.
    assert_allclose(read.time, time - time[0], atol=1e-6)


@pytest.mark.parametrize(
    ('text', 'columns', 'said'),
    [
        ('', {}, 'is empty; valid: a table'),
        ('hello\nworld\n', {}, 'no line of numbers'),
        (
            'a,b\n1,2\n2,3\n',
            {},
            r'which column is time and force and depth or speed\? It has a, b',
        ),
        ('t,q,F\n1,2,3\n2,3,4\n', {'time': 's'}, "no column 's' for time; it has t, q, F"),
        ('t,q,F\n1,2,3\n2,3,4\n', {'force': 'F[kg]'}, "must be one of N, mN, .*, got 'kg'"),
        ('t,q,F\n1,2,3\n2,3,4\n', {'force': 'F*k'}, 'a number or the name of one'),
        *(
            ('t,q,F\n1,2,3\n2,3,4\n', {'force': f'F*{word}'}, 'must be finite and not zero')
            for word in ('nan', 'inf', '0')
        ),
        ('t,q,F\n1,2,3\n1,3,4\n', {}, 'all rows have the same time'),
        ('t,q,F\n1,2,3\nnan,3,4\n', {}, '1 usable rows'),
        ('t,q,F\n1,2,3\n1e30,3,4\n', {}, 'is its unit right'),
    ],
)
def test_invalid_tables_are_rejected(
    text: str, columns: dict[str, str], said: str, tmp_path: Path
) -> None:
    with pytest.raises(RecordingError, match=said):
        read_friction_recording(written(tmp_path, text), columns=columns)


@pytest.mark.parametrize('words', ['', 'time', 'time=', 'tyme=t', 'time=t,force'])
def test_invalid_roles_are_rejected(words: str) -> None:
    with pytest.raises(RecordingError, match='--columns takes ROLE='):
        column_roles(words)
    assert column_roles('time=sec:nsec, force=-F*2[mN]') == {
        'time': 'sec:nsec',
        'force': '-F*2[mN]',
    }


def test_a_repeated_role_is_rejected() -> None:
    with pytest.raises(RecordingError, match='--columns names time twice: t and Zeit_ms'):
        column_roles('time=t,force=F,time=Zeit_ms')


def test_options_of_bags_are_rejected_for_tables(tmp_path: Path) -> None:
    path = written(tmp_path, 't,q,F\n1,2,3\n2,3,4\n')
    with pytest.raises(RecordingError, match='--columns takes the place of --force-axis'):
        read_friction_recording(path, force_axis='-z')
    with pytest.raises(RecordingError, match='--columns is for tables'):
        read_friction_recording('bags/friction_01', columns={'time': 't'})


def test_damaged_and_new_matlab_files_are_rejected(tmp_path: Path) -> None:
    for content in (b'', b'MATLAB 5.0 MAT-file' + bytes(500), bytes(range(256)) * 4):
        (tmp_path / 'run.mat').write_bytes(content)
        with pytest.raises(RecordingError):
            read_table(tmp_path / 'run.mat')
    (tmp_path / 'run.mat').write_bytes(
        b'MATLAB 7.3 MAT-file'.ljust(124) + b'\x00\x02IM' + bytes(500)
    )
    with pytest.raises(RecordingError, match=r'7\.3'):
        read_table(tmp_path / 'run.mat')


def test_usual_names_are_found_with_any_case_and_unit(tmp_path: Path) -> None:
    path = written(tmp_path, 'Timestamp (s),Insertion [mm],Velocity,Fz_N\n1,2,3,4\n2,3,4,5\n')
    assert guessed(read_table(path).columns) == {
        'time': 'Timestamp (s)',
        'depth': 'Insertion [mm]',
        'speed': 'Velocity',
        'force': 'Fz_N',
    }
    assert tables.is_table('A.CSV')
    assert not tables.is_table('a.mcap')


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_columns_of_any_language_are_found_by_their_units(tmp_path: Path, sign: float) -> None:
    """And the motion is reversed where the force opposes it."""
    recording = strokes()
    path = tmp_path / 'run.csv'
    columns = [1e3 * recording.time, 1e3 * sign * recording.depth, recording.force]
    path.write_text(lines('Zeit [ms];Achse_mm;Kraft [N]', *columns, separator=';'))
    found = inspect_recording(path)
    words = f"'time=Zeit [ms],depth={'-' if sign < 0.0 else ''}Achse_mm,force=Kraft [N]'"
    assert found.command == f'needle identify friction {path} --columns {words}'
    assert any('motion reversed' in one for one in found.words) == (sign < 0.0)


@pytest.mark.parametrize('heading', ['Zeit [s]', 'temps (s)', 'uhr_s'])
def test_the_only_column_with_a_unit_of_time_is_the_time(tmp_path: Path, heading: str) -> None:
    """Of friction, and of a tip sensor."""
    values = np.linspace(0.0, 1.0, 60), *np.random.default_rng(1).normal(size=(3, 60))
    path = written(tmp_path, lines(f'{heading},x [mm],y [mm],z [mm]', *values))
    read = read_sensor_recording(path, (0.0, 0.0, 0.0))
    assert_allclose(read.time, values[0], atol=1e-9)
    assert guessed([heading, 'q [mm]'])['time'] == heading


def test_averaged_rows_of_a_long_table_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(samples, 'MOST_SAMPLES', 1000)
    time = 0.005 * np.arange(1500)
    path = written(tmp_path, lines('time,depth,force', time, np.sin(time), np.cos(time)))
    assert 'averaged the rows over 0.01 s, because there are so many' in (
        read_friction_recording(path).losses
    )
