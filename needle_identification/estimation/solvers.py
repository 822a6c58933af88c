r"""
The four estimators of a linear regression, as weighted normal equations.

With the regressors :math:`x_i` of sample i and its response :math:`y_i`, they solve

.. math:: \sum_i w_i \, x_i (y_i - x_i^T \beta) + n \Sigma \beta = 0

=============  ====================================================================================
``ordinary``   w = 1
``weighted``   w = 1 / (noise variance measured in the group of the sample), the matrix W of
               section 3.2.2.1 of [Boroomand2014]_
``huber``      w falls with the size of the residual [Huber1981]_
``total``      Sigma is the covariance of the noise of the regressors, which ordinary least squares
               takes for signal. This is total least squares with exact and noisy columns and free
               noise of the response; it has a closed solution [VanHuffel1991]_.
=============  ====================================================================================

References
----------
.. [Boroomand2014] A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling
   and controllability analysis of a flexible needle in soft tissue", 2014, section 3.2.2.1.
.. [Huber1981] P. J. Huber, "Robust Statistics", Wiley, 1981.
.. [VanHuffel1991] S. Van Huffel, J. Vandewalle, "The Total Least Squares Problem", SIAM, 1991.

"""

from __future__ import annotations

from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.errors import IdentificationError
from needle_ros.errors import ParameterError
import numpy as np

#: Relative change of a solution, or size of a residual, that counts as rounding.
ROUNDING: Final = 1e-9

#: Weight of the noise of all groups in the variance of each group [correlation windows].
_PRIOR: Final = 5.0

#: Residual beyond which Huber's weight falls [standard deviations]. It makes the estimator 95 %
#: efficient for normal noise.
_HUBER_LIMIT: Final = 1.345

#: Standard deviation of normal noise over its median absolute deviation.
_DEVIATION_OVER_MEDIAN: Final = 1.4826

_MAX_ITERATIONS: Final = 100


class Solution(NamedTuple):
    """
    Solution of weighted normal equations with k parameters and n samples.

    Attributes
    ----------
    values : ndarray, shape (k,)
        Parameters.
    inverse : ndarray, shape (k, k)
        Inverse of the normal matrix.
    influence : ndarray, shape (n, k)
        Change of the normal equations with the response of each sample.
    scores : ndarray, shape (n, k)
        Share of each sample in the normal equations; they sum to zero.

    """

    values: FloatArray
    inverse: FloatArray
    influence: FloatArray
    scores: FloatArray


def weighted(x: FloatArray, y: FloatArray, weights: FloatArray) -> Solution:
    """
    Solve weighted least squares.

    Parameters
    ----------
    x : ndarray, shape (n, k)
        Regressors.
    y, weights : ndarray, shape (n,)
        Response, and weight of each sample.

    Returns
    -------
    Solution
        The solution.

    """
    root = np.sqrt(weights)[:, np.newaxis]
    values: FloatArray = np.asarray(np.linalg.lstsq(root * x, root[:, 0] * y, rcond=None)[0])
    influence = weights[:, np.newaxis] * x
    inverse = np.asarray(np.linalg.inv(x.T @ influence))
    return Solution(values, inverse, influence, influence * (y - x @ values)[:, np.newaxis])


def group_weights(
    x: FloatArray, y: FloatArray, used: BoolArray, groups: IntArray | None, span: float
) -> FloatArray:
    """
    Weigh each sample by the noise measured in its group.

    The variance of a group is taken about its own mean, so that a misfit of the model does not
    count as noise. A few correlation windows of the noise of all groups are added to each group,
    because a group of few samples may look less noisy than it is.

    Parameters
    ----------
    x : ndarray, shape (n, k)
        Regressors.
    y : ndarray, shape (n,)
        Response.
    used : ndarray of bool, shape (n,)
        Samples to use.
    groups : ndarray of int, shape (n,), or None
        Group of each sample.
    span : float
        Number of samples that count as one independent sample.

    Returns
    -------
    ndarray, shape (n,)
        Noise variance of all samples over that of the group; zero where not used.

    Raises
    ------
    ParameterError
        If the group of each sample is missing.

    """
    if groups is None or np.shape(groups) != y.shape:
        raise ParameterError('weighted needs the group of each sample')
    residual = y - x @ weighted(x, y, used.astype(np.float64)).values
    members = np.unique(np.asarray(groups)[used], return_inverse=True)[1]
    count = np.bincount(members)
    left = residual[used]
    left = left - (np.bincount(members, left) / count)[members]
    pooled = float(left @ left) / len(left)
    weights = used.astype(np.float64)
    if pooled > 0.0:
        variance = (np.bincount(members, left**2) + _PRIOR * span * pooled) / (
            count + _PRIOR * span
        )
        weights[used] = pooled / variance[members]
    return weights


def huber(x: FloatArray, y: FloatArray, used: BoolArray) -> Solution:
    """
    Solve by iterated weights; the scale is the median absolute residual of each iteration.

    Parameters
    ----------
    x : ndarray, shape (n, k)
        Regressors.
    y : ndarray, shape (n,)
        Response.
    used : ndarray of bool, shape (n,)
        Samples to use.

    Returns
    -------
    Solution
        The solution. Only samples within the limit have influence.

    """
    weights = used.astype(np.float64)
    values = weighted(x, y, weights).values
    smallest = ROUNDING * float(np.sqrt(np.mean(y[used] ** 2)))
    limit = np.inf
    for _ in range(_MAX_ITERATIONS):
        size = np.abs(y - x @ values)
        limit = _HUBER_LIMIT * max(_DEVIATION_OVER_MEDIAN * float(np.median(size[used])), smallest)
        weights = np.where(size > limit, limit / np.maximum(size, limit), 1.0) * used
        last, values = values, weighted(x, y, weights).values
        if np.linalg.norm(values - last) <= ROUNDING * np.linalg.norm(values):
            break
    residual = y - x @ values
    within = (used & (np.abs(residual) <= limit)).astype(np.float64)
    influence = within[:, np.newaxis] * x
    inverse = np.asarray(np.linalg.pinv(x.T @ influence))
    scores = x * np.clip(residual, -limit, limit)[:, np.newaxis]
    return Solution(values, inverse, influence, scores)


def total(x: FloatArray, y: FloatArray, used: BoolArray, noise: FloatArray) -> Solution:
    """
    Solve without the part of the normal matrix that is noise of the regressors.

    Parameters
    ----------
    x : ndarray, shape (n, k)
        Regressors.
    y : ndarray, shape (n,)
        Response.
    used : ndarray of bool, shape (n,)
        Samples to use.
    noise : ndarray, shape (k, k)
        Covariance of the noise of the regressors of one sample.

    Returns
    -------
    Solution
        The solution.

    Raises
    ------
    IdentificationError
        If the noise exceeds the variation of the regressors.

    """
    normal = x.T @ x - np.count_nonzero(used) * noise
    if np.linalg.eigvalsh(normal)[0] <= 0.0:
        raise IdentificationError('the noise of the regressors exceeds their variation')
    values = np.asarray(np.linalg.solve(normal, x.T @ y))
    scores = x * (y - x @ values)[:, np.newaxis] + np.outer(used, noise @ values)
    return Solution(values, np.asarray(np.linalg.inv(normal)), x, np.asarray(scores))
