# SPDX-License-Identifier: Apache-2.0
"""
Shape modes of the needle, equations (10)-(11), and their integrals over the inserted part.

All mode quantities in the equations of motion have a closed form in the insertion depth s:
values, curvatures, G, H and the first two moments. `needle_dynamics.compiled.integrals`
evaluates them; this module computes the constants and series coefficients.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import cos, cosh, factorial, pi, sin, tanh
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.integrals import (
    mode_integrals,
    ModeIntegrals,
    ModeTables,
    SERIES_END,
    TERMS_PER_LENGTH,
)
from needle_ros.errors import ParameterError
import numpy as np
from numpy.typing import ArrayLike

#: Relative truncation error of the series: first omitted term over the sum.
_TRUNCATION: Final = 1e-17


@dataclass(frozen=True)
class ModeShapes:
    """The first modes of a clamped-free beam of a given length, with unit norm on [0, l]."""

    length: float  #: needle length l [m]
    count: int = 2  #: number of modes n in (10); 2 in the source
    #: Largest insertion depth over l for which integrals are computed; above 1 the modes are
    #: extended beyond the needle length.
    reach: float = 1.0

    @cached_property
    def arguments(self) -> FloatArray:
        """Arguments k_i l, the roots of cos(x) cosh(x) + 1 = 0; shape (n,)."""
        return np.array([_root(i) for i in range(self.count)])

    @cached_property
    def wavenumbers(self) -> FloatArray:
        """Wavenumbers k_i [1/m]; shape (n,)."""
        return np.asarray(self.arguments / self.length)

    @cached_property
    def _rests(self) -> FloatArray:
        """Coefficients (mu_i - 1) exp(k_i l) of the growing exponentials; shape (n,)."""
        x = self.arguments
        fall = np.exp(-x)
        # mu - 1 = (sin - cos - exp(-x)) / (cos + cosh), numerator and denominator times exp(x).
        return np.asarray(
            2.0 * (np.sin(x) - np.cos(x) - fall) / (1.0 + 2.0 * np.cos(x) * fall + fall**2)
        )

    @cached_property
    def ratios(self) -> FloatArray:
        """Ratios mu_i of (11); shape (n,)."""
        return np.asarray(1.0 + self._rests * np.exp(-self.arguments))

    @cached_property
    def scales(self) -> FloatArray:
        """Normalizing constants c_i of (11) [m^-1/2]: 1/c_i^2 = mu_i^2 l; shape (n,)."""
        return np.asarray(1.0 / (self.ratios * np.sqrt(self.length)))

    def values(self, y: ArrayLike) -> FloatArray:
        """Return phi_i(y) [m^-1/2], shape (..., n), by (11) with the sign for phi_i(0) = 0."""
        x = self.wavenumbers * np.asarray(y, dtype=float)[..., np.newaxis]
        # `derivatives` of order 0, arranged so that it is exactly zero at the clamped end.
        mu, rest, end = self.ratios, self._rests, self.arguments
        grow = 0.5 * rest * (np.exp(x - end) - np.exp(-end))
        fall = 0.5 * (mu + 1.0) * np.expm1(-x)
        shape = np.sin(x) + 2.0 * mu * np.sin(0.5 * x) ** 2 + grow + fall
        return np.asarray(self.scales * shape)

    def derivatives(self, y: ArrayLike, order: int) -> FloatArray:
        """Return derivatives of phi_i in y [m^(-1/2 - order)], shape (..., n)."""
        # There is no cancellation for high modes.
        x = self.wavenumbers * np.asarray(y, dtype=float)[..., np.newaxis]
        sine, cosine = np.sin(x), np.cos(x)
        mu = self.ratios
        # d/dx maps sin to cos, cos to -sin, exp(x) to itself and exp(-x) to -exp(-x).
        even, odd = sine - mu * cosine, cosine + mu * sine
        turned = (even, odd, -even, -odd)[order % 4]
        grow = 0.5 * self._rests * np.exp(x - self.arguments)
        fall = 0.5 * (mu + 1.0) * np.exp(-x) * (-1.0) ** order
        return np.asarray(self.scales * self.wavenumbers**order * (turned + grow + fall))

    def integrals(self, depth: float) -> ModeIntegrals:
        """Return modes and integrals at an insertion depth [m] in [0, reach l]."""
        high = self.reach * self.length
        if not 0.0 <= depth <= high:
            raise ParameterError(f'insertion depth must be in [0, {high:g}] m, got {depth!r}')
        n, tables = self.count, self.tables
        grams, rows = np.empty((2, n, n)), np.empty((4, n))
        at = ModeIntegrals(grams[0], grams[1], rows[0], rows[1], rows[2], rows[3])
        mode_integrals(tables, float(depth), np.empty(tables.series.shape[1] + 4 * n), at)
        return at

    @cached_property
    def tables(self) -> ModeTables:
        """Series and constants for the compiled evaluation of the integrals."""
        constants = np.array([self.arguments, self.ratios, self._rests, self.scales])
        tables = ModeTables(self.length, self._series(), self._needed(), constants)
        for table in tables[1:]:
            table.setflags(write=False)
        return tables

    def _series(self) -> FloatArray:
        """Return the coefficients of all integrals in powers of (s/l)^4, see `ModeTables`."""
        # Products of two modes grow as (2 k y)^m / m!; beyond SERIES_END the series is not used.
        growth = 2.0 * self.reach * self.arguments[-1] if self.count == 2 else 2.0 * SERIES_END
        terms = _terms(growth)
        n, degree = self.count, 4 * terms
        phi = np.zeros((n, degree))
        curvature = np.zeros((n, degree))
        for i in range(n):
            x, c, mu = self.arguments[i], self.scales[i], self.ratios[i]
            for m in range(terms):
                # sin - sinh and cos - cosh retain every fourth power of the exponential series.
                phi[i, 4 * m + 3] = -2.0 * c * x ** (4 * m + 3) / factorial(4 * m + 3)
                phi[i, 4 * m + 2] = 2.0 * c * mu * x ** (4 * m + 2) / factorial(4 * m + 2)
            powers = np.arange(degree - 2)
            curvature[i, :-2] = phi[i, 2:] * (powers + 1) * (powers + 2) / self.length**2

        def integral(series: FloatArray, power: int = 0) -> FloatArray:
            """Integrate series(xi) y^power over y; leading zeros preserve the exponents."""
            exponents = np.arange(series.size) + power + 1
            return np.concatenate(
                [np.zeros(power + 1), series / exponents * self.length ** (power + 1)]
            )

        pairs = [(i, j) for i in range(n) for j in range(i, n)]
        # Series, lowest nonzero power and number of consecutive powers.
        found = (
            *((integral(np.convolve(phi[i], phi[j])), 5, 3) for i, j in pairs),
            *((integral(np.convolve(curvature[i], curvature[j])), 1, 3) for i, j in pairs),
            *((one, 2, 2) for one in phi),
            *((one, 0, 2) for one in curvature),
            *((integral(one), 3, 2) for one in phi),
            *((integral(one, 1), 4, 2) for one in phi),
        )
        columns = [
            np.resize(np.append(series[power::4], np.zeros(terms)), terms)
            for series, lowest, count in found
            for power in range(lowest, lowest + count)
        ]
        return np.ascontiguousarray(np.array(columns).T)

    def _needed(self) -> FloatArray:
        """Return the number of series terms for two modes, by relative insertion depth."""
        if self.count != 2:
            return np.zeros(1)
        steps = np.arange(1, round(self.reach * TERMS_PER_LENGTH) + 2)
        growths = 2.0 * self.arguments[-1] * steps / TERMS_PER_LENGTH
        longest = _terms(2.0 * self.reach * self.arguments[-1])
        return np.array([float(min(_terms(growth), longest)) for growth in growths])


@lru_cache(maxsize=32)
def mode_shapes(length: float, count: int = 2, reach: float = 1.0) -> ModeShapes:
    """
    Return the (cached) modes of a needle.

    Parameters
    ----------
    length : float
        Needle length l [m].
    count : int
        Number of modes.
    reach : float
        See `ModeShapes`.

    Returns
    -------
    ModeShapes
        The modes.

    Examples
    --------
    >>> from needle_dynamics import mode_shapes
    >>> modes = mode_shapes(0.2)
    >>> print(modes.arguments.round(4))
    [1.8751 4.6941]

    The modes are orthonormal on the whole length and vanish at the entry point:

    >>> print(modes.integrals(0.2).gram.round(9) + 0.0)
    [[1. 0.]
     [0. 1.]]
    >>> print(modes.values([0.0, 0.2]).round(3))
    [[ 0.     0.   ]
     [ 4.472 -4.472]]

    """
    return ModeShapes(length, count, reach)


def _root(i: int) -> float:
    """Return the root i = 0, 1, ... of cos(x) cosh(x) + 1 = 0, by Newton's method."""
    x = (i + 0.5) * pi + (0.3 if i == 0 else 0.0)
    for _ in range(10):
        x += (cos(x) + 1.0 / cosh(x)) / (sin(x) + tanh(x) / cosh(x))
    return x


def _terms(growth: float) -> int:
    """Return the number of powers of (y/l)^4 for a series that grows as growth^m / m!."""
    return next(m for m in range(1, 99) if growth ** (4 * m) < _TRUNCATION * factorial(4 * m))
