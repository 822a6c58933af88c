# SPDX-License-Identifier: Apache-2.0
"""
Three and four modes in lanes, as `modal_flow.rotate_many`.

Values and integrals of the modes are polynomials in pieces of the relative depth; the normal modes
come from a fixed number of Jacobi rotations. A lane therefore does not depend on the others.
Loops over lanes are functions of rows, which the compiler vectorizes, and compiles once.
"""

from math import sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled
from needle_dynamics.compiled.lane_functions import lane_decay_means, lane_sine_cosine
from needle_dynamics.compiled.lane_rows import (
    ABOVE,
    BENDING,
    DAMPING,
    DENSITY,
    DEPTH,
    H,
    IMPULSE,
    INSIDE,
    LaneModes,
    LANES,
    LENGTH,
    NEW_Q1,
    NEW_Z1,
    Q1,
    SERIES,
    TIP,
    TISSUE,
    XI,
    XI4,
    Z1,
)
from needle_dynamics.compiled.matrices import backward, cholesky, forward
import numpy as np

MANY: Final = 4  #: largest number of modes
PIECES: Final = 32  #: pieces of relative depth per length
TERMS: Final = 11  #: coefficients of a piece, the highest power first

_PAIRS: Final = MANY * (MANY + 1) // 2

# Rows: values of the table; matrices of the modes, row by row: factor of the mass, stiffness in
# the coordinates in which the mass is the identity, and its eigenvectors as columns; vectors of
# the modes: deflections, rates, values and curvatures at the tip, the same for normal modes, and
# their deflections and rates at the end. Then factor of half a step of damping, intermediate
# results, and constants of the impulse.
_AT = SERIES // LANES
_FACTOR, _STIFFNESS, _VECTORS = (
    _AT + 2 * (_PAIRS + MANY) + k * MANY * MANY for k in range(3)
)  # fmt: skip
_Y, _V, _TIP, _BENT, _NORMAL_Y, _NORMAL_V, _NORMAL_TIP, _NORMAL_BENT, _END_Y, _END_V, _REST = (
    _VECTORS + MANY * MANY + k * MANY for k in range(11)
)
_DECAY, _COSINE, _SINE, _ONE, _TWO, _EI, _KA, _RHO = range(_REST, _REST + 8)
MANY_ROWS: Final = _REST + 8

#: Jacobi rotations of each pair.
_SWEEPS: Final = 5


@compiled
def _evaluate(r: FloatArray, first: int, end: int, table: FloatArray) -> None:
    """Evaluate the table at the relative depths of some lanes."""
    at, last = np.empty(table.shape[1]), table.shape[0] // TERMS - 1
    for i in range(first, end):
        place = r[XI // LANES, i] * PIECES
        piece = min(int(place), last)
        x, top = 2.0 * (place - piece) - 1.0, piece * TERMS
        for j in range(at.shape[0]):
            at[j] = table[top, j]
        for m in range(top + 1, top + TERMS):
            row = table[m]
            for j in range(at.shape[0]):
                at[j] = at[j] * x + row[j]
        for j in range(at.shape[0]):
            r[_AT + j, i] = at[j]


@compiled
def _clear(n: int, out: FloatArray) -> None:
    for i in range(n):
        out[i] = 0.0


@compiled
def _add(n: int, out: FloatArray, x: FloatArray, y: FloatArray) -> None:
    for i in range(n):
        out[i] += x[i] * y[i]


@compiled
def _subtract(n: int, out: FloatArray, x: FloatArray, y: FloatArray) -> None:
    for i in range(n):
        out[i] -= x[i] * y[i]


@compiled
def _divide(n: int, out: FloatArray, x: FloatArray) -> None:
    for i in range(n):
        out[i] /= x[i]


@compiled
def _root(n: int, out: FloatArray) -> None:
    for i in range(n):
        out[i] = sqrt(out[i])


@compiled
def _masses(n: int, out: FloatArray, r: FloatArray, pair: int) -> None:
    density, xi4, xi, gram = r[DENSITY // LANES], r[XI4 // LANES], r[XI // LANES], r[_AT + pair]
    for i in range(n):
        out[i] = density[i] * xi4[i] * xi[i] * gram[i]


@compiled
def _stiffnesses(n: int, out: FloatArray, r: FloatArray, pair: int, pairs: int) -> None:
    xi4, xi, length = r[XI4 // LANES], r[XI // LANES], r[LENGTH // LANES]
    bending, tissue, above = r[BENDING // LANES], r[TISSUE // LANES], r[ABOVE // LANES + pair]
    gram, curved = r[_AT + pair], r[_AT + pairs + pair]
    for i in range(n):
        ei = bending[i] / (length[i] * length[i] * length[i] * length[i])
        out[i] = xi[i] * (ei * curved[i] + tissue[i] * xi4[i] * gram[i]) + above[i]


@compiled
def _solve(n: int, r: FloatArray, m: int, x: int, stride: int) -> None:
    """Replace a vector x of m rows by the solution y of L y = x."""
    for p in range(m):
        for k in range(p):
            _subtract(n, r[x + p * stride], r[_FACTOR + MANY * p + k], r[x + k * stride])
        _divide(n, r[x + p * stride], r[_FACTOR + (MANY + 1) * p])


@compiled
def _solve_back(n: int, r: FloatArray, m: int, x: int) -> None:
    """Replace a vector x of m rows by the solution y of L^T y = x."""
    for p in range(m - 1, -1, -1):
        for k in range(p + 1, m):
            _subtract(n, r[x + p], r[_FACTOR + MANY * k + p], r[x + k])
        _divide(n, r[x + p], r[_FACTOR + (MANY + 1) * p])


@compiled
def _multiply(n: int, r: FloatArray, m: int, matrix: int, x: int, y: int, turned: bool) -> None:
    """Compute y = A x, or A^T x."""
    for p in range(m):
        _clear(n, r[y + p])
        for k in range(m):
            _add(n, r[y + p], r[matrix + (MANY * k + p if turned else MANY * p + k)], r[x + k])


@compiled
def _factor(n: int, r: FloatArray, m: int) -> None:
    """Compute the factor L of the mass rho G = L L^T."""
    pair = 0
    for p in range(m):
        for q in range(p, m):
            _masses(n, r[_FACTOR + MANY * q + p], r, pair)
            if q > p:
                _clear(n, r[_FACTOR + MANY * p + q])
            pair += 1
    for p in range(m):
        own = r[_FACTOR + (MANY + 1) * p]
        for k in range(p):
            _subtract(n, own, r[_FACTOR + MANY * p + k], r[_FACTOR + MANY * p + k])
        _root(n, own)
        for q in range(p + 1, m):
            target = r[_FACTOR + MANY * q + p]
            for k in range(p):
                _subtract(n, target, r[_FACTOR + MANY * p + k], r[_FACTOR + MANY * q + k])
            _divide(n, target, own)


@compiled
def _tangents(
    n: int, out: FloatArray, first: FloatArray, second: FloatArray, both: FloatArray
) -> None:
    """Compute the tangent of the rotation that zeroes an entry of the stiffness."""
    for i in range(n):
        off, gap = both[i], second[i] - first[i]
        root = sqrt(gap * gap + 4.0 * off * off)
        # Zero for two equal entries without coupling.
        out[i] = 2.0 * off / (gap + root + 1e-300 if gap >= 0.0 else gap - root)


@compiled
def _cosines(n: int, tangent: FloatArray, cosine: FloatArray, sine: FloatArray) -> None:
    for i in range(n):
        own = 1.0 / sqrt(1.0 + tangent[i] * tangent[i])
        cosine[i], sine[i] = own, tangent[i] * own


@compiled
def _turn(
    n: int, first: FloatArray, second: FloatArray, cosine: FloatArray, sine: FloatArray
) -> None:
    for i in range(n):
        x, y = first[i], second[i]
        first[i] = cosine[i] * x - sine[i] * y
        second[i] = sine[i] * x + cosine[i] * y


@compiled
def _entry(i: int, j: int) -> int:
    """Return the row of an entry of the stiffness, in its upper triangle."""
    return _STIFFNESS + MANY * min(i, j) + max(i, j)


@compiled
def _stiffness(n: int, r: FloatArray, m: int) -> None:
    """Compute the stiffness in the coordinates in which the mass is the identity."""
    pair, pairs = 0, m * (m + 1) // 2
    for p in range(m):
        for q in range(p, m):
            _stiffnesses(n, r[_STIFFNESS + MANY * p + q], r, pair, pairs)
            if q > p:
                _stiffnesses(n, r[_STIFFNESS + MANY * q + p], r, pair, pairs)
            pair += 1
    for p in range(m):
        _solve(n, r, m, _STIFFNESS + MANY * p, 1)
    for p in range(m):
        _solve(n, r, m, _STIFFNESS + p, MANY)


@compiled
def _diagonalize(n: int, r: FloatArray, m: int) -> None:
    """Compute squared frequencies (diagonal of the stiffness) and eigenvectors."""
    for p in range(m):
        for q in range(m):
            row = r[_VECTORS + MANY * p + q]
            for i in range(n):
                row[i] = 1.0 if p == q else 0.0
    tangent, cosine, sine = r[_ONE], r[_COSINE], r[_SINE]
    for _ in range(_SWEEPS):
        for p in range(m):
            for q in range(p + 1, m):
                first, second, both = r[_entry(p, p)], r[_entry(q, q)], r[_entry(p, q)]
                _tangents(n, tangent, first, second, both)
                _cosines(n, tangent, cosine, sine)
                _subtract(n, first, tangent, both)
                _add(n, second, tangent, both)
                _clear(n, both)
                for k in range(m):
                    if k != p and k != q:
                        _turn(n, r[_entry(k, p)], r[_entry(k, q)], cosine, sine)
                    row = _VECTORS + MANY * k
                    _turn(n, r[row + p], r[row + q], cosine, sine)


@compiled
def _decays(n: int, out: FloatArray, r: FloatArray) -> None:
    """Compute the factor of the rates in half a step of damping."""
    h, damping, density = r[H // LANES], r[DAMPING // LANES], r[DENSITY // LANES]
    for i in range(n):
        x = 0.5 * h[i] * damping[i] / density[i]
        out[i] = 1.0 - x * lane_decay_means(x)[0]


@compiled
def _sines(
    n: int, squares: FloatArray, h: FloatArray, cosine: FloatArray, sine: FloatArray
) -> None:
    """Compute cosine and sine of the angle of a mode, the latter over the frequency."""
    for i in range(n):
        omega = sqrt(squares[i])
        one, two = lane_sine_cosine(omega * h[i])
        cosine[i], sine[i] = two, one / omega


@compiled
def _scale(n: int, out: FloatArray, x: FloatArray) -> None:
    for i in range(n):
        out[i] *= x[i]


@compiled
def _crossed(
    n: int, out: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray
) -> None:
    """Compute a b - c d."""
    for i in range(n):
        out[i] = a[i] * b[i] - c[i] * d[i]


@compiled
def _squares_of(
    n: int, out: FloatArray, y: FloatArray, v: FloatArray, square: FloatArray, h: FloatArray
) -> None:
    """Compute h (v^2 + omega^2 y^2)."""
    for i in range(n):
        out[i] = h[i] * (v[i] * v[i] + square[i] * y[i] * y[i])


@compiled
def _own_integrals(
    n: int, twice: FloatArray, change: FloatArray, square: FloatArray, aa: FloatArray
) -> None:
    """Compute the integrals of a^2, and of b^2 in place of ``change``."""
    for i in range(n):
        aa[i] = 0.5 * (twice[i] - change[i]) / square[i]
    for i in range(n):
        change[i] = 0.5 * (twice[i] + change[i])


@compiled
def _mixed_integral(
    n: int, out: FloatArray, one: FloatArray, two: FloatArray, p: FloatArray, q: FloatArray
) -> None:
    for i in range(n):
        out[i] = 2.0 * (one[i] - two[i]) / (p[i] - q[i])


@compiled
def _mixed_rates(n: int, one: FloatArray, two: FloatArray, p: FloatArray, q: FloatArray) -> None:
    """Compute the integral of the product of two rates, in place of ``one``."""
    for i in range(n):
        one[i] = 2.0 * (p[i] * one[i] - q[i] * two[i]) / (p[i] - q[i])


@compiled
def _loads(n: int, r: FloatArray) -> None:
    """Clear the impulse, and compute constants over 2 l of its parts."""
    length, bending, tissue = r[LENGTH // LANES], r[BENDING // LANES], r[TISSUE // LANES]
    density, out = r[DENSITY // LANES], r[_EI]
    for i in range(n):
        length2 = length[i] * length[i]
        out[i] = 0.5 * bending[i] / (length2 * length2 * length[i])
    out = r[_KA]
    for i in range(n):
        out[i] = 0.5 * tissue[i] / length[i]
    out = r[_RHO]
    for i in range(n):
        out[i] = -0.5 * density[i] / length[i]
    _clear(n, r[IMPULSE // LANES])


@compiled
def _add_product(
    n: int, out: FloatArray, a: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray
) -> None:
    for i in range(n):
        out[i] += a[i] * x[i] * y[i] * z[i]


@compiled
def _impulse(n: int, r: FloatArray, m: int) -> None:
    """Compute the impulse of the modes on the axis, as `modal_flow.rotate_many`."""
    _loads(n, r)
    impulse, one, two, aa = r[IMPULSE // LANES], r[_ONE], r[_TWO], r[_COSINE]
    for p in range(m):
        own, tip, bent = r[_entry(p, p)], r[_NORMAL_TIP + p], r[_NORMAL_BENT + p]
        y, v, end_y, end_v = r[_NORMAL_Y + p], r[_NORMAL_V + p], r[_END_Y + p], r[_END_V + p]
        for q in range(p, m):
            other, other_tip = r[_entry(q, q)], r[_NORMAL_TIP + q]
            # Changes of products of deflection and rate over the step.
            _crossed(n, one, end_y, r[_END_V + q], y, r[_NORMAL_V + q])
            if p == q:
                _squares_of(n, two, y, v, own, r[H // LANES])
                _own_integrals(n, two, one, own, aa)
            else:
                _crossed(n, two, r[_END_Y + q], end_v, r[_NORMAL_Y + q], v)
                _mixed_integral(n, aa, one, two, own, other)
                _mixed_rates(n, one, two, own, other)
            _add_product(n, impulse, r[_EI], aa, bent, r[_NORMAL_BENT + q])
            _add_product(n, impulse, r[_KA], aa, tip, other_tip)
            _add_product(n, impulse, r[_RHO], one, tip, other_tip)


@compiled
def _start(n: int, r: FloatArray, m: int) -> None:
    """Copy rates, values and curvatures at the tip."""
    xi = r[XI // LANES]
    values = _AT + m * (m + 1)
    for p in range(m):
        momentum, value, curvature = r[Z1 // LANES + p], r[values + p], r[values + m + p]
        rate, tip, bent = r[_V + p], r[_TIP + p], r[_BENT + p]
        for i in range(n):
            rate[i] = momentum[i]
        for i in range(n):
            tip[i] = xi[i] * xi[i] * value[i]
        for i in range(n):
            bent[i] = curvature[i]


@compiled
def rotate_many_lanes(w: FloatArray, n: int, modes: LaneModes) -> None:
    """Advance the deflections through the step of each lane."""
    r, m, table = w.reshape(-1, LANES), modes.number, modes.table
    _evaluate(r, 0, n, table)
    _factor(n, r, m)
    _stiffness(n, r, m)
    _diagonalize(n, r, m)
    _multiply(n, r, m, _FACTOR, Q1 // LANES, _Y, True)
    _start(n, r, m)
    for vector in (_V, _TIP, _BENT):
        _solve(n, r, m, vector, 1)
    for k in range(4):
        _multiply(n, r, m, _VECTORS, _Y + MANY * k, _NORMAL_Y + MANY * k, True)
    decay, cosine, sine, h = r[_DECAY], r[_COSINE], r[_SINE], r[H // LANES]
    _decays(n, decay, r)
    for p in range(m):
        y, v, squares = r[_NORMAL_Y + p], r[_NORMAL_V + p], r[_entry(p, p)]
        _scale(n, v, decay)
        _sines(n, squares, h, cosine, sine)
        _clear(n, r[_END_Y + p])
        _add(n, r[_END_Y + p], y, cosine)
        _add(n, r[_END_Y + p], v, sine)
        _scale(n, sine, squares)
        _crossed(n, r[_END_V + p], v, cosine, y, sine)
    _impulse(n, r, m)
    for p in range(m):
        _scale(n, r[_END_V + p], decay)
    _multiply(n, r, m, _VECTORS, _END_Y, NEW_Q1 // LANES, False)
    _solve_back(n, r, m, NEW_Q1 // LANES)
    _multiply(n, r, m, _VECTORS, _END_V, _V, False)
    _multiply(n, r, m, _FACTOR, _V, NEW_Z1 // LANES, False)


@compiled
def end_many_lanes(w: FloatArray, n: int, m: int) -> None:
    """End the step of the modes after the second, as `lanes._end`."""
    for row in range(2 * LANES, m * LANES, LANES):
        for i in range(n):
            if w[INSIDE + i] != 0.0:
                w[Q1 + row + i], w[Z1 + row + i] = w[NEW_Q1 + row + i], w[NEW_Z1 + row + i]


@compiled
def tip_many_lanes(w: FloatArray, n: int, m: int, table: FloatArray) -> None:
    """Compute the tip deflection of each lane at the relative depth of its row."""
    r = w.reshape(-1, LANES)
    _evaluate(r, 0, n, table)
    for i in range(n):
        xi, tip = w[XI + i], 0.0
        for p in range(m):
            tip += r[_AT + m * (m + 1) + p, i] * w[Q1 + p * LANES + i]
        w[TIP + i] = xi * xi * tip / sqrt(w[LENGTH + i])


@compiled
def _mass(w: FloatArray, i: int, m: int, table: FloatArray) -> FloatArray:
    """Compute the mass rho G (m, m) of a lane at its depth."""
    r, mass, pair = w.reshape(-1, LANES), np.empty((m, m)), 0
    w[XI + i] = xi = w[DEPTH + i] / w[LENGTH + i]
    _evaluate(r, i, i + 1, table)
    for p in range(m):
        for q in range(p, m):
            gram = xi * xi * xi * xi * xi * r[_AT + pair, i]
            mass[p, q] = mass[q, p] = w[DENSITY + i] * gram
            pair += 1
    return mass


@compiled
def load_many_lane(w: FloatArray, i: int, table: FloatArray, rates: FloatArray) -> None:
    """Compute the momenta of a lane from the rates (m,) of its modes."""
    m = rates.shape[0]
    mass = _mass(w, i, m, table)
    for p in range(m):
        w[Z1 + p * LANES + i] = 0.0
        for q in range(m):
            w[Z1 + p * LANES + i] += mass[p, q] * rates[q]


@compiled
def save_many_lane(w: FloatArray, i: int, table: FloatArray, rates: FloatArray) -> None:
    """Compute the rates (m,) of the modes of a lane from its momenta."""
    m = rates.shape[0]
    mass = _mass(w, i, m, table)
    cholesky(mass, mass)
    for p in range(m):
        rates[p] = w[Z1 + p * LANES + i]
    forward(mass, rates)
    backward(mass, rates)
