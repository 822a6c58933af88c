# SPDX-License-Identifier: Apache-2.0
"""
Shape modes at the tip and their integrals over the inserted part.

Where the arguments k_i s are small, the closed forms of the integrals lose all digits by
cancellation; power series in s, stored side by side in `ModeTables.series`, do not. The arguments
of two modes are small enough at any s, so that a single Horner pass evaluates all series.
"""

from math import cos, exp, isfinite, nan, sin
from typing import Final, NamedTuple

from needle_dynamics.arrays import FixedMatrix, FixedVector, FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import compiled, inlined, inlined_kernel, kernel
import numpy as np

#: Below this argument k_i s the series of a mode is used, above it the closed form.
SERIES_END: Final = 2.0

TERMS_PER_LENGTH: Final = 32  #: resolution of `ModeTables.terms` in the relative insertion depth


class ModeTables(NamedTuple):
    """Tables for the evaluation of n modes, from `needle_dynamics.modes.ModeShapes.tables`."""

    length: float  #: needle length l [m]
    #: Coefficients in powers of (s/l)^4. Columns: G and H of each pair i <= j (three powers of s/l
    #: each), then phi, phi'' and the integrals of phi and y phi of each mode (two powers each),
    #: shape (terms, columns).
    series: FixedMatrix
    #: Number of series terms for two modes, by relative insertion depth in steps of 1 /
    #: `TERMS_PER_LENGTH`, shape (l / s steps,).
    terms: FixedVector
    modes: FixedMatrix  #: rows k_i l, mu_i, (mu_i - 1) exp(k_i l) and c_i of (11), shape (4, n)


class ModeIntegrals(NamedTuple):
    """The modes at the tip and their integrals over the inserted part 0 <= y <= s."""

    gram: Matrix  #: G(s), the integral of phi phi^T [1], shape (n, n)
    curvature_gram: Matrix  #: H(s), the integral of phi'' phi''^T [m^-4], shape (n, n)
    value: Vector  #: phi(s) [m^-1/2], shape (n,)
    curvature: Vector  #: phi''(s) [m^-5/2], shape (n,)
    area: Vector  #: integral of phi [m^1/2], shape (n,)
    moment: Vector  #: integral of y phi [m^3/2], shape (n,)


@compiled
def mode_derivatives(
    x: float, ratio: float, rest: float, end: float
) -> tuple[float, float, float, float]:
    """Return phi and its first three derivatives at x = k_i y, divided by c_i k_i^order."""
    # ``ratio`` is mu_i and ``end`` k_i l; ``rest``, (mu_i - 1) exp(k_i l), is what remains of
    # growing exponentials of (11) that nearly cancel.
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
    """Evaluate the series of two modes; see `mode_integrals`."""
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
    """Evaluate any number of modes; see `mode_integrals`."""
    # Pairs of modes use the series where boundary values of the antiderivatives would cancel.
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
    """Evaluate modes and integrals at a depth [m]; ``work`` (columns + 4 n,) is scratch memory."""
    if tables.modes.shape[1] == 2:
        two_modes(tables, depth, work, out)
    else:
        many_modes(tables, depth, work, out)


@kernel
def tip_deflections(tables: ModeTables, states: Matrix) -> FloatArray:
    """Return tip deflections w(s) [m], shape (k,), of states (k, 2 (2 + n)); NaN for NaN."""
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
