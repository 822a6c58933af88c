# SPDX-License-Identifier: Apache-2.0
"""Regression recovers parameters with valid errors, and marks undetermined parameters."""

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import FloatArray, ParameterError, ShapeError
from needle_identification import ESTIMATORS, IdentificationError, ParameterEstimate, regress
from needle_identification.estimation.estimate import statistic
from needle_identification.estimation.regression import Regression, wald_test
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.signal import lfilter

VALUES = np.array([0.56, 300.0, -2.0])
#: Columns of very different scale, such as sgn(v), v and an offset.
SIZES = np.array([1.0, 1e-2, 0.1])


def problem(
    seed: int = 0, n: int = 600, noise: float = 0.0
) -> tuple[FloatArray, FloatArray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    x = SIZES * rng.normal(loc=[0.2, 0.5, 0.0], size=(n, 3))
    return x, x @ VALUES + noise * rng.normal(size=n), rng


def extras(n: int, noise: tuple[float, ...] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    return {'groups': np.arange(n) % 4, 'regressor_noise': np.array(noise)}


@pytest.mark.parametrize('estimator', ESTIMATORS)
def test_parameters_are_exact_without_noise(estimator: str) -> None:
    x, y, _ = problem()
    found = regress(x, y, estimator=estimator, **extras(len(y)))
    # 1e-10: rounding times the condition number of the columns.
    assert_allclose(found.values, VALUES, rtol=1e-10)
    assert found.determination > 1.0 - 1e-12
    assert found.determined.all()
    assert (found.errors < 1e-9 * np.abs(VALUES)).all()


@pytest.mark.parametrize('estimator', ESTIMATORS)
@given(scale=st.floats(1e-3, 1e3), column=st.floats(1e-3, 1e3), sign=st.sampled_from([-1.0, 1.0]))
@settings(max_examples=10, deadline=None)
def test_estimates_scale_with_the_units(
    estimator: str, scale: float, column: float, sign: float
) -> None:
    x, y, _ = problem(noise=0.1)
    one = regress(x, y, estimator=estimator, **extras(len(y), (0.0, 1e-3, 0.0)))
    units = np.array([1.0, sign * column, 1.0])
    noise = (0.0, 1e-3 * column, 0.0)
    other = regress(units * x, scale * y, estimator=estimator, **extras(len(y), noise))
    # 1e-6: iterations of Huber stop at 1e-9 of the solution.
    assert_allclose(other.values, scale * one.values / units, rtol=1e-6)
    assert_allclose(other.errors, scale * one.errors / np.abs(units), rtol=1e-6)
    assert_allclose(other.condition, one.condition, rtol=1e-9)


def test_ordinary_is_least_squares_with_its_textbook_errors() -> None:
    x, y, _ = problem(noise=0.1, n=20_000)
    found = regress(x, y)
    assert_allclose(found.values, np.linalg.lstsq(x, y, rcond=None)[0], rtol=1e-9)
    textbook = np.sqrt(np.diag(np.linalg.inv(x.T @ x)) * np.mean(found.residual**2))
    # Errors from scores scatter by sqrt(2 / n) = 1 % and the kurtosis of the regressors.
    assert_allclose(found.errors, textbook, rtol=0.05)


def test_huber_is_robust_against_gross_outliers() -> None:
    x, y, rng = problem(noise=0.1)
    struck = rng.random(len(y)) < 0.1
    y = y + np.where(struck, 50.0, 0.0)
    huber, ordinary = regress(x, y, estimator='huber'), regress(x, y)
    # Each value is within four standard errors of the true one.
    assert (np.abs(huber.values - VALUES) < 4.0 * huber.errors).all()
    assert (huber.errors < 0.1 * ordinary.errors).all()


def test_total_least_squares_has_no_attenuation_bias() -> None:
    noise = 0.3 * SIZES[1]
    total, ordinary = [], []
    for seed in range(50):
        x, y, rng = problem(seed, noise=0.1)
        x[:, 1] += noise * rng.normal(size=len(y))
        extra = extras(len(y), (0.0, noise, 0.0))
        total.append(regress(x, y, estimator='total', **extra))
        ordinary.append(regress(x, y))
    means = [np.mean([f.values[1] for f in found]) for found in (total, ordinary)]
    errors = np.array([f.errors[1] for f in total])
    # Variance 1 and noise 0.09, with 8 % of the column explained by the others.
    assert means[1] < 0.95 * VALUES[1]
    assert abs(means[0] - VALUES[1]) < 4.0 * errors.mean() / np.sqrt(50.0)
    # A standard deviation from 50 values has an error of 10 %: three of these.
    assert_allclose(np.std([f.values[1] for f in total]), np.sqrt(np.mean(errors**2)), rtol=0.3)


def test_total_least_squares_rejects_columns_of_noise() -> None:
    x, y, _ = problem()
    with pytest.raises(IdentificationError, match='noise of the regressors exceeds'):
        regress(x, y, estimator='total', **extras(len(y), (0.0, 1.0, 0.0)))


def test_weighting_by_group_reduces_the_errors() -> None:
    values: dict[str, list[Regression]] = {'ordinary': [], 'weighted': []}
    for seed in range(100):
        x, y, rng = problem(seed)
        groups = np.arange(len(y)) // 150
        y = y + np.array([0.02, 0.02, 0.02, 1.0])[groups] * rng.normal(size=len(y))
        for estimator, found in values.items():
            found.append(regress(x, y, estimator=estimator, groups=groups))
    spread = {e: np.std([f.values for f in found], axis=0) for e, found in values.items()}
    assert (spread['weighted'] < 0.1 * spread['ordinary']).all()
    claimed = np.sqrt(np.mean([f.errors**2 for f in values['weighted']], axis=0))
    # A standard deviation from 100 values has an error of 7 %: three of these.
    assert_allclose(claimed, spread['weighted'], rtol=0.21)


@pytest.mark.parametrize('estimator', ESTIMATORS)
def test_intervals_have_their_coverage_for_correlated_noise(estimator: str) -> None:
    """Noise of a first-order filter with a time constant of 10 samples, and smooth regressors."""
    rng = np.random.default_rng(7)
    n, runs = 1500, 200
    x = np.column_stack([np.sign(np.sin(np.arange(n) / 40.0)), np.sin(np.arange(n) / 90.0)])
    covered = []
    for _ in range(runs):
        y = x @ [1.0, 2.0] + lfilter([0.1], [1.0, -0.9], rng.normal(size=n))
        found = regress(
            x, y, estimator=estimator, correlation=61, groups=np.arange(n) // 375,
            regressor_noise=np.zeros(2),
        )  # fmt: skip
        low, high = found.interval().T
        covered.append((low <= [1.0, 2.0]) & (high >= [1.0, 2.0]))
    # 400 trials at 95 %: standard deviation 1.1 % (correlated in pairs: 1.5 %), three of these.
    assert abs(np.mean(covered) - 0.95) < 0.045
    independent = regress(x, y)
    assert (independent.errors < 0.5 * found.errors).all()


def test_unused_samples_have_no_influence() -> None:
    x, y, rng = problem(noise=0.1)
    used = rng.random(len(y)) < 0.7
    spoiled = np.where(used, y, 1e6)
    one = regress(x, spoiled, used=used)
    other = regress(x[used], y[used])
    assert_allclose(one.values, other.values, rtol=1e-9)
    assert_allclose(one.errors, other.errors, rtol=1e-9)
    assert one.samples == other.samples == np.count_nonzero(used)
    assert_array_equal(one.residual[~used], 0.0)


@pytest.mark.parametrize('estimator', ESTIMATORS)
def test_only_collinear_parameters_are_not_determined(estimator: str) -> None:
    x, y, _ = problem(noise=0.1)
    x = np.column_stack([x, x[:, 0] - 3.0 * x[:, 2]])
    extra = extras(len(y)) | {'regressor_noise': np.zeros(4)}
    found = regress(x, y, estimator=estimator, **extra)
    assert_array_equal(found.determined, [False, True, False, False])
    assert np.isnan(found.values[[0, 2, 3]]).all()
    assert np.isinf(found.errors[[0, 2, 3]]).all()
    assert_array_equal(found.interval()[0], [-np.inf, np.inf])
    plain = regress(x[:, :3], y, estimator=estimator, **extras(len(y)))
    # 2 %: one parameter more or less in the small-sample correction of 600.
    assert_allclose(found.values[1], plain.values[1], rtol=1e-8)
    assert_allclose(found.errors[1], plain.errors[1], rtol=0.02)


@pytest.mark.parametrize(('spread', 'determined'), [(0.05, False), (0.3, True)])
def test_nearly_collinear_parameters_are_not_determined(spread: float, determined: bool) -> None:
    rng = np.random.default_rng(0)
    velocity = 5e-3 * (1.0 + spread * rng.normal(size=1000))
    x = np.column_stack([np.ones(1000), velocity])
    found = regress(x, x @ [0.56, 300.0])
    assert (found.determined == determined).all()


@pytest.mark.parametrize('noise', [0.1, 0.2])
@pytest.mark.parametrize(('spread', 'determined'), [(0.0, False), (0.05, False), (0.3, True)])
def test_noise_of_the_regressors_determines_nothing(
    spread: float, determined: bool, noise: float
) -> None:
    """The same parameters are determined with and without noise that is known."""
    rng = np.random.default_rng(0)
    velocity = 5e-3 * (1.0 + spread * rng.normal(size=(5000, 1)))
    velocity = np.hstack([velocity, velocity + 5e-3 * noise * rng.normal(size=(5000, 1))])
    moments = np.diag([0.0, 5000 * (5e-3 * noise) ** 2])
    for column, known in zip(velocity.T, (None, moments), strict=True):
        x = np.column_stack([np.ones(5000), column])
        found = regress(x, 0.56 + 300.0 * velocity[:, 0], noise_moments=known)
        assert (found.determined == determined).all()


def test_a_column_of_zeros_is_not_determined() -> None:
    x, y, _ = problem(noise=0.1)
    found = regress(np.column_stack([x, np.zeros(len(y))]), y)
    assert_array_equal(found.determined, [True, True, True, False])


def test_the_p_value_of_the_wald_test_is_uniform_under_the_null_hypothesis() -> None:
    chances = []
    for seed in range(400):
        x, y, rng = problem(seed, n=60, noise=0.1)
        more = regress(np.column_stack([x, rng.normal(size=(60, 2))]), y)
        chances.append(wald_test(more, [3, 4]))
        assert wald_test(more, [0]) < 0.05
    # 400 trials at 5 %: standard deviation 1.1 %; scores of 60 samples are slightly too small.
    assert 0.02 < np.mean(np.array(chances) < 0.05) < 0.1


@pytest.mark.parametrize(
    ('changes', 'error', 'complaint'),
    [
        ({'estimator': 'best'}, ParameterError, 'estimator must be one of ordinary, weighted'),
        ({'estimator': 'weighted'}, ParameterError, 'weighted needs the group of each sample'),
        ({'estimator': 'total'}, ParameterError, 'total needs the noise of each column'),
        ({'used': np.ones(3, bool)}, ShapeError, r'do not match: \(600, 3\), \(600,\), \(3,\)'),
        ({'used': np.arange(600) < 3}, IdentificationError, '3 parameters need more than 3'),
        ({'correlation': 1000}, IdentificationError, 'independent samples, got 0.8'),
    ],
)
def test_invalid_arguments_are_rejected(
    changes: dict[str, Any],
    error: type[IdentificationError] | type[ParameterError] | type[ShapeError],
    complaint: str,
) -> None:
    x, y, _ = problem()
    with pytest.raises(error, match=complaint):
        regress(x, y, **changes)


def test_nonfinite_values_are_rejected() -> None:
    x, y, _ = problem()
    y[7] = np.nan
    with pytest.raises(ShapeError, match='must be finite'):
        regress(x, y)
    assert regress(x, y, used=np.isfinite(y)).samples == 599


def estimates(values: list[float], error: float) -> list[ParameterEstimate]:
    return [
        ParameterEstimate(
            name='coulomb_friction',
            symbol='mu_s',
            unit='N',
            value=value,
            error=error,
            interval=(value - 2.0 * error, value + 2.0 * error),
            determined=True,
        )
        for value in values
    ]


def test_the_statistic_is_mean_and_standard_deviation_as_in_table_1() -> None:
    found = statistic(estimates([0.5, 0.6, 0.7, 0.6], 0.01))
    assert_allclose(found.mean, 0.6, rtol=1e-12)
    assert_allclose(found.deviation, np.sqrt(0.02 / 3.0), rtol=1e-12)
    assert_allclose(found.error, np.sqrt(0.02 / 3.0) / 2.0, rtol=1e-12)
    # Student's t for four recordings that differ by more than their errors, from a table.
    assert_allclose(found.interval, 0.6 + np.array([-3.182, 3.182]) * found.error, rtol=1e-3)
    assert (found.name, found.unit, found.count) == ('coulomb_friction', 'N', 4)


def test_the_standard_error_is_at_least_the_error_within_recordings() -> None:
    found = statistic(estimates([0.6, 0.6], 0.02))
    assert_allclose(found.error, 0.02 / np.sqrt(2.0), rtol=1e-12)
    assert_allclose(found.interval, [0.6 - 2.0 * found.error, 0.6 + 2.0 * found.error])


def test_the_statistic_ignores_undetermined_parameters() -> None:
    unknown = ParameterEstimate(name='coulomb_friction', symbol='mu_s', unit='N')
    one = statistic([unknown, *estimates([0.6], 0.02)])
    assert (one.mean, one.deviation, one.error, one.count) == (0.6, None, 0.02, 1)
    none = statistic([unknown, unknown])
    assert (none.count, none.interval) == (0, (-np.inf, np.inf))
    assert np.isnan(none.mean)


def test_a_statistic_without_estimates_is_rejected() -> None:
    with pytest.raises(IdentificationError, match='no recordings'):
        statistic([])
