# SPDX-License-Identifier: Apache-2.0
"""Steps, tip measurements and limits of a steered insertion, as parameters."""

from dataclasses import dataclass, fields
from math import sqrt
from typing import Final

from needle_controller.steering.limits import SteeringLimits
from needle_dynamics.arrays import FloatArray
from needle_ros.contract import GUIDE_X, GUIDE_Z, INSERTION, ROLL
from needle_ros.errors import ParameterError
from needle_ros.settings import constant, flag
from needle_ros.system_state import RETRACT_DEPTH
import numpy as np

_PER_STEP: Final = 4.0  #: Least number of guide commands within a step.

#: Joints that are moved; roll only if turns are allowed.
JOINTS: Final = (INSERTION, GUIDE_X, GUIDE_Z, ROLL)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExecutiveSettings(SteeringLimits):
    """Steps, tip measurements and limits of a steered insertion."""

    speed: float = constant(0.01, 'm/s', 'highest insertion speed', open_low=True)
    guide_speed: float = constant(0.02, 'm/s', 'highest speed of the guide', open_low=True)
    acceleration: float = constant(
        0.1,
        'm/s^2',
        'highest acceleration of needle and guide; not of the guide if continuous',
        open_low=True,
    )
    roll_speed: float = constant(2.0, 'rad/s', 'highest angular speed of the roll', open_low=True)
    continuous: bool = flag(
        False, 'the needle is inserted without rests, and the guide follows its depth; else it '
        'rests at the end of each step',
    )  # fmt: skip
    rate: float = constant(
        20.0,
        'Hz',
        'rate of guide commands, if continuous and while a controller withdraws the needle',
        low=1.0,
        high=50.0,
    )
    settle_time: float = constant(0.1, 's', 'time at rest before a tip measurement')
    measurement_time: float = constant(
        0.5, 's', 'duration of a tip measurement, whose readings are averaged', open_low=True
    )
    depth_tolerance: float = constant(
        3e-4, 'm', 'largest distance of the needle at rest from the end of a step', open_low=True
    )
    guide_tolerance: float = constant(
        1e-4, 'm', 'largest distance of the guide at rest from its goal', open_low=True
    )
    roll_tolerance: float = constant(
        0.02, 'rad', 'largest difference of the roll at rest from its goal', open_low=True
    )
    slip_tolerance: float = constant(
        3e-3, 'm', 'largest change of the difference between tip depth and insertion depth '
        'since the first measurement', open_low=True,
    )  # fmt: skip
    retract_depth: float = constant(
        RETRACT_DEPTH, 'm', 'insertion depth of ~/retract; a needle that is less deep rests'
    )
    patience: float = constant(
        5.0,
        's',
        'additional time for a step, or for the whole insertion if continuous, in which the robot '
        'moves but is slow; a motion that does not begin is sent again after 1 s, three times',
        open_low=True,
    )
    measurement_timeout: float = constant(
        0.5, 's', 'age at which joint_states and tip_deflection are stale; largest delay of '
        'a reading of the tip', open_low=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        SteeringLimits.__post_init__(self)
        if self.depth_tolerance >= 0.5 * self.step_length:
            raise ParameterError(
                f'depth_tolerance must be < half of step_length {self.step_length:g} m, got '
                f'{self.depth_tolerance:g} m'
            )
        if self.continuous and self.turns:
            raise ParameterError('turns must be 0 if continuous: a needle is turned at rest')
        least = _PER_STEP * self.speed / self.step_length
        if self.continuous and self.rate < least:
            raise ParameterError(
                f'rate must be at least {least:g} Hz if continuous, {_PER_STEP:g} times in a '
                f'step, got {self.rate:g} Hz'
            )
        if self.guide_limit == 0.0 and self.turns == 0:
            raise ParameterError('guide_limit and turns cannot both be 0: nothing would move')

    @property
    def joints(self) -> tuple[str, ...]:
        return JOINTS if self.turns else JOINTS[:-1]

    def limits(self, step: float) -> SteeringLimits:
        """Return the limits of the steering law for steps of a length [m]."""
        change = self.guide_step
        if self.continuous:
            # Both axes at once, at the peak of the insertion speed.
            change = min(change, sqrt(0.5) * self.guide_speed * step / self.speed)
        own = {item.name: getattr(self, item.name) for item in fields(SteeringLimits)}
        return SteeringLimits(**{**own, 'guide_step': change})

    @property
    def tolerances(self) -> FloatArray:
        """Position tolerance of each moved joint at rest [m, rad]."""
        guide = self.guide_tolerance
        every = [self.depth_tolerance, guide, guide, self.roll_tolerance]
        return np.array(every[: len(self.joints)])
