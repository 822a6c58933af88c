# SPDX-License-Identifier: Apache-2.0
"""Error estimate of `simulate` over depths, forces, modes, tissues and friction laws."""

from __future__ import annotations

from typing import Any

from benchmarks.honesty import difference
from needle_dynamics import (
    InsertionDepthError,
    Integrator,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    simulate,
    ToleranceError,
    Trajectory,
)
from needle_dynamics.simulated.trajectory import (
    DEFAULT_SAMPLES,
    DEFAULT_TOLERANCE,
    ORDERS,
    refined,
)
import numpy as np
import pytest

preset = NeedleParameters.preset

LAYERS = {'layer_depths': (0.03, 0.06), 'layer_stiffnesses': (2000.0, 100.0)}
STRIBECK = {'friction_law': 'stribeck', 'breakaway_friction': 1.5, 'stribeck_speed': 0.5}

#: Preset and changes, initial insertion depth and deflection [m], force [N], duration and
#: interval [s].
CASES: dict[str, tuple[str, dict[str, Any], float, float, float, float, float | None]] = {
    'phantom': ('phantom', {}, 0.02, 5e-4, 3.0, 1.0, None),
    'phantom, 5 mm': ('phantom', {}, 0.005, 5e-5, 3.0, 0.1, None),
    'phantom, 10 cm': ('phantom', {}, 0.1, 2e-3, 3.0, 1.0, None),
    'phantom, to the hub': ('phantom', {}, 0.19, 5e-3, 5.0, 1.0, None),
    'phantom, 15 N': ('phantom', {}, 0.02, 5e-4, 15.0, 1.0, None),
    'phantom, withdrawn': ('phantom', {}, 0.1, 2e-3, -3.0, 1.0, None),
    'phantom, held': ('phantom', {}, 0.05, 1e-3, 0.3, 1.0, None),
    'phantom, sampled rarely': ('phantom', {}, 0.02, 5e-4, 3.0, 0.5, 0.05),
    'phantom, sampled often': ('phantom', {}, 0.02, 5e-4, 3.0, 0.05, 1e-5),
    'phantom, layers': ('phantom', LAYERS, 0.02, 5e-4, 5.0, 1.0, None),
    'phantom, swelling': (
        'phantom', {'swelling': 0.5, 'swelling_time': 0.05}, 0.1, 2e-3, 3.0, 0.5, None,
    ),
    'phantom, carriage': ('phantom', {'carriage_mass': 0.5}, 0.02, 5e-4, 3.0, 0.5, None),
    'phantom, overdamped': ('phantom', {'tissue_damping': 100.0}, 0.1, 5e-3, 3.0, 0.3, None),
    'phantom, three modes': (
        'phantom', {'modes': 3, 'minimum_depth': 0.0195}, 0.02, 5e-4, 3.0, 0.2, None,
    ),
    'paper_si': ('paper_si', {}, 0.02, 5e-4, 3.0, 0.035, None),
    'paper_si, 5 mm': ('paper_si', {}, 0.005, 5e-5, 3.0, 0.02, None),
    'paper_si, 1 N': ('paper_si', {}, 0.05, 1e-3, 1.0, 0.05, None),
    'paper_si, one mode': ('paper_si', {'modes': 1}, 0.02, 5e-4, 3.0, 0.03, None),
    'paper_si, four modes': (
        'paper_si', {'modes': 4, 'minimum_depth': 0.0457}, 0.05, 1e-3, 3.0, 0.02, None,
    ),
    'paper_si, layers': ('paper_si', LAYERS, 0.02, 5e-4, 3.0, 0.03, None),
    'paper_si, stribeck': ('paper_si', STRIBECK, 0.05, 1e-3, 2.0, 0.03, None),
    'paper_si, as printed': (
        'paper_si', {'formulation': 'as_printed'}, 0.02, 5e-4, 3.0, 0.02, None,
    ),
    'paper_mm': ('paper_mm', {}, 0.02, 5e-4, 3.0, 0.3, None),
    'paper_mm, 10 cm': ('paper_mm', {}, 0.1, 2e-3, 3.0, 1.0, None),
    'paper_mm, tanh': ('paper_mm', {'friction_law': 'tanh'}, 0.05, 1e-3, 2.0, 0.3, None),
}  # fmt: skip


def go(name: str, **options: Any) -> Trajectory:
    """Return the run of a case."""
    kind, changes, depth, tip, force, duration, interval = CASES[name]
    parameters = preset(kind, **changes)
    start = NeedleModel(parameters).state_at(depth, tip)
    return simulate(parameters, start, force, duration=duration, interval=interval, **options)


@pytest.mark.parametrize('name', CASES)
def test_default_run_meets_its_error_estimate(name: str) -> None:
    """
    The true error is below the tolerance and below the estimate of the run.

    The reference has even steps of an eighth of the shortest step, with at most a 64th of the
    error: these steps are short everywhere.
    """
    run = go(name)
    assert 0.0 < run.error <= DEFAULT_TOLERANCE
    fine = go(name, step=float(run.steps.min()) / 8.0)
    assert np.isnan(fine.error)
    # At second order a third of the estimate; measured 0.02 to 0.34 of it, and 0.75 where few
    # samples resolve the vibration.
    assert difference(run, fine) < run.error


@pytest.mark.parametrize('preset_name', ['paper_si', 'phantom'])
@pytest.mark.parametrize('speed', [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize('tip', [1e-4, 1e-3])
def test_error_includes_the_time_scale_of_friction(
    preset_name: str, speed: float, tip: float
) -> None:
    """
    Static friction decreases to Coulomb friction within a small part of a step.

    The reference has even steps, of a fiftieth of the time in which friction changes the velocity
    by `stribeck_speed`, or of an eighth of the shortest step.
    """
    p = preset(preset_name, friction_law='stribeck', breakaway_friction=1.5, stribeck_speed=speed)
    start = NeedleModel(p).state_at(0.05, tip)
    run = simulate(p, start, 2.0, duration=0.03)
    scale = p.moving_mass * speed / (0.5 * p.coulomb_friction)
    step = min(float(run.steps.min()) / 8.0, scale / 50.0)
    fine = simulate(p, start, 2.0, duration=0.03, step=step)
    # The error of the reference is of second order in the ratio of the steps: 1/64 of the error.
    assert difference(run, fine) < 1.02 * run.error


@pytest.mark.parametrize('name', ['phantom', 'paper_si, layers', 'phantom, sampled often'])
def test_smaller_tolerances_are_met(name: str) -> None:
    fine = go(name, tolerance=1e-8)
    assert fine.error <= 1e-8
    for tolerance in (1e-2, 1e-4, 1e-6):
        run = go(name, tolerance=tolerance)
        assert run.error <= tolerance
        assert difference(run, fine) < run.error + 1e-8


def test_default_run_needs_few_steps() -> None:
    """Default preset: fewer than one step per 30 us, 100 times real time at 0.3 us per step."""
    for name in ('phantom', 'phantom, 10 cm', 'phantom, 15 N', 'phantom, withdrawn'):
        run = go(name)
        interval = run.time[1]
        # Each previous run takes half as many steps as the next.
        assert 2.0 * (interval / run.steps).sum() < run.time[-1] / 30e-6
        assert len(run.time) == DEFAULT_SAMPLES + 1


def test_steps_become_longer_as_the_vibration_fades() -> None:
    """Step length follows the root of the amplitude, with at least two steps per interval."""
    run = go('phantom', tolerance=1e-2)
    early, late = run.steps[run.time[:-1] < 1e-3], run.steps[run.time[:-1] > 0.5]
    assert late.min() >= 20.0 * early.min()
    assert np.isclose(late, 0.5 * run.time[1]).all()


@pytest.mark.parametrize('order', ORDERS)
@pytest.mark.parametrize('changes', [{}, {'tissue_damping': 1.6}, {'carriage_mass': 0.01}])
def test_error_decreases_with_the_order(changes: dict[str, Any], order: int) -> None:
    """A needle in motion, without start, stop and border of layers."""
    p = preset('paper_si', **changes)
    start = NeedleModel(p).state_at(0.025, 5e-4)
    # Insertion at 0.5 m/s.
    start[start.size // 2] = -0.5
    # It ends before the hub.
    options: Any = {'duration': 0.024, 'interval': 2.4e-4}
    fine = simulate(p, start, 3.0, step=3e-6, order=8, **options)
    errors = [
        difference(simulate(p, start, 3.0, step=step, order=order, **options), fine)
        for step in (4.8e-5, 2.4e-5)
    ]
    # The smaller error of order 8 is 3e-9 or more; with shorter steps rounding dominates.
    assert np.log2(errors[0] / errors[1]) > order - 0.3


@pytest.mark.parametrize('order', ORDERS)
def test_needle_held_by_friction_does_not_move_at_any_order(order: int) -> None:
    """Extrapolated depths and velocities are exact at rest, while the modes vibrate."""
    run = go('phantom, held', step=2e-5, order=order)
    assert (run.states[:, 0] == run.states[0, 0]).all()
    assert (run.velocity == 0.0).all()


@pytest.mark.parametrize(
    'name', ['phantom', 'phantom, layers', 'paper_si, 1 N', 'phantom, to the hub']
)
def test_small_error_is_not_below_the_true_error(name: str) -> None:
    """
    The needle starts, crosses layers, reverses and stops: there the extrapolation has order 2.

    The reference has even steps of order 2, of a 64th of the shortest step of the default run,
    with a 4096th of its error.
    """
    run, default = go(name, tolerance=1e-5), go(name)
    assert run.order > 2
    fine = go(name, step=float(default.steps.min()) / 64.0)
    assert difference(run, fine) < run.error + default.error / 4096.0


@pytest.mark.parametrize('tolerance', [None, 1e-6])
def test_dense_output_has_the_accuracy_of_the_samples(tolerance: float | None) -> None:
    run = go('paper_si', tolerance=tolerance)
    fine = go('paper_si', step=float(run.steps.min()) / 8.0, order=run.order)
    model = NeedleModel(run.parameters)
    peak = np.abs(run.tip_deflection).max()
    for time in np.random.default_rng(1).uniform(0.0, run.time[-1], size=50):
        tips = [model.tip_deflection(one.at(time)) for one in (run, fine)]
        assert abs(tips[0] - tips[1]) < run.error * peak


def test_end_of_the_open_loop_run_equals_an_independent_solution() -> None:
    """
    Depth coordinate and tip after 28 ms with 3 N, from 0.5 mm of tip deflection in the first mode.

    The values are those of the same equations in C with long double. Two runs of a method of
    second order, extrapolated to a step of zero, have an error of fourth order.
    """
    p = preset('paper_si')
    model = NeedleModel(p)
    start = model.state_at(0.02, modal=(5e-4 / model.modes.values(0.02)[0], 0.0))
    ends = []
    for step in (4e-7, 2e-7):
        it = Integrator(p, start, step)
        it.advance(0.028, 3.0)
        ends.append(it.state)
    end = ends[1] + (ends[1] - ends[0]) / 3.0
    # Relative: the reference has 11 and 10 digits.
    np.testing.assert_allclose(end[0], 0.0046074357713, rtol=1e-9)
    np.testing.assert_allclose(model.tip_deflection(end), 0.8529611285e-3, rtol=1e-9)


def test_given_step_matches_the_integrator_bit_for_bit() -> None:
    for graded in (False, True):
        run = go('phantom, 10 cm', step=2e-5, graded=graded)
        it = Integrator(run.parameters, run.states[0], 2e-5, graded=graded)
        interval = float(run.time[1])
        for k in range(20):
            it.time = float(run.time[k])
            it.advance(interval, 3.0)
            assert np.array_equal(it.state, run.states[k + 1])


def test_tolerance_below_rounding_is_rejected() -> None:
    """Without a run; a larger tolerance that a run cannot meet is named with the best."""
    p = preset('paper_si')
    start = NeedleModel(p).state_at(0.05, 1e-3)
    with pytest.raises(ParameterError, match='tolerance must be finite, >= 1e-11, got 1e-15'):
        simulate(p, start, 3.0, duration=1e-3, interval=1e-3, tolerance=1e-15)
    with pytest.raises(ToleranceError, match=r'tolerance 1e-15 cannot be met .*; the best is'):
        refined(NeedleModel(p), start, np.array([3.0]), np.zeros(1), 1e-3, 1e-15)


def test_too_many_intervals_are_rejected() -> None:
    """Before the memory of the samples is requested."""
    p = preset('phantom')
    start = NeedleModel(p).state_at(0.05, 1e-3)
    with pytest.raises(ParameterError, match=r'duration must be at most 1e\+07 intervals'):
        simulate(p, start, 3.0, duration=9.0, interval=1e-7)


def test_leaving_the_depth_range_raises_the_error_of_the_integrator() -> None:
    p = preset('paper_si')
    start = NeedleModel(p).state_at(0.004, 1e-5)
    for step in (None, 1e-5):
        with pytest.raises(InsertionDepthError, match=r'reached minimum_depth = 0\.001 m while'):
            simulate(p, start, -2.0, duration=0.02, interval=1e-3, step=step)


@pytest.mark.parametrize(
    ('options', 'complaint'),
    [
        ({'tolerance': 1e-3, 'step': 1e-5}, 'tolerance and step exclude each other'),
        ({'tolerance': 0.0}, 'tolerance must be finite, >= 1e-11'),
        ({'graded': True}, 'graded and order require a step'),
        ({'order': 4}, 'graded and order require a step'),
        ({'step': 1e-5, 'order': 3}, 'order must be one of 2, 4, 6, 8, got 3'),
        ({'step': 1e-5, 'order': 4.0}, r'order must be one of 2, 4, 6, 8, got 4\.0'),
        ({'step': 1e-5, 'order': 4, 'law': 'tanh'}, 'order must be 2 unless friction_law is coul'),
        ({'force': lambda _: 3.0}, 'interval must be given with a force that is a function'),
    ],
)
def test_contradictory_options_are_rejected(options: dict[str, Any], complaint: str) -> None:
    words = {'force': 3.0, 'duration': 0.1, **options}
    p = preset('phantom', friction_law=words.pop('law', 'coulomb'))
    with pytest.raises(ParameterError, match=complaint):
        simulate(p, NeedleModel(p).state_at(0.05), **words)
