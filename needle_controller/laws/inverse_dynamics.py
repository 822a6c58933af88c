"""Inverse dynamics control, section 3.2.7.1 of the source, in sampled form."""

from __future__ import annotations

from dataclasses import dataclass, replace

from needle_controller.compiled import laws as kernels
from needle_controller.laws.axis import Law
from needle_ros.settings import check_constants, constant


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

    def slots(self) -> dict[str, float]:
        """Return the gains by the names of their slots in `needle_controller.compiled.laws`."""
        return {'LAW': kernels.INVERSE_DYNAMICS, 'KP': self.kp, 'KD': self.kv}

    def scaled(self, factor: float) -> InverseDynamicsGains:
        """Return all gains times a factor."""
        return replace(self, kp=factor * self.kp, kv=factor * self.kv)


@dataclass(frozen=True, slots=True, kw_only=True)
class InverseDynamics(Law):
    r"""
    The law F_c = M (q_ddot_d + k_v e_dot + k_p e) + N' on one axis, for a sample period h.

    With a = q_ddot_d + k_v e_dot + k_p e the axis shall have the speed u + h a after the
    period. The force that does this exactly under viscous friction, held over the period, is

    .. math:: f = \mu_v \frac{u + h a - u e^{-x}}{1 - e^{-x}}, \quad x = \mu_v h / M

    which tends to M a + mu_v u as h -> 0 (the continuous law), and to mu_v at the predicted
    speed when friction is fast against the period; on an axis with stiffness its response takes
    the place of the exponential. Coulomb friction is compensated in the direction of the
    predicted speed: at rest that is the direction of the wanted acceleration, so that the law
    breaks away.

    Attributes
    ----------
    gains : InverseDynamicsGains
        Gains.

    """

    gains: InverseDynamicsGains

    def __post_init__(self) -> None:
        self._set_constants(self.gains.breakaway_speed, **self.gains.slots())

    def scaled(self, factor: float) -> InverseDynamics:
        """Return the same law with all gains times a factor."""
        return replace(self, gains=self.gains.scaled(factor))
