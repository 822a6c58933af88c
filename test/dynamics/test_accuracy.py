"""What `simulate` says of its error holds, over depths, forces, modes, tissues and frictions."""

from __future__ import annotations

from typing import Any

from needle_dynamics import (
    InsertedLengthError,
    Integrator,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    simulate,
    ToleranceError,
    Trajectory,
)
from needle_dynamics.simulated.trajectory import DEFAULT_SAMPLES, DEFAULT_TOLERANCE
import numpy as np
import pytest

preset = NeedleParameters.preset

LAYERS = {'layer_depths': (0.03, 0.06), 'layer_stiffnesses': (2000.0, 100.0)}
STRIBECK = {'friction_law': 'stribeck', 'breakaway_friction': 1.5, 'stribeck_speed': 0.5}

#: Preset and changes, inserted length and deflection at the start [m], force [N], duration and
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


def apart(one: Trajectory, exact: Trajectory) -> float:
    """Return how far a run is from another one: of the peak of the tip, and of the way."""
    tips, depths = exact.tip_deflection, exact.depth
    # The floor of the way is that of `Trajectory.error`.
    way = max(np.abs(depths - depths[0]).max(), 1e-4 * exact.parameters.length)
    tip = np.abs(one.tip_deflection - tips).max() / np.abs(tips).max()
    return float(max(tip, np.abs(one.depth - depths).max() / way))


@pytest.mark.parametrize('name', CASES)
def test_the_default_is_as_good_as_it_says(name: str) -> None:
    """
    The error is below the tolerance, and below what the run says of itself.

    It is found by even steps of an eighth of the shortest step, which have a 64th of its error or
    less: they are also that short where the run's are long.
    """
    run = go(name)
    assert 0.0 < run.error <= DEFAULT_TOLERANCE
    fine = go(name, step=float(run.steps.min()) / 8.0)
    assert np.isnan(fine.error)
    # At second order a third of what it says; measured 0.02 to 0.34 of it, and 0.75 where few
    # samples see the vibration.
    assert apart(run, fine) < run.error


@pytest.mark.parametrize('name', ['phantom', 'paper_si, layers', 'phantom, sampled often'])
def test_a_smaller_tolerance_is_met_too(name: str) -> None:
    fine = go(name, tolerance=1e-8)
    assert fine.error <= 1e-8
    for tolerance in (1e-2, 1e-4, 1e-6):
        run = go(name, tolerance=tolerance)
        assert run.error <= tolerance
        assert apart(run, fine) < run.error + 1e-8


def test_a_first_call_takes_few_steps() -> None:
    """On the default preset, less than one in 30 us: at 0.3 us each, 100 times real time."""
    for name in ('phantom', 'phantom, 10 cm', 'phantom, 15 N', 'phantom, withdrawn'):
        run = go(name)
        interval = run.time[1]
        # Each run before takes half as many as the one after it.
        assert 2.0 * (interval / run.steps).sum() < run.time[-1] / 30e-6
        assert len(run.time) == DEFAULT_SAMPLES + 1


def test_steps_become_longer_as_the_vibration_fades() -> None:
    """With the root of its amplitude, down to two in an interval."""
    run = go('phantom', tolerance=1e-2)
    early, late = run.steps[run.time[:-1] < 1e-3], run.steps[run.time[:-1] > 0.5]
    assert late.min() >= 20.0 * early.min()
    assert np.isclose(late, 0.5 * run.time[1]).all()


def test_dense_output_goes_on_with_the_steps_of_the_run() -> None:
    """Between samples it is as near to a finer run as the samples are."""
    run = go('paper_si')
    fine = go('paper_si', step=float(run.steps.min()) / 8.0)
    model = NeedleModel(run.parameters)
    peak = np.abs(run.tip_deflection).max()
    for time in np.random.default_rng(1).uniform(0.0, run.time[-1], size=50):
        tips = [model.tip_deflection(one.at(time)) for one in (run, fine)]
        assert abs(tips[0] - tips[1]) < run.error * peak


def test_a_given_step_is_taken_as_it_is() -> None:
    """Bit for bit as the integrator does, also graded."""
    for graded in (False, True):
        run = go('phantom, 10 cm', step=2e-5, graded=graded)
        it = Integrator(run.parameters, run.states[0], 2e-5, graded=graded)
        interval = float(run.time[1])
        for k in range(20):
            it.time = float(run.time[k])
            it.advance(interval, 3.0)
            assert np.array_equal(it.state, run.states[k + 1])


def test_a_tolerance_below_rounding_is_refused() -> None:
    """Saying what can be had."""
    p = preset('paper_si')
    start = NeedleModel(p).state_at(0.05, 1e-3)
    with pytest.raises(ToleranceError, match=r'tolerance 1e-15 cannot be met .*; the best is'):
        simulate(p, start, 3.0, duration=1e-3, interval=1e-3, tolerance=1e-15)


def test_a_needle_that_leaves_its_range_says_so_as_the_integrator_does() -> None:
    p = preset('paper_si')
    start = NeedleModel(p).state_at(0.004, 1e-5)
    for step in (None, 1e-5):
        with pytest.raises(InsertedLengthError, match=r'reached minimum_depth = 0\.001 m while'):
            simulate(p, start, -2.0, duration=0.02, interval=1e-3, step=step)


@pytest.mark.parametrize(
    ('options', 'complaint'),
    [
        ({'tolerance': 1e-3, 'step': 1e-5}, 'tolerance and step exclude each other'),
        ({'tolerance': 0.0}, 'tolerance must be positive and finite'),
        ({'graded': True}, 'graded is for a given step'),
        ({'force': lambda _: 3.0}, 'interval must be given with a force that is a function'),
    ],
)
def test_what_contradicts_itself_is_refused(options: dict[str, Any], complaint: str) -> None:
    p = preset('phantom')
    words = {'force': 3.0, 'duration': 0.1, **options}
    with pytest.raises(ParameterError, match=complaint):
        simulate(p, NeedleModel(p).state_at(0.05), **words)
