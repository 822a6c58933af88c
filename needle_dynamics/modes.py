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

from needle_dynamics._compile import compiled
from needle_dynamics.errors import ParameterError
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

FloatArray = NDArray[np.float64]

#: Number of modes n in (10), as in the paper.
MODES: Final = 2

#: Powers of (y/l)^4 kept: the first one left out is below 1e-17 of the sum at y = l.
_TERMS: Final = 13

# Columns of the series: where each quantity starts. Pairs count 11, 12, 22.
_G: Final = 0
_H: Final = 9
_PHI: Final = 18
_CURVATURE: Final = 22
_MOMENT_0: Final = 26
_MOMENT_1: Final = 30
_COLUMNS: Final = 34


@dataclass(frozen=True)
class ModeShapes:
    """
    The first two clamped-free modes of a beam of a given length, with unit norm on [0, l].

    Attributes
    ----------
    length : float
        Needle length l [m].

    """

    length: float

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
        degree = 4 * _TERMS
        phi = np.zeros((MODES, degree))
        curvature = np.zeros((MODES, degree))
        for i in range(MODES):
            x, c, mu = self.wavenumbers[i] * self.length, self.scales[i], self.ratios[i]
            for m in range(_TERMS):
                # sin - sinh and cos - cosh keep one power in four of the exponential series.
                phi[i, 4 * m + 3] = -2.0 * c * x ** (4 * m + 3) / factorial(4 * m + 3)
                phi[i, 4 * m + 2] = 2.0 * c * mu * x ** (4 * m + 2) / factorial(4 * m + 2)
            powers = np.arange(degree - 2)
            curvature[i, :-2] = phi[i, 2:] * (powers + 1) * (powers + 2) / self.length**2
        table = np.zeros((_TERMS, _COLUMNS))

        def put(column: int, series: FloatArray, first: int, parts: int) -> None:
            for part in range(parts):
                picked = series[first + part :: 4][:_TERMS]
                table[: picked.size, column + part] = picked

        def integral(series: FloatArray, power: int = 0) -> FloatArray:
            """Integrate series(xi) y^power over y; leading zeros keep the powers in place."""
            exponents = np.arange(series.size) + power + 1
            return np.concatenate(
                [np.zeros(power + 1), series / exponents * self.length ** (power + 1)]
            )

        for pair, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            put(_G + 3 * pair, integral(np.convolve(phi[i], phi[j])), 5, 3)
            put(_H + 3 * pair, integral(np.convolve(curvature[i], curvature[j])), 1, 3)
        for i in range(MODES):
            put(_PHI + 2 * i, phi[i], 2, 2)
            put(_CURVATURE + 2 * i, curvature[i], 0, 2)
            put(_MOMENT_0 + 2 * i, integral(phi[i]), 3, 2)
            put(_MOMENT_1 + 2 * i, integral(phi[i], 1), 4, 2)
        table.setflags(write=False)
        return table

    def integrals(self, depth: float) -> ModeIntegrals:
        """
        Evaluate the modes and their integrals over the inserted part.

        Parameters
        ----------
        depth : float
            Inserted length s [m], in [0, l].

        Returns
        -------
        ModeIntegrals
            Values at s.

        Raises
        ------
        ParameterError
            If ``depth`` is outside [0, l].

        """
        if not 0.0 <= depth <= self.length:
            raise ParameterError(
                f'inserted length must be in [0, {self.length:g}] m, got {depth!r}'
            )
        v = np.empty(COLUMNS_OUT)
        evaluate(depth / self.length, self.series, np.empty(_COLUMNS), v)
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
def mode_shapes(length: float) -> ModeShapes:
    """Return the modes of a needle of the given length [m], made once."""
    return ModeShapes(length)


#: Length of the output of `evaluate`: G (11, 12, 22), H (11, 12, 22), then phi, phi'',
#: the integral of phi and that of y phi, two each.
COLUMNS_OUT: Final = 14


@compiled
def evaluate(xi: float, table: FloatArray, work: FloatArray, out: FloatArray) -> None:
    """
    Evaluate all series at the relative inserted length.

    Parameters
    ----------
    xi : float
        s / l.
    table : ndarray, shape (terms, columns)
        `ModeShapes.series`.
    work : ndarray, shape (columns,)
        Scratch.
    out : ndarray, shape (14,)
        Overwritten with the values, in the order of `COLUMNS_OUT`.

    """
    square = xi * xi
    z = square * square
    for j in range(_COLUMNS):
        work[j] = table[_TERMS - 1, j]
    for m in range(_TERMS - 2, -1, -1):
        for j in range(_COLUMNS):
            work[j] = work[j] * z + table[m, j]
    for pair in range(3):
        g, h = _G + 3 * pair, _H + 3 * pair
        out[pair] = z * xi * (work[g] + xi * work[g + 1] + square * work[g + 2])
        out[3 + pair] = xi * (work[h] + xi * work[h + 1] + square * work[h + 2])
    for i in range(MODES):
        j = 2 * i
        out[6 + i] = square * (work[_PHI + j] + xi * work[_PHI + j + 1])
        out[8 + i] = work[_CURVATURE + j] + xi * work[_CURVATURE + j + 1]
        out[10 + i] = square * xi * (work[_MOMENT_0 + j] + xi * work[_MOMENT_0 + j + 1])
        out[12 + i] = z * (work[_MOMENT_1 + j] + xi * work[_MOMENT_1 + j + 1])
