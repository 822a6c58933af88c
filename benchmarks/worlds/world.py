# SPDX-License-Identifier: Apache-2.0
"""Interface of the simulated needles, and the constants that one of them has."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from math import exp, sqrt
from typing import Any, cast, Final, TypeVar

from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numba
import numpy as np

_Function = TypeVar('_Function', bound=Callable[..., object])

#: Length of the cells in which the disturbance of the path is constant [m].
CELL: Final = 1e-3

#: Longest needle in tissue [m].
LONGEST: Final = 0.125

#: Growth of the variance of the path direction per length [rad^2/m], and correlation length [m]:
#: repeated insertions differ by about 0.3 mm at 100 mm (docs/steering.md).
_WANDER, _WANDER_LENGTH = 1e-4, 5e-3


def native(function: _Function) -> _Function:
    """Compile a function at its first call, and keep the machine code on disk."""
    return cast(_Function, numba.njit(error_model='numpy', cache=True)(function))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnConstants:
    """Constants of one needle in one tissue."""

    stiffness: float = 0.0256  #: bending stiffness E I of the needle [N m^2]
    tissue: float  #: stiffness of the tissue per length [N/m^2]
    skin: float = 0.0  #: lateral stiffness of the skin [N/m]
    free: float = 0.04  #: length between guide and skin [m]
    tilt: tuple[float, float] = (0.0, 0.0)  #: tilt of the guide in x and z [rad]
    bevel: tuple[float, float] = (0.0, 0.0)  #: lateral load of the tip in x and z [N]
    #: Rotation of the sensor's frame: shift of the tip in x and z per depth [rad].
    frame: tuple[float, float] = (0.0, 0.0)
    #: Disturbing curvature of the path in x and z [1/m] in cells of length `CELL`, shape (k, 2).
    wander: FloatArray | None = None

    @property
    def bending(self) -> float:
        """Bending length [m]."""
        return float((4.0 * self.stiffness / self.tissue) ** 0.25)

    @property
    def entry(self) -> FloatArray:
        """Point in which the loaded tip of a needle at its zero pierces the skin, x, z [m]."""
        bent = self.free**3 / (3.0 * self.stiffness) * self.load(0.0)
        return np.asarray(self.free * np.array(self.tilt) + bent)

    def curvature(self, depth: float) -> FloatArray:
        """Return the disturbing curvature in x and z [1/m] at a depth [m]."""
        if self.wander is None:
            return np.zeros(2)
        cell = min(int(max(0.0, depth) / CELL), len(self.wander) - 1)
        return np.asarray(self.wander[cell])

    def load(self, depth: float) -> FloatArray:
        """Return the lateral load on a tip that cuts at a depth, in x and z [N]."""
        # A tip load F bends the path of a long needle by F lambda / (E I).
        steady = self.stiffness / self.bending
        return np.asarray(self.bevel) + steady * self.curvature(depth)


def draw_wander(rng: np.random.Generator) -> FloatArray:
    """Draw the disturbing curvature of a path [1/m], shape (k, 2)."""
    keep = exp(-CELL / _WANDER_LENGTH)
    found = rng.standard_normal((round(LONGEST / CELL), 2))
    for k in range(1, len(found)):
        found[k] = keep * found[k - 1] + sqrt(1.0 - keep * keep) * found[k]
    return np.asarray(sqrt(_WANDER / (2.0 * _WANDER_LENGTH)) * found)


class IndependentNeedle(ABC):
    """
    Simulated needle that is inserted in steps, with the members that `simulate_steering` uses.

    A derived class moves guide and roll at a constant depth (`guide`), and inserts the needle to a
    depth (`advance`). The needle begins at the first of the ``depths`` of the tip measurements
    [m], shape (n + 1,), which is 0; ``step`` is the number of its present depth.
    """

    def __init__(self, constants: DrawnConstants, depths: FloatArray) -> None:
        self.constants, self.depths, self.step = constants, depths, 0

    @property
    def depth(self) -> float:
        """Insertion depth [m]."""
        return float(self.depths[self.step])

    @property
    def done(self) -> bool:
        """Whether the needle is at the last depth."""
        return self.step == len(self.depths) - 1

    @property
    def tip(self) -> FloatArray:
        """Position of the tip in the frame of the sensor, x and z [m], shape (2,)."""
        return self.position + np.array(self.constants.frame) * self.depth

    @property
    def needle(self) -> Any:
        """This object: it has the load on the guide, too."""
        return self

    @property
    @abstractmethod
    def position(self) -> FloatArray:
        """Position of the tip, x and z [m], shape (2,)."""

    @property
    @abstractmethod
    def guide_load(self) -> FloatArray:
        """Force of the needle on the guide in x and z [N], shape (1, 2)."""

    @abstractmethod
    def guide(self, to: GuideSetpoint) -> None:
        """Move guide and roll, while the depth is constant."""

    @abstractmethod
    def advance(self, depth: float) -> None:
        """Insert the needle to a depth [m]."""

    def insert(self) -> None:
        """Insert the needle to the next depth."""
        self.step += 1
        self.advance(self.depth)


def grown(begin: float, end: float, longest: float) -> list[float]:
    """Return the depths at the ends of equal increments [m], not longer than a length [m]."""
    count = max(1, int(np.ceil((end - begin) / longest - 1e-9)))
    return [begin + (end - begin) * (i + 1) / count for i in range(count)]
