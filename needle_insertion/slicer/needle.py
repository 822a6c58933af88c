# SPDX-License-Identifier: Apache-2.0
"""Present shape of the needle, measured or a line to its tip, in the images; state of nodes."""

from dataclasses import dataclass
from math import sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_ros.errors import MessageError, ParameterError
from needle_ros.settings import check_constants, constant
from needle_ros.status import NodeReport, SILENT
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

MILLIMETERS: Final = 1e3  #: millimeters per meter: OpenIGTLink and 3D Slicer use mm
_ROUNDED: Final = 2e-3  #: tolerance of the norm of a quaternion that is rounded to three digits

_TIMEOUT: Final = 1.0  #: timeout of measurements [s]
_FARTHEST: Final = 10.0  #: largest plausible coordinate [m]
MOST_POINTS: Final = 480  #: largest number of points of a shape: 0.5 m with a point per millimeter

#: Source of a shape: measured, or a straight line.
MEASURED: Final = 'needle_poses'
LINE: Final = 'line from guide to tip, not measured'

_PERIOD: Final = 1.0  #: time between two transmissions, unless something changes [s]

#: Largest number of nodes, and age of a removed node [s].
_MOST: Final = 20
_REMOVED: Final = 60.0


def rotation_matrix(quaternion: ArrayLike) -> FloatArray:
    """Return the rotation matrix of a quaternion xyzw; `ParameterError` if its norm is not 1."""
    given = np.array(quaternion, dtype=np.float64)
    norm = sqrt(given @ given) if given.shape == (4,) and np.isfinite(given).all() else 0.0
    if abs(norm - 1.0) > _ROUNDED:
        raise ParameterError(
            f'must be a quaternion x, y, z, w of norm 1, got {given.tolist()} of norm {norm:g}'
        )
    return np.asarray(Rotation.from_quat(given).as_matrix())


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """
    Pose of the frame ``needle_entry`` in the images, p_image = R p_needle + t.

    By default the origins are equal, and x is to the patient's right, y anterior, z superior.
    """

    rotation: tuple[float, ...] = constant(
        (0.0, 0.0, 0.0, 1.0),
        '1',
        'rotation from needle_entry to the frame of the images: quaternion x, y, z, w',
        low=-1.0,
        high=1.0,
    )
    translation: tuple[float, ...] = constant(
        (0.0, 0.0, 0.0),
        'm',
        'position of the entry point in the frame of the images: x, y, z; in m (3D Slicer shows '
        'mm)',
        low=-10.0,
        high=10.0,
    )

    def __post_init__(self) -> None:
        for name, count in (('rotation', 4), ('translation', 3)):
            given = getattr(self, name)
            if not isinstance(given, tuple) or len(given) != count:
                raise ParameterError(f'{name} must have {count} numbers, got {given!r}')
        check_constants(self)
        try:
            rotation_matrix(self.rotation)
        except ParameterError as error:
            raise ParameterError(f'rotation {error}') from error

    def to_image(self, points: ArrayLike) -> FloatArray:
        """Transform points (..., 3) from ``needle_entry`` [m] to the frame of the images [mm]."""
        turned = np.asarray(points, dtype=np.float64) @ rotation_matrix(self.rotation).T
        return np.asarray(MILLIMETERS * (turned + self.translation))

    def to_needle(self, points: ArrayLike) -> FloatArray:
        """Transform points (..., 3) from the frame of the images [mm] to ``needle_entry`` [m]."""
        lengths = np.asarray(points, dtype=np.float64) / MILLIMETERS
        return np.asarray((lengths - self.translation) @ rotation_matrix(self.rotation))

    def pose_to_image(self, position: ArrayLike, quaternion: ArrayLike) -> FloatArray:
        """Transform a pose (position in m) to a homogeneous matrix of the images (in mm)."""
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(self.rotation) @ rotation_matrix(quaternion)
        pose[:3, 3] = self.to_image(position)
        return pose


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


class NodeStates:
    """Latest state of each node on ``/diagnostics``; all times are of a monotonic clock [s]."""

    def __init__(self) -> None:
        #: Time of receipt, name of the level and message, by node.
        self._states: dict[str, tuple[float, str, str]] = {}
        #: Peer at the last call of `is_due`.
        self._peer = ''
        self._sent = self._changed = -_PERIOD

    def take(self, report: NodeReport, now: float) -> None:
        """Store the state of a node; further nodes beyond the largest number are ignored."""
        name, state = report.node.lstrip('/'), (report.level_name, report.message)
        if name in self._states or len(self._states) < _MOST:
            if self._states.get(name, (0.0, '', ''))[1:] != state:
                self._changed = now
            self._states[name] = now, *state

    def mark_changed(self, now: float) -> None:
        self._changed = now

    def is_due(self, peer: str, now: float) -> bool:
        """Return whether the states must be sent now: to a new peer, after a change, or again."""
        is_new, self._peer = peer != self._peer, peer
        changed = is_new or self._changed > self._sent or now - self._sent >= _PERIOD
        if not peer or not changed:
            return False
        self._sent = now
        return True

    def lines(self, now: float) -> list[str]:
        """Return a line for each node, sorted by name; nodes without a state are removed."""
        known = sorted(self._states.items())
        self._states = {name: state for name, state in known if now - state[0] < _REMOVED}
        lines = []
        for name, (when, level, message) in self._states.items():
            age = now - when
            silent = f', silent for {age:.0f} s' if age > SILENT else ''
            lines.append(f'{name} [{level}{silent}]: {message}')
        return lines
