# SPDX-License-Identifier: Apache-2.0
"""Tables whose rows are not samples of force and motion at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from needle_identification import (
    FrictionEstimate,
    identify_friction,
    inspect_recording,
    read_friction_recording,
    RecordingError,
)
from needle_identification.recordings.friction_table import held_rows
import numpy as np
import pytest
from support.strokes import COULOMB, strokes, VISCOUS


def written(path: Path, names: str, *columns: Any) -> Path:
    rows = np.column_stack(columns)
    np.savetxt(path, rows, delimiter=',', fmt='%.9g', header=names, comments='')
    return path


def assert_true(found: FrictionEstimate, errors: float = 4.0) -> None:
    for name, truth in (('coulomb_friction', COULOMB), ('viscous_friction', VISCOUS)):
        assert abs(found[name].value - truth) < errors * found[name].error


@pytest.mark.parametrize('every', [2, 5, 10])
@pytest.mark.parametrize('has_speed', [False, True])
def test_repeated_positions_are_samples_of_their_own(
    tmp_path: Path, every: int, has_speed: bool
) -> None:
    """As those of a topic of the robot, at 125, 50 and 25 Hz."""
    made = strokes(seed=1, push=0.0)
    held = np.arange(len(made.time)) // every * every
    columns = [made.time, 1e3 * made.depth[held], made.force]
    columns += [made.velocity[held]] * has_speed
    names = 'time,q_mm,force' + ',speed' * has_speed
    read = read_friction_recording(written(tmp_path / 'run.csv', names, *columns))
    (line,) = [one for one in read.losses if 'repeated' in one]
    assert line.startswith(f'the motion is measured in every {every} rows')
    assert (read.velocity is not None) == has_speed
    assert_true(identify_friction(read))


def test_rests_and_counts_are_no_repetitions() -> None:
    """Counts of 1 um to 0.1 mm, at 250 Hz and speeds from less to more than a count a row."""
    made = strokes(seed=1, push=0.0)
    for size in (0.0, 1e-6, 1e-5, 1e-4):
        depth = np.round(made.depth / size) * size if size else made.depth
        for slower in (1.0, 0.1, 0.01):
            assert held_rows(slower * depth[:, None], made.force)[1] == 0
            counts = np.round(slower * made.depth / (size or 1e-7))
            assert held_rows(counts[:, None], made.force)[1] == 0


def test_only_the_whole_motion_is_repeated_and_not_the_force() -> None:
    """With a speed in each row, positions in some rows are of no importance."""
    made = strokes(seed=1, push=0.0)
    held = np.arange(len(made.time)) // 5 * 5
    depth = made.depth[held, None]
    assert held_rows(depth, made.force)[1] == 5
    assert held_rows(depth, made.force[held])[1] == 0
    assert held_rows(np.column_stack([depth, made.velocity[held]]), made.force)[1] == 5
    speed = made.velocity + 1e-6 * np.random.default_rng(0).normal(size=len(held))
    assert held_rows(np.column_stack([depth, speed]), made.force)[1] == 0


@pytest.mark.parametrize('has_force', [False, True])
def test_force_and_position_in_different_rows(tmp_path: Path, has_force: bool) -> None:
    """A row in four has a position, alone or with a force."""
    made = strokes(seed=1, push=0.0)
    moved = np.arange(len(made.time)) % 4 == 0
    depth = np.where(moved, made.depth, np.nan)
    force = np.where(moved & (not has_force), np.nan, made.force)
    path = written(tmp_path / 'run.csv', 'time,depth,force', made.time, depth, force)
    read = read_friction_recording(path)
    count = np.count_nonzero(np.isfinite(force))
    # The last rows are after the last position.
    assert count - 4 < len(read.time) <= count
    assert f'force in {count} rows, motion in {np.count_nonzero(moved)}' in ' '.join(read.losses)
    assert_true(identify_friction(read))


def test_the_needle_axis_is_chosen_among_components(tmp_path: Path) -> None:
    """Of a robot and a sensor with 2 % of the motion and of the force along the other axes."""
    made, rng = strokes(seed=1, push=0.0), np.random.default_rng(2)
    few = 0.02 + 1e-5 * rng.normal(size=(4, len(made.time)))
    across = few * [made.depth, made.depth, made.force, made.force]
    names = 'time,x [mm],y [mm],z [mm],fx,fy,fz'
    columns = [*(1e3 * across[:2]), 1e3 * made.depth, *across[2:], made.force]
    path = written(tmp_path / 'run.csv', names, made.time, *columns)
    read = read_friction_recording(path)
    assert read.losses == ('columns by their names and values: time=time, depth=z [mm], force=fz',)
    assert_true(identify_friction(read))
    assert 'depth=z [mm],force=fz' in inspect_recording(path).command
    given = read_friction_recording(path, columns={'force': 'fy'})
    assert 'depth=z [mm]' in given.losses[0]
    # Nine digits are written, of forces of a few newtons.
    assert given.force == pytest.approx(columns[4], abs=1e-8)
    columns[5] = rng.normal(size=len(made.time))
    columns[3:5] = columns[5], columns[5]
    path = written(path, names, made.time, *columns)
    said = r'which depth is x \[mm\], y \[mm\], z \[mm\] and which force is fx, fy, fz'
    with pytest.raises(RecordingError, match=said):
        read_friction_recording(path)
    assert 'which depth is' in inspect_recording(path).lacking


@pytest.mark.parametrize('axis', ['x', 'y', 'z'])
def test_the_only_component_that_varies_is_read(tmp_path: Path, axis: str) -> None:
    """The others are constant, at zero or at another place."""
    made = strokes(seed=1, push=0.0)
    still = np.zeros_like(made.time)
    depth = [1e3 * made.depth if one == axis else still + 412.3 for one in 'xyz']
    force = [made.force if one == axis else still for one in 'xyz']
    names = 'time,x_mm,y_mm,z_mm,Fx_N,Fy_N,Fz_N'
    path = written(tmp_path / 'run.csv', names, made.time, *depth, *force)
    assert_true(identify_friction(read_friction_recording(path)))
    assert f'depth={axis}_mm,force=F{axis}_N' in inspect_recording(path).command


@pytest.mark.parametrize('angle', [0.05, 0.6])
def test_an_oblique_motion_is_named(tmp_path: Path, angle: float) -> None:
    """Above 0.1 rad, where its speed along the axis is 0.5 % too small."""
    made = strokes(seed=1, push=0.0)
    x, z = np.sin(angle) * made.depth, np.cos(angle) * made.depth
    path = written(tmp_path / 'run.csv', 'time,x,z,force', made.time, x, z, made.force)
    (one,) = read_friction_recording(path).losses[1:] or ['']
    assert ('x moves by 0.68 of z: the motion is oblique' in one) == (angle > 0.1)
    own = {'depth': 'x*2[mm]'}
    assert 'z moves by' in ' '.join(read_friction_recording(path, columns=own).losses)
