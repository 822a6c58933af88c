# SPDX-License-Identifier: Apache-2.0
"""
Beam of Legendre polynomials in tissue with stiff inclusions and membranes.

The deflection in the tissue is one polynomial in each plane, and the free length is an exact beam
(a Ritz method). The tissue acts at Gauss points of the path.

An inclusion is stiffer than the tissue around it, and its inclined surface pushes the tip aside.
A membrane pushes the tip aside until it breaks. Lesions of liver and prostate are two to five
times as stiff as the tissue around them; loads and sizes are assumptions.
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

from benchmarks.worlds.world import CELL, DrawnConstants, grown, IndependentNeedle, LONGEST
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import cho_factor, cho_solve

#: Number of inclusions and of membranes.
_INCLUSIONS, _MEMBRANES = 2, 2

#: Largest lateral load of an obstacle [N]: a third of a puncture of 3 N.
_PUSH: Final = 1.0

#: Gauss points of an interval from -1 to 1.
_GAUSS: Final = np.array([-(3.0**-0.5), 3.0**-0.5])

#: Distance before a membrane in which its load grows [m].
_BULGE: Final = 4e-3


class Obstacles(NamedTuple):
    """Obstacles along a path."""

    begins: FloatArray  #: depth at which each inclusion begins [m]
    ends: FloatArray  #: depth at which it ends [m]
    factors: FloatArray  #: its stiffness relative to the tissue
    loads: FloatArray  #: lateral load on the tip in each cell of length `CELL` [N], (k, 2)


def draw_obstacles(rng: np.random.Generator) -> Obstacles:
    """Draw inclusions of 8 to 20 mm, and membranes; all of them push with up to 1 N."""
    begins = rng.uniform(0.01, 0.09, _INCLUSIONS)
    ends = begins + rng.uniform(8e-3, 0.02, _INCLUSIONS)
    factors = rng.uniform(2.0, 5.0, _INCLUSIONS)
    membranes = rng.uniform(0.015, 0.09, _MEMBRANES)
    depths = CELL * np.arange(round(LONGEST / CELL))
    loads = np.zeros((len(depths), 2))
    for at in (*begins, *membranes):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        push = rng.uniform(0.0, _PUSH) * np.array([np.cos(angle), np.sin(angle)])
        before = (depths - (at - _BULGE)) / _BULGE
        loads += np.where((before > 0.0) & (before <= 1.0), before, 0.0)[:, np.newaxis] * push
    return Obstacles(begins, ends, factors, loads)


@cache
def _polynomials(count: int) -> tuple[FloatArray, FloatArray]:
    """
    Return integrals of the products of second derivatives from -1 to 1, shape (count, count).

    And values and derivatives at -1, shape (2, count).
    """
    unit = np.eye(count)
    xi, weights = legendre.leggauss(count)
    bent = legendre.legval(xi, legendre.legder(unit, 2)).T
    ends = [legendre.legval(-1.0, one) for one in (unit, legendre.legder(unit))]
    return bent.T @ (weights[:, np.newaxis] * bent), np.array(ends)


class Inclusions(IndependentNeedle):
    """
    Beam in tissue with obstacles, by default without.

    ``degree`` is the degree of the polynomial, and ``size`` the longest increment of the path [m].
    """

    def __init__(
        self,
        constants: DrawnConstants,
        depths: FloatArray,
        obstacles: Obstacles | None = None,
        degree: int = 14,
        size: float = 1.25e-3,
    ) -> None:
        super().__init__(constants, depths)
        self._obstacles, self._degree, self._size = obstacles, degree, size
        self._at = np.array([(0.0, 0.0), constants.tilt])
        #: Path at its depths [m], and the force on the guide [N].
        self._along, self._path = [0.0], [constants.entry]
        l = constants.free
        # Exact stiffness of the free length for deflection and slope at its ends.
        self._outside = constants.stiffness / l**3 * np.array([
            [12.0, 6.0 * l, -12.0, 6.0 * l],
            [6.0 * l, 4.0 * l * l, -6.0 * l, 2.0 * l * l],
            [-12.0, -6.0 * l, 12.0, -6.0 * l],
            [6.0 * l, 2.0 * l * l, -6.0 * l, 4.0 * l * l],
        ])  # fmt: skip
        self._rest()

    def _ground(self, depths: FloatArray) -> FloatArray:
        """Return the stiffness of the tissue at depths [N/m^2]."""
        found, few = np.full(len(depths), self.constants.tissue), self._obstacles
        if few is not None:
            for begin, end, factor in zip(few.begins, few.ends, few.factors, strict=True):
                found[(depths >= begin) & (depths < end)] = factor * self.constants.tissue
        return found

    def _load(self, depth: float) -> FloatArray:
        """Return the load on the tip [N]."""
        load, few = self.constants.load(depth), self._obstacles
        if few is None:
            return load
        return np.asarray(load + few.loads[min(int(depth / CELL), len(few.loads) - 1)])

    def _rest(self) -> None:
        """Compute the shape of a needle on the skin."""
        outside, skin = self._outside, self.constants.skin
        inside = outside[2:, 2:] + np.diag([skin, 0.0])
        loads = -outside[2:, :2] @ self._at
        loads[0] += skin * self.constants.entry + self._load(0.0)
        end = np.linalg.solve(inside, loads)
        self._tip = end[0]
        self._force = -outside[0] @ np.vstack([self._at, end])

    def _solve(self, *, cutting: bool) -> None:
        """Compute the shape; a needle that cuts ends on its path."""
        along, path = np.array(self._along), np.array(self._path)
        deep, count = along[-1], min(self._degree, 2 + len(along)) + 1
        scale = 2.0 / deep
        bent, ends = _polynomials(count)
        stiff = self.constants.stiffness * scale**3 * bent
        # Two Gauss points in each increment of the path, which is straight.
        part = 0.5 + 0.5 * _GAUSS
        widths = np.diff(along)
        at = (along[:-1, np.newaxis] + np.outer(widths, part)).ravel()
        shares = np.tile(part, len(widths))[:, np.newaxis]
        rows = legendre.legvander(scale * at - 1.0, count - 1)
        bed = (1.0 - shares) * np.repeat(path[:-1], 2, axis=0)
        later = shares * np.repeat(path[1:], 2, axis=0)
        if cutting:
            # The last point of the path is the tip, where each polynomial is 1.
            rows[-2:] -= shares[-2:]
            later[-2:] = 0.0
        strength = (0.5 * np.repeat(widths, 2) * self._ground(at))[:, np.newaxis]
        stiff += rows.T @ (strength * rows)
        loads = rows.T @ (strength * (bed + later))
        begin = ends * np.array([[1.0], [scale]])
        outside = self._outside
        inside = outside[2:, 2:].copy()
        inside[0, 0] += self.constants.skin
        stiff += begin.T @ inside @ begin
        loads -= begin.T @ outside[2:, :2] @ self._at
        loads += self.constants.skin * np.outer(begin[0], self.constants.entry)
        loads += self._load(deep - 0.5 * widths[-1])
        size = 1.0 / np.sqrt(np.diag(stiff))
        scaled = size[:, np.newaxis] * stiff * size
        found = size[:, np.newaxis] * cho_solve(cho_factor(scaled), size[:, np.newaxis] * loads)
        self._tip = found.sum(axis=0)
        self._force = -outside[0] @ np.vstack([self._at, begin @ found])

    @property
    def position(self) -> FloatArray:
        return np.array(self._tip)

    @property
    def guide_load(self) -> FloatArray:
        return np.array([self._force])

    def guide(self, to: GuideSetpoint) -> None:
        self._at[0] = to[:2]
        if len(self._along) > 1:
            self._solve(cutting=False)
        else:
            self._rest()

    def advance(self, depth: float) -> None:
        # The path continues from the tip, which has moved since the last increment.
        self._path.append(self._tip)
        self._along.append(self._along[-1])
        for at in grown(self._along[-1], depth, self._size):
            self._along.append(at)
            self._path.append(self._tip)
            self._solve(cutting=True)
            self._path[-1] = self._tip
