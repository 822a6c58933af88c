"""What is seen: takes what comes on the topics, and gives it as frames for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite, sqrt
from typing import Any, Final

from needle_dynamics import FloatArray
from needle_insertion.watch.scene import scene
from needle_ros import contract
from needle_ros.errors import printable
from needle_ros.wire import Reading
import numpy as np

#: Frames per second.
RATE: Final = 30.0

#: Columns of the history, and how far back it goes [s].
HISTORY: Final = ('time', 'depth', 'reference', 'force', 'tip_x', 'tip_z')
SPAN: Final = 20.0

#: Age from which a node is silent; it says something every second [s].
_SILENT_NODE: Final = 3.0

#: Position, velocity and effort of a joint that is not there.
_NOTHING: Final = (None, None, None)

#: Most points of a line, and most nodes that are told of.
_POINTS: Final = 120
_NODES: Final = 64

#: Half of an interval of 95 % over the standard deviation.
_NORMAL: Final = 1.96

#: Values of /diagnostics by which nodes tell of their target.
_AIM: Final = 'target x, y, z [m]'
_DEPTH: Final = 'target [m]'

#: Values of /diagnostics of a node that people need beside its message.
_SHOWN: Final = ('step', 'chance to come within 1 mm', 'last complaint')


def number(value: float | None) -> float | None:
    """
    Return a number as a frame has it.

    Parameters
    ----------
    value : float or None
        The number.

    Returns
    -------
    float or None
        Rounded to 1e-7; None for what is none or not finite.

    """
    return None if value is None or not isfinite(value) else round(float(value), 7)


def line(points: FloatArray) -> list[list[float]]:
    """
    Return a line as a frame has it.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Points x, y, z [m].

    Returns
    -------
    list of list of float
        Columns x, y and z [m], with 120 points at most; points that are not finite are left out.

    """
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) > _POINTS:
        points = points[np.linspace(0, len(points) - 1, _POINTS).round().astype(int)]
    return [[round(value, 6) for value in column] for column in points.T.tolist()]


class View:
    """
    The newest of everything that is known.

    All times are those of one clock, in s.

    Parameters
    ----------
    silent : float
        Age from which a stream is silent [s].

    Attributes
    ----------
    invalid : int
        Number of messages that could not be read.
    scene : dict
        Needle, tissue and limits, as `scene.scene` returns them.

    """

    def __init__(self, silent: float = 1.0) -> None:
        self.invalid = 0
        self.scene = scene({})
        self._silence = silent
        #: Newest reading of each stream and when it came.
        self._readings: dict[str, tuple[float, Reading]] = {}
        self._lines: dict[str, tuple[float, list[list[float]]]] = {}
        self._expected: dict[str, Any] | None = None
        self._configurations: dict[str, dict[str, Any]] = {}
        self._nodes: dict[str, tuple[float, Any]] = {}

    # What comes in.

    def reading(self, topic: str, reading: Reading, now: float) -> None:
        """
        Take a reading of a stream.

        Parameters
        ----------
        topic : str
            Name of the topic in the contract.
        reading : Reading
            Its content.
        now : float
            When it came [s].

        """
        self._readings[topic] = now, reading

    def line(self, name: str, points: FloatArray, now: float) -> None:
        """
        Take a line of ``needle_shape``.

        Parameters
        ----------
        name : str
            ``needle`` or ``path``.
        points : ndarray, shape (n, 3)
            Its points [m].
        now : float
            When it came [s].

        """
        self._lines[name] = now, line(points)

    def expected(self, message: Any) -> None:
        """
        Take where the tip will be.

        Parameters
        ----------
        message : PoseWithCovarianceStamped
            Position and covariance.

        """
        at, covariance = message.pose.pose.position, np.asarray(message.pose.covariance)
        xx, xz, zz = (float(covariance[k]) for k in (0, 2, 14))
        if not all(map(isfinite, (at.x, at.y, at.z, xx, xz, zz))):
            self.invalid += 1
            return
        x, z = (sqrt(max(0.0, one)) for one in (xx, zz))
        self._expected = {
            'at': [number(one) for one in (at.x, at.y, at.z)],
            'half': [number(_NORMAL * one) for one in (x, z)],
            # Of the ellipse: the correlation of x and z.
            'correlation': number(xz / (x * z)) if x * z > 0.0 else 0.0,
        }

    def configuration(self, node: str, parameters: dict[str, Any]) -> None:
        """
        Take the configuration of a node.

        Parameters
        ----------
        node : str
            Its name without namespace.
        parameters : dict
            Its parameters by name, as `scene.parameters_of` returns them.

        """
        if not parameters:
            self.invalid += 1
        elif parameters != self._configurations.get(node):
            self._configurations[node] = parameters
            self.scene = scene(self._configurations)

    def status(self, status: Any, now: float) -> None:
        """
        Take what a node says of its state.

        Parameters
        ----------
        status : DiagnosticStatus
            What it says.
        now : float
            When it came [s].

        """
        if status.name in self._nodes or len(self._nodes) < _NODES:
            self._nodes[status.name] = now, status

    # What is seen.

    def frame(self, now: float) -> dict[str, Any]:
        """
        Return what is seen now.

        Parameters
        ----------
        now : float
            Time [s].

        Returns
        -------
        dict
            For JSON: lengths in m, forces in N, times in s; None for what is not known.

        """
        joints = self._joints(contract.JOINT_STATES.name)
        depth, velocity, effort = joints.get(contract.INSERTION, _NOTHING)
        aim = self._joints(contract.REFERENCE.name).get(contract.INSERTION, _NOTHING)
        error = self._joints(contract.TRACKING_ERROR.name).get(contract.INSERTION, _NOTHING)
        tip = self._vector(contract.TIP_DEFLECTION.name)
        force = self._vector(contract.BASE_WRENCH.name)
        guide = [joints.get(name, _NOTHING)[0] for name in (contract.GUIDE_X, contract.GUIDE_Z)]
        return {
            'time': round(now, 3),
            'depth': depth,
            'velocity': velocity,
            # Without a sensor, what the robot says that it exerts.
            'force': effort if force is None else force[1],
            'sensed': force is not None,
            'reference': aim[0],
            'error': error[0],
            'tip': tip,
            'guide': guide,
            'roll': joints.get(contract.ROLL, _NOTHING)[0],
            'target': self._target(),
            'expected': self._expected,
            **self._shape(depth, tip, guide, now),
            'silent': self._silent(now),
            'nodes': self._told(now),
            'invalid': self.invalid,
        }

    def _joints(self, topic: str) -> dict[str, tuple[float | None, ...]]:
        """Return position, velocity and effort of each joint of a topic."""
        _, reading = self._readings.get(topic, (0.0, None))
        if reading is None:
            return {}
        return {
            name: tuple(number(part[k]) if k < len(part) else None for part in reading.values)
            for k, name in enumerate(reading.names)
        }

    def _vector(self, topic: str) -> list[float | None] | None:
        """Return the first three numbers of a message."""
        _, reading = self._readings.get(topic, (0.0, None))
        return None if reading is None else [number(value) for value in reading.values[0][:3]]

    def _target(self) -> list[float | None] | None:
        """Return the target x, y, z [m]; x and z are None where only the depth counts."""
        told = [{pair.key: pair.value for pair in one.values} for _, one in self._nodes.values()]
        aims = [values[_AIM] for values in told if _AIM in values]
        depths = [values[_DEPTH] for values in told if _DEPTH in values]
        try:
            if aims:
                return [number(float(part)) for part in aims[0].split(',')][:3]
            if depths and not self.scene['steered']:
                return None if depths[0] == 'None' else [None, number(float(depths[0])), None]
        except ValueError:
            return None
        # Of a controller that is not of this package.
        return self._vector(contract.TARGET.name) if not told else None

    def _shape(
        self,
        depth: float | None,
        tip: Sequence[float | None] | None,
        guide: Sequence[float | None],
        now: float,
    ) -> dict[str, Any]:
        """Return needle and path, and where the shape is from."""
        came, needle = self._lines.get('needle', (0.0, None))
        path = self._lines.get('path', (0.0, None))[1]
        if needle is not None and now - came < self._silence:
            return {'needle': needle, 'path': path, 'shape': 'simulated'}
        if depth is None:
            return {'needle': None, 'path': path, 'shape': None}
        tissue = self.scene['tissue'] or {}
        length, free = tissue.get('length') or depth, tissue.get('free') or 0.0
        x, z = (one or 0.0 for one in guide)
        ends = [(x, min(depth - length, -free), z), (x, -free, z)]
        if tip is not None and None not in (tip[0], tip[2]):
            ends.append((tip[0], depth, tip[2]))  # type: ignore[arg-type]
        else:
            ends.append((x, depth, z))
        return {'needle': line(np.array(ends)), 'path': path, 'shape': 'straight'}

    def _silent(self, now: float) -> dict[str, float]:
        """Return the age of each stream that has been there and no longer comes [s]."""
        ages = {name: now - came for name, (came, _) in self._readings.items()}
        # A target comes once.
        return {
            name: round(age, 1)
            for name, age in ages.items()
            if age > self._silence and name != contract.TARGET.name
        }

    def _told(self, now: float) -> list[dict[str, Any]]:
        """Return what each node says, the worst first."""
        nodes = []
        for name, (came, status) in self._nodes.items():
            level = status.level
            values = {pair.key: pair.value for pair in status.values}
            age = max(0.0, now - came)
            nodes.append(
                {
                    'name': printable(name),
                    'level': level[0] if isinstance(level, bytes) else int(level),
                    'words': printable(status.message),
                    'age': round(age, 1),
                    'silent': age > _SILENT_NODE,
                    'values': {key: printable(values[key]) for key in _SHOWN if values.get(key)},
                }
            )
        return sorted(nodes, key=lambda node: (-node['level'], node['name']))


def row(frame: Mapping[str, Any]) -> list[float | None]:
    """
    Return what of a frame the strip charts show.

    Parameters
    ----------
    frame : mapping
        As `View.frame` returns it.

    Returns
    -------
    list of float or None
        Columns `HISTORY`.

    """
    tip = frame['tip'] or [None] * 3
    charted = [frame['time'], frame['depth'], frame['reference'], frame['force']]
    return [*charted, tip[0], tip[2]]
