# SPDX-License-Identifier: Apache-2.0
"""Force-torque sensor: noise, drift, filters, resolution, range and tare."""

from __future__ import annotations

from typing import Any

from needle_dynamics import FloatArray, ParameterError, ShapeError
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_ros.errors import JobError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import butter, group_delay, sosfilt
from scipy.stats import chi2

RATE = 1000.0
PERFECT: dict[str, Any] = {
    'force_noise': 0.0,
    'torque_noise': 0.0,
    'force_resolution': 0.0,
    'torque_resolution': 0.0,
    'filter': 0,
}
FORCE, TORQUE = slice(0, 3), slice(3, 6)
#: Default resolution of each axis.
COUNT = np.repeat([0.0025, 1e-4], 3)


def sensor(seed: int = 0, rate: float = RATE, **changes: Any) -> ForceSensor:
    """Return a sensor that is ideal except for the changes."""
    return ForceSensor(ForceSensorParameters(**(PERFECT | changes)), rate, seed)


def readings(of: ForceSensor, wrenches: FloatArray) -> FloatArray:
    return np.array([of.measure(wrench) for wrench in wrenches])


def wrenches(count: int) -> FloatArray:
    return np.random.default_rng(7).normal(size=(count, 6)) * [5, 5, 5, 0.5, 0.5, 0.5]


def cascade(filters: int, rate: float = 8000.0) -> FloatArray:
    """Return the sections of the cascade, from SciPy: 500 Hz at 8 kHz, then quarters."""
    return np.concatenate(
        [butter(2, rate / 16.0 / 4.0**k, fs=rate, output='sos') for k in range(filters)]
    )


@pytest.mark.parametrize('own', [1000.0, 3000.0, 8000.0])
def test_sensor_without_imperfections_is_the_identity(own: float) -> None:
    """Readings equal the true wrench bit for bit."""
    truth = wrenches(2000)
    perfect = ForceSensor(ForceSensorParameters(**PERFECT, rate=own), RATE, 0)
    assert np.array_equal(readings(perfect, truth), truth)


@pytest.mark.parametrize('rate', [1.0, 250.0, 8000.0])
def test_same_seed_gives_the_same_readings(rate: float) -> None:
    """Another seed gives other noise."""
    truth = wrenches(20)

    def seen(seed: int) -> FloatArray:
        parameters = ForceSensorParameters(force_drift=0.1, force_bias=1.0)
        return readings(ForceSensor(parameters, rate, seed), truth)

    assert np.array_equal(seen(1), seen(1))
    assert not np.array_equal(seen(1), seen(2))


def test_noise_is_white_with_the_given_deviation_and_bias() -> None:
    """Variance and mean are within their sampling bounds; channels are independent."""
    count = 20_000
    deviation = np.array([0.02, 0.03, 0.04, 5e-4, 6e-4, 7e-4])
    bias = np.array([-0.1, 0.2, 0.3, 3e-3, -2e-3, 1e-3])
    of = sensor(
        seed=3,
        force_noise=tuple(deviation[FORCE]),
        torque_noise=tuple(deviation[TORQUE]),
        force_bias=tuple(bias[FORCE]),
        torque_bias=tuple(bias[TORQUE]),
    )
    seen = readings(of, np.zeros((count, 6)))
    # Chi-square bounds with probability 1e-6 each; the seed is fixed.
    low, high = chi2.ppf([5e-7, 1.0 - 5e-7], count - 1) / (count - 1)
    ratio = seen.var(axis=0, ddof=1) / deviation**2
    assert np.all((low < ratio) & (ratio < high))
    # Five standard errors.
    bound = 5.0 / np.sqrt(count)
    normal = (seen - bias) / deviation
    assert np.abs(normal.mean(axis=0)).max() < bound
    # White: no correlation with the next reading, nor across blocks of random numbers.
    for lag in (1, 2, ForceSensor._DRAWN // 54):
        assert np.abs((normal[:-lag] * normal[lag:]).mean(axis=0)).max() < bound
    # Independent channels.
    assert np.abs(normal.T @ normal / count - np.diag(ratio)).max() < bound


def test_single_number_applies_to_three_axes() -> None:
    """The order of components is force x y z, torque x y z."""
    of = sensor(force_bias=(1.0, 2.0, 3.0), torque_bias=0.01)
    assert_allclose(of.measure(np.zeros(6)), [1.0, 2.0, 3.0, 0.01, 0.01, 0.01], rtol=1e-15)
    of = sensor(force_range=2.0, torque_range=(0.1, 0.2, 0.3))
    assert of.measure(np.full(6, 9.0)).tolist() == [2.0, 2.0, 2.0, 0.1, 0.2, 0.3]
    of = sensor(force_resolution=(0.5, 0.3, 0.2), torque_resolution=0.2)
    assert_allclose(of.measure(np.full(6, 0.35)), [0.5, 0.3, 0.4] + [0.4] * 3, rtol=1e-15)


@pytest.mark.parametrize('rate', [250.0, 1000.0, 8000.0])
@pytest.mark.parametrize('filters', [1, 2, 3])
def test_filter_cascade_matches_scipy_at_the_internal_rate(filters: int, rate: float) -> None:
    """Readings are every k-th sample of the SciPy cascade for piecewise linear input at 8 kHz."""
    truth = wrenches(100)
    truth[0] = 0.0
    seen = readings(sensor(rate=rate, filter=filters), truth)
    per = round(8000.0 / rate)
    fine = np.arange(1, per * (len(truth) - 1) + 1) / per
    lines = np.array([np.interp(fine, np.arange(len(truth)), column) for column in truth.T])
    expected = sosfilt(cascade(filters), lines)[:, per - 1 :: per].T
    # Rounding, amplified by poles close to 1: (8000 / 31)^2 eps.
    assert_allclose(seen[1:], expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize('filters', [0, 1, 2])
def test_each_internal_sample_uses_its_own_wrench(filters: int) -> None:
    """With given sample wrenches, readings are every eighth sample of the SciPy cascade."""
    truth = wrenches(800)
    truth[0] = 0.0
    of = sensor(filter=filters)
    assert of.samples == 8
    seen = readings(of, truth.reshape(100, 8, 6))
    filtered = sosfilt(cascade(filters), truth, axis=0) if filters else truth
    # Rounding, amplified by poles close to 1.
    assert_allclose(seen, filtered[7::8], rtol=0.0, atol=1e-10)
    if not filters:
        # The next linear segment starts there.
        assert np.array_equal(of.measure(truth[0]), truth[0])
    with pytest.raises(
        ShapeError, match=r'wrench must have shape \(6,\) or \(8, 6\), got \(7, 6\)'
    ):
        of.measure(truth[:7])


@pytest.mark.parametrize('filters', range(1, 7))
def test_constant_force_passes_and_ramp_lags_by_the_group_delay(filters: int) -> None:
    """Gain 1 at rest; the lag of a ramp is the sum of the group delays at 0 Hz."""
    rate, slope = 250.0, 0.05
    settle = 20.0 / ForceSensorParameters(filter=filters).cutoffs[-1]
    time = np.arange(round(settle * rate)) / rate
    truth = np.repeat(slope * time, 6).reshape(-1, 6)
    level = readings(sensor(rate=rate, filter=filters), np.ones((len(time), 6)))
    # A pole within 4e-4 of 1 amplifies rounding by 1e7.
    assert_allclose(level, 1.0, atol=1e-8)
    late = slope * time[-1] - readings(sensor(rate=rate, filter=filters), truth)[-1]
    delay = sum(
        float(group_delay((row[:3], row[3:]), w=[0.0])[1][0]) / 8000.0 for row in cascade(filters)
    )
    assert_allclose(late / slope, delay, rtol=1e-6)


def test_cutoffs_scale_with_the_internal_rate() -> None:
    """One sixteenth of the rate and quarters of it, as in the device at 8 kHz."""
    seen = ForceSensorParameters(filter=6).cutoffs
    assert_allclose(seen, [500.0, 125.0, 31.25, 7.8125, 1.953125, 0.48828125], rtol=1e-15)
    assert ForceSensorParameters(filter=1, rate=400.0).cutoffs == (25.0,)
    assert ForceSensorParameters(filter=0).cutoffs == ()


@pytest.mark.parametrize('filters', [1, 2, 3])
def test_filter_reduces_the_noise_variance(filters: int) -> None:
    """The variance of readings is the sum of squares of the SciPy impulse response."""
    own = 400.0
    of = ForceSensor(
        ForceSensorParameters(**(PERFECT | {'filter': filters, 'force_noise': 0.02}), rate=own),
        own,
        5,
    )
    response = sosfilt(cascade(filters, own), np.eye(1, 20_000)[0])
    seen = readings(of, np.zeros((40_000, 6)))[10_000:, FORCE] / 0.02
    power = np.sum(response**2)
    # Readings are correlated: the variance of the mean square of a Gaussian process is twice the
    # sum of its squared correlations. Five standard errors.
    lagged = np.correlate(response[:4000], response[:4000], 'full') / power
    error = np.sqrt(2.0 * np.sum(lagged**2) / seen.size)
    assert abs(np.mean(seen**2) / power - 1.0) < 5.0 * error
    assert error < 0.05


def test_the_default_noise_is_a_hundredth_of_a_newton() -> None:
    """Default settings: the readings of a resting sensor have a deviation of about 0.01 N."""
    seen = readings(ForceSensor(ForceSensorParameters(), RATE, 2), np.zeros((5000, 6)))
    assert_allclose(seen[100:, FORCE].std(axis=0), 0.01, rtol=0.15)


def test_filter_starts_in_steady_state() -> None:
    """A constant wrench is reported from the first reading on, without a transient."""
    truth = np.array([1.0, -2.0, 3.0, 0.1, 0.0, -0.3])
    seen = readings(sensor(filter=3, force_bias=0.5), np.tile(truth, (500, 1)))
    assert_allclose(seen, np.tile(truth + np.repeat([0.5, 0.0], 3), (500, 1)), atol=1e-9)


@pytest.mark.parametrize('rate', [10.0, 100.0])
def test_offset_drift_is_a_random_walk(rate: float) -> None:
    """Variance d^2 t at any reading rate, independent increments."""
    drift = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    count = round(4.0 * rate)
    ends = []
    for seed in range(300):
        of = sensor(seed, rate, force_drift=tuple(drift[FORCE]), torque_drift=tuple(drift[TORQUE]))
        ends.append(readings(of, np.zeros((count, 6)))[[count // 4 - 1, -1]] / drift)
    early, late = np.swapaxes(ends, 0, 1)
    # Chi-square bounds with probability 1e-6 for 1800 independent values.
    low, high = chi2.ppf([5e-7, 1.0 - 5e-7], early.size) / early.size
    for walk, time in ((early, 1.0), (late, 4.0), (late - early, 3.0)):
        assert low < np.mean(walk**2) / time < high
    assert abs(np.mean(early * (late - early))) < 5.0 * np.sqrt(3.0 / early.size)
    # Only drift: initially 0 N, independent of filters and resolution.
    assert abs(np.mean(late)) < 5.0 * np.sqrt(4.0 / late.size)


def test_readings_are_rounded_to_whole_counts() -> None:
    """Each reading is a whole multiple of the resolution with an error of at most half a count."""
    of = sensor(force_resolution=0.0025, torque_resolution=1e-4)
    truth = wrenches(1000)
    seen = readings(of, truth)
    # Rounding of the product and the quotient of up to 1e4 counts.
    assert_allclose(seen / COUNT, np.round(seen / COUNT), rtol=1e-15)
    assert np.abs((seen - truth) / COUNT).max() <= 0.5 + 1e-9
    assert len(np.unique(seen[:, 0])) > 500
    assert not np.signbit(of.measure(np.full(6, -1e-5))).any()


def test_rounding_follows_filter_noise_and_tare() -> None:
    """With all of them active, readings are still whole counts."""
    of = ForceSensor(ForceSensorParameters(force_bias=0.4567, force_drift=0.1), RATE, 0)
    readings(of, np.zeros((200, 6)))
    of.tare()
    seen = readings(of, wrenches(500)) / COUNT
    assert_allclose(seen, np.round(seen), atol=1e-9)


def test_readings_saturate_at_the_range() -> None:
    """Saturation includes bias and noise."""
    of = sensor(seed=1, force_noise=1.0, force_bias=5.0, force_range=20.0, torque_range=2.0)
    over = readings(of, np.full((200, 6), 1e3))
    assert np.all(over[:, FORCE] == 20.0)
    assert np.all(over[:, TORQUE] == 2.0)
    under = readings(of, np.full((200, 6), -1e3))
    assert np.all(under[:, FORCE] == -20.0)
    assert np.all(under[:, TORQUE] == -2.0)
    # Bias is included: 24 N true force with a bias of 5 N is out of range.
    near = readings(of, np.full((200, 6), 24.0))
    assert np.all(near[:, FORCE] == 20.0)


def test_saturation_precedes_filter_and_tare() -> None:
    """A constant overload gives the range minus the tare value."""
    of = sensor(filter=1, force_range=20.0, force_bias=3.0)
    readings(of, np.zeros((200, 6)))
    of.tare()
    seen = readings(of, np.full((300, 6), 1e3))
    # e^-22 per filter time constant after 0.3 s.
    assert_allclose(seen[200:, FORCE], 17.0, rtol=1e-9)


def test_tare_uses_the_mean_of_the_last_100_ms() -> None:
    """The mean of the last 100 of 1000 readings per second becomes zero, repeatedly."""
    of = sensor(torque_bias=0.2)
    for level in (0.5, -1.0):
        readings(of, np.full((300, 6), 2.0))
        steps = np.arange(100.0) / 100.0 + level
        readings(of, np.repeat(steps, 6).reshape(-1, 6))
        of.tare()
        assert_allclose(of.measure(np.full(6, 1.5)), 1.5 - steps.mean(), rtol=1e-12)


@pytest.mark.parametrize(('rate', 'needed'), [(1000.0, 100), (50.0, 5), (1.0, 1)])
def test_tare_requires_100_ms_at_rest(rate: float, needed: int) -> None:
    """Rejected until there are enough readings since the start, a motion, or the last tare."""
    of = sensor(rate=rate, force_bias=1.0)

    def refused(found: int) -> None:
        with pytest.raises(JobError, match=f'^{found} of {needed} readings at rest so far$'):
            of.tare()

    def rest() -> None:
        for found in range(needed):
            refused(found)
            of.measure(np.zeros(6))

    rest()
    of.measure(np.zeros(6), moving=True)
    rest()
    of.tare()
    assert of.measure(np.zeros(6))[0] == 0.0
    of.measure(np.zeros(6), moving=True)
    rest()


@pytest.mark.parametrize(
    ('own', 'rate', 'fits'),
    [(8000.0, 3000.0, 6000), (8000.0, 300.0, 7800), (500.0, 1000.0, 8000), (1e-9, 1.0, 8000)],
)
def test_internal_rate_must_be_a_multiple_of_the_reading_rate(
    own: float, rate: float, fits: int
) -> None:
    """The message contains the given rate and a valid rate."""
    complaint = f'a whole multiple of {rate:g} Hz, got {own:g} Hz; {fits} Hz would do'
    with pytest.raises(ParameterError, match=complaint):
        ForceSensor(ForceSensorParameters(rate=own), rate, 0)
    assert ForceSensor(ForceSensorParameters(rate=float(fits)), rate, 0)


@pytest.mark.parametrize('value', [-1.0, np.nan, np.inf, True, '1', (1.0, -1.0, 1.0), ('1',)])
@pytest.mark.parametrize('name', ['force_noise', 'torque_resolution', 'force_range'])
def test_constants_out_of_range_are_rejected(name: str, value: Any) -> None:
    """Sensor constants are checked for each axis; the message contains the name."""
    with pytest.raises(ParameterError, match=f'^{name} must be .*got'):
        ForceSensorParameters(**{name: value})


@pytest.mark.parametrize('value', [(), (1.0, 2.0), (1.0, 1.0, 1.0, 1.0)])
def test_lists_must_have_three_axes(value: Any) -> None:
    with pytest.raises(ParameterError, match=r'^force_bias must be one number or three, x y z'):
        ForceSensorParameters(force_bias=value)


@pytest.mark.parametrize('value', [-1, 7, 2.0, True, '2'])
def test_unknown_filter_numbers_are_rejected(value: Any) -> None:
    with pytest.raises(ParameterError, match=r'^filter must be an integer from 0 to 6'):
        ForceSensorParameters(filter=value)


@pytest.mark.parametrize('value', [0.0, 8001.0])
def test_internal_rate_is_limited(value: float) -> None:
    """At most the 8 kHz of the device."""
    with pytest.raises(ParameterError, match=r'^rate must be finite, > 0 and <= 8000 Hz, got'):
        ForceSensorParameters(rate=value)


def test_bias_may_be_negative_and_a_range_may_not_be_zero() -> None:
    assert ForceSensorParameters(force_bias=-1.0).force_bias == -1.0
    with pytest.raises(ParameterError, match='force_range must be finite, > 0 N'):
        ForceSensorParameters(force_range=0.0)


def test_measure_neither_changes_nor_keeps_its_argument() -> None:
    truth = wrenches(1)[0]
    kept = truth.copy()
    of, other = (ForceSensor(ForceSensorParameters(), RATE, 0) for _ in range(2))
    first = of.measure(truth)
    before = first.copy()
    assert np.array_equal(truth, kept)
    other.measure(kept)
    truth[:] = 1e3
    assert np.array_equal(of.measure(kept), other.measure(kept))
    assert np.array_equal(first, before)
