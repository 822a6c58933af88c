# SPDX-License-Identifier: Apache-2.0
r"""
Likelihood of the tips of a medium in a linear mixed model.

In each plane of each recording, the tip minus its response to the guide is

.. math:: X \beta + o + s d + w(d) + u(d) + v(g) + e

with the drift constants of the medium :math:`\beta`, which are normal with known deviations, an
offset o, a slope s ~ N(0, tau^2) with the depth d, the path noise w, an integrated Wiener process
of intensity q, an error u near the skin, where tissue hardly supports the needle and it yields to
each load of the tip, the error v of the response to the guide g, whose variance grows with its
travel, and white noise e of deviation sigma. All causes of drift are possible at once; without a
prior [Harville1977]_ they would not be determined together. The offset and sigma are integrated
out. The ratios of the other deviations to sigma are summed over a grid: a few recordings hardly
determine them. A penalty for each ratio integrates the lengths in the response out, in the
approximation of [Cox1987]_: otherwise the lengths of a few recordings are those with the least
difference between recordings.

References
----------
.. [Cox1987] D. R. Cox, N. Reid, "Parameter orthogonality and approximate conditional inference",
   Journal of the Royal Statistical Society B 49(1), 1987.
.. [Harville1977] D. A. Harville, "Maximum likelihood approaches to variance component estimation
   and to related problems", Journal of the American Statistical Association 72(358), 1977.

"""

from collections.abc import Sequence
from copy import copy
from itertools import product
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray
import numpy as np

_REACH: Final = 0.1  # depth at which path noise and slopes have the deviations of the grid [m]
_TRAVEL: Final = 1e-3  # motion of the guide whose response has the deviation of the grid [m]

#: Grid of the deviations of path noise and slopes at this depth, and of responses, over sigma.
_WANDERS: Final = (0.0, 1.0, 4.0, 16.0, 64.0, 256.0)
_SLOPES: Final = (0.0, 2.0, 8.0, 32.0, 128.0)
_RESPONSES: Final = (0.0, 0.5, 2.0, 8.0)

#: Grid of the deviation of the error at the skin over that of the path noise.
_ENTRIES: Final = (0.0, 2.0)
_SHALLOW: Final = 0.01  # depth over which this error decays [m]
_CORRELATED: Final = 5e-3  # depth over which it is correlated [m]

_FINEST: Final = 1e-6  # smallest deviation of the white noise [m]


class Likelihood(NamedTuple):
    """Fit at given lengths: K ratios, c drift constants and N residuals."""

    deviance: float  #: -2 log likelihood
    weights: FloatArray  #: (K,) posterior probabilities of the ratios
    variances: FloatArray  #: (K,) of the white noise [m^2]
    values: FloatArray  #: (K, c) drift constants
    covariances: FloatArray  #: (K, c, c) of the drift constants
    #: (K, N) residuals, whitened to the variance of the white noise, and of the prior [m].
    residuals: FloatArray
    known: float  #: effective number of drift constants that the tips determine

    @property
    def drift(self) -> FloatArray:
        """Mean drift constants (c,)."""
        return np.asarray(self.weights @ self.values)


class MixedModel:
    """
    Covariances of the recordings of a medium, by depth and guide (n, 3) of their readings.

    ``prior`` is sigma over the deviation of each drift constant, (c,). Twice the log likelihood of
    each ratio is less by its penalty.
    """

    def __init__(
        self,
        depths: Sequence[FloatArray],
        prior: FloatArray,
        ratios: FloatArray | None = None,
        penalties: FloatArray | float = 0.0,
    ) -> None:
        if ratios is None:
            # The drift of a single recording contains its slope.
            slopes = _SLOPES if len(depths) > 1 else (0.0,)
            ratios = np.array(
                [
                    (*own, entry * own[0])
                    for *own, entry in product(_WANDERS, slopes, _RESPONSES, _ENTRIES)
                    if own[0] or not entry
                ]
            )
        self.ratios, self.depths, self.penalties = ratios, depths, penalties
        self.prior = prior
        #: Samples minus offsets.
        self.freedom = 2 * (sum(map(len, depths)) - len(depths))
        rows = max(map(len, depths))
        self._half = np.zeros((len(ratios), len(depths), rows, rows))
        self._logs = penalties - 2.0 * np.log(prior).sum() + np.zeros(len(ratios))
        for k, ratio in enumerate(ratios):
            unique = {depth.tobytes(): depth for depth in depths}
            known = {key: _whitening(covariance(one, ratio)) for key, one in unique.items()}
            for i, depth in enumerate(depths):
                half, log = known[depth.tobytes()]
                self._half[k, i, : len(half), : len(half)] = half
                self._logs[k] += 2.0 * log
        # Whitened columns and tips of all recordings in both planes; each constant of the drift
        # has a reading of 0, the prior.
        c, count = len(prior), 2 * rows * len(depths)
        self._rows = np.zeros((len(ratios), count + c, c + 1))
        self._rows[:, count + np.arange(c), range(c)] = prior

    def limited(self, kept: BoolArray) -> 'MixedModel':
        """Return the model with some of the ratios (K,)."""
        found = copy(self)
        found.ratios, found._half, found._logs, found._rows = (
            one[kept] for one in (self.ratios, self._half, self._logs, self._rows)
        )
        return found

    def likelihood(
        self, columns: Sequence[FloatArray], wanted: Sequence[FloatArray]
    ) -> Likelihood:
        """Fit the drift, (2, n, c) for each recording, to what the guide leaves, (2, n) [m]."""
        c, recordings, most = len(self.prior), *self._half.shape[1:3]
        both = np.zeros((recordings, most, 2, c + 1))
        for at, column, one in zip(both, columns, wanted, strict=True):
            n = one.shape[1]
            at[:n, :, :c], at[:n, :, c] = np.swapaxes(column, 0, 1), one.T
        # One product for both planes.
        planes = both.reshape(recordings, most, -1)
        rows = self._rows
        whitened = rows[:, :-c].reshape(len(rows), *planes.shape)
        np.matmul(self._half, planes, out=whitened)
        # Products of all columns: products of slices are several times slower.
        products = np.swapaxes(rows, 1, 2) @ rows
        normal = products[:, :c, :c]
        inverse = np.linalg.inv(normal)
        values = np.einsum('kij,kj->ki', inverse, products[:, :c, c])
        left = (rows @ np.insert(-values, c, 1.0, axis=1)[..., np.newaxis])[..., 0]
        variances = np.einsum('kn,kn->k', left, left) / self.freedom + _FINEST**2
        each = self.freedom * np.log(variances) + self._logs + np.linalg.slogdet(normal)[1]
        total = float(np.logaddexp.reduce(-0.5 * each))
        weights = np.exp(-0.5 * each - total)
        unknown = np.diagonal(inverse, axis1=1, axis2=2) @ self.prior**2
        return Likelihood(
            deviance=-2.0 * total,
            weights=weights,
            variances=variances,
            values=values,
            covariances=variances[:, np.newaxis, np.newaxis] * inverse,
            residuals=left,
            known=c - float(weights @ unknown),
        )


def covariance(moved: FloatArray, ratio: FloatArray) -> FloatArray:
    """Return the covariance (n, n) in a plane over sigma^2, from depth and guide (n, 3) [m]."""
    d = (moved[:, 0] - moved[:, 0].min()) / _REACH
    low, high = np.minimum(d[:, np.newaxis], d), np.maximum(d[:, np.newaxis], d)
    wander = 0.5 * low**2 * (3.0 * high - low)
    steps = np.diff(moved[:, 1:], axis=0, prepend=moved[:1, 1:])
    travel = np.cumsum(np.hypot(*steps.T)) / _TRAVEL
    response = np.minimum(travel[:, np.newaxis], travel)
    decay = np.exp(-_REACH * d / _SHALLOW)
    entry = np.outer(decay, decay) * np.exp(-_REACH * (high - low) / _CORRELATED)
    parts = zip(ratio, (wander, np.outer(d, d), response, entry), strict=True)
    return np.asarray(np.eye(len(d)) + sum(one**2 * part for one, part in parts))


def variances(ratios: FloatArray) -> FloatArray:
    """Return path noise [rad^2/m] and variance of slopes [rad^2], over sigma^2 [m^2]."""
    return np.asarray(ratios[:, :2] ** 2 * np.array([3.0 / _REACH**3, 1.0 / _REACH**2]))


def _whitening(covariance: FloatArray) -> tuple[FloatArray, float]:
    """Return the matrix (n, n) to white residuals without offset, and its log determinant."""
    lower = np.linalg.cholesky(covariance)
    half = np.linalg.inv(lower)
    one = half.sum(axis=1)
    square = float(one @ one)
    log = 2.0 * float(np.log(np.diag(lower)).sum()) + float(np.log(square))
    return half - np.outer(one / square, one @ half), log
