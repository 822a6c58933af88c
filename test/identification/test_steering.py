# SPDX-License-Identifier: Apache-2.0
"""Identification of needles that follow the path they cut."""

from __future__ import annotations

from dataclasses import replace
import json
from math import pi, sqrt
from pathlib import Path

from benchmarks.steering_fit import drawn, FitTruth, insertion, NOISE
from needle_dynamics import bending_length
from needle_dynamics.simulated.assembly import PlantConstants
from needle_identification import (
    IdentificationError,
    identify_steering,
    read_steering_recording,
    SteeringRecording,
    SteeringSettings,
)
from needle_identification.errors import RecordingError
from needle_identification.recordings.tables import column_roles
from needle_identification.result import steering_yaml
from needle_identification.steering.mixed import covariance, MixedModel
from needle_identification.steering.reading import STEERING_ROLES
from needle_identification.steering.recording import credible, readings
from needle_identification.steering.search import Prediction, reaches
from needle_insertion.cli import main
from needle_ros.errors import ParameterError, ShapeError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from support.steered_recording import recorded_plant
import yaml

PLAIN = FitTruth()

TILTED = SteeringSettings(terms=('tilt',), order='together')

#: Columns of a table of another laboratory.
COLUMNS = (
    'depth=-robot[m],guide_x=base.x[mm]@1,guide_z=base.z[mm]@1,tip_x=tip.x[mm],tip_z=tip.z[mm]'
)


def write_table(path: Path, one: SteeringRecording, frozen: int = 0) -> None:
    """
    Write a recording in the table format of another laboratory.

    Each row has the tip after the step and the guide of the previous row, the robot has the
    opposite sign, and the last readings of the sensor may be frozen.
    """
    tip = one.tip.copy()
    if frozen:
        tip[-frozen:] = tip[-frozen - 1]
    # At rest before the first step.
    at = [0, *range(len(tip))]
    ahead = [*range(len(tip)), len(tip) - 1]
    lines = ['sec,nanosec,tip.x,tip.y,tip.z,base.x,base.y,base.z,robot']
    for row, (now, then) in enumerate(zip(at, ahead, strict=True)):
        stamp = 1_700_000_000_250_000_000 + row * 500_000_000
        depth, (x, z), (guide_x, guide_z) = one.depth[now], tip[now], one.guide[then]
        places = 1e3 * np.array([x, -depth, z, guide_x, 0.0, guide_z])
        numbers = ','.join(f'{value:.4f}' for value in places)
        lines.append(f'{stamp // 10**9},{stamp % 10**9},{numbers},{-0.2 - depth:.5f}')
    path.write_text('\n'.join(lines) + '\n')


def test_the_identification_is_exact_without_noise() -> None:
    """From one insertion; the error is from elements of different lengths."""
    found = identify_steering([insertion(1, replace(PLAIN, noise=0.0))], TILTED)
    [gel] = found.media
    # Elements of 1 and 1.25 mm differ by 0.1 um at the tip; skin and free length, which have small
    # effects, are more sensitive.
    assert gel['bending_length'].value == pytest.approx(PLAIN.length, rel=1e-4)
    assert gel['skin'].value == pytest.approx(PLAIN.skin, rel=5e-3)
    assert found.free_length.value == pytest.approx(PLAIN.free, rel=1e-3)
    assert_allclose([gel['tilt_x'].value, gel['tilt_z'].value], PLAIN.tilt, rtol=1e-3)
    assert found.rms < 3e-7


def test_media_share_the_free_length() -> None:
    """Each has its own bending length, skin and tilt; all intervals contain the true values."""
    gel = FitTruth(length=0.03)
    liver = FitTruth(length=0.05, skin=0.03, tilt=(0.0, 0.01), medium='liver')
    recordings = [insertion(k, gel) for k in range(10)]
    recordings += [insertion(k, liver) for k in range(20, 30)]
    found = identify_steering(recordings, TILTED)
    for truth in (gel, liver):
        medium, values = truth.medium, (truth.length, truth.skin, *truth.tilt)
        assert found[medium].recordings == 10
        # Each interval is 95 %; for all together, twice the interval.
        for one, true in zip(found[medium].parameters, values, strict=True):
            low, high = one.interval
            assert low - (one.value - low) <= true <= high + (high - one.value), one
        # 210 samples per axis, minus fitted parameters.
        assert found[medium].rms == pytest.approx(NOISE, rel=0.1)
    low, high = found.free_length.interval
    assert low < gel.free < high
    with pytest.raises(KeyError, match='valid: gel, liver'):
        found['fat']


def test_indistinguishable_causes_of_drift_are_not_determined() -> None:
    """Guide tilt and frame rotation are equivalent, except for a needle that rolls."""
    tilted = identify_steering([insertion(k) for k in range(6)])
    [words] = tilted.warnings
    assert 'not known apart (tilt_x, tilt_z, frame_x, frame_z have probable values)' in words
    assert 'A motion of the guide in air identifies the frame' in words
    rolled = FitTruth(tilt=(0.0, 0.0), curvature=0.8)
    bent = identify_steering(
        [insertion(k, rolled, lambda depth: pi * (depth > 0.05)) for k in range(6)]
    )
    [gel] = bent.media
    assert gel['curvature_z'].value == pytest.approx(0.8, abs=4.0 * gel['curvature_z'].error)
    assert abs(gel['curvature_x'].value) < 4.0 * gel['curvature_x'].error
    assert gel['curvature_z'].error < 0.1


@pytest.mark.parametrize(
    ('axes', 'said'),
    [
        ([[1, 0], [0, 1]], ''),
        ([[0, 1], [1, 0]], 'with z as x and x as z'),
        ([[-1, 0], [0, 1]], 'with -x as x and z as z'),
        # x is measured as z, and z as -x.
        ([[0, -1], [1, 0]], 'with z as x and -x as z'),
    ],
)
def test_exchanged_and_reversed_axes_are_named(axes: list[list[int]], said: str) -> None:
    for seed in range(2):
        made = [insertion(100 * seed + k, drawn(seed)) for k in range(3)]
        turned = [replace(one, tip=one.tip @ np.transpose(axes)) for one in made]
        words = [one for one in identify_steering(turned).warnings if 'guide explains' in one]
        assert bool(words) == bool(said)
        assert all(said in one for one in words)


@pytest.mark.parametrize('seed', [10, 87])
def test_bending_length_is_known_with_several_causes_of_drift(seed: int) -> None:
    """With a single cause for each fit, these intervals excluded the true value."""
    truth = drawn(seed)
    assert truth.tilt[0]
    assert truth.curvature
    length = identify_steering([insertion(1000 * seed, truth)])['gel']['bending_length']
    assert length.interval[0] <= truth.length <= length.interval[1]


def test_a_long_free_length_that_yields_at_the_skin_is_known() -> None:
    """Without an error at the skin the fit was a bending length of 5 mm with large slopes."""
    truth = drawn(11)
    assert truth.free > 2.5 * truth.length
    length = identify_steering([insertion(11000 + k, truth) for k in range(3)])['gel'][
        'bending_length'
    ]
    assert length.determined
    assert length.interval[0] <= truth.length <= length.interval[1]


def test_likelihood_is_that_of_the_joint_normal_distribution() -> None:
    """Of tips with drift of known variance, with any offset, for the best sigma."""
    rng = np.random.default_rng(0)
    moved = np.column_stack([np.linspace(0.0, 0.1, 12), rng.normal(0.0, 1e-3, (12, 2))])
    prior = np.array([2e-3, 5e-3, 0.1])

    def deviances(ratio: tuple[float, ...]) -> tuple[float, float]:
        design, tips = rng.normal(0.0, 0.02, (2, 12, 3)), rng.normal(0.0, 1e-3, (2, 12))
        found = MixedModel([moved], prior, np.array([ratio])).likelihood([design], [tips])
        columns, y = design.reshape(24, 3), tips.ravel()
        total = np.kron(np.eye(2), covariance(moved, np.array(ratio)))
        total += (columns / prior**2) @ columns.T
        offsets = np.kron(np.eye(2), np.ones((12, 1)))
        inverse = np.linalg.inv(total)
        normal = offsets.T @ inverse @ offsets
        rest = inverse - inverse @ offsets @ np.linalg.solve(normal, offsets.T @ inverse)
        joint = 22.0 * np.log(y @ rest @ y / 22.0)
        joint += np.linalg.slogdet(total)[1] + np.linalg.slogdet(normal)[1]
        return found.deviance, float(joint)

    ratios = [(0.0, 0.0, 0.0, 0.0), (4.0, 0.0, 0.5, 8.0), (64.0, 8.0, 2.0, 0.0)]
    differences = [found - joint for found, joint in map(deviances, ratios)]
    # Up to a constant; rounding and the smallest noise of 1 um, of 1 mm.
    assert_allclose(differences, differences[0], atol=1e-4)


def test_a_limited_model_has_the_fits_of_its_ratios() -> None:
    rng = np.random.default_rng(1)
    moved = [np.column_stack([np.linspace(0.0, 0.1, n), np.zeros((n, 2))]) for n in (9, 12)]
    model = MixedModel(moved, np.array([2e-3, 5e-3, 0.1]))
    columns = [rng.normal(0.0, 0.02, (2, len(one), 3)) for one in moved]
    tips = [rng.normal(0.0, 1e-3, (2, len(one))) for one in moved]
    kept = rng.random(len(model.ratios)) < 0.2
    whole = model.likelihood(columns, tips)
    part = model.limited(kept).likelihood(columns, tips)
    for name in ('variances', 'values', 'covariances', 'residuals'):
        # Rounding only.
        assert_allclose(getattr(part, name), getattr(whole, name)[kept], rtol=1e-9, atol=1e-15)
    assert_allclose(part.weights, whole.weights[kept] / whole.weights[kept].sum(), rtol=1e-9)


@pytest.mark.parametrize('first', [False, True])
def test_the_order_of_guide_and_needle_is_detected(first: bool) -> None:
    found = identify_steering(
        [insertion(k, FitTruth(guide_first=first)) for k in range(4)],
        SteeringSettings(terms=('tilt',)),
    )
    assert found.order == ('guide first' if first else 'together')


def test_a_given_free_length_is_used() -> None:
    found = identify_steering([insertion(1)], replace(TILTED, free_length=PLAIN.free))
    assert found.free_length.value == PLAIN.free
    assert found.free_length.interval == (PLAIN.free, PLAIN.free)
    free = identify_steering([insertion(1)], TILTED)

    def width(one: tuple[float, float]) -> float:
        return one[1] - one[0]

    [known], [unknown] = found.media, free.media
    assert width(known['bending_length'].interval) < width(unknown['bending_length'].interval)


def test_a_guide_at_rest_determines_no_length() -> None:
    """The shape of the drift alone determines no length, with noise and without."""
    for noise in (NOISE, 0.0):
        still = insertion(1, replace(PLAIN, noise=noise), steer=0.0)
        found = identify_steering([still])
        [gel] = found.media
        assert not gel['bending_length'].determined
        assert not gel['skin'].determined
        assert not found.free_length.determined
        with pytest.raises(IdentificationError, match='do not determine the bending length'):
            steering_yaml(found)


def test_a_simulated_needle_with_a_guide_at_rest_is_not_identified(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = str(tmp_path / 'insertion.csv')
    words = ['--set', 'bevel_load=0.4', '--set', 'cutting_force=0.8', '-o', table]
    assert main(['simulate', '--model', 'steering', *words]) == 0
    capsys.readouterr()
    assert main(['identify', 'steering', table, '--json']) == 0
    [medium] = json.loads(capsys.readouterr().out)['media'].values()
    assert not medium['parameters']['bending_length']['determined']


def test_rows_at_rest_are_one_reading() -> None:
    """Ten readings at each depth, where the tip settles: as one reading, the mean of the last."""
    one = insertion(1)
    rng = np.random.default_rng(1)
    noise = 1e-4 * rng.standard_normal((10 * len(one.depth), 2))
    unsettled = 3e-3 * np.tile(np.arange(10) < 5, len(one.depth))[:, np.newaxis]
    rows = np.repeat(np.arange(len(one.depth)), 10)
    often = replace(
        one,
        depth=one.depth[rows],
        guide=one.guide[rows],
        roll=one.roll[rows],
        tip=one.tip[rows] + noise + unsettled,
    )
    mean = replace(one, tip=one.tip + noise.reshape(-1, 10, 2)[:, 5:].mean(axis=1))
    [found], [wanted] = (identify_steering([r], TILTED).media for r in (often, mean))
    assert found.samples == wanted.samples == len(one.depth)
    # Rounding of the means, and the end of the search.
    assert_allclose(found['bending_length'].interval, wanted['bending_length'].interval, rtol=1e-3)


def test_readings_of_a_dense_recording_are_averages() -> None:
    depth = np.linspace(0.0, 0.1, 1000)
    tip = np.column_stack([depth, -depth])
    tip[::2] = np.nan
    dense = SteeringRecording(
        depth=depth, guide=0.1 * np.column_stack([depth, depth]), roll=20.0 * depth, tip=tip
    )
    found = readings(dense)
    assert found.samples == 100
    assert_allclose(found.depth, depth.reshape(100, 10).mean(axis=1))
    assert_allclose(found.guide[:, 0], 0.1 * found.depth)
    assert_allclose(found.roll, 20.0 * found.depth)
    assert_allclose(found.tip[:, 0], depth[1::2].reshape(100, 5).mean(axis=1))


def test_intervals_contain_the_differences_between_insertions() -> None:
    """Paths wander and frames differ: intervals are wider, and contain the true values."""
    real = replace(PLAIN, path_noise=1e-3, slope=0.02)
    found = identify_steering([insertion(k, real) for k in range(6)], TILTED)
    plain = identify_steering([insertion(k) for k in range(6)], TILTED)
    [gel], [known] = found.media, plain.media
    low, high = gel['bending_length'].interval
    assert low < real.length < high
    narrow = known['bending_length'].interval
    assert high - low > 1.5 * (narrow[1] - narrow[0])
    # Slopes and path noise both change the direction at 100 mm. Twelve directions: an error of a
    # fifth, times three.
    direction = sqrt(real.slope**2 + 0.1 * real.path_noise)
    assert sqrt(gel.slope**2 + 0.1 * gel.path_noise) == pytest.approx(direction, rel=0.6)
    assert known.path_noise < 0.1 * gel.path_noise
    assert gel.held_out is not None
    # Predicted tips of twelve paths, whose errors are correlated within a path.
    assert 0.8 <= gel.held_out.coverage <= 1.0


@pytest.mark.parametrize('recordings', [2, 4, 10])
@pytest.mark.parametrize('factor', [0.3, 3.0])
def test_predicted_intervals_hold_with_wrong_deviations(recordings: int, factor: float) -> None:
    """By the errors of the other recordings; the errors along a path are alike."""
    rng, held = np.random.default_rng(recordings), []
    growing = np.linspace(0.1, 1.0, 20)[:, np.newaxis] * np.ones(2)
    for _ in range(1000):
        errors = factor * rng.standard_normal((recordings, 2))
        found = [Prediction(one * growing, growing) for one in errors]
        held.append(np.abs(errors) <= reaches(found)[:, np.newaxis])
    # Of 1000 independent draws: 0.7 % or less, times two.
    assert np.mean(held) == pytest.approx(0.95, abs=0.014)


@pytest.mark.parametrize('seed', [22, 49])
def test_lengths_are_uncertain_with_the_difference_of_two_insertions(seed: int) -> None:
    """At wrong lengths, two insertions in different frames are alike."""
    truth = drawn(seed)
    assert truth.slope > 0.0
    found = identify_steering([insertion(1000 * seed + k, truth) for k in range(2)], TILTED)
    low, high = found['gel']['bending_length'].interval
    assert low < truth.length < high


def test_poor_prediction_of_another_recording_is_reported() -> None:
    """Two tissues by the same name."""
    two = [insertion(1), insertion(2, replace(PLAIN, length=0.015))]
    found = identify_steering(two, TILTED)
    assert any('is predicted from the others with an error of' in one for one in found.warnings)
    alike = identify_steering([insertion(1), insertion(2)], TILTED)
    assert not any('is predicted' in one for one in alike.warnings)


def test_a_single_insertion_is_not_predicted() -> None:
    [gel] = identify_steering([insertion(1)], TILTED).media
    assert gel.held_out is None


def test_a_table_of_another_laboratory_is_read_with_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Units, signs, stamps in two columns, delayed rows, and a frozen sensor."""
    for k in range(4):
        write_table(tmp_path / f'run_{k}.csv', insertion(k), frozen=8 if k == 2 else 0)
    paths = [str(tmp_path / f'run_{k}.csv') for k in range(4)]
    options = ['--columns', COLUMNS, '--terms', 'tilt', '--order', 'together']
    assert main(['identify', 'steering', *paths, *options, '--json']) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert 'run_2.csv: 8 samples of the tip repeated during the insertion' in said.err
    assert 'depths relative to the first depth, 200 mm, at the skin' in said.err
    [medium] = found['media'].values()
    # The row at rest before the first step is no reading of its own.
    assert medium['samples'] == 4 * 21 - 8
    low, high = medium['parameters']['bending_length']['interval']
    assert low < PLAIN.length < high
    assert medium['rms'] == pytest.approx(NOISE, rel=0.15)
    assert main(['identify', 'steering', str(tmp_path), *options]) == 0
    text = capsys.readouterr().out
    assert 'Bending length lambda [m]' in text
    assert tmp_path.name in text


def test_a_copy_of_a_table_counts_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(tmp_path / name) for name in ('a.csv', 'copy.csv')]
    for path in paths:
        write_table(Path(path), insertion(1))
    options = ['--columns', COLUMNS, '--terms', 'tilt', '--order', 'together', '--json']
    assert main(['identify', 'steering', *paths, *options]) == 0
    said = capsys.readouterr()
    assert f'{paths[1]}: the same samples as {paths[0]}: counts once' in said.err
    assert json.loads(said.out)['media'][tmp_path.name]['recordings'] == 1


def test_media_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k, medium in enumerate(('gel', 'gel', 'fat', 'fat')):
        write_table(tmp_path / f'{medium}_{k}.csv', insertion(k))
    paths = [str(path) for path in sorted(tmp_path.glob('*.csv'))]
    options = ['--columns', COLUMNS, '--terms', 'tilt', '--order', 'together', '--json']
    assert main(['identify', 'steering', *paths, *options, '--medium', r'/(\w+)_\d']) == 0
    assert list(json.loads(capsys.readouterr().out)['media']) == ['fat', 'gel']
    (tmp_path / 'bad.csv').write_text('a,b\n1,2\n')
    assert main(['identify', 'steering', *paths, str(tmp_path / 'bad.csv'), *options]) == 2
    said = capsys.readouterr()
    assert "bad.csv has no column 'robot' for depth; it has a, b" in said.err
    assert json.loads(said.out)['media'][tmp_path.name]['recordings'] == 4
    with pytest.raises(SystemExit):
        main(['identify', 'steering', *paths, '--medium', '('])
    assert 'is no regular expression' in capsys.readouterr().err


def test_a_tip_that_never_moves_is_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'still.csv'
    write_table(path, insertion(0), frozen=20)
    table = path.read_text().splitlines()
    first = table[1].split(',')[2:5]
    rows = [','.join([*row.split(',')[:2], *first, *row.split(',')[5:]]) for row in table[1:]]
    path.write_text('\n'.join([table[0], *rows]) + '\n')
    assert main(['identify', 'steering', str(path), '--columns', COLUMNS]) == 2
    said = capsys.readouterr()
    assert said.out == ''
    assert said.err.count('\n') == 1
    assert 'the tip never moves: all ' in said.err


def test_frozen_and_implausible_readings_are_discarded() -> None:
    depth = np.linspace(0.0, 0.045, 10)
    guide, tip = np.zeros((10, 2)), 1e-4 * np.random.default_rng(1).standard_normal((10, 2))
    good, losses = credible(depth, guide, tip)
    assert good.all()
    assert not losses
    tip[4:8] = tip[4]
    tip[9] = 0.5
    tip[1, 0] = np.nan
    good, losses = credible(depth, guide, tip)
    assert good.tolist() == [True, False, True, True, True, False, False, False, True, False]
    assert [words.split()[0] for words in losses] == ['3', '1', '1']
    # A needle at rest may have repeated readings.
    rest = np.zeros((10, 2))
    assert credible(np.full(10, 0.05), guide, rest)[0].all()


def test_rows_of_zeros_before_the_guide_moves_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / 'run.csv'
    rows = ['0,0,0,0,0', '0,0,0,0,0', '0,25,-22,1,1', '5,25,-22,1,2', '10,26,-22,2,2']
    path.write_text('\n'.join(['depth_mm,guide_x_mm,guide_z_mm,tip_x_mm,tip_z_mm', *rows]))
    one = read_steering_recording(path)
    assert_allclose(one.guide[:, 0], [0.025, 0.025, 0.026])
    assert any('2 rows of zeros before the first position of the guide' in w for w in one.losses)
    # A guide that starts at zero.
    path.write_text(path.read_text().replace('25,-22', '1,0').replace('26,-22', '2,0'))
    assert len(read_steering_recording(path).depth) == 5


def test_a_foreign_table_is_read_without_options(tmp_path: Path) -> None:
    """Millimeters without a unit, inverted depth, held columns with own times, zeros first."""
    rng = np.random.default_rng(3)
    depth = 5e-3 * np.arange(1.0, 21.0)
    guide, tip = 1e-3 * rng.normal(size=(2, 20, 2)) + 0.02
    plain = tmp_path / 'plain.csv'
    rows = np.column_stack([depth, guide, tip])
    np.savetxt(plain, rows, delimiter=',', header='depth,guide_x,guide_z,tip_x,tip_z', comments='')
    # Each step is logged when it ends; until the next one the tip is logged in motion.
    held = np.repeat(np.column_stack([1e3 * guide[:, 0], -1e3 * depth, 1e3 * guide[:, 1]]), 4, 0)
    seen = 1e3 * np.repeat(tip, 4, 0)
    seen[np.arange(80) % 4 > 0] += rng.normal(size=(60, 2))
    steps = np.repeat(np.arange(20), 4)
    times = np.column_stack([1_665_773_010 + steps, 1_000 + steps])
    along = -1e3 * np.repeat(depth, 4) - 0.4
    lines = np.column_stack([held, times, seen[:, 0], along, seen[:, 1]])
    lines = np.vstack([np.zeros((7, 8)), lines])
    lines[:7, 5:] = 1e3 * tip[0, 0]
    foreign = tmp_path / 'foreign.csv'
    names = 'Base x,Base y,Base z,Base sec,Base nanosec,Tip x,Tip y,Tip z'
    np.savetxt(foreign, lines, delimiter=',', header=names, comments='', fmt='%.10g')
    expected, found = read_steering_recording(plain), read_steering_recording(foreign)
    for name in ('depth', 'guide', 'tip'):
        # Ten digits in the file, of up to 100 mm.
        assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-10)
    assert 'rows in which Base sec or Base nanosec changes: 20' in found.losses
    assert any('depth=-Base y[mm], guide_x=Base x[mm]' in words for words in found.losses)


def test_columns_may_be_delayed_by_rows(tmp_path: Path) -> None:
    path = tmp_path / 'run.csv'
    path.write_text('depth,gx,gz,tx,tz\n0,1,0,0,0\n0.01,2,0,1,1\n0.02,3,0,2,2\n')
    columns = column_roles('guide_x=gx[mm]@1,guide_z=gz,tip_x=tx[mm],tip_z=tz[mm]', STEERING_ROLES)
    one = read_steering_recording(path, columns=columns)
    assert_allclose(one.guide[:, 0], [1e-3, 1e-3, 2e-3])
    assert_allclose(one.depth, [0.0, 0.01, 0.02])
    with pytest.raises(RecordingError, match='goes from the first row to -20 mm, out of the skin'):
        read_steering_recording(path, columns=columns | {'depth': '-depth'})
    with pytest.raises(RecordingError, match='with the roles depth, guide_x'):
        column_roles('force=f', STEERING_ROLES)


def test_invalid_input_is_reported() -> None:
    with pytest.raises(IdentificationError, match='no recordings'):
        identify_steering([])
    short = SteeringRecording(
        depth=np.zeros(3), guide=np.zeros((3, 2)), roll=np.zeros(3), tip=np.zeros((3, 2))
    )
    with pytest.raises(IdentificationError, match=r'7 constants of these recordings need more'):
        identify_steering([short], TILTED)
    blind = replace(short, name='run 7', tip=np.full((3, 2), np.nan))
    with pytest.raises(IdentificationError, match='run 7: no valid sample of the tip'):
        identify_steering([blind])
    with pytest.raises(ShapeError, match=r'guide must have the shape \(n, 2\)'):
        replace(short, guide=np.zeros((2, 2)))
    with pytest.raises(ShapeError, match='depth must be >= 0'):
        replace(short, depth=np.array([0.0, -0.01, 0.0]))
    for wrong, words in (
        ({'terms': ('wind',)}, "terms must be one of tilt, frame, bevel, got 'wind'"),
        ({'terms': ()}, 'terms must be at least one of tilt, frame, bevel'),
        ({'order': 'never'}, 'order must be one of together, guide first'),
        ({'free_length': 2.0}, r'free_length must be in \[0.001, 0.3\] m, got 2.0'),
    ):
        with pytest.raises(ParameterError, match=words):
            SteeringSettings(**wrong)


def test_a_bag_of_the_plant_is_read_without_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten insertions with a tracker: intervals contain the true values, residuals are noise."""
    bags = [recorded_plant(tmp_path / 'gel', seed) for seed in range(10)]
    result = tmp_path / 'result.yaml'
    words = ['--json', '--terms', 'tilt', '-o', str(result), *map(str, bags)]
    assert main(['identify', 'steering', *words]) == 0
    found = json.loads(capsys.readouterr().out)
    gel = found['media']['gel']
    low, high = gel['parameters']['bending_length']['interval']
    assert low < 0.035 < high
    # Of ten insertions; about 0.3 mm.
    assert high - low < 2e-3
    low, high = found['free_length']['interval']
    assert low < 0.04 < high
    # Readings are averages of five samples. 900 readings of both axes: a deviation has an error of
    # 2.4 %, times four.
    assert gel['rms'] == pytest.approx(NOISE / sqrt(5.0), rel=0.1)
    assert gel['noise'] == pytest.approx(NOISE / sqrt(5.0), rel=0.1)
    # Offset and slope from 15 readings have errors, too.
    assert gel['rms'] < gel['held_out']['rms'] < 1.3 * gel['rms']
    assert gel['recordings'] == 10
    assert 10 * 80 < gel['samples'] <= 10 * 100
    # The file starts a plant with the result, and a controller with the same tissue.
    sections = yaml.safe_load(result.read_text())
    values = sections['/**/plant']['ros__parameters']
    constants = PlantConstants.of(values)
    assert constants.steered
    length = bending_length(constants.model.bending_stiffness, constants.model.tissue_stiffness)
    # Seven digits, and their fourth root.
    assert length == pytest.approx(gel['parameters']['bending_length']['value'], rel=1e-6)
    assert constants.steering.free_length == pytest.approx(found['free_length']['value'], rel=1e-6)
    # The skin of the plant, by its interval: 300 N/m over the stiffness of the tissue.
    low, high = gel['parameters']['skin']['interval']
    tissue = constants.model.tissue_stiffness
    assert low < 300.0 / tissue < high
    assert constants.steering.skin_stiffness == pytest.approx(
        gel['parameters']['skin']['value'] * tissue, rel=1e-6
    )
    prior = sections['/**/steering']['ros__parameters']
    assert prior['prior.path_noise'] == pytest.approx(
        min(max(gel['path_noise'], 1e-6), 1e-4), rel=1e-6
    )
    assert sections['/**/controller']['ros__parameters'] == {
        name: value
        for name, value in values.items()
        if name == 'needle' or name.startswith('model.')
    }


def test_a_parameter_file_has_one_medium(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed, name in enumerate(('gel', 'liver')):
        (tmp_path / name).mkdir()
        write_table(tmp_path / name / 'run.csv', insertion(seed, replace(PLAIN, noise=1e-5)))
    tables = [str(tmp_path / name / 'run.csv') for name in ('gel', 'liver')]
    words = ['identify', 'steering', *tables, '--columns', COLUMNS, '--terms', 'tilt']
    assert main([*words, '-o', str(tmp_path / 'both.yaml')]) == 2
    assert 'a parameter file describes a single medium, got gel, liver' in capsys.readouterr().err
    assert not (tmp_path / 'both.yaml').exists()


def test_the_load_of_a_bevel_is_identified() -> None:
    """With the stiffness of the default needle, and the roll of its load along z."""
    truth = replace(PLAIN, noise=1e-7, tilt=(0.0, 0.0), curvature=0.8)
    bevel = SteeringSettings(terms=('bevel',), order='together')
    text = steering_yaml(identify_steering([insertion(2, truth)], bevel))
    values = yaml.safe_load(text)['/**/plant']['ros__parameters']
    # Error of elements of different lengths.
    assert values['steering.bevel_load'] == [pytest.approx(0.8 * 0.0256 / 0.035, rel=2e-3)]
    (line,) = (line for line in text.splitlines() if 'pushes along z' in line)
    assert abs(float(line.split()[-2])) < 1e-3
