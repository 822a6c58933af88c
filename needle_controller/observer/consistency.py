"""Whether errors of an estimate are as large as it says."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import inf, nan

from scipy.special import chdtri


@lru_cache(maxsize=64)
def _far(degrees: int) -> float:
    """Return the ratio that chance exceeds once in a million cases."""
    return float(chdtri(degrees, 1e-6)) / degrees


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """
    Whether errors are as large as the filter says: squares of errors over their variances.

    Attributes
    ----------
    ratio : float
        Their mean over all degrees of freedom; 1 in a filter that is consistent.
    low, high : float
        Band of chi^2 that holds it with 95 %.
    degrees : int
        Degrees of freedom; without any the ratio is not a number.

    """

    ratio: float
    low: float
    high: float
    degrees: int

    @classmethod
    def of(cls, total: float, degrees: int) -> Consistency:
        """
        Judge a sum of NIS or NEES.

        Parameters
        ----------
        total : float
            The sum.
        degrees : int
            Number of measurements (NIS), or of runs times 2 n (NEES).

        Returns
        -------
        Consistency
            The sum over its degrees of freedom, with the band.

        """
        if degrees == 0:
            return cls(ratio=nan, low=0.0, high=inf, degrees=0)
        low, high = (float(chdtri(degrees, tail)) / degrees for tail in (0.975, 0.025))
        return cls(ratio=float(total) / degrees, low=low, high=high, degrees=degrees)

    @property
    def doubtful(self) -> bool:
        """Whether errors are far larger than said: by chance once in a million cases."""
        return self.degrees > 0 and self.ratio > _far(self.degrees)

    @property
    def holds(self) -> bool:
        """Whether the ratio is within the band; with no measurements it is."""
        return self.degrees == 0 or self.low <= self.ratio <= self.high
