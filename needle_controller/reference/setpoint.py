"""What every reference is made of: setpoints over time, and limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from needle_ros.settings import check_constants, constant

#: Relative rounding error by which a limit may be exceeded.
ROUNDING: Final = 1e-9

#: Shortest duration of a motion [s].
SHORTEST: Final = 1e-3

#: Factor by which a motion is made longer until it is within its limits.
LONGER: Final = 1.1


class Setpoint(NamedTuple):
    """
    Desired position, speed and acceleration of an axis.

    Attributes
    ----------
    position : float
        Inserted length [m] or angle [rad].
    speed, acceleration : float
        Its first and second derivative in time.

    """

    position: float
    speed: float = 0.0
    acceleration: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceLimits:
    """Limits of a reference."""

    speed: float = constant(0.01, 'm/s', 'highest speed of the reference', open_low=True)
    acceleration: float = constant(
        0.1, 'm/s^2', 'highest acceleration of the reference', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)


class Reference(Protocol):
    """A motion that ends at rest. Times count from its start [s]."""

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""

    def at(self, time: float) -> Setpoint:
        """
        Return the setpoint at a time.

        Parameters
        ----------
        time : float
            Time since the start [s]. Before the start and after the end the reference rests.

        Returns
        -------
        Setpoint
            Desired position, speed and acceleration.

        """


def around(depths: tuple[float, float], start: Setpoint) -> tuple[float, float]:
    """
    Widen a range of depths to include the start: a needle outside has to come back.

    Parameters
    ----------
    depths : tuple of float
        Least and largest inserted length [m].
    start : Setpoint
        Where the motion starts.

    Returns
    -------
    tuple of float
        The wider range [m].

    """
    return min(depths[0], start.position), max(depths[1], start.position)
