r"""
Whether the tissue is a spring, section 3.2.2.3 of [Boroomand2014]_.

The force of the tissue is -K d. It is that of a spring where its curl

.. math:: \frac{\partial F_x}{\partial z} - \frac{\partial F_z}{\partial x} = k_{zx} - k_{xz}

is zero, that is, where K is symmetric. The measure used here has no unit: the Frobenius norm of
the antisymmetric part of K over that of its symmetric part. The largest value that still counts
as a spring is `StiffnessSettings.largest_asymmetry`.

References
----------
.. [Boroomand2014] A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling
   and controllability analysis of a flexible needle in soft tissue", 2014, section 3.2.2.3.

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


def curl_estimate(fit: MatrixFit) -> ParameterEstimate:
    """
    Return the curl of the force of the tissue.

    Parameters
    ----------
    fit : MatrixFit
        Stiffness matrix with errors.

    Returns
    -------
    ParameterEstimate
        k_zx - k_xz [N/m].

    """
    return fit.derived('curl', 'curl F', 'N/m', float(fit.matrix[1, 0] - fit.matrix[0, 1]), _CURL)


def asymmetry_estimate(fit: MatrixFit) -> ParameterEstimate:
    """
    Return the asymmetry of a stiffness matrix with its errors.

    Parameters
    ----------
    fit : MatrixFit
        Stiffness matrix with errors.

    Returns
    -------
    ParameterEstimate
        ``|K_a| / |K_s|`` [1], which is ``|curl| / (sqrt(2) |K_s|)``.

    """
    curl = float(fit.matrix[1, 0] - fit.matrix[0, 1])
    symmetric = (fit.matrix + fit.matrix.T) / 2.0
    size = sqrt(2.0) * float(np.linalg.norm(symmetric)) or nan
    gradient = (_CURL - 2.0 * curl / size**2 * symmetric) / size
    signed = fit.derived('spring', '|K_a|/|K_s|', '1', curl / size, gradient)
    if not signed.determined:
        return signed
    _, freedom = fit.variance_of(gradient)
    value = abs(signed.value)
    return replace(signed, value=value, interval=_unsigned_interval(value, signed.error, freedom))


def _unsigned_interval(value: float, error: float, freedom: float) -> tuple[float, float]:
    """
    Return the 95 % interval of the size of a quantity with an arbitrary sign.

    The interval holds each size for which the measured value is within the nearest 95 % of the
    values that may be measured. Zero is among them where it is in the interval of Student's t of
    the signed quantity.
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


def judge_spring(
    spring: ParameterEstimate, curl: ParameterEstimate, limit: float
) -> tuple[bool, str]:
    """
    Judge by its asymmetry whether a tissue is a spring.

    Parameters
    ----------
    spring : ParameterEstimate
        Asymmetry of its stiffness matrix [1].
    curl : ParameterEstimate
        Curl of its force [N/m].
    limit : float
        Largest asymmetry of a spring [1].

    Returns
    -------
    is_spring : bool
        Whether the whole interval of the asymmetry is within the limit.
    words : str
        The result in words: a spring, not a spring, or undecided.

    """
    if not spring.determined:
        return False, 'undetermined: the presses do not determine the whole matrix'
    low, high = spring.interval
    figure = (
        f'antisymmetric part {spring.value:.2%} of the symmetric, 95 % interval '
        f'{low:.2%} to {high:.2%}, limit {limit:.0%}; curl '
        + ('zero within its error' if low == 0.0 else f'{curl.value:.3g} N/m')
    )
    if high <= limit:
        return True, f'a spring: {figure}'
    return False, f'{"not a spring" if low > limit else "undecided"}: {figure}'
