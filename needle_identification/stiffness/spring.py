r"""
Test whether the tissue is a spring, section 3.2.2.3 of the paper.

The force of the tissue is -K d. The tissue is a spring if the curl

.. math:: \frac{\partial F_x}{\partial z} - \frac{\partial F_z}{\partial x} = k_{zx} - k_{xz}

is zero, that is, if K is symmetric. The dimensionless measure is the Frobenius norm of the
antisymmetric part of K over the norm of its symmetric part. Its largest value for a spring is
`StiffnessSettings.largest_asymmetry`.
"""

from __future__ import annotations

from dataclasses import replace
from math import nan, sqrt
from typing import Final

from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.stiffness.matrix import MatrixFit
from needle_identification.stiffness.plateaus import ROUNDING
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import stdtr, stdtrit

#: Gradient of the curl k_zx - k_xz with respect to the entries of K.
_CURL: Final = np.array([[0.0, -1.0], [1.0, 0.0]])


def asymmetry(matrix: ArrayLike) -> float:
    """
    Return the ratio of the antisymmetric to the symmetric part of a stiffness matrix.

    Parameters
    ----------
    matrix : array_like, shape (2, 2)
        Stiffness matrix [N/m].

    Returns
    -------
    float
        Ratio of the Frobenius norms [1]; nan if the symmetric part is zero.

    """
    k = np.asarray(matrix, dtype=np.float64)
    symmetric = float(np.linalg.norm(k + k.T))
    return float(np.linalg.norm(k - k.T)) / symmetric if symmetric else nan


def spring_estimates(
    fit: MatrixFit, limit: float
) -> tuple[ParameterEstimate, ParameterEstimate, bool, str]:
    """
    Return curl, asymmetry, whether the tissue is a spring, and the result as a sentence.

    The tissue is a spring if the whole interval of the asymmetry is within ``limit`` [1].
    """
    k = fit.matrix
    curl = fit.derived('curl', 'curl F', 'N/m', float(k[1, 0] - k[0, 1]), _CURL)
    symmetric = (k + k.T) / 2.0
    size = sqrt(2.0) * float(np.linalg.norm(symmetric)) or nan
    gradient = (_CURL - 2.0 * (k[1, 0] - k[0, 1]) / size**2 * symmetric) / size
    value = float(k[1, 0] - k[0, 1]) / size
    spring = fit.derived('spring', '|K_a|/|K_s|', '1', value, gradient)
    if not spring.determined:
        return curl, spring, False, 'undetermined: the presses do not determine the whole matrix'
    _, freedom = fit.variance_of(gradient)
    low, high = _unsigned_interval(abs(value), spring.error, freedom)
    spring = replace(spring, value=abs(value), interval=(low, high))
    is_spring = high <= limit
    verdict = 'a spring' if is_spring else 'not a spring' if low > limit else 'undecided'
    words = (
        f'{verdict}: antisymmetric part {spring.value:.2%} of the symmetric, 95 % interval '
        f'{low:.2%} to {high:.2%}, limit {limit:.0%}; curl '
        + ('zero within its error' if low == 0.0 else f'{curl.value:.3g} N/m')
    )
    return curl, spring, is_spring, words


def _unsigned_interval(value: float, error: float, freedom: float) -> tuple[float, float]:
    """
    Return the 95 % interval of the magnitude of a signed quantity.

    It contains each magnitude for which the measured value is among the nearest 95 % of values.
    """
    if error <= ROUNDING * value:
        return value, value
    found = value / error
    farthest = float(stdtrit(freedom, 0.975))

    def excess(size: float) -> float:
        """Probability that a value is nearer to this size than the measurement, minus 95 %."""
        off = abs(size - found)
        near = [off, max(-off, -size), min(-size, off - 2.0 * size), -off - 2.0 * size]
        above, below, mirrored, lowest = stdtr(freedom, near)
        return float(above - below + mirrored - lowest) - 0.95

    low = brentq(excess, 0.0, found) if found > farthest else 0.0
    return low * error, brentq(excess, found, found + 1.01 * farthest) * error
