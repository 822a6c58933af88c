# SPDX-License-Identifier: Apache-2.0
r"""
Screen additional columns for a least squares fit at little cost.

The explanatory power of additional columns Z to the columns X is the power of the rest
:math:`\tilde Z` of their own regression on X for the residual [Frisch1933]_. The covariance of
their coefficients is computed from sums of scores over parts with the correlation length of the
noise.

References
----------
.. [Frisch1933] R. Frisch, F. V. Waugh, "Partial time regressions as compared with individual
   trends", Econometrica 1(4), 1933.

"""

from collections.abc import Sequence
from typing import NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.estimation.memory import Parts
from needle_identification.estimation.regression import determinable
import numpy as np
from scipy.special import fdtrc


class Trial(NamedTuple):
    """Coefficients (q,) and standard errors of additional columns, and the test that all are 0."""

    values: FloatArray
    errors: FloatArray
    determined: bool  # distinguished from the other columns
    misfit: float  # residual sum of squares
    p_value: float
    growth: float = 1.0  # of the errors by autocorrelated noise that remains
    samples: float = 0.0  # independent ones of the noise that remains; 0: unknown


class Screening:
    """Least squares fit of the used samples, to which additional columns are added on trial."""

    def __init__(
        self,
        regressors: FloatArray,
        response: FloatArray,
        parts: Parts,
        noise: FloatArray | None = None,
    ) -> None:
        norms = _norms(regressors)
        self._x = regressors / norms
        self._gram = self._x.T @ self._x
        self._moment = self._x.T @ response
        self._power = float(response @ response)
        self._inverse = np.linalg.pinv(self._gram, hermitian=True)
        values = self._inverse @ self._moment
        self._residual = response - self._x @ values
        scaled = np.zeros_like(self._x) if noise is None else noise / norms
        #: Change of the residual by the noise, and its product with that of each column.
        self._blur = scaled @ values
        self._pull = scaled.T @ self._blur
        self._starts = np.concatenate([[0], np.cumsum(parts.sizes)[:-1]]).astype(np.int_)
        self.misfit = float(self._residual @ self._residual)

    def tried(self, columns: FloatArray, noise: FloatArray | None = None) -> Trial:
        """
        Fit with additional columns (n, q) of the used samples.

        ``noise`` is the change of the columns by a standard deviation of a noise that they share
        with the columns of the fit.
        """
        norms = _norms(columns)
        z = columns / norms
        k, q = len(self._gram), z.shape[1]
        both = self._x.T @ z
        part = self._inverse @ both
        rest, pull = z - self._x @ part, -part.T @ self._pull
        if noise is not None:
            pull += noise.T @ self._blur / norms
        inner = np.linalg.pinv(rest.T @ rest, hermitian=True)
        # A shared noise e changes z and y - X b: E[z(v + e) e] = var(e) E[z'(v + e)] (Stein).
        values = inner @ (rest.T @ self._residual + pull)
        left = self._residual - rest @ values
        scores = self._scores(rest, left)
        free = len(self._starts) - k - q
        misfit = float(left @ left)
        determined = free > 0 and not self._unknown(both, z)[k:].any()
        if not determined:
            return Trial(values / norms, np.full(q, np.inf), False, misfit, 1.0)
        covariance = inner @ (scores.T @ scores) @ inner * len(self._starts) / free
        if covariance.any():
            wald = float(values @ np.linalg.solve(covariance, values)) / q
        else:
            wald = np.inf
        errors = np.sqrt(np.diag(covariance)) / norms
        return Trial(values / norms, errors, True, misfit, float(fdtrc(q, free, wald)))

    def _scores(self, x: FloatArray, left: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(x * left[:, np.newaxis], self._starts, axis=0))

    def _unknown(self, both: FloatArray, z: FloatArray) -> BoolArray:
        whole = np.block([[self._gram, both], [both.T, z.T @ z]])
        strengths, directions = np.linalg.eigh(whole)
        singular = np.sqrt(np.maximum(strengths[::-1], 0.0))
        return determinable(singular, directions[:, ::-1].T)[1]

    def misfit_without(self, columns: Sequence[int]) -> float:
        """Return the residual sum of squares without some columns of the fit."""
        kept = np.setdiff1d(np.arange(len(self._gram)), columns)
        moment = self._moment[kept]
        inverse = np.linalg.pinv(self._gram[np.ix_(kept, kept)], hermitian=True)
        return max(self._power - float(moment @ inverse @ moment), self.misfit)


def _norms(columns: FloatArray) -> FloatArray:
    norms = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    return np.where(norms > 0.0, norms, 1.0)
