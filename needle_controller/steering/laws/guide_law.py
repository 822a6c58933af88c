# SPDX-License-Identifier: Apache-2.0
"""Base class of laws that compute the guide from the newest tip measurement."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from math import inf

from needle_controller.steering.law import (
    checked_roll,
    checked_target,
    checked_tip,
    GuideSetpoint,
    TipEstimate,
)
from needle_controller.steering.limits import SteeringLimits
from needle_controller.steering.responses import SteeringModel
from needle_dynamics.arrays import FloatArray
from needle_dynamics.steering.needle import SteeredNeedle
import numpy as np
from numpy.typing import ArrayLike


class GuideLaw(ABC):
    """
    Steering law that computes the guide from the newest tip measurement.

    A derived class implements `choose`, and may implement `prepare`. Position and change of the
    guide are clipped to their limits, and its load on the nominal needle to ``load_limit``.
    Parameters as for `LawClass`.
    """

    warning = ''

    def __init__(
        self, model: SteeringModel, target: ArrayLike, limits: SteeringLimits, roll: float = 0.0
    ) -> None:
        self.depths, self.limits = model.depths, limits
        self.turns, self.roll = limits.turns, checked_roll(roll)
        self._nominal = SteeredNeedle(model.needle, model.steering, roll=self.roll)
        self.step = 0
        self.guides = [np.zeros(2)]  #: guide at each depth so far [m], at last its setpoint
        self._newest: tuple[FloatArray, int] | None = None
        self.aim(target)
        self.prepare(model)

    def prepare(self, model: SteeringModel) -> None:  # noqa: B027
        """Compute constants before the first step; the default computes nothing."""

    def aim(self, target: ArrayLike) -> None:
        """Set the target, x and z of the tip at the last depth [m]."""
        self.target = checked_target(target)

    def update(
        self,
        tip: Sequence[float] | FloatArray | None,
        at: int,
        noise: float = 0.0,  # noqa: ARG002
    ) -> None:
        """Process a tip measurement, x and z [m], or None; see `SteeringLaw`."""
        measured = checked_tip(tip)
        if np.isfinite(measured).all():
            self._newest = measured, at

    def plan(self) -> GuideSetpoint:
        guide, most, change = self.guides[-1], self.limits.guide_limit, self.limits.guide_step
        if self._newest is not None and self.step < len(self.depths) - 1:
            wanted = np.clip(self.choose(*self._newest), guide - change, guide + change)
            guide = self._within_load(np.clip(wanted, -most, most))
        self._newest = None
        self.guides.append(guide)
        self.step += 1
        x, z = guide.tolist()
        return GuideSetpoint(x, z, self.roll)

    def _within_load(self, guide: FloatArray) -> FloatArray:
        """Return the guide [m], less of its motion where it would exceed the load limit."""
        limit, needle, before = self.limits.load_limit, self._nominal, self.guides[-1]
        if limit == inf:
            return guide
        needle.move(depth=float(self.depths[self.step]))
        now = needle.guide_load[0]
        needle.move(guide=guide.tolist(), roll=self.roll)
        # At a constant depth the load is linear in the guide, and each plane has its own.
        then = needle.guide_load[0]
        change, over = then - now, np.sign(then) * np.maximum(0.0, np.abs(then) - limit)
        back = np.divide(over, change, out=np.zeros(2), where=change != 0.0)
        guide = guide - np.clip(back, 0.0, 1.0) * (guide - before)
        needle.move(guide=guide.tolist())
        return guide

    @abstractmethod
    def choose(self, tip: FloatArray, at: int) -> FloatArray:
        """Return the guide for the next step [m] from a tip [m] measured at depth number at."""

    def expected(self) -> TipEstimate | None:
        """Return None: there is no prediction."""
        return None

    def status(self) -> Mapping[str, float]:
        return {'turns_left': self.turns}
