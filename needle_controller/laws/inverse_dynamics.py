# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics control, section 3.2.7.1 of the paper, in sampled form, with feedback."""

from dataclasses import dataclass
from typing import Final

from needle_controller.compiled.laws import INVERSE_DYNAMICS
from needle_controller.laws.law import Law, LawGains
from needle_ros.settings import constant, positive

#: Feedback at a bandwidth b: added damping as a fraction of viscous friction, bandwidth of the
#: integral as a fraction of b, and the reduction of b to b / (1 + 5 b h). With these values the
#: loop is stable for errors of 50 % of friction and inertia, see docs/control.md.
_DAMPING: Final = 1.0 / 3.0
_INTEGRAL: Final = 0.25
_PERIODS: Final = 5.0

BANDWIDTH: Final = 30.0  #: Default bandwidth of the feedback [1/s].


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
