"""Inverse dynamics control, section 3.2.7.1 of the paper, in sampled form."""

from __future__ import annotations

from dataclasses import dataclass

from needle_controller.compiled.laws import INVERSE_DYNAMICS
from needle_controller.laws.law import Law, LawGains
from needle_ros.settings import check_constants, constant


@dataclass(frozen=True, slots=True, kw_only=True)
class InverseDynamicsGains(LawGains):
    """Gains of the closed loop e_ddot + kv e_dot + kp e = 0 on one axis."""

    kp: float = constant(900.0, '1/s^2', 'position gain k_p')
    kv: float = constant(60.0, '1/s', 'speed gain k_v')
    breakaway_speed: float = constant(
        1e-4, '(m or rad)/s', 'commanded speed at which Coulomb friction is fully compensated',
        open_low=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_constants(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class InverseDynamics(Law):
    r"""
    The law F_c = M (q_ddot_d + k_v e_dot + k_p e) + N' on one axis, for a sample period h.

    With a = q_ddot_d + k_v e_dot + k_p e the axis shall have the speed u + h a after the
    period. The force that does this exactly under viscous friction, held over the period, is

    .. math:: f = \mu_v \frac{u + h a - u e^{-x}}{1 - e^{-x}}, \quad x = \mu_v h / M

    It tends to M a + mu_v u as h -> 0 (the continuous law), and to mu_v times the predicted
    speed if friction is fast compared with the period. Coulomb friction is compensated in the
    direction of the predicted speed. At rest that is the direction of the wanted acceleration,
    so that the law breaks away.

    Attributes
    ----------
    gains : InverseDynamicsGains
        Gains.

    Examples
    --------
    The force that starts a needle of 0.2 kg at rest towards a target 1 mm away:

    >>> from needle_controller import Axis, InverseDynamics, InverseDynamicsGains, Setpoint
    >>> from needle_controller import no_memory
    >>> axis = Axis(inertia=0.2, viscous=300.0, coulomb=0.56)
    >>> law = InverseDynamics(axis=axis, gains=InverseDynamicsGains(), period=1e-3)
    >>> print(f'{law.force(0.02, 0.0, Setpoint(0.021), no_memory()):.2f} N')
    0.91 N

    """

    gains: InverseDynamicsGains

    def __post_init__(self) -> None:
        gains = self.gains
        self._set_constants(gains.breakaway_speed, kind=INVERSE_DYNAMICS, kp=gains.kp, kd=gains.kv)
