# SPDX-License-Identifier: Apache-2.0
"""Calibration study: bounds, coverage and report."""

from __future__ import annotations

from math import nan, pi
from typing import Any

from benchmarks import bounds, calibration
from benchmarks.calibration import CalibrationResult
from needle_dynamics import NeedleParameters
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.simulated.indenter import IndenterParameters
from needle_identification import FrictionSettings
from needle_insertion.cli import main
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import toeplitz


@pytest.fixture(scope='module')
def friction() -> list[list[CalibrationResult]]:
    return [calibration.friction(1, number) for number in range(2)]


@pytest.fixture(scope='module')
def stiffness() -> list[CalibrationResult]:
    return calibration.stiffness(1, 0)


def found(
    value: float,
    low: float,
    high: float,
    *,
    truth: float = 1.0,
    bound: float = 1.0,
    unit: str = 'N',
    case: str = 'a',
) -> CalibrationResult:
    return CalibrationResult(case, 'x', unit, truth, bound, value, 0.5, low, high)


def test_reading_noise_equals_sensor_noise() -> None:
    parameters = ForceSensorParameters(force_noise=(0.01, 0.05, 0.02))
    wrenches = np.zeros((20_000, 6))
    sensor = ForceSensor(parameters, bounds.RATE, 3)
    noise = np.array([sensor.measure(wrench)[1] for wrench in wrenches])
    expected = bounds.reading_noise(parameters, 1)
    measured = [noise[: len(noise) - k] @ noise[k:] / (len(noise) - k) for k in range(5)]
    # Means of 20,000 products: four standard errors of 1/sqrt(20,000).
    assert_allclose(measured, expected[:5], atol=4.0 / np.sqrt(20_000) * expected[0])


def test_information_counts_used_samples_only() -> None:
    rng = np.random.default_rng(2)
    x, noise = rng.standard_normal((40, 2)), np.array([2.0, 0.7, 0.2])
    used = rng.random(40) < 0.7
    covariance = toeplitz(np.append(noise, np.zeros(37)))[np.ix_(used, used)]
    expected = x[used].T @ np.linalg.solve(covariance, x[used])
    assert_allclose(bounds.information(x, noise, used), expected, rtol=1e-12)


def test_sensor_delay_follows_from_filter_cutoffs() -> None:
    assert bounds.sensor_lag(ForceSensorParameters(filter=0)) == 0.0
    # Delay of a second-order Butterworth filter: sqrt(2) / (2 pi f).
    expected = np.sqrt(2.0) / (2.0 * pi) * (1.0 / 500.0 + 1.0 / 125.0)
    # Discrete filters differ by the square of cutoff over rate.
    assert bounds.sensor_lag(ForceSensorParameters()) == pytest.approx(expected, 0.02)


def test_friction_bound_equals_cramer_rao_bound_for_white_noise() -> None:
    needle = NeedleParameters.preset('phantom')
    sensor = ForceSensorParameters(filter=0, force_resolution=0.0)
    motion = calibration.insertion(needle)
    settings = FrictionSettings()
    truth = bounds.friction_truth(needle, sensor, motion.time, motion.speed, settings)
    moving = motion.speed[np.abs(motion.speed) > settings.moving_speed]
    x = np.column_stack([np.sign(moving), moving])
    expected = 0.05**2 * np.diag(np.linalg.inv(x.T @ x))
    names = 'coulomb_friction', 'viscous_friction'
    assert_allclose([truth[name][1] for name in names], expected, rtol=1e-9)


def test_stiffness_bound_is_invariant_to_rotation() -> None:
    tissue, sensor = IndenterParameters(), ForceSensorParameters()
    one = bounds.stiffness_truth(np.array([[900.0, 20.0], [-40.0, 600.0]]), 1.3, sensor, tissue)
    other = bounds.stiffness_truth(np.array([[600.0, 40.0], [-20.0, 900.0]]), 1.3, sensor, tissue)
    # Rotation by 90 degrees exchanges x and z; the set of forces is the same.
    for name, turned in (('k_xx', 'k_zz'), ('k_xz', 'k_zx')):
        assert one[name][1] == pytest.approx(other[turned][1], rel=1e-9)
    for name in ('curl', 'spring', 'principal_stiffness_1', 'principal_angle'):
        # Differences of 1e-3 in 1e3 give gradients to 1e-9 or so.
        assert one[name][1] == pytest.approx(other[name][1], rel=1e-5)


def test_study_is_reproducible_for_seed(friction: list[list[CalibrationResult]]) -> None:
    again = np.array([one[3:] for one in calibration.friction(1, 0)])
    assert np.array_equal(again, np.array([one[3:] for one in friction[0]]), equal_nan=True)
    assert friction[0][0].truth != friction[1][0].truth


def test_every_case_reports_its_parameters(friction: list[list[CalibrationResult]]) -> None:
    by_case: dict[str, set[str]] = {}
    for one in friction[0]:
        by_case.setdefault(one.case, set()).add(one.name)
    assert list(by_case) == list(calibration.FRICTION_CASES)
    assert by_case['(15)'] == {'coulomb_friction', 'viscous_friction', 'breakaway_force', 'lag'}
    assert 'offset' in by_case['+ offset']
    assert 'withdrawal_friction' in by_case['+ direction']
    assert {'breakaway_friction', 'stribeck_friction'} <= by_case['+ break-away']
    assert 'moving_mass' in by_case['+ inertia, stamps off']
    # A lag is not identifiable from positions, or together with a mass.
    assert all(
        ('lag' in names) == ('positions' not in case and 'inertia' not in case)
        for case, names in by_case.items()
    )
    # Cases other than the default case are in every second recording.
    assert {one.case for one in friction[1]} == {'(15)'}


def test_estimates_are_near_ground_truth(
    friction: list[list[CalibrationResult]], stiffness: list[CalibrationResult]
) -> None:
    for one in (*friction[0], *friction[1], *stiffness):
        # No error of a few hundred estimates exceeds four times the 95 % half width.
        if one.name != 'principal_angle' and np.isfinite(one.value):
            assert abs(one.value - one.truth) < 2.0 * (one.high - one.low), one


def test_stiffness_is_reported_by_estimator_and_level(stiffness: list[CalibrationResult]) -> None:
    cases = {one.case for one in stiffness}
    assert cases == {'K, ordinary', 'K, weighted', 'K, huber', 'K, total'}
    assert sum(one.name == 'k_zz' for one in stiffness) == 4 * 5


def test_row_counts_coverage_and_undetermined_estimates() -> None:
    [row] = calibration.summarized(
        [
            found(1.5, 0.5, 2.5),
            found(2.5, 1.5, 3.5),
            found(0.5, 0.0, 1.0),
            found(nan, -np.inf, np.inf),
        ]
    )
    assert (row.count, row.undetermined) == (4, 1)
    assert row.coverage == pytest.approx(2.0 / 3.0)
    assert row.bias == pytest.approx(0.5)
    assert row.efficiency == pytest.approx((0.25 + 2.25 + 0.25) / 3.0)
    assert not row.holds
    [row] = calibration.summarized([found(1.0, 0.0, 2.0, bound=nan)])
    assert row.efficiency is None
    # Full coverage: intervals are too wide.
    assert not row.holds


def test_directions_180_degrees_apart_are_equal() -> None:
    [row] = calibration.summarized([found(-1.5, -1.6, -1.4, truth=1.6, bound=0.01, unit='rad')])
    # -1.5 + pi = 1.64.
    assert row.coverage == 1.0
    assert row.bias == pytest.approx(pi - 3.1)


def test_results_are_independent_of_process_count(friction: list[list[CalibrationResult]]) -> None:
    pairs = list(calibration.studied(calibration.friction, 2, 1, 1))
    assert pairs[1][0] == friction[1][0]
    # Any importable function of seed and number.
    any_function: Any = max
    found: list[Any] = list(calibration.studied(any_function, 8, 5, 2))
    assert found == [5, 5, 5, 5, 5, 5, 6, 7]


def test_bars_apply_to_default_cases_with_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, 'cores', lambda: 1)

    def study(seed: int, number: int) -> list[CalibrationResult]:
        return [
            found(1.5, 0.5, 2.5 + seed + number, case='(15)'),
            found(1.5, 1.4, 1.6, case='K, ordinary', bound=nan),
            found(1.5, 1.4, 1.6),
        ]

    monkeypatch.setattr(calibration, 'STUDIES', {'friction': study})
    told: list[str] = []
    [section], bars = calibration.compare(told.append, recordings=3, seed=2)
    assert told == [f'friction, {k} of 3' for k in (1, 2, 3)]
    assert '3 recordings of each kind' in section.notes
    assert len(section.rows) == 3
    # Coverage with too wide intervals only; 0.5^2 is a quarter of the bound.
    assert [bar.found for bar in bars] == [100.0, 100.0, 0.25]
    assert [bar.missed for bar in bars] == [False, True, False]


@pytest.mark.parametrize('words', [['--recordings', '1'], ['--seed', '-1']])
def test_numbers_out_of_range_exit_with_status_2(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['bench', 'calibration', *words]) == 2
    assert 'must be' in capsys.readouterr().err
