# SPDX-License-Identifier: Apache-2.0
"""
Beam by its flexibility in tissue that moves sideways with breathing.

The beam is a cantilever whose deflection at any point per force at any other one is known exactly
(the force method); the tissue acts at points of a uniform grid and moves with its path. At exhale
the displacement is zero, and the target is where it was then.

The displacement A cos(pi t / T)^6 rests at exhale for most of the time [Lujan1999]_.

References
----------
.. [Lujan1999] A. E. Lujan, E. W. Larsen, J. M. Balter, R. K. Ten Haken, "A method for
   incorporating organ motion due to breathing into 3D dose calculations", Medical Physics 26,
   1999.

"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi
from typing import Final

from benchmarks.worlds.world import DrawnConstants, grown, IndependentNeedle, LONGEST
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numpy as np
from scipy.linalg import cho_factor, cho_solve

#: Duration of a motion of the guide and of a tip measurement [s], and insertion speed [m/s].
_MOTION, _LOOK, _SPEED = 0.2, 1.0, 0.01

#: Distance from exhale at which a gated insertion continues, relative to the amplitude.
_GATE: Final = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Breath:
    """Motion of the tissue."""

    amplitude: tuple[float, float] = (0.0, 0.0)  #: displacement at inhale, x and z [m]
    period: float = 4.0  #: duration of a breath [s]
    begin: float = 0.0  #: time since inhale at the start [s]
    gated: bool = False  #: whether the needle is measured and moved near exhale only

    def displacement(self, time: float) -> FloatArray:
        """Return the displacement of the tissue at a time [s], x and z [m]."""
        part = cos(pi * (self.begin + time) / self.period) ** 6
        return part * np.array(self.amplitude)

    def next(self, time: float, step: float = 0.02) -> float:
        """Return the next time at which the needle may move [s]."""
        most = _GATE * float(np.hypot(*self.amplitude))
        while self.gated and np.hypot(*self.displacement(time)) > most:
            time += step
        return time


def draw_breath(rng: np.random.Generator, *, gated: bool) -> Breath:
    """Draw a breath of 5 to 10 mm in 3 to 5 s; organs below the diaphragm move that far."""
    size, angle = rng.uniform(5e-3, 0.01), rng.uniform(0.0, 2.0 * pi)
    period = rng.uniform(3.0, 5.0)
    return Breath(
        amplitude=(size * np.cos(angle), size * np.sin(angle)),
        period=period,
        begin=rng.uniform(0.0, period),
        gated=gated,
    )


class BreathingTissue(IndependentNeedle):
    """
    Beam in tissue that moves with breathing, by default at rest.

    ``size`` is the distance of the points at which the tissue acts [m]; all depths are multiples.
    """

    def __init__(
        self,
        constants: DrawnConstants,
        depths: FloatArray,
        breath: Breath | None = None,
        size: float = 1.25e-3,
    ) -> None:
        super().__init__(constants, depths)
        self._breath, self._size, self._time = breath or Breath(), size, 0.0
        # From the guide; a force at b moves a point at a <= b by a^2 (3 b - a) / (6 E I).
        self._at = constants.free + size * np.arange(round(LONGEST / size) + 1)
        low = np.minimum(self._at, self._at[:, np.newaxis])
        high = np.maximum(self._at, self._at[:, np.newaxis])
        self._flexible = low**2 * (3.0 * high - low) / (6.0 * constants.stiffness)
        self._guide = np.zeros(2)
        #: Path at the points, in the tissue [m].
        self._path = np.zeros((1, 2))
        self._solve(cutting=True)

    @property
    def _shift(self) -> FloatArray:
        """Displacement of the tissue [m]; the last measurement is at exhale."""
        return self._breath.displacement(self._time)

    def _solve(self, *, cutting: bool) -> None:
        """Compute the tip and the load on the guide; a needle that cuts ends on its path."""
        c, count = self.constants, len(self._path)
        at, flexible = self._at[:count], self._flexible[:count, :count]
        springs = np.full(count, c.tissue * self._size)
        springs[0] *= 0.5
        springs[-1] *= 0.0 if cutting else 0.5
        pulls = springs[:, np.newaxis] * (self._path + self._shift)
        springs[0] += c.skin
        pulls[0] += c.skin * (c.entry + self._shift)
        load = c.load(self._size * (count - 1.5))
        alone = self._guide + np.outer(at, c.tilt) + np.outer(flexible[:, -1], load)
        # Forces f = pulls - springs (alone + flexible f), symmetric after scaling.
        roots = np.sqrt(springs)
        matrix = np.eye(count) + roots[:, np.newaxis] * flexible * roots
        wanted = np.divide(
            pulls, roots[:, np.newaxis], out=np.zeros_like(pulls), where=roots[:, np.newaxis] > 0.0
        )
        forces = roots[:, np.newaxis] * cho_solve(
            cho_factor(matrix), wanted - roots[:, np.newaxis] * alone
        )
        self._tip = alone[-1] + flexible[-1] @ forces
        self._force = forces.sum(axis=0) + load

    @property
    def position(self) -> FloatArray:
        return np.array(self._tip)

    @property
    def guide_load(self) -> FloatArray:
        return np.array([self._force])

    def guide(self, to: GuideSetpoint) -> None:
        self._guide = np.array(to[:2])
        self._time = self._breath.next(self._time + _MOTION)
        self._solve(cutting=len(self._path) == 1)

    def advance(self, depth: float) -> None:
        begin = self._size * (len(self._path) - 1)
        # The path continues from the tip, which has moved since the last increment.
        before = 0.0 if len(self._path) == 1 else 0.5
        tip = self._tip - self._shift
        self._path[-1] = before * self._path[-1] + (1.0 - before) * tip
        for _ in grown(begin, depth, self._size):
            self._time = self._breath.next(self._time + self._size / _SPEED)
            self._path = np.vstack([self._path, np.zeros(2)])
            self._solve(cutting=True)
            self._path[-1] = self._tip - self._shift
        self._time = self._breath.next(self._time + _LOOK)
        if self.done:
            # The end is judged at exhale, half a breath after an inhale.
            period = self._breath.period
            self._time = period * (np.ceil(self._time / period) + 0.5) - self._breath.begin
        self._solve(cutting=False)
