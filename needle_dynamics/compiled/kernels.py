"""Evaluation of the modes into one array, as the observer still takes it."""

from __future__ import annotations

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled
from needle_dynamics.compiled.integrals import mode_derivatives, SERIES_END, TERMS_PER_LENGTH


@compiled
def evaluate(
    xi: float, table: FloatArray, terms: FloatArray, work: FloatArray, out: FloatArray
) -> None:
    """
    Evaluate the series of two modes at the relative inserted length.

    Parameters
    ----------
    xi : float
        s / l.
    table : ndarray, shape (terms, 34)
        `ModeShapes.series`.
    terms : ndarray
        `ModeShapes.terms`: how many of them the depth needs.
    work : ndarray, shape (34,) or longer
        Scratch.
    out : ndarray, shape (14,)
        Overwritten with G (11, 12, 22), H (11, 12, 22), phi, phi'', the integral of phi and that
        of y phi, two each.

    """
    square = xi * xi
    z = square * square
    last = int(terms[int(xi * TERMS_PER_LENGTH)]) - 1
    for j in range(34):
        work[j] = table[last, j]
    for m in range(last - 1, -1, -1):
        for j in range(34):
            work[j] = work[j] * z + table[m, j]
    for pair in range(3):
        g, h = 3 * pair, 9 + 3 * pair
        out[pair] = z * xi * (work[g] + xi * work[g + 1] + square * work[g + 2])
        out[3 + pair] = xi * (work[h] + xi * work[h + 1] + square * work[h + 2])
    for i in range(2):
        j = 18 + 2 * i
        out[6 + i] = square * (work[j] + xi * work[j + 1])
        out[8 + i] = work[j + 4] + xi * work[j + 5]
        out[10 + i] = square * xi * (work[j + 8] + xi * work[j + 9])
        out[12 + i] = z * (work[j + 12] + xi * work[j + 13])


@compiled
def evaluate_many(
    xi: float,
    length: float,
    modes: FloatArray,
    table: FloatArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """
    Evaluate what `evaluate` does for any number of modes n.

    Pairs of modes with small arguments come from the series, which does not cancel there, the
    others from the boundary values of the antiderivatives: the fourth derivative of a mode is
    k^4 times the mode.

    Parameters
    ----------
    xi : float
        s / l.
    length : float
        Needle length l [m].
    modes : ndarray, shape (4, n)
        `ModeShapes.constants`.
    table : ndarray, shape (terms, columns)
        `ModeShapes.series`.
    work : ndarray, shape (columns + 4 n,)
        Scratch.
    out : ndarray, shape (n (n + 1) + 4 n,)
        Overwritten with G and H (upper triangles by rows), phi, phi'', the integral of phi and
        that of y phi.

    """
    n = modes.shape[1]
    pairs = n * (n + 1) // 2
    columns = table.shape[1]
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
        at = 2 * pairs + i
        j = 6 * pairs + 2 * i
        if end * xi < SERIES_END:
            out[at] = square * (work[j] + xi * work[j + 1])
            out[at + n] = work[j + 2 * n] + xi * work[j + 2 * n + 1]
            out[at + 2 * n] = square * xi * (work[j + 4 * n] + xi * work[j + 4 * n + 1])
            out[at + 3 * n] = z * (work[j + 6 * n] + xi * work[j + 6 * n + 1])
        else:
            k4 = k * k * k * k
            # At the clamped end the second derivative is 2 c mu k^2 and the third -2 c k^3.
            out[at] = work[d]
            out[at + n] = work[d + 2]
            out[at + 2 * n] = (work[d + 3] + 2.0 * scale * k * k * k) / k4
            out[at + 3 * n] = (s * work[d + 3] - work[d + 2] + 2.0 * ratio * scale * k * k) / k4
    pair = 0
    for i in range(n):
        a0, a1 = work[columns + 4 * i], work[columns + 4 * i + 1]
        a2, a3 = work[columns + 4 * i + 2], work[columns + 4 * i + 3]
        ki4 = (modes[0, i] / length) ** 4
        for j in range(i, n):
            if modes[0, j] * xi < SERIES_END:
                g, h = 3 * pair, 3 * (pairs + pair)
                out[pair] = z * xi * (work[g] + xi * work[g + 1] + square * work[g + 2])
                out[pairs + pair] = xi * (work[h] + xi * work[h + 1] + square * work[h + 2])
            else:
                b0, b1 = work[columns + 4 * j], work[columns + 4 * j + 1]
                b2, b3 = work[columns + 4 * j + 2], work[columns + 4 * j + 3]
                if i == j:
                    whole = s * (ki4 * a0 * a0 + a2 * a2 - 2.0 * a1 * a3)
                    out[pair] = (whole - a1 * a2 + 3.0 * a0 * a3) / (4.0 * ki4)
                else:
                    kj4 = (modes[0, j] / length) ** 4
                    out[pair] = (a3 * b0 - a2 * b1 + a1 * b2 - a0 * b3) / (ki4 - kj4)
                out[pairs + pair] = a2 * b1 - a3 * b0 + ki4 * out[pair]
            pair += 1
