"""Friction comes out as it went in, with an error bar that means what it says."""

from dataclasses import replace

from identification.samples import IDEAL, NOISY, simulated, THERE_AND_BACK, TRUTH
from needle_dynamics import ForceSensorParameters, Integrator, ParameterError
from needle_identification import (
    FrictionSettings,
    IdentificationError,
    identify_friction,
    Recording,
    summarize,
)
import numpy as np
from numpy.testing import assert_allclose
import pytest

ONE_WAY = ((0.0, 0.3), (2e-3, 1.5), (5e-3, 1.5), (8e-3, 1.5), (0.0, 0.3))


def law(pace, *, both_ways=True, duration=8.0, offset=0.0):
    """Make a recording of equation (15) itself at a given pace |s_dot| [m/s] over time [s]."""
    time = np.arange(round(duration * 250)) / 250.0
    way = np.where(time < duration / 2.0, 1.0, -1.0) if both_ways else np.ones_like(time)
    speed = way * pace(time)
    force = 0.56 * np.sign(speed) + 300.0 * speed + offset
    return Recording(
        name='law', time=time, depth=np.cumsum(speed) / 250.0, speed=speed, force=force
    )


def jump(recording):
    """Let the clock jump in the middle, as one with simulated and real stamps does."""
    return replace(recording, time=recording.time + np.where(recording.time < 4.0, 0.0, 1e9))


def varied(time):
    return 5e-3 + 2e-3 * np.sin(2.0 * np.pi * 0.3 * time)


@pytest.mark.parametrize('legs', [THERE_AND_BACK, ONE_WAY])
def test_recovers_what_was_simulated(legs):
    estimate = identify_friction(simulated(legs))
    # 1e-3: the filter forgets a step to 2e-4 of it at the edge of what is used.
    assert_allclose(estimate.coulomb_friction, TRUTH.coulomb_friction, rtol=1e-3)
    assert_allclose(estimate.viscous_friction, TRUTH.viscous_friction, rtol=1e-3)
    assert estimate.determination > 0.9999


def test_recovers_what_was_pushed_with_a_growing_force():
    """The protocol of section 3.2.2.2: the force grows until the needle moves, and on."""
    rate, growth = 250.0, 0.5
    integrator = Integrator(TRUTH, [0.17, 0, 0, 0, 0, 0, 0, 0], step=1e-3)
    rows = []
    for i in range(round(6.0 * rate)):
        force = growth * i / rate
        integrator.advance(1.0 / rate, force)
        rows.append((i / rate, integrator.depth, integrator.speed, force))
    time, depth, speed, force = np.array(rows).T
    estimate = identify_friction(
        Recording(name='push', time=time, depth=depth, speed=speed, force=force)
    )
    # 4 mN: the force of a sample acts until the next one, 4 ms later, at 0.5 N/s; twice that.
    assert abs(estimate.coulomb_friction - TRUTH.coulomb_friction) < 4e-3
    assert_allclose(estimate.viscous_friction, TRUTH.viscous_friction, rtol=1e-3)
    assert estimate.offset is None


@pytest.mark.parametrize(
    'sensor',
    [
        ForceSensorParameters(cutoff=0.0, force_resolution=0.0),
        NOISY,
        ForceSensorParameters(cutoff=0.0, force_resolution=0.02),
    ],
    ids=['white', 'second order', 'counts'],
)
def test_error_bars_hold_the_truth_as_often_as_they_say(sensor):
    estimates = [identify_friction(simulated(sensor=sensor, seed=seed)) for seed in range(100)]
    for name, error, truth in (
        ('coulomb_friction', 'coulomb_error', TRUTH.coulomb_friction),
        ('viscous_friction', 'viscous_error', TRUTH.viscous_friction),
    ):
        values = np.array([getattr(estimate, name) for estimate in estimates])
        errors = np.array([getattr(estimate, error) for estimate in estimates])
        # Three standard deviations of a binomial of 100 trials at 95 % are 6.5 %.
        assert np.mean(np.abs(values - truth) < 2.0 * errors) >= 0.885
        # A standard deviation from 100 values is good to 7 %: three of these.
        assert_allclose(np.sqrt(np.mean(errors**2)), values.std(), rtol=0.21)


def test_friction_scales_with_the_force():
    recording = simulated(sensor=NOISY)
    one = identify_friction(recording)
    three = identify_friction(replace(recording, force=3.0 * recording.force))
    assert_allclose(
        [three.coulomb_friction, three.viscous_friction, three.coulomb_error, three.residual],
        np.multiply(
            3.0, [one.coulomb_friction, one.viscous_friction, one.coulomb_error, one.residual]
        ),
        rtol=1e-9,
    )


def test_friction_is_the_same_seen_from_the_other_side():
    recording = simulated(sensor=NOISY)
    mirrored = replace(recording, force=-recording.force, speed=-recording.speed)
    one, other = identify_friction(recording), identify_friction(mirrored)
    assert_allclose(other.coulomb_friction, one.coulomb_friction, rtol=1e-9)
    assert_allclose(other.viscous_friction, one.viscous_friction, rtol=1e-9)
    assert_allclose(other.offset, -one.offset, rtol=1e-9)


def test_an_offset_of_the_sensor_is_told_from_friction_when_both_ways_are_seen():
    one = identify_friction(law(varied))
    other = identify_friction(law(varied, offset=0.2))
    assert_allclose(other.offset - one.offset, 0.2, rtol=1e-9)
    assert_allclose(other.coulomb_friction, one.coulomb_friction, rtol=1e-9)
    assert identify_friction(law(varied, both_ways=False)).offset is None


def test_time_may_begin_anywhere_and_samples_may_be_lost():
    recording = simulated(sensor=NOISY, seed=3)
    whole = identify_friction(recording)
    rng = np.random.default_rng(3)
    kept = rng.random(len(recording.time)) > 0.02
    kept[1000:1100] = False
    part = identify_friction(
        Recording(
            name='part',
            time=recording.time[kept] + 100.0,
            depth=recording.depth[kept],
            speed=recording.speed[kept],
            force=recording.force[kept],
        )
    )
    assert part.samples < whole.samples
    # The same noise but for what is missing: well within the error bars of either.
    assert abs(part.coulomb_friction - whole.coulomb_friction) < 2.0 * whole.coulomb_error
    assert abs(part.viscous_friction - whole.viscous_friction) < 2.0 * whole.viscous_error


@pytest.mark.parametrize('both_ways', [True, False])
def test_one_speed_does_not_determine_two_coefficients(both_ways):
    with pytest.raises(IdentificationError, match=r'told apart, got 0\.005 m/s with a spread'):
        identify_friction(law(lambda time: np.full_like(time, 5e-3), both_ways=both_ways))


@pytest.mark.parametrize(
    ('recording', 'settings', 'complaint'),
    [
        (law(np.zeros_like), {}, r'must last 2.2. s in all, lasts 0 s'),
        (law(varied, duration=2.0), {}, 'steady motion above 0.0005 m/s must last'),
        (law(varied, duration=0.2), {}, 'must last > 0.4 s for a filter of 10 Hz'),
        (law(varied, duration=0.004), {}, 'too short: 1 samples'),
        (law(varied), {'cutoff': 125.0}, 'cutoff must be < half the sample rate = 125 Hz'),
        (replace(law(varied), force=np.zeros(2000)), {}, 'force must vary, got 0 N throughout'),
        (jump(law(varied)), {}, r'stamps too uneven: 2000 samples in 1e\+09 s'),
    ],
    ids=['rest', 'little motion', 'short', 'one sample', 'cutoff', 'no force', 'stamps'],
)
def test_says_what_a_recording_lacks(recording, settings, complaint):
    with pytest.raises(IdentificationError, match=f'^law: .*{complaint}'):
        identify_friction(recording, FrictionSettings(**settings))


def test_refuses_friction_that_drives():
    recording = law(varied)
    with pytest.raises(IdentificationError, match=r'negative, got mu_s = -0\.56 N.*wrong sign'):
        identify_friction(replace(recording, force=-recording.force))


@pytest.mark.parametrize('name', ['cutoff', 'moving_speed', 'largest_acceleration'])
@pytest.mark.parametrize('value', [0.0, -1.0, float('nan')])
def test_refuses_settings_out_of_range(name, value):
    with pytest.raises(ParameterError, match=f'{name} must be'):
        FrictionSettings(**{name: value})


def estimates(values, error):
    base = identify_friction(simulated(sensor=IDEAL))
    return [
        replace(base, coulomb_friction=value, coulomb_error=error, name=str(value))
        for value in values
    ]


def test_summary_is_the_mean_and_scatter_of_table_1():
    summary = summarize(estimates([0.5, 0.6, 0.7, 0.6], 0.01))
    assert_allclose(summary.coulomb.mean, 0.6, rtol=1e-12)
    assert_allclose(summary.coulomb.deviation, np.sqrt(0.02 / 3.0), rtol=1e-12)
    assert_allclose(summary.coulomb.error, np.sqrt(0.02 / 3.0) / 2.0, rtol=1e-12)
    # Student's t for four recordings that differ by more than their errors, from a table.
    assert_allclose(
        summary.coulomb.interval,
        0.6 + np.array([-3.182, 3.182]) * summary.coulomb.error,
        rtol=1e-3,
    )


def test_summary_is_no_surer_than_its_recordings_allow():
    statistic = summarize(estimates([0.6, 0.6], 0.02)).coulomb
    assert_allclose(statistic.error, 0.02 / np.sqrt(2.0), rtol=1e-12)
    assert_allclose(statistic.interval, [0.6 - 2.0 * statistic.error, 0.6 + 2.0 * statistic.error])


def test_summary_of_one_recording_has_its_error_and_no_scatter():
    statistic = summarize(estimates([0.6], 0.02)).coulomb
    assert (statistic.mean, statistic.deviation, statistic.error) == (0.6, None, 0.02)


def test_nothing_cannot_be_summarized():
    with pytest.raises(IdentificationError, match='no recordings'):
        summarize([])
