# SPDX-License-Identifier: Apache-2.0
"""Derivation of the equations of motion with SymPy: Euler-Lagrange on T and V of (12)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import cache
from typing import Any

from needle_dynamics import FloatArray, NeedleModel, NeedleParameters
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.integrate import fixed_quad
import sympy as sp

#: The Lagrangian covers needle and tissue only; (14) adds friction.
MODEL = NeedleModel(NeedleParameters(coulomb_friction=0.0, viscous_friction=0.0))
PRINTED = NeedleModel(
    NeedleParameters(coulomb_friction=0.0, viscous_friction=0.0, formulation='as_printed')
)

T, Y = sp.symbols('t y', real=True)
L, RHO, EI, K, INERTIA = sp.symbols('l rho EI k I', positive=True)
FORCE, TORQUE = sp.symbols('f tau', real=True)
COORDINATES = [sp.Function(name)(T) for name in ('d', 'theta', 'q1', 'q2')]
RATES = [x.diff(T) for x in COORDINATES]
PHI = [sp.Function(f'phi{i}') for i in (1, 2)]
TIP = L - COORDINATES[0]
PAIRS = [(0, 0), (0, 1), (1, 1)]


def lagrangian() -> Any:
    """Return (12) with undetermined mode functions and integrals up to l - d."""
    d_rate, turn, *modal_rate = RATES
    modal = COORDINATES[2:]
    w = sum(q * phi(Y) for q, phi in zip(modal, PHI, strict=True))
    w_rate = sum(v * phi(Y) for v, phi in zip(modal_rate, PHI, strict=True))

    def along(density: Any) -> Any:
        """Integrate a quadratic form term by term, as printed in (12)."""
        terms = sp.Add.make_args(sp.expand(density))
        total = sp.Integer(0)
        for term in terms:
            outside, inside = term.as_independent(Y)
            total += outside * sp.Integral(inside, (Y, 0, TIP))
        return total

    kinetic = RHO * L * d_rate**2 / 2 + RHO / 2 * along(w_rate**2) + INERTIA * turn**2 / 4
    return kinetic - EI / 2 * along(w.diff(Y, 2) ** 2) - K / 2 * along(w**2)


@cache
def equations() -> tuple[Any, Any]:
    """Derive M and N of (13) by (3), with accelerations, rates and integrals as symbols."""
    energy = lagrangian()
    rows = [
        (energy.diff(rate).diff(T) - energy.diff(x)).doit(integrals=False)
        for x, rate in zip(COORDINATES, RATES, strict=True)
    ]
    accelerations = sp.symbols('a0:4')
    named = [
        sp.expand(row).subs(
            {x.diff(T, 2): a for x, a in zip(COORDINATES, accelerations, strict=True)}
        )
        for row in rows
    ]
    mass = sp.Matrix(4, 4, lambda i, j: sp.expand(named[i]).coeff(accelerations[j]))
    rest = sp.Matrix([sp.expand(row.subs(dict.fromkeys(accelerations, 0))) for row in named])
    return mass, rest


# Symbols for the quantities that remain open in the derivation.
SHAPES = sp.symbols('G11 G12 G22 H11 H12 H22 phi1 phi2 bend1 bend2')
PLACES = sp.symbols('x0:4')
SPEEDS = sp.symbols('v0:4')


def closed(expression: Any) -> Any:
    """Replace integrals, tip values, coordinates and rates by plain symbols."""
    names: dict[Any, Any] = {}
    for offset, order in ((0, 0), (3, 2)):
        for k, (i, j) in enumerate(PAIRS):
            inside = PHI[i](Y).diff(Y, order) * PHI[j](Y).diff(Y, order)
            names[sp.Integral(inside, (Y, 0, TIP))] = SHAPES[offset + k]

    def tip_value(x: Any) -> Any:
        """Replace phi and phi'' at l - d by symbols."""
        for i, phi in enumerate(PHI):
            if x == phi(TIP):
                return SHAPES[6 + i]
            if x == sp.Subs(phi(Y).diff(Y, 2), Y, TIP):
                return SHAPES[8 + i]
        return x

    named = expression.xreplace(names)
    named = named.replace(lambda x: isinstance(x, sp.Subs) or x.func in PHI, tip_value)
    named = named.xreplace(dict(zip(RATES, SPEEDS, strict=True)))
    return named.xreplace(dict(zip(COORDINATES, PLACES, strict=True)))


@cache
def functions() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compile the derived M and N to functions of shapes, state and constants."""
    arguments = [SHAPES, PLACES, SPEEDS, (L, RHO, EI, K, INERTIA)]
    matrices = [closed(matrix) for matrix in equations()]
    for matrix in matrices:
        known = {*SHAPES, *PLACES, *SPEEDS, L, RHO, EI, K, INERTIA}
        # No integral, derivative or undefined function remains.
        assert matrix.free_symbols <= known
        assert not matrix.atoms(sp.Integral, sp.Derivative, sp.Subs, sp.Function)
    return sp.lambdify(arguments, matrices[0]), sp.lambdify(arguments, matrices[1])


def shapes(depth: float) -> FloatArray:
    """Integrals by quadrature of (11) and tip values, independent of the code under test."""
    modes = MODEL.modes

    def products(y: FloatArray) -> FloatArray:
        phi, bend = modes.values(y).T, modes.derivatives(y, 2).T
        return np.array([f[i] * f[j] for f in (phi, bend) for i, j in PAIRS])

    integrals = fixed_quad(products, 0.0, depth, n=40)[0]
    return np.concatenate([integrals, modes.values(depth), modes.derivatives(depth, 2)])


def states() -> list[FloatArray]:
    """Draw states with similar kinetic and elastic energy in each mode."""
    rng = np.random.default_rng(2014)
    found = []
    for _ in range(30):
        state = MODEL.state_at(rng.uniform(0.01, 0.19))
        state[1], state[4], state[5] = rng.normal(size=3) * [0.1, 0.5, 30.0]
        elastic = np.linalg.cholesky(MODEL.stiffness_matrix(0.2 - state[0]))
        inertial = np.linalg.cholesky(MODEL.mass_matrix(state)[2:, 2:])
        state[2:4] = np.linalg.solve(elastic.T, rng.normal(size=2)) * 0.04
        state[6:8] = np.linalg.solve(inertial.T, rng.normal(size=2)) * 0.04
        found.append(state)
    return found


def derived(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evaluate the derived M and N at a state."""
    p = MODEL.parameters
    constants = (p.length, p.linear_density, p.bending_stiffness, p.tissue_stiffness)
    arguments = (shapes(p.length - x[0]), x[:4], x[4:], (*constants, p.rotary_inertia))
    mass, rest = (np.array(f(*arguments), dtype=float) for f in functions())
    return mass, rest[:, 0]


def test_derived_mass_matrix_has_the_structure_of_the_source() -> None:
    """M is symmetric and block diagonal: d and theta are decoupled, the modes share a block."""
    mass, _ = equations()
    assert (mass - mass.T).is_zero_matrix
    assert mass[0, 0] == RHO * L
    assert mass[1, 1] == INERTIA / 2
    assert all(mass[i, j] == 0 for i in (0, 1) for j in range(4) if i != j)


def test_derived_row_of_d_is_not_zero() -> None:
    """Row d of N is (rho (phi q_dot)^2 - E I (phi'' q)^2 - k (phi q)^2) / 2 at the tip."""
    _, rest = equations()
    phi1, phi2, bend1, bend2 = SHAPES[6:]
    _, _, q1, q2 = PLACES
    _, _, v1, v2 = SPEEDS
    expected = RHO * (phi1 * v1 + phi2 * v2) ** 2 - EI * (bend1 * q1 + bend2 * q2) ** 2
    expected -= K * (phi1 * q1 + phi2 * q2) ** 2
    assert sp.expand(closed(rest[0]) - expected / 2) == 0


def test_derived_modal_rows_contain_the_rate_of_the_mass() -> None:
    """The modal rows are (E I H + k G) q - rho d_dot phi phi^T q_dot, from dG/dt."""
    _, rest = equations()
    g11, g12, g22, h11, h12, h22, phi1, phi2, *_ = SHAPES
    gram, bends = sp.Matrix([[g11, g12], [g12, g22]]), sp.Matrix([[h11, h12], [h12, h22]])
    value, modal, rates = sp.Matrix([phi1, phi2]), sp.Matrix(PLACES[2:]), sp.Matrix(SPEEDS[2:])
    expected = (EI * bends + K * gram) * modal - RHO * SPEEDS[0] * value * value.T * rates
    found = closed(sp.Matrix(rest[2:]))
    assert (found - expected).applyfunc(sp.expand).is_zero_matrix


def test_model_equals_the_derivation() -> None:
    """Mass matrix, bias forces and accelerations of `complete` equal the derivation."""
    rng = np.random.default_rng(1)
    for x in states():
        mass, rest = derived(x)
        # The quadrature of (11) cancels by 1 / (k s)^2 = 100 at 1 cm.
        size = np.sqrt(np.outer(np.diag(mass), np.diag(mass)))
        assert_allclose(MODEL.mass_matrix(x) / size, mass / size, atol=1e-12)
        # Magnitude of the terms: they cancel by up to sqrt(cond G) = 1e3.
        modal = np.abs(MODEL.stiffness_matrix(0.2 - x[0])) @ np.abs(x[2:4])
        at = shapes(0.2 - x[0])
        tip = (at[8:] @ x[2:4]) ** 2 * MODEL.parameters.bending_stiffness
        assert_allclose(MODEL.bias_forces(x)[2:] / modal, rest[2:] / modal, atol=1e-11)
        assert_allclose(MODEL.bias_forces(x)[0], rest[0], atol=1e-8 * (abs(rest[0]) + tip))
        assert MODEL.bias_forces(x)[1] == rest[1] == 0.0
        force, torque = rng.normal(size=2) * [3.0, 1e-4]
        # A positive force shortens d: Q_d = -f_y.
        expected = np.linalg.solve(mass, [-force, torque, 0.0, 0.0] - rest)
        found = MODEL.acceleration(x, force, torque)
        assert_allclose(found[:2], expected[:2], rtol=1e-7)
        # In coordinates of unit mass, for comparable modes.
        inertial = np.linalg.cholesky(mass[2:, 2:]).T
        size = np.abs(inertial @ expected[2:]).max()
        assert_allclose(inertial @ found[2:] / size, inertial @ expected[2:] / size, atol=1e-7)


def test_printed_form_is_the_derivation_without_two_terms() -> None:
    """Without row d and the terms with d_dot in the modal rows, N equals the printed form."""
    _, rest = equations()
    printed = closed(rest)
    printed[0] = sp.Integer(0)
    printed = printed.subs(SPEEDS[0], 0)
    g11, g12, g22, h11, h12, h22, *_ = SHAPES
    q1, q2 = PLACES[2:]
    # The third and the fourth equation of the source, term by term.
    assert sp.expand(printed[2] - (EI * (q1 * h11 + q2 * h12) + K * (q1 * g11 + q2 * g12))) == 0
    assert sp.expand(printed[3] - (EI * (q2 * h22 + q1 * h12) + K * (q2 * g22 + q1 * g12))) == 0
    assert not set(SPEEDS) & printed.free_symbols
    evaluate = sp.lambdify([SHAPES, PLACES, (EI, K)], printed)
    p = PRINTED.parameters
    for x in states():
        at = shapes(p.length - x[0])
        constants = (p.bending_stiffness, p.tissue_stiffness)
        expected = np.array(evaluate(at, x[:4], constants), dtype=float)[:, 0]
        found = PRINTED.bias_forces(x)
        modal = np.abs(PRINTED.stiffness_matrix(0.2 - x[0])) @ np.abs(x[2:4])
        assert np.all(found[:2] == 0.0)
        assert_allclose(found[2:] / modal, expected[2:] / modal, atol=1e-11)
        assert np.array_equal(PRINTED.mass_matrix(x), MODEL.mass_matrix(x))


def test_derived_equations_conserve_energy() -> None:
    """Along the derived equations d(T + V)/dt is identically the power of force and torque."""
    energy = lagrangian()
    kinetic = sum(rate * energy.diff(rate) for rate in RATES) / 2
    total = 2 * kinetic - energy
    mass, rest = equations()
    accelerations = mass.LUsolve(sp.Matrix([-FORCE, TORQUE, 0, 0]) - rest)
    rate = total.diff(T).doit(integrals=False)
    for x, a in zip(COORDINATES, accelerations, strict=True):
        rate = rate.subs(x.diff(T, 2), a)
    power = -FORCE * SPEEDS[0] + TORQUE * SPEEDS[1]
    assert sp.simplify(sp.together(closed(rate) - power)) == 0


def test_equation_9_halves_the_tissue_energy_twice() -> None:
    """Integration of w dw gives w^2 / 2, so the factor in (9) gives a quarter; (12) is V."""
    w = sp.Symbol('w')
    ninth = sp.Rational(1, 2) * K * sp.integrate(w, w)
    seventh = sp.integrate(K * w, w)
    assert ninth == K * w**2 / 4
    assert seventh == K * w**2 / 2
    x = states()[0]
    at = shapes(0.2 - x[0])
    squared = at[0] * x[2] ** 2 + 2.0 * at[1] * x[2] * x[3] + at[2] * x[3] ** 2
    free = NeedleModel(NeedleParameters(tissue_stiffness=0.0))
    held = MODEL.potential_energy(x) - free.potential_energy(x)
    # The tissue has a fraction of V that is up to 1e3 times smaller than the bending energy.
    assert_allclose(held, 0.5 * 520.0 * squared, rtol=1e-7)


def test_rotational_energy_has_the_factor_one_quarter() -> None:
    """T_R is half the integral of I theta_dot, a quarter of I theta_dot^2, so that M22 = I / 2."""
    turn = sp.Symbol('w')
    printed = sp.integrate(INERTIA * turn, turn) / 2
    assert printed == INERTIA * turn**2 / 4
    state = MODEL.state_at(0.1)
    state[5] = 2.0
    assert_allclose(MODEL.kinetic_energy(state), MODEL.parameters.rotary_inertia, rtol=1e-15)
    assert_allclose(
        MODEL.acceleration(state, torque=1e-9)[1],
        2e-9 / MODEL.parameters.rotary_inertia,
        rtol=1e-15,
    )


@pytest.mark.parametrize('i', [0, 1])
def test_derivative_of_the_integrals_is_the_integrand_at_the_tip(i: int) -> None:
    """Leibniz rule, omitted in the printed equations: d/dd of G is -phi phi^T at l - d."""
    integral = sp.Integral(PHI[i](Y) ** 2, (Y, 0, TIP))
    assert integral.diff(COORDINATES[0]) == -(PHI[i](TIP) ** 2)
    assert integral.diff(T) == -(PHI[i](TIP) ** 2) * RATES[0]


def test_gravity_is_not_in_the_equations() -> None:
    """The derived equations contain only the constants of needle and tissue, as does the code."""
    mass, rest = equations()
    constants = (mass.free_symbols | rest.free_symbols) - {T, Y}
    assert constants == {L, RHO, EI, K, INERTIA}
    assert not [item.name for item in fields(NeedleParameters) if 'gravity' in item.name]


def test_table_3_is_a_round_needle_except_for_one_row() -> None:
    """A and I_y belong to a round needle of 1.27 mm; I_x is neither of its moments."""
    p, diameter = MODEL.parameters, 1.27e-3
    # Table 3 has three digits.
    assert_allclose(p.area, np.pi / 4.0 * diameter**2, rtol=5e-3)
    assert_allclose(p.area_moment, np.pi / 64.0 * diameter**4, rtol=5e-3)
    polar = np.pi / 32.0 * diameter**4
    about_axis = p.linear_density * p.length * diameter**2 / 8.0
    about_base = p.linear_density * p.length**3 / 3.0
    for moment in (p.area_moment, polar, about_axis, about_base):
        assert not 0.5 < p.rotary_inertia / moment < 2.0
    # Used as a mass moment: the acceleration under a torque is 2 tau / I_x, rad/s^2 per N m.
    assert_allclose(MODEL.mass_matrix(MODEL.state_at(0.1))[1, 1], 0.5 * 1.0626e-9, rtol=1e-15)


def test_curl_of_a_linear_field_is_the_antisymmetric_part() -> None:
    """For F = -k x the curl is k_zx - k_xz: zero for a symmetric k, constant for any other."""
    x, z, kxx, kxz, kzx, kzz = sp.symbols('x z k_xx k_xz k_zx k_zz', real=True)
    stiffness = sp.Matrix([[kxx, kxz], [kzx, kzz]])
    force = -stiffness * sp.Matrix([x, z])
    assert force[0].diff(z) - force[1].diff(x) == kzx - kxz
    half = (stiffness - stiffness.T) / 2
    spring = -(stiffness - half) * sp.Matrix([x, z])
    assert sp.simplify(spring[0].diff(z) - spring[1].diff(x)) == 0
