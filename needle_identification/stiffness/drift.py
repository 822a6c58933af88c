"""The zeros of force and position, followed from rest to rest as they drift."""

from __future__ import annotations

from math import exp, log

from needle_dynamics.arrays import FloatArray
import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize_scalar


def follow_zero(
    times: FloatArray, rests: FloatArray, variance: FloatArray, at: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """
    Estimate the zero between the rests as a random walk, measured with noise of known variance.

    The variance of the walk is that of maximum likelihood. Without drift every rest counts for
    every hold. Where the drift exceeds the noise, the zero is interpolated between neighbors.

    Parameters
    ----------
    times : ndarray, shape (r,)
        Times of the rests [s].
    rests : ndarray, shape (r, c)
        Their means in channels of one kind.
    variance : ndarray, shape (r,)
        Variance of these means.
    at : ndarray, shape (m,)
        Times at which to estimate the zero [s].

    Returns
    -------
    zero : ndarray, shape (m, c)
        Zeros.
    covariance : ndarray, shape (m, m)
        Their covariance in each channel.

    """
    mean: FloatArray = rests.mean(axis=0)
    knots, place = np.unique(np.concatenate([times, at]), return_inverse=True)
    seen, asked = place[: len(times)], place[len(times) :]
    precision = np.zeros((len(knots), len(knots)))
    precision[seen, seen] = 1.0 / variance
    rate = _drift_rate(times, rests, variance) if len(times) > 1 else variance[0]
    if len(knots) > 1:
        difference = np.diff(np.eye(len(knots)), axis=0)
        precision += difference.T @ (difference / (rate * np.diff(knots))[:, np.newaxis])
    covariance = np.linalg.inv(precision)
    gain = covariance[np.ix_(asked, seen)] / variance
    zero: FloatArray = mean + gain @ (rests - mean)
    return zero, np.asarray(covariance[np.ix_(asked, asked)])


def _drift_rate(times: FloatArray, rests: FloatArray, variance: FloatArray) -> float:
    """Return the variance per second of the random walk with the largest likelihood."""
    step, change = np.diff(times), np.diff(rests, axis=0)
    slow = 0.01 * float(np.median(variance)) / float(step.sum())
    fast = 100.0 * max(slow, float((change**2).max() / step.min()))

    def negative_log_likelihood(logarithm: float) -> float:
        banded = np.zeros((2, len(step)))
        banded[0] = np.exp(logarithm) * step + variance[:-1] + variance[1:]
        banded[1, :-1] = -variance[1:-1]
        factor = cholesky_banded(banded, lower=True)
        fitted = cho_solve_banded((factor, True), change)
        return float(2.0 * change.shape[1] * np.log(factor[0]).sum() + (change * fitted).sum())

    found = minimize_scalar(
        negative_log_likelihood, bounds=(log(slow), log(fast)), method='bounded'
    )
    return exp(found.x)
