# SPDX-License-Identifier: Apache-2.0
"""Residual tests equal the tests of SciPy, and each detects its own fault."""

from __future__ import annotations

from needle_dynamics import FloatArray
from needle_identification.estimation import residual_tests as ours
from needle_identification.estimation.memory import divided, Memory
from needle_identification.estimation.residual_tests import residual_tests, ResidualTest
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy import stats

COUNT, LENGTH = 200, 25

WHITE = Memory(inflation=np.ones(2), far=np.ones(2), length=0.0, ratio=0.0)


def results_of(means: FloatArray, velocities: FloatArray) -> dict[str, ResidualTest]:
    """Test a residual with constant values per part."""
    residual, velocity = (np.repeat(values, LENGTH) for values in (means, velocities))
    found = residual_tests(
        residual,
        time=np.arange(len(residual), dtype=np.float64),
        velocity=velocity,
        parts=divided(np.ones(len(residual), dtype=np.bool_), LENGTH),
        memory=WHITE,
        parameters=2,
    )
    return {test.name: test for test in found}


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('power', [1, 3])
def test_statistics_and_p_values_equal_scipy(seed: int, power: int) -> None:
    rng = np.random.default_rng(seed)
    means, velocities = rng.normal(size=(2, COUNT))
    means = means**power
    found = results_of(means, velocities)
    groups = [means[group] for group in np.array_split(np.argsort(velocities), 10)]
    expected = {
        'normality': stats.normaltest(means),
        'trend': stats.spearmanr(np.arange(COUNT), means),
        'spread': stats.levene(*groups, center='median'),
    }
    for name, (statistic, p_value) in expected.items():
        # 1e-9: rounding of sums of 200 values, and of the means over parts.
        assert_allclose(found[name].statistic, statistic, rtol=1e-9, atol=1e-12)
        assert_allclose(found[name].p_value, p_value, rtol=1e-9)


def test_equal_values_share_their_rank() -> None:
    values = np.array([2.0, 1.0, 2.0, 3.0, 2.0])
    assert_allclose(ours._ranks(values), stats.rankdata(values), rtol=0.0)


def test_few_parts_are_tested_for_normality_by_shapiro_and_wilk() -> None:
    means, velocities = np.random.default_rng(0).normal(size=(2, 15))
    # 1e-9: rounding of the means over parts.
    assert_allclose(
        results_of(means, velocities)['normality'].p_value, stats.shapiro(means).pvalue, rtol=1e-9
    )


@pytest.mark.parametrize('name', ['normality', 'trend', 'speed', 'spread'])
def test_each_test_detects_its_own_fault(name: str) -> None:
    rng = np.random.default_rng(1)
    noise, velocities = rng.normal(size=(2, COUNT))
    faulty = {
        'normality': noise**3,
        'trend': noise + np.linspace(-1.0, 1.0, COUNT),
        'speed': noise + velocities**2,
        'spread': noise * np.exp(velocities),
    }
    assert not any(test.failed for test in results_of(noise, velocities).values())
    assert results_of(faulty[name], velocities)[name].failed


def test_too_few_parts_are_not_tested() -> None:
    assert results_of(np.zeros(9), np.zeros(9)) == {}
