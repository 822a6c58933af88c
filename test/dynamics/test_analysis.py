# SPDX-License-Identifier: Apache-2.0
"""Linearization (19), controllability and observability."""

from __future__ import annotations

from itertools import product
from typing import Any

from needle_dynamics import (
    FloatArray,
    InsertionDepthError,
    NeedleError,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    ShapeError,
)
from needle_dynamics.analysis import analyze, controllability, controllability_map, observability
from needle_dynamics.linearization import linearize, LinearSystem, operating_point, StuckError
import numpy as np
from numpy.linalg import cond
from numpy.testing import assert_allclose
from numpy.typing import NDArray
import pytest
from scipy.integrate import solve_ivp

preset = NeedleParameters.preset

#: Least depth at which n modes are distinguishable.
LEAST_DEPTH = {1: 0.001, 2: 0.001, 3: 0.03, 4: 0.05}

LAYERS: dict[str, Any] = {
    'layer_depths': (0.03, 0.11),
    'layer_stiffnesses': (4000.0, 90.0),
    'swelling': 0.5,
    'swelling_time': 2.0,
    'tissue_damping': 1.6,
    'carriage_mass': 0.3,
}

FRICTIONS: list[dict[str, Any]] = [
    {},
    {'friction_law': 'stribeck', 'breakaway_friction': 1.7, 'withdrawal_friction': 0.6},
    {'friction_law': 'tanh', 'smoothing_speed': 0.01, 'withdrawal_friction': 0.6},
]


def model(name: str = 'paper_si', **changes: Any) -> NeedleModel:
    return NeedleModel(preset(name, **changes))


def many(modes: int = 2, **changes: Any) -> NeedleModel:
    return model(modes=modes, minimum_depth=LEAST_DEPTH[modes], **changes)


def at_point(of: NeedleModel, *point: float, sliding: str | None = None) -> LinearSystem:
    return linearize(of, operating_point(of, *point), sliding=sliding)


def random_state(of: NeedleModel, rng: np.random.Generator) -> FloatArray:
    """Draw a state in which all terms contribute: millimeters of each mode, and rates."""
    low = max(0.01, 1.5 * of.parameters.minimum_depth)
    at = at_point(of, rng.uniform(low, 0.19), 0.0, 0.01)
    state = at.transform @ (0.01 * rng.normal(size=2 * of.coordinates))
    state[0] = of.parameters.length - at.output_scale
    return state


def field(
    of: NeedleModel, x: NDArray[Any], force: complex, torque: complex, time: float
) -> NDArray[Any]:
    """Evaluate (18) with the modes (11) and quadrature, for complex arguments."""
    p, n = of.parameters, of.parameters.modes
    depth, modal, d_rate, rate = p.length - x[0], x[2 : 2 + n], x[2 + n], x[4 + n :]
    k, root = of.modes.wavenumbers, 1.0 / np.sqrt(p.length)
    mu = (np.sin(k * p.length) + np.sinh(k * p.length)) / (
        np.cos(k * p.length) + np.cosh(k * p.length)
    )

    def shapes(y: NDArray[Any]) -> NDArray[Any]:
        v = k * y[..., np.newaxis]
        return np.asarray(root / mu * (np.sin(v) - np.sinh(v) - mu * (np.cos(v) - np.cosh(v))))

    def bends(y: NDArray[Any]) -> NDArray[Any]:
        v = k * y[..., np.newaxis]
        curved = -np.sin(v) - np.sinh(v) + mu * (np.cos(v) + np.cosh(v))
        return np.asarray(root / mu * k**2 * curved)

    nodes, weights = np.polynomial.legendre.leggauss(30)
    gram, elastic = np.zeros((2, n, n), dtype=complex)
    starts = [start for start in (0.0, *p.layer_depths) if start < depth.real]
    layers = (p.tissue_stiffness, *p.layer_stiffnesses)
    growth = 1.0 + p.swelling * (1.0 - np.exp(-time / p.swelling_time))
    for stiffness, low, high in zip(layers, starts, [*starts[1:], depth], strict=False):
        y, w = 0.5 * (high - low) * (nodes + 1.0) + low, 0.5 * (high - low) * weights
        part = np.einsum('y,yi,yj->ij', w, shapes(y), shapes(y))
        gram += part
        elastic += growth * stiffness * part
        elastic += p.bending_stiffness * np.einsum('y,yi,yj->ij', w, bends(y), bends(y))
    tip, curve = shapes(np.array(depth)), bends(np.array(depth))
    forces = -elastic @ modal - p.tissue_damping * gram @ rate
    pull = 0.0j
    if p.formulation == 'complete':
        forces = forces + p.linear_density * d_rate * tip * (tip @ rate)
        pull = 0.5 * p.bending_stiffness * (curve @ modal) ** 2
        pull += 0.5 * growth * layers[len(starts) - 1] * (tip @ modal) ** 2
        pull -= 0.5 * p.linear_density * (tip @ rate) ** 2
    sign = np.sign(-d_rate.real)
    speed = -d_rate * sign
    dry = {
        'coulomb': 1.0,
        'stribeck': 1.0
        + (p.breakaway_friction - 1.0) * np.exp(-((speed / p.stribeck_speed) ** 2)),
        'tanh': np.tanh(speed / p.smoothing_speed),
    }[p.friction_law]
    drag = sign * (p.coulomb_friction * dry + p.viscous_friction * speed)
    drag *= 1.0 if sign > 0.0 else p.withdrawal_friction
    return np.concatenate(
        [
            x[2 + n :],
            [(drag + pull - force) / p.moving_mass, 2.0 * torque / p.rotary_inertia],
            np.linalg.solve(p.linear_density * gram, forces),
        ]
    )


@pytest.mark.parametrize('formulation', ['complete', 'as_printed'])
@pytest.mark.parametrize('modes', [1, 2, 3, 4])
@pytest.mark.parametrize('friction', FRICTIONS, ids=['coulomb', 'stribeck', 'tanh'])
@pytest.mark.parametrize('layers', [{}, LAYERS], ids=['uniform', 'layers'])
def test_jacobians_match_complex_step_derivatives(
    formulation: str, modes: int, friction: dict[str, Any], layers: dict[str, Any]
) -> None:
    """A and B equal complex-step derivatives of the equations by quadrature, at random states."""
    of = many(modes, formulation=formulation, **friction, **layers)
    rng = np.random.default_rng(modes)
    tiny = 1e-30
    for _ in range(5):
        x = random_state(of, rng)
        force, torque, time = rng.normal(), 1e-6 * rng.normal(), 1.0
        found = linearize(of, x, force, torque, time)
        a, b = np.empty_like(found.A), np.empty_like(found.B)
        for j, axis in enumerate(np.eye(x.size)):
            a[:, j] = field(of, x + 1j * tiny * axis, force, torque, time).imag / tiny
        b[:, 0] = field(of, x + 0j, force + 1j * tiny, torque, time).imag / tiny
        b[:, 1] = field(of, x + 0j, force, torque + 1j * tiny, time).imag / tiny
        # Complex steps have no truncation error. Both sides divide by G; in natural units rounding
        # errors are amplified by cond(G), relative to the largest entry.
        rounding = 1e-14 * max(cond(of.modes.integrals(of.parameters.length - x[0]).gram), 1e3)
        back = np.linalg.inv(found.transform)
        error = np.abs(back @ (a - found.A) @ found.transform).max()
        assert error < rounding * np.abs(back @ found.A @ found.transform).max()
        assert_allclose(found.B, b, rtol=1e-14, atol=0.0)
        # The drift is the vector field.
        exact = back @ field(of, x + 0j, force, torque, time).real
        assert_allclose(back @ found.drift, exact, atol=rounding * np.abs(exact).max(), rtol=0.0)
        assert np.all(found.D == 0.0)


@pytest.mark.parametrize('formulation', ['complete', 'as_printed'])
@pytest.mark.parametrize('modes', [1, 2, 3, 4])
def test_jacobians_match_finite_differences_of_the_model(formulation: str, modes: int) -> None:
    """A, B, C equal central differences of the right-hand side and output of the model."""
    of = many(modes, formulation=formulation, **LAYERS)
    rng = np.random.default_rng(10 + modes)
    for _ in range(5):
        x = random_state(of, rng)
        found = linearize(of, x, 1.0, 1e-6, 0.5)
        back = np.linalg.inv(found.transform)
        step = 1e-5
        # Truncation: 1e-10 times up to (k s)^3 < 1e3. Rounding of the field for states of 1e-2:
        # 1e-2 eps cond(G), over the step.
        tolerance = 1e-6 + 1e-13 * cond(of.modes.integrals(of.parameters.length - x[0]).gram)
        for way in found.transform.T:
            ahead, behind = x + step * way, x - step * way
            slope = of.derivative(ahead, 1.0, 1e-6, 0.5) - of.derivative(behind, 1.0, 1e-6, 0.5)
            exact = back @ found.A @ way
            error = np.abs(back @ slope / (2.0 * step) - exact)
            assert error.max() < tolerance * np.abs(back @ found.A @ found.transform).max()
            rise = of.tip_deflection(ahead) - of.tip_deflection(behind)
            size = np.abs(found.C @ found.transform).max()
            assert_allclose(rise / (2.0 * step), found.C[0] @ way, atol=1e-8 * size, rtol=0.0)
        push = of.derivative(x, 2.0, 1e-6, 0.5) - of.derivative(x, 1.0, 1e-6, 0.5)
        # The field is linear in the force: only rounding of the difference.
        assert_allclose(push[of.coordinates], found.B[of.coordinates, 0], rtol=1e-9)


def test_layer_boundary_belongs_to_the_deeper_layer() -> None:
    """At a boundary A is the limit from the deeper side, like k(s) of the model."""
    of = many(**LAYERS)
    exact, below, above = (
        at_point(of, 0.11 + shift, 5e-4, 0.01).A for shift in (0.0, 1e-9, -1e-9)
    )
    size = np.abs(exact).max(axis=1)
    # A moves by 1e-9 of a depth of 0.11 m.
    assert np.all(np.abs(below - exact).max(axis=1) <= 1e-6 * size)
    assert np.any(np.abs(above - exact).max(axis=1) > 1e-3 * size)


def test_friction_derivative_at_rest_requires_a_sliding_direction() -> None:
    """A stuck needle is rejected unless a branch, a larger force or a smooth law is given."""
    of = model(friction_law='stribeck', breakaway_friction=2.0, withdrawal_friction=0.5)
    rest = of.state_at(0.1)
    with pytest.raises(StuckError, match=r'-0\.56 to 1\.12 N.*insertion or withdrawal'):
        linearize(of, rest, 1.1)
    mass, viscous = of.parameters.moving_mass, of.parameters.viscous_friction
    m = of.coordinates
    for branch, factor, held in (('insertion', 1.0, 1.12), ('withdrawal', 0.5, -0.56)):
        found = linearize(of, rest, 0.1, sliding=branch)
        assert_allclose(found.A[m, m], -factor * viscous / mass, rtol=1e-14)
        assert_allclose(found.drift[m], (held - 0.1) / mass, rtol=1e-14)
    # Beyond friction the needle moves in the direction of the force, for any branch.
    for force, factor in ((1.2, 1.0), (-0.6, 0.5)):
        for sliding in (None, 'insertion', 'withdrawal'):
            found = linearize(of, rest, force, sliding=sliding)
            assert_allclose(found.A[m, m], -factor * viscous / mass, rtol=1e-14)
            assert_allclose(found.drift, of.derivative(rest, force), rtol=1e-12)
    # A smooth law and zero friction have a derivative at rest.
    smooth = linearize(model(friction_law='tanh'), rest)
    assert_allclose(smooth.A[m, m], -(0.56 / 1e-4 + viscous) / mass, rtol=1e-14)
    assert linearize(model(coulomb_friction=0.0), rest).A[m, m] < 0.0
    with pytest.raises(StuckError):
        linearize(model(friction_law='tanh', withdrawal_friction=2.0), rest)


def test_textbook_systems() -> None:
    """Rank, lost states and distances of systems with known analytic results."""
    names = ('x1', 'x2', 'x3')
    diagonal = np.diag([1.0, 2.0, 3.0])
    found = controllability(diagonal, [[1.0], [0.0], [1.0]], names)
    assert (found.rank, found.lost, found.combined) == (2, ('x2',), ())
    assert found.loss == 'x2'
    assert found.distances[np.argmin(np.abs(found.eigenvalues - 2.0))] < 1e-15
    assert found.margin > 0.1

    companion = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-6.0, -11.0, -6.0]]
    assert controllability(companion, [[0.0], [0.0], [1.0]], names).loss == 'none'

    # Two equal eigenvalues need two inputs: x1 - x2 is constant.
    twins = controllability(np.eye(2), [[1.0], [1.0]], names[:2])
    assert (twins.deficiency, twins.lost) == (1, ())
    assert twins.loss == '1 combination of x1, x2'
    assert controllability(np.eye(2), np.eye(2), names[:2]).deficiency == 0

    # Double integrators: a chain driven at the wrong end; a chain with a weak input of 1e-3.
    chain = np.array([[0.0, 1.0], [0.0, 0.0]])
    assert controllability(chain, [[1.0], [0.0]], names[:2]).lost == ('x2',)
    weak = controllability(chain, [[0.0], [1e-3]], names[:2])
    assert weak.rank == 2
    assert weak.weakest == 'x2'
    assert_allclose(weak.distance, 1e-3, rtol=1e-12)
    assert weak.margin == weak.distance

    idle = controllability(diagonal, np.zeros((3, 1)), names)
    assert (idle.rank, idle.lost, idle.margin, idle.weakest) == (0, names, 0.0, 'none')

    # A position output makes its rate observable, a rate output does not make the position so.
    assert observability(chain, [[1.0, 0.0]], names[:2]).deficiency == 0
    assert observability(chain, [[0.0, 1.0]], names[:2]).lost == ('x1',)


def test_constructed_loss_is_found_in_any_basis() -> None:
    """A deliberately decoupled part is found and named after a change of basis."""
    rng = np.random.default_rng(3)
    names = tuple(f'x{i}' for i in range(7))
    for kept in range(1, 7):
        a, b = rng.normal(size=(7, 7)), rng.normal(size=(7, 2))
        a[kept:, :kept] = b[kept:] = 0.0
        basis = np.linalg.qr(rng.normal(size=(7, 7)))[0]
        turned = (basis.T @ a @ basis, basis.T @ b)
        found = controllability(*turned, names, basis)
        assert found.lost == names[kept:]
        assert found.combined == ()
        assert found.rank == kept
        # Rounding of the eigenvalues.
        assert found.distance < 1e-13 < 1e-4 < found.margin
        # PBH gives the same count: the eigenvalues of the decoupled part.
        assert np.count_nonzero(found.distances < 1e-12) == 7 - kept
        # In the transformed basis no single state is lost.
        mixed = controllability(*turned, names)
        assert (mixed.rank, mixed.lost, mixed.combined) == (kept, (), names)


def test_observability_is_the_dual_of_controllability() -> None:
    """(A, C) and (A^T, C^T) have the same rank, distances and margin."""
    rng = np.random.default_rng(4)
    names = tuple('abcde')
    for rank in range(6):
        a, c = rng.normal(size=(5, 5)), rng.normal(size=(2, 5))
        a[:rank, rank:] = c[:, rank:] = 0.0
        seen, steered = observability(a, c, names), controllability(a.T, c.T, names)
        assert seen.rank == steered.rank == rank
        assert seen.lost == steered.lost == names[rank:]
        assert_allclose(np.sort(seen.distances), np.sort(steered.distances), atol=1e-13)
        # Singular values of the pencil [A - lambda I; C] at its eigenvalues.
        for value, distance in zip(seen.eigenvalues, seen.distances, strict=True):
            pencil = np.vstack([a - value * np.eye(5), c])
            assert_allclose(np.linalg.svd(pencil)[1][-1], distance, atol=1e-13)


POINTS = list(product((0.02, 0.1, 0.2), (-5e-3, 5e-3, 0.1)))
MODELS = [
    (name, formulation)
    for name in ('paper_si', 'paper_mm', 'phantom')
    for formulation in ('complete', 'as_printed')
]


@pytest.mark.parametrize(('name', 'formulation'), MODELS)
def test_straight_needle_has_uncontrollable_bending_and_unobservable_base(
    name: str, formulation: str
) -> None:
    """Uncontrollable are q1, q2 and the output; d and theta are unobservable."""
    of = model(name, formulation=formulation)
    for depth, speed in POINTS:
        found = analyze(at_point(of, depth, 0.0, speed))
        assert found.state.lost == ('q1', 'q2', 'q1_dot', 'q2_dot')
        assert found.state.deficiency == 4
        assert found.observed.lost == ('d', 'theta', 'd_dot', 'theta_dot')
        assert found.observed.deficiency == 4
        assert not found.output_controllable
        assert found.output_gain == 0.0
        # Rounding only, compared with the margins of the remaining part.
        assert max(found.state.distance, found.observed.distance) < 1e-13
        assert min(found.state.margin, found.observed.margin) > 1e-2


@pytest.mark.parametrize(('name', 'formulation'), MODELS)
def test_deflected_needle_is_controllable_and_only_rotation_is_unobservable(
    name: str, formulation: str
) -> None:
    """Deflection of 0.5 mm: all states and the output are controllable; theta is unobservable."""
    of = model(name, formulation=formulation)
    for depth, speed in POINTS:
        found = analyze(at_point(of, depth, 5e-4, speed))
        assert found.state.loss == 'none'
        assert found.state.distance == found.state.margin > 1e-5
        assert found.observed.lost == ('theta', 'theta_dot')
        assert found.observed.deficiency == 2
        assert found.observed.margin > 1e-7
        assert found.output_controllable
        # Small gain: the tip follows a base motion by the slope of the needle, about 3 w / 2 s.
        assert 0.5 < found.output_gain / (5e-4 / depth) < 3.0


def test_ranks_at_rest_equal_ranks_of_slow_motion() -> None:
    """The sliding branch at rest gives the ranks of a slowly moving needle."""
    of = model()
    for deflection, rank, seen in ((0.0, 4, 4), (5e-4, 8, 6)):
        for sliding in ('insertion', 'withdrawal'):
            found = analyze(at_point(of, 0.1, deflection, 0.0, sliding=sliding))
            assert (found.state.rank, found.observed.rank) == (rank, seen)


@pytest.mark.parametrize('modes', [1, 2, 3, 4])
def test_ranks_hold_for_any_number_of_modes(modes: int) -> None:
    """Straight: the 2 n bending states are lost. Deflected: none; only theta is unobservable."""
    of = many(modes, **LAYERS)
    for depth in (0.06, 0.1, 0.2):
        straight, bent = (analyze(at_point(of, depth, w, 5e-3)) for w in (0.0, 5e-4))
        bending = [f'q{i + 1}' for i in range(modes)]
        assert straight.state.lost == (*bending, *(f'{name}_dot' for name in bending))
        assert bent.state.loss == 'none'
        assert straight.observed.rank == 2 * modes
        assert bent.observed.lost == ('theta', 'theta_dot')


def test_straight_needle_stays_straight_for_any_inputs() -> None:
    """This holds for the nonlinear model: without deflection the bending has no acceleration."""
    of = model()
    for depth, speed, force in product((0.01, 0.1, 0.2), (-0.1, 0.1), (-50.0, 50.0)):
        state = operating_point(of, depth, 0.0, speed)
        assert np.all(of.acceleration(state, force, 1e-3)[2:] == 0.0)
        # There is no bent equilibrium: the bending stiffness is positive definite.
        assert np.linalg.eigvalsh(of.stiffness_matrix(depth))[0] > 0.0


def test_uncontrollable_bending_mode_is_reported() -> None:
    """A shape in which d does not couple to the second normal mode loses it as a combination."""
    for formulation in ('complete', 'as_printed'):
        of = model(formulation=formulation)
        state = of.state_at(0.1)

        def push(modal: FloatArray, of: NeedleModel = of, state: FloatArray = state) -> Any:
            state[2:4] = modal
            return linearize(of, state, sliding='insertion')

        second = [push(axis).scaled()[0][7, 0] for axis in np.eye(2)]
        shape = np.array([second[1], -second[0]])
        found = analyze(push(shape * 1e-5 / np.linalg.norm(shape)))
        assert found.state.rank == 6
        assert found.state.lost == ()
        assert found.state.loss == '2 combinations of q1, q2, q1_dot, q2_dot'
        assert found.output_controllable


def in_other_units(
    p: NeedleParameters, length: float, mass: float, time: float
) -> NeedleParameters:
    """Convert constants to other units, given per meter, kilogram and second."""
    line = mass / (length * time**2)
    units = {
        'length': length,
        'minimum_depth': length,
        'density': mass / length**3,
        'area': length**2,
        'youngs_modulus': line,
        'area_moment': length**4,
        'rotary_inertia': mass * length**2,
        'tissue_stiffness': line,
        'tissue_damping': line * time,
        'coulomb_friction': mass * length / time**2,
        'viscous_friction': mass / time,
    }
    return NeedleParameters(**{name: getattr(p, name) * unit for name, unit in units.items()})


def kalman(system: LinearSystem) -> FloatArray:
    """Return [B, AB, A^2 B, ...] without scaling."""
    blocks = [system.B]
    for _ in system.names[1:]:
        blocks.append(system.A @ blocks[-1])
    return np.hstack(blocks)


def test_results_are_independent_of_units_unlike_the_raw_rank() -> None:
    """In millimeter, gram, millisecond all results are equal, except the rank of [B, AB, ...]."""
    raw, conditions = [], []
    for units in ((1.0, 1.0, 1.0), (1e3, 1e3, 1e3), (1e2, 1.0, 1e6)):
        of = NeedleModel(in_other_units(preset('paper_si'), *units))
        length, _, time = units
        systems = [
            at_point(of, depth * length, w * length, 5e-3 * length / time)
            for depth, w in product((0.02, 0.1, 0.2), (0.0, 5e-4))
        ]
        found = [analyze(system) for system in systems]
        figures = np.array(
            [
                (f.state.rank, f.state.margin, f.observed.rank, f.observed.margin, f.output_gain)
                for f in found
            ]
        )
        if units == (1.0, 1.0, 1.0):
            expected = figures
        # Rounding of G over the smallest relative margin, 1e-16 1e5 / 1e-4.
        assert_allclose(figures, expected, rtol=1e-6)
        raw.append([int(np.linalg.matrix_rank(kalman(system))) for system in systems])
        conditions.append(np.linalg.cond(kalman(systems[3])))
    # Exact ranks alternate between 4 and 8. In SI units the numerical rank is wrong.
    assert not any(found == exact for found, exact in zip(raw[0], [4, 8] * 3, strict=True))
    assert conditions[0] > 1e19
    assert len({tuple(ranks) for ranks in raw}) == 3


def test_raw_rank_with_one_output_is_never_two() -> None:
    """The printed criterion of output controllability requires rank 2 of a matrix with one row."""
    system = at_point(model(), 0.1, 5e-4, 5e-3)
    row = system.C @ kalman(system)
    assert row.shape == (1, 16)
    assert np.linalg.matrix_rank(row) == 1 < system.B.shape[1]
    assert analyze(system).output_controllable


def test_gramian_along_a_motion_has_the_rank_of_the_frozen_pair() -> None:
    """The Gramian of (19) along a real motion has the rank of the frozen pair at its start."""
    of = model()
    m, force = of.coordinates, of.parameters.coulomb_friction
    for deflection, rank in ((0.0, 4), (5e-4, 8)):
        start = operating_point(of, 0.1, deflection, 5e-3)
        first = linearize(of, start)
        back = np.linalg.inv(first.transform)

        def flow(_t: float, z: FloatArray, first: Any = first, back: Any = back) -> FloatArray:
            x = first.transform @ z[: 2 * m]
            at = linearize(of, x, force)
            a = back @ at.A @ first.transform / first.frequencies[0]
            b = back @ at.B * first.input_scales / first.frequencies[0]
            gramian = z[2 * m :].reshape(2 * m, 2 * m)
            change = a @ gramian + gramian @ a.T + b @ b.T
            return np.concatenate([back @ at.drift / first.frequencies[0], change.ravel()])

        begin = np.concatenate([back @ start, np.zeros(4 * m * m)])
        # Half a period of the slowest mode.
        end = solve_ivp(flow, (0.0, np.pi), begin, method='LSODA', rtol=1e-8, atol=1e-12)
        sizes = np.linalg.eigvalsh(end.y[2 * m :, -1].reshape(2 * m, 2 * m))
        # 1e-10: above the tolerance of the solver, well below the controllable directions.
        assert np.count_nonzero(sizes > 1e-10) == rank


def test_map_equals_the_analysis_at_each_point() -> None:
    parameters = preset('phantom')
    depths, deflections = [0.05, 0.15], [0.0, 1e-4, 1e-3]
    found = controllability_map(parameters, depths, deflections, 5e-3)
    of = NeedleModel(parameters)
    assert found.rank.shape == found.output_gain.shape == (2, 3)
    for i, j in product(range(2), range(3)):
        point = analyze(at_point(of, depths[i], deflections[j], 5e-3))
        assert found.rank[i, j] == point.state.rank
        assert found.distance[i, j] == point.state.distance
        assert found.observed_rank[i, j] == point.observed.rank
        assert found.observed_margin[i, j] == point.observed.margin
        assert found.output_gain[i, j] == point.output_gain
    # The distance increases with the deflection; the sign of the deflection has no effect.
    assert np.all(np.diff(found.distance, axis=1) > 0.0)
    mirrored = controllability_map(parameters, depths, [-1e-3], 5e-3)
    assert_allclose(mirrored.distance[:, 0], found.distance[:, 2], rtol=1e-9)


def test_distance_grows_with_the_deflection() -> None:
    """For small deflections the distance to a loss of rank is proportional to the deflection."""
    of = model()
    small, large = (analyze(at_point(of, 0.1, w, 5e-3)).state.distance for w in (1e-5, 2e-5))
    # Second-order terms are 1e-2 of the ratio of deflection to depth.
    assert_allclose(large / small, 2.0, rtol=1e-3)


@pytest.mark.parametrize(
    ('changes', 'error', 'complaint'),
    [
        ({'force': np.nan}, ParameterError, 'force must be finite, got nan'),
        ({'torque': np.inf}, ParameterError, 'torque must be finite, got inf'),
        ({'time': np.nan}, ParameterError, 'time must be finite'),
        ({'sliding': 'up'}, ParameterError, 'one of insertion, withdrawal'),
        ({'state': np.zeros(6)}, ShapeError, r'shape \(8,\), got \(6,\)'),
        ({'state': np.full(8, np.nan)}, ParameterError, 'must be finite'),
        ({'state': np.array([0.2, *np.zeros(7)])}, InsertionDepthError, 'insertion depth 0 m'),
    ],
)
def test_invalid_operating_points_are_rejected(
    changes: dict[str, Any], error: type[NeedleError], complaint: str
) -> None:
    """The message contains the wrong argument and the valid range."""
    of = model()
    arguments = {'state': operating_point(of, 0.1, 0.0, 5e-3), **changes}
    with pytest.raises(error, match=complaint):
        linearize(of, **arguments)


def test_invalid_systems_and_maps_are_rejected() -> None:
    """The message contains wrong shapes and non-finite numbers."""
    names = ('x1', 'x2')
    with pytest.raises(ShapeError, match=r'got \(3, 3\) and \(3, 1\)'):
        controllability(np.eye(3), np.ones((3, 1)), names)
    with pytest.raises(ShapeError, match=r'got \(2, 2\) and \(2,\)'):
        controllability(np.eye(2), np.ones(2), names)
    with pytest.raises(ShapeError, match='finite'):
        observability(np.eye(2), [[np.nan, 0.0]], names)
    with pytest.raises(ShapeError, match='depths must be a list'):
        controllability_map(preset('paper_si'), 0.1, [0.0], 5e-3)
    with pytest.raises(ShapeError, match='deflections must be a list'):
        controllability_map(preset('paper_si'), [0.1], [], 5e-3)
    with pytest.raises(InsertionDepthError, match=r'0\.3 m is outside'):
        controllability_map(preset('paper_si'), [0.3], [0.0], 5e-3)
    with pytest.raises(StuckError):
        controllability_map(preset('paper_si'), [0.1], [0.0], 0.0)
