# SPDX-License-Identifier: Apache-2.0
"""Selection of the velocity source, samples and friction terms from the data; punctures."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from math import exp, log
import re
from typing import Any

from benchmarks.noises import FURTHER, NoiseKind, recorded
from needle_dynamics import ParameterError
from needle_identification import (
    FrictionEstimate,
    FrictionSettings,
    IdentificationError,
    identify_friction,
    Recording,
    summarize,
)
from needle_identification.friction.filtering import cut_off, low_pass_taps
from needle_identification.friction.lag import velocity_delay, velocity_scale
from needle_identification.friction.settings import OF_VELOCITY, TERMS
from needle_identification.friction.terms import NeedleMotion, regressors
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.signal import lsim
from support.strokes import strokes, VISCOUS

MU_S, MU_V = 0.2, 250.0
PLAIN = ('coulomb', 'viscous')
NOISE = 0.02


def insertion(
    seed: int,
    *,
    layers: tuple[tuple[float, float], ...] = (),
    cutting: float = 0.0,
    presliding: float = 0.0,
    punctures: tuple[tuple[float, float, float], ...] = (),
) -> Recording:
    """
    Simulate one minute of alternating insertion and withdrawal with increasing depth.

    ``layers`` are pairs of a depth and the friction per length below it [N/m]; ``punctures`` a
    depth, a drop of the force, and the length over which the tissue loads the needle before.
    """
    rng = np.random.default_rng(seed)
    step, lasts = 1.0 / 250.0, 60.0
    corners, velocities, depth, sign = [0.0, 0.5], [0.0, 0.0], 0.0, 1.0
    while corners[-1] < lasts:
        speed = exp(rng.uniform(log(4e-3), log(12e-3)))
        way = rng.uniform(0.02, 0.04) if sign > 0.0 else rng.uniform(0.01, 0.025)
        if not 0.0 <= depth + sign * way <= 0.09:
            sign = -sign
            continue
        ramp, begin = speed / 0.08, corners[-1]
        corners += [begin + ramp, begin + way / speed, begin + ramp + way / speed]
        velocities += [sign * speed, sign * speed, 0.0]
        depth, sign = depth + sign * way, -sign
    time = np.arange(0.0, lasts, step)
    velocity = np.interp(time, corners, velocities)
    s = np.concatenate([[0.0], np.cumsum(0.5 * step * (velocity[1:] + velocity[:-1]))])
    sliding = np.sign(velocity)
    if presliding:
        # Asperities bend before they slide (Dahl).
        state = 0.0
        for k, v in enumerate(velocity):
            kept = exp(-abs(v) * step / presliding)
            state = np.sign(v) + (state - np.sign(v)) * kept
            sliding[k] = state
    force = MU_S * sliding + MU_V * velocity
    ends = [*(depth for depth, _ in layers[1:]), np.inf]
    for (begin, density), end in zip(layers, ends, strict=bool(layers)):
        force += np.sign(velocity) * density * np.clip(s - begin, 0.0, end - begin)
    fresh = (s >= np.maximum.accumulate(s) - 1e-9) & (velocity > 0.0)
    force += cutting * fresh
    for where, drop, load in punctures:
        loading = (s - (where - load)) / load
        force += np.where(fresh & (loading > 0.0) & (s < where), drop * loading, 0.0)
    return Recording(
        name=f'insertion {seed}',
        time=time,
        depth=np.round(s, 6),
        velocity=velocity,
        force=force + NOISE * rng.standard_normal(len(time)),
    )


def advised(found: FrictionEstimate) -> list[str]:
    """Return the suggested terms."""
    words = [w.rpartition('add the term')[2] for w in found.warnings if 'add the term' in w]
    return [term for w in words for term in w.removeprefix('s').strip().split(' and ')]


def followed(recording: Recording) -> set[str]:
    """Return the terms after following all suggestions."""
    terms = ['coulomb', 'viscous']
    while more := advised(identify_friction(recording, FrictionSettings(terms=tuple(terms)))):
        terms += more
    return set(terms) - {'coulomb', 'viscous'}


@pytest.mark.parametrize(
    ('made', 'terms', 'layers', 'truth'),
    [
        ({'layers': ((0.0, 5.0),)}, ('length',), (), {'length_friction': 5.0}),
        (
            {'layers': ((0.0, 5.0),), 'cutting': 0.3}, ('length', 'cutting'), (),
            {'length_friction': 5.0, 'cutting_force': 0.3},
        ),
        (
            {'layers': ((0.0, 6.0), (0.03, 20.0))}, ('layers',), (0.0, 0.03),
            {'layer_1_friction': 6.0, 'layer_2_friction': 20.0},
        ),
    ],
)  # fmt: skip
def test_friction_along_the_needle_is_identified(
    made: dict[str, Any],
    terms: tuple[str, ...],
    layers: tuple[float, ...],
    truth: dict[str, float],
) -> None:
    """The suggested terms are the missing terms; with them the estimates are correct."""
    right, covered, count = 0, 0, 0
    for seed in range(8):
        recording = insertion(seed, **made)
        ends = followed(recording)
        right += 'length' in ends if layers else ends == set(terms)
        settings = FrictionSettings(terms=('coulomb', 'viscous', *terms), layers=layers)
        found = identify_friction(recording, settings)
        assert not advised(found)
        for name, value in {'viscous_friction': MU_V, **truth}.items():
            if found[name].determined:
                count += 1
                low, high = found[name].interval
                covered += low <= value <= high
    assert right >= 7
    # 95 % of 16 or more, with three standard deviations.
    assert count >= 16
    assert covered >= 0.79 * count


@pytest.mark.parametrize(
    ('settings', 'said'),
    [
        ({'terms': ('coulomb', 'layers')}, 'need each other'),
        ({'layers': (0.01,)}, 'need each other'),
        ({'terms': ('layers',), 'layers': (0.02, 0.01)}, 'layers must increase'),
        ({'terms': ('layers', 'length'), 'layers': (0.0,)}, 'takes the place'),
    ],
)
def test_invalid_layers_are_rejected(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        FrictionSettings(**settings)


def test_punctures_are_detected_and_located() -> None:
    where = ((0.025, 0.4, 0.006), (0.06, 0.25, 0.01))
    found_of, false = {depth: 0 for depth, _, _ in where}, 0
    terms = FrictionSettings(terms=('coulomb', 'viscous', 'cutting'))
    for seed in range(8):
        found = identify_friction(insertion(seed, cutting=0.2, punctures=where), terms)
        for one in found.punctures:
            near = [p for p in where if abs(p[0] - one.depth.value) < 1e-3]
            false += not near
            for depth, drop, _ in near:
                # Four standard errors, and the load of the tissue within the window of the
                # filter.
                assert abs(one.drop.value - drop) < 4.0 * one.drop.error + 0.25 * drop
                found_of[depth] += 1
        assert identify_friction(insertion(seed, cutting=0.2)).punctures == ()
    assert false == 0
    assert min(found_of.values()) >= 6


def one_stroke(seed: int, speed: float, drop: float = 0.0) -> Recording:
    """Simulate an insertion by 30 mm that ends gradually, with a puncture after half of it."""
    corners = 0.5 + np.cumsum([0.0, 0.1, 0.03 / speed, 0.1])
    time = np.arange(0.0, corners[-1] + 0.5, 0.004)
    velocity = np.interp(time, corners, [0.0, speed, speed, 0.0])
    s = np.cumsum(velocity) * 0.004
    force = MU_S * np.sign(velocity) + MU_V * velocity
    force += np.where((velocity > 0.0) & (s < 0.015), drop, 0.0)
    noise = 0.01 * np.random.default_rng(seed).standard_normal(len(time))
    return Recording(name='one', time=time, depth=s, velocity=velocity, force=force + noise)


@pytest.mark.parametrize('speed', [0.005, 0.03])
def test_the_end_of_a_stroke_is_no_puncture(speed: float) -> None:
    """One speed does not separate mu_s from mu_v: the friction of other speeds is unknown."""
    for seed in range(10):
        found = identify_friction(one_stroke(seed, speed))
        assert any('do not determine' in words for words in found.warnings)
        assert not found.punctures
        (one,) = identify_friction(one_stroke(seed, speed, drop=0.4)).punctures
        # Four standard errors.
        assert abs(one.drop.value - 0.4) < 4.0 * one.drop.error


def test_friction_that_falls_with_the_speed_is_no_puncture_without_its_term() -> None:
    for seed in range(5):
        for speed in (0.01, 0.02):
            made = one_stroke(seed, speed)
            assert not identify_friction(made, FrictionSettings(terms=('coulomb',))).punctures


@pytest.mark.parametrize('seed', range(3))
def test_presliding_samples_are_discarded(seed: int) -> None:
    """Friction that builds up over 0.2 mm after each reversal is not sliding friction."""
    found = identify_friction(insertion(seed, presliding=2e-4))
    assert any('presliding' in words for words in found.warnings)
    assert abs(found['coulomb_friction'].value - MU_S) < 0.02 * MU_S
    assert abs(found['viscous_friction'].value - MU_V) < 0.01 * MU_V
    plain = identify_friction(insertion(seed))
    assert not any('presliding' in words for words in plain.warnings)


@pytest.mark.parametrize('seed', range(3))
def test_velocities_filtered_by_the_driver_are_replaced(seed: int) -> None:
    """A first-order filter of 32 ms smooths strokes: positions show it, and replace it."""
    generator = np.random.default_rng(seed)
    recording, truth = recorded(NoiseKind(speed_filter=0.032), generator)
    # The end points of 0.1 s of samples of 4 ms determine the delay to a sample.
    assert abs(velocity_delay(recording) - 0.032) < 0.004
    found = identify_friction(recording)
    assert any('behind the positions: a filter' in words for words in found.warnings)
    for name, value in truth.items():
        assert abs(found[name].value - value) < 4.0 * found[name].error
    plain, _ = recorded(NoiseKind(speed_noise=1e-3), generator)
    assert velocity_delay(plain) == 0.0
    assert velocity_delay(replace(recording, velocity=None)) == 0.0


@pytest.mark.parametrize(
    ('ratio', 'said'), [(1000.0, 'speed in mm/s'), (1.1, ''), (0.95, ''), (1e-3, 'depth in mm')]
)
def test_a_velocity_with_another_scale_than_the_positions_is_named(
    ratio: float, said: str
) -> None:
    """The positions replace it, unless the unit of the depth is as probable."""
    for seed in range(5):
        recording, truth = recorded(NoiseKind(speed_noise=1e-5), np.random.default_rng(seed))
        assert velocity_scale(recording) is None
        assert recording.velocity is not None
        wrong = replace(recording, velocity=ratio * recording.velocity)
        found_ratio, error = velocity_scale(wrong) or (0.0, 0.0)
        assert abs(found_ratio / ratio - 1.0) < 1e-3
        assert error < 1e-3 * ratio
        found = identify_friction(wrong, FrictionSettings(moving_speed=1e-8))
        (words,) = (words for words in found.warnings if 'times the change' in words)
        assert said in words
        assert ('took the speed from the positions' in words) == (ratio > 0.01)
        true = truth['viscous_friction'] / (1.0 if ratio > 0.01 else ratio)
        assert abs(found['viscous_friction'].value - true) < 4.0 * found['viscous_friction'].error
    # A chosen estimator keeps the velocity; motion in mm/s seems to accelerate too much.
    said = 'times the change'
    with pytest.raises(IdentificationError, match=said) if ratio > 2.0 else nullcontext():
        asked = identify_friction(wrong, FrictionSettings(estimator='ordinary', moving_speed=1e-8))
        (words,) = (words for words in asked.warnings if said in words)
        assert 'took the speed' not in words
    plain, _ = recorded(NoiseKind(speed_noise=5e-3), np.random.default_rng(0))
    assert velocity_scale(plain) is None


def test_positions_against_the_velocity_are_named() -> None:
    """Friction has the sign of the velocity, and the terms of depth that of the positions."""
    for seed in range(5):
        recording, truth = recorded(NoiseKind(speed_noise=1e-5), np.random.default_rng(seed))
        found = identify_friction(replace(recording, depth=-recording.depth))
        (words,) = (words for words in found.warnings if 'times the change' in words)
        assert words.startswith('the speed is -1')
        assert words.endswith('depth or velocity has the wrong sign')
        for name, value in truth.items():
            assert abs(found[name].value - value) < 4.0 * found[name].error
        # Friction dissipates: if the force is against the velocity, it is with the positions.
        assert recording.velocity is not None
        found = identify_friction(replace(recording, velocity=-recording.velocity))
        assert any('wrong sign: took the speed from the' in words for words in found.warnings)
        for name, value in truth.items():
            assert abs(found[name].value - value) < 4.0 * found[name].error


def holding(found: FrictionEstimate, truth: Mapping[str, float]) -> int:
    """Return the number of intervals that contain the true value."""
    intervals = [(found[name].interval, value) for name, value in truth.items()]
    return sum(low <= value <= high for (low, high), value in intervals)


def test_low_pass_taps_are_the_exact_filter_less_its_mean_delay() -> None:
    period, time_constant = 0.004, 0.02
    time = period * np.arange(500)
    signal = np.interp(time, [0.0, 0.6, 0.8, 1.1, 1.2], [0.0, 0.0, 1.0, 1.0, -1.0])
    _, exact, _ = lsim(([1.0], [time_constant, 1.0]), signal, time)
    taps = low_pass_taps(time_constant, period)
    later = round(time_constant / period)
    found = np.convolve(signal, taps, 'same')[:-later]
    # Both are exact for piecewise linear signals; the taps end after eight time constants.
    assert_allclose(found[80:-80], exact[later:][80:-80], atol=2.0 * exp(-8.0))
    half = len(taps) // 2
    assert abs(taps @ np.arange(-half, half + 1)) < 10.0 * later * exp(-8.0)


def test_intervals_hold_behind_a_low_pass_filter_of_the_force() -> None:
    """A filter of 8 Hz smooths the force: the motion passes it as well, and it is named."""
    held = 0
    for seed in range(30):
        recording, truth = recorded(FURTHER['low-pass of 8 Hz'].kind, np.random.default_rng(seed))
        found = identify_friction(recording)
        assert any('low-pass filter of about 8' in words for words in found.warnings)
        assert not advised(found)
        held += holding(found, truth)
    # 95 % of 60 less three standard deviations; 35 without the filter of the motion.
    assert held >= 52


def test_intervals_hold_with_play_of_the_drive() -> None:
    """Play of 10 um delays the force after each reversal: it is named, the samples left out."""
    held = 0
    for seed in range(15):
        recording, truth = recorded(FURTHER['play of the drive'].kind, np.random.default_rng(seed))
        found = identify_friction(recording)
        assert any('presliding, play' in words for words in found.warnings)
        held += holding(found, truth)
    # 95 % of 30 less three standard deviations.
    assert held >= 24


@pytest.mark.parametrize('kind', ['friction by depth', 'gravity', 'decaying zero'])
def test_the_advised_term_describes_a_force_by_depth_or_time(kind: str) -> None:
    held = 0
    for seed in range(8):
        recording, truth = recorded(FURTHER[kind].kind, np.random.default_rng(seed))
        found = identify_friction(recording)
        term = FURTHER[kind].effect
        assert advised(found) == [term]
        time = re.search(r'decay_time (\S+) s', ' '.join(found.warnings))
        settings = FrictionSettings(
            terms=(*PLAIN, term), decay_time=float(time[1]) if time else 10.0
        )
        taken = identify_friction(recording, settings)
        assert not advised(taken)
        held += holding(taken, truth)
    # 95 % of 16 less three standard deviations.
    assert held >= 12


def test_outliers_of_one_sign_are_not_friction_by_direction() -> None:
    """Their mean is an offset, which is a linear combination of the columns of `direction`."""
    advised = []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        recording, _ = recorded(NoiseKind(), generator)
        size = len(recording.time)
        spikes = np.where(generator.random(size) < 0.02, generator.exponential(0.3, size), 0.0)
        found = identify_friction(replace(recording, force=recording.force + spikes))
        advised += [c for c in found.comparison if c.supported and 'direction' in c.terms]
    assert not advised


def test_the_zero_of_the_sensor_is_an_offset_and_not_friction_by_direction() -> None:
    """The residual without the offset is no noise, and does not count independent samples."""
    made = [strokes(seed=seed, push=0.0, offset=0.4) for seed in range(20, 40)]
    # One of fifty may be wrong; 8 of 20 were `direction` with a gain of BIC five times too large.
    assert [advised(identify_friction(one)) for one in made].count(['offset']) >= 19
    other = [identify_friction(strokes(seed=k, push=0.0, withdrawal=1.1)) for k in range(5)]
    assert [advised(one) for one in other] == [['direction']] * 5


@pytest.mark.parametrize(
    ('noise', 'breakaway', 'terms'), [(3e-6, 0.0, []), (1e-6, 0.0, []), (1e-6, 0.1, ['stribeck'])]
)
def test_noise_of_the_positions_is_no_friction_near_rest(
    noise: float, breakaway: float, terms: list[str]
) -> None:
    """It is in the velocity and in the column of `stribeck`, which is not linear in it."""
    kind = NoiseKind(
        positions_only=True,
        position_noise=noise,
        position_counts=0.0,
        speeds=(5e-4, 15e-3),
        truth={'stribeck_friction': breakaway},
    )
    for seed in range(6):
        found = identify_friction(recorded(kind, np.random.default_rng(seed))[0])
        assert advised(found) == terms


@pytest.mark.parametrize('noise', [2e-5, 4e-5])
def test_a_lower_cutoff_is_the_remedy_for_motion_hidden_by_noise(noise: float) -> None:
    """It is chosen automatically, and advised with a chosen estimator."""
    kind = NoiseKind(positions_only=True, position_noise=noise)
    for seed in range(4):
        recording, truth = recorded(kind, np.random.default_rng(seed))
        with pytest.raises(IdentificationError, match='choose a lower cutoff'):
            identify_friction(recording, FrictionSettings(estimator='ordinary'))
        chosen = identify_friction(recording)
        assert any('took a cutoff of' in words for words in chosen.warnings)
        for found in (chosen, identify_friction(recording, FrictionSettings(cutoff=5.0))):
            for name, value in truth.items():
                assert abs(found[name].value - value) < 4.0 * found[name].error
        # Noise without motion: another topic is the remedy.
        still = replace(recording, depth=noise * np.random.default_rng(seed).normal(size=10000))
        with pytest.raises(IdentificationError, match=r'axis, topic or column$'):
            identify_friction(still)


def test_a_lower_cutoff_is_the_remedy_for_coarse_counts() -> None:
    """Counts of 0.1 mm at 250 Hz: the acceleration leaves out all samples."""
    exact = strokes(seed=0, speeds=(0.02, 0.04, 0.06) * 3)
    recording = replace(exact, depth=1e-4 * np.round(1e4 * exact.depth), velocity=None)
    with pytest.raises(IdentificationError, match=r'not steady, .* choose a lower cutoff$'):
        identify_friction(recording, FrictionSettings(estimator='ordinary'))
    for cutoff in (30.0, 5.0):
        found = identify_friction(recording, FrictionSettings(cutoff=cutoff))
        # Equal strokes have equal errors of counting, which no interval states: at most one count
        # in a stroke of 20 mm, averaged over 18 strokes.
        assert found['viscous_friction'].value == pytest.approx(VISCOUS, rel=1e-3)
    finer = replace(recording, depth=1e-6 * np.round(1e6 * exact.depth))
    assert identify_friction(finer)['viscous_friction'].determined


def test_noisy_velocities_are_replaced_by_differentiated_positions() -> None:
    recording, truth = recorded(NoiseKind(speed_noise=1e-3), np.random.default_rng(3))
    found = identify_friction(recording)
    assert any('took the speed from the positions' in words for words in found.warnings)
    for name, value in truth.items():
        assert abs(found[name].value - value) < 4.0 * found[name].error
    # Velocities only: an order of magnitude worse, with a warning.
    asked = identify_friction(recording, FrictionSettings(estimator='ordinary'))
    assert abs(asked['viscous_friction'].value - truth['viscous_friction']) > 1.0
    assert any('in the speed reduces mu_v' in words for words in asked.warnings)


@pytest.mark.parametrize(
    'kind', [NoiseKind(), NoiseKind(white=0.005, counts=0.02), NoiseKind(counts=0.01, white=0.0)]
)
def test_only_saturated_samples_are_detected_as_clipped(kind: NoiseKind) -> None:
    for seed in range(10):
        recording, truth = recorded(kind, np.random.default_rng(seed))
        assert not cut_off(recording.force).any()
        limit = float(np.quantile(np.abs(recording.force), 0.85))
        clipped = replace(recording, force=np.clip(recording.force, -limit, limit))
        if not kind.counts:
            assert_array_equal(cut_off(clipped.force), np.abs(clipped.force) == limit)
            found = identify_friction(clipped)
            assert any('limits of its sensor' in words for words in found.warnings)
            for name, value in truth.items():
                assert abs(found[name].value - value) < 4.0 * found[name].error


def test_false_suggestions_are_rare_over_all_recordings() -> None:
    """In studies of twenty recordings, at most one of twenty gets a suggested term."""
    wrong = 0
    for study in range(3):
        rng = np.random.default_rng(study)
        made = [recorded(NoiseKind(duration=20.0), rng)[0] for _ in range(20)]
        found = [identify_friction(one, among=len(made)) for one in made]
        together = summarize(found).warnings
        # The recordings have different friction.
        assert 'predicted from the others' in together[-1]
        wrong += any(advised(one) for one in found) or len(together) > 1
    assert wrong <= 1


def test_pooled_recordings_reveal_a_drift_too_small_for_each_recording() -> None:
    drift = NoiseKind(truth={'force_drift': 2.5e-4}, duration=20.0)
    made = [recorded(drift, np.random.default_rng(seed))[0] for seed in range(20)]
    found = [identify_friction(one, among=len(made)) for one in made]
    alone = [one for one in found if advised(one)]
    assert len(alone) < 10
    # Only recordings without a significant drift of their own.
    others = [one for one in found if not advised(one)]
    assert 'add the term drift' in summarize(others).warnings[0]
    assert not alone or len(summarize(found).warnings) == 1


@pytest.mark.parametrize('number', [50, 152, 240, 252])
def test_two_terms_are_advised_only_if_each_is_needed(number: int) -> None:
    """Outliers of one sign are an offset: no second term explains them, also not beside it."""
    name = 'outliers of one sign'
    recording, _ = recorded(FURTHER[name].kind, np.random.default_rng([2014, number, 21]))
    assert set(advised(identify_friction(recording))) <= {'offset'}


@pytest.mark.parametrize('term', TERMS)
def test_noise_of_the_velocity_changes_the_columns_of_its_terms_alone(term: str) -> None:
    speed = np.array([-4e-4, -1e-5, 2e-5, 3e-4])
    depth, settings = np.cumsum(speed), FrictionSettings(terms=('layers',), layers=(0.0,))
    columns = [
        regressors(
            NeedleMotion(v, 0.0 * v, np.arange(4.0), depth, depth >= 0.0, np.sign(v)),
            [term],
            settings,
        )
        for v in (speed, 1.1 * speed)
    ]
    assert (columns[0] != columns[1]).any() == (term in OF_VELOCITY)
