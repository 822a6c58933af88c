# SPDX-License-Identifier: Apache-2.0
"""Fastest motion within the limits, and the target as a step."""

from math import copysign, sqrt

from needle_controller.reference.setpoint import Reference, ReferenceLimits, Setpoint
from needle_dynamics.arrays import FloatArray
import numpy as np


class Step(Reference):
    """Step to the target [m], as in the paper; start and limits are ignored."""

    duration = 0.0

    def __init__(self, start: Setpoint, target: float, limits: ReferenceLimits) -> None:
        del start, limits
        self._target = target

    def at(self, time: float) -> Setpoint:
        del time
        return Setpoint(self._target)


class Trapezoid(Reference):
    """
    Fastest motion to a target [m] within the limits: accelerate, constant speed, brake.

    The acceleration at the start is ignored; a start faster than the limit first brakes.
    """

    def __init__(self, start: Setpoint, target: float, limits: ReferenceLimits) -> None:
        top, ramp = limits.speed, limits.acceleration
        position, velocity = start.position, start.velocity
        parts: list[tuple[float, float]] = []  #: (duration, acceleration) of each part.
        # First brake a motion in the wrong direction, too fast, or too far.
        stop = position + copysign(velocity * velocity / (2.0 * ramp), velocity)
        sign = copysign(1.0, target - stop)
        if velocity * sign < 0.0:
            parts.append((abs(velocity) / ramp, -copysign(ramp, velocity)))
            position, velocity = stop, 0.0
        elif abs(velocity) > top:
            slowing = (abs(velocity) - top) / ramp
            parts.append((slowing, -sign * ramp))
            position += sign * slowing * (abs(velocity) + top) / 2.0
            velocity = sign * top
        v0 = abs(velocity)
        distance = abs(target - position)
        peak = min(top, sqrt(ramp * distance + 0.5 * v0 * v0))
        cruise = distance - (2.0 * peak * peak - v0 * v0) / (2.0 * ramp)
        parts.append((max(0.0, peak - v0) / ramp, sign * ramp))
        parts.append((max(0.0, cruise) / peak if peak > 0.0 else 0.0, 0.0))
        parts.append((peak / ramp, -sign * ramp))
        self._start, self._target, self._parts = start, target, parts
        self.duration = sum(part[0] for part in parts)

    def at(self, time: float) -> Setpoint:
        if time >= self.duration:
            return Setpoint(self._target)
        position, velocity = self._start.position, self._start.velocity
        if time <= 0.0:
            return Setpoint(position, velocity)
        for duration, acceleration in self._parts:
            t = min(time, duration)
            position += t * (velocity + 0.5 * t * acceleration)
            velocity += t * acceleration
            time -= t
            if time <= 0.0:
                break
        return Setpoint(position, velocity, acceleration)

    def sampled(self, times: FloatArray) -> FloatArray:
        """Return the setpoints of `at` as rows, shape (k, 3), for times [s] of shape (k,)."""
        left, found = np.maximum(times, 0.0), np.zeros((3, len(times)))
        position, velocity, acceleration = found
        position[:], velocity[:] = self._start.position, self._start.velocity
        for duration, change in self._parts:
            t = np.minimum(left, duration)
            position += t * (velocity + 0.5 * t * change)
            velocity += t * change
            acceleration[left > 0.0] = change
            left -= t
        found[:, times >= self.duration] = np.array([[self._target], [0.0], [0.0]])
        return found.T
