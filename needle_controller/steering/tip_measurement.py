# SPDX-License-Identifier: Apache-2.0
"""Averaged tip measurement: one position from many readings, at rest or during motion."""

from math import sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray
import numpy as np

_OUTLIER: Final = 5.0  #: Distance of an outlier from the median, in standard deviations.
_NORMAL: Final = 1.4826  #: Standard deviation over the median of absolute deviations.
_FEW: Final = 3  #: Least number of readings for outlier rejection.


class AveragedTipMeasurement(NamedTuple):
    """Result of an averaged tip measurement."""

    tip: FloatArray  #: position of the tip, x, y, z [m]
    error: float  #: standard error along x or z, from the scatter of the readings [m]; 0 for few
    readings: int  #: number of valid readings
    frozen: bool  #: whether at least three readings are identical in x and z


class TipMeasurements:
    """Averaged tip measurement at a depth, or during the motion through it."""

    def __init__(self) -> None:
        self._readings: list[tuple[float, ...]] = []

    def take(self, tip: tuple[float, ...], before: float = 0.0) -> None:
        """Add a reading of the tip, x, y, z [m], at a distance before the depth [m]."""
        self._readings.append((*tip, before))

    def average(self, noise: float) -> AveragedTipMeasurement | None:
        """
        Return the mean without outliers, or during motion a fitted line at the depth; or None.

        ``noise`` is the least standard deviation of a measurement in the outlier test [m].
        """
        if not self._readings:
            return None
        rows = np.array(self._readings)
        tips, before = rows[:, :3], rows[:, 3]
        basis = np.ones((len(tips), 1))
        if len(tips) > _FEW and np.ptp(before) > 0.0:
            basis = np.column_stack([basis, before])
        kept: BoolArray = np.ones(len(tips), dtype=np.bool_)
        if len(tips) >= _FEW:
            off = np.abs(tips - basis @ _fitted(basis, tips))
            scatter = np.maximum(_NORMAL * np.median(off, axis=0), noise * sqrt(len(tips)))
            kept = np.asarray((off <= _OUTLIER * scatter).all(axis=1))
            if kept.sum() < basis.shape[1]:
                return AveragedTipMeasurement(_fitted(basis, tips)[0], 0.0, 1, frozen=False)
        tips, basis = tips[kept], basis[kept]
        found, count = np.linalg.lstsq(basis, tips, rcond=None)[0], len(tips)
        left, error = tips - basis @ found, 0.0
        free = count - basis.shape[1]
        if free > 1:
            # The error at the end of a line is twice the error of a mean.
            scale = basis.shape[1] / sqrt(free * count)
            error = float(np.sqrt((left[:, [0, 2]] ** 2).sum(axis=0)).max()) * scale
        across = tips[:, [0, 2]]
        frozen = count >= _FEW and bool((across == across[0]).all())
        tip = found[0]
        if frozen:
            # Exactly, so that measurements can be compared.
            tip[[0, 2]] = across[0]
        return AveragedTipMeasurement(tip, error, count, frozen)


def _fitted(basis: FloatArray, tips: FloatArray) -> FloatArray:
    """Return the median, or a line through the medians of the first and of the last half."""
    if basis.shape[1] == 1:
        return np.median(tips, axis=0)[np.newaxis]
    order = np.argsort(basis[:, 1])
    halves = np.array_split(order, 2)
    (one, other) = (np.median(tips[half], axis=0) for half in halves)
    (at, to) = (float(np.median(basis[half, 1])) for half in halves)
    slope = (other - one) / (to - at) if to > at else np.zeros(3)
    return np.array([one - at * slope, slope])
