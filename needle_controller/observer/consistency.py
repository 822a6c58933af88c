# SPDX-License-Identifier: Apache-2.0
"""Chi-squared consistency test of estimation errors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import inf, nan

from scipy.special import chdtri


@lru_cache(maxsize=64)
def _far(degrees: int) -> float:
    """Return the ratio that is exceeded by chance with a probability of 1e-6."""
    return float(chdtri(degrees, 1e-6)) / degrees


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """Consistency of errors with their variances: mean normalized squared error."""

    ratio: float  #: mean squared error over variance per degree of freedom; 1 if consistent
    low: float  #: lower end of the 95 % band of chi^2 for the ratio
    high: float  #: upper end
    degrees: int  #: degrees of freedom; with 0 the ratio is nan

    @classmethod
    def of(cls, total: float, degrees: int) -> Consistency:
        """Compute ratio and band of a sum of NIS, or of NEES with 2 n degrees for each run."""
        if degrees == 0:
            return cls(ratio=nan, low=0.0, high=inf, degrees=0)
        low, high = (float(chdtri(degrees, tail)) / degrees for tail in (0.975, 0.025))
        return cls(ratio=float(total) / degrees, low=low, high=high, degrees=degrees)

    @property
    def doubtful(self) -> bool:
        """Whether the ratio is too large, by chance with a probability of 1e-6."""
        return self.degrees > 0 and self.ratio > _far(self.degrees)

    @property
    def holds(self) -> bool:
        """Whether the ratio is within the band; true without measurements."""
        return self.degrees == 0 or self.low <= self.ratio <= self.high
