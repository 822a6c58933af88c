r"""
Shape modes of the needle, equations (10)-(11), and their integrals over the inserted part.

Everything the equations of motion need of the modes at an inserted length s (their values and
curvatures, G, H, and the first two moments) has a closed form. Where the arguments k_i s are small
the antiderivatives in boundary values lose all their digits by cancellation; there the power
series in s, held side by side in `ModeShapes.series`, gives the same without it. Two modes are
small enough at any s: one Horner pass gives all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import cos, cosh, factorial, pi
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.integrals import (
    mode_integrals,
    ModeIntegrals,
    ModeTables,
    SERIES_END,
    TERMS_PER_LENGTH,
)
from needle_dynamics.compiled.kernels import evaluate, evaluate_many
from needle_ros.errors import (
    ParameterError,
)
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

#: The first term that a series leaves out is below this part of the sum.
_TRUNCATION: Final = 1e-17


@dataclass(frozen=True)
class ModeShapes:
    """
    The first modes of a clamped-free beam of a given length, with unit norm on [0, l].

    Attributes
    ----------
    length : float
        Needle length l [m].
    count : int
        Number of modes n in (10); 2 in the source.
    reach : float
        Largest inserted length over l for which integrals are wanted; above 1 the modes are
        continued beyond the needle's length.

    """

    length: float
    count: int = 2
    reach: float = 1.0

    @cached_property
    def arguments(self) -> FloatArray:
        """Arguments k_i l, the roots of cos(x) cosh(x) + 1 = 0; shape (n,)."""
        return np.array(
            [
                brentq(
                    lambda x: cos(x) + 1.0 / cosh(x), i * pi, (i + 1) * pi, xtol=1e-15, rtol=1e-15
                )
                for i in range(self.count)
            ]
        )

    @cached_property
    def wavenumbers(self) -> FloatArray:
        """Wavenumbers k_i [1/m]; shape (n,)."""
        return np.asarray(self.arguments / self.length)

    @cached_property
    def rests(self) -> FloatArray:
        """What the growing exponentials leave, (mu_i - 1) exp(k_i l); shape (n,)."""
        x = self.arguments
        fall = np.exp(-x)
        # mu - 1 = (sin - cos - exp(-x)) / (cos + cosh), numerator and denominator times exp(x).
        return np.asarray(
            2.0 * (np.sin(x) - np.cos(x) - fall) / (1.0 + 2.0 * np.cos(x) * fall + fall**2)
        )

    @cached_property
    def ratios(self) -> FloatArray:
        """Ratios mu_i of (11); shape (n,)."""
        return np.asarray(1.0 + self.rests * np.exp(-self.arguments))

    @cached_property
    def scales(self) -> FloatArray:
        """Normalizing constants c_i of (11) [m^-1/2]: 1/c_i^2 = mu_i^2 l; shape (n,)."""
        return np.asarray(1.0 / (self.ratios * np.sqrt(self.length)))

    def derivatives(self, y: ArrayLike, order: int) -> FloatArray:
        """
        Differentiate the modes, without cancellation for high ones.

        Parameters
        ----------
        y : array_like, shape (...)
            Distance from the entry point [m].
        order : int
            Order of the derivative, at least 0.

        Returns
        -------
        ndarray, shape (..., n)
            Derivatives [m^(-1/2 - order)].

        """
        x = self.wavenumbers * np.asarray(y, dtype=float)[..., np.newaxis]
        sine, cosine = np.sin(x), np.cos(x)
        mu = self.ratios
        # d/dx takes sin to cos and cos to -sin; exp(x) stays and exp(-x) changes sign.
        turned = (
            sine - mu * cosine,
            cosine + mu * sine,
            -sine + mu * cosine,
            -cosine - mu * sine,
        )[order % 4]
        grow = 0.5 * self.rests * np.exp(x - self.arguments)
        fall = 0.5 * (mu + 1.0) * np.exp(-x) * (-1.0) ** order
        return np.asarray(self.scales * self.wavenumbers**order * (turned + grow + fall))

    def values(self, y: ArrayLike) -> FloatArray:
        """
        Mode shapes phi_i(y), equation (11) with the sign that makes them vanish at y = 0.

        Parameters
        ----------
        y : array_like, shape (...)
            Distance from the entry point [m].

        Returns
        -------
        ndarray, shape (..., n)
            phi_i [m^-1/2].

        """
        x = self.wavenumbers * np.asarray(y, dtype=float)[..., np.newaxis]
        # `derivatives` of order 0, arranged so that it is exactly zero at the clamped end.
        mu, rest, end = self.ratios, self.rests, self.arguments
        grow = 0.5 * rest * (np.exp(x - end) - np.exp(-end))
        fall = 0.5 * (mu + 1.0) * np.expm1(-x)
        shape = np.sin(x) + 2.0 * mu * np.sin(0.5 * x) ** 2 + grow + fall
        return np.asarray(self.scales * shape)

    def curvatures(self, y: ArrayLike) -> FloatArray:
        """
        Second derivatives phi_i''(y).

        Parameters
        ----------
        y : array_like, shape (...)
            Distance from the entry point [m].

        Returns
        -------
        ndarray, shape (..., n)
            phi_i'' [m^-5/2].

        """
        return self.derivatives(y, 2)

    @cached_property
    def series(self) -> FloatArray:
        """
        Coefficients of all integrals in powers of (y/l)^4; shape (terms, columns).

        Columns: G and H of each pair (three powers each), then phi, phi'', the integral of phi
        and that of y phi of each mode (two powers each).
        """
        # Products of two modes grow as (2 k y)^m / m!; beyond SERIES_END the series is not used.
        growth = 2.0 * self.reach * self.arguments[-1] if self.count == 2 else 2.0 * SERIES_END
        terms = _terms(growth)
        n, degree = self.count, 4 * terms
        phi = np.zeros((n, degree))
        curvature = np.zeros((n, degree))
        for i in range(n):
            x, c, mu = self.arguments[i], self.scales[i], self.ratios[i]
            for m in range(terms):
                # sin - sinh and cos - cosh keep one power in four of the exponential series.
                phi[i, 4 * m + 3] = -2.0 * c * x ** (4 * m + 3) / factorial(4 * m + 3)
                phi[i, 4 * m + 2] = 2.0 * c * mu * x ** (4 * m + 2) / factorial(4 * m + 2)
            powers = np.arange(degree - 2)
            curvature[i, :-2] = phi[i, 2:] * (powers + 1) * (powers + 2) / self.length**2
        columns: list[FloatArray] = []

        def put(series: FloatArray, first: int, parts: int) -> None:
            for part in range(parts):
                column = np.zeros(terms)
                picked = series[first + part :: 4][:terms]
                column[: picked.size] = picked
                columns.append(column)

        def integral(series: FloatArray, power: int = 0) -> FloatArray:
            """Integrate series(xi) y^power over y; leading zeros keep the powers in place."""
            exponents = np.arange(series.size) + power + 1
            return np.concatenate(
                [np.zeros(power + 1), series / exponents * self.length ** (power + 1)]
            )

        pairs = [(i, j) for i in range(n) for j in range(i, n)]
        for i, j in pairs:
            put(integral(np.convolve(phi[i], phi[j])), 5, 3)
        for i, j in pairs:
            put(integral(np.convolve(curvature[i], curvature[j])), 1, 3)
        for i in range(n):
            put(phi[i], 2, 2)
        for i in range(n):
            put(curvature[i], 0, 2)
        for i in range(n):
            put(integral(phi[i]), 3, 2)
        for i in range(n):
            put(integral(phi[i], 1), 4, 2)
        table = np.ascontiguousarray(np.array(columns).T)
        table.setflags(write=False)
        return table

    @cached_property
    def terms(self) -> FloatArray:
        """Terms of `series` that two modes need at a relative inserted length, by its 32nds."""
        if self.count != 2:
            return np.zeros(1)
        steps = round(self.reach * TERMS_PER_LENGTH) + 1
        needed = np.empty(steps)
        for k in range(steps):
            growth = 2.0 * self.arguments[-1] * (k + 1) / TERMS_PER_LENGTH
            needed[k] = _terms(growth)
        needed = np.minimum(needed, len(self.series))
        needed.setflags(write=False)
        return needed

    def condition(self, depth: float) -> float:
        """Return cond(G) at an inserted length [m]: how far the modes can be told apart."""
        return float(np.linalg.cond(self.integrals(depth).gram))

    def least_depth(self, condition: float) -> float:
        """Return the inserted length [m] from which on cond(G) does not exceed a value."""
        low, high = 0.0, self.length
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.condition(middle) <= condition else (middle, high)
        return high

    def packed(self, depth: float) -> FloatArray:
        """
        Evaluate the modes and their integrals as the compiled step does.

        Parameters
        ----------
        depth : float
            Inserted length s [m], in [0, reach l].

        Returns
        -------
        ndarray, shape (n (n + 1) + 4 n,)
            G and H (upper triangles by rows), phi, phi'', integrals of phi and of y phi.

        Raises
        ------
        ParameterError
            If ``depth`` is outside that range.

        """
        self._check(depth)
        n = self.count
        out = np.empty(n * (n + 1) + 4 * n)
        work = np.empty(self.series.shape[1] + 4 * n)
        xi = depth / self.length
        if n == 2:
            evaluate(xi, self.series, self.terms, work, out)
        else:
            evaluate_many(xi, self.length, self.constants, self.series, work, out)
        return out

    @cached_property
    def constants(self) -> FloatArray:
        """Rows k_i l, mu_i, (mu_i - 1) exp(k_i l) and c_i for the compiled step; shape (4, n)."""
        table = np.array([self.arguments, self.ratios, self.rests, self.scales])
        table.setflags(write=False)
        return table

    def integrals(self, depth: float) -> ModeIntegrals:
        """
        Evaluate the modes and their integrals over the inserted part.

        Parameters
        ----------
        depth : float
            Inserted length s [m], in [0, reach l].

        Returns
        -------
        ModeIntegrals
            Values at s.

        Raises
        ------
        ParameterError
            If ``depth`` is outside that range.

        """
        n, tables = self.count, self.tables
        self._check(depth)
        grams, rows = np.empty((2, n, n)), np.empty((4, n))
        at = ModeIntegrals(grams[0], grams[1], rows[0], rows[1], rows[2], rows[3])
        mode_integrals(tables, float(depth), np.empty(self.series.shape[1] + 4 * n), at)
        return at

    @cached_property
    def tables(self) -> ModeTables:
        """What the compiled evaluation of the modes takes."""
        return ModeTables(self.length, self.series, self.terms, self.constants)

    def _check(self, depth: float) -> None:
        high = self.reach * self.length
        if not 0.0 <= depth <= high:
            raise ParameterError(f'inserted length must be in [0, {high:g}] m, got {depth!r}')


@lru_cache(maxsize=32)
def mode_shapes(length: float, count: int = 2, reach: float = 1.0) -> ModeShapes:
    """
    Return the modes of a needle, made once.

    Parameters
    ----------
    length : float
        Needle length l [m].
    count : int
        Number of modes.
    reach : float
        As in `ModeShapes`.

    Returns
    -------
    ModeShapes
        The modes.

    """
    return ModeShapes(length, count, reach)


def _terms(growth: float) -> int:
    """Return after how many powers of (y/l)^4 a series that grows as growth^m / m! has ended."""
    return next(m for m in range(1, 99) if growth ** (4 * m) < _TRUNCATION * factorial(4 * m))
