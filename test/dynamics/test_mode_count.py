# SPDX-License-Identifier: Apache-2.0
"""Any number of modes: integrals, both compiled paths, convergence to the exact beam, limits."""

from __future__ import annotations

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
import mpmath
from needle_dynamics import (
    FloatArray,
    Integrator,
    mode_shapes,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    ShapeError,
)
from needle_dynamics.compiled.integrals import many_modes, ModeIntegrals
from needle_dynamics.compiled.modal_flow import Elasticity, rotate_many, rotate_two
from needle_dynamics.parameters import LARGEST_CONDITION, MOST_MODES
import numpy as np
from numpy.linalg import cond
from numpy.polynomial.legendre import leggauss
from numpy.testing import assert_allclose
import pytest
from scipy.integrate import solve_ivp, trapezoid
from scipy.linalg import eigh, expm
from scipy.optimize import brentq

LENGTH = 0.2
EPS = np.finfo(float).eps
COUNTS = range(1, MOST_MODES + 1)
#: Least depth for each number of modes, with a margin.
SHALLOWEST = {1: 1e-3, 2: 1e-3, 3: 0.02, 4: 0.05, 5: 0.07, 6: 0.085, 8: 0.11, 12: 0.14}


def needle(n: int, **changes: Any) -> NeedleParameters:
    changes = {'minimum_depth': SHALLOWEST[n], **changes}
    return NeedleParameters.preset('paper_si', modes=n, **changes)


def frictionless(n: int, **changes: Any) -> NeedleParameters:
    return needle(n, coulomb_friction=0.0, viscous_friction=0.0, **changes)


def ringing(
    parameters: NeedleParameters, depth: float, speed: float, energy: float = 1e-4
) -> FloatArray:
    """Return a moving needle with kinetic energy [J] in every normal mode."""
    model = NeedleModel(parameters)
    state, m = model.state_at(depth, 5e-4), model.coordinates
    inertial = np.linalg.cholesky(model.mass_matrix(state)[2:, 2:])
    signs = np.where(np.arange(m - 2) % 2, -1.0, 1.0)
    state[m] = -speed
    state[m + 2 :] = np.linalg.solve(inertial.T, signs * np.sqrt(2.0 * energy))
    return state


# --- modes and their integrals --------------------------------------------------------------


def test_arguments_are_the_roots_of_the_frequency_equation() -> None:
    """The first twelve k_i l are the roots of cos x cosh x + 1, one in each half turn."""
    x = mode_shapes(LENGTH, MOST_MODES).arguments
    assert np.all(np.floor(x / np.pi) == np.arange(MOST_MODES))
    with mpmath.workdps(40):
        for root in x:
            exact = mpmath.findroot(lambda z: mpmath.cos(z) * mpmath.cosh(z) + 1, mpmath.mpf(root))
            assert abs(float(exact - root)) <= 4 * EPS * root


@pytest.mark.parametrize('i', [0, 1, 5, 11])
def test_high_modes_keep_full_precision(i: int) -> None:
    """Values and curvatures agree with (11) in 60 digits, where doubles lose cosh(38) = 1e16."""
    modes = mode_shapes(LENGTH, MOST_MODES)
    places = np.linspace(0.0, LENGTH, 23)
    with mpmath.workdps(60):
        x = mpmath.findroot(
            lambda z: mpmath.cos(z) * mpmath.cosh(z) + 1, mpmath.mpf(modes.arguments[i])
        )
        mu = (mpmath.sin(x) + mpmath.sinh(x)) / (mpmath.cos(x) + mpmath.cosh(x))
        c, k = 1 / (mu * mpmath.sqrt(LENGTH)), x / LENGTH
        turns = [k * mpmath.mpf(y) for y in places]
        value = [
            float(c * (mpmath.sin(z) - mpmath.sinh(z) - mu * (mpmath.cos(z) - mpmath.cosh(z))))
            for z in turns
        ]
        bend = [
            float(
                -c * k**2
                * (mpmath.sin(z) + mpmath.sinh(z) - mu * (mpmath.cos(z) + mpmath.cosh(z)))
            )
            for z in turns
        ]  # fmt: skip
    # Rounding of k y <= 36, in a function of order 1 / sqrt(l).
    size = 100 * EPS / np.sqrt(LENGTH)
    assert_allclose(modes.values(places)[:, i], value, atol=size)
    assert_allclose(
        modes.derivatives(places, 2)[:, i] / modes.wavenumbers[i] ** 2,
        np.array(bend) / modes.wavenumbers[i] ** 2,
        atol=size,
    )


@pytest.mark.parametrize('n', COUNTS)
def test_modes_are_orthonormal(n: int) -> None:
    """At full insertion G is the identity and H is diag(k^4), for every number of modes."""
    modes = mode_shapes(LENGTH, n)
    at = modes.integrals(LENGTH)
    assert_allclose(at.gram, np.eye(n), atol=1e-12)
    square = modes.wavenumbers**2
    # 1e-12: cancellation of boundary values of order one.
    assert_allclose(at.curvature_gram / np.outer(square, square), np.eye(n), atol=1e-12)


@pytest.mark.parametrize('n', [1, 3, 7, 12])
def test_integrals_agree_with_quadrature(n: int) -> None:
    """G, H, both moments and the values at s equal Gauss-Legendre quadrature of the modes."""
    modes = mode_shapes(LENGTH, n)
    nodes, weights = leggauss(120)
    for depth in np.geomspace(1e-3, LENGTH, 40):
        y, w = 0.5 * depth * (nodes + 1.0), 0.5 * depth * weights
        phi, bend = modes.values(y), modes.derivatives(y, 2)
        at = modes.integrals(depth)
        norm, curved = np.sqrt(w @ phi**2), np.sqrt(w @ bend**2)
        found = (
            (at.gram - phi.T * w @ phi) / np.outer(norm, norm),
            (at.curvature_gram - bend.T * w @ bend) / np.outer(curved, curved),
            (at.area - w @ phi) / (norm * np.sqrt(depth)),
            (at.moment - w * y @ phi) / (norm * np.sqrt(depth**3 / 3.0)),
            (at.value - modes.values(depth)) / (norm / np.sqrt(depth)),
            (at.curvature - modes.derivatives(depth, 2)) / (curved / np.sqrt(depth)),
        )
        # Relative to the Cauchy-Schwarz bounds. The direct form of phi in the reference cancels:
        # eps / (k s)^2 = 2e-12 at 1 mm; measured 8e-13.
        for part in found:
            assert np.abs(part).max() < 4e-12


@given(depth=st.floats(1e-3, 2.0 * LENGTH))
@settings(max_examples=100)
def test_general_path_matches_the_special_path_for_two_modes(depth: float) -> None:
    """The integrals for n = 2 are equal on both paths, also beyond the hub."""
    modes = mode_shapes(LENGTH, 2, 2.0)
    special = modes.integrals(depth)
    general = ModeIntegrals(*(np.empty_like(part) for part in special))
    many_modes(modes.tables, depth, np.empty(modes.tables.series.shape[1] + 8), general)
    # Diagonals of G and H bound the other entries; at 2 l the series of two modes loses cosh(19) =
    # 1e8 of its terms, in a result of the same size.
    norm, bend = (np.sqrt(np.diag(x)) for x in (special.gram, special.curvature_gram))
    sizes = (
        np.outer(norm, norm),
        np.outer(bend, bend),
        norm / np.sqrt(depth) * 4.0,
        bend / np.sqrt(depth) * 4.0,
        norm * np.sqrt(depth),
        norm * np.sqrt(depth**3 / 3.0),
    )
    for one, other, size in zip(special, general, sizes, strict=True):
        assert_allclose(other / size, one / size, atol=1e-11)


@pytest.mark.parametrize('formulation', ['complete', 'as_printed'])
@pytest.mark.parametrize('depth', [2e-3, 0.02, 0.1, 0.2])
def test_general_modal_flow_matches_the_special_flow_for_two_modes(
    depth: float, formulation: str
) -> None:
    """State, impulse and every mean of one step agree between both compiled modal flows."""
    parameters = NeedleParameters.preset(
        'phantom', formulation=formulation, layer_depths=[0.05], layer_stiffnesses=[3e3]
    )
    model, layer, growth = NeedleModel(parameters), int(depth >= 0.05), 1.25
    stiffness = growth * model.tissue.stiffness(depth)
    layers, at = model.tissue.layers(model.modes), model.modes.integrals(depth)
    state = ringing(parameters, depth, 0.0)
    q, z = state[2:4].copy(), state[6:8].copy()
    if formulation == 'complete':
        z = model.mass_matrix(state)[2:, 2:] @ z
    p, printed = parameters, formulation == 'as_printed'
    elasticity = Elasticity(
        p.linear_density, p.bending_stiffness, p.tissue_damping, printed,
        layer, stiffness, growth, 0.99,
    )  # fmt: skip
    other_q, other_z = q.copy(), z.copy()
    special = rotate_two(elasticity, layers, at, q, z, 1e-5)
    general = rotate_many(elasticity, layers, at, other_q, other_z, 1e-5)
    # Rounding times sqrt(cond G) = 3e3 at 2 mm, for each of a dozen sums: 1e-10.
    for one, other in ((q, other_q), (z, other_z), (special, general)):
        assert_allclose(one, other, rtol=1e-10, atol=1e-10 * np.abs(other).max())
    assert (general.impulse == 0.0) == printed


# --- convergence ----------------------------------------------------------------------------


def exact_frequencies(parameters: NeedleParameters, depth: float, count: int) -> FloatArray:
    """Angular frequencies of a clamped-free beam of this length on an elastic foundation."""
    p = parameters
    turns = np.array(
        [
            brentq(lambda x: np.cos(x) + 1.0 / np.cosh(x), i * np.pi, (i + 1) * np.pi, xtol=1e-15)
            for i in range(count)
        ]
    )
    bending = p.bending_stiffness * (turns / depth) ** 4
    return np.asarray(np.sqrt((bending + p.tissue_stiffness) / p.linear_density))


def exact_compliance(parameters: NeedleParameters, depth: float) -> float:
    """Tip deflection per tip load of the same beam: E I w'''' + k w = 0, solved in closed form."""
    k = parameters.tissue_stiffness
    decay = (k / (4.0 * parameters.bending_stiffness)) ** 0.25
    x = decay * depth
    top = np.sinh(x) * np.cosh(x) - np.sin(x) * np.cos(x)
    return float(2.0 * decay / k * top / (np.cosh(x) ** 2 + np.cos(x) ** 2))


def test_closed_form_compliance_solves_the_beam_equation() -> None:
    """The reference is checked against the boundary value problem, solved by shooting."""
    p, depth = NeedleParameters(), 0.15

    def end(moment: float, shear: float) -> FloatArray:
        solved = solve_ivp(
            lambda _, w: [w[1], w[2], w[3], -p.tissue_stiffness / p.bending_stiffness * w[0]],
            (0.0, depth),
            [0.0, 0.0, moment, shear],
            method='DOP853',
            rtol=1e-12,
            atol=1e-15,
        )
        return np.asarray(solved.y[:, -1])

    ends = np.column_stack([end(1.0, 0.0), end(0.0, 1.0)])
    load = np.linalg.solve(p.bending_stiffness * ends[2:], [0.0, -1.0])
    # Tolerance of the solver.
    assert_allclose(exact_compliance(p, depth), ends[0] @ load, rtol=1e-9)


@pytest.mark.parametrize(('depth', 'most', 'good'), [(0.1, 7, 1e-6), (0.15, 12, 1e-7)])
def test_frequencies_converge_from_above_to_the_exact_beam(
    depth: float, most: int, good: float
) -> None:
    """With every additional mode the first three frequencies approach the exact values."""
    exact = exact_frequencies(NeedleParameters(), depth, 3)
    before = np.full(3, np.inf)
    for n in range(1, most + 1):
        model = NeedleModel(NeedleParameters(modes=n, minimum_depth=depth))
        gram = model.parameters.linear_density * model.modes.integrals(depth).gram
        square = eigh(model.stiffness_matrix(depth), gram, eigvals_only=True)
        excess = np.full(3, np.inf)
        excess[: min(n, 3)] = np.sqrt(square[:3]) / exact[: min(n, 3)] - 1.0
        # Rayleigh-Ritz; rounding is cond(G) eps = 1e-6 of the highest square at worst.
        assert np.all(excess > -1e-10)
        assert np.all((excess <= before) | np.isinf(excess))
        before = excess
    # Measured: 7e-11, 8e-9, 1e-7 at 10 cm with 7; 3e-11, 3e-9, 3e-8 at 15 cm with 12.
    assert np.all(before < good)


@pytest.mark.parametrize(
    ('depth', 'most', 'good'), [(0.1, 7, 1e-9), (0.15, 12, 1e-8), (0.2, 12, 1e-4)]
)
def test_static_tip_deflection_converges_from_below_to_the_exact_beam(
    depth: float, most: int, good: float
) -> None:
    """A beam with few modes is too stiff under a tip load."""
    exact = exact_compliance(NeedleParameters(), depth)
    before = 0.0
    for n in range(1, most + 1):
        model = NeedleModel(NeedleParameters(modes=n, minimum_depth=min(depth, 0.19)))
        value = model.modes.integrals(depth).value
        now = float(value @ np.linalg.solve(model.stiffness_matrix(depth), value))
        assert before < now < exact * (1.0 + 1e-10)
        before = now
    # Below the full length convergence is geometric (measured 8e-11 and 1e-9); at full length no
    # mode has shear at the tip, and the error decreases only as n^-3 (measured 8e-5).
    assert before > exact * (1.0 - good)


def test_at_full_insertion_the_modes_are_exact() -> None:
    """At s = l each frequency equals the beam frequency, for any number of modes."""
    for n in (1, 2, 5, 12):
        model = NeedleModel(NeedleParameters(modes=n, minimum_depth=0.19))
        stiffness = model.stiffness_matrix(LENGTH)
        exact = model.parameters.linear_density * exact_frequencies(model.parameters, LENGTH, n)
        exact *= exact_frequencies(model.parameters, LENGTH, n)
        size = np.sqrt(np.outer(exact, exact))
        # Boundary values of order one cancel in the closed forms.
        assert_allclose(stiffness / size, np.diag(exact) / size, atol=1e-12)


# --- motion ---------------------------------------------------------------------------------


@pytest.mark.parametrize(('n', 'depth'), [(1, 0.02), (3, 0.03), (6, 0.1)])
def test_modal_flow_is_exact_while_the_needle_sticks(n: int, depth: float) -> None:
    """At constant depth n undamped modes follow the matrix exponential, for any step."""
    p = needle(n, coulomb_friction=1e3)
    model, state, m = NeedleModel(p), ringing(p, depth, 0.0, 1e-6), 2 + n
    inertial = np.linalg.cholesky(model.mass_matrix(state)[2:, 2:])
    # In coordinates of unit mass, for comparable modes.
    stiffness = np.linalg.solve(inertial, model.stiffness_matrix(depth))
    stiffness = np.linalg.solve(inertial, stiffness.T)
    system = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, np.zeros((n, n))]])
    end = expm(1e-3 * system) @ np.concatenate(
        [inertial.T @ state[2:m], inertial.T @ state[m + 2 :]]
    )
    it = Integrator(p, state, 1e-3)
    it.advance(1e-3)
    assert it.depth == p.length - state[0]
    scale = np.abs(end[n:]).max()
    # Rounding times cond(G), 2e9 at worst, and a phase of 270 rad: measured 2.5e-8.
    assert_allclose(inertial.T @ it.state[m + 2 :] / scale, end[n:] / scale, atol=1e-6)


@pytest.mark.parametrize('n', [1, 3, 5])
def test_order_two_against_an_ode_solver(n: int) -> None:
    """A moving, vibrating needle of n modes converges at order two to DOP853."""
    p, depth = needle(n), 1.2 * SHALLOWEST[n] + 0.03
    model, start = NeedleModel(p), ringing(p, depth, 1.0, 1e-6)
    solved = solve_ivp(
        lambda _, x: model.derivative(x, 2.0),
        (0.0, 2e-3),
        start,
        method='DOP853',
        rtol=1e-10,
        atol=1e-13,
    ).y[:, -1]
    errors = []
    for step in (4e-6, 2e-6, 1e-6):
        it = Integrator(p, start, step)
        it.advance(2e-3, 2.0)
        difference = it.state - solved
        difference[0] = solved[0]
        errors.append(np.sqrt(model.energy(difference) / model.energy(solved)))
    # Measured: slopes 1.997 to 2.005, last errors 1.4e-8, 1.3e-7, 2.2e-8.
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert_allclose(slopes, 2.0, atol=0.05)
    assert errors[-1] < 1e-6


@pytest.mark.parametrize('n', [1, 3, 5])
def test_energy_error_is_of_second_order(n: int) -> None:
    """Without friction, for n modes."""
    p, start_depth = frictionless(n), 1.2 * SHALLOWEST[n] + 0.03
    start = ringing(p, start_depth, 1.0, 1e-5)
    model = NeedleModel(p)
    errors = []
    for step in (8e-6, 4e-6, 2e-6):
        it = Integrator(p, start, step)
        it.advance(0.04)
        errors.append(abs(model.energy(it.state) / model.energy(start) - 1.0))
    assert it.depth > start_depth + 0.03
    assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2.0, atol=0.1)
    # Measured 1.1e-8 to 5.1e-8.
    assert errors[-1] < 1e-7


def test_means_agree_with_fine_samples_of_the_motion() -> None:
    """Tip, lateral force and moment of four modes match the momentum balance."""
    p = needle(4)
    model, step, steps = NeedleModel(p), 5e-7, 400
    whole, single = (Integrator(p, ringing(p, 0.08, 0.5, 1e-7), step) for _ in range(2))
    total = whole.advance(steps * step, 3.0)
    states = [single.state]
    for _ in range(steps):
        single.advance(step, 3.0)
        states.append(single.state)
    time, course = np.arange(steps + 1) * step, np.array(states)
    at = [model.modes.integrals(p.length - x[0]) for x in states]
    momentum = [[a.area @ x[8:], a.moment @ x[8:]] for a, x in zip(at, states, strict=True)]
    shift = [[a.area @ x[2:6], a.moment @ x[2:6]] for a, x in zip(at, states, strict=True)]
    load = p.linear_density * np.gradient(momentum, time, axis=0, edge_order=2)
    load += p.tissue_stiffness * np.array(shift)
    tips = np.array([model.tip_deflection(x) for x in states])
    moment = load[:, 1] + course[:, 0] * load[:, 0]
    for name, seen in (
        ('tip_deflection', tips),
        ('lateral_force', load[:, 0]),
        ('moment', moment),
    ):
        mean = trapezoid(seen, time) / (steps * step)
        # Differences and trapezoids at 20 kHz: (omega h)^2 / 6 = 7e-4 of the amplitude.
        assert_allclose(getattr(total, name), mean, atol=1e-3 * np.abs(seen).max(), err_msg=name)


# --- limits ---------------------------------------------------------------------------------


@pytest.mark.parametrize('n', COUNTS)
def test_ill_conditioned_mode_counts_are_rejected_with_the_least_depth(n: int) -> None:
    """The message contains cond(G), its limit and the least depth, which is valid."""
    if n <= 2:
        assert NeedleModel(NeedleParameters(modes=n)).coordinates == 2 + n
        return
    with pytest.raises(ParameterError) as caught:
        NeedleParameters(modes=n)
    message = str(caught.value)
    assert message.startswith(
        f'{n} modes cannot be distinguished at minimum_depth = 0.001 m, where cond(G) > 1e+11'
    )
    advice = float(message.partition('minimum_depth >= ')[2].partition(' m')[0])
    made = NeedleParameters(modes=n, minimum_depth=advice)
    assert cond(mode_shapes(LENGTH, n).integrals(made.minimum_depth).gram) <= LARGEST_CONDITION
    # Rounded up to 0.1 mm, not more than needed.
    with pytest.raises(ParameterError):
        NeedleParameters(modes=n, minimum_depth=0.9 * advice)


@pytest.mark.parametrize('n', [0, -1, 13, 2.0, 2.5, True, '2', None, np.nan])
def test_mode_count_must_be_an_integer_from_1_to_12(n: Any) -> None:
    with pytest.raises(ParameterError, match='modes must be an integer from 1 to 12, got'):
        NeedleParameters(modes=n)


def test_condition_number_decreases_with_depth() -> None:
    """cond(G) is one at full length and grows without bound at small depths."""
    for n in (2, 5, 8):
        modes = mode_shapes(LENGTH, n)
        found = [cond(modes.integrals(depth).gram) for depth in (0.2, 0.17, 0.14, 0.11)]
        assert_allclose(found[0], 1.0, rtol=1e-11)
        assert np.all(np.diff(found) > 0.0)


@pytest.mark.parametrize('n', [1, 3, 12])
def test_state_shape_depends_on_the_number_of_modes(n: int) -> None:
    """Only shape (2 (2 + n),) is valid; the message contains both shapes."""
    model = NeedleModel(needle(n))
    assert model.coordinate_names == ('d', 'theta', *(f'q{i + 1}' for i in range(n)))
    assert model.state_at(0.15, 1e-3).shape == (4 + 2 * n,)
    assert_allclose(model.tip_deflection(model.state_at(0.15, 1e-3)), 1e-3, rtol=1e-9)
    if n != 2:
        with pytest.raises(ShapeError, match=rf'must have shape \({4 + 2 * n},\), got \(8,\)'):
            Integrator(needle(n), np.zeros(8))
