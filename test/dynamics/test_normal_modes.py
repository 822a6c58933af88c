# SPDX-License-Identifier: Apache-2.0
"""Small matrices, normal modes of the inserted part, and the damped oscillator."""

from __future__ import annotations

from math import exp

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters
from needle_dynamics.compiled.friction import decay_means, glide
from needle_dynamics.compiled.matrices import backward, cholesky, diagonalize, forward
from needle_dynamics.compiled.normal_modes import coupling, empty_normal_modes, normal_modes, swing
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import eigh, expm


def positive_definite(rng: np.random.Generator, n: int) -> FloatArray:
    """Return a random symmetric matrix with eigenvalues from 1 to 1e6."""
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return np.asarray(basis * np.geomspace(1.0, 1e6, n) @ basis.T)


@pytest.mark.parametrize('n', [1, 2, 3, 6])
def test_cholesky_and_triangular_solutions_match_numpy(n: int) -> None:
    """L L^T is the matrix; forward and backward solve with L and L^T."""
    rng = np.random.default_rng(n)
    matrix, x = positive_definite(rng, n), rng.standard_normal(n)
    factor = np.zeros((n, n))
    cholesky(matrix, factor)
    # Rounding of n sums.
    assert_allclose(factor, np.linalg.cholesky(matrix), rtol=1e-9, atol=1e-9)
    solved = x.copy()
    forward(factor, solved)
    assert_allclose(factor @ solved, x, atol=1e-9)
    backward(factor, solved)
    # Rounding times the condition 1e6.
    assert_allclose(matrix @ solved, x, atol=1e-9)


@pytest.mark.parametrize('n', [1, 2, 3, 6])
def test_jacobi_finds_ascending_eigenvalues(n: int) -> None:
    """The vectors are orthonormal, and the factors reproduce the matrix."""
    matrix = positive_definite(np.random.default_rng(n), n)
    left, vectors = matrix.copy(), np.empty((n, n))
    diagonalize(left, vectors)
    values = np.diag(left)
    assert (np.diff(values) > 0.0).all()
    # Rounding of the rotations.
    assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-14)
    assert_allclose(vectors * values @ vectors.T, matrix, atol=1e-9)


@pytest.mark.parametrize(('n', 'depth'), [(2, 0.005), (2, 0.02), (2, 0.2), (3, 0.08), (5, 0.2)])
def test_normal_modes_diagonalize_mass_and_stiffness(n: int, depth: float) -> None:
    """N^T rho A G N = 1, N^T K N = omega^2, and `inverse` is the inverse of N."""
    p = NeedleParameters.preset('phantom', modes=n, minimum_depth=min(depth, 0.08))
    model = NeedleModel(p)
    at, stiffness = model.modes.integrals(depth), model.stiffness_matrix(depth)
    modes = empty_normal_modes(n)
    normal_modes(p.linear_density, at, stiffness.copy(), modes)
    mass = p.linear_density * at.gram
    # Rounding times the condition of G.
    rounding = 1e-15 * np.linalg.cond(at.gram) + 1e-12
    assert_allclose(modes.shapes.T @ mass @ modes.shapes, np.eye(n), atol=rounding)
    roots = np.sqrt(modes.squares)
    turned = modes.shapes.T @ stiffness @ modes.shapes / np.outer(roots, roots)
    assert_allclose(turned, np.eye(n), atol=rounding)
    # The triangular form is not affected by the condition number.
    assert_allclose(modes.inverse @ modes.shapes, np.eye(n), atol=1e-11)
    assert_allclose(modes.squares, eigh(stiffness, mass)[0], rtol=1e-7)


@given(st.floats(0.0, 1e4), st.floats(0.0, 5.0).map(lambda e: 10.0**e), st.floats(1e-5, 1e-2))
def test_swing_is_the_matrix_exponential(damping: float, square: float, t: float) -> None:
    """Position and velocity match the matrix exponential of the system."""
    exact = expm(t * np.array([[0.0, 1.0], [-square, -damping]]))
    pp, pv, vp, vv = swing(damping, square, t)
    # Rounding of expm (squarings).
    assert_allclose((pp, pv), exact[0], rtol=1e-9, atol=1e-13)
    assert_allclose((vp, vv), exact[1], rtol=1e-9, atol=1e-12 * square)


@pytest.mark.parametrize('excess', [-1e-9, 0.0, 1e-9])
def test_swing_is_continuous_at_critical_damping(excess: float) -> None:
    """Near half damping = frequency the response approaches (1 + w t, t) exp(-w t)."""
    w, t = 100.0, 0.02
    pp, pv, _, _ = swing(2.0 * w * (1.0 + excess), w * w, t)
    assert_allclose((pp, pv), ((1.0 + w * t) * exp(-w * t), t * exp(-w * t)), rtol=1e-7)


def test_glide_is_the_first_order_lag() -> None:
    """u_dot = a - b u has an exponential solution; without damping it is a parabola."""
    velocity, moved = glide(0.2, 3.0, 5.0, 0.1)
    end = 0.6 + (0.2 - 0.6) * exp(-0.5)
    assert_allclose(velocity, end, rtol=1e-14)
    assert_allclose(moved, (0.2 + 3.0 * 0.1 - end) / 5.0, rtol=1e-12)
    assert glide(0.2, 3.0, 0.0, 0.1) == pytest.approx((0.5, 0.02 + 0.015), rel=1e-14)
    assert decay_means(0.0) == (1.0, 0.5)


def test_coupling_matches_the_row_of_d() -> None:
    """The force against insertion is the bias force of d in (13) with opposite sign."""
    p = NeedleParameters.preset('phantom')
    model = NeedleModel(p)
    state = model.state_at(0.1, 2e-3)
    state[6:] = 0.3, -0.2
    at = model.modes.integrals(0.1)
    q, rate = state[2:4], state[6:]
    force = coupling(
        p.linear_density, p.bending_stiffness, p.tissue_stiffness,
        float(at.curvature @ q), float(at.value @ q), float(at.value @ rate),
    )  # fmt: skip
    assert_allclose(force, -model.bias_forces(state)[0], rtol=1e-12)
