# SPDX-License-Identifier: Apache-2.0
"""Batch simulation: bitwise independent of the number of threads and equal to single runs."""

from __future__ import annotations

from typing import Any

from needle_dynamics import (
    FloatArray,
    InsertionDepthError,
    Integrator,
    NeedleError,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    ShapeError,
    simulate,
    simulate_batch,
)
from needle_dynamics.simulated.batch import Batch
from needle_dynamics.simulated.integrator import DEFAULT_STEP
import numpy as np
from numpy.testing import assert_allclose
import pytest

preset = NeedleParameters.preset
RUNS, COUNT, INTERVAL = 7, 12, 1e-3


def study(n: int = 2) -> tuple[list[NeedleParameters], FloatArray, FloatArray]:
    """Return constants, initial states and forces that differ in every run."""
    rng = np.random.default_rng(7)
    laws = ('coulomb', 'stribeck', 'tanh')
    constants = [
        preset(
            'paper_mm',
            modes=n,
            minimum_depth=1e-3 if n <= 2 else 0.05,
            tissue_stiffness=rng.uniform(300.0, 3000.0),
            tissue_damping=rng.uniform(0.0, 2.0),
            coulomb_friction=rng.uniform(0.2, 0.8),
            friction_law=laws[i % 3],
            breakaway_friction=1.3,
            swelling=0.3,
            swelling_time=0.01,
            layer_depths=[0.07 + 0.002 * i],
            layer_stiffnesses=[4e3],
            formulation=('complete', 'as_printed')[i % 2],
        )
        for i in range(RUNS)
    ]
    states = np.array(
        [
            NeedleModel(p).state_at(rng.uniform(0.06, 0.08), rng.uniform(-1e-3, 1e-3))
            for p in constants
        ]
    )
    return constants, states, rng.uniform(-1.0, 6.0, size=(RUNS, COUNT))


def batch(*arguments: Any, **options: Any) -> Batch:
    options = {'duration': COUNT * INTERVAL, 'interval': INTERVAL, **options}
    return simulate_batch(*arguments, **options)


@pytest.mark.parametrize('n', [1, 2, 4])
def test_bits_do_not_depend_on_the_number_of_workers(n: int) -> None:
    """One thread, two, three, or more than the number of runs."""
    arguments = study(n)
    first = batch(*arguments, workers=1)
    assert np.isfinite(first.states).all()
    assert np.ptp(first.states[:, -1, 0]) > 1e-3
    for workers in (2, 3, 20, None):
        other = batch(*arguments, workers=workers)
        assert np.array_equal(other.states, first.states)
        assert np.array_equal(other.completed, first.completed)


def assert_equal(found: FloatArray, exact: FloatArray, p: NeedleParameters) -> None:
    """Compare states: to the bit, except for needles that are computed together."""
    if p.formulation == 'as_printed':
        assert np.array_equal(found, exact)
        return
    # Rounding. With `tanh` it can change where a step is divided, by the error of such a part.
    # With four modes a change of 1e-15 of the first state becomes 5e-7, with `tanh` 2e-4.
    few, several = (1e-4, 1e-3) if p.friction_law == 'tanh' else (1e-10, 2e-5)
    tolerance = few if p.modes <= 2 else several
    scale = np.abs(exact).max(axis=0) + 1e-12
    assert_allclose(found / scale, exact / scale, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize('n', [1, 2, 4])
def test_batch_equals_single_simulations(n: int) -> None:
    """With all friction laws, in two layers that swell."""
    constants, states, forces = study(n)
    found = batch(constants, states, forces)
    for i in range(RUNS):
        course = forces[i]

        def force(time: float, course: FloatArray = course) -> float:
            return float(course[round(time / INTERVAL)])

        alone = simulate(
            constants[i],
            states[i],
            force,
            duration=COUNT * INTERVAL,
            interval=INTERVAL,
            step=DEFAULT_STEP,
        )
        assert_equal(found.states[i], alone.states, constants[i])
        assert np.array_equal(found.time, alone.time)
        assert_allclose(found.completed[i], COUNT * INTERVAL, rtol=1e-15)


@pytest.mark.parametrize('tolerance', [1e-3, 1e-6])
def test_tolerance_gives_the_samples_and_errors_of_single_runs(tolerance: float) -> None:
    """To the bit, for any number of workers; friction laws of several orders."""
    parameters = [preset('phantom', friction_law=law) for law in ('coulomb', 'stribeck')]
    states = np.array([NeedleModel(p).state_at(0.05, 5e-4) for p in parameters])
    options: Any = {'duration': 0.02, 'interval': 0.01, 'tolerance': tolerance}
    found = simulate_batch(parameters, states, 3.0, **options)
    for i, p in enumerate(parameters):
        alone = simulate(p, states[i], 3.0, **options)
        assert np.array_equal(found.states[i], alone.states)
        assert found.error[i] == alone.error <= tolerance
    last = simulate_batch(parameters, states, 3.0, keep=False, workers=1, **options)
    assert np.array_equal(last.states[:, 0], found.states[:, -1])
    assert np.array_equal(last.error, found.error)


def test_tolerance_with_torques_and_with_a_run_that_ends_early() -> None:
    """The rotation has no error; a run that leaves its range is compared up to there."""
    p = preset('phantom')
    states = np.array([NeedleModel(p).state_at(depth) for depth in (0.05, 1.5e-3)])
    options: Any = {'duration': 0.2, 'interval': 0.02}
    found = simulate_batch(p, states, -3.0, 1e-5, tolerance=1e-4, **options)
    with_step = simulate_batch(p, states, -3.0, 1e-5, step=1e-5, **options)
    assert_allclose(found.states[0, :, [1, 5]], with_step.states[0, :, [1, 5]], rtol=1e-12)
    assert found.states[0, -1, 1] > 0.0
    assert np.array_equal(found.completed, with_step.completed)
    assert found.completed[1] < 0.2
    assert np.isnan(found.states[1, -1]).all()
    assert (found.error <= 1e-4).all()
    assert np.isnan(with_step.error).all()


@pytest.mark.parametrize(
    ('options', 'complaint'),
    [
        ({'tolerance': 1e-4, 'step': 1e-5}, 'tolerance excludes step and graded'),
        ({'tolerance': 1e-4, 'graded': True}, 'tolerance excludes step and graded'),
        ({'tolerance': 0.0}, r'tolerance must be finite, >= 1e-11, got 0\.0'),
    ],
)
def test_invalid_tolerance_is_rejected(options: dict[str, Any], complaint: str) -> None:
    p = preset('phantom')
    with pytest.raises(ParameterError, match=f'^{complaint}$'):
        batch(p, NeedleModel(p).state_at(0.05), 3.0, **options)


def test_batch_equals_the_integrator_over_its_intervals() -> None:
    """The clock of the integrator is the sum of the intervals."""
    constants, states, forces = study()
    found = batch(constants, states, forces)
    for i in range(RUNS):
        it = Integrator(constants[i], states[i])
        reached = [it.state.copy()]
        for k in range(COUNT):
            it.advance(INTERVAL, forces[i, k])
            reached.append(it.state.copy())
        exact, p = np.array(reached), constants[i]
        if p.formulation == 'complete':
            assert_equal(found.states[i], exact, p)
        else:
            # The sum of intervals differs from a multiple in the last bit: so does the swelling.
            assert_allclose(found.states[i], exact, rtol=1e-9, atol=1e-15)


def test_single_values_apply_to_all_runs() -> None:
    """One set of constants, one state or one force is used for every run."""
    constants, states, forces = study()
    p, x = constants[0], states[0]
    assert batch(p, x, 3.0).states.shape == (1, COUNT + 1, 8)
    each = batch(p, x, forces)
    for i in range(RUNS):
        assert np.array_equal(each.states[i], batch(p, x, forces[i : i + 1]).states[0])
    level = batch(p, states, [1.0 + i for i in range(RUNS)])
    for i in range(RUNS):
        assert np.array_equal(level.states[i], batch(p, states[i], 1.0 + i).states[0])
    several = batch(constants, x, 3.0)
    for i in range(RUNS):
        assert np.array_equal(several.states[i], batch(constants[i], x, 3.0).states[0])


def test_keep_false_returns_only_the_final_state() -> None:
    arguments = study()
    every, last = batch(*arguments), batch(*arguments, keep=False)
    assert last.states.shape == (RUNS, 1, 8)
    assert np.array_equal(last.states[:, 0], every.states[:, -1])
    assert np.array_equal(last.time, every.time[-1:])
    assert np.array_equal(last.completed, every.completed)


@pytest.mark.parametrize('workers', [1, 2])
def test_run_outside_its_range_is_nan_without_effect_on_others(workers: int) -> None:
    """One run is pulled out of the tissue; its earlier samples and the other runs stay valid."""
    p = preset('paper_si')
    states = np.array([NeedleModel(p).state_at(s, 1e-5) for s in (0.05, 0.004, 0.06)])
    forces = np.array([3.0, -1.0, 2.0])
    found = batch(p, states, forces, workers=workers)
    with pytest.raises(InsertionDepthError):
        simulate(
            p, states[1], -1.0, duration=COUNT * INTERVAL, interval=INTERVAL, step=DEFAULT_STEP
        )
    valid = round(found.completed[1] / INTERVAL)
    assert 0 < valid < COUNT
    assert np.isfinite(found.states[1, : valid + 1]).all()
    assert np.isnan(found.states[1, valid + 1 :]).all()
    alone = simulate(
        p, states[1], -1.0, duration=valid * INTERVAL, interval=INTERVAL, step=DEFAULT_STEP
    )
    # At 4 mm cond(G) is 1e9: only depth and velocity have sufficient accuracy.
    assert_allclose(found.depth[1, : valid + 1], alone.depth, rtol=1e-6)
    for i in (0, 2):
        single = batch(p, states[i], forces[i])
        assert np.array_equal(found.states[i], single.states[0])
        assert_allclose(found.completed[i], COUNT * INTERVAL, rtol=1e-15)


def test_final_state_of_an_incomplete_run_is_nan() -> None:
    p = preset('paper_si')
    states = np.array([NeedleModel(p).state_at(s, 1e-5) for s in (0.05, 0.004)])
    found = batch(p, states, [3.0, -1.0], keep=False)
    assert np.isfinite(found.states[0]).all()
    assert np.isnan(found.states[1]).all()
    assert 0.0 < found.completed[1] < COUNT * INTERVAL


def test_arguments_are_not_modified() -> None:
    """Initial states and forces are not changed."""
    constants, states, forces = study()
    before = states.copy(), forces.copy()
    batch(constants, states, forces)
    batch(constants, states, forces, keep=False)
    assert np.array_equal(states, before[0])
    assert np.array_equal(forces, before[1])


@pytest.mark.parametrize(
    ('which', 'shape'),
    [
        ('states', (RUNS - 1, 8)),
        ('states', (0, 8)),
        ('states', (RUNS, 7)),
        ('states', (7,)),
        ('states', (RUNS, 1, 8)),
        ('forces', (RUNS - 1,)),
        ('forces', (RUNS, COUNT - 1)),
        ('forces', (RUNS, COUNT, 1)),
        ('forces', (0,)),
        ('constants', (RUNS - 1,)),
        ('constants', (0,)),
    ],
)
def test_inconsistent_shapes_are_rejected(which: str, shape: tuple[int, ...]) -> None:
    """Numbers of runs, intervals and coordinates must agree; the message has the shapes."""
    constants, states, forces = study()
    arguments: dict[str, Any] = {'constants': constants, 'states': states, 'forces': forces}
    arguments[which] = constants[: shape[0]] if which == 'constants' else np.full(shape, 0.1)
    with pytest.raises(ShapeError, match='got'):
        batch(*arguments.values())


@pytest.mark.parametrize('empty', ['constants', 'states', 'forces'])
def test_empty_batches_are_rejected(empty: str) -> None:
    p = preset('paper_si')
    arguments: dict[str, Any] = {
        'constants': p,
        'states': NeedleModel(p).state_at(0.05),
        'forces': 3.0,
    }
    arguments[empty] = np.empty((0, 8)) if empty == 'states' else []
    with pytest.raises(ShapeError, match='got'):
        batch(*arguments.values())


@pytest.mark.parametrize(
    'options',
    [
        {'step': 0.0},
        {'step': np.nan},
        {'interval': 0.0},
        {'interval': -1e-3},
        {'interval': np.nan},
        {'duration': np.inf},
        {'duration': 0.5e-3},
        {'workers': 0},
        {'workers': -1},
    ],
)
def test_invalid_options_are_rejected(options: dict[str, float]) -> None:
    """Step, interval, duration and workers are checked before the simulation."""
    with pytest.raises(ParameterError):
        batch(*study(), **options)


@pytest.mark.parametrize('interval', [0.7e-3, 0.6e-3])
def test_duration_must_be_a_whole_number_of_intervals(interval: float) -> None:
    p = preset('paper_si')
    start = NeedleModel(p).state_at(0.05)
    for call in (simulate, simulate_batch):
        with pytest.raises(ParameterError, match='whole number of intervals'):
            call(p, start, 0.0, duration=1e-3, interval=interval)


def test_non_finite_values_are_rejected() -> None:
    """Forces and states are checked before the simulation, also against the range."""
    constants, states, forces = study()
    for bad in (np.nan, np.inf):
        wrong = forces.copy()
        wrong[3, 4] = bad
        with pytest.raises(ParameterError, match='forces must be finite'):
            batch(constants, states, wrong)
        wrong = states.copy()
        wrong[3, 4] = bad
        with pytest.raises(ParameterError, match='must be finite'):
            batch(constants, wrong, forces)
    wrong = states.copy()
    wrong[3, 0] = 0.2
    with pytest.raises(InsertionDepthError):
        batch(constants, wrong, forces)


def test_runs_of_one_batch_share_their_number_of_modes() -> None:
    """The states of a batch have a single length."""
    constants, states, forces = study()
    constants[2] = preset('paper_si', modes=1)
    with pytest.raises(NeedleError, match=r'must have shape \(6,\), got \(8,\)'):
        batch(constants, states, forces)
