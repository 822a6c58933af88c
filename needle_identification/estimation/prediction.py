# SPDX-License-Identifier: Apache-2.0
r"""
Predict each recording by the mean coefficients of the others.

With the mean products of regressors :math:`G = X^T X / n`, of regressors and residuals
:math:`c = X^T r / n`, and the power p of the residuals, another set of coefficients, d less than
the recording's own, has the mean squared error :math:`p + 2 c^T d + d^T G d`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
import numpy as np
from scipy.special import chdtri

WORSE: Final = 1.5  #: error of predicted recordings over the residuals for a warning


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingPrediction:
    """Error of recordings predicted from all others, root mean square [N]."""

    rms: float  #: of the force
    interval: tuple[float, float]  #: 95 % interval, with one degree of freedom per recording
    residual: float  #: of the fit to each recording itself

    @property
    def warning(self) -> str:
        """Warning if the prediction is clearly worse than the fit, or an empty string."""
        if not self.rms > WORSE * self.residual:
            return ''
        return (
            f'the force of a recording predicted from the others is wrong by {self.rms:.3g} N, '
            f'its own fit by {self.residual:.3g} N: the recordings differ'
        )


class Moments(NamedTuple):
    """Coefficients (k,) of a recording, mean products (k, k), (k,), and power of the residuals."""

    values: FloatArray
    gram: FloatArray
    cross: FloatArray
    power: float


def moments(regressors: FloatArray, residual: FloatArray, values: FloatArray) -> Moments:
    """Return the moments of a fit from regressors (n, k), residuals (n,) and coefficients (k,)."""
    n = len(residual)
    gram, cross = (np.asarray(regressors.T @ one / n) for one in (regressors, residual))
    return Moments(values, gram, cross, float(residual @ residual) / n)


def predicted(recordings: Sequence[Moments]) -> RecordingPrediction | None:
    """Predict each recording by the mean of the others; None for one, or undetermined ones."""
    known = [one for one in recordings if np.isfinite(one.values).all()]
    if len(known) < 2:
        return None
    total = np.sum([one.values for one in known], axis=0)
    squares = []
    for one in known:
        off = one.values - (total - one.values) / (len(known) - 1)
        squares.append(one.power + 2.0 * float(one.cross @ off) + float(off @ one.gram @ off))
    rms = sqrt(float(np.mean(squares)))
    low, high = (rms * sqrt(len(known) / float(chdtri(len(known), p))) for p in (0.025, 0.975))
    return RecordingPrediction(
        rms=rms, interval=(low, high), residual=sqrt(float(np.mean([one.power for one in known])))
    )
