# SPDX-License-Identifier: Apache-2.0
"""Response monitor: check that plant and encoders follow the commands."""

from __future__ import annotations

from math import isnan
from typing import Final, NamedTuple

from needle_controller.laws.axis import Axis
from needle_dynamics import NeedleParameters
from needle_ros.timing import NANOSECONDS

#: Time without response after which the plant does not follow [ns].
_PATIENCE: Final = NANOSECONDS // 10

#: Least response, as a fraction of the commanded force or of the distance of the reference.
_NOTHING: Final = 0.1


#: Longest time between two measurements that can be compared [s].
_GAP: Final = 0.1

#: Friction of a needle in other tissue, as a multiple of the nominal one: while the reference
#: moves, and while it rests, where the law may approach its target slowly.
_STRONGER, _RESTING = 1.5, 4.0


class _Mark(NamedTuple):
    """Stamp [ns] and insertion depth [m] at the start of a lack of response."""

    stamp: int
    depth: float


class StallMonitor:
    """
    Expect a displacement from the applied force, with stronger friction than the nominal one.

    Encoders that do not move while the expected displacement exceeds ``most`` [m] are frozen, or
    the needle is blocked: no further force may act.
    """

    def __init__(self, axis: Axis, most: float) -> None:
        self.axis, self._most = axis, most
        self.forget()

    def forget(self) -> None:
        """Expect motion from the next measurement on."""
        self._stamp: int | None = None
        self._depth = self._velocity = self._expected = 0.0

    def update(self, stamp: int, depth: float, rate: float, force: float) -> str | None:
        """
        Process a measurement at a stamp [ns] and the force [N] that acted before it.

        Takes insertion depth [m] and velocity of the reference [m/s].

        Returns the fault, or None.
        """
        before, self._stamp = self._stamp, stamp
        factor, axis = _RESTING if rate == 0.0 else _STRONGER, self.axis
        elapsed = (stamp - before) / NANOSECONDS if before is not None else 0.0
        push = abs(force) - factor * axis.coulomb
        if not 0.0 < elapsed < _GAP or push <= 0.0 or self._expected * force < 0.0:
            self._depth, self._velocity, self._expected = depth, 0.0, 0.0
            return None
        # Implicit step: stable for any friction.
        speed = abs(self._velocity) + elapsed / axis.inertia * push
        speed /= 1.0 + elapsed / axis.inertia * factor * axis.viscous
        self._velocity = speed
        self._expected += (speed if force > 0.0 else -speed) * elapsed
        moved = depth - self._depth
        if abs(self._expected) <= self._most:
            return None
        if abs(moved) > _NOTHING * self._most:
            self._depth, self._expected = depth, 0.0
            return None
        return (
            f'the encoders do not move: {1e3 * abs(moved):.3g} mm measured, more than '
            f'{1e3 * self._most:.3g} mm expected at {force:.3g} N; they are frozen, or the needle '
            'is blocked'
        )


class ResponseMonitor:
    """
    Compare the commanded force with the response that the robot reports.

    A plant does not follow if it reports almost no force while a force is commanded, and the
    needle rests while its reference moves. It follows again as soon as one of these conditions
    ends. A robot that reports no force is not checked. ``lost`` is whether the plant does not
    follow. ``fault`` is the fault of the stall monitor, see `StallMonitor` for
    ``most``.
    """

    def __init__(self, parameters: NeedleParameters, most: float) -> None:
        self._stall = StallMonitor(Axis.insertion(parameters), most)
        self.forget()

    def change(self, parameters: NeedleParameters) -> None:
        """Continue with another nominal friction."""
        self._stall.axis = Axis.insertion(parameters)

    def forget(self) -> None:
        """Reset to a plant that follows."""
        self.lost = False
        self.fault: str | None = None
        self._mark: _Mark | None = None
        self._stall.forget()

    def update(
        self, stamp: int, depth: float, rate: float, commanded: float, reported: float
    ) -> bool:
        """
        Process a measurement at a stamp [ns]; return whether the plant does not follow.

        Takes insertion depth [m], velocity of the reference [m/s], also while it waits, and the
        last commanded and the reported force [N]; the latter is NaN if the robot reports none.
        """
        applied = commanded if isnan(reported) else reported
        self.fault = self._stall.update(stamp, depth, rate, applied)
        # Without a command no response is expected.
        if commanded == 0.0 or not abs(reported) < _NOTHING * abs(commanded):
            self.lost, self._mark = False, None
            return False
        if self._mark is None:
            self._mark = _Mark(stamp, depth)
        mark = self._mark
        elapsed = min(stamp - mark.stamp, _PATIENCE) / NANOSECONDS
        moved = abs(depth - mark.depth) > _NOTHING * abs(rate) * elapsed
        if self.lost and moved:
            self.lost, self._mark = False, None
        elif not self.lost and stamp - mark.stamp > _PATIENCE:
            self.lost = not moved and rate != 0.0
            if not self.lost:
                self._mark = None
        return self.lost
