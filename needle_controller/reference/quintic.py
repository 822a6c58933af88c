# SPDX-License-Identifier: Apache-2.0
"""Motions of least integrated squared jerk: polynomials of fifth order in time."""

from math import inf, sqrt
from typing import Final

from needle_controller.compiled.quintic import quintic_extremes
from needle_controller.reference.setpoint import (
    around,
    LONGER,
    Reference,
    ReferenceLimits,
    ROUNDING,
    Setpoint,
    SHORTEST,
)
from needle_dynamics import FloatArray
import numpy as np

PEAK_SPEED: Final = 15.0 / 8.0  #: Highest speed of a quintic from rest to rest over its mean.

#: Highest acceleration of such a quintic, times its squared duration over its distance.
PEAK_ACCELERATION: Final = 10.0 / sqrt(3.0)


class Quintic(Reference):
    """Motion of least integrated squared jerk between two setpoints in a given duration [s]."""

    def __init__(self, start: Setpoint, end: Setpoint, duration: float) -> None:
        self.duration = t = duration
        self.start, self.end = start, end
        v0, a0 = start.velocity * t, start.acceleration * t * t
        v1, a1 = end.velocity * t, end.acceleration * t * t
        d = end.position - start.position
        # Powers of time over duration.
        c3 = 10.0 * d - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1
        c4 = -15.0 * d + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1
        c5 = 6.0 * d - 3.0 * (v0 + v1) - 0.5 * (a0 - a1)
        self._c = start.position, v0, 0.5 * a0, c3, c4, c5

    def at(self, time: float) -> Setpoint:
        if time >= self.duration:
            return self.end
        if time <= 0.0:
            return self.start
        t = self.duration
        x = time / t
        p, v, a, c3, c4, c5 = self._c
        return Setpoint(
            p + x * (v + x * (a + x * (c3 + x * (c4 + x * c5)))),
            (v + x * (2.0 * a + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))) / t,
            (2.0 * a + x * (6.0 * c3 + x * (12.0 * c4 + x * 20.0 * c5))) / (t * t),
        )

    def within(self, limits: ReferenceLimits) -> bool:
        """Return whether the motion is within limits, or within larger values of its ends."""
        ends = self.start, self.end
        top = max(limits.speed, *(abs(end.velocity) for end in ends)) * (1.0 + ROUNDING)
        ramp = max(limits.acceleration, *(abs(end.acceleration) for end in ends))
        ramp *= 1.0 + ROUNDING
        _, velocity, acceleration = self.extremes
        return bool(np.abs(acceleration).max() <= ramp and np.abs(velocity).max() <= top)

    def stays(self, depths: tuple[float, float]) -> bool:
        """Return whether all positions are in a range [m], up to rounding."""
        low, high = depths
        least, largest = self.extremes[0]
        slack = ROUNDING * (high - low) if high - low < inf else 0.0
        return bool(low - slack <= least and largest <= high + slack)

    @property
    def extremes(self) -> FloatArray:
        """Range of position [m], velocity [m/s] and acceleration [m/s^2], shape (3, 2)."""
        t = self.duration
        return np.asarray(quintic_extremes(np.array(self._c)) / [[1.0], [t], [t * t]])


def shortest(distance: float, limits: ReferenceLimits) -> float:
    """Return the duration [s] of the fastest quintic from rest to rest over a distance [m]."""
    return max(
        PEAK_SPEED * distance / limits.speed,
        sqrt(PEAK_ACCELERATION * distance / limits.acceleration),
        SHORTEST,
    )


class MinimumJerk(Reference):
    """
    Fastest quintic motion to a target within the limits.

    Parameters
    ----------
    start : Setpoint
        Start of the motion, with velocity and acceleration.
    target : float
        Position of the end, at rest [m].
    limits : ReferenceLimits
        Limits; values that the start already exceeds are allowed.
    depths : tuple of float
        Lowest and highest position of the motion [m]; the start is always allowed.

    """

    def __init__(
        self,
        start: Setpoint,
        target: float,
        limits: ReferenceLimits,
        depths: tuple[float, float] = (-inf, inf),
    ) -> None:
        depths = around(depths, start)
        least = max(
            shortest(abs(target - start.position), limits),
            2.0 * abs(start.velocity) / limits.acceleration,
        )
        end = Setpoint(target)
        motion = Quintic(start, end, least)
        at_rest = start.velocity == 0.0 and start.acceleration == 0.0

        def fits() -> bool:
            return at_rest or (motion.within(limits) and motion.stays(depths))

        while not fits() and motion.duration < 100.0 * least:
            motion = Quintic(start, end, LONGER * motion.duration)
        self._halt = Quintic(start, start, 0.0)
        if not fits():
            # No single quintic is within the limits: stop first.
            self._halt = halt(start, limits, depths)
            rest = self._halt.end
            motion = Quintic(rest, end, shortest(abs(target - rest.position), limits))
        self._motion = motion
        self.duration = motion.duration + self._halt.duration

    def at(self, time: float) -> Setpoint:
        halting = self._halt.duration
        return self._halt.at(time) if time < halting else self._motion.at(time - halting)


def halt(
    start: Setpoint, limits: ReferenceLimits, depths: tuple[float, float] = (-inf, inf)
) -> Quintic:
    """
    Return the motion to rest without reversal, within the acceleration limit.

    If it would leave the range of depths [m], which is extended to the start, it ends at the end
    of the range, with the deceleration that this requires. The initial acceleration fades, so that
    the velocity may first increase by up to 4/27 of acceleration times duration.
    """
    depths = around(depths, start)
    v, a = start.velocity, start.acceleration
    time = max(1.5 * abs(v) / limits.acceleration, SHORTEST)

    def motion() -> Quintic:
        end = Setpoint(start.position + time * (0.5 * v + time * a / 12.0))
        return Quintic(start, end, time)

    # The velocity is a cubic: for long durations its acceleration tends to the initial value.
    for _ in range(40):
        peak = np.abs(motion().extremes[2]).max()
        if peak <= max(limits.acceleration, abs(a)) * (1.0 + ROUNDING):
            break
        time *= LONGER
    found = motion()
    if found.stays(depths):
        return found
    end = Setpoint(depths[1] if v > 0.0 or (v == 0.0 and a > 0.0) else depths[0])
    # The longest duration that does not pass the end first.
    short, long = 0.0, time
    for _ in range(30):
        middle = 0.5 * (short + long)
        if Quintic(start, end, middle).stays(depths):
            short = middle
        else:
            long = middle
    return Quintic(start, end, short or long)
