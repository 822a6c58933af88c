# SPDX-License-Identifier: Apache-2.0
"""Check positions of a tip sensor: lost ones that look like measurements, steps, unlike axes."""

from collections.abc import Iterator, Sequence
from math import ceil, exp, log, pi, sqrt
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.sensor.noise import NoiseFit, NoiseLikelihood
import numpy as np

EXACT: Final = 1e-9  #: Largest change of positions that is rounding [m].
_RARE: Final = 1e-3  # probability of a longer run in a whole recording
_HELD: Final = 0.75  # part of the positions that repeat in a log at a higher rate
_COARSE: Final = 1.5  # steps over the noise above which runs last as long as slow noise
_LIKELY: Final = 1.5  # power of the probability of the most likely step: up to here, at most
_CLEARLY: Final = 4.5  # smallest difference of axes [standard errors]
_UNLIKE: Final = 1.25  # smallest ratio of their noise; a warning for less would be idle


def measured_rows(tip: FloatArray) -> tuple[BoolArray, list[str]]:
    """Return which rows of positions (n, k) are measurements, and a sentence for the others."""
    zero = zero_rows(tip)
    frozen = np.zeros_like(zero)
    frozen[~zero], is_held = _repeated(tip[~zero])
    held = 'left out: the log has a higher rate than the sensor'
    words = []
    for lost, what, so in (
        (zero, 'zero', 'counted as lost'),
        (frozen, 'equal to the previous position', held if is_held else 'counted as lost'),
    ):
        places = np.count_nonzero(np.diff(lost.astype(np.int8), prepend=0) > 0)
        if places:
            words.append(
                f'{np.count_nonzero(lost)} positions are {what}, in {places} places: {so}'
            )
    return ~(zero | frozen), words


def zero_rows(tip: FloatArray) -> BoolArray:
    """Return which positions (n, k), NaN if missing, are zeros far from all others: lost."""
    zero = (tip == 0.0).all(axis=1)
    others = tip[~zero & np.isfinite(tip).all(axis=1)]
    if not len(others) or _is_among(others):
        zero[:] = False
    return np.asarray(zero)


def _is_among(tip: FloatArray) -> bool:
    """Return whether zero is a position like the others (n, k)."""
    margin = tip.std(axis=0) + _steps(tip)
    return bool((np.abs(tip).min(axis=0) <= margin).all())


def _repeated(tip: FloatArray) -> tuple[BoolArray, bool]:
    """Return which rows repeat the previous row by no chance, and whether most rows do."""
    noise = np.sqrt(0.5 * np.mean(np.diff(tip, axis=0) ** 2, axis=0))
    if (_steps(tip) > _COARSE * noise).all():
        return np.zeros(len(tip), dtype=np.bool_), False
    starts = np.flatnonzero(np.append(True, (tip[1:] != tip[:-1]).any(axis=1)))
    lengths = np.diff(starts, append=len(tip))
    within = np.arange(len(tip)) - np.repeat(starts, lengths)
    count = np.count_nonzero(lengths > 1)
    # The log has a higher rate than the sensor.
    if count >= _HELD * len(lengths):
        return np.asarray(within > 0), True
    # A run of more than j rows has the probability longer**j, by chance.
    longer = min((count + 2.0 * sqrt(count) + 1.0) / len(lengths), 0.9)
    limit = ceil(_LIKELY * log(_RARE / len(lengths)) / log(longer))
    return np.asarray((np.repeat(lengths, lengths) > limit) & (within > 0)), False


def _steps(tip: FloatArray) -> FloatArray:
    """Return the smallest difference of the positions on each axis [m], (k,)."""
    gaps = [np.diff(np.unique(column)) for column in tip.T]
    return np.array([gap[gap > EXACT].min(initial=np.inf) for gap in gaps])


def axis_warnings(
    axes: Sequence[str], time: FloatArray, tip: FloatArray, errors: FloatArray, fit: NoiseFit
) -> Iterator[str]:
    """Warn of positions (n, k) on a coarse grid, and of axes whose errors have unlike noise."""
    k, moves = len(axes), np.ptp(tip, axis=0) > EXACT
    if not moves.all():
        still = ', '.join(axis for axis, does in zip(axes, moves, strict=True) if not does)
        yield f'positions along {still} never change: stuck, or not measured'
        return
    steps = _steps(tip)
    # The first harmonic of the error of a mean of rounded normal values (Widrow 1996).
    spread = np.maximum(tip.var(axis=0) - steps**2 / 12.0, 0.0)
    off = steps / pi * np.exp(-2.0 * pi**2 * spread / steps**2)
    coarse = off > 0.5 * np.sqrt(np.diag(fit.covariance)[:k])
    if coarse.any():
        named = ', '.join(axis for axis, is_coarse in zip(axes, coarse, strict=True) if is_coarse)
        yield (
            f'positions along {named} are in steps of {1e3 * steps[coarse].max():.3g} mm, coarse '
            f'against the noise: their bias may be off by {1e3 * off[coarse].max():.2g} mm'
        )
        return
    each = [
        NoiseLikelihood(time, column[:, np.newaxis], None).fit(fit.log_ratio, fit.log_time)
        for column in errors.T
    ]
    logs = [one.log_noise for one in each]
    # A difference of two logarithms, each with the variance of half the inverse freedom.
    clear = max(_CLEARLY * sqrt(1.0 / each[0].freedom), log(_UNLIKE))
    if max(logs) - min(logs) > clear:
        each_axis = zip(axes, logs, strict=True)
        sizes = ', '.join(f'{axis} {1e3 * exp(one):.3g} mm' for axis, one in each_axis)
        yield (
            f'the noise differs between the axes, {sizes}: one value for all describes none; '
            '--axes leaves an axis out'
        )
