# SPDX-License-Identifier: Apache-2.0
"""Fraction of lost samples and duration of bursts, from the gaps between samples."""

from math import exp, inf, log, log1p, nan, sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import estimated, ParameterEstimate
import numpy as np
from scipy.special import betaincinv

_REGULAR: Final = 0.25  # largest deviation of a step from a multiple of the period [periods]
_IRREGULAR: Final = 0.05  # largest fraction of steps beyond it
_BURSTS: Final = 2.6  # memory of losses that are not independent [standard errors]
_NO_BURSTS: Final = ParameterEstimate(name='dropout_time', symbol='T', unit='s')


def binomial_interval(count: int, total: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a probability (Clopper and Pearson 1934)."""
    low = float(betaincinv(count, total - count + 1, 0.025)) if count else 0.0
    high = float(betaincinv(count + 1, total - count, 0.975)) if count < total else 1.0
    return low, high


def fit_losses(time: FloatArray) -> tuple[ParameterEstimate, ParameterEstimate]:
    """Return the fraction of lost samples and the duration of a burst, at times [s], (n,)."""
    # A Markov process; nan without a regular period, and no duration for independent losses.
    steps = np.diff(time)
    period = float(np.median(steps))
    # Drift of the clocks does not add up, since each step is rounded by itself.
    each = np.maximum(np.rint(steps / period), 1.0)
    if np.mean(np.abs(steps / period - each) > _REGULAR) > _IRREGULAR:
        return _dropout(nan, inf, (-inf, inf)), _NO_BURSTS
    bursts, lost = int(np.count_nonzero(each > 1.0)), int(each.sum()) - len(steps)
    total = len(time) + lost
    if not bursts:
        return _dropout(0.0, 1.0 / total, binomial_interval(0, total)), _NO_BURSTS
    # Transitions from received and from lost samples: a burst ends once.
    begin, end = bursts / len(steps), bursts / lost
    fraction, kept = begin / (begin + end), 1.0 - begin - end
    variance = begin * (1.0 - begin) / len(steps), end * (1.0 - end) / lost
    error = fraction * sqrt(
        ((1.0 - fraction) ** 2) * (variance[0] / begin**2 + variance[1] / end**2)
    )
    if kept <= _BURSTS * sqrt(sum(variance)):
        fraction = lost / total
        error = sqrt(fraction * (1.0 - fraction) / total)
        return _dropout(fraction, error, binomial_interval(lost, total)), _NO_BURSTS
    # The logit of a fraction is nearly normal.
    logit, half = log(fraction) - log1p(-fraction), 1.96 * error / (fraction * (1.0 - fraction))
    low, high = (1.0 / (1.0 + exp(-at)) for at in (logit - half, logit + half))
    duration = -period / ((1.0 - fraction) * log(kept))
    # Derivatives of the logarithm of the duration.
    whole = (begin + end) ** 2
    by_begin = end / whole / (1.0 - fraction) + 1.0 / (kept * log(kept))
    by_end = -begin / whole / (1.0 - fraction) + 1.0 / (kept * log(kept))
    log_error = sqrt(by_begin**2 * variance[0] + by_end**2 * variance[1])
    ends = duration * exp(-1.96 * log_error), duration * exp(1.96 * log_error)
    burst = estimated('dropout_time', 'T', 's', duration, duration * log_error, ends)
    return _dropout(fraction, error, (low, high)), burst


def _dropout(value: float, error: float, interval: tuple[float, float]) -> ParameterEstimate:
    return estimated('dropout', 'p', '1', value, error, interval)
