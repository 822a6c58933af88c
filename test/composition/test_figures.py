"""What figures 4 to 8 show must come out of the runs."""

from math import exp, sqrt

from matplotlib.figure import Figure
from needle_controller import ContinuousPid, run_continuous
from needle_dynamics import Integrator, NeedleParameters
from needle_insertion.paper.figures import FIGURES, section
from needle_insertion.paper.runs import (
    base_alone,
    CASES,
    closed_loop,
    DEFLECTION,
    DEPTH,
    hub_time,
    LAWS,
    needle,
    open_loop,
    Outcome,
    paper_law,
    PID_KP,
    READINGS,
)
from needle_insertion.report.content import png
import numpy as np
from numpy.testing import assert_allclose
import pytest

BOUND = NeedleParameters().coulomb_friction / PID_KP


@pytest.mark.parametrize('case', CASES)
def test_all_runs_begin_where_the_paper_says(case: tuple[str, ...]) -> None:
    for run in (open_loop(*case), closed_loop('pid', *case, hub_stop=True)):
        assert_allclose(run.depth[0], DEPTH)
        assert_allclose(run.tip_deflection[0], DEFLECTION)
        assert (run.states[0, 4:] == 0.0).all()


def test_the_open_loop_distinguishes_readings_and_formulations() -> None:
    # 2 %: the way to the terminal speed and the force of the deflection.
    assert_allclose(hub_time(open_loop('paper_mm', 'complete')), 0.18 * 300.0 / 2.44, rtol=0.02)
    assert 0.028 < hub_time(open_loop('paper_si', 'complete')) < 0.029
    for reading in READINGS:
        complete, printed = (
            abs(Outcome.of(open_loop(reading, form)).peak) for form in ('complete', 'as_printed')
        )
        assert DEFLECTION < complete < 3.0 * DEFLECTION
        assert printed > 50.0 * complete


def test_the_open_loop_has_converged() -> None:
    """The slow runs turn many thousand times; their peaks must not be those of the step."""
    for formulation in ('complete', 'as_printed'):
        run = open_loop('paper_mm', formulation)
        fine = Integrator(run.model.parameters, run.states[0], 5e-6)
        coarse = Integrator(run.model.parameters, run.states[0], 1e-5)
        for integrator in (fine, coarse):
            for _ in range(50):
                integrator.advance(0.1, 3.0)
        energies = [run.model.energy(one.state) for one in (fine, coarse)]
        # 1e-3: a second-order step a quarter as wrong; the phase is not looked at.
        assert_allclose(energies[1], energies[0], rtol=1e-3)


@pytest.mark.parametrize('hub_stop', [False, True])
def test_inverse_dynamics_cancels_reading_and_formulation(hub_stop: bool) -> None:
    # Of a peak of 100 mm and 30 mm; where the hub is touched differs by the solver's tolerance.
    tips = [
        closed_loop('inverse_dynamics', *case, hub_stop=hub_stop).tip_deflection for case in CASES
    ]
    assert np.ptp(tips, axis=0).max() < 1e-4
    for case in CASES:
        found = Outcome.of(closed_loop('inverse_dynamics', *case, hub_stop=hub_stop))
        assert found.final < 1e-8
        assert (found.deepest > 0.35) is (not hub_stop)
        # d falls as exp(-0.05 t) without a hub, and is zero on it.
        assert abs(found.error) <= (0.0 if hub_stop else 0.18 * exp(-0.05 * found.end) * 1.1)


@pytest.mark.parametrize('case', CASES)
def test_pid_leaves_coulomb_friction_over_its_gain(case: tuple[str, ...]) -> None:
    run = closed_loop('pid', *case, hub_stop=True)
    found = Outcome.of(run)
    assert found.final < 1e-8
    # 1 %: after 150 s of a time constant of 10 s.
    assert_allclose(found.error, BOUND, rtol=1e-2)
    assert found.error > BOUND
    assert found.deepest < 0.2


def test_another_solver_agrees_on_the_pid_run() -> None:
    """BDF on the smooth right-hand side: before the end the friction never changes its sign."""
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
def test_with_f_y_alone_the_tip_rings_on(law: str) -> None:
    for reading in READINGS:
        run = base_alone(law, reading)
        found = Outcome.of(run)
        assert found.final > DEFLECTION
        # The base does what it does under the modal law.
        modal = Outcome.of(closed_loop(law, reading, 'complete', hub_stop=True))
        assert_allclose(found.error, modal.error, atol=5e-6)


def test_the_moved_base_follows_the_error_equation() -> None:
    run = base_alone('inverse_dynamics', 'paper_si')
    before = run.time < 1.6
    w = sqrt(1.0 - 0.05**2)
    t = run.time[before]
    exact = 0.18 * np.exp(-0.05 * t) * (np.cos(w * t) + 0.05 / w * np.sin(w * t))
    # The speed is even within 5 ms.
    assert_allclose(run.states[before, 0], exact, atol=1e-5)


def test_every_figure_is_drawn_and_says_what_is_seen() -> None:
    for name, draw in FIGURES.items():
        found = draw()
        assert isinstance(found.picture.figure, Figure)
        assert found.picture.caption.startswith(f'Figure {name[-1]}, ')
        assert len(found.table().rows) == len(found.outcomes)
    assert png(FIGURES['figure-8']().picture.figure) == png(FIGURES['figure-8']().picture.figure)


def test_the_section_compares_the_controllers() -> None:
    found = section()
    assert len(found.pictures) == 5
    rows = found.tables[0].rows
    assert len(rows) == 8
    assert all(len(row) == len(found.tables[0].heads) for row in rows)
    assert '0.56 mm = mu_s / k_p' in found.paragraphs[2]


@pytest.mark.parametrize(('law', 'peak'), [('inverse_dynamics', 16.0), ('pid', 4.87)])
def test_peaks_depend_on_the_shape_at_the_start(law: str, peak: float) -> None:
    """From mode 1 alone, with the same deflection, they are less than half as large."""
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
    least_energy = abs(Outcome.of(closed_loop(law, 'paper_mm', 'complete', hub_stop=False)).peak)
    assert 1e3 * least_energy > 2.0 * peak
