# SPDX-License-Identifier: Apache-2.0
"""Friction is recovered, with valid standard errors and confidence intervals."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
import re
from typing import Any

from benchmarks.noises import NoiseKind, recorded
import hypothesis
from hypothesis import strategies as st
from needle_dynamics import FloatArray, NeedleError, ParameterError
from needle_identification import (
    ESTIMATORS,
    FrictionEstimate,
    FrictionSettings,
    IdentificationError,
    identify_friction,
    ParameterEstimate,
    Recording,
    summarize,
)
from needle_identification.estimation.rounding import resolution, rounding_of_motion
from needle_identification.friction.filtering import _smooth, filter_taps
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.signal.windows import hann
from scipy.stats import chi2
from support.strokes import COULOMB, NOISE, SPEEDS, strokes, VISCOUS

TRUTH = {'coulomb_friction': COULOMB, 'viscous_friction': VISCOUS}


def law(
    size: Callable[..., Any] | Any,
    *,
    both_ways: bool = True,
    duration: float = 8.0,
    offset: float = 0.0,
) -> Recording:
    """Build a recording of equation (15) with absolute speed [m/s] over time [s]."""
    time = np.arange(round(duration * 250)) / 250.0
    way = np.where(time < duration / 2.0, 1.0, -1.0) if both_ways else np.ones_like(time)
    velocity = way * size(time)
    force = COULOMB * np.sign(velocity) + VISCOUS * velocity + offset
    return Recording(
        name='law', time=time, depth=np.cumsum(velocity) / 250.0, velocity=velocity, force=force
    )


def varied(time: FloatArray) -> FloatArray:
    return 5e-3 + 2e-3 * np.sin(2.0 * np.pi * 0.3 * time)


def settings(*terms: str, **changes: Any) -> FrictionSettings:
    return FrictionSettings(terms=('coulomb', 'viscous', *terms), **changes)


@cache
def identified(chosen: FrictionSettings | None = None, **recorded: Any) -> FrictionEstimate:
    return identify_friction(strokes(**recorded), chosen)


def within(parameter: ParameterEstimate, truth: float, errors: float = 4.0) -> bool:
    return parameter.determined and abs(parameter.value - truth) < errors * parameter.error


def test_the_filter_is_a_hann_window_at_zero_phase() -> None:
    taps = filter_taps(30.0, 0.004)
    window = hann(len(taps))
    assert_allclose(taps, window / window.sum(), rtol=1e-12)
    for length in (50, 5000):
        signal = np.random.default_rng(0).normal(size=length)
        padded = np.pad(signal, len(taps) // 2, mode='edge')
        # 1e-12: rounding of the transforms.
        assert_allclose(_smooth(signal, taps), np.convolve(padded, taps, 'valid'), atol=1e-12)


@pytest.mark.parametrize('estimator', ESTIMATORS)
def test_exact_friction_is_recovered(estimator: str) -> None:
    found = identified(FrictionSettings(estimator=estimator))
    for name, truth in TRUTH.items():
        # 1e-6: the filter has finite length; samples within its reach of a change are discarded.
        assert_allclose(found[name].value, truth, rtol=1e-6)
    # The start of motion is resolved to a sample, 4 ms, in which the force rises by 2.7 mN.
    assert_allclose(found.breakaway.value, COULOMB, atol=2.7e-3)
    assert found.determination > 1.0 - 1e-9
    assert found.warnings == ()


@pytest.mark.parametrize('estimator', ESTIMATORS)
def test_true_friction_is_within_the_standard_errors(estimator: str) -> None:
    found = identified(FrictionSettings(estimator=estimator), seed=1)
    assert all(within(found[name], truth) for name, truth in TRUTH.items())
    assert within(found.breakaway, COULOMB)


def test_strokes_in_one_direction_are_sufficient() -> None:
    found = identify_friction(law(varied, both_ways=False))
    assert_allclose(found['coulomb_friction'].value, COULOMB, rtol=1e-6)


@pytest.mark.parametrize('recorded', [{'cutoff': 40.0}, {}], ids=['40 Hz', '125 Hz'])
def test_confidence_intervals_have_their_coverage(recorded: dict[str, float]) -> None:
    runs = [identified(seed=seed, **recorded) for seed in range(100)]
    truths = {**TRUTH, 'breakaway_force': COULOMB}
    for name, truth in truths.items():
        found = [run.breakaway if name == 'breakaway_force' else run[name] for run in runs]
        values, errors = np.array([(p.value, p.error) for p in found]).T
        covered = [p.interval[0] <= truth <= p.interval[1] for p in found]
        # Three standard deviations of a binomial of 100 trials at 95 % are 6.5 %.
        assert np.mean(covered) >= 0.885
        # A standard deviation from 100 values has an error of 7 %: three of these.
        assert_allclose(np.sqrt(np.mean(errors**2)), values.std(), rtol=0.21)


def test_friction_scales_with_the_force() -> None:
    recording = strokes(seed=2)
    one = identify_friction(recording)
    three = identify_friction(replace(recording, force=3.0 * recording.force))
    for name in TRUTH:
        assert_allclose(three[name].value, 3.0 * one[name].value, rtol=1e-6)
        assert_allclose(three[name].error, 3.0 * one[name].error, rtol=1e-6)
    assert_allclose(three.breakaway.value, 3.0 * one.breakaway.value, rtol=1e-6)
    assert_allclose(three.lag.value, one.lag.value, rtol=1e-6)
    assert_allclose(three.residual, 3.0 * one.residual, rtol=1e-6)


def test_reversed_axes_give_the_same_friction() -> None:
    recording = strokes(seed=2, offset=0.1)
    mirrored = replace(
        recording, force=-recording.force, velocity=-recording.velocity, depth=-recording.depth
    )
    one = identify_friction(recording, settings('offset'))
    other = identify_friction(mirrored, settings('offset'))
    for name in TRUTH:
        assert_allclose(other[name].value, one[name].value, rtol=1e-6)
        assert_allclose(other[name].error, one[name].error, rtol=1e-6)
    assert_allclose(other['offset'].value, -one['offset'].value, rtol=1e-6)
    assert_allclose(other.breakaway.value, one.breakaway.value, rtol=1e-6)


def test_a_missing_offset_term_is_suggested() -> None:
    plain = identified(seed=3)
    assert [parameter.name for parameter in plain.parameters] == list(TRUTH)
    assert plain.warnings == ()
    shifted = identified(seed=3, offset=0.1)
    assert any('offset = 0.1 ±' in words and 'add the term' in words for words in shifted.warnings)
    taken = identified(settings('offset'), seed=3, offset=0.1)
    assert within(taken['offset'], 0.1)
    assert within(taken.breakaway, COULOMB)
    assert not any('add the term' in words for words in taken.warnings)


@pytest.mark.parametrize(
    ('term', 'recorded', 'truths'),
    [
        (
            'direction',
            {'withdrawal': 1.2},
            {
                'withdrawal_friction': 1.2,
                'withdrawal_coulomb': 0.2 * COULOMB,
                'withdrawal_viscous': 0.2 * VISCOUS,
            },
        ),
        (
            'stribeck',
            {'breakaway': 1.3},
            {'breakaway_friction': 1.3, 'stribeck_friction': 0.3 * COULOMB},
        ),
    ],
)
def test_a_missing_term_is_suggested_and_identified(
    term: str, recorded: dict[str, float], truths: dict[str, float]
) -> None:
    without = identified(seed=4, **recorded)
    assert [c.terms[-1] for c in without.comparison if c.supported].count(term) == 1
    assert any(f'add the term {term}' in words for words in without.warnings)
    found = identified(settings(term), seed=4, **recorded)
    for name, truth in {**TRUTH, **truths}.items():
        assert within(found[name], truth), name
    assert not any('add the term' in words for words in found.warnings)


@pytest.mark.parametrize(
    ('drift', 'withdrawal', 'term'),
    [
        (1e-3, 1.0, 'drift'),
        (-1e-2, 1.0, 'drift'),
        (0.0, 1.03, 'direction'),
        (0.0, 1.2, 'direction'),
    ],
)
def test_drift_and_direction_are_distinguished(drift: float, withdrawal: float, term: str) -> None:
    """If withdrawals follow insertions the two terms are similar; the better fit is selected."""
    advised = 0
    for seed in range(20):
        made = strokes(seed=seed, push=0.0, withdrawal=withdrawal)
        recording = Recording(
            name='drifting',
            time=made.time,
            depth=made.depth,
            velocity=made.velocity,
            force=made.force + drift * (made.time - made.time[0]),
        )
        found = identify_friction(recording)
        advised += any(f'add the term {term}' in words for words in found.warnings)
    assert advised >= 18
    taken = identify_friction(recording, settings(term))
    assert not any('add the term' in words for words in taken.warnings)
    for name, truth in TRUTH.items():
        assert within(taken[name], truth), name
    if drift:
        assert within(taken['force_drift'], drift)


def test_only_failed_residual_tests_are_warnings() -> None:
    fine = ('show no', 'do not differ', 'do not depend', 'the same at')
    for found in [identified(seed=seed) for seed in range(40)]:
        assert all(t.failed != any(words in t.words for words in fine) for t in found.tests)
        if not any('add the term' in words for words in found.warnings):
            failed = [test.words for test in found.tests if test.failed]
            tested = {test.words for test in found.tests}
            assert [words for words in found.warnings if words in tested] == failed


def test_false_alarms_are_rare() -> None:
    found = [identified(seed=seed) for seed in range(40)]
    false = [any(c.supported for c in one.comparison) for one in found]
    # At most 2 % of 40 recordings, and three standard deviations of that.
    assert np.mean(false) <= 0.09
    failed = [test.failed for one in found for test in one.tests]
    # 0.25 % of 160, and three standard deviations of that: the tests are valid for many parts.
    assert np.mean(failed) <= 0.0145
    assert all(len(one.tests) == 4 for one in found)
    needless = identified(settings('offset'), seed=0).comparison
    assert ('coulomb', 'viscous') in [c.terms for c in needless if c.supported]
    assert not any(c.supported for c in needless if 'coulomb' not in c.terms)


def test_the_error_of_the_mass_allows_for_wrong_stamps() -> None:
    time = np.arange(5000) / 250.0
    velocity = 8e-3 * np.sin(2.0 * np.pi * 0.5 * time) + 6e-3 * np.sin(2.0 * np.pi * 0.31 * time)
    force = COULOMB * np.sign(velocity) + 20.0 * np.gradient(velocity, time) + 5.0 * velocity
    force = force + np.random.default_rng(0).normal(scale=0.01, size=5000)
    recording = Recording(
        name='shaken', time=time, depth=0.0 * time, velocity=velocity, force=force
    )
    found = identify_friction(recording, settings('inertia', largest_acceleration=1.0))
    assert within(found['moving_mass'], 20.0)
    # A sampling period of 4 ms, uniformly distributed, times mu_v.
    assert found['moving_mass'].error >= 5.0 * 4e-3 / np.sqrt(3.0)
    assert found.lag is None
    assert any('looks like' in words for words in found.warnings)


@pytest.mark.parametrize('lag', [0.008, -0.05, 0.1])
def test_a_lag_is_estimated_and_corrected(lag: float) -> None:
    time = np.arange(4000) / 250.0
    velocity = 8e-3 * np.sin(2.0 * np.pi * 0.3 * time) + 5e-3 * np.sin(2.0 * np.pi * 0.47 * time)
    shown = np.interp(time - lag, time, velocity)
    force = COULOMB * np.sign(shown) + VISCOUS * shown
    force = force + np.random.default_rng(0).normal(scale=0.01, size=4000)
    recording = Recording(name='late', time=time, depth=0.0 * time, velocity=velocity, force=force)
    found = identify_friction(recording)
    assert within(found.lag, lag)
    assert found.lag.error < 2e-4
    assert all(within(found[name], truth) for name, truth in TRUTH.items())
    # A lag below 10 ms is explained by sensor filters.
    assert any(' the motion: ' in words for words in found.warnings) == (abs(lag) > 0.01)


def steps(rate: float, lag: float) -> Recording:
    """Build strokes of constant velocity, without acceleration, with a delayed force."""
    legs = [leg for v in SPEEDS for leg in ((v, 1.0), (0.0, 0.2), (-v, 1.0), (0.0, 0.2))]
    velocity = np.repeat([v for v, _ in legs], [round(rate * duration) for _, duration in legs])
    shown = np.roll(velocity, round(lag * rate))
    noise = np.random.default_rng(0).normal(scale=0.01, size=len(velocity))
    return Recording(
        name='steps',
        time=np.arange(len(velocity)) / rate,
        depth=np.cumsum(velocity) / rate,
        velocity=velocity,
        force=COULOMB * np.sign(shown) + VISCOUS * shown + noise,
    )


@pytest.mark.parametrize('rate', [50.0, 250.0, 1000.0])
@pytest.mark.parametrize('lag', [0.02, 0.1, -0.1])
def test_a_large_lag_of_steady_strokes_is_corrected(rate: float, lag: float) -> None:
    found = identify_friction(steps(rate, lag))
    assert all(within(found[name], truth) for name, truth in TRUTH.items())
    # A thousand samples with noise of 0.01 N.
    assert found['coulomb_friction'].error < 1.5e-3
    assert not found.lag.determined
    [words] = [words for words in found.warnings if 'the motion (from steady strokes' in words]
    assert ('behind' in words) == (lag > 0.0)


def eased(rate: float, lag: float, seed: int) -> Recording:
    """Build strokes with velocity ramps of 0.05 s, sampled at arbitrary times."""
    corners = [(0.0, 0.0)]
    for velocity in (way * v for v in SPEEDS for way in (1.0, -1.0)):
        start = corners[-1][0]
        corners += [
            (start + at, v) for at, v in ((0.15, 0), (0.2, velocity), (0.85, velocity), (0.9, 0))
        ]
    times, velocities = np.array(corners).T
    rng = np.random.default_rng(seed)
    time = rng.uniform(0.0, 1.0 / rate) + np.arange(round(times[-1] * rate)) / rate
    velocity, shown = (np.interp(at, times, velocities) for at in (time, time - lag))
    force = COULOMB * np.sign(shown) + VISCOUS * shown + rng.normal(scale=0.01, size=len(time))
    return Recording(
        name='eased', time=time, depth=np.cumsum(velocity) / rate, velocity=velocity, force=force
    )


@pytest.mark.parametrize(('rate', 'surest'), [(250.0, 0.0), (100.0, 5e-4)])
def test_the_error_of_the_lag_includes_the_sampling_period(rate: float, surest: float) -> None:
    found = [identify_friction(eased(rate, 2.24e-3, seed)).lag for seed in range(60)]
    covered = [lag.interval[0] <= 2.24e-3 <= lag.interval[1] for lag in found]
    # Three standard deviations of a binomial of 60 trials at 95 % are 8.4 %.
    assert np.mean(covered) >= 0.866
    assert all(surest < lag.error < 2e-3 for lag in found)


def test_velocity_steps_do_not_determine_the_lag() -> None:
    # The ringing of the spline after a jump is not an acceleration.
    lags = [identify_friction(steps(250.0, 0.0)).lag, identified(seed=14, push=0.0).lag]
    assert not any(lag.determined for lag in lags)


def test_the_lag_is_not_determined_by_positions_only() -> None:
    recording = strokes(seed=14, lag=0.02)
    found = identify_friction(replace(recording, velocity=None))
    assert found.lag is None
    # The lag is corrected and reported.
    assert all(within(found[name], truth) for name, truth in TRUTH.items())
    assert any(' behind the motion' in words for words in found.warnings)


def test_a_force_independent_of_the_velocity_does_not_determine_the_lag() -> None:
    recording = strokes(seed=14, speeds=SPEEDS[:3], push=0.0)
    dry = replace(recording, force=recording.force - (VISCOUS - 0.3) * recording.velocity)
    found = identify_friction(dry)
    assert not found.lag.determined
    assert found.lag.interval == (-np.inf, np.inf)
    assert within(found['coulomb_friction'], COULOMB)


def test_positions_only_give_the_same_friction() -> None:
    recording = strokes(seed=5)
    both = identify_friction(recording)
    counted = 1e-6 * np.round(recording.depth / 1e-6)
    alone = identify_friction(replace(recording, velocity=None, depth=counted))
    for name in TRUTH:
        # The noise of the force is the same.
        assert abs(alone[name].value - both[name].value) < both[name].error
        assert alone[name].error < 1.3 * both[name].error


def test_total_least_squares_corrects_for_velocity_noise() -> None:
    """Speeds with small differences, so that noise is a large fraction of their variation."""
    rng = np.random.default_rng(1)
    recording = law(lambda time: 3e-3 + varied(time), duration=80.0)
    velocity = recording.velocity + 1e-3 * rng.normal(size=20_000)
    noisy = replace(
        recording,
        depth=np.cumsum(velocity) / 250.0,
        velocity=velocity,
        force=recording.force + 0.01 * rng.normal(size=20_000),
    )
    ordinary = identify_friction(noisy, FrictionSettings(estimator='ordinary'))
    total = identify_friction(noisy)
    assert any('choose estimator total' in words for words in ordinary.warnings)
    assert any('took estimator total' in words for words in total.warnings)
    assert total.estimator == 'total'
    assert not within(ordinary['viscous_friction'], VISCOUS)
    assert within(total['viscous_friction'], VISCOUS)
    assert not any('choose' in words for words in total.warnings)


@pytest.mark.parametrize(('counts', 'rate'), [(5e-6, 250.0), (2e-5, 250.0), (5e-5, 50.0)])
def test_counts_of_the_positions_do_not_bias_the_friction(counts: float, rate: float) -> None:
    """Also where strokes of a whole number of counts per sample show no noise (5e-5 at 50 Hz)."""
    kind = NoiseKind(positions_only=True, position_counts=counts, rate=rate)
    scores = []
    for seed in range(8):
        recording, truth = recorded(kind, np.random.default_rng([26, seed]))
        found = identify_friction(recording)
        scores += [(found[k].value - truth[k]) / found[k].error for k in TRUTH]
    # Chi-squared of 16 values, but mu_s and mu_v are correlated: p = 1e-5 for 8 independent ones.
    # At a cutoff of 30 Hz it is from 60 to 2000.
    assert np.sum(np.square(scores)) < 2.0 * chi2.isf(1e-5, 8)


@pytest.mark.parametrize('counts', [1e-6, 5e-6])
@pytest.mark.parametrize('delay', [0.018, 0.04])
def test_delay_of_the_force_to_counted_positions_is_no_filter(counts: float, delay: float) -> None:
    """At a lower cutoff the lag is known; the noise of the speed is no variance of the lag."""
    kind = NoiseKind(
        positions_only=True,
        position_counts=counts,
        plant=lambda made, _truth, _rng: made._replace(
            force=np.interp(made.time - delay, made.time, made.force)
        ),
    )
    for seed in range(6):
        recording, truth = recorded(kind, np.random.default_rng([5, seed]))
        found = identify_friction(recording)
        said = '; '.join(found.warnings)
        assert 'low-pass' not in said
        stated = re.search(r'the force is ([\d.]+) ± [\d.]+ ms behind', said)
        # 1 ms is a quarter of a sample; the coarse lag, in steps of half the filter, is 6 ms off.
        assert stated is None or float(stated[1]) == pytest.approx(1e3 * delay, abs=1.0)
        assert counts > 1e-6 or stated
        assert all(within(found[name], truth[name], 4.5) for name in TRUTH)


@hypothesis.given(
    step=st.floats(1e-7, 1e-3),
    begin=st.floats(-0.2, 0.2),
    seed=st.integers(0, 2**32 - 1),
    size=st.integers(200, 2000),
)
@hypothesis.settings(deadline=None)
def test_resolution_is_the_step_of_counts(step: float, begin: float, seed: int, size: int) -> None:
    """Of all counts or a part of them, with any zero; measurements without counts have none."""
    counts = np.random.default_rng(seed).integers(-1000, 1000, size)
    measured_counts = np.asarray(begin + step * counts, dtype=np.float64)
    assert resolution(measured_counts) == pytest.approx(step, rel=1e-6)
    assert resolution(np.random.default_rng(seed).normal(begin, step, size)) == 0.0
    assert resolution(np.full(size, begin)) == 0.0


def test_exact_positions_at_constant_speeds_are_not_rounded() -> None:
    """They are multiples of a step as well; the same positions in counts are."""
    velocity = np.repeat([0.0, 5e-3, -5e-3, 0.0, 1e-2, -1e-2] * 5, 500)
    exact = np.asarray(0.1 + np.cumsum(velocity) / 250.0)
    assert resolution(exact) == pytest.approx(2e-5)
    assert rounding_of_motion(exact) == 0.0
    counted = 7e-6 * np.round(exact / 7e-6)
    assert rounding_of_motion(counted) == pytest.approx(7e-6 / np.sqrt(12.0))


@pytest.mark.parametrize('seed', range(8))
def test_exact_speeds_at_a_low_rate_have_no_noise(seed: int) -> None:
    """The change of the speed between few samples is not noise of the speed."""
    rng = np.random.default_rng(seed)
    peaks = np.tile([10e-3, -10e-3, 20e-3, -20e-3, 30e-3, -30e-3], 5)

    def speed(time: FloatArray) -> FloatArray:
        return peaks[time.astype(int) % 30] * (1.0 - np.abs(2.0 * (time % 1.0) - 1.0))

    time, fine = np.sort(rng.uniform(0.0, 60.0, 300)), np.linspace(0.0, 60.0, 60_001)
    depth = np.interp(time, fine, cumulative_trapezoid(speed(fine), fine, initial=0.0))
    velocity = speed(time)
    force = COULOMB * np.sign(velocity) + VISCOUS * velocity + 0.01 * rng.normal(size=len(time))
    found = identify_friction(Recording(time=time, depth=depth, velocity=velocity, force=force))
    assert found.estimator == 'ordinary'
    # Samples near a reversal differ from the terms between its neighbors: four standard errors.
    assert all(abs(found[k].value - truth) < 4.0 * found[k].error for k, truth in TRUTH.items())


def test_huber_is_robust_against_outliers() -> None:
    recording = strokes(seed=6)
    rng = np.random.default_rng(6)
    struck = rng.random(len(recording.time)) < 0.01
    spoiled = replace(recording, force=recording.force + 3.0 * struck)
    huber = identify_friction(spoiled, FrictionSettings(estimator='huber'))
    ordinary = identify_friction(spoiled)
    assert huber['coulomb_friction'].error < 0.5 * ordinary['coulomb_friction'].error
    assert within(huber['viscous_friction'], VISCOUS)
    assert any(test.name == 'normality' and test.p_value < 1e-3 for test in ordinary.tests)


@pytest.mark.parametrize('both_ways', [True, False])
@pytest.mark.parametrize('seed', [None, 0])
def test_one_speed_does_not_determine_two_coefficients(both_ways: bool, seed: int | None) -> None:
    recording = law(lambda time: np.full_like(time, 5e-3), both_ways=both_ways, offset=0.01)
    if seed is not None:
        noise = np.random.default_rng(seed).normal(scale=0.01, size=2000)
        recording = replace(recording, force=recording.force + noise)
    elif not both_ways:
        recording = replace(recording, force=recording.force + 1e-3 * np.sin(recording.time))
    found = identify_friction(recording)
    for name in TRUTH:
        assert not found[name].determined
        assert found[name].interval == (-np.inf, np.inf)
    assert any('do not determine coulomb_friction' in words for words in found.warnings)


def measured(*speeds: float, noise: float, seed: int) -> Recording:
    """Record positions with noise [m], of strokes of 3 s in and out at each speed [m/s]."""
    rng = np.random.default_rng(seed)
    rest = np.zeros(100)
    legs = [np.full(600, way * speed) for speed in speeds for way in (1.0, -1.0)]
    velocity = np.concatenate([part for leg in legs for part in (rest, leg)])
    time = np.asarray(0.005 * np.arange(len(velocity)))
    depth = 0.005 * np.cumsum(velocity) + rng.normal(scale=noise, size=len(time))
    force = COULOMB * np.sign(velocity) + VISCOUS * velocity
    force += rng.normal(scale=0.01, size=len(time))
    return Recording(name='measured', time=time, depth=depth, force=force)


@pytest.mark.parametrize(('speed', 'noise'), [(5e-4, 3e-7), (5e-4, 1e-6), (1e-3, 2e-6)])
def test_noise_of_the_speed_is_no_second_speed(speed: float, noise: float) -> None:
    """Position noise up to that which hides the speed; another speed determines mu_v."""
    for seed in range(10):
        found = identify_friction(measured(speed, speed, noise=noise, seed=seed))
        assert not any(found[name].determined for name in TRUTH)
        assert found.warnings[-1].endswith('use more speeds, or fewer terms')
        found = identify_friction(measured(speed, 4.0 * speed, noise=noise, seed=seed))
        # 60 intervals of 95 %.
        assert all(within(found[name], truth, 4.5) for name, truth in TRUTH.items())


@pytest.mark.parametrize('others', [(), (2e-3,)])
def test_slow_strokes_that_noise_hides_are_named_with_a_remedy(others: tuple[float]) -> None:
    """Whether the other strokes determine the friction or not; the default uses the remedy."""
    recording = measured(1.5e-4, 2e-4, 8e-4, *others, noise=1e-6, seed=1)
    found = identify_friction(recording, FrictionSettings(estimator='ordinary'))
    assert found['viscous_friction'].determined == bool(others)
    said = r's of motion are left out: noise .* hides motion below .*: choose a lower cutoff'
    assert re.search(said, '; '.join(found.warnings))
    for chosen in (FrictionSettings(), FrictionSettings(cutoff=5.0)):
        found = identify_friction(recording, chosen)
        assert 'left out' not in '; '.join(found.warnings)
        assert all(within(found[name], truth) for name, truth in TRUTH.items())


@pytest.mark.parametrize('noise', [1e-6, 5e-6])
def test_rests_are_no_hidden_motion(noise: float) -> None:
    for seed in range(5):
        recording = measured(2e-3, 5e-3, 1e-2, noise=noise, seed=seed)
        before = np.random.default_rng(seed).normal(scale=noise, size=4000) + recording.depth[0]
        resting = Recording(
            time=np.asarray(0.005 * np.arange(4000 + len(recording.time))),
            depth=np.concatenate([before, recording.depth]),
            force=np.concatenate([np.zeros(4000), recording.force]),
        )
        for one in (recording, resting):
            assert 'hides' not in '; '.join(identify_friction(one).warnings)


def test_offset_and_direction_together_are_not_determined() -> None:
    found = identified(settings('offset', 'direction'), seed=7)
    known = {parameter.name: parameter.determined for parameter in found.parameters}
    assert known == {
        'coulomb_friction': False,
        'viscous_friction': True,
        'offset': False,
        'withdrawal_coulomb': False,
        'withdrawal_viscous': True,
        'withdrawal_friction': False,
    }
    assert within(found['viscous_friction'], VISCOUS)


def test_strokes_in_one_direction_do_not_determine_an_offset() -> None:
    found = identify_friction(law(varied, both_ways=False), settings('offset'))
    known = {parameter.name: parameter.determined for parameter in found.parameters}
    assert known == {'coulomb_friction': False, 'viscous_friction': True, 'offset': False}


def test_mu_s_includes_a_zero_of_the_sensor_that_nothing_determines() -> None:
    """It is named for strokes in one direction, and for friction by direction."""
    tare = 'mu_s includes the zero of the force sensor'
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(scale=NOISE, size=2000)
        one_way, both = (law(varied, both_ways=ways, offset=1.0) for ways in (False, True))
        found = identify_friction(replace(one_way, force=one_way.force + noise))
        assert within(found['coulomb_friction'], COULOMB + 1.0)
        assert any('record both directions' in words for words in found.warnings)
        for terms, named in (((), False), (('offset',), False), (('direction',), True)):
            found = identify_friction(replace(both, force=both.force + noise), settings(*terms))
            assert any(tare in words for words in found.warnings) == named


def test_the_breakaway_force_needs_a_rest_with_a_rising_force() -> None:
    assert identified(seed=8).breakaway is not None
    assert identified(seed=8, push=0.0).breakaway is None
    sticky = identified(settings('stribeck'), seed=8, breakaway=1.3)
    # In this recording the needle creeps while the force rises to the breakaway force.
    assert sticky.breakaway is None or sticky.breakaway.error < 0.02


@pytest.mark.parametrize('slowest', [2.0e-3, 2.9e-3])
def test_velocity_noise_does_not_suggest_stribeck_friction(slowest: float) -> None:
    """Positions only, white noise of 1 um, no samples near rest."""
    advised = 0
    for seed in range(20):
        made = strokes(seed=seed, speeds=(slowest, 5e-3, 10e-3, 20e-3), push=0.0)
        noise = np.random.default_rng(1000 + seed).normal(scale=1e-6, size=len(made.depth))
        recording = Recording(
            name='positions', time=made.time, depth=made.depth + noise, force=made.force
        )
        found = identify_friction(recording)
        advised += any('add the term' in words for words in found.warnings)
    assert advised == 0
    # If requested, the term has a warning.
    asked = identify_friction(recording, settings('stribeck'))
    assert any('no sample is slow enough' in words for words in asked.warnings)


def test_terms_with_unphysical_values_are_not_suggested() -> None:
    """A force ahead of its motion has the effect of negative Stribeck friction or mass."""
    for seed in range(10):
        found = identify_friction(strokes(seed=seed, lag=-1e-3))
        assert not any('add the term' in words for words in found.warnings)


def test_lost_samples_and_start_time_do_not_change_the_result() -> None:
    recording = strokes(seed=9)
    whole = identify_friction(recording)
    rng = np.random.default_rng(3)
    kept = rng.random(len(recording.time)) > 0.02
    kept[1000:1100] = False
    part = identify_friction(
        Recording(
            name='part',
            time=recording.time[kept] + 100.0,
            depth=recording.depth[kept],
            velocity=recording.velocity[kept],
            force=recording.force[kept],
        )
    )
    assert part.samples < whole.samples
    for name, truth in TRUTH.items():
        # Interpolated samples add misfit where the velocity changes.
        assert abs(part[name].value - truth) < 5.0 * whole[name].error


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('rate', [50.0, 1000.0])
def test_friction_is_independent_of_the_sampling_rate(rate: float) -> None:
    recording = strokes(seed=10)
    time = np.arange(recording.time[0], recording.time[-1], 1.0 / rate)
    changed = Recording(
        name='rate',
        time=time,
        **{
            name: np.interp(time, recording.time, getattr(recording, name))
            for name in ('depth', 'velocity', 'force')
        },
    )
    found = identify_friction(changed)
    assert all(within(found[name], truth) for name, truth in TRUTH.items())
    # No more than 8 samples per period of the cutoff are fitted.
    assert len(found.fit.time) <= 250 * 15


def test_the_fit_has_the_reported_residual() -> None:
    found = identified(seed=11)
    fit = found.fit
    assert_array_equal(np.isfinite(fit.model), fit.used)
    left = fit.force[fit.used] - fit.model[fit.used]
    assert_allclose(np.sqrt(np.mean(left**2)), found.residual, rtol=1e-9)
    assert np.count_nonzero(fit.used) == found.samples


TENS = np.arange(0.0, 50.0, 10.0)


def jump(recording: Recording) -> Recording:
    """Insert a clock jump in the middle, as between simulated and real stamps."""
    return replace(recording, time=recording.time + np.where(recording.time < 4.0, 0.0, 1e9))


@pytest.mark.parametrize(
    ('recording', 'complaint'),
    [
        (law(np.zeros_like), r'must last .* s in all, lasts 0 s: .* another axis, topic'),
        (law(varied, duration=0.5), 'steady motion above 1e-05 m/s must last'),
        (law(varied, duration=0.04), 'must last > 0.048 s for a filter of 30 Hz'),
        (law(varied, duration=0.004), 'too short: 1 samples'),
        (Recording(name='law', time=TENS, depth=TENS, force=TENS), 'too short: 5 periods of 10 s'),
        (
            replace(law(varied), force=np.zeros(2000)),
            'force must vary, got 0 N throughout: choose another axis, topic or column',
        ),
        (
            replace(law(varied), force=np.random.default_rng(0).normal(scale=0.01, size=2000)),
            'no friction: mu_s = .* N, mu_v = .* force and motion do not belong together',
        ),
        (jump(law(varied)), r'stamps too uneven: 2000 samples in 1e\+09 s'),
    ],
    ids=[
        'rest',
        'little motion',
        'short',
        'one sample',
        'five samples',
        'no force',
        'noise',
        'stamps',
    ],
)
def test_an_unusable_recording_is_rejected_with_a_reason(
    recording: Recording, complaint: str
) -> None:
    with pytest.raises(IdentificationError, match=f'^law: .*{complaint}'):
        identify_friction(recording)


def test_negative_friction_is_rejected() -> None:
    recording = law(varied)
    with pytest.raises(IdentificationError, match=r'negative, got mu_s = -0\.56 N.*wrong sign'):
        identify_friction(replace(recording, force=-recording.force))


@pytest.mark.parametrize(
    'name', ['cutoff', 'moving_speed', 'largest_acceleration', 'stribeck_speed']
)
@pytest.mark.parametrize('value', [0.0, -1.0, float('nan')])
def test_settings_out_of_range_are_rejected(name: str, value: Any) -> None:
    with pytest.raises(ParameterError, match=f'{name} must be'):
        FrictionSettings(**{name: value})


@pytest.mark.parametrize(
    ('changes', 'complaint'),
    [
        ({'terms': ()}, 'distinct, at least one'),
        ({'terms': ('coulomb', 'coulomb')}, 'distinct, at least one'),
        ({'terms': ('coulomb', 'glue')}, "of coulomb, viscous, .*, got 'glue'"),
        ({'terms': ('coulomb', 'direction')}, 'direction needs the terms coulomb and viscous'),
        ({'estimator': 'best'}, "estimator must be one of .*, got 'best'"),
        ({'estimator': 'total', 'terms': ('coulomb',)}, 'total needs the term viscous'),
    ],
)
def test_invalid_terms_and_estimators_are_rejected(
    changes: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(ParameterError, match=complaint):
        FrictionSettings(**changes)


def test_the_error_for_an_unknown_parameter_lists_valid_names() -> None:
    """It is a KeyError, and as all errors a NeedleError with a plain message."""
    valid = "^'offset'; valid: coulomb_friction, viscous_friction"
    for kind in (KeyError, NeedleError):
        with pytest.raises(kind, match=valid):
            identified()['offset']


def test_the_summary_contains_all_parameters_of_all_recordings() -> None:
    one = identified(settings('offset'), seed=12, offset=0.1)
    other = identified(seed=13)
    summary = summarize([one, other])
    assert {s.name for s in summary.statistics} == {
        *TRUTH, 'offset', 'breakaway_force', 'lag',
    }  # fmt: skip
    pair = [one['coulomb_friction'].value, other['coulomb_friction'].value]
    assert_allclose(summary['coulomb_friction'].mean, np.mean(pair), rtol=1e-12)
    assert_allclose(summary['coulomb_friction'].deviation, np.std(pair, ddof=1), rtol=1e-9)
    assert (summary['coulomb_friction'].count, summary['offset'].count) == (2, 1)
    assert summary.estimates == (one, other)
    with pytest.raises(KeyError, match=r'moving_mass.*valid: coulomb_friction'):
        summary['moving_mass']


def test_a_summary_without_estimates_is_rejected() -> None:
    with pytest.raises(IdentificationError, match='no recordings'):
        summarize([])
