# SPDX-License-Identifier: Apache-2.0
"""Shape modes (10)-(11) and their integrals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import FloatArray, mode_shapes, ModeShapes, ParameterError
from needle_dynamics.compiled.integrals import ModeIntegrals
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.integrate import fixed_quad, quad

LENGTH = 0.2
MODES = mode_shapes(LENGTH)
EPS = np.finfo(float).eps
DEPTHS = np.geomspace(1e-3, LENGTH, 40)
#: Gauss points: the integrands are entire with fewer than two oscillations, 40 points are exact.
POINTS = 40


def derivative(order: int, y: float) -> FloatArray:
    """Return derivatives of (11) with the minus sign, implemented independently for the test."""
    x, k, mu = MODES.wavenumbers * y, MODES.wavenumbers, MODES.ratios
    bracket = {
        0: np.sin(x) - np.sinh(x) - mu * (np.cos(x) - np.cosh(x)),
        1: np.cos(x) - np.cosh(x) + mu * (np.sin(x) + np.sinh(x)),
        2: -np.sin(x) - np.sinh(x) + mu * (np.cos(x) + np.cosh(x)),
        3: -np.cos(x) - np.cosh(x) - mu * (np.sin(x) - np.sinh(x)),
    }[order % 4]
    return np.asarray(MODES.scales * k**order * bracket)


def gauss(integrand: Callable[..., Any], depth: float) -> FloatArray:
    """Integrate a vector-valued function of y (points last) from 0 to the depth."""
    return np.asarray(fixed_quad(integrand, 0.0, depth, n=POINTS)[0])


def outer(shapes: FloatArray) -> FloatArray:
    """Return products of two modes at many points, points last; shape (2, 2, points)."""
    return np.einsum('pi,pj->ijp', shapes, shapes)


def sizes(
    at: ModeIntegrals, depth: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return Cauchy-Schwarz bounds of G, H and both moments, as scales of the errors."""
    norm = np.sqrt(np.diag(at.gram))
    bend = np.sqrt(np.diag(at.curvature_gram))
    return (
        np.outer(norm, norm),
        np.outer(bend, bend),
        norm * np.sqrt(depth),
        norm * np.sqrt(depth**3 / 3.0),
    )


@pytest.mark.parametrize('length', [0.05, 0.2, 1.0])
def test_modes_are_orthonormal_over_the_whole_needle(length: float) -> None:
    """The Gram matrix of the modes on [0, l] is the identity, for any length."""
    modes = mode_shapes(length)
    by_quadrature = gauss(lambda y: outer(modes.values(y)), length)
    # 1e-12: normalizing constants of order 1 / l from sums whose terms reach cosh(2 k l) = 6e3.
    assert_allclose(by_quadrature, np.eye(2), atol=1e-12)
    assert_allclose(modes.integrals(length).gram, np.eye(2), atol=1e-12)


def test_wavenumbers_are_the_first_two_roots() -> None:
    """cos(k l) cosh(k l) + 1 = 0 at the published first and second root."""
    x = MODES.wavenumbers * LENGTH
    # cosh(k l) is 55 at the second root and amplifies the rounding of k l.
    assert_allclose(np.cos(x) * np.cosh(x), -1.0, rtol=200 * EPS)
    assert_allclose(x, [1.875104068711961, 4.694091132974175], rtol=4 * EPS)


def test_base_is_clamped_and_tip_is_free() -> None:
    """Value and slope vanish at the entry, bending moment and shear at the end of the needle."""
    k = MODES.wavenumbers
    assert np.all(MODES.values(0.0) == 0.0)
    step = 1e-7
    # phi is quadratic at 0: the difference quotient is at most max phi'' times the step.
    slope = MODES.values(step) / step
    assert np.all(np.abs(slope) <= 2.0 * np.abs(MODES.derivatives(0.0, 2)) * step)
    # Bending moment and shear relative to the base; 1e-13: cancellation of cosh(k l) = 55.
    assert_allclose(MODES.derivatives(LENGTH, 2) / MODES.derivatives(0.0, 2), 0.0, atol=1e-13)
    assert_allclose(derivative(3, LENGTH) / (k**3 * MODES.scales), 0.0, atol=1e-12)


def test_curvature_is_the_second_derivative_of_the_value() -> None:
    """The curvature agrees with the second difference of phi."""
    y = np.linspace(0.01, 0.19, 19)
    h = 1e-4
    second = (MODES.values(y + h) - 2.0 * MODES.values(y) + MODES.values(y - h)) / h**2
    # Truncation (k h)^2 / 12 = 5e-7 and rounding eps / (k h)^2 = 1e-11, of k^2 max phi.
    assert_allclose(
        second / MODES.wavenumbers**2, MODES.derivatives(y, 2) / MODES.wavenumbers**2, atol=1e-5
    )


def test_printed_sign_of_equation_11_is_a_misprint() -> None:
    """The closed form of 1/c^2 is the norm of the bracket with - cosh, not with + cosh."""
    for i in range(2):
        k, mu, l = MODES.wavenumbers[i], MODES.ratios[i], LENGTH
        x = k * l
        # As printed in the paper.
        printed = (
            2 * mu / k * np.sin(x) * np.sinh(x)
            + (1 - mu**2) / k * np.cos(x) * np.sinh(x)
            - (1 + mu**2) / k * np.sin(x) * np.cosh(x)
            + (1 + mu**2) / (4 * k) * np.sinh(2 * x)
            + (mu**2 - 1) / (4 * k) * np.sin(2 * x)
            + mu / (2 * k) * (np.cos(2 * x) - np.cosh(2 * x))
            + mu**2 * l
        )

        def bracket(y: float, sign: float, k: float = k, mu: float = mu) -> float:
            return float(
                np.sin(k * y) - np.sinh(k * y) - mu * (np.cos(k * y) + sign * np.cosh(k * y))
            )

        minus = quad(lambda y: bracket(y, -1.0) ** 2, 0.0, l, epsrel=1e-12)[0]
        plus = quad(lambda y: bracket(y, 1.0) ** 2, 0.0, l, epsrel=1e-12)[0]
        # 1e-11: the closed form cancels cosh(2 k l) = 6e3 down to 1.
        assert_allclose(printed, minus, rtol=1e-11)
        assert abs(plus / printed - 1.0) > 0.1
        # The deflection at the entry point is zero, but the printed form gives 2 mu c.
        assert bracket(0.0, -1.0) == 0.0
        assert_allclose(bracket(0.0, 1.0), -2.0 * mu)
        assert_allclose(MODES.scales[i], minus**-0.5, rtol=1e-11)


@pytest.mark.parametrize('depth', DEPTHS)
def test_integrals_agree_with_quadrature(depth: float) -> None:
    """G, H and both moments equal Gauss quadrature; phi and phi'' equal the modes at s."""
    at = MODES.integrals(depth)
    gram, bend, area, moment = sizes(at, depth)
    # The direct form of phi in the reference cancels: eps / (k s)^2 relative, 2e-12 at 1 mm.
    tolerance = 20 * EPS * (1.0 + 1.0 / (MODES.wavenumbers[0] * depth) ** 2) + 2e-13
    reference = gauss(lambda y: outer(MODES.values(y)), depth)
    assert_allclose(at.gram / gram, reference / gram, atol=tolerance)
    reference = gauss(lambda y: outer(MODES.derivatives(y, 2)), depth)
    assert_allclose(at.curvature_gram / bend, reference / bend, atol=tolerance)
    reference = gauss(lambda y: MODES.values(y).T, depth)
    assert_allclose(at.area / area, reference / area, atol=tolerance)
    reference = gauss(lambda y: MODES.values(y).T * y, depth)
    assert_allclose(at.moment / moment, reference / moment, atol=tolerance)
    # phi is at most about twice its root mean square.
    size = np.sqrt(np.diag(at.gram) / depth)
    assert_allclose(at.value / size, MODES.values(depth) / size, atol=4 * tolerance)
    size = np.abs(MODES.derivatives(0.0, 2))
    assert_allclose(at.curvature / size, MODES.derivatives(depth, 2) / size, atol=tolerance)


@pytest.mark.parametrize('depth', [0.1, 0.13, 0.17, 0.2])
def test_integrals_agree_with_antiderivatives(depth: float) -> None:
    """With phi'''' = k^4 phi, every integral is a form in boundary values at s (Felgar 1950)."""
    at = MODES.integrals(depth)
    k4 = MODES.wavenumbers**4
    derivatives = [derivative(order, depth) for order in range(6)]

    def gram(f0: FloatArray, f1: FloatArray, f2: FloatArray, f3: FloatArray) -> FloatArray:
        diagonal = (3 * f0 * f3 + depth * (k4 * f0**2 - 2 * f1 * f3 + f2**2) - f1 * f2) / (4 * k4)
        cross = (f3[0] * f0[1] - f2[0] * f1[1] + f1[0] * f2[1] - f0[0] * f3[1]) / (k4[0] - k4[1])
        return np.array([[diagonal[0], cross], [cross, diagonal[1]]])

    sized = sizes(at, depth)
    # 1e-11: at these depths the boundary terms exceed the integral by less than 1e3.
    reference = gram(*derivatives[:4])
    assert_allclose(at.gram / sized[0], reference / sized[0], atol=1e-11)
    reference = gram(*derivatives[2:])
    assert_allclose(at.curvature_gram / sized[1], reference / sized[1], atol=1e-11)
    f2, f3 = derivatives[2:4]
    reference = (f3 - derivative(3, 0.0)) / k4
    assert_allclose(at.area / sized[2], reference / sized[2], atol=1e-11)
    reference = (depth * f3 - f2 + derivative(2, 0.0)) / k4
    assert_allclose(at.moment / sized[3], reference / sized[3], atol=1e-11)


@pytest.mark.parametrize('depth', DEPTHS[:-1])
def test_rates_with_depth_are_the_integrands_at_the_tip(depth: float) -> None:
    """dG/ds = phi phi^T, dH/ds = phi'' phi''^T; the moments have the derivatives phi and s phi."""
    h = min(1e-3 * depth, LENGTH - depth)
    at, before, after = (MODES.integrals(s) for s in (depth, depth - h, depth + h))
    # Truncation: G grows as s^7 at most, so (h/s)^2 7 6 5 / 6 = 4e-5 of G / s at h = s / 1000.
    gram, bend, area, moment = (size / depth for size in sizes(at, depth))
    for name, expected, size in (
        ('gram', np.outer(at.value, at.value), gram),
        ('curvature_gram', np.outer(at.curvature, at.curvature), bend),
        ('area', at.value, area),
        ('moment', depth * at.value, moment),
    ):
        slope = (getattr(after, name) - getattr(before, name)) / (2.0 * h)
        assert_allclose(slope / size, expected / size, atol=1e-4, err_msg=name)


@pytest.mark.parametrize('depth', DEPTHS)
def test_gram_matrices_are_symmetric_positive_definite(depth: float) -> None:
    """G and H are symmetric positive definite down to 1 mm, where cond(G) is 6e7."""
    at = MODES.integrals(depth)
    for matrix in (at.gram, at.curvature_gram):
        assert np.array_equal(matrix, matrix.T)
        eigenvalues = np.linalg.eigvalsh(matrix)
        # More than a thousand roundings from singular.
        assert eigenvalues[0] > 1e3 * EPS * eigenvalues[1]


def test_determinant_of_gram_at_small_depth_has_its_analytic_limit() -> None:
    """For s -> 0 only y^2 and y^3 contribute: det G -> (a1 b2 - a2 b1)^2 s^12 / 1260."""
    depth = 1e-3
    a, b = derivative(2, 0.0) / 2.0, derivative(3, 0.0) / 6.0
    limit = (a[0] * b[1] - a[1] * b[0]) ** 2 * depth**12 / 1260.0
    # 1e-5: the next power contributes (k s)^4 = 3e-7, and rounding cond(G) eps = 1e-8.
    assert_allclose(np.linalg.det(MODES.integrals(depth).gram), limit, rtol=1e-5)


def test_integrals_vanish_at_zero_depth() -> None:
    at = MODES.integrals(0.0)
    for matrix in (at.gram, at.curvature_gram, at.value, at.area, at.moment):
        assert np.all(matrix == 0.0)


@given(shape=st.lists(st.integers(0, 4), max_size=3))
@settings(max_examples=30)
def test_values_have_the_shape_of_their_argument(shape: list[int]) -> None:
    """Values and curvatures append one axis of length 2 to the shape of y."""
    y = np.zeros(shape)
    assert MODES.values(y).shape == (*shape, 2)
    assert MODES.derivatives(y, 2).shape == (*shape, 2)


@pytest.mark.parametrize('depth', [-1e-9, -1.0, 10.0 * LENGTH, np.inf, -np.inf, np.nan])
def test_invalid_depths_are_rejected(depth: float) -> None:
    """Negative depths, depths beyond the needle and NaN are errors."""
    with pytest.raises(ParameterError, match=r'insertion depth must be in \[0, .*got'):
        MODES.integrals(depth)


def test_modes_are_cached_and_read_only() -> None:
    """Equal lengths give the same object, whose table is read-only."""
    assert mode_shapes(LENGTH) is mode_shapes(LENGTH)
    assert ModeShapes(LENGTH) == MODES
    with pytest.raises(ValueError, match='read-only'):
        MODES.tables.series[0, 0] = 1.0
