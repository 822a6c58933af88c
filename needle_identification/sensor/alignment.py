# SPDX-License-Identifier: Apache-2.0
"""Align a sensor recording with its true position: clocks, delay, units and axes."""

from itertools import permutations, product
from math import log10, sqrt
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.recordings.recording import SensorRecording
from needle_identification.sensor.truth import TruePath
import numpy as np

DELAYS: Final = (-0.2, 1.0)  #: Range of the delay [s].
_GRID: Final = 0.01  # step of the search for the delay [s], short relative to motions
_ALIGNED: Final = 5000  # largest number of samples of this search

_CLOCKS: Final = 60.0  # largest difference of clocks that is searched [s]
_STEP: Final = 0.05  # step of this search [s]
_FEW: Final = 1000  # largest number of samples of this search
_PART: Final = 0.5  # smallest part of the samples, of the largest, that a difference covers
_BETTER: Final = 0.25  # largest ratio of the mean square errors with other clocks
_UNEXPLAINED: Final = 0.2  # largest part of the motion that they leave

#: Factors of wrong units, and the largest difference of decimal logarithms.
_UNITS: Final = {1e3: '[mm]', 1e2: '[cm]', 1e-3: '[m], with the true position in mm'}
_SIMILAR: Final = 0.3
_EXCHANGED: Final = 5.0  # ratio of residuals above which axes are exchanged
_BIASED: Final = 2e-3  # smallest residual of exchanged axes [m]
_EQUAL: Final = 1.5  # ratio of residuals up to which fewer changes of axes are preferred


def covered(one: SensorRecording, path: TruePath) -> BoolArray:
    """Return which samples have a true position at all delays of the search."""
    if not path.moves:
        return np.ones(len(one.time), dtype=np.bool_)
    return path.covers(one.time - DELAYS[1], one.time - DELAYS[0])


def clock_offset(one: SensorRecording, path: TruePath) -> float:
    """Return the delay [s] beyond the range of delays that fits clearly better, else 0."""
    if not path.moves:
        return 0.0
    every = -(-len(one.time) // _FEW)
    time, tip = one.time[::every], one.tip[::every]

    def unexplained(delays: FloatArray) -> FloatArray:
        """Return the part of the motion that each delay leaves; infinite for few samples."""
        left, counts = np.full(len(delays), np.inf), np.zeros(len(delays))
        for row, delay in enumerate(delays.tolist()):
            at = time - delay
            inside = path.covers(at, at)
            counts[row] = np.count_nonzero(inside)
            true, measured = path.at(at[inside]), tip[inside]
            if counts[row] > 1 and (power := float(true.var(axis=0).sum())) > 0.0:
                left[row] = (measured - true).var(axis=0).sum() / power
        left[counts < _PART * counts.max()] = np.inf
        return left

    wide = np.arange(-_CLOCKS, _CLOCKS, _STEP)
    left = unexplained(wide)
    within = (wide > DELAYS[0] - _STEP) & (wide < DELAYS[1] + _STEP)
    best = float(wide[left.argmin()])
    if within[left.argmin()]:
        return 0.0
    others, usual = np.arange(best - _STEP, best + _STEP, _GRID), np.arange(*DELAYS, _GRID)
    # Both parts in one call, so that the number of covered samples is compared.
    left = unexplained(np.concatenate([others, usual]))
    found = int(left[: len(others)].argmin())
    is_better = left[found] < min(_BETTER * left[len(others) :].min(), _UNEXPLAINED)
    return float(others[found]) if is_better else 0.0


def aligned(one: SensorRecording, path: TruePath, usable: BoolArray) -> float:
    """Return the delay of least errors [s]; reject other units, exchanged or reversed axes."""
    every = -(-int(np.count_nonzero(usable)) // _ALIGNED)
    time, tip, k = one.time[usable][::every], one.tip[usable][::every], len(one.axes)
    delays = np.arange(*DELAYS, _GRID) if path.moves else np.zeros(1)
    # An offset between the frames of two sensors is a bias, and may be large.
    center = tip.mean(axis=0) if path.moves else np.zeros(k)
    tip = tip - center
    #: Mean square errors by delay, axis, true axis, and sign [m^2].
    squares = np.empty((len(delays), k, k, 2))
    for row, delay in zip(squares, delays.tolist(), strict=True):
        true = path.at(time - delay)
        true -= true.mean(axis=0) if path.moves else 0.0
        for column, sign in enumerate((1.0, -1.0)):
            apart = tip[:, :, np.newaxis] - sign * true[:, np.newaxis, :]
            row[:, :, column] = np.mean(apart**2, axis=0)
    _check_units(one, tip, true)
    _check_axes(one, squares)
    own = np.trace(squares[..., 0], axis1=1, axis2=2)
    return float(delays[int(np.argmin(own))])


def _check_axes(one: SensorRecording, squares: FloatArray) -> None:
    """Reject positions that match the true ones much better with exchanged or reversed axes."""
    k = len(one.axes)
    axes, own = range(k), list(range(k))
    found = []
    for order, signs in product(permutations(axes), product((0, 1), repeat=k)):
        size = sqrt(float(squares[:, axes, order, signs].sum(axis=1).min()) / k)
        changes = sum(i != j for i, j in zip(own, order, strict=True)) + sum(signs)
        found.append((changes, size, order, signs))
    # The first one is without changes.
    best, expected = min(size for _, size, *_ in found), found[0][1]
    if expected <= max(_EXCHANGED * best, _BIASED):
        return
    _, size, order, signs = min(one for one in found if one[1] <= _EQUAL * best)
    names = ', '.join(f'{"-" * sign}{one.axes[j]}' for sign, j in zip(signs, order, strict=True))
    raise IdentificationError(
        f'{one.name}: measured {", ".join(one.axes)} match the true {names}, to '
        f'{1e3 * size:.3g} mm instead of {1e3 * expected:.3g} mm: name the axes in --columns or '
        '--truth-columns'
    )


def _check_units(one: SensorRecording, tip: FloatArray, true: FloatArray) -> None:
    measured, size = (sqrt(float(np.mean(part**2))) for part in (tip, true))
    for factor, unit in _UNITS.items():
        if min(measured, size) > 0.0 and abs(log10(measured / size / factor)) < _SIMILAR:
            raise IdentificationError(
                f'{one.name}: measured positions are {measured / size:.3g} times the true '
                f'positions: perhaps their unit is {unit}; name it in --columns or '
                '--truth-columns'
            )
