# SPDX-License-Identifier: Apache-2.0
"""Tissue model along the needle: layered elastic foundation, swelling, damping; equation (7)."""

from dataclasses import dataclass
from itertools import pairwise
from math import expm1, inf

from needle_dynamics.compiled.tissue import Layers
from needle_dynamics.modes import ModeShapes
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant, positive
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Tissue:
    """
    Elastic foundation k(y, t), piecewise constant in depth, optionally swelling.

    A single layer without swelling is the homogeneous tissue (8) of the source.

    """

    starts: tuple[float, ...] = constant((), 'm', 'depths at which the layers begin, the first 0')
    stiffnesses: tuple[float, ...] = constant((), 'N/m^2', 'stiffness of each layer per length')
    swelling: float = constant(
        0.0, '1', 'final relative increase of the stiffness over its value at time 0',
        low=-1.0, open_low=True,
    )  # fmt: skip
    swelling_time: float = positive(1.0, 's', 'time constant of the swelling')

    def __post_init__(self) -> None:
        check_constants(self)
        ordered = all(low < high for low, high in pairwise(self.starts))
        if len(self.starts) != len(self.stiffnesses) or self.starts[:1] != (0.0,) or not ordered:
            raise ParameterError(
                f'layers must start at 0 and go deeper, with one stiffness each, got starts '
                f'{self.starts} and stiffnesses {self.stiffnesses}'
            )

    def growth(self, time: float) -> float:
        """Return the factor of the stiffness by swelling at a time of at least 0 [s]."""
        if not 0.0 <= time < inf:
            raise ParameterError(f'time must be finite and >= 0 s, got {time!r}')
        return 1.0 - self.swelling * expm1(-time / self.swelling_time)

    def layer(self, depth: float) -> int:
        """Return the index of the layer at a depth [m]; at a boundary the deeper layer."""
        return max(int(np.searchsorted(self.starts, depth, side='right')) - 1, 0)

    def stiffness(self, depth: float, time: float = 0.0) -> float:
        """Return the stiffness per length k(y, t) of (7) [N/m^2] at a depth [m] and time [s]."""
        return self.stiffnesses[self.layer(depth)] * self.growth(time)

    def layers(self, modes: ModeShapes) -> Layers:
        """Return the layers, with the contributions of the layers above to the mode integrals."""
        n, m = modes.count, len(self.starts)
        above = np.zeros((m, n, n)), np.zeros((m, n)), np.zeros((m, n))
        for i in range(1, m):
            at = modes.integrals(min(self.starts[i], modes.reach * modes.length))
            step = self.stiffnesses[i - 1] - self.stiffnesses[i]
            for total, integral in zip(above, (at.gram, at.area, at.moment), strict=True):
                total[i] = total[i - 1] + step * integral
        return Layers(np.array(self.starts), np.array(self.stiffnesses), *above)
