# SPDX-License-Identifier: Apache-2.0
"""Errors of the tip sensor: variance, correlation in time and space, and bursts."""

from __future__ import annotations

from math import exp, sqrt
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import FloatArray
from needle_dynamics.simulated.tip_sensor import (
    BurstLosses,
    Distortion,
    SlowNoise,
    TipErrorParameters,
    TipParameters,
    TipSensor,
)
from needle_ros.errors import ParameterError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

TIP = (2e-3, 0.05, 1e-3)  # x, depth, z [m]
ERRORS: dict[str, Any] = {
    'slow_noise': 3e-4, 'slow_time': 0.5, 'dropout': 0.2, 'dropout_time': 0.3,
    'distortion': 5e-4, 'distortion_length': 0.03,
}  # fmt: skip


def measured(
    count: int, *, seed: int = 3, spatial: bool = True, plant: float = 100.0, **constants: Any
) -> FloatArray:
    """Return measurements x, y, z of a tip at rest in a plant of a rate [Hz]; NaN if lost."""
    sensor = TipSensor(TipParameters(**{'noise': 0.0, **constants}), plant, seed, spatial=spatial)
    x, depth, z = TIP
    found = [sensor.measure(depth, z, x) for _ in range(count)]
    return np.array([reading.point if reading else [np.nan] * 3 for reading in found])


@pytest.mark.parametrize('parts', [1, 7])
@pytest.mark.parametrize('interval', [0.01, 0.2, 0.5, 3.0])
def test_slow_noise_is_independent_of_the_sampling_period(interval: float, parts: int) -> None:
    """Variance and correlation over an interval do not depend on the samples within it."""
    size, time = 3e-4, 0.5
    noise = SlowNoise(size, time, np.random.default_rng(1), 20_000)
    first = noise.value
    for _ in range(parts):
        noise.advance(interval / parts)
    for value in (first, noise.value):
        # 20 000 independent values: a deviation has an error of 0.5 %, taken four times.
        assert value.std() == pytest.approx(size, rel=0.02)
    # The standard error of a correlation is at most 0.007, taken four times.
    kept = np.corrcoef(first, noise.value)[0, 1]
    assert kept == pytest.approx(exp(-interval / time), abs=0.028)


@pytest.mark.parametrize('rate', [0.0, 70.0])
def test_slow_noise_of_a_sensor_in_time(rate: float) -> None:
    """Also at a rate that does not divide the rate of the plant; on every axis."""
    time, plant = 0.05, 1000.0
    found = measured(100_000, plant=plant, slow_noise=3e-4, slow_time=time, rate=rate)
    errors = found[~np.isnan(found[:, 0])] - TIP
    kept = exp(-1.0 / (time * (rate or plant)))
    # Effective numbers of independent samples; four standard errors of deviation and correlation.
    effective = len(errors) * (1.0 - kept**2) / (1.0 + kept**2)
    assert_allclose(errors.std(axis=0), 3e-4, rtol=4.0 / sqrt(2.0 * effective))
    lagged = (errors[1:] * errors[:-1]).mean(axis=0) / errors.var(axis=0)
    assert_allclose(lagged, kept, atol=4.0 * sqrt((1.0 - kept**2) / len(errors)))
    assert np.abs(np.corrcoef(errors.T) - np.eye(3)).max() < 4.0 / sqrt(effective)


@pytest.mark.parametrize('interval', [0.02, 0.3, 2.0])
def test_bursts_have_fraction_and_duration(interval: float) -> None:
    """For any interval, as samples of the same process in continuous time."""
    fraction, time, count = 0.2, 0.3, 100_000
    losses = BurstLosses(fraction, time, np.random.default_rng(1))
    lost = np.array([losses.lost(interval) for _ in range(count)])
    kept = exp(-interval / (time * (1.0 - fraction)))
    # The effective number of samples is count (1 - kept) / (1 + kept); four standard errors.
    error = sqrt(fraction * (1.0 - fraction) / count * (1.0 + kept) / (1.0 - kept))
    assert lost.mean() == pytest.approx(fraction, abs=4.0 * error)
    ends = np.mean(~lost[1:][lost[:-1]])
    expected = (1.0 - fraction) * (1.0 - kept)
    # Each of about 20 000 lost samples ends a burst or not; four standard errors.
    assert ends == pytest.approx(expected, abs=4.0 * sqrt(expected * (1.0 - expected) / 20_000))


def test_mean_duration_of_bursts() -> None:
    """Sampled finely, a burst lasts for the given time, and all are lost at a fraction of one."""
    interval = 1e-3
    losses = BurstLosses(0.3, 0.1, np.random.default_rng(2))
    lost = np.array([losses.lost(interval) for _ in range(300_000)])
    bursts = np.sum(lost[1:] & ~lost[:-1])
    # About 900 bursts of exponential duration: an error of 3.3 %, taken four times. Bursts
    # between two samples are not seen: another 1 %.
    assert lost.sum() * interval / bursts == pytest.approx(0.1, rel=0.14)
    assert np.isnan(measured(50, dropout=1.0, dropout_time=0.3)).all()


@pytest.mark.parametrize('distance', [0.0, 0.015, 0.03, 0.09])
def test_distortion_has_rms_and_correlation_length(distance: float) -> None:
    size, length = 5e-4, 0.03
    fields = [Distortion(size, length, np.random.default_rng(seed)) for seed in range(4000)]
    here = np.array([field.error(TIP) for field in fields])
    step = distance * np.array([0.6, 0.0, 0.8])
    there = np.array([field.error(TIP + step) for field in fields])
    # 4000 independent fields of three axes: 0.65 %, taken four times.
    assert np.sqrt(np.mean(here**2)) == pytest.approx(size, rel=0.026)
    # 12 000 products: a standard error of at most 0.013, taken four times.
    kept = np.mean(here * there) / size**2
    assert kept == pytest.approx(exp(-0.5 * (distance / length) ** 2), abs=0.052)


def test_rms_of_each_field_in_a_large_space() -> None:
    """The mean square over space is exact for each seed, not only over seeds."""
    field = Distortion(5e-4, 1e-3, np.random.default_rng(5))
    points = np.random.default_rng(1).uniform(-10.0, 10.0, (4000, 3))
    errors = np.array([field.error(point) for point in points])
    # 4000 points, 10^4 lengths apart: 1.1 %, taken four times.
    assert_allclose(np.sqrt(np.mean(errors**2, axis=0)), 5e-4, rtol=0.045)


@settings(max_examples=30, deadline=None)
@given(point=st.tuples(*[st.floats(-0.2, 0.2)] * 3), step=st.tuples(*[st.floats(-1e-5, 1e-5)] * 3))
def test_distortion_is_fixed_and_smooth(
    point: tuple[float, float, float], step: tuple[float, float, float]
) -> None:
    """A point always has the same error; nearby points have nearly the same."""
    field = Distortion(5e-4, 0.03, np.random.default_rng(4))
    error = field.error(point)
    assert_array_equal(field.error(point), error)
    # Slopes of an axis have an RMS of size / length along each axis; ten times that.
    assert np.abs(field.error(np.add(point, step)) - error).max() <= (
        10.0 * 5e-4 / 0.03 * np.linalg.norm(step) + 1e-18
    )


def test_seed_determines_all_errors() -> None:
    first, again, other = (measured(300, seed=seed, **ERRORS) for seed in (3, 3, 4))
    assert_array_equal(first, again)
    both = ~np.isnan(first) & ~np.isnan(other)
    assert both.any()
    assert (first[both] != other[both]).all()
    # The field does not depend on the size of other errors.
    field: dict[str, Any] = {'distortion': 5e-4, 'distortion_length': 0.03}
    lost = measured(300, **field, dropout=0.2)
    assert_array_equal(lost[~np.isnan(lost)], measured(300, **field)[~np.isnan(lost)])


def test_sizes_of_zero_change_no_bit() -> None:
    """White noise and independent losses are the draws of their own streams, times and all."""
    found = measured(
        400, noise=1.8e-4, dropout=0.1, slow_time=0.2, distortion_length=0.01, dropout_time=0.0
    )
    random, losses = np.random.default_rng([3, 1]), np.random.default_rng([3, 3])
    noise = random.standard_normal((400, 3))[:, [1, 2, 0]]
    expected = np.array(TIP) + 1.8e-4 * noise
    expected[losses.random(400) < 0.1] = np.nan
    assert_array_equal(found, expected)


def test_a_planar_sensor_has_an_error_of_the_deflection_only() -> None:
    """It is the z error of a spatial sensor with the same seed."""
    whole, plane = (measured(100, spatial=spatial, **ERRORS) for spatial in (True, False))
    kept = ~np.isnan(plane[:, 0])
    assert_array_equal(plane[kept, 1], TIP[1])
    assert_array_equal(plane[kept, 2], whole[kept, 2])


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'slow_noise': -1e-4}, r'slow_noise must be finite, >= 0 m, got -0\.0001'),
        ({'slow_time': 0.0}, r'slow_time must be finite, > 0 s, got 0\.0'),
        ({'dropout': 1.1}, r'dropout must be finite, >= 0 and <= 1, got 1\.1'),
        ({'dropout_time': -1.0}, r'dropout_time must be finite, >= 0 s, got -1\.0'),
        ({'distortion': float('nan')}, r'distortion must be finite, >= 0 m, got nan'),
        ({'distortion_length': 0.0}, r'distortion_length must be finite, > 0 m, got 0\.0'),
    ],
)
def test_invalid_constants_are_rejected(change: dict[str, float], complaint: str) -> None:
    for settings_type in (TipErrorParameters, TipParameters):
        with pytest.raises(ParameterError, match=complaint):
            settings_type(**change)
