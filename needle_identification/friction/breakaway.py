# SPDX-License-Identifier: Apache-2.0
"""
Estimate the breakaway force of the needle, section 3.2.2.2 of the paper.

The base pushes with a rising force until the needle moves. A straight line is fitted to the force
of the last 0.3 s at rest and evaluated at the onset of motion.
"""

from collections.abc import Sequence
from math import ceil, hypot, sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import ParameterEstimate, with_half_width
from needle_identification.estimation.regression import regress
from needle_identification.friction.design import Design
from needle_identification.friction.filtering import CORRELATION_LENGTH
import numpy as np
from scipy.special import stdtrit

_RISING: Final = 0.3  # time before the motion in which the rise of the force is measured [s]
_SMALLEST_RISE: Final = 0.05  # smallest rise, as a fraction of the force and of mu_s
_CLEAR_RISE: Final = 5.0  # smallest slope of the rise [standard errors]
_WINDOW_PART: Final = 0.4  # part of the usual correlation length, for a short rise
_UNKNOWN: Final = ParameterEstimate(name='breakaway_force', symbol='f_b', unit='N')


def breakaway_force(
    design: Design, parameters: Sequence[ParameterEstimate]
) -> ParameterEstimate | None:
    """Return the mean rising force [N] at which a resting needle began to move, if any."""
    starts = np.flatnonzero((design.regime[1:] != 0.0) & (design.regime[:-1] == 0.0)) + 1
    changes = np.flatnonzero(np.diff(design.stroke)) + 1
    found = []
    coulomb = [p.value for p in parameters if p.name == 'coulomb_friction' and p.determined]
    least = _SMALLEST_RISE * max(coulomb, default=0.0)
    for start in starts:
        before, after = changes[changes < start], changes[changes > start]
        rest = int(before[-1]) if len(before) else 0
        end = int(after[0]) if len(after) else len(design.velocity)
        push = _push(design, (rest, int(start), end), least)
        if push is not None:
            found.append((*push, design.regime[start]))
    if not found:
        return None
    values, errors, half_widths, signs = np.array(found).T
    value, count, bias = float(values.mean()), len(found), float(signs.mean())
    error = sqrt(float(errors @ errors)) / count
    half_width = sqrt(float(half_widths @ half_widths)) / count
    for parameter in parameters:
        if parameter.name == 'offset' and parameter.determined:
            value -= bias * parameter.value
            error = hypot(error, bias * parameter.error)
            half_width = hypot(half_width, bias * (parameter.interval[1] - parameter.value))
    return with_half_width(_UNKNOWN, value, error, half_width)


def _push(
    design: Design, span: tuple[int, int, int], least: float
) -> tuple[float, float, float] | None:
    """Return breakaway force, error and half interval [N]; span: rest, motion, its end."""
    signals = design.signals
    cutoff = signals.settings.cutoff
    correlation = ceil(_WINDOW_PART * CORRELATION_LENGTH / cutoff / signals.period)
    rest, start, end = span
    longest = round(_RISING / signals.period)
    sign = float(design.regime[start])
    early = max(rest + signals.half_filter, start - longest)
    still = start - signals.margin
    if min(still - early, 2 * (end - start)) < correlation:
        return None
    if sign * (signals.force[still] - signals.force[early]) <= 0.5 * least:
        return None
    around = (max(rest, start - longest), start, min(end, start + longest))
    onset, onset_error = _onset(design, around)
    last = round((onset - signals.time[0]) / signals.period) - signals.half_filter
    first = max(rest + signals.half_filter, last - longest)
    if last - first < correlation:
        return None
    elapsed = signals.time[first:last] - onset
    columns = np.column_stack([np.ones_like(elapsed), elapsed])
    try:
        line = regress(columns, signals.force[first:last], correlation=correlation)
    except IdentificationError:
        return None
    value, slope = sign * line.values
    rise = slope * (last - first) * signals.period
    if not (slope > _CLEAR_RISE * line.errors[1] and rise > max(_SMALLEST_RISE * value, least)):
        return None
    error = hypot(float(line.errors[0]), slope * onset_error)
    return float(value), error, error * float(stdtrit(line.effective_samples - 2.0, 0.975))


def _onset(design: Design, span: tuple[int, int, int]) -> tuple[float, float]:
    """Return the onset of motion [s], fitted as a step and a ramp of velocity, and its error."""
    signals = design.signals
    first, start, end = span
    time, velocity = signals.time[first:end], design.velocity[first:end]
    candidates = signals.time[first : start + 1]
    misfits = np.array(
        [_misfit(time[k:] - time[k], velocity[k:]) for k in range(len(candidates))]
    ) + np.concatenate([[0.0], np.cumsum(velocity**2)[: len(candidates) - 1]])
    best = int(np.argmin(misfits))
    # The length of the filter counts as one independent sample.
    independent = max(len(time) / (2 * signals.half_filter + 1) - 3.0, 1.0)
    close = misfits <= misfits[best] * (1.0 + 4.0 / independent)
    error = signals.period * max(np.count_nonzero(close) / 4.0, 1.0 / sqrt(12.0))
    # The onset lies between this sample and the previous sample.
    return float(candidates[best]) - 0.5 * signals.period, float(error)


def _misfit(time: FloatArray, values: FloatArray) -> float:
    centered, rest = time - time.mean(), values - values.mean()
    total = float(centered @ centered)
    explained = float(centered @ rest) ** 2 / total if total else 0.0
    return float(rest @ rest) - explained
