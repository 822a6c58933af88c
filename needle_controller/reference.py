"""References from where the needle is to a target, within limits of speed and acceleration."""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, sqrt
from typing import Protocol

from needle_controller.axis import Setpoint
from needle_dynamics.parameters import check_constants, constant
import numpy as np
from numpy.polynomial import Polynomial


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceLimits:
    """Limits of the reference."""

    speed: float = constant(0.01, 'm/s', 'highest speed of the reference', open_low=True)
    acceleration: float = constant(
        0.1, 'm/s^2', 'highest acceleration of the reference', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)


class Reference(Protocol):
    """A motion that ends at rest; times count from its start [s]."""

    @property
    def duration(self) -> float:
        """Time to the end [s]."""

    def at(self, time: float) -> Setpoint:
        """Return where the reference is; before the start and after the end it rests."""


class Trapezoid:
    """
    The fastest motion within the limits: ramp up, cruise, ramp down.

    Parameters
    ----------
    start : Setpoint
        Where it begins; its acceleration does not count.
    target : float
        Where it ends, at rest [m].
    limits : ReferenceLimits
        Limits; a higher initial speed is braked first.

    """

    def __init__(self, start: Setpoint, target: float, limits: ReferenceLimits) -> None:
        top, ramp = limits.speed, limits.acceleration
        position, speed = start.position, start.speed
        #: (duration, acceleration) of each part.
        parts: list[tuple[float, float]] = []
        # Brake what cannot belong to the motion: the wrong way, too fast, or too far.
        stop = position + copysign(speed * speed / (2.0 * ramp), speed)
        sign = copysign(1.0, target - stop)
        if speed * sign < 0.0:
            parts.append((abs(speed) / ramp, -copysign(ramp, speed)))
            position, speed = stop, 0.0
        elif abs(speed) > top:
            slowing = (abs(speed) - top) / ramp
            parts.append((slowing, -sign * ramp))
            position += sign * slowing * (abs(speed) + top) / 2.0
            speed = sign * top
        v0 = abs(speed)
        distance = abs(target - position)
        peak = min(top, sqrt(ramp * distance + 0.5 * v0 * v0))
        cruise = distance - (2.0 * peak * peak - v0 * v0) / (2.0 * ramp)
        parts.append((max(0.0, peak - v0) / ramp, sign * ramp))
        parts.append((max(0.0, cruise) / peak if peak > 0.0 else 0.0, 0.0))
        parts.append((peak / ramp, -sign * ramp))
        self._start = start
        self._target = target
        self._parts = parts
        self.duration = sum(part[0] for part in parts)

    def at(self, time: float) -> Setpoint:
        """Return where the reference is."""
        if time >= self.duration:
            return Setpoint(self._target)
        position, speed = self._start.position, self._start.speed
        if time <= 0.0:
            return Setpoint(position, speed)
        for duration, acceleration in self._parts:
            t = min(time, duration)
            position += t * (speed + 0.5 * t * acceleration)
            speed += t * acceleration
            time -= t
            if time <= 0.0:
                break
        return Setpoint(position, speed, acceleration)


class MinimumJerk:
    """
    The quintic of least integrated squared jerk, as short as the limits allow.

    Parameters
    ----------
    start : Setpoint
        Where it begins, with its speed and acceleration.
    target : float
        Where it ends, at rest [m].
    limits : ReferenceLimits
        Limits; what the start already exceeds is not held against it.

    """

    def __init__(self, start: Setpoint, target: float, limits: ReferenceLimits) -> None:
        self._start = start
        self._target = target
        distance = abs(target - start.position)
        # Rest to rest: the peaks of the quintic are 15/8 D/T and 10/sqrt(3) D/T^2.
        shortest = max(
            1.875 * distance / limits.speed,
            sqrt(10.0 / sqrt(3.0) * distance / limits.acceleration),
            2.0 * abs(start.speed) / limits.acceleration,
        )
        self._fit(max(shortest, 1e-3))
        at_rest = start.speed == 0.0 and start.acceleration == 0.0
        top = max(limits.speed, abs(start.speed)) * (1.0 + 1e-9)
        ramp = max(limits.acceleration, abs(start.acceleration)) * (1.0 + 1e-9)
        while not at_rest and not self._within(top, ramp) and self.duration < 100.0 * shortest:
            self._fit(1.1 * self.duration)

    def _fit(self, duration: float) -> None:
        """Take the quintic of this duration; its variable is time over duration."""
        t = duration
        p0, v0, a0 = self._start.position, self._start.speed * t, self._start.acceleration * t * t
        d = self._target - p0
        self.duration = t
        self._position = Polynomial(
            [
                p0,
                v0,
                0.5 * a0,
                10.0 * d - 6.0 * v0 - 1.5 * a0,
                -15.0 * d + 8.0 * v0 + 1.5 * a0,
                6.0 * d - 3.0 * v0 - 0.5 * a0,
            ]
        )
        self._speed = self._position.deriv()
        self._acceleration = self._speed.deriv()

    def _within(self, top: float, ramp: float) -> bool:
        t = self.duration
        return bool(_peak(self._speed) <= top * t and _peak(self._acceleration) <= ramp * t * t)

    def at(self, time: float) -> Setpoint:
        """Return where the reference is."""
        if time >= self.duration:
            return Setpoint(self._target)
        if time <= 0.0:
            return self._start
        t = self.duration
        x = time / t
        return Setpoint(
            float(self._position(x)),
            float(self._speed(x)) / t,
            float(self._acceleration(x)) / (t * t),
        )


def _peak(curve: Polynomial) -> float:
    """Return the largest modulus of a polynomial on [0, 1]."""
    turns = curve.deriv().roots()
    inside = turns.real[(abs(turns.imag) < 1e-9) & (turns.real > 0.0) & (turns.real < 1.0)]
    return float(abs(curve(np.concatenate([[0.0, 1.0], inside]))).max())


#: References by name.
REFERENCES: dict[str, type[Trapezoid] | type[MinimumJerk]] = {
    'trapezoid': Trapezoid,
    'minimum_jerk': MinimumJerk,
}
