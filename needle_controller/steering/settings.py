# SPDX-License-Identifier: Apache-2.0
"""Settings of steering, as parameters: prior uncertainty, limits, steps of an insertion."""

from dataclasses import dataclass, fields
from math import ceil, inf, sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.contract import GUIDE_X, GUIDE_Z, INSERTION, ROLL
from needle_ros.errors import ParameterError
from needle_ros.settings import (
    check_constants,
    CheckedSettings,
    choice,
    constant,
    flag,
    same_field,
)
from needle_ros.system_state import RETRACT_DEPTH
import numpy as np

_MOST_STEPS: Final = 200  #: Most steps of an insertion.
_PER_STEP: Final = 4.0  #: Least number of guide commands within a step.

#: Joints that are moved; roll only if turns are allowed.
JOINTS: Final = (INSERTION, GUIDE_X, GUIDE_Z, ROLL)


def step_depths(
    end: float, step: float, begin: float = 0.0, name: str = 'step_length'
) -> FloatArray:
    """
    Return the depths of equal steps [m], each at most a step [m], shape (steps + 1,).

    Raises `ParameterError` for more than 200 steps; ``name`` is that of the setting.
    """
    # A quotient of whole steps may be rounded up.
    steps = max(1, ceil(min((end - begin) / step, 1e9) - 1e-6))
    if steps > _MOST_STEPS:
        raise ParameterError(
            f'it would take {steps} steps of {1e3 * step:g} mm, at most {_MOST_STEPS} are '
            f'possible: increase {name}'
        )
    return np.linspace(begin, end, steps + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringLimits:
    """
    Length of the steps, and limits of the guide setpoints of a steering law.

    The defaults are for a robot: a force on tissue and a motion without a limit are never implied.
    """

    step_length: float = constant(
        5e-3, 'm', 'insertion from one tip measurement to the next', open_low=True
    )
    guide_limit: float = constant(
        6e-3, 'm', 'largest position of the guide along x and along z; 0: it stays at 0', high=0.1
    )
    guide_step: float = constant(
        2e-3, 'm', 'largest change of the guide from one step to the next along x and along z',
        open_low=True, unlimited=True,
    )  # fmt: skip
    load_limit: float = constant(
        8.0, 'N', 'largest lateral force of the guide that is planned, along x and along z; the '
        'reachable set is computed without it',
        open_low=True, unlimited=True,
    )  # fmt: skip
    turns: int = constant(0, '1', 'allowed number of turns of the needle', whole=True)

    def __post_init__(self) -> None:
        check_constants(self)
        object.__setattr__(self, 'turns', int(self.turns))


#: Default limits of simulations; these two differ from the node: a simulated guide has time for
#: any motion between two steps, and its force harms no tissue.
SIMULATION_LIMITS: Final = SteeringLimits(guide_step=inf, load_limit=inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringPrior(CheckedSettings):
    """Prior uncertainty of needle, tissue, guide, path and sensor."""

    spread: float = constant(
        0.3, '1', 'relative uncertainty of the bending length; 0: bending length and skin known',
        high=0.9,
    )  # fmt: skip
    skin: float = constant(
        0.06, 'm',
        'largest stiffness of the skin relative to that of the tissue; 0: the nominal one',
    )  # fmt: skip
    layer_spread: tuple[float, ...] = constant(
        (), '1', 'standard deviation of the logarithm of the stiffness of each layer of tissue, '
        'independent of other layers and in addition to spread; one value, or one for each layer; '
        'empty: all layers differ by the same factor', high=2.0,
    )  # fmt: skip
    tilt: float = constant(0.04, 'rad', 'standard deviation of the tilt of the guide')
    frame: float = constant(
        0.06, 'rad', 'standard deviation of the rotation between the frames of guide and sensor'
    )
    bevel: float = constant(0.3, 'N', 'standard deviation of the lateral load of the bevel')
    offset: float = constant(1e-3, 'm', 'standard deviation of the origin of the sensor')
    path_noise: float = constant(
        1e-4, 'rad^2/m', 'least growth of the variance of the path direction per length; up to '
        '100 times as much is considered', open_low=True,
    )  # fmt: skip
    path_noise_length: float = same_field(SteeringParameters, 'path_noise_length')
    noise: float = constant(
        4e-5,
        'm',
        'standard deviation of a tip measurement, along each axis',
        high=0.1,
        open_low=True,
    )
    drift: float = constant(
        5e-4, 'm', 'standard deviation of a slow error of the tip sensor; 0, one and three times '
        'as much is considered',
    )  # fmt: skip


#: What happens before contact along a plan.
STOP_HERE, WITHDRAW, REPLAN = CONTACT_ACTIONS = 'stop', 'retract', 'replan'


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactSettings(CheckedSettings):
    """Monitoring of the clearance along a plan."""

    limit: float = constant(
        0.2,
        '1',
        'largest probability of contact along a plan before each motion; 1: not monitored',
        high=1.0,
    )
    action: str = choice(STOP_HERE, CONTACT_ACTIONS, 'what happens above the limit')
    registration: float = constant(
        5e-4, 'm', 'standard deviation of the anatomy from the frame of the plan along each axis'
    )


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
        3e-3, 'm', 'largest difference between tip depth and insertion depth at the first '
        'measurement, and its largest change', open_low=True,
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
