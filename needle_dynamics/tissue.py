# SPDX-License-Identifier: Apache-2.0
"""Tissue model along the needle: layered elastic foundation, swelling, damping; equation (7)."""

from dataclasses import dataclass
from itertools import pairwise
from math import expm1, inf

from needle_dynamics.compiled.tissue import Layers
from needle_dynamics.modes import ModeShapes
from needle_ros.errors import ParameterError
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Tissue:
    """
    Elastic foundation k(y, t), piecewise constant in depth, optionally swelling.

    A single layer without swelling is the homogeneous tissue (8) of the source.

    Attributes
    ----------
    starts : tuple of float
        Depths at which the layers begin [m]; the first is 0.
    stiffnesses : tuple of float
        Stiffness of each layer per length [N/m^2].
    damping : float
        Damping c_a per length (Kelvin-Voigt) [N s/m^2].
    swelling : float
        Final relative increase of the stiffness over its value at time 0.
    swelling_time : float
        Time constant of the swelling [s].

    """

    starts: tuple[float, ...]
    stiffnesses: tuple[float, ...]
    damping: float = 0.0
    swelling: float = 0.0
    swelling_time: float = 1.0

    def __post_init__(self) -> None:
        ordered = all(low < high for low, high in pairwise(self.starts))
        if len(self.starts) != len(self.stiffnesses) or self.starts[:1] != (0.0,) or not ordered:
            raise ParameterError(
                f'layers must start at 0 and go deeper, with one stiffness each, got starts '
                f'{self.starts} and stiffnesses {self.stiffnesses}'
            )

        for name, low in (('damping', 0.0), ('swelling', -1.0), ('swelling_time', 0.0)):
            value = getattr(self, name)
            # Only damping may equal its lower bound.
            if not low <= value < inf or (value == low and name != 'damping'):
                raise ParameterError(f'{name} must be finite and above {low:g}, got {value!r}')
        if not all(0.0 <= value < inf for value in (*self.starts, *self.stiffnesses)):
            raise ParameterError(
                f'layers must have finite starts and stiffnesses >= 0, got {self.starts} and '
                f'{self.stiffnesses}'
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
        gram, area, moment = np.zeros((m, n, n)), np.zeros((m, n)), np.zeros((m, n))
        for i in range(1, m):
            at = modes.integrals(min(self.starts[i], modes.reach * modes.length))
            step = self.stiffnesses[i - 1] - self.stiffnesses[i]
            gram[i] = gram[i - 1] + step * at.gram
            area[i] = area[i - 1] + step * at.area
            moment[i] = moment[i - 1] + step * at.moment
        starts, stiffnesses = np.array(self.starts), np.array(self.stiffnesses)
        return Layers(starts, stiffnesses, gram, area, moment)
