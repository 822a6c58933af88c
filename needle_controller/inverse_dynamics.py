"""Inverse dynamics control, section 3.2.7.1 of the source, in sampled form."""

from __future__ import annotations

from dataclasses import dataclass, replace

from needle_controller.axis import Axis, Setpoint
from needle_dynamics.parameters import check_constants, constant


@dataclass(frozen=True, slots=True, kw_only=True)
class InverseDynamicsGains:
    """Gains of the closed loop e_ddot + kv e_dot + kp e = 0, per axis."""

    kp: float = constant(900.0, '1/s^2', 'position gain k_p')
    kv: float = constant(60.0, '1/s', 'speed gain k_v')
    breakaway_speed: float = constant(
        1e-4, '(m or rad)/s', 'commanded speed at which Coulomb friction is fully compensated',
        open_low=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_constants(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class InverseDynamics:
    r"""
    The law F_c = M (q_ddot_d + k_v e_dot + k_p e) + N' on one axis, for a sample period h.

    With a = q_ddot_d + k_v e_dot + k_p e the axis shall have the speed u + h a after the
    period. The force that does this exactly under viscous friction, held over the period, is

    .. math:: f = \mu_v \frac{u + h a - u e^{-x}}{1 - e^{-x}}, \quad x = \mu_v h / M

    which tends to M a + mu_v u as h -> 0 (the continuous law), and to mu_v at the predicted
    speed when friction is fast against the period. Coulomb friction is compensated in the
    direction of the predicted speed: at rest that is the direction of the wanted acceleration,
    so that the law breaks away.

    Attributes
    ----------
    axis : Axis
        Axis as the law believes it to be.
    gains : InverseDynamicsGains
        Gains.
    period : float
        Sample period h [s].

    """

    axis: Axis
    gains: InverseDynamicsGains
    period: float

    def force(
        self, position: float, speed: float, setpoint: Setpoint, memory: float, load: float
    ) -> float:
        """Return the force for the next period, before any limit."""
        del memory
        gains = self.gains
        acceleration = (
            setpoint.acceleration
            + gains.kv * (setpoint.speed - speed)
            + gains.kp * (setpoint.position - position)
        )
        predicted = speed + self.period * acceleration
        decay, gain, _, _ = self.axis.response(self.period)
        coulomb = self.axis.coulomb * min(max(predicted / gains.breakaway_speed, -1.0), 1.0)
        return (predicted - decay * speed) / gain + coulomb + load

    def remember(self, memory: float, position: float, setpoint: Setpoint, excess: float) -> float:
        """Return the memory unchanged: the law has none."""
        del position, setpoint, excess
        return memory

    def linear(self) -> InverseDynamics:
        """Return the same law without Coulomb friction."""
        return replace(self, axis=self.axis.without_coulomb())

    def scaled(self, factor: float) -> InverseDynamics:
        """Return the same law with all gains times a factor."""
        gains = self.gains
        return replace(self, gains=replace(gains, kp=factor * gains.kp, kv=factor * gains.kv))
