# SPDX-License-Identifier: Apache-2.0
"""Needles in the lanes of vector registers: each equals a single simulation."""

from __future__ import annotations

from math import cos, exp, pi, sin
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters, simulate, simulate_batch
from needle_dynamics.compiled.friction import decay_means
from needle_dynamics.compiled.lane_functions import lane_decay_means, lane_sine_cosine
from needle_dynamics.compiled.lane_rows import LANES
from needle_dynamics.simulated.batch import Batch
import numpy as np
from numpy.testing import assert_allclose
import pytest

preset = NeedleParameters.preset
COUNT, INTERVAL = 6, 2e-3


def population(
    runs: int, seed: int = 3, modes: int = 2
) -> tuple[list[NeedleParameters], FloatArray, FloatArray]:
    """Return needles, states in motion and forces that push, hold and pull."""
    rng = np.random.default_rng(seed)
    # The modes cannot be distinguished above it; see `LARGEST_CONDITION`.
    least = {2: 1e-3, 3: 0.03, 4: 0.07}[modes]
    needles = [
        preset(
            ('paper_si', 'phantom')[i % 2],
            modes=modes,
            minimum_depth=least,
            length=rng.uniform(0.15, 0.25),
            tissue_stiffness=rng.uniform(0.0, 3000.0),
            tissue_damping=rng.choice([0.0, rng.uniform(0.0, 5.0)]),
            coulomb_friction=rng.uniform(0.0, 0.8),
            withdrawal_friction=rng.uniform(0.5, 1.5),
            carriage_mass=rng.choice([0.0, 0.1]),
            hub_stop=bool(i % 3),
            layer_depths=(0.05, 0.09) if i % 4 == 0 else (),
            layer_stiffnesses=(4e3, 500.0) if i % 4 == 0 else (),
            swelling=0.5 * (i % 5 == 0),
            swelling_time=0.01,
        )
        for i in range(runs)
    ]
    states = np.array(
        [NeedleModel(p).state_at(rng.uniform(0.02 + least, 0.14), rng.uniform(-1e-3, 1e-3))
         for p in needles]
    )  # fmt: skip
    states[:, 2 + modes] = rng.uniform(-0.5, 0.5, runs)
    states[:, 3 + modes] = rng.uniform(-1.0, 1.0, runs)
    states[:, 4 + modes :] = rng.uniform(-1e-4, 1e-4, (runs, modes))
    return needles, states, rng.uniform(-2.0, 4.0, (runs, COUNT))


def batch(*arguments: Any, **options: Any) -> Batch:
    options = {'duration': COUNT * INTERVAL, 'interval': INTERVAL, **options}
    return simulate_batch(*arguments, **options)


# Rounding, amplified by cond(G), in the phases of a thousand steps: cond(G) is 1e5 for two modes
# at 3 cm; more modes keep five digits, see `LARGEST_CONDITION`.
@pytest.mark.parametrize(('modes', 'tolerance'), [(2, 1e-7), (3, 1e-5), (4, 1e-5)])
@pytest.mark.parametrize('graded', [False, True])
def test_lane_equals_a_single_simulation(graded: bool, modes: int, tolerance: float) -> None:
    """Pushed, held and pulled, with and without hub, damping, layers and swelling."""
    needles, states, forces = population(60, modes=modes)
    found = batch(needles, states, forces, graded=graded)
    stuck = moved = 0
    for i, (p, start) in enumerate(zip(needles, states, strict=True)):
        whole = round(found.completed[i] / INTERVAL)
        assert whole > 0

        def force(time: float, course: FloatArray = forces[i]) -> float:
            return float(course[round(time / INTERVAL)])

        alone = simulate(
            p, start, force, duration=whole * INTERVAL, interval=INTERVAL, step=1e-5, graded=graded
        )
        scale = np.abs(alone.states).max(axis=0)
        assert_allclose(found.states[i, : whole + 1] / scale, alone.states / scale, atol=tolerance)
        stuck += bool((alone.velocity == 0.0).any())
        moved += bool((alone.velocity[1:] != 0.0).all())
    # Both cases must occur for a meaningful test.
    assert stuck > 5
    assert moved > 5


@pytest.mark.parametrize(('graded', 'modes'), [(False, 2), (True, 2), (True, 4)])
def test_result_is_independent_of_other_lanes_bit_for_bit(graded: bool, modes: int) -> None:
    needles, states, forces = population(3 * LANES + 5, modes=modes)
    found = batch(needles, states, forces, workers=1, graded=graded)
    some = np.random.default_rng(5).permutation(len(needles))[: LANES + 3]
    other = batch([needles[i] for i in some], states[some], forces[some], workers=2, graded=graded)
    assert np.array_equal(other.states, found.states[some], equal_nan=True)
    for i in (0, 1, 2):
        alone = batch(needles[i], states[i], forces[i : i + 1], graded=graded)
        assert np.array_equal(alone.states[0], found.states[i], equal_nan=True)


def test_lane_stops_on_the_hub_and_can_be_withdrawn() -> None:
    """A needle pushed to the hub rests there exactly, and is pulled out again."""
    p = preset('paper_si')
    start = NeedleModel(p).state_at(0.19, 1e-4)
    forces = np.array([[3.0] * 10 + [-3.0] * 4])
    found = batch(p, start, forces, duration=0.028, interval=2e-3)
    assert found.depth[0, 10] == p.length
    assert found.velocity[0, 10] == 0.0
    assert found.depth[0, -1] < p.length - 1e-3
    assert np.isfinite(found.states).all()


def test_lanes_are_of_second_order() -> None:
    """Half the step gives a quarter of the error."""
    p = preset('paper_si', tissue_damping=1.0)
    start = NeedleModel(p).state_at(0.08, 5e-4)

    def end(step: float) -> FloatArray:
        return batch(p, start, 3.0, duration=0.02, interval=0.02, step=step).states[0, -1]

    exact = end(1e-7)
    errors = [abs(end(step) - exact)[[0, 2]] for step in (4e-5, 2e-5)]
    # Rounding of 200,000 steps changes the depth by 1e-12 m, with an error of 4e-11 m.
    assert_allclose(errors[0] / errors[1], 4.0, rtol=0.03)


def test_torque_rotates_a_lane() -> None:
    """The angle matches a constant torque on the inertia in each interval."""
    p = preset('phantom')
    start = NeedleModel(p).state_at(0.05)
    torques = np.array([[1e-6, -2e-6]])
    found = batch(p, start, 0.0, torques, duration=0.02, interval=0.01).states[0]
    gains = 2.0 * torques[0] / p.rotary_inertia * 0.01
    assert_allclose(found[:, 5], [0.0, gains[0], gains.sum()], rtol=1e-14)
    angles = 0.005 * np.array([0.0, gains[0], 3.0 * gains[0] + gains[1]])
    assert_allclose(found[:, 1], angles, rtol=1e-14)


@given(st.floats(-1e6, 1e6))
def test_sine_and_cosine_match_the_library(x: float) -> None:
    """Up to the last digits, also of the argument."""
    found = lane_sine_cosine(x)
    assert_allclose(found, (sin(x), cos(x)), rtol=0, atol=4e-16 + abs(x) * 1e-22)


@given(st.floats(0.0, 200.0) | st.floats(0.0, 1e-3) | st.floats(1e2, 1e300))
@settings(max_examples=300)
def test_decay_means_match_the_friction_kernel(x: float) -> None:
    """Where the closed form loses digits, they match the series."""
    mean, ramp = lane_decay_means(x)
    exact, other = decay_means(x)
    assert_allclose(mean, exact, rtol=1e-13)
    # The reference is a difference over x, or a series truncated at 1e-13.
    assert_allclose(ramp, other, rtol=2e-13 + 3e-16 / max(x, 1e-4))
    assert_allclose(1.0 - x * mean, exp(-x), rtol=0, atol=1e-15)


def test_signs_at_quarter_turns() -> None:
    """At every multiple of a quarter turn, and next to it, the sign is correct."""
    for k in range(-9, 10):
        for off in (-1e-3, 0.0, 1e-3):
            x = 0.25 * pi * k + off
            assert_allclose(lane_sine_cosine(x), (sin(x), cos(x)), rtol=0, atol=4e-16)
