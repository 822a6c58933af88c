# SPDX-License-Identifier: Apache-2.0
"""Errors of a tip sensor are recovered, with intervals; invalid recordings are rejected."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
import json
from math import exp, log, sqrt
from pathlib import Path
import re
from typing import Any, Final

from needle_controller import SteeringPrior
from needle_dynamics import FloatArray
from needle_dynamics.simulated.assembly import PlantConstants
from needle_dynamics.simulated.tip_sensor import TipParameters, TipSensor
from needle_identification import (
    BagWriter,
    IdentificationError,
    identify_sensor,
    RecordingError,
    SensorRecording,
)
from needle_identification.sensor.checks import measured_rows
from needle_identification.sensor.noise import fit_losses, NoiseLikelihood
from needle_identification.sensor.reading import read_sensor_recording
from needle_insertion.cli import main
from needle_ros import contract
from needle_ros.errors import ParameterError, ShapeError
import numpy as np
import pytest
import yaml

RATE = 40.0
HELD = (2e-3, 0.05, 1e-3)  # true position of a tip at rest, x, depth, z [m]

ERRORS: Final[dict[str, Any]] = {
    'noise': 1.8e-4, 'slow_noise': 2e-4, 'slow_time': 1.0, 'dropout': 0.1, 'dropout_time': 0.3,
    'offset': (1e-3, -5e-4, 2e-4),
}  # fmt: skip


def recorded(
    seed: int = 0, count: int = 3000, *, moving: bool = False, **constants: Any
) -> SensorRecording:
    """Record the tip sensor of the plant by the times of its messages, with the true position."""
    sensor = TipSensor(TipParameters(**constants), RATE, seed, spatial=True)
    time = np.arange(1, count + 1) / RATE
    path = np.tile(HELD, (count, 1))
    if moving:
        phases = np.add(np.outer(time, [1.3, 0.7, 1.1]), [0.0, 0.0, 1.6])
        path = path + 0.01 * np.sin(phases)
    found = [sensor.measure(y, z, x) for x, y, z in path.tolist()]
    received = np.array([reading is not None for reading in found])
    kept = slice(None) if moving else slice(1)
    return SensorRecording(
        time=time[received],
        tip=np.array([reading.point for reading in found if reading is not None]),
        true_time=time[kept],
        true_tip=path[kept],
    )


def changed(recording: SensorRecording, tip: FloatArray) -> SensorRecording:
    return replace(recording, tip=tip)


def write_table(path: Path, time: FloatArray, tip: FloatArray, head: str = 'time,x,y,z') -> Path:
    rows = [','.join(f'{value:.9f}' for value in row) for row in np.column_stack([time, tip])]
    path.write_text('\n'.join([head, *rows]) + '\n', encoding='utf-8')
    return path


@pytest.mark.parametrize('constants', [{}, {'delay': 0.1}], ids=['at rest', 'moving, late'])
def test_errors_of_the_plant_are_within_their_intervals(constants: dict[str, Any]) -> None:
    """Each parameter in 90 to 98 of 100 recordings of 75 s."""
    true = {**ERRORS, **constants}
    true |= {f'bias_{axis}': value for axis, value in zip('xyz', ERRORS['offset'], strict=True)}
    del true['offset']
    hits = Counter[str]()
    for seed in range(1000, 1100):
        found = identify_sensor(recorded(seed, moving=bool(constants), **ERRORS, **constants))
        for name, value in true.items():
            low, high = found[name].interval
            hits[name] += found[name].determined and low <= value <= high
    # 95 of 100 with a standard deviation of 2.2. An exact interval of each of ten parameters is
    # within 90 to 98 with a probability of about 95 %; these seeds are fixed.
    assert {name: hits[name] for name in true if not 90 <= hits[name] <= 98} == {}


def test_slow_noise_is_rarely_found_in_white_noise() -> None:
    """A few of 100: the threshold is for 0.5 %, and the correlation time is searched."""
    found = [identify_sensor(recorded(seed, 2000, noise=1.8e-4)) for seed in range(100)]
    # A rate of 1 % has more than five with a probability of 5e-4.
    assert sum(one['slow_noise'].determined for one in found) <= 5
    assert not any(one['delay'].determined or one['dropout_time'].determined for one in found)
    low, high = np.array([one['noise'].interval for one in found]).T
    held = np.count_nonzero((low <= 1.8e-4) & (high >= 1.8e-4))
    # As above, without an upper limit: 95 less three standard deviations.
    assert held >= 88
    assert all(one['dropout'].value == 0.0 for one in found)
    # No loss in 2000 samples: at most 1 - 0.025^(1 / 2000).
    expected = 0.0, 1.0 - 0.025 ** (1.0 / 2000.0)
    assert found[0]['dropout'].interval == pytest.approx(expected, rel=1e-9)


def test_outliers_are_counted_and_left_out() -> None:
    """Their fraction is within its interval, and the noise is as without them."""
    hits, sizes = 0, []
    for seed in range(100):
        clean = recorded(seed, 2000, noise=1.8e-4)
        rng = np.random.default_rng(seed)
        wild = rng.random(2000) < 0.02
        tip = clean.tip + wild[:, np.newaxis] * rng.choice([-0.01, 0.01], (2000, 3))
        found = identify_sensor(changed(clean, tip))
        low, high = found['outliers'].interval
        hits += low <= 0.02 <= high
        sizes.append(found['noise'].value / identify_sensor(clean)['noise'].value)
    # An exact interval holds for at least 95 %: 90 is less than it by 2.3 standard deviations.
    assert hits >= 90
    # Without 2 % of 6000 values, a deviation differs by 0.13 %: five times that.
    np.testing.assert_allclose(sizes, 1.0, atol=6.5e-3)


@pytest.mark.parametrize('kind', ['zero', 'equal to the previous position'])
def test_lost_tracking_is_as_missing_samples(kind: str) -> None:
    """Zeros and repeated positions are bursts of losses, to the bit."""
    clean = recorded(noise=1.8e-4)
    place = np.arange(len(clean.time))
    lost = np.isin(place // 40, [7, 21, 40, 63])
    last = np.maximum.accumulate(np.where(lost, 0, place))
    tip = np.where(lost[:, np.newaxis], 0.0, clean.tip) if kind == 'zero' else clean.tip[last]
    found = identify_sensor(changed(clean, tip))
    missing = identify_sensor(replace(clean, time=clean.time[~lost], tip=clean.tip[~lost]))
    assert found.parameters == missing.parameters
    low, high = found['dropout'].interval
    assert low < lost.mean() < high
    assert found['dropout_time'].determined
    assert found.warnings == (f'160 positions are {kind}, in 4 places: counted as lost',)


@pytest.mark.parametrize('times', [2.0, 2.5, 3.0])
def test_a_log_at_a_higher_rate_is_one_at_the_rate_of_the_sensor(times: float) -> None:
    """The first row of each position counts, to the bit; lost ones remain lost."""
    clean = recorded(noise=1.8e-4, dropout=0.1, dropout_time=0.3)
    tip = clean.tip.copy()
    tip[400:440] = 0.0
    first = np.ceil(times * np.arange(len(tip))).astype(np.int64)
    last = np.append(first[1:], first[-1] + 1)
    # The log continues while tracking is lost; its rows have the time of the sensor.
    place = np.repeat(np.arange(len(tip)), last - first)
    within = np.arange(len(place)) - np.repeat(first, last - first)
    time = clean.time[place] + within / (times * RATE)
    log = identify_sensor(replace(clean, time=time, tip=tip[place]))
    own = identify_sensor(changed(clean, tip))
    assert log.parameters == own.parameters
    count = np.count_nonzero(within) - np.count_nonzero(within[tip[place, 0] == 0.0])
    zeros = np.count_nonzero(tip[place, 0] == 0.0)
    words = 'left out: the log has a higher rate than the sensor'
    assert log.warnings[0] == f'{zeros} positions are zero, in 1 places: counted as lost'
    assert re.fullmatch(
        f'{count} positions are equal to the previous position, .*{words}', log.warnings[1]
    )


@pytest.mark.parametrize('every', [1.0, 1.5])
@pytest.mark.parametrize('step', [1e-9, 1e-4, 2e-4, 3e-4, 1e-3])
def test_positions_that_repeat_by_chance_are_measurements(step: float, every: float) -> None:
    """Those of a coarse sensor, about zero or elsewhere, and of a log at a higher rate."""
    for seed in range(20):
        tip = 2e-4 * np.random.default_rng(seed).standard_normal((3000, 3))
        tip = tip[(np.arange(3000) / every).astype(np.int64)]
        for axes, center in ((1, 0.0), (1, 2e-3), (3, 0.0), (3, 2e-3)):
            rows, words = measured_rows(np.round((tip[:, :axes] + center) / step) * step)
            # By chance in one of a thousand recordings.
            assert rows.all()
            assert not words


def test_axes_that_differ_and_coarse_steps_are_named() -> None:
    """One noise for all axes and a mean of rounded positions then have no valid interval."""
    clean = recorded(noise=1e-4)
    errors = clean.tip - HELD
    assert identify_sensor(clean).warnings == ()
    (words,) = identify_sensor(changed(clean, HELD + errors * [1.0, 1.0, 6.0])).warnings
    assert re.match('the noise differs between the axes, x 0.09.* mm, y .* mm, z 0.6.* mm', words)
    for step, coarse in ((1e-4, False), (2e-4, False), (5e-4, True)):
        # A quarter of 0.5 mm from a step, where the mean is off the most.
        tip = np.round((clean.tip + 1.25e-4) / step) * step
        found = identify_sensor(changed(clean, tip))
        assert len(found.warnings) == coarse
        assert all('x, y, z are in steps of 0.5 mm, coarse' in one for one in found.warnings)


def test_likelihood_equals_that_of_the_dense_covariance() -> None:
    """Against a normal distribution with a full matrix, at irregular times, with a delay."""
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.01, 0.3, 40))
    errors, slopes = rng.standard_normal((2, 40, 2))

    def dense(ratio: float, tau: float) -> tuple[float, FloatArray]:
        one = np.eye(40) + ratio * np.exp(-np.abs(time[:, np.newaxis] - time) / tau)
        whole = np.kron(np.eye(2), one)
        design = np.zeros((80, 3))
        design[:40, 0] = design[40:, 1] = 1.0
        design[:, 2] = slopes.T.ravel()
        inverse = np.linalg.inv(whole)
        normal = design.T @ inverse @ design
        y = errors.T.ravel()
        constants = np.linalg.solve(normal, design.T @ inverse @ y)
        left = y - design @ constants
        scatter = 77.0 * np.log(left @ inverse @ left / 77.0)
        logs = np.linalg.slogdet(whole)[1] + np.linalg.slogdet(normal)[1]
        return float(scatter + logs), constants

    fast = NoiseLikelihood(time, errors, slopes)
    for ratio, tau in ((0.3, 0.5), (20.0, 2.0), (1e3, 0.05)):
        found = fast.fit(np.log(ratio), np.log(tau))
        deviance, constants = dense(ratio, tau)
        # Rounding, with condition numbers up to 1e5.
        assert found.deviance == pytest.approx(deviance, rel=1e-9)
        np.testing.assert_allclose(found.constants, constants, rtol=1e-9)
    # A ratio that vanishes is white noise.
    vanished, white = fast.fit(np.log(1e-12), 0.0), fast.fit(-np.inf, 0.0)
    assert vanished.deviance == pytest.approx(white.deviance, rel=1e-9)


def test_losses_of_regular_samples_only() -> None:
    """Independent losses have no duration; irregular samples have no count."""
    rng = np.random.default_rng(3)
    time = np.arange(3000.0)[rng.random(3000) >= 0.2]
    fraction, burst = fit_losses(time)
    assert fraction.interval[0] < 0.2 < fraction.interval[1]
    assert np.isnan(burst.value)
    assert np.isnan(fit_losses(np.cumsum(rng.exponential(1.0, 500)))[0].value)
    # Jitter of a tenth of the period is no loss.
    assert fit_losses(np.arange(3000.0) + rng.uniform(-0.1, 0.1, 3000))[0].value == 0.0


def test_another_sensor_is_a_true_position() -> None:
    """At another rate and with its own noise; at rest its noise is no motion."""
    moving = recorded(moving=True, noise=1.8e-4, delay=0.1)
    time = np.arange(0.0, 80.0, 0.01)
    phases = np.add(np.outer(time, [1.3, 0.7, 1.1]), [0.0, 0.0, 1.6])
    noise = 1e-5 * np.random.default_rng(1).standard_normal((len(time), 3))
    path = HELD + 0.01 * np.sin(phases) + noise
    found = identify_sensor(replace(moving, true_time=time, true_tip=path))
    # A standard error of about 0.2 ms; the interval has to contain it for this seed.
    low, high = found['delay'].interval
    assert low < 0.1 < high
    assert high - low < 2e-3
    still = recorded(noise=1.8e-4)
    at_rest = replace(still, true_time=time, true_tip=np.tile(HELD, (len(time), 1)) + noise)
    assert not at_rest.moves
    found = identify_sensor(at_rest)
    assert not found['delay'].determined
    exact = identify_sensor(still)
    # The mean of 8000 values with 0.01 mm: 0.11 um, five times that.
    assert found['bias_x'].value == pytest.approx(exact['bias_x'].value, abs=6e-7)


@pytest.mark.parametrize('moving', [False, True])
@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        (lambda tip: 1e3 * tip, r'1e\+03 times the true positions: .* \[mm\]'),
        (lambda tip: 100.0 * tip, r'times the true positions: .* \[cm\]'),
        (lambda tip: 1e-3 * tip, 'times the true positions: .* true position in mm'),
        (lambda tip: tip[:, [1, 0, 2]], 'x, y, z match the true y, x, z, to'),
        (lambda tip: tip[:, [2, 0, 1]], 'x, y, z match the true z, x, y, to'),
        (lambda tip: tip * [1.0, -1.0, 1.0], 'x, y, z match the true x, -y, z, to'),
        (lambda tip: tip * 0.0 + HELD, 'the error along x does not vary'),
    ],
)  # fmt: skip
def test_units_and_axes_that_do_not_match_are_named(
    moving: bool, change: Any, complaint: str
) -> None:
    """In one line, with a true position at rest and in motion."""
    one = recorded(count=1000, moving=moving, noise=1.8e-4)
    if 'does not vary' in complaint:
        # An exact axis: the noise of the others would be mixed with it.
        true = np.column_stack(
            [np.interp(one.time, one.true_time, column) for column in one.true_tip.T]
        )
        wrong = np.column_stack([true[:, 0], one.tip[:, 1:]])
    else:
        wrong = change(one.tip)
    with pytest.raises(IdentificationError, match=complaint) as caught:
        identify_sensor(changed(one, wrong))
    assert '\n' not in str(caught.value)


def test_short_and_invalid_recordings_are_rejected() -> None:
    one = recorded(count=40, noise=1e-4)
    with pytest.raises(IdentificationError, match=r'at least 50 samples .* got 40'):
        identify_sensor(one)
    # A moving true position must cover all delays of the search.
    moving = recorded(count=80, moving=True, noise=1e-4)
    with pytest.raises(IdentificationError, match=r'at least 50 samples .* got 3'):
        identify_sensor(moving)
    tip = one.tip.copy()
    tip[3, 1] = np.nan
    with pytest.raises(ShapeError, match='tip must be finite'):
        changed(one, tip)
    with pytest.raises(ShapeError, match='time must be strictly increasing'):
        replace(one, time=one.time[::-1])
    with pytest.raises(ShapeError, match=r'tip must have the shape \(n, 3\)'):
        changed(one, tip[:, :2])


def test_a_slow_drift_is_a_warning() -> None:
    """A correlation time of a quarter of the recording is not reliable."""
    found = identify_sensor(recorded(3, 1000, noise=1e-4, slow_noise=5e-4, slow_time=20.0))
    assert any('needs a recording of' in warning for warning in found.warnings)


def test_repaired_tables_give_the_same_result(tmp_path: Path) -> None:
    """Rows out of order are sorted, and rows with NaN and repeated times left out, with counts."""
    one = recorded(noise=1.8e-4)
    whole = write_table(tmp_path / 'whole.csv', one.time, one.tip)
    exact = read_sensor_recording(whole, HELD)
    rows = whole.read_text().splitlines()
    mixed = [rows[0], *rows[2:11], rows[1], rows[1], *rows[11:], '76.0,nan,0.05,0.001']
    broken = tmp_path / 'broken.csv'
    broken.write_text('\n'.join(mixed) + '\n', encoding='utf-8')
    repaired = read_sensor_recording(broken, HELD)
    np.testing.assert_array_equal(repaired.tip, exact.tip)
    assert identify_sensor(repaired)['noise'].value == identify_sensor(exact)['noise'].value
    for words in (
        '1 rows with a value that is not',
        '1 of the rows out of order',
        '1 of the rows with the stamp',
    ):
        assert any(words in loss for loss in repaired.losses)
    # Nine decimal places.
    np.testing.assert_allclose(exact.tip, one.tip, atol=1e-9)


def test_columns_have_units_signs_and_axes(tmp_path: Path) -> None:
    """Of the recording and of a table of the true position."""
    one = recorded(moving=True, noise=1.8e-4)
    log = write_table(tmp_path / 'log.csv', 1e3 * one.time, 1e3 * one.tip, 't_ms,a_mm,b_mm,c_mm')
    truth = write_table(tmp_path / 'truth.csv', one.true_time, -one.true_tip, 'time,u,v,w')
    found = read_sensor_recording(
        log,
        truth,
        axes=('x', 'z'),
        columns={'tip_x': 'a_mm', 'tip_z': 'c_mm'},
        truth_columns={'tip_x': '-u[m]', 'tip_z': '-w'},
    )
    # Nine decimal places; times are relative to the first sample.
    np.testing.assert_allclose(found.tip, one.tip[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(found.true_tip, one.true_tip[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(found.time, one.time - one.time[0], atol=1e-8)
    for words, complaint in (
        ({'axes': ('x', 'y')}, 'no column found for tip_x and tip_y'),
        ({'axes': ('x', 'q')}, "axes must be one or several of x, y, z, got 'x,q'"),
        ({'axes': ()}, "axes must be one or several of x, y, z, got ''"),
        ({'tip_topic': '/tip'}, 'is a table: name columns instead of --tip-topic'),
    ):
        with pytest.raises((RecordingError, ParameterError), match=complaint):
            read_sensor_recording(log, truth, **words)
    pixels = write_table(tmp_path / 'px.csv', one.true_time, one.true_tip, 'time,x [px],y,z')
    own = write_table(tmp_path / 'own.csv', one.time, one.tip)
    for paths, option in (((pixels, own), '--columns'), ((own, pixels), '--truth-columns')):
        with pytest.raises(RecordingError, match=f"the unit 'px' .* use {option} 'tip_x=x "):
            read_sensor_recording(*paths)
    late = write_table(tmp_path / 'late.csv', one.true_time + 1e6, one.true_tip)
    with pytest.raises(RecordingError, match=r'do not overlap in time; they last from 0\.025 to'):
        read_sensor_recording(own, late)
    with pytest.raises(ParameterError, match=r'a constant position is x, y, z \[m\]'):
        read_sensor_recording(late, (0.0, 0.05))


def test_a_bag_has_topics_of_sensor_and_true_position(tmp_path: Path) -> None:
    """Stamps of headers have no delay, receive times have it; joints are a true position, too."""
    one = recorded(moving=True, noise=1.8e-4)
    late, start, path = 0.06, 1_700_000_000_000_000_000, tmp_path / 'run'
    point, joints = contract.TIP_DEFLECTION, contract.ground_truth(1, commanded=False)
    names = [joint.name for joint in joints.joints]
    with BagWriter(path) as bag:
        for name, topic in (('/tip_deflection', point), ('/robot_tip', point), ('/arm', joints)):
            bag.add_topic(name, topic.type_name)
        for time, measured, true in zip(one.time, one.tip, one.true_tip, strict=True):
            stamp = start + round(1e9 * time)
            row = measured.tolist(), true.tolist()
            many = [*row[1], *[0.0] * (len(joints.quantities) - 3)]
            for name, topic, numbers, after in (
                ('/tip_deflection', point, row[0], late),
                ('/robot_tip', point, row[1], 0.0),
                ('/arm', joints, many, 0.0),
            ):
                data = topic.template().serialize(stamp, *numbers)
                bag.write(name, data, stamp + round(1e9 * after))
    for time, delay in (('header', 0.0), ('receive', late)):
        found = identify_sensor(
            read_sensor_recording(path, path, truth_topic='/robot_tip', time=time)
        )
        low, high = found['delay'].interval
        assert low < delay < high
    of = {f'tip_{axis}': name for axis, name in zip('xyz', names, strict=False)}
    arm = read_sensor_recording(path, path, truth_topic='/arm', truth_columns=of)
    np.testing.assert_allclose(arm.true_tip, one.true_tip, rtol=1e-12)
    with pytest.raises(RecordingError, match=r'truth_topic .* must name one of'):
        read_sensor_recording(path, path)


def test_the_topic_that_is_left_is_that_of_the_sensor(tmp_path: Path) -> None:
    """With the other named, in the same bag."""
    one, path, point = (
        recorded(moving=True, noise=1.8e-4),
        tmp_path / 'run',
        contract.TIP_DEFLECTION,
    )
    with BagWriter(path) as bag:
        for name, positions in (('/aurora', one.tip), ('/robot_tip', one.true_tip)):
            bag.add_topic(name, point.type_name)
            for time, row in zip(one.time, positions, strict=True):
                stamp = 1_700_000_000_000_000_000 + round(1e9 * time)
                bag.write(name, point.template().serialize(stamp, *row.tolist()), stamp)
    for truth, tip in (('/robot_tip', None), (None, '/aurora')):
        found = read_sensor_recording(path, path, truth_topic=truth, tip_topic=tip)
        np.testing.assert_allclose(found.tip, one.tip, rtol=1e-12)
        np.testing.assert_allclose(found.true_tip, one.true_tip, rtol=1e-12)
    with pytest.raises(RecordingError, match='must name one of /aurora, /robot_tip'):
        read_sensor_recording(path, str(tmp_path / '.' / 'run'))


def run(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> tuple[str, str]:
    assert main(['identify', 'sensor', *words]) == status
    said = capsys.readouterr()
    return said.out, said.err


def test_parameter_file_is_accepted_by_plant_and_steering(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has the values of the JSON output, without undetermined ones."""
    one = recorded(moving=True, **ERRORS, delay=0.1)
    log = str(write_table(tmp_path / 'log.csv', one.time, one.tip))
    truth = str(write_table(tmp_path / 'truth.csv', one.true_time, one.true_tip))
    output = tmp_path / 'sensor.yaml'
    out, said = run(capsys, log, '--truth', truth, '--json', '-o', str(output))
    found = json.loads(out)['parameters']
    sections = yaml.safe_load(output.read_text(encoding='utf-8'))
    plant = sections['/**/plant']['ros__parameters']
    made = PlantConstants.of({**plant, 'steered': True})
    for name in ('noise', 'slow_noise', 'slow_time', 'dropout', 'dropout_time', 'delay'):
        # Seven digits in the file.
        assert getattr(made.tip, name) == pytest.approx(found[name]['value'], rel=1e-6)
    biases = [found[f'bias_{axis}']['value'] for axis in 'xyz']
    assert list(made.tip.offset) == pytest.approx(biases, rel=1e-6)
    assert made.tip.rate == pytest.approx(RATE, rel=1e-3)
    made.make()
    steering = sections['/**/steering']['ros__parameters']
    prior = SteeringPrior(**{name.removeprefix('prior.'): steering[name] for name in steering})
    # About 18 of 20 readings in 0.5 s.
    assert prior.noise == pytest.approx(found['noise']['value'] / 18.0**0.5, rel=0.05)
    assert prior.drift == pytest.approx(found['slow_noise']['value'], rel=1e-6)
    assert 'columns by their names' in said
    text, _ = run(capsys, log, '--truth', truth)
    assert 'Slow noise s_s [m]' in text
    still = recorded(noise=1.8e-4)
    held = str(write_table(tmp_path / 'held.csv', still.time, still.tip))
    run(capsys, held, '--truth', '2mm,50mm,1mm', '-o', str(output))
    plant = yaml.safe_load(output.read_text(encoding='utf-8'))['/**/plant']['ros__parameters']
    assert {*plant} == {'tip.rate', 'tip.noise', 'tip.dropout', 'tip.offset'}


def test_invalid_options_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = recorded(count=200, noise=1.8e-4)
    log = str(write_table(tmp_path / 'log.csv', one.time, one.tip))
    for words, complaint in (
        ([], '--truth X,Y,Z or --truth FILE must give the true position'),
        (['--truth', '1mm,2mm'], "three lengths x,y,z such as 0mm,52.3mm,0mm, got '1mm,2mm'"),
        (['--truth', 'none.csv'], '--truth must be a file, or three lengths'),
        (['--truth', '0,nan,0'], '--truth must be a file, or three lengths'),
        (['--truth', '-2,50,1'], 'true position in mm'),
        (['--truth', '0,0,0', '--columns', 'depth=z'], 'with the roles time, tip_x, tip_y, tip_z'),
        (['--truth', '0,0,0', '-o', str(tmp_path / 'no' / 'x.yaml')], 'folder does not exist'),
    ):
        out, said = run(capsys, log, *words, status=2)
        assert out == ''
        errors = [line for line in said.splitlines() if not line.startswith('warning')]
        assert len(errors) == 1
        assert complaint in errors[0]


def test_likelihood_at_very_dense_samples_is_finite() -> None:
    """A correlation time of 1e6 intervals leaves differences of neighbors only."""
    time, steps = 1e-3 * np.arange(2000.0), np.random.default_rng(1).standard_normal((2000, 2))
    found = NoiseLikelihood(time, 1e-6 * np.cumsum(steps, axis=0), None).fit(log(1e9), log(1e3))
    assert np.isfinite(found.deviance)
    # A random walk with the variance 2 h s^2 / tau per step; 1.1 % for 4000 steps, taken four
    # times.
    size = exp(found.log_noise) * sqrt(1e9)
    assert size * sqrt(2.0 * 1e-3 / 1e3) == pytest.approx(1e-6, rel=0.045)


def test_axis_that_never_changes_is_named() -> None:
    clean = recorded(noise=1e-4, moving=True)
    tip, truth = clean.tip.copy(), clean.true_tip.copy()
    tip[:, 1] = tip[0, 1]
    truth[:, 1] += np.linspace(0.0, 1e-4, len(truth))
    found = identify_sensor(replace(changed(clean, tip), true_tip=truth))
    assert 'positions along y never change: stuck, or not measured' in found.warnings


def test_only_the_reversed_axis_is_named_at_rest() -> None:
    """Exchanging axes with similar true positions gains nothing measurable."""
    one = recorded(noise=1.8e-4, offset=(1e-3, -5e-4, 2e-3))
    with pytest.raises(IdentificationError, match='match the true x, -y, z, to'):
        identify_sensor(changed(one, one.tip * [1.0, -1.0, 1.0]))


@pytest.mark.parametrize(('offset', 'words'), [(1.5, '1.5 s later'), (-3.0, '3 s earlier')])
def test_different_clocks_are_named_and_corrected(offset: float, words: str) -> None:
    """Noise and bias are as with the same clock; the delay is not determined."""
    one = recorded(moving=True, noise=1.8e-4, offset=(1e-3, 0.0, 0.0))
    same = identify_sensor(one)
    found = identify_sensor(replace(one, true_time=one.true_time - offset))
    assert any(f'the true position fits {words}: clocks' in line for line in found.warnings)
    assert not found['delay'].determined
    assert same['delay'].determined
    assert not same.warnings
    # The last 2 s of 75 s are not covered by both: much less than the error of the bias.
    half = 0.5 * same['bias_x'].error
    assert found['bias_x'].value == pytest.approx(same['bias_x'].value, abs=half)
    assert found['noise'].value == pytest.approx(same['noise'].value, rel=0.02)
    assert not found['slow_noise'].determined


def test_clocks_that_drift_apart_are_named() -> None:
    """By 75 ms in 75 s; the errors stay white, and the delay is not determined."""
    one = recorded(moving=True, noise=1.8e-4)
    found = identify_sensor(replace(one, time=1.001 * one.time))
    (words,) = (line for line in found.warnings if 'the clock of the tip sensor gains' in line)
    match = re.search(r'gains ([\d.]+) ms', words)
    assert match
    # Four standard errors of 1 ms.
    assert float(match[1]) == pytest.approx(75.0, abs=4.0)
    assert not found['delay'].determined
    assert not found['slow_noise'].determined


@pytest.mark.parametrize('axes', [('x', 'y', 'z'), ('x', 'z')])
@pytest.mark.parametrize(('scale', 'angle'), [(1.02, 0.0), (1.0, 5.0)])
def test_error_that_follows_the_true_position_is_named(
    scale: float, angle: float, axes: tuple[str, ...]
) -> None:
    """A scale or rotated axes are no slow noise, and noise and bias are as without them."""
    whole, columns = recorded(moving=True, noise=1.8e-4), ['xyz'.index(axis) for axis in axes]
    one = replace(whole, axes=axes, tip=whole.tip[:, columns], true_tip=whole.true_tip[:, columns])
    clean = identify_sensor(one)
    cosine, sine = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    turn = np.eye(len(axes))
    turn[[0, 0, -1, -1], [0, -1, 0, -1]] = cosine, sine, -sine, cosine
    center = one.true_tip.mean(axis=0)
    found = identify_sensor(changed(one, center + scale * (one.tip - center) @ turn.T))
    (words,) = (line for line in found.warnings if 'depends on the true position' in line)
    assert f'motion along z is measured {scale:.2f}' in words
    match = re.search(r'along x is .*? turned by ([\d.e-]+) deg', words)
    assert match
    # 0.2 mm of noise, 10 mm of motion and 3000 samples: four standard errors of 0.03 deg.
    assert float(match[1]) == pytest.approx(angle, abs=0.12)
    assert not found['slow_noise'].determined
    assert found['noise'].value == pytest.approx(clean['noise'].value, rel=0.03)
    for axis in axes:
        low, high = found[f'bias_{axis}'].interval
        # The mean of the samples differs from that of the path: five standard errors.
        assert low - 2e-5 < 0.0 < high + 2e-5


@pytest.mark.parametrize(('rate', 'is_slow'), [(2.0, False), (0.8, True)])
def test_a_path_recorded_slowly_is_interpolated_or_named(rate: float, is_slow: bool) -> None:
    """Motion up to 0.2 Hz at 2 Hz leaves white noise; at 0.8 Hz the rate is named."""
    one = recorded(moving=True, noise=1.8e-4)
    time = np.arange(-5.0, 80.0, 1.0 / rate)
    phases = np.add(np.outer(time, [1.3, 0.7, 1.1]), [0.0, 0.0, 1.6])
    slow = replace(one, true_time=time, true_tip=HELD + 0.01 * np.sin(phases))
    found = identify_sensor(slow)
    named = [line for line in found.warnings if f'recorded at {rate:g} Hz, too slowly' in line]
    assert len(named) == is_slow
    assert is_slow or not found['slow_noise'].determined


def test_noise_of_the_true_position_is_no_drift_and_no_delay() -> None:
    """Slopes of neighboring rows would have its noise, and a delay 8 ms off with 0.2 ms error."""
    one = recorded(moving=True, noise=1.8e-4)
    time = np.arange(-2.0, 78.0, 0.01)
    phases = np.add(np.outer(time, [1.3, 0.7, 1.1]), [0.0, 0.0, 1.6])
    noise = 3e-4 * np.random.default_rng(2).standard_normal((len(time), 3))
    path = HELD + 0.01 * np.sin(phases) + noise
    found = identify_sensor(replace(one, true_time=time, true_tip=path))
    assert found.warnings == ()
    # Four standard errors of 0.5 ms.
    assert found['delay'].value == pytest.approx(0.0, abs=2e-3)


def test_a_constant_velocity_does_not_separate_bias_and_delay() -> None:
    """In one line, as its normal equations are singular."""
    one = recorded(moving=True, noise=1.8e-4)
    ramp = np.outer(one.time, [0.0, 1e-3, 0.0])
    moved = replace(one, tip=one.tip - one.true_tip + ramp, true_tip=ramp)
    with pytest.raises(IdentificationError, match='constant velocity, which does not separate'):
        identify_sensor(moved)
