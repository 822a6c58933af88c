# SPDX-License-Identifier: Apache-2.0
"""Search the constants of the terms `decay` and `stribeck`, in which the force is not linear."""

from dataclasses import replace
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.regression import LARGEST_CONDITION
from needle_identification.friction.design import Design
from needle_identification.friction.settings import FrictionSettings
import numpy as np

_DECAY_TIMES: Final = np.geomspace(1 / 32, 1 / 2, 9)  # tried, of the recording
_GRID: Final = 9  # speeds tried from the slowest to half the fastest, then around the best
_REFINED: Final = 4  # grids
_CLEAR: Final = 20.0  # explained force over its variance, from which all samples are used

#: Number of constants tried for a term (Bonferroni).
TRIED: Final = {'decay': len(_DECAY_TIMES), 'stribeck': _REFINED * _GRID}


def with_decay_time(design: Design, residual: FloatArray) -> Design:
    """Set the time constant of the term `decay` to the one that explains most of the residual."""
    signals, parts = design.signals, design.parts
    time = parts.means(signals.time - signals.time[0])
    times = _DECAY_TIMES * (signals.time[-1] - signals.time[0])
    x = parts.means(design.regressors(signals.settings.terms))
    along, power = _beside(x, np.exp(-time / times[:, None]).T, parts.means(residual))
    settings = replace(signals.settings, decay_time=float(times[np.argmax(along**2 / power)]))
    return replace(design, signals=replace(signals, settings=settings))


def with_stribeck_speed(design: Design) -> Design:
    """Set the speed of the term `stribeck` to the measured speed that explains most force."""
    signals, parts = design.signals, design.parts
    terms = tuple(term for term in signals.settings.terms if term != 'stribeck')
    velocity = parts.means(design.velocity)
    low, high = float(np.abs(velocity).min()), 0.5 * float(np.abs(velocity).max())
    if not 0.0 < low < high or not terms:
        return design
    x, y = parts.means(design.regressors(terms)), parts.means(signals.force)
    y = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    found, clear = 0.0, False
    for _ in range(_REFINED):
        speeds = np.geomspace(low, high, _GRID)
        columns = (
            parts.means(_breakaway(design.velocity, speeds))
            if clear
            else _breakaway(velocity, speeds)
        )
        along, power = _beside(x, columns, y)
        # The breakaway friction cannot be less than mu_s.
        distinct = (along > 0.0) & (LARGEST_CONDITION**2 * power > (columns**2).sum(axis=0))
        if not distinct.any():
            break
        explained = np.where(distinct, along, 0.0) ** 2 / np.where(distinct, power, 1.0)
        best = int(np.argmax(explained))
        low, found = float(speeds[max(best - 1, 0)]), float(speeds[best])
        high = float(speeds[min(best + 1, _GRID - 1)])
        # The speed changes within a part, which matters if it is known well.
        clear = bool(explained[best] * len(y) > _CLEAR * (y @ y))
    if not found:
        return design
    settings = replace(signals.settings, stribeck_speed=float(f'{found:.3g}'))
    return replace(design, signals=replace(signals, settings=settings))


def _breakaway(velocity: FloatArray, speeds: FloatArray) -> FloatArray:
    ratio = velocity[:, np.newaxis] / speeds
    return np.asarray(np.sign(velocity)[:, np.newaxis] * np.exp(-(ratio**2)))


def speed_option(settings: FrictionSettings) -> str:
    return f'--stribeck-speed {1e3 * settings.stribeck_speed:.6g}mm/s'


def _beside(x: FloatArray, z: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the product of y and each column of z, and its power, (q,), beside the columns x."""
    rest = z - x @ np.linalg.lstsq(x, z, rcond=None)[0]
    return np.asarray(y @ rest), np.asarray((rest**2).sum(axis=0))
