# SPDX-License-Identifier: Apache-2.0
"""Equations of motion (12)-(18) against the Lagrangian."""

from __future__ import annotations

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import (
    FloatArray,
    InsertionDepthError,
    NeedleError,
    NeedleModel,
    NeedleParameters,
    ShapeError,
)
from needle_ros.errors import ParameterError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.integrate import fixed_quad

preset = NeedleParameters.preset


def model(name: str = 'paper_si', **changes: Any) -> NeedleModel:
    return NeedleModel(preset(name, **changes))


def conservative(**changes: Any) -> NeedleModel:
    return model(coulomb_friction=0.0, viscous_friction=0.0, **changes)


def random_state(of: NeedleModel, rng: np.random.Generator) -> FloatArray:
    """Draw a state with about 1 mJ in each normal mode, so that every term contributes."""
    state = of.state_at(rng.uniform(0.01, 0.19))
    state[1], state[4], state[5] = rng.normal(size=3) * [0.1, 0.5, 30.0]
    elastic = np.linalg.cholesky(of.stiffness_matrix(of.parameters.length - state[0]))
    inertial = np.linalg.cholesky(of.mass_matrix(state)[2:, 2:])
    state[2:4] = np.linalg.solve(elastic.T, rng.normal(size=2)) * 0.04
    state[6:8] = np.linalg.solve(inertial.T, rng.normal(size=2)) * 0.04
    return state


def states(of: NeedleModel, count: int = 20) -> list[FloatArray]:
    rng = np.random.default_rng(2014)
    return [random_state(of, rng) for _ in range(count)]


def test_coordinate_names_are_in_order() -> None:
    assert model().coordinates == len(model().coordinate_names) == 4
    assert model().coordinate_names == ('d', 'theta', 'q1', 'q2')


def test_mass_matrix_is_symmetric_positive_definite_and_block_diagonal() -> None:
    """The zeros of M match the paper."""
    of = model(carriage_mass=0.3)
    p = of.parameters
    for state in states(of):
        mass = of.mass_matrix(state)
        assert np.array_equal(mass, mass.T)
        assert np.linalg.eigvalsh(mass[2:, 2:])[0] > 0.0
        assert np.all(mass[:2, 2:] == 0.0)
        assert mass[0, 1] == 0.0
        # rho A l + carriage and I_x / 2: products of the constants, two roundings.
        assert_allclose(mass[0, 0], 8000.0 * 1.27e-6 * 0.2 + 0.3, rtol=1e-15)
        assert_allclose(mass[1, 1], p.rotary_inertia / 2.0, rtol=1e-15)


def test_energies_are_the_integrals_of_equation_12() -> None:
    """T and V equal the integrals over the needle of their densities, with one half of k_a."""
    of = model(carriage_mass=0.1)
    p = of.parameters
    for x in states(of):
        depth = p.length - x[0]

        def field(y: FloatArray, x: FloatArray = x) -> FloatArray:
            shapes, bends = of.modes.values(y), of.modes.derivatives(y, 2)
            return np.array([shapes @ x[2:4], bends @ x[2:4], shapes @ x[6:8]]) ** 2

        w, bend, rate = fixed_quad(field, 0.0, depth, n=40)[0]
        potential = 0.5 * (200e9 * 1.28e-13 * bend + 520.0 * w)
        kinetic = 0.5 * (8000.0 * 1.27e-6 * (0.2 * x[4] ** 2 + rate) + 0.1 * x[4] ** 2)
        kinetic += 0.25 * 1.0626e-9 * x[5] ** 2
        # 1e-9: quadratic forms whose terms cancel by up to sqrt(cond G) = 1e3 at 1 cm, squared.
        assert_allclose(of.potential_energy(x), potential, rtol=1e-9)
        assert_allclose(of.kinetic_energy(x), kinetic, rtol=1e-9)
        assert of.energy(x) == of.kinetic_energy(x) + of.potential_energy(x)


def test_equations_of_motion_follow_from_the_lagrangian() -> None:
    """d/dt dL/dq_dot - dL/dq = Q in all four rows, for random states and inputs."""
    of = conservative()
    rng = np.random.default_rng(1)

    def lagrangian(x: FloatArray) -> float:
        return of.kinetic_energy(x) - of.potential_energy(x)

    def gradient(x: FloatArray, first: int, steps: FloatArray) -> FloatArray:
        slopes = np.empty(4)
        for i, step in enumerate(steps):
            ahead, behind = x.copy(), x.copy()
            ahead[first + i] += step
            behind[first + i] -= step
            slopes[i] = (lagrangian(ahead) - lagrangian(behind)) / (2.0 * step)
        return slopes

    for x in states(of):
        force, torque = rng.normal(size=2) * [1.0, 1e-6]
        acceleration = of.acceleration(x, force, torque)

        def path(t: float, x: FloatArray = x, a: FloatArray = acceleration) -> FloatArray:
            return np.concatenate([x[:4] + x[4:] * t + 0.5 * a * t**2, x[4:] + a * t])

        def momentum(t: float, x: FloatArray = x, path: Any = path) -> FloatArray:
            # L is a quadratic form of the rates: a central difference has no truncation.
            return gradient(path(t), 4, np.abs(x[4:]))

        # Along the path the momenta are smooth on the scale s / u > 10 ms: at 1 us, truncation
        # is 1e-8 and rounding eps / (omega 1 us) = 1e-13, amplified by sqrt(cond G) = 1e3.
        tick = 1e-6
        rate = (momentum(tick) - momentum(-tick)) / (2.0 * tick)
        # d moves by 1e-5 of the depth (truncation 1e-9); the rest are quadratic forms.
        slope = gradient(x, 0, np.array([1e-7, 1.0, *np.abs(x[2:4])]))
        applied = np.array([-force, torque, 0.0, 0.0])
        # Magnitude of the terms of each row, as the scale of an error.
        modal = of.stiffness_matrix(of.parameters.length - x[0]) @ np.diag(np.abs(x[2:4]))
        at = of.modes.integrals(of.parameters.length - x[0])
        tip = of.parameters.linear_density * (at.value @ x[6:8]) ** 2
        size = np.array([abs(force) + tip, abs(torque), *np.abs(modal).sum(axis=1)])
        assert np.all(size > 0.0)
        assert_allclose((rate - slope - applied) / size, 0.0, atol=1e-6)
        # The terms omitted in the paper are larger than this tolerance.
        assert abs(slope[0]) > 1e-4 * size[0]


def test_modal_rows_contain_the_convective_term() -> None:
    """The term is -rho A d_dot phi phi^T q_dot, from dG/dt."""
    of = conservative()
    for x in states(of):
        still = x.copy()
        still[4] = 0.0
        at = of.modes.integrals(of.parameters.length - x[0])
        expected = -of.parameters.linear_density * x[4] * np.outer(at.value, at.value) @ x[6:8]
        difference = (of.bias_forces(x) - of.bias_forces(still))[2:]
        # Rounding of the stiffness term, which is up to 1e5 times larger.
        size = np.abs(of.bias_forces(still)[2:]).max()
        assert_allclose(difference, expected, atol=1e-14 * size)
        assert np.abs(expected).max() > 1e-9 * size


def test_positive_force_shortens_the_outer_length() -> None:
    """A positive force accelerates d downwards and a positive torque theta upwards."""
    of = conservative()
    acceleration = of.acceleration(of.state_at(0.05), force=1.0, torque=1e-6)
    assert_allclose(acceleration[0], -1.0 / of.parameters.moving_mass, rtol=1e-15)
    assert_allclose(acceleration[1], 2e-6 / of.parameters.rotary_inertia, rtol=1e-15)
    assert np.all(acceleration[2:] == 0.0)


@pytest.mark.parametrize('speed', [-0.3, -1e-12, 1e-12, 0.3])
def test_friction_opposes_motion(speed: float) -> None:
    """Friction is mu_s sign(u) + mu_v u against the motion, for any drive."""
    of = model('paper_mm')
    expected = np.sign(speed) * 0.56 + 300.0 * speed
    for drive in (-5.0, 0.0, 5.0):
        assert_allclose(of.friction.force(speed, drive), expected, rtol=1e-15)
    state = of.state_at(0.05)
    state[4] = -speed
    # d decreases during insertion: friction increases it.
    assert np.sign(of.acceleration(state)[0]) == np.sign(speed)
    assert_allclose(of.acceleration(state)[0], expected / of.parameters.moving_mass, rtol=1e-14)


@given(fraction=st.floats(-1.0, 1.0))
def test_friction_at_rest_balances_any_drive_within_its_bound(fraction: float) -> None:
    """At rest a drive of at most mu_s causes neither acceleration nor creep."""
    of = model()
    drive = fraction * of.parameters.coulomb_friction
    assert of.friction.force(0.0, drive) == drive
    assert of.acceleration(of.state_at(0.05), force=drive)[0] == 0.0


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_excess_over_static_friction_accelerates_the_needle(sign: float) -> None:
    """At rest only the excess over mu_s accelerates the needle."""
    of = model()
    acceleration = of.acceleration(of.state_at(0.05), force=sign * 0.66)[0]
    # 0.66 - 0.56 cancels to 0.1.
    assert_allclose(acceleration, -sign * 0.1 / of.parameters.moving_mass, rtol=1e-14)


def test_power_balance() -> None:
    """dE/dt is input power minus dissipation by friction and damping, for random states."""
    of = model('phantom', carriage_mass=0.1)
    p = of.parameters
    rng = np.random.default_rng(3)
    for x in states(of):
        force, torque = rng.normal(size=2) * [3.0, 1e-4]
        flow = of.derivative(x, force, torque)
        # E is quadratic except for its dependence on depth: with 1 ns the truncation error is
        # 1e-12 and rounding is eps E / 1 ns = 1e-10 W, compared with watts.
        tick = 1e-9
        rate = (of.energy(x + tick * flow) - of.energy(x - tick * flow)) / (2.0 * tick)
        speed, spin, modal = -x[4], x[5], x[6:8]
        gram = of.modes.integrals(p.length - x[0]).gram
        friction = (np.sign(speed) * 0.56 + 300.0 * speed) * speed
        damping = 1.6 * modal @ gram @ modal
        expected = force * speed + torque * spin - friction - damping
        size = abs(force * speed) + abs(torque * spin) + friction + damping
        assert friction > 0.0
        assert damping > 0.0
        # 1e-5: cancellation of the elastic against the inertial power, up to 1e3 W.
        assert_allclose(rate / size, expected / size, atol=1e-5)


@given(depth=st.floats(1.1e-3, 0.2), tip=st.floats(-1e-2, 1e-2))
def test_state_at_gives_the_least_energy_shape_for_a_tip_deflection(
    depth: float, tip: float
) -> None:
    """Depth and tip are as given; any other shape with the same tip has more energy."""
    of = model()
    x = of.state_at(depth, tip)
    # 0.2 - (0.2 - depth) rounds once at 0.2; the rest are a few roundings.
    assert_allclose(of.parameters.length - x[0], depth, atol=1e-16)
    assert_allclose(of.tip_deflection(x), tip, rtol=1e-11, atol=1e-300)
    assert np.all(x[4:] == 0.0)
    assert x[1] == 0.0
    value = of.modes.integrals(depth).value
    across = np.array([-value[1], value[0]]) / np.linalg.norm(value)
    size = max(float(np.linalg.norm(x[2:4])), 1e-6)
    for other in (-1.0, -1e-2, 1e-2, 1.0):
        y = x.copy()
        y[2:4] += other * size * across
        assert_allclose(
            value @ y[2:4], tip, rtol=1e-9, atol=1e-9 * float(np.linalg.norm(value)) * size
        )
        assert of.potential_energy(y) > of.potential_energy(x)


def test_both_ends_of_the_depth_range_are_valid() -> None:
    """The range [minimum_depth, length] of the error message is closed."""
    for length in np.random.default_rng(5).uniform(0.05, 0.3, size=50):
        of = model(length=length, minimum_depth=0.07 * length)
        assert np.isfinite(of.acceleration(of.state_at(of.parameters.minimum_depth))).all()
        assert np.isfinite(of.acceleration(of.state_at(length))).all()


def test_tip_deflection_is_the_end_of_the_shape() -> None:
    """The shape runs from the clamped entry to the tip at s, whose deflection is the output."""
    of = model()
    for x in states(of, 5):
        points = of.shape(x, points=7)
        assert points.shape == (7, 2)
        assert np.all(points[0] == 0.0)
        assert points[-1, 0] == of.parameters.length - x[0]
        # 1e-10: eps / (k s)^2 cancellation of the direct form of phi, and of q1 phi1 + q2 phi2.
        assert_allclose(points[-1, 1], of.tip_deflection(x), rtol=1e-10)


@given(shape=st.lists(st.integers(0, 9), max_size=3).filter(lambda s: s != [8]))
@settings(max_examples=50)
def test_invalid_state_shapes_are_rejected(shape: list[int]) -> None:
    """Only shape (8,) is valid; the message contains the given shape."""
    of = model()
    for call in (of.checked_state, of.acceleration, of.energy, of.tip_deflection, of.mass_matrix):
        with pytest.raises(ShapeError, match=r'must have shape \(8,\), got \('):
            call(np.zeros(shape))


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('slot', range(8))
def test_non_finite_states_are_rejected(slot: int, value: float) -> None:
    of = model()
    state = of.state_at(0.05)
    state[slot] = value
    with pytest.raises(ParameterError, match='state must be finite'):
        of.acceleration(state)


@pytest.mark.parametrize('depth', [-0.01, 0.0, 0.9e-3, 0.2 + 1e-9, 1.0])
def test_depth_outside_its_range_is_rejected(depth: float) -> None:
    """Invalid below minimum_depth, and beyond the hub with hub_stop."""
    of = model()
    state = of.state_at(0.05)
    state[0] = 0.2 - depth
    with pytest.raises(InsertionDepthError, match=r'outside \[0.001, 0.2\] m'):
        of.checked_state(state)
    with pytest.raises(InsertionDepthError):
        of.state_at(depth)


@pytest.mark.parametrize('depth', [0.05, np.nan])
def test_state_at_rejects_non_finite_values(depth: float) -> None:
    """`state_at` returns only states that the model accepts."""
    with pytest.raises(NeedleError):
        model().state_at(depth, np.nan)


def test_without_hub_stop_the_equations_are_valid_beyond_the_hub() -> None:
    """States with d < 0 are valid in every method, and continuous at d = 0."""
    of = conservative(hub_stop=False)
    x = of.state_at(0.2, 1e-3)
    x[4:] = [-0.1, 0.0, 0.2, 0.1]
    beyond = x.copy()
    beyond[0] = -1e-9
    # The modes change by k 1 nm = 2e-8 relative.
    assert_allclose(of.acceleration(beyond, 0.5), of.acceleration(x, 0.5), rtol=1e-6)
    assert_allclose(of.energy(beyond), of.energy(x), rtol=1e-6)
    assert_allclose(of.tip_deflection(beyond), of.tip_deflection(x), rtol=1e-6)


def test_states_are_copied() -> None:
    """`checked_state` and `state_at` return new arrays."""
    of = model()
    state = of.state_at(0.05)
    checked = of.checked_state(state)
    checked[2] = 1.0
    assert state[2] == 0.0
