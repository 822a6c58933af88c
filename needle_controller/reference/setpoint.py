# SPDX-License-Identifier: Apache-2.0
"""Setpoints over time and their limits: the interface of all references."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final, NamedTuple

from needle_ros.settings import CheckedSettings, positive

ROUNDING: Final = 1e-9  #: Relative rounding error by which a limit may be exceeded.
SHORTEST: Final = 1e-3  #: Shortest duration of a motion [s].
LONGER: Final = 1.1  #: Factor by which a motion is made longer until it is within its limits.


class Setpoint(NamedTuple):
    """Desired position, velocity and acceleration of an axis."""

    position: float  #: insertion depth [m] or angle [rad]
    velocity: float = 0.0  #: its rate
    acceleration: float = 0.0  #: rate of the velocity


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceLimits(CheckedSettings):
    """Limits of a reference."""

    speed: float = positive(0.01, 'm/s', 'highest speed of the reference')
    acceleration: float = positive(0.1, 'm/s^2', 'highest acceleration of the reference')


class Reference(ABC):
    """Motion that ends at rest, with times from its start [s]."""

    duration: float  #: Duration of the motion [s].

    @abstractmethod
    def at(self, time: float) -> Setpoint:
        """Return the setpoint at a time since the start [s]; it rests before and after."""


def around(depths: tuple[float, float], start: Setpoint) -> tuple[float, float]:
    """Extend a range of depths [m] to the start of a motion, so that the needle can return."""
    return min(depths[0], start.position), max(depths[1], start.position)
