# SPDX-License-Identifier: Apache-2.0
"""Euler buckling loads against an energy method."""

from math import inf, nan

from needle_dynamics import euler_loads, InsertionDepthError, NeedleParameters
import numpy as np
from numpy.polynomial import Polynomial
import pytest
from scipy.linalg import eigh


def least_load(length: float, stiffness: float, end: Polynomial) -> float:
    """Minimize E I int w'' ^2 / int w' ^2 over polynomials clamped at zero (Ritz method)."""
    shapes = [Polynomial([0.0, 0.0, 1.0]) * end * Polynomial([0.0, 1.0]) ** k for k in range(8)]

    def energy(order: int) -> np.ndarray:
        parts = [shape.deriv(order) for shape in shapes]
        return np.array([[(a * b).integ()(1.0) for b in parts] for a in parts])

    return float(eigh(energy(2), energy(1), eigvals_only=True)[0]) * stiffness / length**2


@pytest.mark.parametrize('depth', [0.001, 0.02, 0.15])
def test_loads_equal_the_minimum_of_the_energy_method(depth: float) -> None:
    needle = NeedleParameters.preset('phantom')
    found = euler_loads(needle, depth)
    free, pinned = (
        least_load(needle.length - depth, needle.bending_stiffness, end)
        for end in (Polynomial([1.0]), Polynomial([1.0, -1.0]))
    )
    # Eight polynomials: upper bound with an error below 1e-8.
    assert found.free == pytest.approx(free, rel=1e-7)
    assert found.pinned == pytest.approx(pinned, rel=1e-7)


def test_fully_inserted_needle_does_not_buckle() -> None:
    needle = NeedleParameters.preset('phantom')
    assert euler_loads(needle, needle.length) == (inf, inf)
    for depth in (-1e-3, nan, inf):
        with pytest.raises(InsertionDepthError, match='insertion depth must be finite'):
            euler_loads(needle, depth)
