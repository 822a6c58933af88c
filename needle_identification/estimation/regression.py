r"""
Linear regression whose errors respect autocorrelation, and which says what it cannot tell.

The estimators of section 3.2.2.1 of [Boroomand2014]_ and two beyond it solve

.. math:: \sum_i w_i \, x_i (y_i - x_i^T \beta) + n \Sigma \beta = 0

``ordinary``: w = 1; ``weighted``: the source's W, w = 1 / (noise variance measured in the group
of the sample); ``huber``: w falls with the size of the residual; ``total``: Sigma is the
covariance of the noise in the regressors, which ordinary least squares takes for signal. It is
total least squares with exact and noisy columns and the noise of the response left free, whose
solution is closed [VanHuffel1991]_.

Errors come from the sums of these scores over a window (`triangular` kernel squared), so they
hold for noise that is correlated, uneven, or both [NeweyWest1987]_.

References
----------
.. [Boroomand2014] A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling
   and controllability analysis of a flexible needle in soft tissue", 2014, section 3.2.2.1.
.. [VanHuffel1991] S. Van Huffel, J. Vandewalle, "The Total Least Squares Problem", SIAM, 1991.
.. [NeweyWest1987] W. K. Newey, K. D. West, "A simple, positive semi-definite,
   heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica 55(3), 1987.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

from needle_dynamics import (
    FloatArray,
)
from needle_identification.errors import IdentificationError
from needle_ros.errors import (
    ParameterError,
    ShapeError,
)
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d
from scipy.special import fdtrc, stdtrit

#: Estimators by name.
ESTIMATORS: Final = ('ordinary', 'weighted', 'huber', 'total')

#: Directions of the scaled regressors that answer less than 1 / this are not determined: beyond
#: it an error of the response of 1 % would move a parameter by a fifth.
LARGEST_CONDITION: Final = 20.0

#: Part of such a direction that a determined parameter may have; it stays in the error.
_LARGEST_SHARE: Final = 0.1

#: Relative size of singular values, and of parts of their directions, that are rounding.
_ROUNDING: Final = 1e-9

#: Noise of all groups that is added to that of each [windows].
_PRIOR: Final = 5.0

#: Residual from which Huber's weight falls [standard deviations]: 95 % efficient if normal.
_HUBER: Final = 1.345

#: Standard deviation of normal noise over its median absolute deviation.
_MAD: Final = 1.4826

_MOST_ITERATIONS: Final = 100

BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int_]

#: Solution, inverse of the normal matrix, what each sample pulls with, scores that sum to zero.
_Solution: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regression:
    """
    Solution of a linear regression with k parameters from n samples.

    Attributes
    ----------
    values, errors : ndarray, shape (k,)
        Parameters and their standard errors; nan and inf where not determined.
    covariance : ndarray, shape (k, k)
        Covariance; nan off the diagonal and inf on it where not determined.
    determined : ndarray of bool, shape (k,)
        Whether the regressors tell the parameter from the others.
    condition : float
        Condition number of the regressors, each scaled to unit norm.
    residual : ndarray, shape (n,)
        What the solution leaves of the response; zero where not used.
    determination : float
        Coefficient of determination R^2.
    samples : int
        Samples used.
    effective_samples : float
        As many independent samples know as much: those used over the span of the window.
    freedom : ndarray, shape (k,)
        Degrees of freedom of the errors: fewer than effective samples beyond k where few of
        them decide on a parameter.

    """

    values: FloatArray
    covariance: FloatArray
    errors: FloatArray
    determined: BoolArray
    condition: float
    residual: FloatArray
    determination: float
    samples: int
    effective_samples: float
    freedom: FloatArray

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return confidence intervals of the parameters (Student's t), shape (k, 2)."""
        reach = stdtrit(self.freedom, 0.5 + level / 2.0) * self.errors
        centers = np.where(self.determined, self.values, 0.0)
        return np.column_stack([centers - reach, centers + reach])

    def wald(self, which: list[int]) -> tuple[float, float]:
        """
        Test whether parameters are all zero.

        Parameters
        ----------
        which : list of int
            Their positions; all determined.

        Returns
        -------
        statistic, p_value : float
            Wald statistic (chi^2 for many samples) and the probability of a larger one by
            chance (F distribution for few).

        """
        values = self.values[which]
        covariance = self.covariance[np.ix_(which, which)]
        if not covariance.any():
            found = np.inf if values.any() else 0.0
        else:
            found = float(values @ np.linalg.solve(covariance, values))
        return found, float(
            fdtrc(len(which), float(self.freedom[which].min()), found / len(which))
        )


def regress(
    regressors: FloatArray,
    response: FloatArray,
    *,
    estimator: str = 'ordinary',
    window: FloatArray | None = None,
    groups: IntArray | None = None,
    noisy: BoolArray | None = None,
    regressor_noise: FloatArray | None = None,
    used: BoolArray | None = None,
) -> Regression:
    """
    Solve ``response = regressors @ values + noise``.

    Parameters
    ----------
    regressors : ndarray, shape (n, k)
        Regressors, one column per parameter.
    response : ndarray, shape (n,)
        Response.
    estimator : str
        One of `ESTIMATORS`.
    window : ndarray, shape (w,), optional
        Window (triangular) that spans the correlation of the noise [samples]; without it the
        samples are independent.
    groups : ndarray of int, shape (n,), optional
        Regime or channel of each sample, within which ``weighted`` measures the noise.
    noisy : ndarray of bool, shape (k,), optional
        Columns that carry noise, for ``total``.
    regressor_noise : ndarray, shape (k,), optional
        Standard deviation of that noise; only noisy columns are looked at.
    used : ndarray of bool, shape (n,), optional
        Samples to use; the others keep the rest at their true distance in time. Default: all.

    Returns
    -------
    Regression
        Parameters with errors; those that the regressors do not tell apart are marked.

    Raises
    ------
    IdentificationError
        If there are too few samples, or the noise of the regressors exceeds what they vary.
    ParameterError
        If the estimator is unknown or lacks what it needs.
    ShapeError
        If the shapes do not fit.

    """
    x, y, used = _checked(regressors, response, used)
    samples, k = int(np.count_nonzero(used)), x.shape[1]
    span = 1.0 if window is None else float(window.sum()) ** 2 / float(window @ window)
    effective = samples / span
    if effective <= k:
        raise IdentificationError(
            f'{k} parameters need more than {k} independent samples, got {effective:.3g}'
        )
    norms = np.linalg.norm(x, axis=0)
    norms[norms == 0.0] = 1.0
    x = x / norms
    singular, directions = np.linalg.svd(x, full_matrices=False)[1:]
    # A null direction says nothing; the parameters that have no part in it are solved without.
    basis, unknown = determinable(singular, directions)
    x = x @ basis
    if estimator == 'ordinary':
        solution, bread, pull, scores = _weighted(x, y, used.astype(np.float64))
    elif estimator == 'weighted':
        solution, bread, pull, scores = _weighted(x, y, _group_weights(x, y, used, groups, span))
    elif estimator == 'huber':
        solution, bread, pull, scores = _huber(x, y, used)
    elif estimator == 'total':
        noise = _noise_covariance(noisy, regressor_noise, norms)
        solution, bread, pull, scores = _total(x, y, used, basis.T @ noise @ basis)
    else:
        raise ParameterError(f'estimator must be one of {", ".join(ESTIMATORS)}, got {estimator}')
    residual = y - x @ solution
    # The fit itself has taken as many degrees of freedom as it has parameters.
    meat = score_covariance(scores, window) * effective / (effective - k)
    back = basis / norms[:, np.newaxis]
    # Effective number of samples behind each parameter, by the share of each in its variance
    # (Satterthwaite).
    shares = (pull @ (back @ bread).T) ** 2
    spread = np.diag(score_covariance(shares, window))
    behind = np.divide(shares.sum(axis=0) ** 2, spread, out=np.ones_like(spread), where=spread > 0)
    values = back @ solution
    covariance = back @ (bread @ meat @ bread.T) @ back.T
    values[unknown] = np.nan
    covariance[unknown] = covariance[:, unknown] = np.nan
    covariance[unknown, unknown] = np.inf
    variance = float(np.var(y[used]))
    unexplained = float(residual @ residual) / samples
    result = Regression(
        values=values,
        covariance=covariance,
        errors=np.sqrt(np.diag(covariance)),
        determined=~unknown,
        condition=float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf,
        residual=residual,
        determination=1.0 - unexplained / variance if variance > 0.0 else 0.0,
        samples=samples,
        effective_samples=effective,
        freedom=behind * (1.0 - k / effective),
    )
    for array in (values, covariance, residual, result.errors, result.determined, result.freedom):
        array.setflags(write=False)
    return result


def _checked(
    regressors: FloatArray, response: FloatArray, used: BoolArray | None
) -> tuple[FloatArray, FloatArray, BoolArray]:
    x, y = np.asarray(regressors, dtype=np.float64), np.asarray(response, dtype=np.float64)
    chosen = np.ones(y.shape, dtype=np.bool_) if used is None else np.asarray(used, dtype=np.bool_)
    if x.ndim != 2 or y.shape != x.shape[:1] or chosen.shape != y.shape:
        raise ShapeError(
            f'regressors (n, k), response (n,) and used (n,) do not fit: {x.shape}, {y.shape}, '
            f'{chosen.shape}'
        )
    if not (np.isfinite(x[chosen]).all() and np.isfinite(y[chosen]).all()):
        raise ShapeError('regressors and response must be finite')
    return np.where(chosen[:, np.newaxis], x, 0.0), np.where(chosen, y, 0.0), chosen


def determinable(singular: FloatArray, directions: FloatArray) -> tuple[FloatArray, BoolArray]:
    """
    Say what regressors of unit norm determine, from their singular value decomposition.

    Parameters
    ----------
    singular : ndarray, shape (k,)
        Singular values, largest first.
    directions : ndarray, shape (k, k)
        Their directions in the space of the parameters, one per row.

    Returns
    -------
    basis : ndarray, shape (k, r)
        Directions that are not null, one per column.
    unknown : ndarray of bool, shape (k,)
        Parameters that have a part in a direction which is null or nearly so.

    """
    null = singular <= _ROUNDING * singular[0]
    weak = singular * LARGEST_CONDITION < singular[0]
    unknown = (np.abs(directions[null]) > np.sqrt(_ROUNDING)).any(axis=0)
    unknown |= (np.abs(directions[weak]) > _LARGEST_SHARE).any(axis=0)
    return directions[~null].T, np.asarray(unknown)


def _weighted(x: FloatArray, y: FloatArray, weights: FloatArray) -> _Solution:
    """Solve with a weight per sample."""
    root = np.sqrt(weights)[:, np.newaxis]
    solution: FloatArray = np.asarray(np.linalg.lstsq(root * x, root[:, 0] * y, rcond=None)[0])
    weighted = weights[:, np.newaxis] * x
    bread = np.asarray(np.linalg.inv(x.T @ weighted))
    return solution, bread, weighted, weighted * (y - x @ solution)[:, np.newaxis]


def _group_weights(
    x: FloatArray, y: FloatArray, used: BoolArray, groups: IntArray | None, span: float
) -> FloatArray:
    """
    Return 1 / (noise variance in the group of the sample), relative to that of all.

    The variance is that about the mean of the group, so that a misfit is not taken for noise.
    A few windows of the noise of all groups are added to each: a group of few samples may seem
    quieter than it is.
    """
    if groups is None or np.shape(groups) != y.shape:
        raise ParameterError('weighted needs the group of each sample')
    residual = y - x @ _weighted(x, y, used.astype(np.float64))[0]
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


def _huber(x: FloatArray, y: FloatArray, used: BoolArray) -> _Solution:
    """Solve by iterated weights; the scale is the median absolute residual of each round."""
    weights = used.astype(np.float64)
    solution = _weighted(x, y, weights)[0]
    smallest = _ROUNDING * float(np.sqrt(np.mean(y[used] ** 2)))
    limit = np.inf
    for _ in range(_MOST_ITERATIONS):
        size = np.abs(y - x @ solution)
        limit = _HUBER * max(_MAD * float(np.median(size[used])), smallest)
        weights = np.where(size > limit, limit / np.maximum(size, limit), 1.0) * used
        last, solution = solution, _weighted(x, y, weights)[0]
        if np.linalg.norm(solution - last) <= _ROUNDING * np.linalg.norm(solution):
            break
    residual = y - x @ solution
    # Only samples within the limit still pull when the solution moves.
    pulling = (used & (np.abs(residual) <= limit)).astype(np.float64)
    pull = pulling[:, np.newaxis] * x
    bread = np.asarray(np.linalg.pinv(x.T @ pull))
    return solution, bread, pull, x * np.clip(residual, -limit, limit)[:, np.newaxis]


def _noise_covariance(
    noisy: BoolArray | None, noise: FloatArray | None, norms: FloatArray
) -> FloatArray:
    if noisy is None or noise is None or not len(noisy) == len(noise) == len(norms):
        raise ParameterError('total needs the noise of each column')
    return np.diag(np.where(noisy, noise, 0.0) / norms) ** 2


def _total(x: FloatArray, y: FloatArray, used: BoolArray, noise: FloatArray) -> _Solution:
    """Solve without the part of the normal matrix that is noise of the regressors."""
    normal = x.T @ x - np.count_nonzero(used) * noise
    if np.linalg.eigvalsh(normal)[0] <= 0.0:
        raise IdentificationError('the noise of the regressors exceeds what they vary')
    solution = np.asarray(np.linalg.solve(normal, x.T @ y))
    scores = x * (y - x @ solution)[:, np.newaxis] + np.outer(used, noise @ solution)
    return solution, np.asarray(np.linalg.inv(normal)), x, np.asarray(scores)


def score_covariance(scores: FloatArray, window: FloatArray | None) -> FloatArray:
    r"""
    Covariance of the sum of correlated scores.

    Sums over all positions of a triangular window weigh the autocovariances with its own
    autocorrelation, which is the kernel of Parzen: flat at lag zero, never negative. Samples
    that are not used have score zero and keep the others at their true distance.

    Parameters
    ----------
    scores : ndarray, shape (n, k)
        Scores.
    window : ndarray, shape (w,), or None
        Window; None if they are independent.

    Returns
    -------
    ndarray, shape (k, k)
        Covariance.

    """
    if window is None:
        return np.asarray(scores.T @ scores)
    padded = np.pad(scores, ((len(window) // 2,) * 2, (0, 0)))
    sums = convolve1d(padded, window, axis=0, mode='constant')
    return np.asarray(sums.T @ sums / (window @ window))
