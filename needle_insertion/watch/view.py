# SPDX-License-Identifier: Apache-2.0
"""State of the page: messages of all topics, needle, tissue and limits, as frames."""

from collections.abc import Callable, Container, Mapping, Sequence
from math import isfinite, isnan, sqrt
from typing import Any, Final, NamedTuple

from needle_controller.steering.insertion_plan import Plan
from needle_dynamics import FloatArray
from needle_insertion.watch.robot import WatchedRobot
from needle_ros import contract
from needle_ros.errors import ParameterError
from needle_ros.quantities import NORMAL
from needle_ros.settings import is_number
from needle_ros.status import ControllerStatus, NodeReport, SteeringStatus
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading
import numpy as np

#: Nodes whose configurations are read; needle and tissue are of the first available node.
CONFIGURED: Final = ('plant', 'steering', 'controller')

#: Parameters of the limits of the controller, by their names on the page.
_LIMITS: Final = {
    'force': 'force_limit',
    'load': 'safety.axial_load',
    'speed': 'safety.speed',
    'error': 'safety.tracking_error',
    'deflection': 'safety.tip_deflection',
}

RATE: Final = 30.0  #: frames per second
SPAN: Final = 20.0  #: duration of the history [s]
_SILENT_NODE: Final = 3.0  #: timeout of the status of a node, which is published every second [s]

#: Largest number of points of a line, and of nodes.
_POINTS: Final = 120
_NODES: Final = 64


#: Largest deflection of the tip to which a straight needle is drawn [m].
_FAR: Final = 1.0

_Place = Sequence[float | None]  #: Coordinates [m], None if unknown.


def scene(configurations: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """
    Return needle, tissue and limits for the page from the parameters of nodes, by node name.

    ``tissue`` or None: source node ``of``, ``length``, ``free`` length, ``layers`` (depth,
    stiffness) and ``membranes`` (depth, strength). ``limits``: force, load, speed, error,
    deflection, depths ``low`` and ``high``. ``steered``: whether a node aims the tip. SI units.
    """
    whose = next((name for name in CONFIGURED if name in configurations), None)
    return {
        'tissue': None if whose is None else _tissue(whose, configurations[whose]),
        'limits': _limits(configurations.get('controller', {})),
        'steered': 'steering' in configurations,
    }


def _number(parameters: Mapping[str, Any], name: str) -> float | None:
    value = parameters.get(name)
    return float(value) if is_number(value) else None


def _numbers(parameters: Mapping[str, Any], name: str) -> list[float]:
    values = parameters.get(name)
    values = values if isinstance(values, list) else []
    return [float(value) for value in values if is_number(value)]


def _tissue(whose: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    depths = [0.0, *_numbers(parameters, 'model.layer_depths')]
    first = _number(parameters, 'model.tissue_stiffness') or 0.0
    stiffnesses = [first, *_numbers(parameters, 'model.layer_stiffnesses')]
    membranes = zip(
        _numbers(parameters, 'steering.membrane_depths'),
        _numbers(parameters, 'steering.membrane_strengths'),
        strict=False,
    )
    # All nodes have the parameter free length; it is valid for a steered needle only.
    steered = whose == 'steering' or parameters.get('steered') is True
    return {
        'of': whose,
        'length': _number(parameters, 'model.length'),
        'free': _number(parameters, 'steering.free_length') if steered else None,
        'layers': [list(layer) for layer in zip(depths, stiffnesses, strict=False)],
        'membranes': [list(one) for one in membranes] if steered else [],
    }


def _limits(parameters: Mapping[str, Any]) -> dict[str, float]:
    found = {name: _number(parameters, of) for name, of in _LIMITS.items()}
    # As in the controller: limited to the range of the needle.
    for name, of, model, choose in (
        ('low', 'lowest_depth', 'model.minimum_depth', max),
        ('high', 'highest_depth', 'model.length', min),
    ):
        both = [_number(parameters, of), _number(parameters, model)]
        known = [value for value in both if value is not None]
        found[name] = choose(known) if known else None
    return {name: value for name, value in found.items() if value is not None}


def number(value: float | None) -> float | None:
    """Return a number rounded to 1e-7; None if missing or not finite."""
    return None if value is None or not isfinite(value) else round(float(value), 7)


class Signal(NamedTuple):
    """Signal of the charts: its topic, and its value in a reading of the topic, in SI units."""

    topic: str
    raw: Callable[[Reading], float | None]  #: None if the reading does not have it

    def of(self, reading: Reading) -> float | None:
        return number(self.raw(reading))

    def fault(self, reading: Reading) -> str:
        """Return the words for a value that is not finite."""
        value = self.raw(reading)
        if value is None or isfinite(value):
            return ''
        return 'NaN received' if isnan(value) else f'{value} received'


def _joint(topic: contract.Topic, joint: str, part: int = 0) -> Signal:
    """Return position, velocity or effort (part 0, 1 or 2) of a joint as a signal."""

    def raw(reading: Reading) -> float | None:
        k = reading.names.index(joint) if joint in reading.names else None
        values = reading.values[part]
        return None if k is None or k >= len(values) else values[k]

    return Signal(topic.name, raw)


def _axis(topic: contract.Topic, axis: int) -> Signal:
    return Signal(topic.name, lambda reading: reading.values[0][axis])


#: Signals of the charts by name.
SIGNALS: Final = {
    'depth': _joint(contract.JOINT_STATES, contract.INSERTION),
    'reference': _joint(contract.REFERENCE, contract.INSERTION),
    'velocity': _joint(contract.JOINT_STATES, contract.INSERTION, 1),
    'error': _joint(contract.TRACKING_ERROR, contract.INSERTION),
    'force': _axis(contract.BASE_WRENCH, 1),
    'force_x': _axis(contract.BASE_WRENCH, 0),
    'force_z': _axis(contract.BASE_WRENCH, 2),
    'tip_x': _axis(contract.TIP_DEFLECTION, 0),
    'tip_z': _axis(contract.TIP_DEFLECTION, 2),
    'guide_x': _joint(contract.JOINT_STATES, contract.GUIDE_X),
    'guide_z': _joint(contract.JOINT_STATES, contract.GUIDE_Z),
    'roll': _joint(contract.JOINT_STATES, contract.ROLL),
}

#: Signals of a frame.
_SHOWN: Final = ('depth', 'velocity', 'force', 'reference', 'error', 'roll')

#: Signals whose faults a frame has.
_EXPLAINED: Final = ('depth', 'velocity', 'force', 'error', 'tip_x', 'tip_z')

#: Force without a sensor: the effort that the robot reports.
EFFORT: Final = _joint(contract.JOINT_STATES, contract.INSERTION, 2)


def signal_of(name: str, topics: Container[str]) -> Signal:
    """Return a signal of `SIGNALS`; without a force sensor, the effort is the force."""
    signal = SIGNALS[name]
    return EFFORT if name == 'force' and signal.topic not in topics else signal


def planned(plan: Plan) -> dict[str, Any]:
    """
    Return the plan for the page, in ``needle_entry`` [m].

    ``path``: columns x, y and z of the tip at each depth. ``free``: radius around each point that
    is free of obstacles and their margins, also interpolated: the clearance of a step is that of
    the whole shaft, so it is a lower bound at the tip.
    """
    # The clearance in the step to a depth also bounds the start of the step.
    clearances = np.minimum(plan.clearances, np.append(plan.clearances[1:], np.inf))
    path = (plan.path - plan.entry) @ plan.axes.T
    return {
        'path': [[round(value, 6) for value in column] for column in path.T.tolist()],
        'free': [round(float(value), 6) for value in plan.radius + clearances],
    }


def line(points: FloatArray) -> list[list[float]]:
    """Return finite points (n, 3) [m] as columns x, y and z, decimated to 120 points."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) > _POINTS:
        points = points[np.linspace(0, len(points) - 1, _POINTS).round().astype(int)]
    return [[round(value, 6) for value in column] for column in points.T.tolist()]


class View:
    """
    Newest message of each topic; all times, also the timeout `silent`, are of one clock [s].

    Without a `robot`, the configuration of the controller describes it.
    """

    def __init__(self, silent: float = 1.0, robot: WatchedRobot | None = None) -> None:
        #: Number of unreadable messages.
        self.invalid = 0
        #: Needle, tissue and limits.
        self.scene = scene({})
        #: Units, joints and frames of the measurements.
        self.robot = WatchedRobot() if robot is None else robot
        self._follows = robot is None
        self._silence = silent
        #: Newest reading of each topic in the contract, and its time of arrival.
        self._readings: dict[str, tuple[float, Reading]] = {}
        #: Fault of the newest reading, and of the newest message without the insertion joint.
        self._faults: dict[str, str] = {}
        self._unusable: dict[str, str] = {}
        #: Newest stamp of each topic [ns], and the time of its first message.
        self._stamps: dict[str, tuple[int, float]] = {}
        self._lines: dict[str, tuple[float, list[list[float]]]] = {}
        self._expected: dict[str, Any] | None = None
        self._configurations: dict[str, dict[str, Any]] = {}
        self._nodes: dict[str, tuple[float, NodeReport]] = {}

    # Input.

    def reading(self, topic: str, reading: Reading, now: float) -> None:
        """
        Store a reading of a topic, by its name in the contract, at a time [s].

        One without the insertion joint, of another publisher, does not replace a reading with it.
        """
        try:
            self._readings[topic] = now, self.robot.reading(topic, reading)
        except ParameterError as error:
            self._unusable[topic] = str(error)
            return
        self._faults[topic] = self.robot.fault(topic, reading)
        if reading.stamp != self._stamps.get(topic, (None, now))[0]:
            self._stamps[topic] = reading.stamp, now

    def lacks_joint(self, topic: str) -> bool:
        """Whether a publisher of a topic does not publish the insertion joint."""
        return topic in self._unusable

    def line(self, name: str, points: FloatArray, now: float) -> None:
        """Store a line of ``needle_shape``, ``needle`` or ``path``, with points (n, 3) [m]."""
        self._lines[name] = now, line(points)

    def expected(self, message: Any) -> None:
        """Store a prediction of the tip with its covariance."""
        at, covariance = message.pose.pose.position, np.asarray(message.pose.covariance)
        xx, xz, zz = (float(covariance[k]) for k in (0, 2, 14))
        if not all(map(isfinite, (at.x, at.y, at.z, xx, xz, zz))):
            self.invalid += 1
            return
        x, z = (sqrt(max(0.0, one)) for one in (xx, zz))
        self._expected = {
            'at': [number(one) for one in (at.x, at.y, at.z)],
            'half': [number(NORMAL * one) for one in (x, z)],
            # Correlation of x and z, for the ellipse.
            'correlation': number(xz / (x * z)) if x * z > 0.0 else 0.0,
        }

    def configuration(self, node: str, parameters: dict[str, Any]) -> None:
        """Store the parameters of a node, by its name without namespace."""
        if not parameters:
            self.invalid += 1
        elif parameters != self._configurations.get(node):
            if node == 'controller' and self._follows:
                self.robot.configure(parameters)
                self._unusable.clear()
            self._configurations[node] = parameters
            self.scene = scene(self._configurations)

    def report(self, report: NodeReport, now: float) -> None:
        if report.node in self._nodes or len(self._nodes) < _NODES:
            self._nodes[report.node] = now, report

    # Output.

    def frame(self, now: float) -> dict[str, Any]:
        """Return the frame at a time [s] for JSON: lengths in m, forces in N; None if unknown."""
        values = {name: self._value(name) for name in SIGNALS}
        tip = self._vector(contract.TIP_DEFLECTION.name)
        guide = [values['guide_x'], values['guide_z']]
        return {
            'time': round(now, 3),
            **{name: values[name] for name in _SHOWN},
            'sensed': contract.BASE_WRENCH.name in self._readings,
            'tip': tip,
            'guide': guide,
            'target': self._target(),
            'expected': self._expected,
            'hit_probability': self._hit_probability(),
            **self._shape(values['depth'], guide, tip, now),
            'silent': self._silent(now),
            'faults': self._reasons(now),
            'robot': self.robot.words,
            'nodes': self._node_rows(now),
            'invalid': self.invalid,
        }

    def row(self, now: float) -> list[float | None]:
        """Return a time [s] and the values of `SIGNALS`; None while a topic is silent."""
        silent = self._silent(now)
        return [round(now, 3), *(self._value(name, silent) for name in SIGNALS)]

    def _value(self, name: str, silent: Container[str] = ()) -> float | None:
        signal = signal_of(name, self._readings)
        known = signal.topic in self._readings and signal.topic not in silent
        return signal.of(self._readings[signal.topic][1]) if known else None

    def _vector(self, topic: str) -> list[float | None] | None:
        """Return the first three numbers of a message."""
        _, reading = self._readings.get(topic, (0.0, None))
        return None if reading is None else [number(value) for value in reading.values[0][:3]]

    def _target(self) -> list[float | None] | None:
        """Return the target x, y, z [m]; x and z are None for a depth target."""
        statuses = [report.status for _, report in self._nodes.values()]
        for status in statuses:
            if isinstance(status, SteeringStatus) and status.target is not None:
                return [number(part) for part in status.target]
        for status in () if self.scene['steered'] else statuses:
            if isinstance(status, ControllerStatus) and status.target is not None:
                return [None, number(status.target), None]
        # Target for a controller of another package.
        return self._vector(contract.TARGET.name) if not statuses else None

    def _hit_probability(self) -> float | None:
        statuses = [report.status for _, report in self._nodes.values()]
        found = [one.hit_probability for one in statuses if isinstance(one, SteeringStatus)]
        return next((number(one) for one in found if one is not None), None)

    def _shape(
        self, depth: float | None, guide: _Place, tip: _Place | None, now: float
    ) -> dict[str, Any]:
        received, needle = self._lines.get('needle', (0.0, None))
        path = self._lines.get('path', (0.0, None))[1]
        if needle is not None and now - received < self._silence:
            return {'needle': needle, 'path': path, 'shape': 'simulated'}
        if depth is None:
            return {'needle': None, 'path': path, 'shape': None}
        tissue = self.scene['tissue'] or {}
        length, free = tissue.get('length') or depth, tissue.get('free') or 0.0
        x, z = (one or 0.0 for one in guide)
        ends = [(x, min(depth - length, -free), z), (x, -free, z)]
        if tip is not None and all(one is not None and abs(one) <= _FAR for one in tip[::2]):
            x, _, z = tip  # type: ignore[assignment]
        ends.append((x, depth, z))
        return {'needle': line(np.array(ends)), 'path': path, 'shape': 'straight'}

    def _silent(self, now: float) -> dict[str, float]:
        """Return the age of each topic after its timeout [s]."""
        ages = {name: now - received for name, (received, _) in self._readings.items()}
        # A target is published once.
        return {
            name: round(age, 1)
            for name, age in ages.items()
            if age > self._silence and name != contract.TARGET.name
        }

    def _reasons(self, now: float) -> dict[str, str]:
        """Return why a value is missing or not to be trusted, by the name of its signal."""
        silent, found = self._silent(now), {}
        for name in _EXPLAINED:
            signal = signal_of(name, self._readings)
            topic = signal.topic
            _, reading = self._readings.get(topic, (0.0, None))
            if reading is None or topic in silent:
                reason = self._unusable.get(topic, '') if name == 'depth' else ''
            else:
                reason = signal.fault(reading) or self._faults[topic] or self._standing(topic, now)
            if reason:
                found[name] = reason
        return found

    def _standing(self, topic: str, now: float) -> str:
        stamp, since = self._stamps[topic]
        if not self.robot.stamped(topic) or now - since <= self._silence:
            return ''
        if not stamp:
            return f'{topic} has no stamp'
        return f'{topic}: the stamp {stamp / NANOSECONDS:.3f} s does not advance'

    def _node_rows(self, now: float) -> list[dict[str, Any]]:
        """Return the status of each node, sorted by level, the worst first."""
        nodes = []
        for name, (received, report) in self._nodes.items():
            typed, age = report.status, max(0.0, now - received)
            nodes.append(
                {
                    'name': name,
                    'level': report.level,
                    'words': report.message,
                    'age': round(age, 1),
                    'silent': age > _SILENT_NODE,
                    'last_rejection': getattr(typed, 'last_rejection', ''),
                }
            )
            if isinstance(typed, SteeringStatus) and typed.steps:
                nodes[-1] |= {'step': typed.step, 'steps': typed.steps}
        return sorted(nodes, key=lambda node: (-node['level'], node['name']))
