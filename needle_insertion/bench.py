"""Benchmarks: ratios measured side by side in one run, never a pass or fail on time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import sys
import time

from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters, simulate
from needle_insertion.report import table
import numpy as np
from scipy.integrate import solve_ivp

#: The open-loop run of the source: 3 N, 2 cm inserted, 0.5 mm deflection; it ends before the hub.
FORCE, DEPTH, DEFLECTION, DURATION = 3.0, 0.02, 5e-4, 0.0285

#: Error that counts as equal: this part of the peak tip deflection.
ACCURACY = 1e-3

_INTERVAL = 1e-4


def dynamics() -> int:
    """
    Compare the integrator with SciPy's solvers on the open-loop run, at equal accuracy.

    Returns
    -------
    int
        0.

    """
    parameters = NeedleParameters.preset('paper_si')
    model = NeedleModel(parameters)
    start = model.state_at(DEPTH, DEFLECTION)
    grid = np.arange(round(DURATION / _INTERVAL) + 1) * _INTERVAL

    def scipy_run(method: str, tolerance: float) -> FloatArray:
        solution = solve_ivp(
            lambda _t, x: model.derivative(x, FORCE),
            (0.0, grid[-1]),
            start,
            method=method,
            rtol=tolerance,
            atol=1e-4 * tolerance,
            t_eval=grid,
        )
        return np.array([model.tip_deflection(x) for x in solution.y.T])

    exact = scipy_run('DOP853', 1e-11)
    peak = np.abs(exact).max()

    def error(tips: FloatArray) -> float:
        return float(np.abs(tips - exact).max() / peak)

    rows = []
    step = max(
        h for h in (4e-5, 3e-5, 2e-5, 1e-5, 5e-6) if error(_tips(parameters, start, h)) <= ACCURACY
    )
    ours = _best_time(lambda: Integrator(parameters, start, step).advance(DURATION, FORCE), 20)
    rows.append(
        _row('Integrator', f'step {step:g} s', error(_tips(parameters, start, step)), ours, ours)
    )
    for method in ('RK45', 'DOP853', 'Radau'):
        for tolerance in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
            found = error(scipy_run(method, tolerance))
            if found <= ACCURACY:
                spent = _best_time(partial(scipy_run, method, tolerance), 1)
                rows.append(_row(f'SciPy {method}', f'rtol {tolerance:g}', found, spent, ours))
                break
    heads = ('solver', 'setting', 'error / peak', 'wall [ms]', 'wall / simulated', 'against ours')
    sys.stdout.write(
        f'open-loop run: {FORCE:g} N, {DEPTH * 100:g} cm inserted, paper_si, '
        f'{DURATION * 1e3:g} ms simulated, error <= {ACCURACY:.1%} of the peak\n'
        f'{table(rows, heads)}\n'
    )
    return 0


def _tips(parameters: NeedleParameters, start: FloatArray, step: float) -> FloatArray:
    run = simulate(parameters, start, FORCE, duration=DURATION, interval=_INTERVAL, step=step)
    return run.tip_deflection


def _best_time(job: Callable[[], object], repeats: int) -> float:
    """Return the least wall time of a job [s]: noise of the machine only adds."""
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        job()
        best = min(best, time.perf_counter() - begin)
    return float(best)


def _row(name: str, setting: str, error: float, spent: float, ours: float) -> tuple[str, ...]:
    return (
        name,
        setting,
        f'{error:.1e}',
        f'{spent * 1e3:.3g}',
        f'{spent / DURATION:.3g}',
        f'{spent / ours:.3g} x',
    )
