"""
The shape modes at the tip and their integrals over the inserted part.

Where the arguments k_i s are small, the closed forms of the integrals lose all their digits by
cancellation; power series in s, held side by side in `ModeTables.series`, do not. The arguments of
two modes are small enough at any s, so that one Horner pass gives all of them.
"""

from __future__ import annotations

from math import cos, exp, isfinite, nan, sin
from typing import Final, NamedTuple

from needle_dynamics.arrays import FixedMatrix, FixedVector, FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import compiled, inlined, inlined_kernel, kernel
import numpy as np

#: Below this argument k_i s the series of a mode is used, above it the closed form.
SERIES_END: Final = 2.0

#: Resolution of `ModeTables.terms` in the relative inserted length.
TERMS_PER_LENGTH: Final = 32


class ModeTables(NamedTuple):
    """
    What the evaluation of n modes needs; made by `needle_dynamics.modes.ModeShapes.tables`.

    Attributes
    ----------
    length : float
        Needle length l [m].
    series : ndarray, shape (terms, columns)
        Coefficients in powers of (s/l)^4. Columns: G and H of each pair i <= j (three powers of
        s/l each), then phi, phi'', the integral of phi and that of y phi of each mode (two powers
        each).
    terms : ndarray, shape (l / s steps,)
        Number of terms that two modes need, by relative inserted length in steps of
        1 / `TERMS_PER_LENGTH`.
    modes : ndarray, shape (4, n)
        Rows k_i l, mu_i, (mu_i - 1) exp(k_i l) and c_i of (11).

    """

    length: float
    series: FixedMatrix
    terms: FixedVector
    modes: FixedMatrix


class ModeIntegrals(NamedTuple):
    """
    The modes at the tip and their integrals over the inserted part 0 <= y <= s.

    Attributes
    ----------
    gram : ndarray, shape (n, n)
        G(s), the integral of phi phi^T [1].
    curvature_gram : ndarray, shape (n, n)
        H(s), the integral of phi'' phi''^T [m^-4].
    value, curvature : ndarray, shape (n,)
        phi(s) [m^-1/2] and phi''(s) [m^-5/2].
    area, moment : ndarray, shape (n,)
        Integrals of phi [m^1/2] and of y phi [m^3/2].

    """

    gram: Matrix
    curvature_gram: Matrix
    value: Vector
    curvature: Vector
    area: Vector
    moment: Vector


@compiled
def mode_derivatives(
    x: float, ratio: float, rest: float, end: float
) -> tuple[float, float, float, float]:
    """
    Return phi and its first three derivatives, over c_i k_i^order.

    The growing exponentials of (11) nearly cancel; ``rest`` is what is left of them at the tip of
    a fully inserted needle, so that no mode is too high.

    Parameters
    ----------
    x : float
        Argument k_i y.
    ratio, rest, end : float
        mu_i, (mu_i - 1) exp(k_i l) and k_i l.

    Returns
    -------
    tuple of float
        Orders 0 to 3.

    """
    sine, cosine = sin(x), cos(x)
    grow = 0.5 * rest * exp(x - end)
    fall = 0.5 * (ratio + 1.0) * exp(-x)
    return (
        sine - ratio * cosine + grow + fall,
        cosine + ratio * sine + grow - fall,
        -sine + ratio * cosine + grow + fall,
        -cosine - ratio * sine + grow - fall,
    )


@inlined
def two_modes(tables: ModeTables, depth: float, work: FloatArray, out: ModeIntegrals) -> None:
    """
    Evaluate the series of two modes; parameters as in `mode_integrals`.

    Parameters
    ----------
    tables : ModeTables
        Tables of two modes.
    depth : float
        Inserted length s [m].
    work : ndarray, shape (34,) or longer
        Scratch.
    out : ModeIntegrals
        Overwritten.

    """
    table = tables.series
    xi = depth / tables.length
    square = xi * xi
    z = square * square
    last = int(tables.terms[int(xi * TERMS_PER_LENGTH)]) - 1
    for j in range(34):
        work[j] = table[last, j]
    for m in range(last - 1, -1, -1):
        for j in range(34):
            work[j] = work[j] * z + table[m, j]
    pair = 0
    for i in range(2):
        for j in range(i, 2):
            g, h = 3 * pair, 9 + 3 * pair
            gram = z * xi * (work[g] + xi * work[g + 1] + square * work[g + 2])
            curved = xi * (work[h] + xi * work[h + 1] + square * work[h + 2])
            out.gram[i, j] = out.gram[j, i] = gram
            out.curvature_gram[i, j] = out.curvature_gram[j, i] = curved
            pair += 1
    for i in range(2):
        j = 18 + 2 * i
        out.value[i] = square * (work[j] + xi * work[j + 1])
        out.curvature[i] = work[j + 4] + xi * work[j + 5]
        out.area[i] = square * xi * (work[j + 8] + xi * work[j + 9])
        out.moment[i] = z * (work[j + 12] + xi * work[j + 13])


@compiled
def many_modes(tables: ModeTables, depth: float, work: FloatArray, out: ModeIntegrals) -> None:
    """
    Evaluate any number of modes.

    Pairs of modes with small arguments come from the series, which does not cancel there, the
    others from the boundary values of the antiderivatives: the fourth derivative of a mode is
    k^4 times the mode.

    Parameters
    ----------
    tables : ModeTables
        Tables of n modes.
    depth : float
        Inserted length s [m].
    work : ndarray, shape (columns + 4 n,) or longer
        Scratch.
    out : ModeIntegrals
        Overwritten.

    """
    length, modes, table = tables.length, tables.modes, tables.series
    n = modes.shape[1]
    pairs = n * (n + 1) // 2
    columns = table.shape[1]
    xi = depth / length
    square = xi * xi
    z = square * square
    last = table.shape[0] - 1
    for j in range(columns):
        work[j] = table[last, j]
    for m in range(last - 1, -1, -1):
        for j in range(columns):
            work[j] = work[j] * z + table[m, j]
    s = xi * length
    for i in range(n):
        end, ratio, rest, scale = modes[0, i], modes[1, i], modes[2, i], modes[3, i]
        k = end / length
        p0, p1, p2, p3 = mode_derivatives(end * xi, ratio, rest, end)
        d = columns + 4 * i
        work[d] = scale * p0
        work[d + 1] = scale * k * p1
        work[d + 2] = scale * k * k * p2
        work[d + 3] = scale * k * k * k * p3
        j = 6 * pairs + 2 * i
        if end * xi < SERIES_END:
            out.value[i] = square * (work[j] + xi * work[j + 1])
            out.curvature[i] = work[j + 2 * n] + xi * work[j + 2 * n + 1]
            out.area[i] = square * xi * (work[j + 4 * n] + xi * work[j + 4 * n + 1])
            out.moment[i] = z * (work[j + 6 * n] + xi * work[j + 6 * n + 1])
        else:
            k4 = k * k * k * k
            # At the clamped end the second derivative is 2 c mu k^2 and the third -2 c k^3.
            out.value[i] = work[d]
            out.curvature[i] = work[d + 2]
            out.area[i] = (work[d + 3] + 2.0 * scale * k * k * k) / k4
            out.moment[i] = (s * work[d + 3] - work[d + 2] + 2.0 * ratio * scale * k * k) / k4
    pair = 0
    for i in range(n):
        a0, a1 = work[columns + 4 * i], work[columns + 4 * i + 1]
        a2, a3 = work[columns + 4 * i + 2], work[columns + 4 * i + 3]
        ki4 = (modes[0, i] / length) ** 4
        for j in range(i, n):
            if modes[0, j] * xi < SERIES_END:
                g, h = 3 * pair, 3 * (pairs + pair)
                gram = z * xi * (work[g] + xi * work[g + 1] + square * work[g + 2])
                curved = xi * (work[h] + xi * work[h + 1] + square * work[h + 2])
            else:
                b0, b1 = work[columns + 4 * j], work[columns + 4 * j + 1]
                b2, b3 = work[columns + 4 * j + 2], work[columns + 4 * j + 3]
                if i == j:
                    whole = s * (ki4 * a0 * a0 + a2 * a2 - 2.0 * a1 * a3)
                    gram = (whole - a1 * a2 + 3.0 * a0 * a3) / (4.0 * ki4)
                else:
                    kj4 = (modes[0, j] / length) ** 4
                    gram = (a3 * b0 - a2 * b1 + a1 * b2 - a0 * b3) / (ki4 - kj4)
                curved = a2 * b1 - a3 * b0 + ki4 * gram
            out.gram[i, j] = out.gram[j, i] = gram
            out.curvature_gram[i, j] = out.curvature_gram[j, i] = curved
            pair += 1


@inlined_kernel
def mode_integrals(tables: ModeTables, depth: float, work: Vector, out: ModeIntegrals) -> None:
    """
    Evaluate the modes and their integrals at an inserted length.

    Parameters
    ----------
    tables : ModeTables
        Tables of n modes.
    depth : float
        Inserted length s [m], in the range of the tables.
    work : ndarray, shape (columns + 4 n,)
        Scratch.
    out : ModeIntegrals
        Overwritten.

    """
    if tables.modes.shape[1] == 2:
        two_modes(tables, depth, work, out)
    else:
        many_modes(tables, depth, work, out)


@kernel
def tip_deflections(tables: ModeTables, states: Matrix) -> FloatArray:
    """
    Return the deflection of the tip w(s) = phi(s) q for many states.

    Parameters
    ----------
    tables : ModeTables
        Tables of n modes.
    states : ndarray, shape (k, 2 (2 + n))
        States with inserted lengths in the range of the tables, or NaN.

    Returns
    -------
    ndarray, shape (k,)
        Deflections [m]; NaN where the state is NaN.

    """
    n = tables.modes.shape[1]
    grids, rows = np.empty((2, n, n)), np.empty((4, n))
    at = ModeIntegrals(grids[0], grids[1], rows[0], rows[1], rows[2], rows[3])
    work, found = np.empty(tables.series.shape[1] + 4 * n), np.empty(states.shape[0])
    for k in range(states.shape[0]):
        depth = tables.length - states[k, 0]
        found[k] = nan
        if isfinite(depth):
            mode_integrals(tables, depth, work, at)
            found[k] = 0.0
            for i in range(n):
                found[k] += at.value[i] * states[k, 2 + i]
    return found
