# SPDX-License-Identifier: Apache-2.0
"""Small dense matrices: Cholesky factor, triangular solutions, eigenvalues by Jacobi rotations."""

from math import sqrt

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled


@compiled
def copy(matrix: FloatArray, to: FloatArray) -> None:
    """Copy a matrix, shape (n, m), in loops: a slice assignment would compile an error message."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            to[i, j] = matrix[i, j]


@compiled
def cholesky(matrix: FloatArray, factor: FloatArray) -> None:
    """Write the lower Cholesky factor of a matrix (n, n), of which the upper triangle is read."""
    n = matrix.shape[0]
    for j in range(n):
        for i in range(j, n):
            value = matrix[j, i]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = sqrt(value) if i == j else value / factor[j, j]


@compiled
def forward(factor: FloatArray, x: FloatArray) -> None:
    """Replace x, shape (n,), by the solution y of L y = x."""
    for i in range(x.shape[0]):
        value = x[i]
        for k in range(i):
            value -= factor[i, k] * x[k]
        x[i] = value / factor[i, i]


@compiled
def backward(factor: FloatArray, x: FloatArray) -> None:
    """Replace x, shape (n,), by the solution y of L^T y = x."""
    for i in range(x.shape[0] - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, x.shape[0]):
            value -= factor[k, i] * x[k]
        x[i] = value / factor[i, i]


@compiled
def diagonalize(matrix: FloatArray, vectors: FloatArray) -> None:
    """Overwrite a positive definite matrix with its ascending eigenvalues; fill the vectors."""
    # Jacobi rotations keep the relative accuracy of small eigenvalues.
    n = matrix.shape[0]
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        largest = 0.0
        for i in range(n):
            for j in range(i + 1, n):
                scale = sqrt(matrix[i, i] * matrix[j, j])
                coupled = abs(matrix[i, j]) / scale
                largest = max(largest, coupled)
                if coupled > 1e-17:
                    _rotate(matrix, vectors, i, j)
        if largest <= 1e-16:
            break
    _sort(matrix, vectors)


@compiled
def _sort(matrix: FloatArray, vectors: FloatArray) -> None:
    """Sort the diagonal and the columns of the vectors in ascending order."""
    n = matrix.shape[0]
    for i in range(n):
        least = i
        for k in range(i + 1, n):
            if matrix[k, k] < matrix[least, least]:
                least = k
        if least != i:
            matrix[i, i], matrix[least, least] = matrix[least, least], matrix[i, i]
            for k in range(n):
                vectors[k, i], vectors[k, least] = vectors[k, least], vectors[k, i]


@compiled
def _rotate(matrix: FloatArray, vectors: FloatArray, i: int, j: int) -> None:
    """Zero the entry (i, j) of a symmetric matrix by a rotation, and rotate the vectors."""
    n = matrix.shape[0]
    tau = (matrix[j, j] - matrix[i, i]) / (2.0 * matrix[i, j])
    t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + sqrt(1.0 + tau * tau))
    cosine = 1.0 / sqrt(1.0 + t * t)
    sine = t * cosine
    for k in range(n):
        x, y = matrix[k, i], matrix[k, j]
        matrix[k, i], matrix[k, j] = cosine * x - sine * y, sine * x + cosine * y
    for k in range(n):
        x, y = matrix[i, k], matrix[j, k]
        matrix[i, k], matrix[j, k] = cosine * x - sine * y, sine * x + cosine * y
    for k in range(n):
        x, y = vectors[k, i], vectors[k, j]
        vectors[k, i], vectors[k, j] = cosine * x - sine * y, sine * x + cosine * y
