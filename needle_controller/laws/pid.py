# SPDX-License-Identifier: Apache-2.0
"""PID control, section 3.2.7.2 of the paper, in implicit sampled form."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from needle_controller.compiled.laws import PID
from needle_controller.laws.law import Law, LawGains
from needle_ros.settings import choice, constant, flag, positive

#: Methods against integrator windup by name.
ANTI_WINDUP: Final = ('conditional', 'back_calculation')


@dataclass(frozen=True, slots=True, kw_only=True)
class PidGains(LawGains):
    """Gains of f = kp e + ki int e dt + kd e_dot on one axis, with anti-windup and filter."""

    kp: float = constant(6000.0, 'N/m or N m/rad', 'proportional gain')
    ki: float = constant(30000.0, 'N/(m s) or N m/(rad s)', 'integral gain')
    kd: float = constant(100.0, 'N s/m or N m s/rad', 'derivative gain')
    tolerance: float = constant(
        2e-5, 'm or rad', 'error at rest below which the integral is frozen (no hunting)'
    )
    filter_time: float = constant(
        0.0, 's', 'time constant of the low-pass filter of the error rate; 0 for none'
    )
    anti_windup: str = choice('conditional', ANTI_WINDUP)
    tracking_time: float = positive(0.2, 's', 'time constant of back_calculation')
    feed_forward: bool = flag(False, 'add the force of the reference motion on the modeled axis')
    breakaway_speed: float = positive(
        1e-4,
        '(m or rad)/s',
        'speed of the reference at which feed_forward fully includes Coulomb friction',
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Pid(Law):
    """
    PID evaluated at the predicted end of the period.

    The textbook sampled form uses the error at the start of the period. It is unstable if kd
    exceeds about mass / period + friction. Here error and error rate are predicted for the end
    of the period, with the force itself in the prediction: a linear equation for the force. High
    gains then tend to reach the reference in one period instead of overshooting. The filter of
    the error rate is implicit, too.

    Back-calculation removes the force beyond the limit from the integral,
    ki int e dt -> ... - excess / tracking_time. `conditional` stops the integral while it would
    increase the excess. Coulomb friction is compensated by the integral, or by the feed-forward:
    the force that moves the modeled axis exactly along the reference.

    Examples
    --------
    The force on a needle of 0.2 kg at rest, 1 mm from its target:

    >>> from needle_controller import Axis, Pid, PidGains, Setpoint
    >>> from needle_controller.laws.law import no_memory
    >>> axis = Axis(inertia=0.2, viscous=300.0, coulomb=0.56)
    >>> law = Pid(axis=axis, gains=PidGains(), period=1e-3)
    >>> print(f'{law.force(0.02, 0.0, Setpoint(0.021), no_memory()):.2f} N')
    4.75 N

    """

    LINEAR: ClassVar[Mapping[str, Any]] = {'tolerance': 0.0}

    gains: PidGains

    def __post_init__(self) -> None:
        gains, h = self.gains, self.period
        tracks = gains.anti_windup == 'back_calculation'
        self._set_constants(
            gains.breakaway_speed,
            kind=PID,
            kp=gains.kp,
            ki=gains.ki,
            kd=gains.kd,
            tolerance=gains.tolerance,
            filter_time=gains.filter_time,
            # Implicit: stable for every tracking time.
            tracking=h / (gains.tracking_time + h) if tracks else 0.0,
            feed_forward=gains.feed_forward,
        )
