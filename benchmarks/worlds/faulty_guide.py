# SPDX-License-Identifier: Apache-2.0
"""
Guide with backlash, a wrong gain, or turned frames, on the beam of `stiffness_field`.

Backlash and gain of a worn or badly calibrated stage are assumptions; the turn is the registration
error in docs/steering.md. Target and tip are in the frame of the sensor.
"""

from __future__ import annotations

from math import cos, sin
from typing import Final

from benchmarks.worlds.stiffness_field import StiffnessField
from benchmarks.worlds.world import DrawnConstants
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numpy as np

#: Turn of the frames of guide and sensor about the direction of insertion [rad].
TURN: Final = 0.17


class FaultyGuide(StiffnessField):
    """
    Beam whose guide does not follow its setpoint.

    The guide follows ``gain`` times the setpoint in x and z, turned by an angle [rad], with a play
    of ``gap`` [m].
    """

    def __init__(
        self,
        constants: DrawnConstants,
        depths: FloatArray,
        gap: float = 0.0,
        gain: tuple[float, float] = (1.0, 1.0),
        turn: float = 0.0,
    ) -> None:
        c, s = cos(turn), sin(turn)
        self._gap, self._gain = gap, np.array([[c, -s], [s, c]]) * gain
        self.at = np.zeros(2)
        super().__init__(constants, depths)

    def guide(self, to: GuideSetpoint) -> None:
        wanted = self._gain @ to[:2]
        self.at = np.clip(self.at, wanted - 0.5 * self._gap, wanted + 0.5 * self._gap)
        super().guide(GuideSetpoint(float(self.at[0]), float(self.at[1]), to.roll))
