# SPDX-License-Identifier: Apache-2.0
"""
Steering law outside the package: bring the tip to a line to the target, four steps ahead.

PYTHONPATH=examples needle steer --law steering_law:NominalLaw
"""

from needle_controller import GuideSetpoint, SteeringLimits, SteeringModel
from needle_dynamics import FloatArray
import numpy as np


class NominalLaw:
    """Predict the tip by the nominal model, plus its measured deviation from this model."""

    warning = ''

    def __init__(
        self, model: SteeringModel, target: FloatArray, limits: SteeringLimits, roll: float
    ) -> None:
        skin = model.steering.skin_stiffness / model.needle.tissue_stiffness
        nominal = np.argmin(abs(model.lengths - 1.0) + abs(model.skins - skin))
        self.responses, self.depths = model.responses.guide[nominal], model.depths
        self.limits = limits
        self.guide = np.zeros((len(self.depths) - 1, 2))
        self.deviation, self.step = np.zeros(2), 0
        self.aim(target)

    def aim(self, target: FloatArray) -> None:
        self.target = np.array(target)

    def update(self, tip: FloatArray | None, at: int, noise: float = 0.0) -> None:
        if tip is not None:
            self.deviation = tip - self.responses[at] @ self.guide

    def plan(self) -> GuideSetpoint:
        k, self.step = self.step, self.step + 1
        if k < len(self.guide):
            limit, step = self.limits.guide_limit, self.limits.guide_step
            past = self.guide[k - 1] if k else np.zeros(2)
            ahead = min(k + 4, len(self.guide))
            wanted = self.target * self.depths[ahead] / self.depths[-1] - self.deviation
            wanted -= self.responses[ahead] @ self.guide
            wanted /= self.responses[ahead, k:].sum()
            wanted = np.clip(wanted, past - step, past + step)
            self.guide[k] = np.clip(wanted, -limit, limit)
        return GuideSetpoint(*self.guide[min(k, len(self.guide) - 1)])

    def expected(self) -> None:
        return None

    def status(self) -> dict[str, float]:
        return {}
