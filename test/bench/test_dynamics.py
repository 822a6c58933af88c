# SPDX-License-Identifier: Apache-2.0
"""Benchmark of the dynamics: equality of the compared models; times are not tested."""

from __future__ import annotations

from collections.abc import Iterator
from math import log1p, sin, sqrt
from pathlib import Path
from typing import Any

from benchmarks import batches, rods, solvers, step
from benchmarks.measure import least_times, NOT_INSTALLED
from benchmarks.solvers import OpenLoopCase
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters
import numba
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.integrate import solve_bvp

FORCE = 3.0


@pytest.fixture(scope='module')
def open_loop() -> OpenLoopCase:
    return solvers.OpenLoopCase()


def states() -> Iterator[FloatArray]:
    """States at increasing depths: moving, withdrawing, and at rest under a sufficient force."""
    random = np.random.default_rng(3)
    for depth, speed in ((0.02, 1.0), (0.1, 8.0), (0.199, -0.5), (0.07, 0.0)):
        modal = 1e-5 * random.standard_normal(2)
        rates = 1e-2 * random.standard_normal(2)
        yield np.array([0.2 - depth, 0.1, *modal, -speed, 0.3, *rates])


@pytest.mark.parametrize('state', list(states()))
@pytest.mark.parametrize('preset', ['paper_si', 'phantom'])
@pytest.mark.parametrize('how', ['compiled', 'gauss', 'quad'])
def test_all_solvers_use_model_equations(state: FloatArray, preset: str, how: str) -> None:
    model = NeedleModel(NeedleParameters.preset(preset))
    if how == 'compiled':
        right_hand_side = solvers.compiled_right_hand_side(model, FORCE)
    else:
        right_hand_side = solvers.user_right_hand_side(model, FORCE, adaptive=how == 'quad')
    exact = model.derivative(state, FORCE)
    # Quadrature of the shapes in sin and sinh loses some nine digits of the accelerations at
    # small depth, relative to the largest.
    scale = np.abs(exact).max()
    assert_allclose(right_hand_side(0.0, state), exact, rtol=0.0, atol=1e-6 * scale)
    if how == 'compiled':
        assert_allclose(right_hand_side(0.0, state), exact, rtol=1e-9, atol=1e-12)


def test_force_below_friction_causes_no_motion_in_any_solver() -> None:
    model = NeedleModel(NeedleParameters.preset('paper_si'))
    state = model.state_at(0.1, 0.0)
    for right_hand_side in (
        solvers.compiled_right_hand_side(model, 0.5),
        solvers.user_right_hand_side(model, 0.5),
    ):
        assert_allclose(right_hand_side(0.0, state), np.zeros(8), atol=1e-15)


def test_run_error_is_relative_tip_error(open_loop: OpenLoopCase) -> None:
    run = open_loop.solve('DOP853', 1e-8, np.full(8, 1e-12), open_loop.right_hand_side)
    assert open_loop.error(run.t, run.y) < 1e-6
    wrong = run.y.copy()
    wrong[2:4] *= 1.01
    assert open_loop.error(run.t, wrong) == pytest.approx(0.01, rel=0.05)
    # An incomplete run has an infinite error.
    assert open_loop.error(run.t[:-1], run.y[:, :-1]) == np.inf


@pytest.mark.parametrize('name', solvers.ONE_CALL)
def test_timed_run_of_a_solver_is_complete(name: str) -> None:
    """To the end, with the state of the run whose error is judged; diffrax if it is installed."""
    case = solvers.OpenLoopCase('paper_mm')
    relative, absolute = 1e-9, 1e-9 * case._peaks
    judged = case.solve(name, relative, absolute, case.right_hand_side)
    assert case.error(judged.t, judged.y) < 1e-6
    # 81,000 calls of the right-hand side by LSODA: more than its usual limits.
    timed = case.solve(name, relative, absolute, case.right_hand_side, steps=False)
    # LSODA ends its steps at the samples: 5e-8 of the peaks found.
    assert (np.abs(timed.y[:, -1] - judged.y[:, -1]) <= 1e-6 * case._peaks).all()


def test_right_hand_side_accepts_states_outside_range(open_loop: OpenLoopCase) -> None:
    beyond = open_loop.start.copy()
    for remaining in (-1.0, 0.3, np.nan):
        beyond[0] = remaining
        assert open_loop.right_hand_side(0.0, beyond).shape == (8,)


def test_integrator_meets_accuracy_of_timing(
    open_loop: OpenLoopCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A coarser grid of run times is sufficient.
    monkeypatch.setattr(solvers, '_GRID', 8.0 * solvers._GRID)
    ours = open_loop.ours(graded=True)
    assert ours.error <= solvers.ACCURACY
    assert 0 < ours.evaluations < open_loop.steps(2e-5, graded=False)


def test_steps_are_counted(open_loop: OpenLoopCase) -> None:
    assert open_loop.steps(solvers.DURATION / 300, graded=False) == 300


def test_batches_are_independent_of_threads_and_store_states_on_request() -> None:
    many = batches.Batches(40)
    ends = [many.run(workers).states for workers in (1, 2)]
    assert np.array_equal(ends[0], ends[1])
    # Each insertion has different friction.
    assert len(np.unique(ends[0], axis=0)) == 40
    short, long = (many.peak_memory(part, keep=False) for part in (0.1, 1.0))
    kept = many.peak_memory(1.0, keep=True)
    # Only arrays of all insertions together grow with the samples, by 3 % of the kept states.
    assert long - short < 0.1 * (kept - short)


def test_exact_frequency_solves_beam_equation() -> None:
    stiffness, density, foundation, length = 0.0256, 0.01016, 520.0, 0.15

    def beam(y: FloatArray, w: FloatArray, unknown: FloatArray) -> FloatArray:
        # E I w'''' = (rho A omega^2 - k) w, in y / l.
        load = (density * unknown[0] - foundation) * length**4 / stiffness
        return np.vstack([w[1], w[2], w[3], load * w[0]])

    def ends(left: FloatArray, right: FloatArray, _unknown: FloatArray) -> FloatArray:
        return np.array([left[0], left[1], right[2], right[3], right[0] - 1.0])

    y = np.linspace(0.0, 1.0, 41)
    guess = np.vstack([y**2, 2.0 * y, 2.0 + 0.0 * y, 0.0 * y])
    solution = solve_bvp(beam, ends, y, guess, p=[1e5], tol=1e-8)
    assert solution.success
    found = rods.beam_frequency(length, stiffness, density, foundation)
    assert (2.0 * np.pi * found) ** 2 == pytest.approx(solution.p[0], rel=1e-6)


def test_frequency_without_tissue_equals_textbook_value() -> None:
    # 1.875104... is the first root of cos x cosh x = -1.
    found = rods.beam_frequency(0.2, 2.0, 0.5)
    assert found == pytest.approx(1.8751040687**2 / 0.04 * 2.0 / (2.0 * np.pi), rel=1e-9)


def test_frequency_of_sinusoid_is_measured_with_harmonics() -> None:
    time = np.linspace(0.0, 0.1, 301)
    values = np.cos(250.0 * time + 0.4) + 0.05 * np.sin(1600.0 * time) + 3.0
    found = rods.measured_frequency(time, values, 38.0)
    assert found == pytest.approx(250.0 / (2.0 * np.pi), rel=2e-3)


@pytest.mark.parametrize('interval', [1e-3, 1e-5])
def test_two_mode_frequency_is_within_percent_of_beam_at_15_cm(interval: float) -> None:
    assert abs(rods.needle(interval).error) < rods.FREQUENCY_ERROR
    error = rods.mode_error(NeedleModel(NeedleParameters.preset('paper_si')))
    # An upper bound, by Rayleigh.
    assert 0.0 < error < rods.FREQUENCY_ERROR


@numba.njit
def _helper(x: Any) -> Any:
    return log1p(x) * x


@numba.njit
def two_modes(x: Any) -> Any:
    return x * x + 1.0


@numba.njit
def _arithmetic(x: Any, values: Any, n: Any) -> Any:
    total = 0.0
    for i in range(n):
        total += values[i] * x
    if total > 0.0:
        values[0] = -abs(sqrt(two_modes(x)) / x)
    scratch = np.empty(2)
    scratch[:] = x
    rest = scratch[1:].copy()
    rest[0] *= x
    return _helper(sin(total)) - 2.0 * x


def test_executed_operations_are_counted() -> None:
    values = np.array([1.0, 2.0, 3.0])
    counts = step.count_operations(_arithmetic, (2.0, values, 3))
    assert dict(counts) == {
        'add': 4,
        'multiply': 6,
        'series multiply': 1,
        'series add': 1,
        'square root': 1,
        'divide': 1,
        'sine': 1,
        'log1p': 1,
    }
    assert_allclose(values, [1.0, 2.0, 3.0])


def test_operations_are_grouped_by_timed_kind() -> None:
    counts = step.operations_of_a_step(20)
    groups = step.grouped(counts)
    # Rotation of two modes: a sine and a cosine each; motion of the axis: one exponential.
    assert groups['sine and cosine'] == 2
    assert groups['expm1'] == 1
    assert 'log1p' not in groups
    assert groups['multiply-add, series'] == counts['series multiply']
    # Including the division in the function with the series.
    assert groups['division'] == counts['divide'] + counts['series divide']


def test_missing_tools_are_reported_and_other_rods_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rods, 'optional', lambda _name: None)
    monkeypatch.setattr(rods, 'least_times', lambda jobs, _repeats: least_times(jobs, 1))
    [section], bars = rods.compare(lambda _stage: None)
    assert str(section).count(NOT_INSTALLED) == 2
    assert [bar.found is None for bar in bars] == [True, True, False]


def test_mujoco_cable_converges_to_beam() -> None:
    mujoco = pytest.importorskip('mujoco')
    libraries = list((Path(mujoco.__file__).parent / 'plugin').glob('*elasticity*'))
    for library in libraries:
        mujoco.mj_loadPluginLibrary(str(library))
    _, _, _, exact = rods._section()
    errors = []
    for elements in (5, 8):
        cable = rods._Cable(
            mujoco, plugin=bool(libraries), elements=elements, how='Euler', step=2e-5
        )
        found = rods.measured_frequency(*cable.sample(4.0 / exact), exact)
        errors.append(abs(found / exact - 1.0))
    # Clamp at the middle of an element: second order.
    assert errors[1] < 0.6 * errors[0] < 0.012


def test_pyelastica_rod_is_near_beam() -> None:
    elastica = pytest.importorskip('elastica')
    _, _, _, exact = rods._section()
    rod = rods._Rod(elastica, 'PositionVerlet', 5, 1.9e-7)
    time, tips = rod.sample(0.3 / exact)
    # First peak after a quarter of a period: sufficient to detect a wrong section or clamp.
    assert 1.0 / (4.0 * time[tips.argmax()]) == pytest.approx(exact, rel=0.03)
