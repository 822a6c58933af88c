r"""
Shape modes of the needle, equations (10)-(11), and their integrals over the inserted part.

Everything the equations of motion need of the modes at an inserted length s (their values and
curvatures, G, H, and the first two moments) is analytic in s. `ModeShapes.series` holds the
power series of all of them side by side, so that one Horner pass gives the lot without
quadrature and without the cancellation that the antiderivatives in boundary values suffer at
small s.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import cos, cosh, factorial, pi
from typing import Final

from needle_dynamics.errors import ParameterError
from needle_dynamics.kernels import (
    AREA,
    COLUMNS,
    CURVATURE,
    CURVATURE_GRAM,
    evaluate,
    FloatArray,
    GRAM,
    INTEGRALS,
    MODES,
    MOMENT,
    VALUE,
)
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

#: The first term that a series leaves out is below this part of the sum.
_TRUNCATION: Final = 1e-17


@dataclass(frozen=True)
class ModeShapes:
    """
    The first two clamped-free modes of a beam of a given length, with unit norm on [0, l].

    Attributes
    ----------
    length : float
        Needle length l [m].
    reach : float
        Largest inserted length over l for which integrals are wanted; above 1 the modes are
        continued beyond the needle's length.

    """

    length: float
    reach: float = 1.0

    @cached_property
    def wavenumbers(self) -> FloatArray:
        """Wavenumbers k_i [1/m], the roots of cos(k l) cosh(k l) + 1 = 0; shape (2,)."""
        roots = [
            brentq(lambda x: cos(x) + 1.0 / cosh(x), i * pi, (i + 1) * pi, xtol=1e-15, rtol=1e-15)
            for i in range(MODES)
        ]
        return np.array(roots) / self.length

    @cached_property
    def ratios(self) -> FloatArray:
        """Ratios mu_i of (11); shape (2,)."""
        x = self.wavenumbers * self.length
        return np.asarray((np.sin(x) + np.sinh(x)) / (np.cos(x) + np.cosh(x)))

    @cached_property
    def scales(self) -> FloatArray:
        """Normalizing constants c_i of (11) [m^-1/2]; shape (2,)."""
        k, l = self.wavenumbers, self.length
        x, mu = k * l, self.ratios
        inverse_square = (
            (2.0 * mu / k) * np.sin(x) * np.sinh(x)
            + (1.0 - mu**2) / k * np.cos(x) * np.sinh(x)
            - (1.0 + mu**2) / k * np.sin(x) * np.cosh(x)
            + (1.0 + mu**2) / (4.0 * k) * np.sinh(2.0 * x)
            + (mu**2 - 1.0) / (4.0 * k) * np.sin(2.0 * x)
            + mu / (2.0 * k) * (np.cos(2.0 * x) - np.cosh(2.0 * x))
            + mu**2 * l
        )
        return np.asarray(1.0 / np.sqrt(inverse_square))

    def values(self, y: ArrayLike) -> FloatArray:
        """
        Mode shapes phi_i(y), equation (11) with the sign that makes them vanish at y = 0.

        Parameters
        ----------
        y : array_like, shape (...)
            Distance from the entry point [m].

        Returns
        -------
        ndarray, shape (..., 2)
            phi_1 and phi_2 [m^-1/2].

        """
        x = self.wavenumbers * np.asarray(y, dtype=float)[..., np.newaxis]
        return np.asarray(
            self.scales * (np.sin(x) - np.sinh(x) - self.ratios * (np.cos(x) - np.cosh(x)))
        )

    def curvatures(self, y: ArrayLike) -> FloatArray:
        """
        Second derivatives phi_i''(y).

        Parameters
        ----------
        y : array_like, shape (...)
            Distance from the entry point [m].

        Returns
        -------
        ndarray, shape (..., 2)
            phi_1'' and phi_2'' [m^-5/2].

        """
        x = self.wavenumbers * np.asarray(y, dtype=float)[..., np.newaxis]
        return np.asarray(
            self.wavenumbers**2
            * self.scales
            * (-np.sin(x) - np.sinh(x) + self.ratios * (np.cos(x) + np.cosh(x)))
        )

    @cached_property
    def series(self) -> FloatArray:
        """Coefficients of all quantities of `integrals` in powers of (y/l)^4; (terms, columns)."""
        # Products of two modes grow as (2 k y)^m / m!.
        growth = 2.0 * float(self.wavenumbers[-1]) * self.length * self.reach
        terms = next(m for m in range(1, 99) if growth ** (4 * m) < _TRUNCATION * factorial(4 * m))
        degree = 4 * terms
        phi = np.zeros((MODES, degree))
        curvature = np.zeros((MODES, degree))
        for i in range(MODES):
            x, c, mu = self.wavenumbers[i] * self.length, self.scales[i], self.ratios[i]
            for m in range(terms):
                # sin - sinh and cos - cosh keep one power in four of the exponential series.
                phi[i, 4 * m + 3] = -2.0 * c * x ** (4 * m + 3) / factorial(4 * m + 3)
                phi[i, 4 * m + 2] = 2.0 * c * mu * x ** (4 * m + 2) / factorial(4 * m + 2)
            powers = np.arange(degree - 2)
            curvature[i, :-2] = phi[i, 2:] * (powers + 1) * (powers + 2) / self.length**2
        table = np.zeros((terms, COLUMNS))

        def put(column: int, series: FloatArray, first: int, parts: int) -> None:
            for part in range(parts):
                picked = series[first + part :: 4][:terms]
                table[: picked.size, column + part] = picked

        def integral(series: FloatArray, power: int = 0) -> FloatArray:
            """Integrate series(xi) y^power over y; leading zeros keep the powers in place."""
            exponents = np.arange(series.size) + power + 1
            return np.concatenate(
                [np.zeros(power + 1), series / exponents * self.length ** (power + 1)]
            )

        for pair, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            put(GRAM + 3 * pair, integral(np.convolve(phi[i], phi[j])), 5, 3)
            put(CURVATURE_GRAM + 3 * pair, integral(np.convolve(curvature[i], curvature[j])), 1, 3)
        for i in range(MODES):
            put(VALUE + 2 * i, phi[i], 2, 2)
            put(CURVATURE + 2 * i, curvature[i], 0, 2)
            put(AREA + 2 * i, integral(phi[i]), 3, 2)
            put(MOMENT + 2 * i, integral(phi[i], 1), 4, 2)
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
        if not 0.0 <= depth <= self.reach * self.length:
            raise ParameterError(
                f'inserted length must be in [0, {self.reach * self.length:g}] m, got {depth!r}'
            )
        v = np.empty(INTEGRALS)
        evaluate(depth / self.length, self.series, np.empty(COLUMNS), v)
        return ModeIntegrals(
            gram=np.array([[v[0], v[1]], [v[1], v[2]]]),
            curvature_gram=np.array([[v[3], v[4]], [v[4], v[5]]]),
            value=v[6:8],
            curvature=v[8:10],
            area=v[10:12],
            moment=v[12:14],
        )


@dataclass(frozen=True, slots=True)
class ModeIntegrals:
    """
    The modes at the tip and their integrals over the inserted part 0 <= y <= s.

    Attributes
    ----------
    gram : ndarray, shape (2, 2)
        G(s), the integral of phi phi^T [1].
    curvature_gram : ndarray, shape (2, 2)
        H(s), the integral of phi'' phi''^T [m^-4].
    value, curvature : ndarray, shape (2,)
        phi(s) [m^-1/2] and phi''(s) [m^-5/2].
    area, moment : ndarray, shape (2,)
        Integrals of phi [m^1/2] and of y phi [m^3/2].

    """

    gram: FloatArray
    curvature_gram: FloatArray
    value: FloatArray
    curvature: FloatArray
    area: FloatArray
    moment: FloatArray


@lru_cache(maxsize=32)
def mode_shapes(length: float, reach: float = 1.0) -> ModeShapes:
    """Return the modes of a needle of the given length [m] and `ModeShapes.reach`, made once."""
    return ModeShapes(length, reach)
