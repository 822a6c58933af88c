# SPDX-License-Identifier: Apache-2.0
"""
Beam of finite differences in tissue whose stiffness varies at random along the path.

Central differences of second order on a uniform grid, in both planes. The beam bends about the
path that its tip cut. In a uniform field it is the linear beam on a Winkler foundation.
"""

from __future__ import annotations

from benchmarks.worlds.world import DrawnConstants, IndependentNeedle, LONGEST
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numpy as np
from scipy.linalg import solveh_banded
from scipy.special import ndtr

#: Distance of the values of a field [m].
_CELL = 1e-3


def draw_field(
    rng: np.random.Generator, deviation: float = 0.5, correlation: float = 0.01
) -> FloatArray:
    """
    Draw relative stiffnesses, uniform in 1 +- deviation, in each millimeter; shape (k,).

    A Gaussian field with a squared exponential covariance, mapped to a uniform distribution. Size
    and correlation length [m] are assumptions.
    """
    depths = _CELL * np.arange(round(LONGEST / _CELL) + 1)
    apart = (depths[:, np.newaxis] - depths) / correlation
    # The second term makes the matrix positive definite in spite of rounding.
    covariance = np.exp(-0.5 * apart**2) + 1e-6 * np.eye(len(depths))
    normal = np.linalg.cholesky(covariance) @ rng.standard_normal(len(depths))
    return np.asarray(1.0 + deviation * (2.0 * ndtr(normal) - 1.0))


class StiffnessField(IndependentNeedle):
    """
    Beam in tissue with relative stiffnesses in each millimeter, by default 1.

    ``size`` is the distance of the nodes [m]; the free length and all depths are multiples of it.
    """

    def __init__(
        self,
        constants: DrawnConstants,
        depths: FloatArray,
        field: FloatArray | None = None,
        size: float = 1e-3,
    ) -> None:
        super().__init__(constants, depths)
        self.size = size
        self._outside = round(constants.free / size)
        nodes = size * np.arange(round(LONGEST / size) + 1)
        values = np.ones(2) if field is None else field
        relative = np.interp(nodes, _CELL * np.arange(len(values)), values)
        self._ground = constants.tissue * size * relative
        self._ground[0] *= 0.5
        self._at = np.array([(0.0, 0.0), constants.tilt])
        #: Deflection in x and z at the nodes, from the guide to the tip [m].
        self.shape = size * np.outer(np.arange(self._outside + 1), self._at[1])
        #: Path at the nodes from the skin to the tip [m].
        self.path = self.shape[-1:].copy()
        self._solve(cutting=True)

    def _solve(self, *, cutting: bool) -> None:
        """Compute the shape; a needle that cuts ends on its path."""
        c, h, inside = self.constants, self.size, len(self.path)
        count = self._outside + inside - 1
        # Curvatures at the nodes from the guide to the last but one; half a cell at the guide.
        weight = np.full(count + 2, c.stiffness / h**3)
        weight[0] *= 2.0
        weight[count:] = 0.0
        band, loads = np.zeros((3, count)), np.zeros((count, 2))
        band[0] = weight[:-2] + 4.0 * weight[1:-1] + weight[2:]
        band[1] = -2.0 * (weight[1:-1] + weight[2:])
        band[2] = weight[2:]
        loads[0] = weight[0] * (self._at[0] + h * self._at[1]) + 2.0 * weight[1] * self._at[0]
        loads[1] = -weight[1] * self._at[0]
        ground = self._ground[:inside].copy()
        ground[-1] *= 0.0 if cutting else 0.5
        band[0, self._outside - 1 :] += ground
        loads[self._outside - 1 :] += ground[:, np.newaxis] * self.path
        band[0, self._outside - 1] += c.skin
        loads[self._outside - 1] += c.skin * c.entry
        loads[-1] += c.load(h * (inside - 1.5))
        found = solveh_banded(band, loads, lower=True, check_finite=False)
        self.shape = np.vstack([self._at[:1], found])

    @property
    def position(self) -> FloatArray:
        return np.array(self.shape[-1])

    @property
    def guide_load(self) -> FloatArray:
        w, h = self.shape, self.size
        # Derivative of the energy by the position of the guide, with its sign changed.
        turned = 2.0 * (w[1] - w[0] - h * self._at[1]) - (w[0] - 2.0 * w[1] + w[2])
        return np.array([self.constants.stiffness / h**3 * turned])

    def guide(self, to: GuideSetpoint) -> None:
        self._at[0] = to[:2]
        self._solve(cutting=len(self.path) == 1)

    def ahead(self) -> FloatArray | None:
        """Return the next point of the path if it does not depend on the next shape [m]."""
        return None

    def advance(self, depth: float) -> None:
        # The path continues from the tip, which has moved since the last increment.
        before = 0.0 if len(self.path) == 1 else 0.5
        self.path[-1] = before * self.path[-1] + (1.0 - before) * self.shape[-1]
        for _ in range(len(self.path) - 1, round(depth / self.size)):
            ahead = self.ahead()
            self.path = np.vstack([self.path, np.zeros(2) if ahead is None else ahead])
            self._solve(cutting=ahead is None)
            if ahead is None:
                self.path[-1] = self.shape[-1]
