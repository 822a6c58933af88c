"""A look at the tip, while the needle rests or on its way: many readings, one position."""

from __future__ import annotations

from math import sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray
import numpy as np

#: A reading farther than this from the median, in standard deviations, is an outlier.
_OUTLIER: Final = 5.0

#: Standard deviation of a normal distribution over the median of its absolute deviations.
_NORMAL: Final = 1.4826

#: Fewer readings have no outliers.
_FEW: Final = 3


class Seen(NamedTuple):
    """
    What a look has seen.

    Attributes
    ----------
    tip : ndarray, shape (3,)
        Position of the tip, x, y, z [m].
    error : float
        Standard error of it along x or z, as the readings scatter [m]; 0 for few of them.
    readings : int
        How many count.
    frozen : bool
        Whether they are all the same in x and z, and more than a few.

    """

    tip: FloatArray
    error: float
    readings: int
    frozen: bool


class Look:
    """Readings of the tip at a depth, or on the way to it."""

    def __init__(self) -> None:
        self._readings: list[tuple[float, ...]] = []

    def take(self, tip: tuple[float, ...], before: float = 0.0) -> None:
        """
        Take a reading.

        Parameters
        ----------
        tip : tuple of float
            Position of the tip, x, y, z [m].
        before : float
            How far before the depth the needle was then [m].

        """
        self._readings.append((*tip, before))

    def seen(self, noise: float) -> Seen | None:
        """
        Return the mean without outliers; on the way, a line through them at the depth.

        Parameters
        ----------
        noise : float
            Deviation of a look as it is believed [m]: less than it makes no outlier.

        Returns
        -------
        Seen or None
            The position; None if there are no readings.

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
                return Seen(_fitted(basis, tips)[0], 0.0, 1, frozen=False)
        tips, basis = tips[kept], basis[kept]
        found, count = np.linalg.lstsq(basis, tips, rcond=None)[0], len(tips)
        left, error = tips - basis @ found, 0.0
        free = count - basis.shape[1]
        if free > 1:
            # At the end of a line it is twice as far as of a mean.
            scale = basis.shape[1] / sqrt(free * count)
            error = float(np.sqrt((left[:, [0, 2]] ** 2).sum(axis=0)).max()) * scale
        across = tips[:, [0, 2]]
        frozen = count >= _FEW and bool((across == across[0]).all())
        tip = found[0]
        if frozen:
            # Exactly, so that looks can be compared.
            tip[[0, 2]] = across[0]
        return Seen(tip, error, count, frozen)


def _fitted(basis: FloatArray, tips: FloatArray) -> FloatArray:
    """Return median, or a line by medians: through those of the first and of the last half."""
    if basis.shape[1] == 1:
        return np.median(tips, axis=0)[np.newaxis]
    order = np.argsort(basis[:, 1])
    halves = np.array_split(order, 2)
    (one, other) = (np.median(tips[half], axis=0) for half in halves)
    (at, to) = (float(np.median(basis[half, 1])) for half in halves)
    slope = (other - one) / (to - at) if to > at else np.zeros(3)
    return np.array([one - at * slope, slope])
