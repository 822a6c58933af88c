"""
Guide with backlash and a wrong gain, on the beam of `stiffness_field`.

Backlash and gain of a worn or badly calibrated stage are assumptions.
"""

from __future__ import annotations

from benchmarks.worlds.stiffness_field import StiffnessField
from benchmarks.worlds.world import Constants
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numpy as np


class FaultyGuide(StiffnessField):
    """Beam whose guide follows ``gain`` times the setpoint in x and z, with a play ``gap`` [m]."""

    def __init__(
        self,
        constants: Constants,
        depths: FloatArray,
        gap: float = 5e-4,
        gain: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        self._gap, self._gain, self.at = gap, gain, np.zeros(2)
        super().__init__(constants, depths)

    def guide(self, to: GuideSetpoint) -> None:
        wanted = np.array(self._gain) * to[:2]
        self.at = np.clip(self.at, wanted - 0.5 * self._gap, wanted + 0.5 * self._gap)
        super().guide(GuideSetpoint(*self.at.tolist(), to.roll))
