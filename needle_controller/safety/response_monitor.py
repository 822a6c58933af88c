"""Response monitor: check that the plant follows its commands."""

from __future__ import annotations

from typing import Final, NamedTuple

from needle_ros.timing import NANOSECONDS

#: Time without response after which the plant does not follow [ns].
_PATIENCE: Final = NANOSECONDS // 10

#: Least response, as a fraction of the commanded force or of the distance of the reference.
_NOTHING: Final = 0.1


class _Mark(NamedTuple):
    """Stamp [ns], insertion depth and reference depth [m] at the start of a lack of response."""

    stamp: int
    depth: float
    aim: float


class ResponseMonitor:
    """
    Compare the commanded force with the response that the robot reports.

    A plant does not follow if it reports almost no force while a force is commanded, and the
    needle rests while its reference moves. It follows again as soon as one of these conditions
    ends. A robot that reports no force is not checked. ``lost`` is whether the plant does not
    follow.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Reset to a plant that follows."""
        self.lost = False
        self._mark: _Mark | None = None

    def update(
        self, stamp: int, depth: float, aim: float, commanded: float, reported: float
    ) -> bool:
        """
        Process a measurement at a stamp [ns]; return whether the plant does not follow.

        Takes insertion depth and reference depth [m], and the last commanded and the reported
        force [N]; the latter is NaN if the robot reports none.
        """
        # Without a command no response is expected.
        if commanded == 0.0 or not abs(reported) < _NOTHING * abs(commanded):
            self.forget()
            return False
        if self._mark is None:
            self._mark = _Mark(stamp, depth, aim)
        mark = self._mark
        moved = abs(depth - mark.depth) > _NOTHING * abs(aim - mark.aim)
        if self.lost and moved:
            self.forget()
        elif not self.lost and stamp - mark.stamp > _PATIENCE:
            self.lost = not moved and aim != mark.aim
            if not self.lost:
                self._mark = None
        return self.lost
