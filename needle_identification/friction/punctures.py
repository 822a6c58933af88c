# SPDX-License-Identifier: Apache-2.0
"""
Detect punctures: drops of the force while the needle enters new tissue.

A membrane or skin yields at once: the force falls within a few milliseconds. The mean forces
before and after each sample, over one correlation length of the filter and without the fitted
friction, are compared; a puncture is a drop clearly above the usual changes by noise and tissue.
"""

from contextlib import suppress
from dataclasses import dataclass
from math import hypot, sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import ParameterEstimate, with_half_width
from needle_identification.estimation.memory import stretches
from needle_identification.estimation.regression import Regression
from needle_identification.friction.design import Design
from needle_ros.quantities import DEVIATION_OVER_MEDIAN, NORMAL
import numpy as np

_CLEAR: Final = 8.0  # smallest drop [standard deviations of other changes of the force]
_UNKNOWN_FRICTION: Final = 0.5  # model error of a change of friction, as a fraction

_DEPTH: Final = ParameterEstimate(name='puncture_depth', symbol='s_p', unit='m')
_DROP: Final = ParameterEstimate(name='puncture_force', symbol='f_p', unit='N')


@dataclass(frozen=True, slots=True, kw_only=True)
class Puncture:
    """Puncture of a tissue boundary."""

    time: float  #: on the clock of the recording [s]
    depth: ParameterEstimate  #: insertion depth [m]
    drop: ParameterEstimate  #: drop of the force [N]


def find_punctures(design: Design, fit: Regression) -> tuple[Puncture, ...]:
    signals = design.signals
    inward = design.fresh & (design.regime > 0.0) & ~signals.lost
    width, reach = signals.correlation, signals.half_filter
    if np.ptp(signals.depth) == 0.0:
        return ()
    terms = signals.settings.terms
    if 'viscous' not in terms:
        # The force falls with the speed all the same.
        with suppress(IdentificationError):
            fit, terms = design.solve((*terms, 'viscous'), 'ordinary'), (*terms, 'viscous')
    if fit.determined.all():
        force = signals.force - design.regressors(terms) @ fit.values
    else:
        # The friction is known where it was fitted.
        force, inward = fit.residual, inward & design.used
    explained = signals.force - force
    drops, others = np.full(len(force), np.nan), np.zeros(len(force))
    inner = stretches(inward) + np.array([signals.margin, -signals.margin])
    for start, end in inner:
        middle = np.arange(start + width + reach, end - width - reach)
        if not len(middle):
            continue
        at = middle - start
        for values, kept in ((force, drops), (explained, others)):
            sums = np.concatenate([[0.0], np.cumsum(values[start:end])])
            before = sums[at - reach] - sums[at - reach - width]
            after = sums[at + reach + width] - sums[at + reach]
            kept[middle] = (before - after) / width
    known = np.isfinite(drops)
    if np.count_nonzero(known) < 4 * width:
        return ()
    usual = float(np.median(drops[known]))
    noise = DEVIATION_OVER_MEDIAN * float(np.median(np.abs(drops[known] - usual)))
    found = []
    # The threshold includes the model error of friction at velocity changes.
    clear = np.maximum(usual + _CLEAR * noise, _UNKNOWN_FRICTION * np.abs(others))
    left = np.where(known & (drops > np.maximum(clear, 0.0)), drops, 0.0)
    while noise > 0.0 and left.any():
        peak = int(np.argmax(left))
        one = _puncture(design, force, peak, noise)
        found += [one] if one.drop.interval[0] > 0.0 else []
        left[max(0, peak - 2 * (width + reach)) : peak + 2 * (width + reach)] = 0.0
    return tuple(sorted(found, key=lambda one: one.time))


def _puncture(design: Design, force: FloatArray, peak: int, noise: float) -> Puncture:
    signals = design.signals
    width, reach = signals.correlation, signals.half_filter
    around = slice(peak - width // 2 - reach, peak + width // 2 + reach)
    at = around.start + int(np.argmin(np.gradient(force[around])))
    before, after = force[at - reach - width : at - reach], force[at + reach : at + reach + width]
    # The tissue may load the needle up to the puncture: extrapolate the line before it.
    time = np.arange(-width, 0) - reach
    level = np.polyfit(time, before, 1)[1]
    drop = float(level - after.mean())
    # Variance of two means, with extrapolation by half a window and half the filter.
    error = noise * sqrt(1.0 + 1.5 * (1.0 + 2.0 * reach / width) ** 2)
    place = hypot(reach * signals.period * float(design.velocity[at]), 1e-6) / sqrt(3.0)
    return Puncture(
        time=float(signals.time[at]),
        depth=with_half_width(_DEPTH, float(design.depth[at]), place, NORMAL * place),
        drop=with_half_width(_DROP, drop, error, NORMAL * error),
    )
