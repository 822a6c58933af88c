# SPDX-License-Identifier: Apache-2.0
r"""
Linear regression with standard errors for autocorrelated noise.

With the regressors :math:`x_i` of sample i and its response :math:`y_i`, the estimators solve

.. math:: \sum_i w_i \, x_i (y_i - x_i^T \beta) + n \Sigma \beta = 0

``ordinary``: w = 1. ``weighted``: w = 1 / (noise variance measured in the group of the sample),
the matrix W of section 3.2.2.1 of the paper. ``huber``: w falls with the size of the residual
[Huber1981]_. ``total``: Sigma is the covariance of the noise of the regressors, which biases
ordinary least squares; this is total least squares with exact and noisy columns and free noise of
the response, which has a closed solution [VanHuffel1991]_.

The covariance of the parameters is computed from the sums of their scores over a triangular
window, so that it is valid for noise that is correlated over the window, heteroskedastic, or both
[NeweyWest1987]_. Noise with a longer correlation is modeled, and the errors are increased
accordingly; see `memory`. Intervals are from Student's t, with the degrees of freedom of
Satterthwaite.

References
----------
.. [Huber1981] P. J. Huber, "Robust Statistics", Wiley, 1981.
.. [VanHuffel1991] S. Van Huffel, J. Vandewalle, "The Total Least Squares Problem", SIAM, 1991.
.. [NeweyWest1987] W. K. Newey, K. D. West, "A simple, positive semi-definite,
   heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica 55(3), 1987.

"""

from dataclasses import dataclass
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation import ESTIMATORS
from needle_identification.estimation.memory import divided, Memory, memory_of
from needle_ros.errors import ParameterError, ShapeError
from needle_ros.quantities import DEVIATION_OVER_MEDIAN
from needle_ros.settings import check_choice
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import convolve1d
from scipy.special import fdtrc, stdtrit

#: Directions of the scaled regressors with a response below 1 / this of the largest are not
#: determined: an error of 1 % in the response would change a parameter by a fifth.
LARGEST_CONDITION: Final = 20.0

_LARGEST_SHARE: Final = 0.1  # largest share of such a direction in a determined parameter
_ROUNDING: Final = 1e-9  # relative size of rounding errors
_PRIOR: Final = 5.0  # weight of the noise of all groups in each group [correlation windows]
HUBER_LIMIT: Final = 1.345  # residual over its deviation of falling weight; 95 % efficient
_MAX_ITERATIONS: Final = 100


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Regression:
    """Solution of a linear regression with k parameters and n samples."""

    values: FloatArray  #: (k,) parameters; nan where not determined
    covariance: FloatArray  #: (k, k) of the parameters; nan, and inf on the diagonal, likewise
    errors: FloatArray  #: (k,) standard errors; inf likewise
    determined: BoolArray  #: (k,) whether the regressors distinguish the parameter from the others
    condition: float  #: condition number of the regressors, each scaled to unit norm
    residual: FloatArray  #: (n,) response minus model; zero where not used
    determination: float  #: coefficient of determination R^2
    samples: int  #: number of samples used
    effective_samples: float  #: number of independent samples with the same information
    degrees_of_freedom: FloatArray  #: (k,) of the errors, by the samples behind each
    memory: Memory | None = None  #: autocorrelation in the errors, if requested

    def __repr__(self) -> str:
        pairs = zip(self.values.tolist(), self.errors.tolist(), strict=True)
        values = ', '.join(f'{value:.4g} ± {error:.2g}' for value, error in pairs)
        return f'<Regression: {values}; {self.samples} samples, R^2 = {self.determination:.4f}>'

    @property
    def is_exact(self) -> bool:
        """Whether the residuals are rounding errors only."""
        return 1.0 - self.determination < _ROUNDING

    def interval(self) -> FloatArray:
        """Return the 95 % confidence intervals (k, 2); infinite where not determined."""
        half_widths = stdtrit(self.degrees_of_freedom, 0.975) * self.errors
        centers = np.where(self.determined, self.values, 0.0)
        return np.column_stack([centers - half_widths, centers + half_widths])


def wald_test(fit: Regression, at: list[int]) -> float:
    """Return the p-value that the parameters with these indices, all determined, are zero."""
    values = fit.values[at]
    covariance = fit.covariance[np.ix_(at, at)]
    if fit.memory is not None:
        more = fit.memory.far[at] / fit.memory.inflation[at]
        covariance = covariance * np.outer(more, more)
    if not covariance.any():
        found = np.inf if values.any() else 0.0
    else:
        found = float(values @ np.linalg.solve(covariance, values))
    freedom = float(fit.degrees_of_freedom[at].min())
    return float(fdtrc(len(at), freedom, found / len(at)))


class _Solution(NamedTuple):
    """Parameters, and the change and the contribution of each sample in their equations."""

    values: FloatArray  # (k,)
    inverse: FloatArray  # of the normal matrix (k, k)
    influence: FloatArray  # (n, k)
    scores: FloatArray  # (n, k), sums to zero


def regress(
    regressors: ArrayLike,
    response: ArrayLike,
    *,
    estimator: str = 'ordinary',
    correlation: int = 1,
    groups: IntArray | None = None,
    regressor_noise: FloatArray | None = None,
    noise_moments: FloatArray | None = None,
    used: BoolArray | None = None,
    colored: bool = False,
) -> Regression:
    """
    Solve ``response = regressors @ values + noise``.

    Parameters
    ----------
    regressors : array_like, shape (n, k)
        Regressors, one column per parameter.
    response : array_like, shape (n,)
        Response.
    estimator : str
        One of `ESTIMATORS`.
    correlation : int
        Correlation length of the noise [samples]; 1 for independent samples.
    groups : ndarray of int, shape (n,), optional
        Group of each sample, in which ``weighted`` measures the noise.
    regressor_noise : ndarray, shape (k,), optional
        Standard deviation of the noise of each column, for ``total``.
    noise_moments : ndarray, shape (k, k), optional
        Sums of squares and products of the noise in the used columns, which determines nothing.
    used : ndarray of bool, shape (n,), optional
        Samples to use; default all. Unused samples preserve the time between the others.
    colored : bool
        Whether the errors include a longer correlation of the noise.

    Returns
    -------
    Regression
        Parameters with errors; undetermined parameters are marked.

    Raises
    ------
    IdentificationError
        If there are too few samples, or the noise of the regressors exceeds their variation.

    Examples
    --------
    A line through four points:

    >>> fit = regress([[1, 0], [1, 1], [1, 2], [1, 3]], [1.0, 3.1, 4.9, 7.0])
    >>> fit.values.round(2).tolist()
    [1.03, 1.98]
    >>> fit.determined.tolist()
    [True, True]

    """
    check_choice('estimator', estimator, ESTIMATORS)
    x, y, used = _checked(regressors, response, used)
    samples, k = int(np.count_nonzero(used)), x.shape[1]
    span = independent_span(correlation)
    effective = samples / span
    if effective <= k:
        raise IdentificationError(
            f'{k} parameters need more than {k} independent samples, got {effective:.3g}'
        )
    norms = np.linalg.norm(x, axis=0)
    norms[norms == 0.0] = 1.0
    x = x / norms
    singular, directions = np.linalg.svd(np.linalg.qr(x, mode='r'))[1:]
    # Null directions are omitted; parameters without a component in them are still solved.
    moments = None if noise_moments is None else noise_moments / np.outer(norms, norms)
    basis, unknown = determinable(singular, directions, moments)
    x = x @ basis
    if estimator == 'ordinary':
        solution = _weighted(x, y, used.astype(np.float64))
    elif estimator == 'weighted':
        solution = _weighted(x, y, _group_weights(x, y, used, groups, span))
    elif estimator == 'huber':
        solution = _huber(x, y, used)
    elif regressor_noise is None or len(regressor_noise) != k:
        raise ParameterError('total needs the noise of each column')
    else:
        noise = np.diag(np.asarray(regressor_noise) / norms) ** 2
        solution = _total(x, y, used, basis.T @ noise @ basis)
    back = basis / norms[:, np.newaxis]
    residual = y - x @ solution.values
    # The fit uses one degree of freedom per parameter.
    middle = score_covariance(solution.scores, correlation) * effective / (effective - k)
    # Effective number of samples behind each parameter, from their shares (Satterthwaite).
    influence = solution.influence @ (back @ solution.inverse).T
    shares = influence**2
    total, spread = shares.sum(axis=0), np.diag(score_covariance(shares, correlation))
    behind = np.divide(total**2, spread, out=np.ones_like(spread), where=spread > 0)
    values = back @ solution.values
    covariance = back @ (solution.inverse @ middle @ solution.inverse.T) @ back.T
    memory = None
    if colored:
        memory = memory_of(residual, x, influence, divided(used, correlation))
        covariance *= np.outer(memory.inflation, memory.inflation)
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
        degrees_of_freedom=behind * (1.0 - k / effective),
        memory=memory,
    )
    for array in (
        values, covariance, residual, result.errors, result.determined, result.degrees_of_freedom,
    ):  # fmt: skip
        array.setflags(write=False)
    return result


def _checked(
    regressors: ArrayLike, response: ArrayLike, used: BoolArray | None
) -> tuple[FloatArray, FloatArray, BoolArray]:
    x, y = np.asarray(regressors, dtype=np.float64), np.asarray(response, dtype=np.float64)
    chosen = np.ones(y.shape, dtype=np.bool_) if used is None else np.asarray(used, dtype=np.bool_)
    if x.ndim != 2 or y.shape != x.shape[:1] or chosen.shape != y.shape:
        raise ShapeError(
            f'regressors (n, k), response (n,) and used (n,) do not match: {x.shape}, {y.shape}, '
            f'{chosen.shape}'
        )
    # By columns: operations on the long, few columns are two to five times as fast.
    x, y = np.where(chosen, x.T, 0.0).T, np.where(chosen, y, 0.0)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ShapeError('regressors and response must be finite')
    return x, y, chosen


def _weighted(x: FloatArray, y: FloatArray, weights: FloatArray) -> _Solution:
    root = np.sqrt(weights)[:, np.newaxis]
    values: FloatArray = np.asarray(np.linalg.lstsq(root * x, root[:, 0] * y, rcond=None)[0])
    influence = weights[:, np.newaxis] * x
    inverse = np.asarray(np.linalg.inv(x.T @ influence))
    return _Solution(values, inverse, influence, influence * (y - x @ values)[:, np.newaxis])


def _group_weights(
    x: FloatArray, y: FloatArray, used: BoolArray, groups: IntArray | None, span: float
) -> FloatArray:
    """Weight each sample by the inverse of the noise variance about the mean of its group."""
    # The noise of all groups enters: few samples may have a small variance by chance.
    if groups is None or np.shape(groups) != y.shape:
        raise ParameterError('weighted needs the group of each sample')
    residual = y - x @ _weighted(x, y, used.astype(np.float64)).values
    members = np.unique(np.asarray(groups)[used], return_inverse=True)[1]
    count = np.bincount(members)
    left = residual[used]
    left = left - (np.bincount(members, left) / count)[members]
    pooled = float(left @ left) / len(left)
    weights = used.astype(np.float64)
    if pooled > 0.0:
        prior = _PRIOR * span
        variance = (np.bincount(members, left**2) + prior * pooled) / (count + prior)
        weights[used] = pooled / variance[members]
    return weights


def _huber(x: FloatArray, y: FloatArray, used: BoolArray) -> _Solution:
    """Solve by iterated weights; the scale is the median absolute residual of each iteration."""
    weights = used.astype(np.float64)
    values = _weighted(x, y, weights).values
    smallest = _ROUNDING * float(np.sqrt(np.mean(y[used] ** 2)))
    limit = np.inf
    for _ in range(_MAX_ITERATIONS):
        size = np.abs(y - x @ values)
        limit = HUBER_LIMIT * max(DEVIATION_OVER_MEDIAN * float(np.median(size[used])), smallest)
        weights = np.where(size > limit, limit / np.maximum(size, limit), 1.0) * used
        last, values = values, _weighted(x, y, weights).values
        if np.linalg.norm(values - last) <= _ROUNDING * np.linalg.norm(values):
            break
    residual = y - x @ values
    within = (used & (np.abs(residual) <= limit)).astype(np.float64)
    # Only samples within the limit have influence.
    influence = within[:, np.newaxis] * x
    inverse = np.asarray(np.linalg.pinv(x.T @ influence))
    scores = x * np.clip(residual, -limit, limit)[:, np.newaxis]
    return _Solution(values, inverse, influence, scores)


def _total(x: FloatArray, y: FloatArray, used: BoolArray, noise: FloatArray) -> _Solution:
    """Solve with the noise of the regressors subtracted from the normal matrix."""
    normal = x.T @ x - np.count_nonzero(used) * noise
    if np.linalg.eigvalsh(normal)[0] <= 0.0:
        raise IdentificationError('the noise of the regressors exceeds their variation')
    values = np.asarray(np.linalg.solve(normal, x.T @ y))
    scores = x * (y - x @ values)[:, np.newaxis] + np.outer(used, noise @ values)
    return _Solution(values, np.asarray(np.linalg.inv(normal)), x, np.asarray(scores))


def determinable(
    singular: FloatArray, directions: FloatArray, noise: FloatArray | None = None
) -> tuple[FloatArray, BoolArray]:
    """
    Return a basis (k, r) of the determined directions, and unknown parameters, of an SVD.

    ``noise`` is the part of the squares and products of the columns, (k, k), that is noise.
    """
    null = singular <= _ROUNDING * singular[0]
    unknown = (np.abs(directions[null]) > np.sqrt(_ROUNDING)).any(axis=0)
    strengths, excited = singular**2, directions
    if noise is not None:
        strengths, turn = np.linalg.eigh(np.diag(strengths) - directions @ noise @ directions.T)
        excited = turn.T @ directions
    weak = strengths * LARGEST_CONDITION**2 < strengths.max()
    unknown |= (np.abs(excited[weak]) > _LARGEST_SHARE).any(axis=0)
    return directions[~null].T, np.asarray(unknown)


def _window(length: int) -> FloatArray:
    """Return a triangular window that rises to at most one in the middle, shape (length,)."""
    whole = length + length % 2
    return np.asarray((whole - np.abs(2.0 * np.arange(length) - (length - 1.0))) / whole)


def independent_span(correlation: int) -> float:
    """Return the number of correlated samples [samples] with the information of one sample."""
    window = _window(correlation)
    return float(window.sum()) ** 2 / float(window @ window)


def score_covariance(scores: FloatArray, correlation: int) -> FloatArray:
    """Return the covariance (k, k) of the sum of correlated scores (n, k), zero where unused."""
    window = _window(correlation)
    padded = np.pad(scores.T, ((0, 0), (len(window) // 2,) * 2))
    sums = convolve1d(padded, window, mode='constant')
    return np.asarray(sums @ sums.T / (window @ window))
