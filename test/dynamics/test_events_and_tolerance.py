# SPDX-License-Identifier: Apache-2.0
"""Hub contact as an event, dense output, and tolerance-controlled steps."""

from __future__ import annotations

from math import inf, isfinite
import re
from typing import Any

from needle_dynamics import (
    FloatArray,
    FRICTION_LAWS,
    Integrator,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    simulate,
    Trajectory,
)
from needle_ros.errors import NeedleError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.integrate import solve_ivp

preset = NeedleParameters.preset
LENGTH = 0.2
PUSH = 3.0


def moving(parameters: NeedleParameters, depth: float, tip: float, speed: float) -> FloatArray:
    model = NeedleModel(parameters)
    state = model.state_at(depth, tip)
    state[model.coordinates] = -speed
    return state


def distance(model: NeedleModel, one: FloatArray, other: FloatArray) -> float:
    """Return the difference of two states: root of its relative energy."""
    difference = one - other
    difference[0] = other[0]
    return float(np.sqrt(model.energy(difference) / model.energy(other)))


# --- hub ------------------------------------------------------------------------------------


def test_contact_of_a_straight_needle_matches_the_closed_form() -> None:
    """With Coulomb friction only: contact after sqrt(2 m d / f), with the known energy."""
    p = preset('paper_si', viscous_friction=0.0)
    it = Integrator(p, moving(p, 0.15, 0.0, 0.0))
    total = it.advance(0.02, PUSH)
    force = PUSH - 0.56
    # Sums over a thousand steps.
    assert_allclose(total.contact_time, np.sqrt(2.0 * p.moving_mass * 0.05 / force), rtol=1e-10)
    assert_allclose(total.impact_loss, force * 0.05, rtol=1e-10)
    assert it.depth == LENGTH
    assert it.velocity == 0.0


@pytest.mark.parametrize('law', FRICTION_LAWS)
@pytest.mark.parametrize('formulation', ['complete', 'as_printed'])
def test_contact_time_converges_to_an_ode_solver(formulation: str, law: str) -> None:
    """Time and energy of the impact of a bent needle converge at order two to an ODE event."""
    p = preset(
        'paper_si',
        formulation=formulation,
        friction_law=law,
        breakaway_friction=1.5,
        stribeck_speed=0.5,
        smoothing_speed=0.5,
    )
    start = moving(p, 0.17, 3e-3, 1.0)

    def hub(_: float, x: FloatArray) -> float:
        return float(x[0])

    hub.terminal = True  # type: ignore[attr-defined]
    # Beyond the hub, for the event detection of the solver.
    free = NeedleModel(preset('paper_si', **{**p_changes(p), 'hub_stop': False}))
    solved = solve_ivp(
        lambda _, x: free.derivative(x, PUSH),
        (0.0, 0.1),
        start,
        method='DOP853',
        rtol=1e-11,
        atol=1e-14,
        events=hub,
    )
    exact = solved.t_events[0][0]
    energy = 0.5 * p.moving_mass * solved.y[4, -1] ** 2
    times, losses = [], []
    for step in (4e-5, 2e-5, 1e-5, 5e-6):
        total = Integrator(p, start, step).advance(0.04, PUSH)
        times.append(abs(total.contact_time - exact))
        losses.append(abs(total.impact_loss / energy - 1.0))
    # Where the modes do not act on the axis and its flow is exact, the step makes no error.
    # Elsewhere 64 times less at an eighth of the step; measured 2e-11 s and 3e-8 at the last.
    assert times[-1] < max(0.03 * times[0], 1e-13)
    assert times[-1] < 1e-10
    assert losses[-1] < 1e-7


def p_changes(p: NeedleParameters) -> dict[str, Any]:
    """Return the changes from `paper_si` to these constants."""
    names = ('formulation', 'friction_law', 'breakaway_friction', 'stribeck_speed')
    return {name: getattr(p, name) for name in (*names, 'smoothing_speed')}


@pytest.mark.parametrize('name', ['paper_si', 'phantom'])
@pytest.mark.parametrize('moved', [False, True])
def test_impact_loss_closes_the_energy_balance(moved: bool, name: str) -> None:
    """Over an impact the energy changes by input - friction - damping - impact loss."""
    gaps = []
    for step in (4e-6, 2e-6, 1e-6):
        p = preset(name, carriage_mass=0.1)
        it = Integrator(p, moving(p, 0.19, 3e-3, 0.5), step)
        before = it.model.energy(it.state)
        total = it.advance_moved(0.04, 0.5) if moved else it.advance(0.2, 20.0)
        assert it.depth == LENGTH
        assert isfinite(total.contact_time)
        assert total.impact_loss > 1e-6
        change = it.model.energy(it.state) - before
        spent = total.friction_work + total.damping_work + total.impact_loss
        gaps.append(abs(total.input_work - spent - change))
        size = total.impact_loss
    # The exchange between modes and axis within the step of the impact depends on the position of
    # the contact in the step: no clean order. Measured 4e-9 of the impact and less.
    assert max(gaps) < 1e-7 * size


def test_contact_time_is_on_the_clock_of_the_integrator() -> None:
    """Each interval reports its own contact, infinite without one."""
    p = preset('paper_si', viscous_friction=0.0)
    whole = Integrator(p, moving(p, 0.15, 0.0, 0.0)).advance(0.02, PUSH).contact_time
    it = Integrator(p, moving(p, 0.15, 0.0, 0.0))
    seen = [it.advance(1e-3, PUSH) for _ in range(20)]
    times = [part.contact_time for part in seen if isfinite(part.contact_time)]
    # No further contact while the needle is held on the hub.
    assert len(times) == 1
    assert times[0] == pytest.approx(whole, rel=1e-9)
    assert [part.impact_loss > 0.0 for part in seen] == [
        isfinite(part.contact_time) for part in seen
    ]
    # Withdrawn and pushed in again: another contact.
    it.advance(2e-3, -PUSH)
    assert it.advance(1e-3, -PUSH).contact_time == inf
    again = [it.advance(1e-3, PUSH) for _ in range(20)]
    later = [part.contact_time for part in again if isfinite(part.contact_time)]
    assert len(later) == 1
    assert later[0] > 0.023


def test_needle_that_starts_on_the_hub_loses_its_speed() -> None:
    """Contact at the start: the kinetic energy is dissipated by the impact."""
    p = preset('paper_si')
    for moved in (False, True):
        it = Integrator(p, moving(p, LENGTH, 0.0, 1.0))
        total = it.advance_moved(1e-3, 1.0) if moved else it.advance(1e-3, PUSH)
        assert it.depth == LENGTH
        assert it.velocity == 0.0
        assert total.contact_time == 0.0
        assert_allclose(total.impact_loss, 0.5 * p.moving_mass, rtol=1e-15)
        assert total.friction_work == total.input_work == 0.0


# --- between samples ------------------------------------------------------------------------


def run(**options: Any) -> Trajectory:
    p = preset('phantom', swelling=0.5, swelling_time=5e-3)
    start = NeedleModel(p).state_at(0.02, 5e-4)
    return simulate(p, start, lambda t: 3.0 - 200.0 * t, duration=0.02, interval=1e-3, **options)


def test_dense_output_passes_through_the_samples() -> None:
    """At a sample it equals the sample, and just before a sample it is close to it."""
    seen = run()
    for k, time in enumerate(seen.time):
        assert np.array_equal(seen.at(time), seen.states[k])
    model = NeedleModel(seen.parameters)
    for k in range(1, len(seen.time)):
        before = seen.at(seen.time[k] * (1.0 - 1e-9))
        assert_allclose(before[0], seen.states[k, 0], rtol=1e-9)
        # 1e-9 of 20 ms at 22 kHz are 3e-6 rad.
        assert distance(model, before, seen.states[k]) < 1e-5


def test_dense_output_equals_a_direct_run_bit_for_bit() -> None:
    """At any time it is the state of a run to that time."""
    seen = run(step=1e-5)
    for time in np.random.default_rng(3).uniform(0.0, 0.02, size=20):
        k = int(time // 1e-3)
        it = Integrator(seen.parameters, seen.states[k])
        it.time = seen.time[k]
        it.advance(time - seen.time[k], 3.0 - 200.0 * seen.time[k])
        assert np.array_equal(seen.at(time), it.state)


def test_dense_output_agrees_with_an_ode_solver() -> None:
    """The error between samples is the integration error, without interpolation."""
    p = preset('paper_si')
    model = NeedleModel(p)
    start = model.state_at(0.05, 1e-3)
    seen = simulate(p, start, PUSH, duration=0.01, interval=2.5e-3, step=2e-6)
    times = np.linspace(0.0, 0.01, 37)
    solved = solve_ivp(
        lambda _, x: model.derivative(x, PUSH),
        (0.0, 0.01),
        start,
        method='DOP853',
        rtol=1e-10,
        atol=1e-13,
        t_eval=times,
    ).y.T
    worst = max(distance(model, seen.at(t), x) for t, x in zip(times, solved, strict=True))
    # Second order at 5 kHz: measured 3.2e-7.
    assert worst < 2e-6


def test_dense_output_keeps_the_tolerance_of_the_run() -> None:
    """A run with a tolerance has no jump at the next sample."""
    seen = run(tolerance=1e-9)
    model = NeedleModel(seen.parameters)
    gaps = [
        distance(model, seen.at(seen.time[k] * (1.0 - 1e-12)), seen.states[k])
        for k in range(1, len(seen.time))
    ]
    # Two ends within 1e-9 each: measured 5e-10. Steps of 10 us would leave 7e-5.
    assert max(gaps) < 3e-9


@pytest.mark.parametrize('time', [-1e-9, 0.0201, np.nan, np.inf])
def test_times_outside_the_run_are_rejected(time: float) -> None:
    with pytest.raises(ParameterError, match=r'time must be in \[0, 0.02\] s, got'):
        run().at(time)


# --- tolerance ------------------------------------------------------------------------------


def test_graded_steps_are_of_second_order() -> None:
    """Graded steps converge like even steps, to the same state, with fewer steps."""
    p = preset('paper_si')
    model, start = NeedleModel(p), moving(p, 0.02, 5e-4, 1.0)
    exact = solve_ivp(
        lambda _, x: model.derivative(x, PUSH),
        (0.0, 0.02),
        start,
        method='DOP853',
        rtol=1e-12,
        atol=1e-16,
    ).y[:, -1]
    errors: dict[bool, list[float]] = {}
    for graded in (False, True):
        errors[graded] = []
        for step in (8e-6, 4e-6, 2e-6):
            it = Integrator(model.parameters, start, step, graded=graded)
            it.advance(0.02, PUSH)
            errors[graded].append(distance(model, it.state, exact))
        # Measured 2.00 to 2.03.
        slopes = np.log2(np.array(errors[graded][:-1]) / errors[graded][1:])
        assert_allclose(slopes, 2.0, atol=0.1)
    assert it.depth > 0.13
    # Measured 1.9e-7 and 4.1e-7.
    assert errors[True][-1] < 1e-6


def test_tolerance_is_met_through_rest_and_impact() -> None:
    """Sticking and hub contact, where the motion is not smooth, do not stall the step control."""
    p = preset('paper_si')
    start = moving(p, 0.15, 1e-3, 0.0)
    options: dict[str, Any] = {'duration': 0.025, 'interval': 1e-3}

    def force(time: float) -> float:
        return 0.3 if time < 5e-3 else PUSH

    seen = simulate(p, start, force, tolerance=1e-6, **options)
    fine = simulate(p, start, force, step=1e-7, **options)
    assert np.all(seen.depth[:6] == seen.depth[0])
    assert seen.depth[-1] == LENGTH
    assert_allclose(seen.depth, fine.depth, atol=1e-6 * LENGTH)


@pytest.mark.parametrize('tolerance', [0.0, -1e-6, np.nan, np.inf])
def test_tolerance_must_be_positive_and_finite(tolerance: float) -> None:
    with pytest.raises(ParameterError, match='tolerance must be finite, >= 1e-11, got'):
        run(tolerance=tolerance)


# --- invalid inputs -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'force': '3'}, "force must be real numbers, got '3'"),
        ({'force': np.ones(3)}, 'force must have shape (), got (3,)'),
        ({'force': 3j}, 'force must be real numbers, got 3j'),
        ({'force': inf}, 'force must be finite, got inf'),
        ({'force': lambda _: '3'}, 'force must be real numbers, got ['),
        ({'state': 1j * np.ones(8)}, 'state must be real numbers, got an array of complex128'),
        ({'state': np.array(['0.15'] * 8)}, 'state must be real numbers, got an array of <U4'),
        ({'state': ['0.15'] * 8}, "state must be real numbers, got ['0.15', "),
        ({'duration': '1'}, "duration must be a number, got '1'"),
        ({'duration': inf}, 'duration must be finite'),
        ({'interval': 0.3}, 'duration must be a whole number of intervals'),
        ({'interval': 2.0}, 'duration must be finite, >= 2 s, got 1.0'),
    ],
)
def test_invalid_inputs_of_a_run_are_named(change: dict[str, Any], complaint: str) -> None:
    p = preset('phantom')
    given: dict[str, Any] = {
        'state': NeedleModel(p).state_at(0.05),
        'force': PUSH,
        'interval': 0.1,
    } | change
    given = {'duration': 1.0, **given}
    with pytest.raises(NeedleError, match=f'^{re.escape(complaint)}'):
        simulate(p, **given)


def test_numbers_of_numpy_are_numbers() -> None:
    p = preset('phantom', modes=np.int64(2), length=np.float32(0.25))
    assert type(p.modes) is int
    start = NeedleModel(p).state_at(np.float32(0.0625))  # type: ignore[arg-type]
    times: dict[str, Any] = {'duration': np.float32(0.5), 'interval': np.float32(0.125)}
    found = simulate(p, start, np.float32(2.0), **times)  # type: ignore[arg-type]
    same = simulate(p, start, 2, duration=0.5, interval=0.125)
    assert np.array_equal(found.states, same.states)
