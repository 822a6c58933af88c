# SPDX-License-Identifier: Apache-2.0
"""Reference models of the literature, against their published values and laws."""

from __future__ import annotations

from math import cos, pi, sin, sqrt

from needle_dynamics import NeedleParameters, ParameterError, ShapeError, SteeringParameters
import numpy as np
from numpy.testing import assert_allclose
import pytest
from support.reference_models import (
    bicycle,
    bicycle_curvature,
    intrinsic_curvature,
    springs,
    unicycle,
)


def test_unicycle_moves_along_an_arc() -> None:
    """100 mm at 0.0449 per centimeter end 22.08 mm lateral and 96.67 mm deep."""
    [tip] = unicycle([0.1], 0.0, 4.49)
    # Values with two decimals, from a curvature with three digits.
    assert_allclose(1e3 * tip, [0.0, 96.67, 22.08], atol=0.015)
    assert_allclose(unicycle([0.1], pi / 2, 4.49), [[tip[2], tip[1], 0.0]], atol=1e-15)


def test_arc_is_independent_of_steps() -> None:
    turn = 2.0
    whole = bicycle([0.1, 0.2], [0.0, turn], 5.0, 0.02)
    fine = bicycle(np.arange(1, 201) * 1e-3, np.repeat([0.0, turn], 100), 5.0, 0.02)
    assert_allclose(fine[[99, 199]], whole, atol=1e-14)


def test_bicycle_tip_circles_the_turning_center_of_the_rear_wheel() -> None:
    """Wheels 40 mm apart, the front wheel turned by 0.198 rad, the tip 23.775 mm ahead."""
    lead, curvature = 23.775e-3, bicycle_curvature(0.04, 0.198)
    tips = bicycle(np.linspace(0.0, 0.1, 5), 0.0, curvature, lead)
    center = np.array([0.0, -lead, 1.0 / curvature])
    radius = sqrt(lead**2 + curvature**-2)
    assert_allclose(np.linalg.norm(tips - center, axis=1), radius, rtol=1e-14)
    assert_allclose(tips[0], 0.0, atol=1e-17)
    end = curvature * 0.1
    expected = [sin(end) / curvature - lead + lead * cos(end), (1 - cos(end)) / curvature]
    expected[1] += lead * sin(end)
    assert_allclose(tips[-1, 1:], expected, rtol=1e-13)


def test_continuous_rotation_gives_a_straight_path() -> None:
    """Fast rotation cancels the curvature: the tip follows a helix about a line."""
    lengths = np.linspace(0.0, 0.1, 10_001)
    tips = unicycle(lengths, 2.0 * pi * 200.0 * lengths / 0.1, 5.0)
    # The radius of the screw, curvature over turns squared, and its slope from the first turn.
    slope = 5.0 / (2.0 * pi * 2000.0)
    assert np.abs(tips[:, [0, 2]]).max() < 1.1 * slope * 0.1


@pytest.mark.parametrize(('curvature', 'deflection'), [(2.0, 4.05e-3), (4.0, 8.1e-3)])
def test_intrinsic_curvature(curvature: float, deflection: float) -> None:
    """At 90 mm; and its second derivative is the curvature, which decays quadratically."""
    assert float(intrinsic_curvature(0.09, curvature)) == pytest.approx(deflection, rel=1e-12)
    y = np.linspace(0.0, 0.09, 91)
    w = intrinsic_curvature(0.09, curvature, y)
    middle = curvature * (1.0 - y[1:-1] / 0.09) ** 2
    # Differences over a millimeter of a polynomial of degree four: h^2 w'''' / 12.
    assert_allclose(np.diff(w, 2) / 1e-6, middle, atol=1e-4 * curvature)


def test_spring_model_has_no_path_memory() -> None:
    """Its tip returns when the guide returns."""
    needle = NeedleParameters.preset('phantom', tissue_stiffness=2e4)
    response, compliance = springs(needle, SteeringParameters(bevel_load=(1.0,)), 0.08)
    assert response[0, 0] == pytest.approx(-0.24, abs=0.01)
    assert_allclose(compliance, compliance.T, rtol=1e-14)
    assert (np.linalg.eigvalsh(compliance) > 0.0).all()


def test_invalid_values_are_rejected() -> None:
    with pytest.raises(ShapeError, match='lengths must have shape'):
        unicycle([0.1, 0.2], [0.0, 0.0, 0.0], 1.0)
    for lengths in ([0.2, 0.1], [-0.1], [np.nan]):
        with pytest.raises(ParameterError, match='must be finite, >= 0 and increase'):
            unicycle(lengths, 0.0, 1.0)
    with pytest.raises(ParameterError, match='depth must be positive and finite, got 0'):
        intrinsic_curvature(0.0, 1.0)
