# SPDX-License-Identifier: Apache-2.0
"""
Beam of Hermite elements in tissue that hardens or yields, and relaxes.

The force of the tissue is along the distance of the needle from its path, so that both planes are
coupled. A fraction of it relaxes (a standard linear solid): the force on an indenter in soft
tissue may fall to less than half of its peak (PMC7595329). The time constant, and the distances at
which the tissue hardens or yields, are assumptions.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf, sqrt
from typing import Final

from benchmarks.worlds.world import DrawnConstants, grown, IndependentNeedle, native
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numpy as np
from scipy.linalg import solveh_banded

#: Duration of a motion of the guide and of a tip measurement [s], and insertion speed [m/s].
_MOTION, _LOOK, _SPEED = 0.2, 1.0, 0.01

#: Parts of the time at rest.
_PARTS: Final = 2

#: Largest change of the shape in the last iteration [m], and number of iterations.
_CLOSE, _MOST = 1e-9, 40

#: Gauss points of an element.
_GAUSS: Final = (0.5 - 0.5 / sqrt(3.0), 0.5 + 0.5 / sqrt(3.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class TissueLaw:
    """Force of the tissue per length, relative to a linear elastic tissue."""

    hardening: float = inf  #: distance at which the force is twice the linear one [m]
    yielding: float = inf  #: distance at which the tissue yields for good [m]
    beyond: float = 0.1  #: stiffness of tissue that yields, relative to its stiffness before
    relaxing: float = 0.0  #: fraction of the force that relaxes
    time: float = 5.0  #: time constant of the relaxation [s]


#: Tissue that hardens, and tissue that yields.
HARDENING: Final = TissueLaw(hardening=5e-4, relaxing=0.5)
YIELDING: Final = TissueLaw(yielding=3e-4, relaxing=0.5)


@native
def _force(x: float, z: float, hard: float, limit: float, beyond: float) -> tuple[float, ...]:
    """Return force and its derivatives by distances x and z, for a stiffness of 1."""
    r = sqrt(x * x + z * z)
    if r > limit:
        factor = beyond + (1.0 - beyond) * limit / r
        slope = -(1.0 - beyond) * limit / (r * r * r)
    else:
        factor, slope = 1.0 + (r / hard) ** 2, 2.0 / hard**2
    xx, xz, zz = factor + slope * x * x, slope * x * z, factor + slope * z * z
    return factor * x, factor * z, xx, xz, zz


@native
def _bend(
    shape: FloatArray, lengths: FloatArray, stiffness: float, band: FloatArray, left: FloatArray
) -> None:
    """
    Add the bending energy to Hessian (lower band) and gradient for a shape (nodes, 4).

    The columns of ``shape`` are deflections in x and z, and slopes in x and z; the first node is
    the guide, which is given.
    """
    bend = np.empty((4, 4))
    for e in range(len(lengths)):
        h = lengths[e]
        one = stiffness / h**3
        bend[0] = np.array([12.0, 6.0 * h, -12.0, 6.0 * h]) * one
        bend[1] = np.array([6.0 * h, 4.0 * h * h, -6.0 * h, 2.0 * h * h]) * one
        bend[2] = -bend[0]
        bend[3] = np.array([6.0 * h, 2.0 * h * h, -6.0 * h, 4.0 * h * h]) * one
        for i in range(4):
            # Deflection or slope at the begin or the end of the element.
            to = 4 * (e - 1 + i // 2) + 2 * (i % 2)
            if to < 0:
                continue
            for j in range(4):
                of = 4 * (e - 1 + j // 2) + 2 * (j % 2)
                for plane in range(2):
                    value = shape[e + j // 2, 2 * (j % 2) + plane]
                    left[to + plane] += bend[i, j] * value
                    if 0 <= of <= to:
                        band[to - of, of + plane] += bend[i, j]


@native
def _hold(
    shape: FloatArray,
    lengths: FloatArray,
    bed: FloatArray,
    crept: FloatArray,
    tissue: float,
    law: tuple[float, float, float, float],
    cutting: bool,
    band: FloatArray,
    left: FloatArray,
) -> None:
    """
    Add the forces of the tissue to Hessian (lower band) and gradient for a shape (nodes, 4).

    ``bed`` is the path and ``crept`` the relaxed distance at the Gauss points,
    shape (elements, 2, 2); the first element is in the air.
    """
    hard, limit, beyond, relaxing = law
    row = np.empty(4)
    for e in range(1, len(lengths)):
        h = lengths[e]
        for g in range(2):
            t = _GAUSS[g]
            row[0] = 1.0 - 3.0 * t * t + 2.0 * t**3
            row[1] = h * t * (1.0 - t) ** 2
            row[2] = 3.0 * t * t - 2.0 * t**3
            row[3] = h * t * t * (t - 1.0)
            if cutting and e == len(lengths) - 1:
                # The path of the last element ends at the tip.
                row[2] -= t
            x, z = -bed[e, g, 0], -bed[e, g, 1]
            for i in range(4):
                x += row[i] * shape[e + i // 2, 2 * (i % 2)]
                z += row[i] * shape[e + i // 2, 2 * (i % 2) + 1]
            fx, fz, xx, xz, zz = _force(x, z, hard, limit, beyond)
            gx, gz, gxx, gxz, gzz = _force(
                x - crept[e, g, 0], z - crept[e, g, 1], hard, limit, beyond
            )
            k = 0.5 * h * tissue
            fx, fz = fx + relaxing * (gx - fx), fz + relaxing * (gz - fz)
            xx, xz = xx + relaxing * (gxx - xx), xz + relaxing * (gxz - xz)
            zz += relaxing * (gzz - zz)
            for i in range(4):
                to = 4 * (e - 1 + i // 2) + 2 * (i % 2)
                left[to] += k * fx * row[i]
                left[to + 1] += k * fz * row[i]
                for j in range(4):
                    of = 4 * (e - 1 + j // 2) + 2 * (j % 2)
                    both = k * row[i] * row[j]
                    if of <= to:
                        band[to - of, of] += both * xx
                        band[to - of, of + 1] += both * zz
                        band[to + 1 - of, of] += both * xz
                    if of + 1 <= to:
                        band[to - of - 1, of + 1] += both * xz


class NonlinearTissue(IndependentNeedle):
    """
    Beam in nonlinear tissue, by default linear.

    ``size`` is the longest element [m].
    """

    def __init__(
        self,
        constants: DrawnConstants,
        depths: FloatArray,
        law: TissueLaw = TissueLaw(),
        size: float = 2.5e-3,
    ) -> None:
        super().__init__(constants, depths)
        self._law, self._size = law, size
        hard = 1e9 if law.hardening == inf else law.hardening
        self._force = hard, law.yielding, law.beyond, law.relaxing
        self._lengths = np.array([constants.free])
        start = np.append(constants.free * np.array(constants.tilt), constants.tilt)
        #: Deflections and slopes in x and z from the guide to the tip, shape (nodes, 4).
        self.shape = np.array([[0.0, 0.0, *constants.tilt], start])
        #: Path at the Gauss points [m], and relaxed distance, shape (elements, 2, 2).
        self._bed, self._crept = np.zeros((2, 1, 2, 2))
        self._solve(cutting=False)

    def _solve(self, *, cutting: bool) -> None:
        """Compute the shape by Newton's method; a needle that cuts ends on its path."""
        c, count = self.constants, 4 * len(self._lengths)
        band, left = np.empty((8, count)), np.empty(count)
        load = c.load(self._lengths[1:].sum() - 0.5 * self._lengths[-1])
        for _ in range(_MOST):
            band[:], left[:] = 0.0, 0.0
            _bend(self.shape, self._lengths, c.stiffness, band, left)
            _hold(
                self.shape, self._lengths, self._bed, self._crept, c.tissue, self._force, cutting,
                band, left,
            )  # fmt: skip
            left[-4:-2] -= load
            left[:2] += c.skin * (self.shape[1, :2] - c.entry)
            band[0, :2] += c.skin
            change = solveh_banded(band, left, lower=True, check_finite=False).reshape(-1, 4)
            self.shape[1:] -= change
            if np.abs(change[:, :2]).max() < _CLOSE:
                return
        raise ArithmeticError('the shape of the needle does not converge')

    def _distances(self) -> FloatArray:
        """Return the distance from the path at the Gauss points, shape (elements, 2, 2) [m]."""
        t, h = np.array(_GAUSS)[:, np.newaxis], self._lengths[:, np.newaxis, np.newaxis]
        begin, end = self.shape[:-1, np.newaxis], self.shape[1:, np.newaxis]
        return np.asarray(
            (1.0 - 3.0 * t**2 + 2.0 * t**3) * begin[..., :2]
            + h * t * (1.0 - t) ** 2 * begin[..., 2:]
            + (3.0 * t**2 - 2.0 * t**3) * end[..., :2]
            + h * t**2 * (t - 1.0) * end[..., 2:]
            - self._bed
        )

    def _wait(self, time: float) -> None:
        """Let the tissue yield and relax for a time [s]."""
        away, law = self._distances(), self._law
        sizes = np.hypot(away[..., 0], away[..., 1])[..., np.newaxis]
        more = (1.0 - law.beyond) * np.maximum(sizes - law.yielding, 0.0)
        moved = more / np.maximum(sizes, 1e-12) * away
        moved[0] = 0.0
        self._bed += moved
        self._crept += (away - moved - self._crept) * (1.0 - exp(-time / law.time))
        self._crept[0] = 0.0

    @property
    def position(self) -> FloatArray:
        return np.array(self.shape[-1, :2])

    @property
    def guide_load(self) -> FloatArray:
        l, (begin, end) = self._lengths[0], self.shape[:2]
        turned = 12.0 * (end[:2] - begin[:2]) - 6.0 * l * (begin[2:] + end[2:])
        return np.array([self.constants.stiffness / l**3 * turned])

    def guide(self, to: GuideSetpoint) -> None:
        self.shape[0, :2] = to[:2]
        self._solve(cutting=False)
        self._wait(_MOTION)

    def advance(self, depth: float) -> None:
        begin = float(self._lengths[1:].sum())
        for at in grown(begin, depth, self._size):
            h = at - float(self._lengths[1:].sum())
            tip = self.shape[-1]
            ahead = np.append(tip[:2] + h * tip[2:], tip[2:])
            # While the needle cuts, the path of the element is relative to the tip.
            before = np.array([(1.0 - t) * tip[:2] for t in _GAUSS])
            self.shape = np.vstack([self.shape, ahead])
            self._lengths = np.append(self._lengths, h)
            self._bed = np.concatenate([self._bed, before[np.newaxis]])
            self._crept = np.concatenate([self._crept, np.zeros((1, 2, 2))])
            self._solve(cutting=True)
            self._bed[-1] += np.outer(_GAUSS, self.shape[-1, :2])
            self._wait(h / _SPEED)
        for _ in range(_PARTS):
            self._solve(cutting=False)
            self._wait(_LOOK / _PARTS)
        self._solve(cutting=False)
