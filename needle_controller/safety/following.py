"""Whether the plant does what is commanded."""

from __future__ import annotations

from typing import Final, NamedTuple

from needle_ros.timing import NANOSECONDS

#: For how long the plant must do nothing before it counts as one that does not follow [ns].
_PATIENCE: Final = NANOSECONDS // 10

#: Less than this part of what is commanded, or of the way that the reference goes, is nothing.
_NOTHING: Final = 0.1


class _Mark(NamedTuple):
    """When the plant began to do nothing, and where needle and reference were then."""

    stamp: int
    depth: float
    aim: float


class Following:
    """
    Compares what is commanded with what the robot reports.

    A plant does not follow if it reports next to no force while one is commanded, and the needle
    rests while its reference moves. It follows again as soon as one of both is over. A robot that
    reports no force is not judged.

    Attributes
    ----------
    lost : bool
        Whether the plant does not follow.

    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Take it that the plant follows."""
        self.lost = False
        self._mark: _Mark | None = None

    def update(
        self, stamp: int, depth: float, aim: float, commanded: float, reported: float
    ) -> bool:
        """
        Take in a measurement.

        Parameters
        ----------
        stamp : int
            Its stamp [ns].
        depth, aim : float
            Inserted length, and where it should be [m].
        commanded, reported : float
            Force that was commanded last, and that the robot reports [N]; NaN if it reports none.

        Returns
        -------
        bool
            Whether the plant does not follow.

        """
        # Where nothing is commanded there is nothing to follow.
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
