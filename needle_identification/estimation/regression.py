r"""
Linear regression with standard errors that respect autocorrelation.

The estimators are in `solvers`. The covariance of the parameters comes from the sums of their
scores over a triangular window, so that it holds for noise that is correlated, uneven, or both
[NeweyWest1987]_. Intervals are those of Student's t, with the degrees of freedom of Satterthwaite.

References
----------
.. [NeweyWest1987] W. K. Newey, K. D. West, "A simple, positive semi-definite,
   heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica 55(3), 1987.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimators import check_estimator
from needle_identification.estimation.solvers import (
    group_weights,
    huber,
    ROUNDING,
    Solution,
    total,
    weighted,
)
from needle_ros.errors import ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import convolve1d
from scipy.special import fdtrc, stdtrit

#: Directions of the scaled regressors with a response below 1 / this of the largest are not
#: determined: an error of 1 % in the response would change a parameter by a fifth.
LARGEST_CONDITION: Final = 20.0

#: Share of such a direction that a determined parameter may have; its error includes it.
_LARGEST_SHARE: Final = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Regression:
    """
    Solution of a linear regression with k parameters and n samples.

    Attributes
    ----------
    values, errors : ndarray, shape (k,)
        Parameters and their standard errors; nan and inf where not determined.
    covariance : ndarray, shape (k, k)
        Covariance of the parameters; where one is not determined, nan off the diagonal and inf
        on it.
    determined : ndarray of bool, shape (k,)
        Whether the regressors distinguish the parameter from the others.
    condition : float
        Condition number of the regressors, each scaled to unit norm.
    residual : ndarray, shape (n,)
        Response minus model; zero where not used.
    determination : float
        Coefficient of determination R^2.
    samples : int
        Number of samples used.
    effective_samples : float
        Number of independent samples with the same information: the samples used over the span
        of the window.
    degrees_of_freedom : ndarray, shape (k,)
        Degrees of freedom of the errors; fewer than ``effective_samples - k`` where few samples
        determine a parameter (Satterthwaite).

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
    degrees_of_freedom: FloatArray

    def __repr__(self) -> str:
        pairs = zip(self.values.tolist(), self.errors.tolist(), strict=True)
        values = ', '.join(f'{value:.4g} ± {error:.2g}' for value, error in pairs)
        return f'<Regression: {values}; {self.samples} samples, R^2 = {self.determination:.4f}>'

    def interval(self, level: float = 0.95) -> FloatArray:
        """
        Return the confidence intervals of the parameters (Student's t).

        Parameters
        ----------
        level : float
            Confidence level.

        Returns
        -------
        ndarray, shape (k, 2)
            Lower and upper limits; infinite where not determined.

        """
        half_widths = stdtrit(self.degrees_of_freedom, 0.5 + level / 2.0) * self.errors
        centers = np.where(self.determined, self.values, 0.0)
        return np.column_stack([centers - half_widths, centers + half_widths])

    def wald(self, which: Sequence[int]) -> tuple[float, float]:
        """
        Test whether parameters are all zero (Wald test).

        Parameters
        ----------
        which : sequence of int
            Their positions; all determined.

        Returns
        -------
        statistic, p_value : float
            Wald statistic and its p-value, from the F distribution.

        """
        at = list(which)
        values = self.values[at]
        covariance = self.covariance[np.ix_(at, at)]
        if not covariance.any():
            found = np.inf if values.any() else 0.0
        else:
            found = float(values @ np.linalg.solve(covariance, values))
        freedom = float(self.degrees_of_freedom[at].min())
        return found, float(fdtrc(len(at), freedom, found / len(at)))


def regress(
    regressors: ArrayLike,
    response: ArrayLike,
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
    regressors : array_like, shape (n, k)
        Regressors, one column per parameter.
    response : array_like, shape (n,)
        Response.
    estimator : str
        One of `ESTIMATORS`.
    window : ndarray, shape (w,), optional
        Window (triangular) that spans the correlation of the noise [samples]. Without it the
        samples are independent.
    groups : ndarray of int, shape (n,), optional
        Group of each sample, in which ``weighted`` measures the noise.
    noisy : ndarray of bool, shape (k,), optional
        Columns that carry noise, for ``total``.
    regressor_noise : ndarray, shape (k,), optional
        Standard deviation of that noise. Only noisy columns count.
    used : ndarray of bool, shape (n,), optional
        Samples to use; default all. Samples that are not used keep the others at their true
        distance in time.

    Returns
    -------
    Regression
        Parameters with errors. Those that the regressors do not determine are marked.

    Raises
    ------
    IdentificationError
        If there are too few samples, or the noise of the regressors exceeds their variation.
    ParameterError
        If the estimator is unknown or lacks an argument.
    ShapeError
        If the shapes do not match, or a used value is not finite.

    Examples
    --------
    A line through four points:

    >>> fit = regress([[1, 0], [1, 1], [1, 2], [1, 3]], [1.0, 3.1, 4.9, 7.0])
    >>> fit.values.round(2).tolist()
    [1.03, 1.98]
    >>> fit.determined.tolist()
    [True, True]

    """
    check_estimator(estimator)
    x, y, used = _checked(regressors, response, used)
    samples, k = int(np.count_nonzero(used)), x.shape[1]
    span = 1.0 if window is None else window_span(window)
    effective = samples / span
    if effective <= k:
        raise IdentificationError(
            f'{k} parameters need more than {k} independent samples, got {effective:.3g}'
        )
    norms = np.linalg.norm(x, axis=0)
    norms[norms == 0.0] = 1.0
    x = x / norms
    singular, directions = np.linalg.svd(x, full_matrices=False)[1:]
    # Null directions are left out; parameters without a part in them are still solved.
    basis, unknown = determinable(singular, directions)
    x = x @ basis
    if estimator == 'ordinary':
        solution = weighted(x, y, used.astype(np.float64))
    elif estimator == 'weighted':
        solution = weighted(x, y, group_weights(x, y, used, groups, span))
    elif estimator == 'huber':
        solution = huber(x, y, used)
    else:
        noise = _noise_covariance(noisy, regressor_noise, norms)
        solution = total(x, y, used, basis.T @ noise @ basis)
    return _with_errors(
        solution, x, y, used, window, basis / norms[:, np.newaxis], unknown, singular
    )


def _with_errors(
    solution: Solution,
    x: FloatArray,
    y: FloatArray,
    used: BoolArray,
    window: FloatArray | None,
    back: FloatArray,
    unknown: BoolArray,
    singular: FloatArray,
) -> Regression:
    """Add covariance and degrees of freedom, and go back to the columns that were given."""
    samples, k = int(np.count_nonzero(used)), len(unknown)
    effective = samples / (1.0 if window is None else window_span(window))
    residual = y - x @ solution.values
    # The fit itself takes as many degrees of freedom as it has parameters.
    middle = score_covariance(solution.scores, window) * effective / (effective - k)
    # Effective number of samples behind each parameter, from the share of each sample in its
    # variance (Satterthwaite).
    shares = (solution.influence @ (back @ solution.inverse).T) ** 2
    variance_of_shares = np.diag(score_covariance(shares, window))
    behind = np.divide(
        shares.sum(axis=0) ** 2,
        variance_of_shares,
        out=np.ones_like(variance_of_shares),
        where=variance_of_shares > 0,
    )
    values = back @ solution.values
    covariance = back @ (solution.inverse @ middle @ solution.inverse.T) @ back.T
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
    if not (np.isfinite(x[chosen]).all() and np.isfinite(y[chosen]).all()):
        raise ShapeError('regressors and response must be finite')
    return np.where(chosen[:, np.newaxis], x, 0.0), np.where(chosen, y, 0.0), chosen


def _noise_covariance(
    noisy: BoolArray | None, noise: FloatArray | None, norms: FloatArray
) -> FloatArray:
    if noisy is None or noise is None or not len(noisy) == len(noise) == len(norms):
        raise ParameterError('total needs the noise of each column')
    return np.diag(np.where(noisy, noise, 0.0) / norms) ** 2


def determinable(singular: FloatArray, directions: FloatArray) -> tuple[FloatArray, BoolArray]:
    """
    Decide which parameters regressors of unit norm determine.

    Parameters
    ----------
    singular : ndarray, shape (k,)
        Singular values of the regressors, largest first.
    directions : ndarray, shape (k, k)
        Their directions in the space of the parameters, one per row.

    Returns
    -------
    basis : ndarray, shape (k, r)
        Directions that are not null, one per column.
    unknown : ndarray of bool, shape (k,)
        Parameters that have a part in a direction that is null or nearly null.

    """
    null = singular <= ROUNDING * singular[0]
    weak = singular * LARGEST_CONDITION < singular[0]
    unknown = (np.abs(directions[null]) > np.sqrt(ROUNDING)).any(axis=0)
    unknown |= (np.abs(directions[weak]) > _LARGEST_SHARE).any(axis=0)
    return directions[~null].T, np.asarray(unknown)


def triangular_window(length: int) -> FloatArray:
    """
    Return a symmetric triangular window for `regress`.

    Parameters
    ----------
    length : int
        Number of samples, at least one.

    Returns
    -------
    ndarray, shape (length,)
        Weights that rise linearly to at most one in the middle.

    """
    rising = np.arange(1, (length + 1) // 2 + 1)
    if length % 2:
        half = 2.0 * rising / (length + 1.0)
        return np.concatenate([half, half[-2::-1]])
    half = (2.0 * rising - 1.0) / length
    return np.concatenate([half, half[::-1]])


def window_span(window: FloatArray) -> float:
    """
    Return the number of samples that count as one independent sample.

    Parameters
    ----------
    window : ndarray, shape (w,)
        Window that spans the correlation of the noise.

    Returns
    -------
    float
        Span of the window [samples].

    """
    return float(window.sum()) ** 2 / float(window @ window)


def score_covariance(scores: FloatArray, window: FloatArray | None) -> FloatArray:
    """
    Return the covariance of the sum of correlated scores.

    The scores are summed over all positions of a triangular window. This weighs their
    autocovariances with the autocorrelation of the window, the Parzen kernel, which is flat at
    lag zero and gives no negative variance. Samples that are not used have score zero and keep
    the others at their true distance.

    Parameters
    ----------
    scores : ndarray, shape (n, k)
        Scores.
    window : ndarray, shape (w,), or None
        Window; None if the scores are independent.

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
