# SPDX-License-Identifier: Apache-2.0
"""Units and rows of the tables of others are found by names and values."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from pathlib import Path
import re
from typing import Final

from benchmarks.steering_fit import drawn, FitTruth, insertion
from needle_dynamics.arrays import FloatArray
from needle_identification import inspect_recording, read_steering_recording
from needle_identification.errors import RecordingError
from needle_identification.steering.recording import credible
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.io import savemat
from support.steered_recording import recorded_plant


def written(path: Path, names: str, columns: FloatArray) -> Path:
    np.savetxt(path, columns, delimiter=',', header=names, comments='')
    return path


LAYOUTS: Final = {
    # Names, and factors of depth, guide x and z, tip x, y and z [1/m].
    'one stage and tracker in mm': (
        'Base y,Base x,Base z,Tip x,Tip y,Tip z', (-1e3, 1e3, 1e3, 1e3, -1e3, 1e3)
    ),
    'depth in mm, tip in m': ('depth,guide_x,guide_z,tip_x,tip_y,tip_z', (1e3, 1, 1, 1, 1, 1)),
    'depth in m, tip in mm': (
        'insertion,xguide,zguide,tip_x,tip_y,tip_z', (1, 1, 1, 1e3, 1e3, 1e3)
    ),
    'tip in cm by its motion along the needle': (
        'depth_mm,guide_x_mm,guide_z_mm,Tip x,Tip y,Tip z', (1e3, 1e3, 1e3, 1e2, 1e2, 1e2)
    ),
    'unit of one column of a body': (
        'Base y [cm],Base x,Base z,tip_x_mm,tip_y_mm,tip_z', (1e2, 1e2, 1e2, 1e3, 1e3, 1e3)
    ),
}  # fmt: skip


@pytest.mark.parametrize('layout', LAYOUTS)
def test_each_body_has_its_own_unit(tmp_path: Path, layout: str) -> None:
    """A column above 1 does not decide the unit of another body."""
    rng = np.random.default_rng(5)
    depth = np.linspace(0.0, 0.1, 21)
    guide, tip = 4e-3 * rng.normal(size=(2, 21, 2))
    along = 0.97 * depth + 0.01
    rows = np.column_stack([depth, guide, tip[:, 0], along, tip[:, 1]])
    names, factors = LAYOUTS[layout]
    found = read_steering_recording(written(tmp_path / 'run.csv', names, rows * factors))
    # 18 digits in the file.
    assert_allclose(found.depth, depth, atol=1e-12)
    assert_allclose(found.guide, guide, atol=1e-12)
    assert_allclose(found.tip, tip, atol=1e-12)


def test_matrices_of_matlab_have_a_row_for_each_coordinate(tmp_path: Path) -> None:
    """Position of the guide and pose of the tip as matrices of either direction."""
    rng = np.random.default_rng(6)
    depth = np.linspace(0.0, 0.1, 21)
    guide, tip = 4e-3 * rng.normal(size=(2, 21, 2))
    base = 1e3 * np.column_stack([guide[:, 0], -depth, guide[:, 1]])
    pose = np.column_stack([tip[:, 0], 0.01 - depth, tip[:, 1], np.ones(21), np.zeros((21, 3))])
    pose[:, :3] *= 1e3
    for turned in (False, True):
        path = tmp_path / f'run_{turned}.mat'
        whole = {'base': base.T if turned else base, 'tip': pose.T if turned else pose}
        savemat(path, {**whole, 'target': np.ones((3, 1)), 'frames': np.ones((4, 4, 21))})
        found = read_steering_recording(path)
        assert_allclose(found.depth, depth, atol=1e-12)
        assert_allclose(found.guide, guide, atol=1e-12)
        assert_allclose(found.tip, tip, atol=1e-12)
        assert any('frames, target of another length' in line for line in found.losses)


def test_rows_before_the_skin_are_left_out(tmp_path: Path) -> None:
    """A robot may move back before it inserts the needle."""
    depth = np.array([0.0, -2.0, -5.0, -2.0, 0.0, *np.linspace(5.0, 100.0, 20)])
    rows = np.column_stack([depth, *np.full((3, len(depth)), 3.0), np.arange(len(depth))])
    names = 'depth_mm,guide_x_mm,guide_z_mm,tip_x_mm,tip_z_mm'
    found = read_steering_recording(written(tmp_path / 'run.csv', names, rows))
    assert_allclose(found.depth, 1e-3 * depth[4:], atol=1e-12)
    assert '4 rows before the needle enters the skin, left out' in found.losses
    # Too far for a motion at the skin.
    rows[:5, 0] *= 10.0
    with pytest.raises(RecordingError, match='out of the skin'):
        read_steering_recording(written(tmp_path / 'wrong.csv', names, rows))


@pytest.mark.parametrize(
    ('first', 'start', 'words'),
    [
        (0.0, 0.0, None),
        (0.9, 0.9, None),
        (15.0, 15.0, 'the first depth is 15 mm: the needle counts as straight to it; if'),
        (29.0, 29.0, 'the first depth is 29 mm: the needle counts as straight to it; if'),
        (40.0, 0.0, 'depths relative to the first depth, 40 mm, at the skin'),
    ],
)
def test_the_depth_of_the_skin_is_stated(
    tmp_path: Path, first: float, start: float, words: str | None
) -> None:
    rows = 1e3 * inserted(1e-3 * first + INTO)
    path = written(tmp_path / 'run.csv', NAMES.replace('[m]', '[mm]'), rows)
    found = read_steering_recording(path)
    assert_allclose(found.depth, 1e-3 * start + INTO, atol=1e-12)
    said = [line for line in found.losses if 'first depth' in line]
    assert [line[: len(words or '')] for line in said] == [words] * (words is not None)


def test_a_depth_in_mm_or_cm_needs_its_unit(tmp_path: Path) -> None:
    rows = np.column_stack([np.linspace(0.0, 10.0, 11), *np.full((4, 11), 0.001)])
    rows[:, 3] += np.linspace(0.0, 0.002, 11)
    path = written(tmp_path / 'run.csv', 'depth,guide_x,guide_z,tip_x,tip_z', rows)
    with pytest.raises(RecordingError, match=r'depth spans 10 without a unit, mm or cm: use'):
        read_steering_recording(path)
    found = read_steering_recording(path, columns={'depth': 'depth[cm]'})
    assert found.depth.max() == pytest.approx(0.1)


def test_roll_in_degrees_is_recognized(tmp_path: Path) -> None:
    """Two turns have 12.6 rad; a rotation beyond is in degrees."""
    for turn, unit in ((90.0, pi / 180.0), (6.0, 1.0)):
        rows = np.column_stack([np.linspace(0.0, 0.1, 11), *np.full((4, 11), 0.001)])
        rows[:, 3] += np.linspace(0.0, 0.002, 11)
        rows = np.column_stack([rows, np.linspace(0.0, turn, 11)])
        names = 'depth,guide_x,guide_z,tip_x,tip_z,roll'
        found = read_steering_recording(written(tmp_path / 'run.csv', names, rows))
        assert found.roll[-1] == pytest.approx(turn * unit)


def test_a_named_column_keeps_the_selection_of_rows(tmp_path: Path) -> None:
    steps = np.repeat(np.arange(6.0), 3)
    rows = np.column_stack(
        [2.0 + 0.0 * steps, -10.0 * steps, 0.0 * steps, 1e9 + steps, steps, steps, 0.0 * steps]
    )
    names = 'Base x,Base y,Base z,Base sec,Base nanosec,tip_x_mm,tip_z_mm'
    path = written(tmp_path / 'run.csv', names, rows)
    plain = read_steering_recording(path)
    named = read_steering_recording(path, columns={'tip_x': 'tip_x_mm', 'depth': '-Base y[mm]'})
    assert len(plain.depth) == 6
    assert_allclose(named.depth, plain.depth)
    assert_allclose(named.guide, plain.guide)


def inserted(depth: FloatArray) -> FloatArray:
    """Return depth, guide and tip [m], (n, 5), with lateral positions of a few millimeters."""
    rng = np.random.default_rng(len(depth))
    return np.column_stack([depth, 2e-3 * rng.normal(size=(len(depth), 4))])


NAMES: Final = 'depth [m],guide_x [m],guide_z [m],tip_x [m],tip_z [m]'
INTO: Final = np.linspace(0.0, 0.1, 21)


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('unit', ['[counts]', '(px)', '[rev]'])
@pytest.mark.parametrize('role', ['depth', 'guide_x', 'tip_z'])
def test_an_unknown_unit_is_an_error(tmp_path: Path, role: str, unit: str, sign: float) -> None:
    """Its numbers would be taken in mm, by their size; a unit in the option replaces it."""
    rows = 1e3 * inserted(sign * INTO)
    names = NAMES.replace('[m]', '[mm]').replace(f'{role} [mm]', f'{role} {unit}')
    path = written(tmp_path / 'run.csv', names, rows)
    words = f"the unit '{unit[1:-1]}' of the column '{role} {unit}' is not one of m, mm"
    with pytest.raises(RecordingError, match=re.escape(words)):
        read_steering_recording(path)
    found = inspect_recording(path)
    assert words.removeprefix('the') in found.lacking
    assert f'{unit}[' not in found.command
    # A depth that decreases has its sign in the option.
    spec = f'{"-" * (role == "depth" and sign < 0.0)}{role} {unit}[mm]'
    assert read_steering_recording(path, columns={role: spec}).depth.max() == pytest.approx(0.1)


@pytest.mark.parametrize(
    ('unit', 'factor'), [('inches', 0.0254), ('micron', 1e-6), ('microns', 1e-6)]
)
def test_words_for_units_of_length(tmp_path: Path, unit: str, factor: float) -> None:
    rows = inserted(INTO)
    expected = rows[:, 3:].copy()
    rows[:, 3:] /= factor
    names = NAMES.replace('tip_x [m],tip_z [m]', f'tip_x [{unit}],tip_z [{unit}]')
    found = read_steering_recording(written(tmp_path / 'run.csv', names, rows))
    # 18 digits in the file.
    assert_allclose(found.tip, expected, atol=1e-12)


@pytest.mark.parametrize('names', ['time [s]', 'sec,nanosec'])
def test_a_second_run_in_a_table_is_an_error(tmp_path: Path, names: str) -> None:
    """By its time, in two insertions of 21 readings each, also deeper and deeper."""
    time = np.column_stack([2.0 * np.arange(21.0), np.zeros((21, names.count(',')))])
    runs = [np.column_stack([time, inserted(0.5 * INTO + begin)]) for begin in (0.0, 0.05)]
    path = written(tmp_path / 'two.csv', f'{names},{NAMES}', np.vstack(runs))
    with pytest.raises(RecordingError, match='time restarts at row 22 of 42: split the file'):
        read_steering_recording(path)
    one = written(tmp_path / 'one.csv', f'{names},{NAMES}', runs[0])
    assert len(read_steering_recording(one).depth) == 21


@pytest.mark.parametrize('deepest', [(0.1, 0.1, 0.1), (0.03, 0.1), (0.1, 0.03)])
@pytest.mark.parametrize('air', [0, 4])
def test_a_second_insertion_in_a_table_is_an_error(
    tmp_path: Path, deepest: tuple[float, ...], air: int
) -> None:
    """By its depth, without a time; rows in front of the skin, left out, count as rows."""
    depth = np.concatenate([-1e-3 * np.arange(air), *(10.0 * most * INTO for most in deepest)])
    path = written(tmp_path / 'runs.csv', NAMES, inserted(depth))
    words = f'second insertion starts at row {22 + air} of {len(depth)}, with a depth of 0 mm'
    with pytest.raises(RecordingError, match=f'{words} after .* mm: split the file, one for each'):
        read_steering_recording(path)


@pytest.mark.parametrize('begin', [3, 8])
@pytest.mark.parametrize('rest', [1, 3])
@pytest.mark.parametrize('out', [0, 2])
def test_insertions_that_begin_in_the_tissue_are_an_error(
    tmp_path: Path, begin: int, rest: int, out: int
) -> None:
    """At 15 or 40 mm, with several rows at each depth, and with the begin of the withdrawal."""
    one = [*INTO[begin:], *INTO[-2 : -2 - out : -1]]
    # The robot at rest moves by micrometers.
    depth = np.repeat(one * 4, rest)
    depth += 1e-6 * np.random.default_rng(0).normal(size=len(depth))
    path = written(tmp_path / 'runs.csv', NAMES, inserted(depth))
    words = f'second insertion starts at row {rest * len(one) + 1} of {len(depth)}, with a depth'
    with pytest.raises(RecordingError, match=words):
        read_steering_recording(path)


def test_a_needle_that_is_withdrawn_is_one_insertion(tmp_path: Path) -> None:
    """Slowly or in long steps, at the end or before the insertion continues, with rows missing."""
    out, back = np.linspace(0.1, 0.0, 100), INTO[16:7:-1]
    for depth in (
        [*INTO, *out],
        [*INTO, *out[::30]],
        [*INTO[:11], *INTO[10:5:-1], *INTO[6:]],
        [0.0, 5e-3, *INTO],
        [*INTO, *INTO[15:5:-5], *INTO[5:]],
        [*INTO[:17], *back[6:], *INTO[9:]],
        [*INTO[:4], *INTO[12:]],
    ):
        path = written(tmp_path / 'run.csv', NAMES, inserted(np.array(depth)))
        assert len(read_steering_recording(path).depth) == len(depth)


@pytest.mark.parametrize('factors', [(1.0, 1.0), (1e3, 1e3), (1.0, 1e3)])
@pytest.mark.parametrize('origin', [(0.21, -0.13), (0.0, 0.02)])
def test_zeros_of_a_tracker_that_is_lost_are_not_measured(
    tmp_path: Path, factors: tuple[float, float], origin: tuple[float, float]
) -> None:
    """Before its first position and later, in m and mm; units are found without them."""
    rows = np.insert(inserted(INTO), 5, 0.3 + INTO, axis=1)
    rows[:, [3, 4]] += origin
    expected = rows[:, 3:5].copy()
    lost = [0, 1, 12]
    rows[lost, 3:] = 0.0
    rows *= np.repeat(factors, 3)
    names = 'depth,guide_x,guide_z,tip_x,tip_z,tip_y'
    found = read_steering_recording(written(tmp_path / 'run.csv', names, rows))
    assert '3 samples of the tip are zero: not measured, left out' in found.losses
    assert not any('not numbers' in line or 'implausible' in line for line in found.losses)
    assert (~found.known).nonzero()[0].tolist() == lost
    assert_allclose(found.tip[found.known], expected[found.known], atol=1e-12)


def test_a_tip_at_the_origin_is_measured(tmp_path: Path) -> None:
    """Simulations start there."""
    rows = inserted(INTO)
    rows[:, 3:] = np.outer(INTO**2, [0.0, 0.5])
    found = read_steering_recording(written(tmp_path / 'run.csv', NAMES, rows))
    assert found.known.all()


@pytest.mark.parametrize(
    ('name', 'spec', 'words'),
    [
        ('d', 'd', "to 100 m, a needle to at most 1 m: is d in mm? Use --columns 'depth=d[mm]'"),
        ('d', '-d', "is -d in mm? Use --columns 'depth=-d[mm]'"),
        ('d [m]', 'd [m]', "is d [m] in mm? Use --columns 'depth=d [m][mm]'"),
        ('d', 'd[cm]', 'goes to 1.2 m, a needle to at most 1 m: is d[cm] in mm? Use'),
    ],
)
def test_a_needle_of_more_than_1_m_is_an_error(
    tmp_path: Path, name: str, spec: str, words: str
) -> None:
    """In elements of 1.5 mm its simulation has no end."""
    rows = inserted(INTO) * 1e3
    rows[:, 0] *= {'-d': -1.0, 'd[cm]': 1.2}.get(spec, 1.0)
    path = written(tmp_path / 'run.csv', NAMES.replace('depth [m]', name), rows)
    with pytest.raises(RecordingError, match=re.escape(words)):
        read_steering_recording(path, columns={'depth': spec})
    right = {'depth': words.partition('depth=')[2].rstrip("'") or 'd[mm]'}
    assert read_steering_recording(path, columns=right).depth.max() < 0.2


@pytest.mark.parametrize('noise', [1.8e-4, 1e-3])
@pytest.mark.parametrize('steer', [3e-4, 1.5e-3, 4e-3])
def test_readings_of_a_steered_needle_are_credible(steer: float, noise: float) -> None:
    """With motions of the guide of several millimeters between rows, and much noise."""
    for seed in range(40):
        for truth in (FitTruth(), drawn(seed)):
            one = insertion(seed, replace(truth, noise=noise), steer=steer)
            good, words = credible(one.depth, one.guide - one.guide[0], one.tip - one.tip[0])
            assert good.all()
            assert not words


@pytest.mark.parametrize('row', [1, 9, 19])
def test_a_single_position_far_from_the_others_is_discarded(tmp_path: Path, row: int) -> None:
    """By 15 mm; a tip that stays there, or rows that are missing, are measured."""
    one = insertion(3)
    rows = np.column_stack([one.depth, one.guide, one.tip])
    rows[row, 3] += 0.015
    found = read_steering_recording(written(tmp_path / 'run.csv', NAMES, rows))
    assert (~found.known).nonzero()[0].tolist() == [row]
    depth = 1e3 * one.depth[row]
    words = f'1 samples of the tip far from the rows around, at depths [mm] of {depth:g}, left out'
    assert words in found.losses
    rows[row + 1 :, 3] += 0.015
    found = read_steering_recording(written(tmp_path / 'step.csv', NAMES, rows))
    assert found.known.all()
    rows = np.delete(np.column_stack([one.depth, one.guide, one.tip]), np.s_[2:8], axis=0)
    found = read_steering_recording(written(tmp_path / 'gap.csv', NAMES, rows))
    assert found.known.all()


def test_second_insertion_of_a_bag_is_left_out(tmp_path: Path) -> None:
    """With its time; the needle would follow the path that it has cut before."""
    once, twice = (
        read_steering_recording(recorded_plant(tmp_path / str(again), 1, twice=again))
        for again in (False, True)
    )
    (words,) = (loss for loss in twice.losses if 'insertion begins' in loss)
    found = re.fullmatch(r'a second insertion begins ([.0-9]+) s after the start, left out', words)
    assert found
    # The period of the tracker, its delay, and a lost reading.
    assert float(found[1]) == pytest.approx(18.0, abs=0.1)
    assert not any('insertion begins' in loss for loss in once.losses)
    deepest = int(np.argmax(once.depth > 0.099))
    assert_allclose(twice.depth[:deepest], once.depth[:deepest], atol=1e-9)
    assert twice.depth[-1] < 0.01
