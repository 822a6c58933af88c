# SPDX-License-Identifier: Apache-2.0
"""Solvers of diffrax in JAX, of order 8 and 5, compiled by XLA with the equations of motion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeAlias

from benchmarks.measure import optional
from needle_dynamics import FloatArray, NeedleModel
from needle_dynamics.compiled.integrals import TERMS_PER_LENGTH
import numpy as np

jax: Any = optional('jax')
diffrax: Any = optional('diffrax')

#: Names of the solvers; none if JAX or diffrax is not installed.
METHODS: Final = ('diffrax Dopri8', 'diffrax Tsit5') if jax and diffrax else ()

#: Columns of the series of two modes: G, H, phi and phi''.
_COLUMNS: Final = 26

#: Runs from a state with relative and absolute tolerances; returns times, states and steps.
Solve: TypeAlias = Callable[[FloatArray, float, FloatArray], tuple[FloatArray, FloatArray, int]]


def _equations(model: NeedleModel, force: float) -> Callable[[Any, Any, Any], Any]:
    """Return the time derivative of the state for a constant insertion force [N]."""
    p, jnp = model.parameters, jax.numpy
    # As many terms as the depths of the needle need.
    tables = model.modes.tables
    series = jnp.asarray(tables.series[: int(tables.terms[TERMS_PER_LENGTH]), :_COLUMNS])
    rho, ei, ka, ca = p.linear_density, p.bending_stiffness, p.tissue_stiffness, p.tissue_damping

    def derivative(_time: Any, x: Any, _data: Any) -> Any:
        # A trial state of a solver may be outside the range.
        depth = jnp.clip(p.length - x[0], 0.0, p.length)
        xi = depth / p.length
        square = xi * xi
        z = square * square
        work = series[-1]
        for row in series[-2::-1]:
            work = work * z + row
        cubic = work[:18].reshape(6, 3) @ jnp.stack([jnp.ones(()), xi, square])
        linear = work[18:].reshape(4, 2) @ jnp.stack([jnp.ones(()), xi])
        g11, g12, g22 = z * xi * cubic[:3]
        h11, h12, h22 = xi * cubic[3:]
        phi, bend = square * linear[:2], linear[2:]
        q1, q2, r1, r2 = x[2], x[3], x[6], x[7]
        speed = -x[4]
        value, rate = phi[0] * q1 + phi[1] * q2, phi[0] * r1 + phi[1] * r2
        curvature = bend[0] * q1 + bend[1] * q2
        drive = force + 0.5 * (rho * rate**2 - ei * curvature**2 - ka * value**2)
        friction = jnp.where(
            speed == 0.0,
            jnp.clip(drive, -p.coulomb_friction, p.coulomb_friction),
            jnp.sign(speed) * p.coulomb_friction + p.viscous_friction * speed,
        )
        k12 = ei * h12 + ka * g12
        f1 = rho * x[4] * phi[0] * rate - (ei * h11 + ka * g11) * q1 - k12 * q2
        f2 = rho * x[4] * phi[1] * rate - k12 * q1 - (ei * h22 + ka * g22) * q2
        f1 -= ca * (g11 * r1 + g12 * r2)
        f2 -= ca * (g12 * r1 + g22 * r2)
        determinant = rho * (g11 * g22 - g12 * g12)
        return jnp.stack([
            x[4], x[5], r1, r2, (friction - drive) / p.moving_mass, jnp.zeros(()),
            (g22 * f1 - g12 * f2) / determinant, (g11 * f2 - g12 * f1) / determinant,
        ])  # fmt: skip

    return derivative


def build_solver(
    model: NeedleModel, force: float, duration: float, name: str, stored: int
) -> Solve:
    """Return one of `METHODS` for a run [s]; it keeps ``stored`` steps, or the final state."""
    jax.config.update('jax_enable_x64', True)
    term, method = diffrax.ODETerm(_equations(model, force)), getattr(diffrax, name.split()[1])()
    kept = diffrax.SaveAt(t0=True, steps=True) if stored else diffrax.SaveAt(t1=True)

    def solve(start: Any, relative: Any, absolute: Any) -> Any:
        control = diffrax.PIDController(rtol=relative, atol=absolute)
        found = diffrax.diffeqsolve(
            term, method, 0.0, duration, None, start, saveat=kept, stepsize_controller=control,
            max_steps=stored or None, adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        return found.ts, found.ys, found.stats['num_steps'], found.stats['num_accepted_steps']

    compiled = jax.jit(solve)

    def run(start: FloatArray, relative: float, absolute: FloatArray) -> Any:
        ts, ys, steps, accepted = jax.block_until_ready(compiled(start, relative, absolute))
        count = int(accepted) + 1 if stored else 1
        return np.asarray(ts)[:count], np.asarray(ys)[:count], int(steps)

    return run
