# SPDX-License-Identifier: Apache-2.0
"""Control laws of section 3.2.7 of the paper, sampled: PID, inverse dynamics, adaptive."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, Final

from needle_controller.compiled.laws import INVERSE_DYNAMICS, PID
from needle_controller.laws.law import Law, LawGains
from needle_ros.settings import choice, constant, flag, positive

#: Methods against integrator windup by name.
ANTI_WINDUP: Final = ('conditional', 'back_calculation')

#: Feedback at a bandwidth b: added damping as a fraction of viscous friction, bandwidth of the
#: integral as a fraction of b, and the reduction of b to b / (1 + 5 b h). With these values the
#: loop is stable for errors of 50 % of friction and inertia, see docs/control.md.
_DAMPING: Final = 1.0 / 3.0
_INTEGRAL: Final = 0.25
_PERIODS: Final = 5.0

BANDWIDTH: Final = 30.0  #: Default bandwidth of the feedback [1/s].


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


@dataclass(frozen=True, slots=True, kw_only=True)
class InverseDynamicsGains(LawGains):
    """Gains of the motion e_ddot + kv e_dot + kp e = 0 on one axis, and of its feedback."""

    kp: float = constant(900.0, '1/s^2', 'position gain k_p')
    kv: float = constant(60.0, '1/s', 'velocity gain k_v')
    breakaway_speed: float = positive(
        1e-4, '(m or rad)/s', 'commanded speed at which Coulomb friction is fully compensated'
    )
    bandwidth: float = constant(
        BANDWIDTH, '1/s', 'bandwidth of the feedback that corrects deviations from the modeled '
        'motion; 0: no feedback, as in the paper',
    )  # fmt: skip
    tolerance: float = constant(
        5e-6, 'm or rad', 'error at rest below which the integral is frozen (no hunting)'
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class InverseDynamics(Law):
    r"""
    The law F_c = M (q_ddot_d + k_v e_dot + k_p e) + N' on one axis, for a sample period h.

    With a = q_ddot_d + k_v e_dot + k_p e the desired velocity after the period is u + h a. The
    constant force over the period that achieves it exactly under viscous friction is

    .. math:: f = \mu_v \frac{u + h a - u e^{-x}}{1 - e^{-x}}, \quad x = \mu_v h / M

    It tends to M a + mu_v u as h -> 0 (the continuous law), and to mu_v times the desired velocity
    if friction is fast compared with the period. Dry friction is compensated in the direction of
    the predicted velocity. At rest this is the direction of the desired acceleration, so that the
    law breaks away.

    In the paper u is measured. Friction smaller than modeled is then overcompensated, which makes
    the loop unstable. Here u and e are states of a *modeled motion*, which starts at the
    measurement and moves under exactly the force above. With an exact model the needle follows
    the modeled motion, and the law equals the law of the paper. Deviations are corrected by an
    implicit PID feedback (see `Pid`), whose gains follow from its bandwidth b:

    .. math:: k_d = \mu_v / 3 + 2 b M, \quad k_p' = b (\mu_v + k_d), \quad k_i = b k_p' / 4

    Friction compensation is then outside of the loop and cannot make it unstable. With
    ``bandwidth=0`` the law equals the law of the paper: the modeled motion restarts in each
    period.

    Examples
    --------
    The force that starts a needle of 0.2 kg at rest towards a target 1 mm away:

    >>> from needle_controller import Axis, InverseDynamics, InverseDynamicsGains, Setpoint
    >>> from needle_controller.laws.law import no_memory
    >>> axis = Axis(inertia=0.2, viscous=300.0, coulomb=0.56)
    >>> law = InverseDynamics(axis=axis, gains=InverseDynamicsGains(), period=1e-3)
    >>> print(f'{law.force(0.02, 0.0, Setpoint(0.021), no_memory()):.2f} N')
    0.91 N

    """

    gains: InverseDynamicsGains

    def __post_init__(self) -> None:
        gains, axis = self.gains, self.axis
        b = gains.bandwidth / (1.0 + _PERIODS * gains.bandwidth * self.period)
        kd = _DAMPING * axis.viscous + 2.0 * b * axis.inertia if b > 0.0 else 0.0
        kp = b * (axis.viscous + kd)
        self._set_constants(
            gains.breakaway_speed,
            kind=INVERSE_DYNAMICS,
            feed_forward=1.0,
            model_kp=gains.kp,
            model_kv=gains.kv,
            kp=kp,
            ki=_INTEGRAL * b * kp,
            kd=kd,
            tolerance=gains.tolerance,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptiveGains(InverseDynamicsGains):
    """Gains of inverse dynamics with friction adaptation."""

    learn: bool = flag(True, 'adapt the friction; false freezes the learned friction')
    bound: float = constant(
        0.5, '1', 'largest learned change of dry and of viscous friction, relative to the model',
        high=10.0,
    )  # fmt: skip
    noise: float = positive(
        0.05, 'N or N m', 'standard deviation of the force not explained by the friction model'
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Adaptive(InverseDynamics):
    """
    `InverseDynamics` with adaptation of friction, see `needle_controller.compiled.laws`.

    In each direction it estimates corrections of dry friction, viscous friction and dry friction
    per insertion depth. They enter the feed-forward of the modeled motion only and are bounded for
    every measurement: a bounded external force on the loop of inverse dynamics.
    """

    LINEAR: ClassVar[Mapping[str, Any]] = {'learn': False, 'bound': 0.0}

    gains: AdaptiveGains

    def __post_init__(self) -> None:
        # Without arguments, super does not work in a dataclass with slots.
        InverseDynamics.__post_init__(self)
        noise = self.gains.noise if self.gains.learn else inf
        constants = self.constants._replace(bound=float(self.gains.bound), noise=float(noise))
        object.__setattr__(self, 'constants', constants)
        object.__setattr__(self, 'packed', tuple(constants))
