# SPDX-License-Identifier: Apache-2.0
"""Displacement monitor: compare measured displacements with measured velocities."""

from math import exp
from typing import Final

_MEMORY: Final = 2.0  #: Time over which positions and velocities are compared [s].


class DisplacementMonitor:
    """
    Compare the displacement between two measurements with their velocities.

    `jump` is the largest inconsistent displacement [m], at once or within the last seconds, and
    `longest` the longest time between two measurements that can be compared [s].
    """

    def __init__(self, jump: float, longest: float) -> None:
        self._jump, self._longest = jump, longest
        self.forget()

    def forget(self) -> None:
        #: Time [s], insertion depth [m] and velocity [m/s] of the last measurement.
        self._last: tuple[float, float, float] | None = None
        #: Displacement unexplained by the velocities of the last seconds [m].
        self._unexplained = 0.0

    def gap(self, time: float) -> float:
        """Return the time since the last measurement [s] if it is too long or negative; else 0."""
        elapsed = time - self._last[0] if self._last is not None else 0.0
        return 0.0 if 0.0 <= elapsed <= self._longest else elapsed

    def fault(self, time: float, depth: float, velocity: float) -> str | None:
        """Add a measurement; return why its displacement is inconsistent, or None."""
        gap, before, self._last = self.gap(time), self._last, (time, depth, velocity)
        if before is None or gap:
            self._unexplained = 0.0
            return None
        last, old, earlier = before
        elapsed, moved = time - last, depth - old
        rest = moved - 0.5 * (earlier + velocity) * elapsed
        if not abs(rest) <= self._jump:
            # The position jumped; the next measurements may be consistent.
            self._unexplained = 0.0
            return (
                f'insertion moved by {moved:.6g} m in {elapsed:.6g} s at velocities of '
                f'{earlier:.6g} and {velocity:.6g} m/s'
            )
        unexplained = exp(-elapsed / _MEMORY) * self._unexplained + rest
        # Clipped, so that the fault ends as soon as position and velocity agree again.
        self._unexplained = min(max(unexplained, -self._jump), self._jump)
        if abs(unexplained) > self._jump:
            return (
                f'insertion and its velocity contradict each other: {1e3 * abs(unexplained):.3g} '
                f'mm too {"much" if unexplained > 0.0 else "little"} within {_MEMORY:g} s'
            )
        return None
