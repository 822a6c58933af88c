# SPDX-License-Identifier: Apache-2.0
"""
Open-loop run of the paper: the integrator of this package and other solvers, at equal error.

Each solver is timed for the final state only, with the loosest setting on a fine grid that meets
the error. The error of the other solvers is evaluated at their own steps, of `odeint` on a grid.
The integrator of this package does not report its steps; its error is evaluated over runs to each
time of a grid, each in one call like the timed run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, cast, Final, NamedTuple
from unittest import mock
import warnings

from benchmarks import in_jax
from benchmarks.dop853 import build_solver, compiled
from benchmarks.measure import geometric, least_times, number, seconds
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters, simulate
from needle_dynamics.compiled import step as compiled_step
from needle_dynamics.compiled.integrals import (
    ModeIntegrals,
    ModeTables,
    TERMS_PER_LENGTH,
    two_modes,
)
from needle_dynamics.compiled.modal_flow import rotate_two
from needle_dynamics.simulated.trajectory import ORDERS
import numpy as np
from scipy.integrate import odeint, quad, solve_ivp

#: Open-loop run: 3 N, 2 cm inserted, 0.5 mm deflection; it ends before the hub.
FORCE, DEPTH, DEFLECTION, DURATION = 3.0, 0.02, 5e-4, 0.0285

#: Error of all solvers, over the peak of the tip deflection.
ACCURACY: Final = 1e-3

#: Solvers that run in one compiled call, except for the right-hand side of `odeint`.
ODEINT, COMPILED = 'odeint (LSODA)', 'DOP853, compiled'
ONE_CALL: Final = (COMPILED, ODEINT, *in_jax.METHODS)
METHODS: Final = ('RK45', 'DOP853', 'Radau', 'BDF', 'LSODA', ODEINT)

#: Grids of settings, from loose to tight: ratio of neighbors.
_TOLERANCE_RATIO: Final = 10.0**-0.125
_STEP_RATIO: Final = 2.0**-0.0625

_STEPS: Final = (1e-3, 1e-8)  #: longest and shortest tried step [s]

#: Sampling interval of our error [s]; several samples in a period of each mode.
_GRID: Final = 1e-5

#: Most stored steps.
_STORED: Final = 200_000

#: Absolute over relative tolerance, if not proportional to the peak of each state.
_ABSOLUTE: Final = 1e-4

_NODES: Final = 16

RightHandSide = Callable[[float, FloatArray], FloatArray]


class _Data(NamedTuple):
    """Constants of a run, and memory for the integrals of the modes."""

    force: float
    constants: tuple[float, float, float, float, float, float, float, float]
    series: FloatArray
    terms: FloatArray
    work: FloatArray
    grids: FloatArray
    rows: FloatArray


@compiled
def _derivative(x: FloatArray, data: _Data, out: FloatArray) -> None:
    """Write the time derivative of the state to ``out``, without torque."""
    force, constants, series, terms, work, grids, rows = data
    length, rho, ei, ka, ca, mass, coulomb, viscous = constants
    depth, reach = length - x[0], length * (terms.shape[0] - 1) / TERMS_PER_LENGTH
    # A trial state of a solver may be outside the range or nan.
    if not depth >= 0.0:
        depth = 0.0
    elif depth > reach:
        depth = reach
    at = ModeIntegrals(grids[0], grids[1], rows[0], rows[1], rows[2], rows[3])
    two_modes(ModeTables(length, series, terms, rows), depth, work, at)
    phi, bend, g, h = at.value, at.curvature, at.gram, at.curvature_gram
    q1, q2, r1, r2 = x[2], x[3], x[6], x[7]
    speed = -x[4]
    value = phi[0] * q1 + phi[1] * q2
    rate = phi[0] * r1 + phi[1] * r2
    curvature = bend[0] * q1 + bend[1] * q2
    drive = force + 0.5 * (rho * rate * rate - ei * curvature * curvature - ka * value * value)
    if speed == 0.0:
        friction = min(max(drive, -coulomb), coulomb)
    else:
        friction = (coulomb if speed > 0.0 else -coulomb) + viscous * speed
    k12 = ei * h[0, 1] + ka * g[0, 1]
    f1 = rho * x[4] * phi[0] * rate - (ei * h[0, 0] + ka * g[0, 0]) * q1 - k12 * q2
    f2 = rho * x[4] * phi[1] * rate - k12 * q1 - (ei * h[1, 1] + ka * g[1, 1]) * q2
    f1 -= ca * (g[0, 0] * r1 + g[0, 1] * r2)
    f2 -= ca * (g[0, 1] * r1 + g[1, 1] * r2)
    determinant = rho * (g[0, 0] * g[1, 1] - g[0, 1] * g[0, 1])
    out[0] = x[4]
    out[1] = x[5]
    out[2] = r1
    out[3] = r2
    out[4] = (friction - drive) / mass
    out[5] = 0.0
    out[6] = (g[1, 1] * f1 - g[0, 1] * f2) / determinant
    out[7] = (g[0, 0] * f2 - g[0, 1] * f1) / determinant


#: Compiled DOP853 for the compiled equations of motion.
_dop853 = build_solver(_derivative)


def _data(model: NeedleModel, force: float) -> _Data:
    """Return the constants of a run with a constant insertion force [N]."""
    p = model.parameters
    constants = (
        p.length,
        p.linear_density,
        p.bending_stiffness,
        p.tissue_stiffness,
        p.tissue_damping,
        p.moving_mass,
        p.coulomb_friction,
        p.viscous_friction,
    )
    tables = model.modes.tables
    work, grids, rows = np.empty(tables.series.shape[1]), np.empty((2, 2, 2)), np.empty((4, 2))
    return _Data(force, constants, tables.series, tables.terms, work, grids, rows)


def compiled_right_hand_side(model: NeedleModel, force: float) -> RightHandSide:
    """Return the compiled equations of motion for a constant insertion force [N]."""
    data = _data(model, force)

    def right_hand_side(_time: float, x: FloatArray) -> FloatArray:
        out = np.empty(8)
        _derivative(x, data, out)
        return out

    return right_hand_side


def user_right_hand_side(
    model: NeedleModel, force: float, *, adaptive: bool = False
) -> RightHandSide:
    """
    Return the equations of motion as typical user code with NumPy and SciPy.

    G and H are integrated in each call: by default with tabulated Gauss-Legendre nodes, all in one
    NumPy expression, which is faster; or with `scipy.integrate.quad` for each entry (`adaptive`),
    which is the straightforward code. The modes of the model give (11).
    """
    p = model.parameters
    rho, ei, ka, ca = (p.linear_density, p.bending_stiffness, p.tissue_stiffness, p.tissue_damping)
    k, mu, c = model.modes.wavenumbers, model.modes.ratios, model.modes.scales
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes = 0.5 * (nodes + 1.0)[:, np.newaxis]
    weights = 0.5 * weights[:, np.newaxis]

    def shapes(y: Any) -> Any:
        x = k * y
        return c * (np.sin(x) - np.sinh(x) - mu * (np.cos(x) - np.cosh(x)))

    def curvatures(y: Any) -> Any:
        x = k * y
        return k**2 * c * (-np.sin(x) - np.sinh(x) + mu * (np.cos(x) + np.cosh(x)))

    def gauss(function: Any, s: float) -> Any:
        at_nodes = function(s * nodes)
        return at_nodes.T @ (s * weights * at_nodes)

    def entries(function: Any, s: float) -> Any:
        gram = np.empty((2, 2))
        for i, j in ((0, 0), (0, 1), (1, 1)):
            gram[i, j] = gram[j, i] = quad(
                lambda y, i=i, j=j: function(y)[i] * function(y)[j], 0.0, s
            )[0]
        return gram

    integral = entries if adaptive else gauss

    def right_hand_side(_time: float, x: FloatArray) -> FloatArray:
        s, q, d_rate, q_rate = p.length - x[0], x[2:4], x[4], x[6:]
        gram, stiffness = integral(shapes, s), integral(curvatures, s)
        value, curvature = shapes(s), curvatures(s)
        drive = force + 0.5 * (
            rho * (value @ q_rate) ** 2 - ei * (curvature @ q) ** 2 - ka * (value @ q) ** 2
        )
        if d_rate == 0.0:
            friction = min(max(drive, -p.coulomb_friction), p.coulomb_friction)
        else:
            friction = -np.sign(d_rate) * p.coulomb_friction - p.viscous_friction * d_rate
        modal = (
            rho * d_rate * value * (value @ q_rate)
            - (ei * stiffness + ka * gram) @ q
            - ca * gram @ q_rate
        )
        d_acceleration = (friction - drive) / p.moving_mass
        q_acceleration = np.linalg.solve(rho * gram, modal)
        return np.array([*x[4:], d_acceleration, 0.0, *q_acceleration])

    return right_hand_side


@dataclass(frozen=True, slots=True)
class Candidate:
    """
    A solver at the loosest setting that meets the error.

    Attributes
    ----------
    name, setting : str
        Names.
    error : float
        Largest error of the tip deflection over its peak.
    evaluations : int
        Calls of the right-hand side, or steps of the integrator of this package.
    run : callable
        Runs the solver on a right-hand side.

    """

    name: str
    setting: str
    error: float
    evaluations: int
    run: Callable[[RightHandSide], Any]


class Run(NamedTuple):
    """Steps of a run, shape (n,), its states, shape (8, n), and calls of the right-hand side."""

    t: FloatArray
    y: FloatArray
    nfev: int


class OpenLoopCase:
    """Open-loop run with its reference solution, and the search for settings."""

    def __init__(self, preset: str = 'paper_si') -> None:
        self.parameters = NeedleParameters.preset(preset)
        self.model = NeedleModel(self.parameters)
        self.start = self.model.state_at(DEPTH, DEFLECTION)
        self.right_hand_side = compiled_right_hand_side(self.model, FORCE)
        self._data = _data(self.model, FORCE)
        # A peer of the reference at a tenth of its tolerance differs by 3e-11 of the peak.
        reference = solve_ivp(
            self.right_hand_side,
            (0.0, DURATION),
            self.start,
            method='DOP853',
            rtol=1e-11,
            atol=1e-15,
            dense_output=True,
        )
        self._solution = reference.sol
        self.peak = float(np.abs(self._tips(reference.y)).max())
        peaks = np.abs(reference.y).max(axis=1)
        self._peaks = np.where(peaks > 0.0, peaks, 1.0)
        self._in_jax = cache(partial(in_jax.build_solver, self.model, FORCE, DURATION))

    def _tips(self, states: FloatArray) -> FloatArray:
        """Return the tip deflections of states, shape (8, n), also outside the valid range."""
        values = self.model.modes.values(self.parameters.length - states[0])
        return np.asarray((values * states[2:4].T).sum(axis=1))

    def error(self, time: FloatArray, states: FloatArray) -> float:
        """Return the largest tip error of states (8, n) over the peak; inf if incomplete."""
        if time[-1] < DURATION * (1.0 - 1e-9) or not np.isfinite(states).all():
            return float('inf')
        exact = self._tips(self._solution(np.minimum(time, DURATION)))
        return float(np.abs(self._tips(states) - exact).max() / self.peak)

    def solve(
        self,
        method: str,
        relative: float,
        absolute: FloatArray,
        right_hand_side: RightHandSide,
        *,
        steps: bool = True,
    ) -> Run:
        """Run one of `ONE_CALL` or `METHODS`; return all `steps` or the final state."""
        if method in in_jax.METHODS:
            run = self._in_jax(method, _STORED * steps)
            times, states, calls = run(self.start, relative, absolute)
            return Run(times, states.T, calls)
        if method == COMPILED:
            times, states = np.empty(_STORED * steps), np.empty((_STORED * steps, 8))
            state = self.start.copy()
            count = _dop853(state, DURATION, relative, absolute, self._data, times, states)
            if not steps:
                return Run(np.array([DURATION]), state[:, np.newaxis], 12 * count)
            found = min(max(count, 1), len(times))
            return Run(times[:found], states[:found].T, 12 * count)
        if method == ODEINT:
            samples = round(DURATION / _GRID) if steps else 1
            grid = np.linspace(0.0, DURATION, samples + 1)
            values, given = odeint(
                right_hand_side,
                self.start,
                grid,
                tfirst=True,
                rtol=relative,
                atol=absolute,
                # Per sample: a run to the end only has one.
                mxstep=10 * _STORED,
                full_output=True,
            )
            return Run(grid, values.T, int(given['nfe'][-1]))
        solution = solve_ivp(
            right_hand_side,
            (0.0, DURATION),
            self.start,
            method=method,
            rtol=relative,
            atol=absolute,
        )
        return Run(solution.t, solution.y, solution.nfev)

    def integrate(
        self, step: float, duration: float, *, graded: bool, order: int = 2
    ) -> FloatArray:
        """Run our integrator from the start in one call; `graded` steps grow with depth."""
        if order > ORDERS[0]:
            whole = {'duration': duration, 'interval': duration}
            run = simulate(
                self.parameters, self.start, FORCE, step=step, graded=graded, order=order, **whole
            )
            return np.asarray(run.states[-1])
        integrator = Integrator(self.parameters, self.start, step, graded=graded)
        integrator.advance(duration, FORCE)
        return integrator.state

    def own_error(self, step: float, *, graded: bool, order: int, spacing: float) -> float:
        """Return the error of our integrator over runs to each time of a grid [s]."""
        count = round(DURATION / spacing)
        time = np.linspace(0.0, DURATION, count + 1)[1:]
        states = [self.integrate(step, end, graded=graded, order=order) for end in time]
        return self.error(time, np.array(states).T)

    def steps(self, step: float, *, graded: bool) -> int:
        """Count the steps of our integrator, by the evaluations of the modes."""
        # Each step rotates the two modes once, counted in the source of the compiled function.
        boxed, advance, steps = (
            cast(Any, getattr(compiled_step, name)).py_func
            for name in ('advance_boxed', 'advance', '_steps')
        )
        with (
            mock.patch('needle_dynamics.simulated.integrator.advance_boxed', boxed),
            mock.patch.object(compiled_step, 'advance', advance),
            mock.patch.object(compiled_step, '_steps', steps),
            mock.patch.object(compiled_step, 'rotate_two', wraps=rotate_two) as call,
        ):
            self.integrate(step, DURATION, graded=graded)
        return call.call_count

    def ours(
        self, *, graded: bool, accuracy: float = ACCURACY, order: int = 2, spacing: float = _GRID
    ) -> Candidate:
        """Return our integrator at the longest step that meets an error on a grid [s]."""

        def run(_unused: RightHandSide) -> None:
            # It has its own equations.
            self.integrate(step, DURATION, graded=graded, order=order)

        def error_of(step: float) -> float:
            return self.own_error(step, graded=graded, order=order, spacing=spacing)

        near = next(s for s in geometric(*_STEPS, 0.5) if error_of(s) <= accuracy)
        for step in geometric(2.0 * near, near, _STEP_RATIO):
            error = error_of(step)
            if error <= accuracy:
                return Candidate(
                    f'order {order}, {"graded" if graded else "uniform"}',
                    f'step {step:.3g} s{", growing with depth" if graded else ""}',
                    error,
                    self.steps(step, graded=graded) if (order, accuracy) == (2, ACCURACY) else 0,
                    run,
                )
        raise RuntimeError('the integrator does not reach the accuracy')

    def other(self, method: str, accuracy: float = ACCURACY) -> Candidate:
        """Return a solver at the loosest tolerances that meet an error."""
        found = []
        for name, weights in (('1e-4 rtol', np.full(8, _ABSOLUTE)), ('rtol x peaks', self._peaks)):
            for relative in geometric(0.1, 1e-11, _TOLERANCE_RATIO):
                run = partial(self.solve, method, relative, relative * weights)
                with warnings.catch_warnings():
                    # LSODA warns on failure, which is also in the error.
                    warnings.simplefilter('ignore')
                    solution = run(self.right_hand_side)
                    error = self.error(solution.t, solution.y)
                if error <= accuracy:
                    setting = f'rtol {relative:.2g}, atol {name}'
                    timed = partial(run, steps=False)
                    spent = min(seconds(partial(timed, self.right_hand_side)) for _ in range(3))
                    label = method if method in ONE_CALL else f'SciPy {method}'
                    candidate = Candidate(label, setting, error, solution.nfev, timed)
                    found.append((spent, candidate))
                    break
        return min(found, key=lambda item: item[0])[1]


def compare(tick: Tick) -> Answer:
    """Compare our integrator with other solvers on the open-loop run."""
    tick('reference')
    case = OpenLoopCase()
    ours, uniform = case.ours(graded=True), case.ours(graded=False)
    candidates, peers = list[Candidate](), list[Candidate]()
    for method in (*METHODS, COMPILED, *in_jax.METHODS):
        tick(f'tolerance of {method}')
        (candidates if method in METHODS else peers).append(case.other(method))
    user = user_right_hand_side(case.model, FORCE)
    adaptive = user_right_hand_side(case.model, FORCE, adaptive=True)

    tick('compiled right-hand side')
    compiled_times = least_times(
        {
            item.name: partial(item.run, case.right_hand_side)
            for item in (ours, uniform, *candidates, *peers)
        }
        | {'making': partial(Integrator, case.parameters, case.start, graded=True)},
        15,
    )
    tick('right-hand side of a user')
    user_times = least_times(
        {item.name: partial(item.run, user) for item in (ours, *candidates)}, 3
    )
    tick('right-hand side of a user, quad')
    first = min(candidates, key=lambda item: user_times[item.name])
    adaptive_time = least_times({first.name: partial(first.run, adaptive)}, 1)[first.name]

    own = min(compiled_times[ours.name], user_times[ours.name])

    def row(item: Candidate, spent: float, right: str) -> tuple[str, ...]:
        return (
            item.name,
            right,
            item.setting,
            f'{item.error:.1e}',
            f'{item.evaluations}',
            number(spent * 1e3),
            number(spent / DURATION),
            f'{number(spent / own)} x',
        )

    rows = [row(ours, own, 'own'), row(uniform, compiled_times[uniform.name], 'own')]
    rows += [row(item, compiled_times[item.name], 'compiled') for item in (*peers, *candidates)]
    rows += [row(item, user_times[item.name], 'NumPy, Gauss') for item in candidates]
    rows.append(row(first, adaptive_time, 'NumPy, quad'))
    section = PageSection(
        'Open-loop run',
        (
            'solver',
            'right-hand side',
            'setting',
            'error / peak',
            'calls or steps',
            'wall [ms]',
            'wall / simulated',
            'relative to ours',
        ),
        rows,
        f'{FORCE:g} N, {DEPTH * 100:g} cm inserted, {DEFLECTION * 1e3:g} mm deflection, preset '
        f'paper_si, {DURATION * 1e3:g} ms simulated, error of the tip deflection at most '
        f'{ACCURACY:.1%} of its peak.\n\n'
        f'- Of our {number(own * 1e6)} us, {number(compiled_times["making"] * 1e6)} us are spent '
        f'on making the integrator.\n'
        f'- Ours is on graded steps, which grow with depth; uniform steps are the default.\n'
        f'- The right-hand side of odeint and of the SciPy solvers is called from Python or '
        f'through it, 3 us or more each; DOP853, compiled, and diffrax are one call.',
    )
    return [section], []
