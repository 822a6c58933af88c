"""PID control, section 3.2.7.2 of the source, in the implicit sampled form."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

from needle_controller.compiled import laws as kernels
from needle_controller.laws.axis import Law
from needle_ros.errors import (
    ParameterError,
)
from needle_ros.settings import check_constants, constant

#: Ways to keep the integral from winding up in a limit, by name.
ANTI_WINDUP: Final = ('conditional', 'back_calculation')


@dataclass(frozen=True, slots=True, kw_only=True)
class PidGains:
    """Gains of f = kp e + ki int e dt + kd e_dot, per axis, and what goes with them."""

    kp: float = constant(6000.0, 'N/m or N m/rad', 'proportional gain')
    ki: float = constant(30000.0, 'N/(m s) or N m/(rad s)', 'integral gain')
    kd: float = constant(100.0, 'N s/m or N m s/rad', 'derivative gain')
    tolerance: float = constant(
        2e-5, 'm or rad', 'error at rest below which the integral is frozen (no hunting)'
    )
    filter_time: float = constant(
        0.0, 's', 'time constant of the low-pass on the rate of the error; 0 for none'
    )
    anti_windup: str = field(
        default='conditional', metadata={'description': f'one of {", ".join(ANTI_WINDUP)}'}
    )
    tracking_time: float = constant(
        0.2, 's', 'time constant in which back_calculation unwinds the integral', open_low=True
    )
    feed_forward: bool = field(
        default=False,
        metadata={'description': 'add the force that the reference takes on the modeled axis'},
    )
    breakaway_speed: float = constant(
        1e-4, '(m or rad)/s', 'speed of the reference at which feed_forward has all of Coulomb '
        'friction', open_low=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_constants(self)
        if self.anti_windup not in ANTI_WINDUP:
            raise ParameterError(
                f'anti_windup must be one of {", ".join(ANTI_WINDUP)}, got {self.anti_windup!r}'
            )
        if not isinstance(self.feed_forward, bool):
            raise ParameterError(f'feed_forward must be true or false, got {self.feed_forward!r}')

    def slots(self, period: float) -> dict[str, float]:
        """Return the gains by the names of their slots in `needle_controller.compiled.laws`."""
        tracks = self.anti_windup == 'back_calculation'
        return {
            'LAW': kernels.PID,
            'KP': self.kp,
            'KI': self.ki,
            'KD': self.kd,
            'TOLERANCE': self.tolerance,
            'FILTER_TIME': self.filter_time,
            # Implicit: no tracking time is too short.
            'TRACKING': period / (self.tracking_time + period) if tracks else 0.0,
            'FEED_FORWARD': float(self.feed_forward),
        }

    def scaled(self, factor: float) -> PidGains:
        """Return all gains times a factor."""
        return replace(self, kp=factor * self.kp, ki=factor * self.ki, kd=factor * self.kd)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pid(Law):
    """
    PID evaluated at the end of the period that its own force brings about.

    The textbook sampled form takes the error at the start of the period and is unstable as soon
    as kd exceeds about mass / period + friction. Here error and rate are those predicted for
    the end of the period with the force itself in the prediction (a linear equation for it):
    high gains then tend to reaching the reference in one period instead of to overshoot. The
    filter of the rate is implicit, too.

    Back-calculation takes the force that a limit took away out of the integral, as
    ki int e dt -> ... - excess / tracking_time; `conditional` stops it while it would drive
    further into the limit. The axis' Coulomb friction is left to the integral, or to the
    feed-forward: the force that gives the modeled axis the motion of the reference exactly.

    Attributes
    ----------
    gains : PidGains
        Gains.

    """

    gains: PidGains

    def __post_init__(self) -> None:
        self._set_constants(self.gains.breakaway_speed, **self.gains.slots(self.period))

    def linear(self) -> Pid:
        """Return the same law without Coulomb friction and tolerance."""
        return replace(
            self, axis=self.axis.without_coulomb(), gains=replace(self.gains, tolerance=0.0)
        )

    def scaled(self, factor: float) -> Pid:
        """Return the same law with all gains times a factor."""
        return replace(self, gains=self.gains.scaled(factor))
