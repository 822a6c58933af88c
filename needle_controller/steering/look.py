"""A look at the tip while the needle rests: many readings, one position."""

from __future__ import annotations

from math import sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
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
        Mean position of the tip, x, y, z [m].
    error : float
        Standard error of the mean along x or z, as the readings scatter [m]; 0 for few of them.
    readings : int
        How many count.
    frozen : bool
        Whether they are all the same, and more than a few.

    """

    tip: FloatArray
    error: float
    readings: int
    frozen: bool


class Look:
    """
    Collects the readings of a look.

    Parameters
    ----------
    since, until : int
        Stamps from which on, and up to which, readings belong to it [ns].

    """

    def __init__(self, since: int, until: int) -> None:
        self.since, self.until = since, until
        self._readings: list[tuple[float, ...]] = []

    def take(self, stamp: int, tip: tuple[float, ...]) -> bool:
        """
        Take a reading if it belongs to the look.

        Parameters
        ----------
        stamp : int
            Its stamp [ns].
        tip : tuple of float
            Position of the tip, x, y, z [m].

        Returns
        -------
        bool
            Whether the look has ended with it.

        """
        if self.since < stamp <= self.until:
            self._readings.append(tip)
        return stamp >= self.until

    def seen(self, noise: float) -> Seen | None:
        """
        Return the mean without outliers.

        Parameters
        ----------
        noise : float
            Deviation of a look as it is believed [m]: less than it makes no outlier.

        Returns
        -------
        Seen or None
            The mean; None if there are no readings.

        """
        if not self._readings:
            return None
        tips = np.array(self._readings)
        if len(tips) >= _FEW:
            middle = np.median(tips, axis=0)
            off = np.abs(tips - middle)
            scatter = np.maximum(_NORMAL * np.median(off, axis=0), noise * sqrt(len(tips)))
            tips = tips[(off <= _OUTLIER * scatter).all(axis=1)]
            if len(tips) == 0:
                tips = middle[np.newaxis]
        count = len(tips)
        error = 0.0
        if count >= _FEW:
            error = float(tips[:, [0, 2]].std(axis=0, ddof=1).max()) / sqrt(count)
        frozen = count >= _FEW and bool((tips == tips[0]).all())
        return Seen(tips.mean(axis=0), error, count, frozen)
