"""The force-torque sensor: noise, drift, filters, counts, range and zero."""

from __future__ import annotations

from typing import Any

from needle_dynamics import (
    FloatArray,
    ForceSensor,
    ForceSensorParameters,
    ParameterError,
    ShapeError,
)
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
#: Count of each axis at the defaults.
COUNT = np.repeat([0.0025, 1e-4], 3)


def sensor(seed: int = 0, rate: float = RATE, **changes: Any) -> ForceSensor:
    """Make a sensor that is perfect but for the changes."""
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
def test_zero_settings_give_the_identity(own: float) -> None:
    """With every imperfection off the sensor reports the truth, bit for bit."""
    truth = wrenches(2000)
    perfect = ForceSensor(ForceSensorParameters(**PERFECT, rate=own), RATE, 0)
    assert np.array_equal(readings(perfect, truth), truth)


@pytest.mark.parametrize('rate', [1.0, 250.0, 8000.0])
def test_same_seed_same_readings(rate: float) -> None:
    """Noise is a function of the seed: the same again, another for another seed."""
    truth = wrenches(20)

    def seen(seed: int) -> FloatArray:
        parameters = ForceSensorParameters(force_drift=0.1, force_bias=1.0)
        return readings(ForceSensor(parameters, rate, seed), truth)

    assert np.array_equal(seen(1), seen(1))
    assert not np.array_equal(seen(1), seen(2))


def test_noise_is_white_with_the_stated_deviation_about_the_stated_bias() -> None:
    """Variance and mean of each channel are within their sampling bounds; channels differ."""
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
    # Chi-square bounds at one in a million each; the seed is fixed.
    low, high = chi2.ppf([5e-7, 1.0 - 5e-7], count - 1) / (count - 1)
    ratio = seen.var(axis=0, ddof=1) / deviation**2
    assert np.all((low < ratio) & (ratio < high))
    # Five standard errors.
    bound = 5.0 / np.sqrt(count)
    normal = (seen - bias) / deviation
    assert np.abs(normal.mean(axis=0)).max() < bound
    # White: no correlation with the next reading, nor after a block of drawn numbers.
    for lag in (1, 2, ForceSensor._DRAWN // 54):
        assert np.abs((normal[:-lag] * normal[lag:]).mean(axis=0)).max() < bound
    # Independent channels.
    assert np.abs(normal.T @ normal / count - np.diag(ratio)).max() < bound


def test_one_number_stands_for_three_axes() -> None:
    """Components come as force x y z, then torque x y z; one number is for all three."""
    of = sensor(force_bias=(1.0, 2.0, 3.0), torque_bias=0.01)
    assert_allclose(of.measure(np.zeros(6)), [1.0, 2.0, 3.0, 0.01, 0.01, 0.01], rtol=1e-15)
    of = sensor(force_range=2.0, torque_range=(0.1, 0.2, 0.3))
    assert of.measure(np.full(6, 9.0)).tolist() == [2.0, 2.0, 2.0, 0.1, 0.2, 0.3]
    of = sensor(force_resolution=(0.5, 0.3, 0.2), torque_resolution=0.2)
    assert_allclose(of.measure(np.full(6, 0.35)), [0.5, 0.3, 0.4] + [0.4] * 3, rtol=1e-15)


@pytest.mark.parametrize('rate', [250.0, 1000.0, 8000.0])
@pytest.mark.parametrize('filters', [1, 2, 3])
def test_the_cascade_is_that_of_scipy_at_the_rate_of_the_sensor(filters: int, rate: float) -> None:
    """Readings are every k-th sample of SciPy's cascade fed with straight lines at 8 kHz."""
    truth = wrenches(100)
    truth[0] = 0.0
    seen = readings(sensor(rate=rate, filter=filters), truth)
    per = round(8000.0 / rate)
    fine = np.arange(1, per * (len(truth) - 1) + 1) / per
    lines = np.array([np.interp(fine, np.arange(len(truth)), column) for column in truth.T])
    expected = sosfilt(cascade(filters), lines)[:, per - 1 :: per].T
    # Rounding, kept by poles close to 1: (8000 / 31)^2 eps.
    assert_allclose(seen[1:], expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize('filters', [0, 1, 2])
def test_each_sample_feels_its_own_wrench(filters: int) -> None:
    """Given what all samples feel, readings are every eighth of SciPy's cascade fed with that."""
    truth = wrenches(800)
    truth[0] = 0.0
    of = sensor(filter=filters)
    assert of.samples == 8
    seen = readings(of, truth.reshape(100, 8, 6))
    filtered = sosfilt(cascade(filters), truth, axis=0) if filters else truth
    # Rounding, kept by poles close to 1.
    assert_allclose(seen, filtered[7::8], rtol=0.0, atol=1e-10)
    if not filters:
        # A straight line goes on from there.
        assert np.array_equal(of.measure(truth[0]), truth[0])
    with pytest.raises(
        ShapeError, match=r'wrench must have shape \(6,\) or \(8, 6\), got \(7, 6\)'
    ):
        of.measure(truth[:7])


@pytest.mark.parametrize('filters', range(1, 7))
def test_a_steady_force_passes_and_a_ramp_lags_by_the_delay(filters: int) -> None:
    """Gain 1 at rest; a ramp is late by the group delays at 0 Hz of the filters, added."""
    rate, slope = 250.0, 0.05
    settle = 20.0 / ForceSensorParameters(filter=filters).cutoffs[-1]
    time = np.arange(round(settle * rate)) / rate
    truth = np.repeat(slope * time, 6).reshape(-1, 6)
    level = readings(sensor(rate=rate, filter=filters), np.ones((len(time), 6)))
    # A pole within 4e-4 of 1 gains 1e7 roundings.
    assert_allclose(level, 1.0, atol=1e-8)
    late = slope * time[-1] - readings(sensor(rate=rate, filter=filters), truth)[-1]
    delay = sum(
        float(group_delay((row[:3], row[3:]), w=[0.0])[1][0]) / 8000.0 for row in cascade(filters)
    )
    assert_allclose(late / slope, delay, rtol=1e-6)


def test_cutoffs_are_quarters_of_a_sixteenth_of_the_rate() -> None:
    """The filters are those of the device at 8 kHz and follow its rate."""
    seen = ForceSensorParameters(filter=6).cutoffs
    assert_allclose(seen, [500.0, 125.0, 31.25, 7.8125, 1.953125, 0.48828125], rtol=1e-15)
    assert ForceSensorParameters(filter=1, rate=400.0).cutoffs == (25.0,)
    assert ForceSensorParameters(filter=0).cutoffs == ()


@pytest.mark.parametrize('filters', [1, 2, 3])
def test_a_filter_passes_its_share_of_the_noise(filters: int) -> None:
    """The variance of readings is that of SciPy's impulse response, its sum of squares."""
    own = 400.0
    of = ForceSensor(
        ForceSensorParameters(**(PERFECT | {'filter': filters, 'force_noise': 0.02}), rate=own),
        own,
        5,
    )
    response = sosfilt(cascade(filters, own), np.eye(1, 20_000)[0])
    seen = readings(of, np.zeros((40_000, 6)))[10_000:, FORCE] / 0.02
    power = np.sum(response**2)
    # Readings are correlated: the variance of the mean square of a Gaussian process is twice
    # the sum of its squared correlations. Five standard errors.
    lagged = np.correlate(response[:4000], response[:4000], 'full') / power
    error = np.sqrt(2.0 * np.sum(lagged**2) / seen.size)
    assert abs(np.mean(seen**2) / power - 1.0) < 5.0 * error
    assert error < 0.05


def test_the_default_noise_is_a_hundredth_of_a_newton() -> None:
    """At the defaults the readings of a resting sensor scatter by about 0.01 N."""
    seen = readings(ForceSensor(ForceSensorParameters(), RATE, 2), np.zeros((5000, 6)))
    assert_allclose(seen[100:, FORCE].std(axis=0), 0.01, rtol=0.15)


def test_filter_starts_in_the_steady_state_of_its_first_value() -> None:
    """A constant wrench is reported from the first reading on: no transient at start."""
    truth = np.array([1.0, -2.0, 3.0, 0.1, 0.0, -0.3])
    seen = readings(sensor(filter=3, force_bias=0.5), np.tile(truth, (500, 1)))
    assert_allclose(seen, np.tile(truth + np.repeat([0.5, 0.0], 3), (500, 1)), atol=1e-9)


@pytest.mark.parametrize('rate', [10.0, 100.0])
def test_the_offset_wanders_with_a_variance_that_grows_with_time(rate: float) -> None:
    """Drift is a random walk: variance d^2 t at any rate of reading, independent increments."""
    drift = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    count = round(4.0 * rate)
    ends = []
    for seed in range(300):
        of = sensor(seed, rate, force_drift=tuple(drift[FORCE]), torque_drift=tuple(drift[TORQUE]))
        ends.append(readings(of, np.zeros((count, 6)))[[count // 4 - 1, -1]] / drift)
    early, late = np.swapaxes(ends, 0, 1)
    # Chi-square bounds at one in a million for 1800 independent values.
    low, high = chi2.ppf([5e-7, 1.0 - 5e-7], early.size) / early.size
    for walk, time in ((early, 1.0), (late, 4.0), (late - early, 3.0)):
        assert low < np.mean(walk**2) / time < high
    assert abs(np.mean(early * (late - early))) < 5.0 * np.sqrt(3.0 / early.size)
    # Drift alone: 0 N at the start, and filters and counts do not matter to it.
    assert abs(np.mean(late)) < 5.0 * np.sqrt(4.0 / late.size)


def test_readings_are_whole_counts_nearest_to_the_truth() -> None:
    """Each reading is a whole multiple of the resolution, at most half a count off."""
    of = sensor(force_resolution=0.0025, torque_resolution=1e-4)
    truth = wrenches(1000)
    seen = readings(of, truth)
    # Rounding of the product and the quotient of up to 1e4 counts.
    assert_allclose(seen / COUNT, np.round(seen / COUNT), rtol=1e-15)
    assert np.abs((seen - truth) / COUNT).max() <= 0.5 + 1e-9
    assert len(np.unique(seen[:, 0])) > 500
    assert not np.signbit(of.measure(np.full(6, -1e-5))).any()


def test_counts_come_after_filter_noise_and_zero() -> None:
    """With all of them on, readings are whole counts all the same."""
    of = ForceSensor(ForceSensorParameters(force_bias=0.4567, force_drift=0.1), RATE, 0)
    readings(of, np.zeros((200, 6)))
    of.tare()
    seen = readings(of, wrenches(500)) / COUNT
    assert_allclose(seen, np.round(seen), atol=1e-9)


def test_readings_saturate_at_the_range() -> None:
    """Beyond its range, bias and noise included, the sensor reports the range."""
    of = sensor(seed=1, force_noise=1.0, force_bias=5.0, force_range=20.0, torque_range=2.0)
    over = readings(of, np.full((200, 6), 1e3))
    assert np.all(over[:, FORCE] == 20.0)
    assert np.all(over[:, TORQUE] == 2.0)
    under = readings(of, np.full((200, 6), -1e3))
    assert np.all(under[:, FORCE] == -20.0)
    assert np.all(under[:, TORQUE] == -2.0)
    # Bias counts: 24 N true with a bias of 5 N is out of range.
    near = readings(of, np.full((200, 6), 24.0))
    assert np.all(near[:, FORCE] == 20.0)


def test_saturation_holds_through_the_filter_and_moves_with_the_zero() -> None:
    """A steady overload is the range; what was zeroed is missing from it."""
    of = sensor(filter=1, force_range=20.0, force_bias=3.0)
    readings(of, np.zeros((200, 6)))
    of.tare()
    seen = readings(of, np.full((300, 6), 1e3))
    # e^-22 per filter time constant after 0.3 s.
    assert_allclose(seen[200:, FORCE], 17.0, rtol=1e-9)


def test_tare_zeroes_on_the_mean_of_the_last_tenth_of_a_second() -> None:
    """What was read over the last 100 of 1000 readings a second becomes zero, again and again."""
    of = sensor(torque_bias=0.2)
    for level in (0.5, -1.0):
        readings(of, np.full((300, 6), 2.0))
        steps = np.arange(100.0) / 100.0 + level
        readings(of, np.repeat(steps, 6).reshape(-1, 6))
        of.tare()
        assert_allclose(of.measure(np.full(6, 1.5)), 1.5 - steps.mean(), rtol=1e-12)


@pytest.mark.parametrize(('rate', 'needed'), [(1000.0, 100), (50.0, 5), (1.0, 1)])
def test_tare_needs_a_tenth_of_a_second_at_rest(rate: float, needed: int) -> None:
    """Refused until there are enough readings since the start, a motion, or the last tare."""
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
    [
        (8000.0, 3000.0, 6000),
        (8000.0, 300.0, 7800),
        (500.0, 1000.0, 8000),
        (1e-9, 1.0, 8000),
    ],
)
def test_a_rate_that_is_no_multiple_is_refused(own: float, rate: float, fits: int) -> None:
    """The message gives what was found and a rate that would do, and that one does."""
    complaint = f'a whole multiple of {rate:g} Hz, got {own:g} Hz; {fits} Hz would do'
    with pytest.raises(ParameterError, match=complaint):
        ForceSensor(ForceSensorParameters(rate=own), rate, 0)
    assert ForceSensor(ForceSensorParameters(rate=float(fits)), rate, 0)


@pytest.mark.parametrize('value', [-1.0, np.nan, np.inf, True, '1', (1.0, -1.0, 1.0), ('1',)])
@pytest.mark.parametrize('name', ['force_noise', 'torque_resolution', 'force_range'])
def test_constants_out_of_range_are_refused_by_name(name: str, value: Any) -> None:
    """Sensor constants are checked as those of the needle are, each axis."""
    with pytest.raises(ParameterError, match=f'^{name} must be .*got'):
        ForceSensorParameters(**{name: value})


@pytest.mark.parametrize('value', [(), (1.0, 2.0), (1.0, 1.0, 1.0, 1.0)])
def test_axes_are_three(value: Any) -> None:
    """A list for other than three axes is refused."""
    with pytest.raises(ParameterError, match=r'^force_bias must be one number or three, x y z'):
        ForceSensorParameters(force_bias=value)


@pytest.mark.parametrize('value', [-1, 7, 2.0, True, '2'])
def test_filters_are_numbered(value: Any) -> None:
    """A filter that the device does not have is refused."""
    with pytest.raises(ParameterError, match=r'^filter must be an integer from 0 \(none\) to 6'):
        ForceSensorParameters(filter=value)


@pytest.mark.parametrize('value', [0.0, 8001.0])
def test_the_rate_of_the_sensor_is_limited(value: float) -> None:
    """No more than the 8 kHz of the device."""
    with pytest.raises(ParameterError, match=r'^rate must be finite, > 0 and <= 8000 Hz, got'):
        ForceSensorParameters(rate=value)


def test_bias_may_be_negative_and_a_range_may_not_be_zero() -> None:
    """An offset has either sign; a sensor without range is none."""
    assert ForceSensorParameters(force_bias=-1.0).force_bias == -1.0
    with pytest.raises(ParameterError, match='force_range must be finite, > 0 N'):
        ForceSensorParameters(force_range=0.0)


def test_the_wrench_given_is_not_changed_nor_kept() -> None:
    """Measuring leaves the truth alone, and what is done to it later does not matter."""
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
