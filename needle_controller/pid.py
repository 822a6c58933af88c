"""PID control, section 3.2.7.2 of the source, in the implicit sampled form."""

from __future__ import annotations

from dataclasses import dataclass, replace

from needle_controller.axis import Axis, Setpoint
from needle_dynamics.parameters import check_constants, constant


@dataclass(frozen=True, slots=True, kw_only=True)
class PidGains:
    """Gains of f = kp e + ki int e dt + kd e_dot, per axis."""

    kp: float = constant(6000.0, 'N/m or N m/rad', 'proportional gain')
    ki: float = constant(30000.0, 'N/(m s) or N m/(rad s)', 'integral gain')
    kd: float = constant(100.0, 'N s/m or N m s/rad', 'derivative gain')
    tolerance: float = constant(
        2e-5, 'm or rad', 'error at rest below which the integral is frozen (no hunting)'
    )

    def __post_init__(self) -> None:
        check_constants(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pid:
    """
    PID evaluated at the end of the period that its own force brings about.

    The textbook sampled form takes the error at the start of the period and is unstable as soon
    as kd exceeds about mass / period + friction. Here error and rate are those predicted for
    the end of the period with the force itself in the prediction (a linear equation for it):
    high gains then tend to reaching the reference in one period instead of to overshoot.

    Attributes
    ----------
    axis : Axis
        Axis as the law believes it to be; its Coulomb friction is left to the integral.
    gains : PidGains
        Gains.
    period : float
        Sample period h [s].

    """

    axis: Axis
    gains: PidGains
    period: float

    def force(
        self, position: float, speed: float, setpoint: Setpoint, memory: float, load: float
    ) -> float:
        """Return the force for the next period, before any limit; ``memory`` is int e dt."""
        del load
        gains, h = self.gains, self.period
        decay, gain, drift, shift = self.axis.response(h)
        error = setpoint.position + h * setpoint.speed - position - drift * speed
        error_rate = setpoint.speed + h * setpoint.acceleration - decay * speed
        stiffness = gains.kp + h * gains.ki
        push = stiffness * error + gains.kd * error_rate + gains.ki * memory
        return push / (1.0 + stiffness * shift + gains.kd * gain)

    def remember(self, memory: float, position: float, setpoint: Setpoint, excess: float) -> float:
        """Integrate the error, but not further into a limit nor within the tolerance at rest."""
        error = setpoint.position - position
        at_rest = setpoint.speed == 0.0 and setpoint.acceleration == 0.0
        if excess * error > 0.0 or (at_rest and abs(error) < self.gains.tolerance):
            return memory
        return memory + self.period * error

    def linear(self) -> Pid:
        """Return the same law without Coulomb friction and tolerance."""
        return replace(
            self, axis=self.axis.without_coulomb(), gains=replace(self.gains, tolerance=0.0)
        )

    def scaled(self, factor: float) -> Pid:
        """Return the same law with all gains times a factor."""
        gains = self.gains
        kp, ki, kd = factor * gains.kp, factor * gains.ki, factor * gains.kd
        return replace(self, gains=replace(gains, kp=kp, ki=ki, kd=kd))
