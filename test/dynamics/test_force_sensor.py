"""The force-torque sensor: noise, filter, counts and range."""

from __future__ import annotations

from typing import Any

from needle_dynamics import FloatArray, ForceSensor, ForceSensorParameters, ParameterError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import chi2

RATE = 1000.0
PERFECT = {
    'force_noise': 0.0,
    'torque_noise': 0.0,
    'force_resolution': 0.0,
    'torque_resolution': 0.0,
    'cutoff': 0.0,
}
FORCE, TORQUE = slice(0, 3), slice(3, 6)


def sensor(seed: int = 0, rate: float = RATE, **changes: Any) -> ForceSensor:
    """Make a sensor that is perfect but for the changes."""
    return ForceSensor(ForceSensorParameters(**(PERFECT | changes)), rate, seed)


def readings(of: ForceSensor, wrenches: FloatArray) -> FloatArray:
    return np.array([of.measure(wrench) for wrench in wrenches])


def wrenches(count: int) -> FloatArray:
    return np.random.default_rng(7).normal(size=(count, 6)) * [5, 5, 5, 0.5, 0.5, 0.5]


def test_zero_settings_give_the_identity() -> None:
    """With every imperfection off the sensor reports the truth, bit for bit."""
    truth = wrenches(2000)
    assert np.array_equal(readings(sensor(), truth), truth)


def test_same_seed_same_readings() -> None:
    """Noise is a function of the seed: the same again, another for another seed."""
    truth = wrenches(2500)

    def seen(seed: int) -> FloatArray:
        return readings(ForceSensor(ForceSensorParameters(), RATE, seed), truth)

    assert np.array_equal(seen(1), seen(1))
    assert not np.array_equal(seen(1), seen(2))


def test_noise_is_white_with_the_stated_deviation_about_the_stated_bias() -> None:
    """Variance and mean of each channel are within their sampling bounds; channels differ."""
    count = 20_000
    of = sensor(seed=3, force_noise=0.02, torque_noise=5e-4, force_bias=-0.1, torque_bias=3e-3)
    seen = readings(of, np.zeros((count, 6)))
    deviation = np.repeat([0.02, 5e-4], 3)
    # Chi-square bounds at one in a million each; the seed is fixed.
    low, high = chi2.ppf([5e-7, 1.0 - 5e-7], count - 1) / (count - 1)
    ratio = seen.var(axis=0, ddof=1) / deviation**2
    assert np.all((low < ratio) & (ratio < high))
    # Five standard errors.
    bound = 5.0 / np.sqrt(count)
    normal = (seen - np.repeat([-0.1, 3e-3], 3)) / deviation
    assert np.abs(normal.mean(axis=0)).max() < bound
    # White: no correlation with the next sample, nor after a block of drawn numbers.
    for lag in (1, 2, 1024):
        assert np.abs((normal[:-lag] * normal[lag:]).mean(axis=0)).max() < bound
    # Independent channels.
    assert np.abs(normal.T @ normal / count - np.diag(ratio)).max() < bound


def test_settings_of_forces_and_torques_are_not_mixed_up() -> None:
    """Components come as force x y z, then torque x y z."""
    of = sensor(force_bias=1.0, torque_bias=0.01)
    assert_allclose(of.measure(np.zeros(6)), [1.0, 1.0, 1.0, 0.01, 0.01, 0.01], rtol=1e-15)
    of = sensor(force_range=2.0, torque_range=0.1)
    assert of.measure(np.full(6, 9.0)).tolist() == [2.0] * 3 + [0.1] * 3
    of = sensor(force_resolution=0.5, torque_resolution=0.2)
    assert_allclose(of.measure(np.full(6, 0.35)), [0.5] * 3 + [0.4] * 3, rtol=1e-15)


def response(of: ForceSensor, frequency: float, rate: float = RATE) -> complex:
    """Frequency response from the impulse response; the first sample sets the steady state."""
    of.measure(np.zeros(6))
    # 4000 samples: the slowest filter below has forgotten all but 1e-12.
    impulse = readings(of, np.vstack([np.ones(6), np.zeros((4000, 6))]))
    assert np.all(impulse == impulse[:, :1])
    phases = np.exp(-2j * np.pi * frequency / rate * np.arange(len(impulse)))
    return complex(impulse[:, 0] @ phases)


@pytest.mark.parametrize('cutoff', [5.0, 125.0, 400.0])
def test_low_pass_has_unit_gain_at_rest_and_half_power_at_its_cutoff(cutoff: float) -> None:
    """The filter is a second-order Butterworth: 1 at 0 Hz, -3 dB and -90 degrees at cutoff."""
    # 1e-9: coefficients of a double pole close to 1 at 5 Hz of 1000 Hz, (500 / 5)^2 eps.
    assert_allclose(response(sensor(cutoff=cutoff), 0.0), 1.0, atol=1e-9)
    at_cutoff = response(sensor(cutoff=cutoff), cutoff)
    assert_allclose(abs(at_cutoff), np.sqrt(0.5), atol=1e-9)
    assert_allclose(np.angle(at_cutoff), -np.pi / 2.0, atol=1e-8)
    # A double zero at half the rate.
    assert_allclose(abs(response(sensor(cutoff=cutoff), RATE / 2.0)), 0.0, atol=1e-9)


def test_cutoff_is_in_hertz_at_the_given_rate() -> None:
    """The same cutoff at another rate is the same frequency."""
    of = sensor(rate=500.0, cutoff=20.0)
    assert_allclose(abs(response(of, 20.0, rate=500.0)), np.sqrt(0.5), atol=1e-9)


def test_filter_starts_in_the_steady_state_of_its_first_value() -> None:
    """A constant wrench is reported from the first sample on: no transient at start."""
    truth = np.array([1.0, -2.0, 3.0, 0.1, 0.0, -0.3])
    seen = readings(sensor(cutoff=30.0), np.tile(truth, (500, 1)))
    # Rounding that a double pole at 30 Hz of 1000 Hz keeps.
    assert_allclose(seen, np.tile(truth, (500, 1)), atol=1e-12)


def test_filter_lowers_noise() -> None:
    """White noise through the filter keeps the share of its power that the filter passes."""
    of = sensor(seed=5, force_noise=0.02, cutoff=50.0)
    seen = readings(of, np.zeros((20_000, 6)))[1000:, FORCE]
    # Equivalent noise bandwidth of a second-order Butterworth: 1.11 cutoff, of 500 Hz. Its
    # samples are correlated over 1 / 50 s, 9 of them: 5 standard errors are 15 % of variance.
    assert_allclose(seen.var() / 0.02**2, 1.11 * 50.0 / 500.0, rtol=0.15)


def test_readings_are_whole_counts_nearest_to_the_truth() -> None:
    """Each reading is a whole multiple of the resolution, at most half a count off."""
    of = sensor(force_resolution=0.0025, torque_resolution=1e-4)
    truth = wrenches(1000)
    seen = readings(of, truth)
    count = np.repeat([0.0025, 1e-4], 3)
    # Rounding of the product and the quotient of up to 1e4 counts.
    assert_allclose(seen / count, np.round(seen / count), rtol=1e-15)
    assert np.abs((seen - truth) / count).max() <= 0.5 + 1e-9
    assert len(np.unique(seen[:, 0])) > 500


def test_counts_come_after_the_filter_and_the_noise() -> None:
    """With noise and filter on, readings are whole counts all the same."""
    seen = readings(ForceSensor(ForceSensorParameters(), RATE, 0), wrenches(500))
    counts = seen / np.repeat([0.0025, 1e-4], 3)
    assert_allclose(counts, np.round(counts), atol=1e-9)


def test_readings_saturate_at_the_range() -> None:
    """Beyond its range, bias and noise included, the sensor reports the range."""
    of = sensor(seed=1, force_noise=1.0, force_bias=5.0, force_range=20.0, torque_range=2.0)
    over = readings(of, np.full((200, 6), 1e3))
    assert np.all(over[:, FORCE] == 20.0)
    assert np.all(over[:, TORQUE] == 2.0)
    under = readings(of, np.full((200, 6), -1e3))
    assert np.all(under[:, FORCE] == -20.0)
    assert np.all(under[:, TORQUE] == -2.0)
    # Bias counts: 17 N true with a bias of 5 N is out of range.
    near = readings(of, np.full((200, 6), 24.0))
    assert np.all(near[:, FORCE] == 20.0)


def test_saturation_at_rest_holds_through_the_filter() -> None:
    """A steady overload through the filter is the range."""
    seen = readings(sensor(cutoff=100.0, force_range=20.0), np.full((300, 6), 1e3))
    assert_allclose(seen[:, FORCE], 20.0, rtol=1e-12)


@pytest.mark.parametrize('cutoff', [500.0, 501.0, 1e9])
def test_cutoff_at_or_above_half_the_rate_is_refused(cutoff: float) -> None:
    """The message gives the limit, the way out and the value found."""
    with pytest.raises(ParameterError, match=r'half the sample rate = 500 Hz \(0 switches.*got'):
        sensor(cutoff=cutoff)


@pytest.mark.parametrize('value', [-1.0, np.nan, np.inf, True, '1'])
@pytest.mark.parametrize('name', ['force_noise', 'torque_resolution', 'force_range', 'cutoff'])
def test_constants_out_of_range_are_refused_by_name(name: str, value: Any) -> None:
    """Sensor constants are checked as those of the needle are."""
    with pytest.raises(ParameterError, match=f'^{name} must be .*got'):
        ForceSensorParameters(**{name: value})


def test_bias_may_be_negative_and_a_range_may_not_be_zero() -> None:
    """An offset has either sign; a sensor without range is none."""
    assert ForceSensorParameters(force_bias=-1.0).force_bias == -1.0
    with pytest.raises(ParameterError, match='force_range must be finite, > 0 N'):
        ForceSensorParameters(force_range=0.0)


def test_the_wrench_given_is_not_changed() -> None:
    """Measuring leaves the truth alone."""
    truth = wrenches(1)[0]
    kept = truth.copy()
    of = ForceSensor(ForceSensorParameters(), RATE, 0)
    first = of.measure(truth)
    before = first.copy()
    of.measure(2.0 * truth)
    assert np.array_equal(truth, kept)
    assert np.array_equal(first, before)
