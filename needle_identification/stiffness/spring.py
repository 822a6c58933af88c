r"""
Whether the tissue is a spring, section 3.2.2.3 of the paper.

The force of the tissue is -K d. It is that of a spring where its curl

.. math:: \frac{\partial F_x}{\partial z} - \frac{\partial F_z}{\partial x} = k_{zx} - k_{xz}

is zero, that is, where K is symmetric. The measure used here has no unit: the Frobenius norm of
the antisymmetric part of K over that of its symmetric part. The largest value that still counts
as a spring is `StiffnessSettings.largest_asymmetry`.
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
    Compare the antisymmetric part of a stiffness matrix with its symmetric part.

    Parameters
    ----------
    matrix : array_like, shape (2, 2)
        Stiffness matrix [N/m].

    Returns
    -------
    float
        Frobenius norm of the antisymmetric part over that of the symmetric part [1]; nan if the
        symmetric part is zero.

    """
    k = np.asarray(matrix, dtype=np.float64)
    symmetric = float(np.linalg.norm(k + k.T))
    return float(np.linalg.norm(k - k.T)) / symmetric if symmetric else nan


def spring_estimates(
    fit: MatrixFit, limit: float
) -> tuple[ParameterEstimate, ParameterEstimate, bool, str]:
    """
    Judge whether the tissue is a spring.

    Parameters
    ----------
    fit : MatrixFit
        Stiffness matrix with errors.
    limit : float
        Largest asymmetry of a spring [1].

    Returns
    -------
    curl : ParameterEstimate
        Curl of the force of the tissue, k_zx - k_xz [N/m].
    spring : ParameterEstimate
        Asymmetry of the matrix [1], which is ``|curl| / (sqrt(2) |K_s|)``.
    is_spring : bool
        Whether the whole interval of the asymmetry is within the limit.
    words : str
        The result in words: a spring, not a spring, or undecided.

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
    Return the 95 % interval of the size of a quantity with an arbitrary sign.

    It holds each size for which the measured value is among the nearest 95 % of possible values,
    so zero where the interval of Student's t of the signed quantity holds zero.
    """
    if error <= ROUNDING * value:
        return value, value
    found = value / error
    farthest = float(stdtrit(freedom, 0.975))

    def excess(size: float) -> float:
        """Probability that a value is nearer to this size than the measured one, minus 95 %."""
        off = abs(size - found)
        near = [off, max(-off, -size), min(-size, off - 2.0 * size), -off - 2.0 * size]
        above, below, mirrored, lowest = stdtr(freedom, near)
        return float(above - below + mirrored - lowest) - 0.95

    low = brentq(excess, 0.0, found) if found > farthest else 0.0
    return low * error, brentq(excess, found, found + 1.01 * farthest) * error
