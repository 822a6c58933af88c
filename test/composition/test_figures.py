# SPDX-License-Identifier: Apache-2.0
"""Statements of figures 4 to 8 hold in the runs."""

from math import exp, sqrt

from matplotlib.figure import Figure
from needle_controller import ContinuousPid, run_continuous
from needle_dynamics import Integrator, NeedleParameters
from needle_insertion.report.content import png
import numpy as np
from numpy.testing import assert_allclose
import pytest
from reproduction.figures import FIGURES, section
from reproduction.runs import (
    base_alone,
    CASES,
    closed_loop,
    DEFLECTION,
    DEPTH,
    hub_time,
    LAWS,
    needle,
    open_loop,
    paper_law,
    PID_KP,
    READINGS,
    RunOutcome,
)

BOUND = NeedleParameters().coulomb_friction / PID_KP


@pytest.mark.parametrize('case', CASES)
def test_all_runs_start_at_the_initial_state_of_the_paper(case: tuple[str, ...]) -> None:
    for run in (open_loop(*case), closed_loop('pid', *case, hub_stop=True)):
        assert_allclose(run.depth[0], DEPTH)
        assert_allclose(run.tip_deflection[0], DEFLECTION)
        assert (run.states[0, 4:] == 0.0).all()


def test_the_open_loop_distinguishes_readings_and_formulations() -> None:
    # 2 %: acceleration to the terminal velocity, and force of the deflection.
    assert_allclose(hub_time(open_loop('paper_mm', 'complete')), 0.18 * 300.0 / 2.44, rtol=0.02)
    assert 0.028 < hub_time(open_loop('paper_si', 'complete')) < 0.029
    for reading in READINGS:
        complete, printed = (
            abs(RunOutcome.of(open_loop(reading, form)).peak)
            for form in ('complete', 'as_printed')
        )
        assert DEFLECTION < complete < 3.0 * DEFLECTION
        assert printed > 50.0 * complete


def test_the_open_loop_has_converged() -> None:
    """The slow runs oscillate thousands of times; their peaks must not depend on the step."""
    for formulation in ('complete', 'as_printed'):
        run = open_loop('paper_mm', formulation)
        fine = Integrator(run.model.parameters, run.states[0], 5e-6)
        coarse = Integrator(run.model.parameters, run.states[0], 1e-5)
        for integrator in (fine, coarse):
            for _ in range(50):
                integrator.advance(0.1, 3.0)
        energies = [run.model.energy(one.state) for one in (fine, coarse)]
        # 1e-3: halving a second-order step reduces the error by 4; the phase is not compared.
        assert_allclose(energies[1], energies[0], rtol=1e-3)


@pytest.mark.parametrize('hub_stop', [False, True])
def test_inverse_dynamics_cancels_reading_and_formulation(hub_stop: bool) -> None:
    # Peaks are 100 mm and 30 mm; the time of the hub contact differs by the solver tolerance.
    tips = [
        closed_loop('inverse_dynamics', *case, hub_stop=hub_stop).tip_deflection for case in CASES
    ]
    assert np.ptp(tips, axis=0).max() < 1e-4
    for case in CASES:
        found = RunOutcome.of(closed_loop('inverse_dynamics', *case, hub_stop=hub_stop))
        assert found.final < 1e-8
        assert (found.deepest > 0.35) is (not hub_stop)
        # d falls as exp(-0.05 t) without a hub, and is zero on it.
        assert abs(found.error) <= (0.0 if hub_stop else 0.18 * exp(-0.05 * found.end) * 1.1)


@pytest.mark.parametrize('case', CASES)
def test_pid_leaves_coulomb_friction_over_its_gain(case: tuple[str, ...]) -> None:
    run = closed_loop('pid', *case, hub_stop=True)
    found = RunOutcome.of(run)
    assert found.final < 1e-8
    # 1 %: after 150 s of a time constant of 10 s.
    assert_allclose(found.error, BOUND, rtol=1e-2)
    assert found.error > BOUND
    assert found.deepest < 0.2


def test_pid_run_agrees_with_another_solver() -> None:
    """BDF on the smooth right-hand side: friction does not change sign before the end."""
    model = needle('paper_mm', 'complete')
    law = paper_law('pid', model)
    assert isinstance(law, ContinuousPid)
    again = run_continuous(
        law, model, model.state_at(DEPTH, DEFLECTION), np.zeros((3, 4)), [0.0, 5.0, 10.0, 20.0],
        method='BDF', tolerance=1e-5,
    )  # fmt: skip
    run = closed_loop('pid', 'paper_mm', 'complete', hub_stop=True)
    for time, state in zip(again.time, again.states, strict=True):
        k = int(np.flatnonzero(np.isclose(run.time, time))[0])
        # 1e-3: BDF at its tolerance.
        assert_allclose(run.states[k, :4], state[:4], rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize('law', LAWS)
def test_tip_keeps_ringing_with_f_y_alone(law: str) -> None:
    for reading in READINGS:
        run = base_alone(law, reading)
        found = RunOutcome.of(run)
        assert found.final > DEFLECTION
        # The base moves as under the modal law.
        modal = RunOutcome.of(closed_loop(law, reading, 'complete', hub_stop=True))
        assert_allclose(found.error, modal.error, atol=5e-6)


def test_the_moved_base_follows_the_error_equation() -> None:
    run = base_alone('inverse_dynamics', 'paper_si')
    before = run.time < 1.6
    w = sqrt(1.0 - 0.05**2)
    t = run.time[before]
    exact = 0.18 * np.exp(-0.05 * t) * (np.cos(w * t) + 0.05 / w * np.sin(w * t))
    # The velocity is constant within 5 ms.
    assert_allclose(run.states[before, 0], exact, atol=1e-5)


def test_every_figure_is_drawn_with_a_caption() -> None:
    for name, draw in FIGURES.items():
        found = draw()
        assert isinstance(found.picture.figure, Figure)
        assert found.picture.caption.startswith(f'Figure {name[-1]}, ')
        assert len(found.table().rows) == len(found.outcomes)
    assert png(FIGURES['figure-8']().picture.figure) == png(FIGURES['figure-8']().picture.figure)


def test_section_compares_the_controllers() -> None:
    found = section()
    assert len(found.pictures) == 5
    rows = found.tables[0].rows
    assert len(rows) == 8
    assert all(len(row) == len(found.tables[0].heads) for row in rows)
    assert '0.56 mm = mu_s / k_p' in found.paragraphs[2]


@pytest.mark.parametrize(('law', 'peak'), [('inverse_dynamics', 16.0), ('pid', 4.87)])
def test_peaks_depend_on_the_initial_shape(law: str, peak: float) -> None:
    """With mode 1 alone and the same deflection the peaks are less than half as large."""
    model = needle('paper_mm', 'complete', hub_stop=False)
    first = DEFLECTION / model.modes.integrals(DEPTH).value[0]
    run = run_continuous(
        paper_law(law, model),
        model,
        model.state_at(DEPTH, modal=(first, 0.0)),
        np.zeros((3, 4)),
        np.linspace(0.0, 20.0, 5001),
        method='Radau' if law == 'pid' else 'DOP853',
    )
    assert 1e3 * np.abs(run.tip_deflection).max() == pytest.approx(peak, rel=0.01)
    least_energy = abs(
        RunOutcome.of(closed_loop(law, 'paper_mm', 'complete', hub_stop=False)).peak
    )
    assert 1e3 * least_energy > 2.0 * peak
