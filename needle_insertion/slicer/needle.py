# SPDX-License-Identifier: Apache-2.0
"""Present state of the needle: its measured shape, or a line to its tip."""

from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_insertion.slicer.registration import rotation_matrix
from needle_ros.errors import MessageError, ParameterError
import numpy as np
from numpy.typing import ArrayLike

_TIMEOUT: Final = 1.0  #: timeout of measurements [s]
_FARTHEST: Final = 10.0  #: largest plausible coordinate [m]
MOST_POINTS: Final = 480  #: largest number of points of a shape: 0.5 m with a point per millimeter

#: Source of a shape: measured, or a straight line.
MEASURED: Final = 'needle_poses'
LINE: Final = 'line from guide to tip, not measured'


class Shape(NamedTuple):
    """Shape of the needle in ``needle_entry``."""

    stamp: int  #: time of the measurement [ns]
    points: FloatArray  #: from the guide to the tip, shape (n, 3) [m]; at least two
    turn: FloatArray  #: orientation of the tip, with y along the needle: quaternion x, y, z, w
    source: str  #: `MEASURED` or `LINE`


class EntryPose(NamedTuple):
    """Pose in ``needle_entry``: time [ns], position [m], quaternion x, y, z, w."""

    stamp: int
    position: FloatArray
    turn: FloatArray


class NeedleView:
    """Latest measurements of the needle; times of arrival are of a monotonic clock [s]."""

    def __init__(self) -> None:
        #: Last prediction of the tip.
        self.expected: EntryPose | None = None
        self._shape: tuple[float, Shape] | None = None
        self._tip: tuple[float, int, FloatArray] | None = None
        self._guide: tuple[float, FloatArray] | None = None

    def take_poses(self, stamp: int, points: ArrayLike, turn: ArrayLike, now: float) -> None:
        """Store points (n, 3) from guide to tip [m] and its turn; `MessageError` if invalid."""
        positions = _places(points)
        if positions.ndim != 2 or not 2 <= len(positions) <= MOST_POINTS:
            raise MessageError(f'it has {len(positions)} poses, a shape has 2 to {MOST_POINTS}')
        self._shape = now, Shape(stamp, positions, _quaternion(turn), MEASURED)

    def take_tip(self, stamp: int, tip: ArrayLike, now: float) -> None:
        """Store a tip position [m]; `MessageError` if it is invalid."""
        self._tip = now, stamp, _places(tip)

    def take_guide(self, x: float, z: float, now: float) -> None:
        """Store the position of the guide [m]; `MessageError` if it is invalid."""
        self._guide = now, _places([x, 0.0, z])

    def take_expected(self, stamp: int, position: ArrayLike, turn: ArrayLike) -> None:
        """Store a prediction of the tip pose; `MessageError` if it is invalid."""
        self.expected = EntryPose(stamp, _places(position), _quaternion(turn))

    def shape(self, now: float) -> Shape | None:
        """Return the last shape, later a line from guide to tip, or None after both timeouts."""
        if self._shape is not None and now - self._shape[0] <= _TIMEOUT:
            return self._shape[1]
        if self._tip is None or self._guide is None:
            return None
        (measured, stamp, tip), (moved, guide) = self._tip, self._guide
        if now - min(measured, moved) > _TIMEOUT:
            return None
        return Shape(stamp, np.array([guide, tip]), _along(tip - guide), LINE)


def _places(given: ArrayLike) -> FloatArray:
    """Return positions as an array [m]; `MessageError` if one is implausible."""
    positions = np.array(given, dtype=np.float64)
    if not (np.abs(positions) <= _FARTHEST).all():
        raise MessageError(f'a position is not within {_FARTHEST:g} m')
    return positions


def _quaternion(given: ArrayLike) -> FloatArray:
    """Return a quaternion as an array; `MessageError` if it is invalid."""
    try:
        rotation_matrix(given)
    except ParameterError as error:
        raise MessageError(f'an orientation {error}') from error
    return np.array(given, dtype=np.float64)


def _along(direction: FloatArray) -> FloatArray:
    """Return the shortest rotation from y to a direction: quaternion x, y, z, w."""
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        return np.array([0.0, 0.0, 0.0, 1.0])
    x, y, z = direction / length
    # Half the angle from y, about the normal of both; for opposite directions any normal.
    turn = np.array([z, 0.0, -x, 1.0 + y]) if y > -1.0 else np.array([1.0, 0.0, 0.0, 0.0])
    return np.asarray(turn / np.linalg.norm(turn))
