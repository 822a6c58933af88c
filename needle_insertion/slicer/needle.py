"""What is known of the needle at a moment: its shape, or the line to its tip."""

from __future__ import annotations

from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_insertion.slicer.registration import rotation_matrix
from needle_ros.errors import MessageError, ParameterError
import numpy as np
from numpy.typing import ArrayLike

#: What comes no more is not shown after this time [s].
_LASTS: Final = 1.0

#: Farthest from the entry point that anything can be [m].
_FARTHEST: Final = 10.0

#: Most points of a shape: 0.5 m at every millimeter.
MOST_POINTS: Final = 480

#: Where a shape is from. The second is a straight line.
MEASURED: Final = 'needle_poses'
LINE: Final = 'line from guide to tip, not measured'


class Shape(NamedTuple):
    """
    The needle in ``needle_entry``.

    Attributes
    ----------
    stamp : int
        Time of the measurement [ns].
    points : ndarray, shape (n, 3)
        From the guide to the tip [m]; at least two.
    turn : ndarray, shape (4,)
        Orientation of the tip, which brings y along the needle: quaternion x, y, z, w.
    source : str
        `MEASURED` or `LINE`.

    """

    stamp: int
    points: FloatArray
    turn: FloatArray
    source: str


class Pose(NamedTuple):
    """
    A pose in ``needle_entry``.

    Attributes
    ----------
    stamp : int
        Its time [ns].
    position : ndarray, shape (3,)
        Where it is [m].
    turn : ndarray, shape (4,)
        Orientation: quaternion x, y, z, w.

    """

    stamp: int
    position: FloatArray
    turn: FloatArray


class NeedleView:
    """
    Collects what comes of the needle; times are those of a clock that never jumps [s].

    Attributes
    ----------
    expected : Pose or None
        Where the tip was last expected.

    """

    def __init__(self) -> None:
        self.expected: Pose | None = None
        self._shape: tuple[float, Shape] | None = None
        self._tip: tuple[float, int, FloatArray] | None = None
        self._guide: tuple[float, FloatArray] | None = None

    def take_poses(self, stamp: int, points: ArrayLike, turn: ArrayLike, now: float) -> None:
        """
        Take a shape.

        Parameters
        ----------
        stamp : int
            Its stamp [ns].
        points : array_like, shape (n, 3)
            From the guide to the tip [m].
        turn : array_like, shape (4,)
            Orientation of the last one: quaternion x, y, z, w.
        now : float
            Time [s].

        Raises
        ------
        MessageError
            If it is no shape.

        """
        there = _places(points)
        if there.ndim != 2 or not 2 <= len(there) <= MOST_POINTS:
            raise MessageError(f'it has {len(there)} poses, 2 to {MOST_POINTS} are a shape')
        self._shape = now, Shape(stamp, there, _turn(turn), MEASURED)

    def take_tip(self, stamp: int, tip: ArrayLike, now: float) -> None:
        """
        Take a reading of the tip.

        Parameters
        ----------
        stamp : int
            Its stamp [ns].
        tip : array_like, shape (3,)
            Where it is [m].
        now : float
            Time [s].

        Raises
        ------
        MessageError
            If it is nowhere.

        """
        self._tip = now, stamp, _places(tip)

    def take_guide(self, x: float, z: float, now: float) -> None:
        """
        Take a reading of the guide.

        Parameters
        ----------
        x, z : float
            Where it holds the needle [m].
        now : float
            Time [s].

        Raises
        ------
        MessageError
            If it is nowhere.

        """
        self._guide = now, _places([x, 0.0, z])

    def take_expected(self, stamp: int, position: ArrayLike, turn: ArrayLike) -> None:
        """
        Take where the tip is expected.

        Parameters
        ----------
        stamp : int
            Time of the estimate [ns].
        position : array_like, shape (3,)
            Where it will be [m].
        turn : array_like, shape (4,)
            Orientation there: quaternion x, y, z, w.

        Raises
        ------
        MessageError
            If it is no pose.

        """
        self.expected = Pose(stamp, _places(position), _turn(turn))

    def shape(self, now: float) -> Shape | None:
        """
        Return the needle as it is known.

        Parameters
        ----------
        now : float
            Time [s].

        Returns
        -------
        Shape or None
            The last shape that came, if it is not old; else a line from the guide to the last
            tip; None if that is old, too.

        """
        if self._shape is not None and now - self._shape[0] <= _LASTS:
            return self._shape[1]
        if self._tip is None or self._guide is None:
            return None
        (seen, stamp, tip), (moved, guide) = self._tip, self._guide
        if now - min(seen, moved) > _LASTS:
            return None
        return Shape(stamp, np.array([guide, tip]), _along(tip - guide), LINE)


def _places(given: ArrayLike) -> FloatArray:
    """Return positions that can be."""
    there = np.array(given, dtype=np.float64)
    if not (np.abs(there) <= _FARTHEST).all():
        raise MessageError(f'a position is not within {_FARTHEST:g} m')
    return there


def _turn(given: ArrayLike) -> FloatArray:
    """Return an orientation that is one."""
    try:
        rotation_matrix(given)
    except ParameterError as error:
        raise MessageError(f'an orientation {error}') from error
    return np.array(given, dtype=np.float64)


def _along(way: FloatArray) -> FloatArray:
    """Return the shortest turn that brings y along a way: quaternion x, y, z, w."""
    length = float(np.linalg.norm(way))
    if length == 0.0:
        return np.array([0.0, 0.0, 0.0, 1.0])
    x, y, z = way / length
    # Half the angle from y, about the normal of both; opposite ways have any normal.
    turn = np.array([z, 0.0, -x, 1.0 + y]) if y > -1.0 else np.array([1.0, 0.0, 0.0, 0.0])
    return np.asarray(turn / np.linalg.norm(turn))
