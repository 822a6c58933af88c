# SPDX-License-Identifier: Apache-2.0
"""
Kinematic needles that are steered by roll: unicycle and bicycle, with windup of the shaft.

A stiff tissue holds the shaft, which follows the tip without any force: the guide has no effect
[Webster2006]_. Friction on the shaft twists it, so that the tip lags the roll of the base by up to
an angle that grows with the depth; more than 45 degrees at 10 cm were measured [Reed2009]_.

References
----------
.. [Webster2006] R. J. Webster, J. S. Kim, N. J. Cowan, G. S. Chirikjian, A. M. Okamura,
   "Nonholonomic modeling of needle steering", International Journal of Robotics Research 25, 2006.
.. [Reed2009] K. B. Reed, A. M. Okamura, N. J. Cowan, "Modeling and control of needles with
   torsional friction", IEEE Transactions on Biomedical Engineering 56, 2009.

"""

from __future__ import annotations

from math import cos, hypot, pi, sin, tan
from typing import Final

from benchmarks.worlds.world import CELL, DrawnConstants, grown, IndependentNeedle
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numpy as np

#: Windup per depth [rad/m]: 45 degrees at 10 cm.
WINDUP: Final = 0.25 * pi / 0.1

#: Curvature of the unicycle [1/m]; wheelbase l1 and distance l2 of the tip [m], and angle [rad] of
#: the front wheel of the bicycle, as measured by Webster et al.
CURVATURE: Final = 4.5
WHEELBASE, LEAD, ANGLE = 0.04, 0.023775, 0.198


class BevelNeedle(IndependentNeedle):
    """
    Tip on arcs of constant curvature [1/m], which turn with the roll of the tip.

    The curvature is towards ``roll`` [rad] as long as the base is at zero; ``lead`` is the
    distance of the tip from the wheel that rolls along the arcs [m], zero for a unicycle, and
    ``windup`` the angle by which the tip lags the base, per depth [rad/m].
    """

    def __init__(
        self,
        constants: DrawnConstants,
        depths: FloatArray,
        curvature: float = CURVATURE,
        lead: float = 0.0,
        windup: float = WINDUP,
        roll: float = 0.0,
    ) -> None:
        super().__init__(constants, depths)
        self._curvature, self._lead, self._windup, self._mounted = curvature, lead, windup, roll
        self.roll, self._base, self._inserted = 0.0, 0.0, 0.0
        x, z = constants.tilt
        ahead = np.array([x, 1.0, z]) / np.sqrt(1.0 + x * x + z * z)
        #: Unit vectors of the wheel: x, along the needle, and z.
        self.frame = turn(np.eye(3), np.array([0.0, 1.0, 0.0]), ahead)
        #: Position of the wheel; the tip is in the skin at the start [m].
        self.wheel = np.array([constants.free * x, 0.0, constants.free * z]) - lead * ahead

    @property
    def point(self) -> FloatArray:
        """Position of the tip, x, y and z [m]."""
        return np.asarray(self.wheel + self._lead * self.frame[:, 1])

    @property
    def position(self) -> FloatArray:
        return self.point[[0, 2]]

    @property
    def guide_load(self) -> FloatArray:
        return np.zeros((1, 2))

    def guide(self, to: GuideSetpoint) -> None:
        self._base = to.roll
        # The tip turns when the shaft is wound up.
        lag = self._windup * self._inserted
        self.roll = min(max(self.roll, self._base - lag), self._base + lag)

    def advance(self, depth: float) -> None:
        for at in grown(self._inserted, depth, CELL):
            h, roll = at - self._inserted, self._mounted + self.roll
            # A disturbance along fixed directions; at zero roll the needle bends along z.
            x, z = self.constants.curvature(self._inserted)
            x, z = x + self._curvature * sin(roll), z + self._curvature * cos(roll)
            self._roll_along(h, x, z)
            self._inserted = at

    def _roll_along(self, length: float, x: float, z: float) -> None:
        """Move the wheel along an arc with curvatures towards x and z of its frame [1/m]."""
        size = hypot(x, z)
        angle = size * length
        # The chord is turned by half of the angle.
        chord = length * np.sinc(0.5 * angle / pi)
        side = np.array([x, 0.0, z]) / size if size > 0.0 else np.array([0.0, 0.0, 1.0])
        ahead = np.array([0.0, 1.0, 0.0])
        self.wheel = self.wheel + self.frame @ (
            chord * (cos(0.5 * angle) * ahead + sin(0.5 * angle) * side)
        )
        self.frame = turn(self.frame, ahead, cos(angle) * ahead + sin(angle) * side)


def turn(frame: FloatArray, one: FloatArray, other: FloatArray) -> FloatArray:
    """Return a frame after the smallest rotation of one unit vector in it to another."""
    axis = np.cross(one, other)
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(frame @ (np.eye(3) + skew + skew @ skew / (1.0 + one @ other)))


def bicycle_curvature() -> float:
    """Return the curvature of the path of the rear wheel [1/m]."""
    return tan(ANGLE) / WHEELBASE
