# SPDX-License-Identifier: Apache-2.0
"""Planned path of the tip, which a steering law follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from needle_dynamics.arrays import FloatArray
import numpy as np

_SHORTEST: Final = 1e-3  #: Shortest first step [m].


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedPath:
    """Path of the tip by depth, and guide setpoints that lead along it; x and z [m]."""

    depths: FloatArray  #: depths of the steps [m], shape (n + 1,)
    tips: FloatArray  #: planned position of the tip at each depth, shape (n + 1, 2)
    guide: FloatArray  #: planned position of the guide in each step, shape (n, 2)

    def since(self, depth: float) -> PlannedPath:
        """Return the path from a depth on [m], with a first step of at least 1 mm."""
        first = int(np.searchsorted(self.depths, depth + _SHORTEST))
        first = min(first, len(self.depths) - 1)
        tip = [np.interp(depth, self.depths, one) for one in self.tips.T]
        return PlannedPath(
            depths=np.append(depth, self.depths[first:]),
            tips=np.vstack([tip, self.tips[first:]]),
            guide=self.guide[max(first - 1, 0) :],
        )
