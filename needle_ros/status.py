# SPDX-License-Identifier: Apache-2.0
"""
Status of the nodes, and its mapping to the key-value pairs of a DiagnosticStatus.

Readers use the dataclasses of this file; the keys are for people and plots. A key is the name of
the field with its unit, such as ``insertion depth [m]``; the fields of a nested dataclass and the
entries of a mapping follow it, such as ``input joint_states rate [Hz]``. An optional field without
a value has no pair.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from functools import cache, cached_property
from types import NoneType, UnionType
from typing import Any, Final, Generic, get_args, get_origin, get_type_hints, TypeVar

from needle_ros.errors import printable, shown
from needle_ros.event_log import Severity
from needle_ros.requests import RequestStatus
from needle_ros.system_state import Mode

TASK: Final = 'state'  #: Task in the name of the status of a node: ``/plant: state``.
HARDWARE: Final = 'needle'  #: Hardware of nodes without a namespace; else the namespace.
LEVELS: Final = ('OK', 'WARN', 'ERROR', 'STALE')  #: Names of the levels of a DiagnosticStatus.
STALE: Final = bytes([3])  #: Level STALE of a DiagnosticStatus: its values are no longer updated.
SILENT: Final = 5.0  #: Timeout of the status of a node, which is published every second [s].
_KIND: Final = 'kind'  #: Key of the kind of a status.
_MISSING: Final = object()  #: Result of a field that is missing or invalid in a status.

_Status = TypeVar('_Status', bound='NodeStatus')
_Reported_co = TypeVar('_Reported_co', bound='NodeStatus', covariant=True)


def entry(default: Any, unit: str, description: str) -> Any:
    """Declare a field of a status; a default of `dict` or `RequestStatus` is called."""
    meta = {'unit': unit, 'description': description}
    if isinstance(default, type):
        return field(default_factory=default, metadata=meta)
    return field(default=default, metadata=meta)


class ControllerPhase(Enum):
    """Phase of the controller."""

    INACTIVE = 'inactive'
    WAITING = 'waiting'  #: No `joint_states` received yet.
    ACTIVE = 'active'  #: Answers measurements.
    FAULT = 'fault'  #: Without force, or with a reference that waits, as long as a fault lasts.
    STOPPED = 'stopped'  #: Without force until `~/clear_stop`.


class CommissioningPhase(Enum):
    """Phase of the check of a robot before its first motion."""

    WAITING = 'waiting'
    MOVING = 'moving'
    PASSED = 'passed'
    REFUSED = 'refused'
    SKIPPED = 'skipped'


class SteeringPhase(Enum):
    """Phase of a steered insertion."""

    INACTIVE = 'inactive'
    IDLE = 'idle'
    PLANNING = 'planning'
    GUIDING = 'guiding'
    INSERTING = 'inserting'
    MEASURING = 'measuring'
    RETRACTING = 'retracting'
    DONE = 'done'
    STOPPED = 'stopped'


class PlantPhase(Enum):
    """Phase of the plant."""

    INACTIVE = 'inactive'
    RUNNING = 'running'
    PAUSED = 'paused'  #: Simulated time stands still.
    HALTED = 'halted'  #: Stopped by an error until a reset.


class PlayerPhase(Enum):
    """Phase of the player."""

    INACTIVE = 'inactive'
    PLAYING = 'playing'
    PAUSED = 'paused'
    ENDED = 'ended'


class SlicerPhase(Enum):
    """Phase of the connection to 3D Slicer."""

    INACTIVE = 'inactive'
    WAITING = 'waiting'
    CONNECTED = 'connected'
    ERROR = 'error'


@dataclass(frozen=True, slots=True, kw_only=True)
class InputStatus:
    """Status of an input monitor."""

    rate: float = entry(0.0, 'Hz', 'messages in the last second')
    age: float | None = entry(None, 's', 'time since the last accepted message')
    accepted: int = entry(0, '', 'accepted messages')
    repeated: int = entry(0, '', 'messages received twice')
    out_of_order: int = entry(0, '', 'messages that are older than the message before')
    rejected: Mapping[str, int] = entry(dict, '', 'rejected messages by reason')


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyStatus:
    """Status of the latency monitor."""

    answered: int = entry(0, '', 'measurements answered by a command')
    late: int = entry(0, '', 'commands later than the configured delay')
    longest: float = entry(0.0, 's', 'largest age of an answered measurement')


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserverStatus:
    """Status of the observer of the bent needle."""

    tip_deflection: float = entry(0.0, 'm', 'estimated tip deflection')
    tip_deflection_deviation: float = entry(0.0, 'm', 'standard deviation of the tip deflection')
    tip_force: float = entry(0.0, 'N', 'estimated lateral force at the tip')
    tip_force_deviation: float = entry(0.0, 'N', 'standard deviation of the lateral force')
    load: float = entry(0.0, 'N', 'axial load of the bent needle')
    nis: float = entry(1.0, '', 'normalized innovation squared; 1 for a consistent observer')
    nis_interval: tuple[float, float] = entry((0.0, 0.0), '', 'interval of a consistent observer')
    rejected: int = entry(0, '', 'rejected samples')
    restarts: int = entry(0, '', 'restarts')
    warning: str = entry('', '', 'why the estimate is not used')


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeStatus:
    """Status of any node."""

    invalid_messages: Mapping[str, int] = entry(dict, '', 'unreadable messages by topic')
    failure: str = entry('', '', 'reason of the last refused transition')

    @classmethod
    def kind(cls) -> str:
        """Return the value of the key `kind`, such as ``plant`` for a `PlantStatus`."""
        return cls.__name__.removesuffix('Status').lower()

    def to_values(self) -> dict[str, str]:
        return {_KIND: self.kind(), **dict(_pairs(self, '', ''))}

    @classmethod
    def from_values(cls: type[_Status], values: Mapping[str, str]) -> _Status:
        """Parse the fields from key-value pairs; a missing or invalid one has its default."""
        found = _filled(cls, values, '')
        return cls() if found is _MISSING else found


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerStatus(NodeStatus):
    """Status of the node `controller`."""

    phase: ControllerPhase = entry(ControllerPhase.INACTIVE, '', 'phase')
    system: Mode = entry(Mode.RUNNING, '', 'mode of the system')
    fault: str = entry('', '', 'why no force is commanded or the reference waits')
    stop: str = entry('', '', 'reason of the latched stop')
    warning: str = entry('', '', 'inputs, observer or rate that need attention')
    stops: int = entry(0, '', 'latched stops')
    duplicate_publishers: str = entry('', '', 'topics with several publishers')
    target: float | None = entry(None, 'm', 'target insertion depth')
    law: str = entry('', '', 'control law')
    least_stable_axis: str = entry('', '', 'axis with the smallest stability margin')
    spectral_radius: float | None = entry(None, '', 'largest pole magnitude of this axis')
    spectral_radius_limit: float | None = entry(None, '', 'largest permitted pole magnitude')
    learned: Mapping[str, tuple[float, float]] = entry(
        dict, '', 'learned friction by term, with its standard deviation'
    )
    observer: ObserverStatus | None = entry(None, '', 'observer, from its first estimate')
    latency: LatencyStatus = entry(LatencyStatus, '', 'latency of the commands')
    command_rate: float = entry(0.0, 'Hz', 'commands in the last second')
    saturated_fraction: float = entry(0.0, '', 'fraction of commands at their limit')
    input: Mapping[str, InputStatus] = entry(dict, '', 'inputs by topic')
    rejected: int = entry(0, '', 'rejected messages and requests')
    last_rejection: str = entry('', '', 'reason of the last rejection')
    robot: str = entry('', '', 'topics and joints of a robot with topics of its own')
    velocity_source: str = entry('', '', 'velocity of this robot: estimated or reported')
    commissioning: CommissioningPhase | None = entry(None, '', 'check of this robot')
    commissioning_result: str = entry('', '', 'response of this robot, or reason of a refusal')
    requests: RequestStatus = entry(RequestStatus, '', 'requests and their acknowledgement')


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringStatus(NodeStatus):
    """Status of the node `steering`."""

    phase: SteeringPhase = entry(SteeringPhase.INACTIVE, '', 'phase')
    system: Mode = entry(Mode.RUNNING, '', 'mode of the system')
    fault: str = entry('', '', 'reason of the stop')
    planned_fraction: float | None = entry(None, '', 'completed fraction of the planning')
    target: tuple[float, float, float] | None = entry(None, 'm', 'target x, y, z of the tip')
    step: int = entry(0, '', 'completed steps')
    steps: int = entry(0, '', 'steps of the insertion')
    guide_setpoint: tuple[float, float] | None = entry(None, 'm', 'guide setpoint x, z')
    turns_left: int | None = entry(None, '', 'half turns that are left')
    hit_probability: float | None = entry(None, '', 'probability of a hit within 1 mm')
    bending_length_ratio: float | None = entry(None, '', 'bending length over the nominal one')
    law: Mapping[str, float] = entry(dict, '', 'further values of the steering law, by name')
    expected_tip: tuple[float, float] | None = entry(None, 'm', 'expected tip x, z at the target')
    expected_tip_half_width: tuple[float, float] | None = entry(None, 'm', 'half width, 95 %')
    last_measurement_readings: int | None = entry(None, '', 'readings of the last tip measurement')
    last_measurement_error: float | None = entry(None, 'm', 'standard error of this measurement')
    warning: str = entry('', '', 'warning')
    input: Mapping[str, InputStatus] = entry(dict, '', 'inputs by topic')
    rejected: int = entry(0, '', 'rejected messages and requests')
    last_rejection: str = entry('', '', 'reason of the last rejection')
    requests: RequestStatus = entry(RequestStatus, '', 'requests and their acknowledgement')


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantStatus(NodeStatus):
    """Status of the node `plant`."""

    phase: PlantPhase = entry(PlantPhase.INACTIVE, '', 'phase')
    system: Mode = entry(Mode.RUNNING, '', 'mode of the system')
    halt: str = entry('', '', 'error that has halted the plant')
    time: float = entry(0.0, 's', 'simulated time')
    insertion_depth: float | None = entry(None, 'm', 'insertion depth')
    tip: tuple[float, float] | None = entry(None, 'm', 'tip position x, z of a steered needle')
    tip_roll: float | None = entry(None, 'rad', 'roll of the tip of a steered needle')
    joint: Mapping[str, float] = entry(dict, 'm or rad', 'positions of guide and roll by joint')
    force: tuple[float, float] | None = entry(None, 'N', 'force x, z of the indenter')
    real_time_factor: float = entry(0.0, '', 'simulated time over real time, last second')
    command_rate: float = entry(0.0, 'Hz', 'commands in the last second')
    commanders: int = entry(0, '', 'nodes that publish commands, if more than one')
    exhausted: bool = entry(False, '', 'whether the commands exceed the energy limit')
    computed_later: int = entry(0, '', 'samples computed after a stall')
    skipped: int = entry(0, '', 'samples skipped after a stall')
    waited: float = entry(0.0, 's', 'time that the simulation has waited for the machine')
    awaited: str = entry('', '', 'answer that has been missing for two seconds')
    rejected: int = entry(0, '', 'rejected commands and trajectories')
    stale: int = entry(0, '', 'stale commands')
    superseded: int = entry(0, '', 'commands superseded by a newer one')
    saturated: int = entry(0, '', 'sensor readings at the end of their range')
    sensor_fault: str = entry('', '', 'simulated fault of a sensor')
    faulty_topic: str = entry('', '', 'topic with this fault')
    other_clock: str = entry('', '', 'other node that publishes the time of this plant')
    lockstep_nodes: int = entry(0, '', 'nodes in lock-step')
    requests: RequestStatus = entry(RequestStatus, '', 'requests and their acknowledgement')


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderStatus(NodeStatus):
    """Status of the node `recorder`."""

    path: str = entry('', '', 'bag of the recording, empty without a recording')
    messages: int = entry(0, '', 'recorded messages')
    size: int = entry(0, 'B', 'size of the bag')
    recorded: Mapping[str, int] = entry(dict, '', 'recorded messages by topic')
    lost: Mapping[str, int] = entry(dict, '', 'lost messages by topic')


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayerStatus(NodeStatus):
    """Status of the node `player`."""

    phase: PlayerPhase = entry(PlayerPhase.INACTIVE, '', 'phase')
    path: str = entry('', '', 'bag')
    position: float = entry(0.0, 's', 'position in the bag')
    rate: float = entry(0.0, '', 'speed of the playback; 1 is real time')
    delay: float = entry(0.0, 's', 'delay of the last message')
    largest_delay: float = entry(0.0, 's', 'largest delay so far')
    messages: int = entry(0, '', 'published messages')
    loops: int = entry(0, '', 'completed loops')
    left_out: str = entry('', '', 'topics that are not played')
    duplicate_publishers: str = entry('', '', 'topics with another publisher')


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentificationStatus(NodeStatus):
    """Status of the node `identification`."""

    samples: int = entry(0, '', 'processed samples of the running topics')
    discarded: Mapping[str, int] = entry(dict, '', 'discarded samples by reason')


@dataclass(frozen=True, slots=True, kw_only=True)
class SlicerStatus(NodeStatus):
    """Status of the node `slicer`."""

    phase: SlicerPhase = entry(SlicerPhase.INACTIVE, '', 'phase of the connection')
    peer: str = entry('', '', 'address of the connected peer')
    error: str = entry('', '', 'error of the connection')
    shape_source: str = entry('', '', 'source of the shape, empty without a shape')
    shapes: int = entry(0, '', 'transmitted shapes')
    shape_rate: float = entry(0.0, 'Hz', 'shapes in the last second')
    left_out: int = entry(0, '', 'messages left out for a slow peer')
    targets: int = entry(0, '', 'accepted targets')
    rejected: int = entry(0, '', 'rejected messages')
    last_rejection: str = entry('', '', 'reason of the last rejection')
    planning: str = entry('', '', 'state of the plan for a target, empty without labels')


#: All status classes of nodes by kind, in the order above.
STATUSES: Final[Mapping[str, type[NodeStatus]]] = {
    one.kind(): one
    for one in [*globals().values()]
    if isinstance(one, type) and issubclass(one, NodeStatus)
}


@dataclass(frozen=True, slots=True)
class Diagnosis(Generic[_Reported_co]):
    """State of a node: severity, one line for users, and the typed status."""

    severity: Severity
    message: str
    status: _Reported_co


@dataclass(frozen=True)
class NodeReport:
    """State of a node as received on /diagnostics, of this suite or of others."""

    node: str  #: Node with its namespace; nodes of others keep their tasks.
    level: int  #: Index of `LEVELS`, or larger.
    message: str
    values: Mapping[str, str]

    @property
    def name(self) -> str:
        """Name of the node without its namespace."""
        return self.node.rpartition('/')[2]

    @property
    def level_name(self) -> str:
        return LEVELS[self.level] if self.level < len(LEVELS) else str(self.level)

    @cached_property
    def status(self) -> NodeStatus | None:
        """Typed status of a node of this suite."""
        kind = STATUSES.get(self.values.get(_KIND, ''))
        return None if kind is None else kind.from_values(self.values)

    @cached_property
    def requests(self) -> RequestStatus:
        """Requests that the node accepts, and its answers."""
        return RequestStatus.from_values(self.values)


def read_reports(message: Any) -> list[NodeReport]:
    """Read the states of nodes from a DiagnosticArray of rclpy or of a bag."""
    return [_report(status) for status in message.status]


def _report(status: Any) -> NodeReport:
    # rclpy represents a byte as bytes.
    level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
    values = {shown(one.key): shown(one.value) for one in status.values}
    node = printable(status.name).removesuffix(f': {TASK}')
    return NodeReport(node, level, printable(status.message), values)


# Mapping to and from key-value pairs.


def _key(prefix: str, name: str) -> str:
    words = name.replace('_', ' ')
    return f'{prefix} {words}' if prefix else words


def _with_unit(key: str, unit: str) -> str:
    return f'{key} [{unit}]' if unit else key


def _pairs(value: Any, key: str, unit: str) -> Iterator[tuple[str, str]]:
    if value is None:
        return
    if isinstance(value, RequestStatus):
        yield from value.to_values().items()
    elif is_dataclass(value):
        for one in fields(value):
            part = getattr(value, one.name)
            yield from _pairs(part, _key(key, one.name), one.metadata['unit'])
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from _pairs(part, f'{key} {name}', unit)
    else:
        yield _with_unit(key, unit), _text(value)


def _text(value: Any) -> str:
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, float):
        # Shortest text that is read as the same number.
        return repr(float(value))
    return ', '.join(map(_text, value)) if isinstance(value, tuple) else str(value)


_hints = cache(get_type_hints)


def _filled(kind: Any, values: Mapping[str, str], prefix: str) -> Any:
    """Return a dataclass from key-value pairs; `_MISSING` without any pair of it."""
    hints = _hints(kind)
    found = {
        one.name: _value(hints[one.name], values, _key(prefix, one.name), one.metadata['unit'])
        for one in fields(kind)
    }
    found = {name: value for name, value in found.items() if value is not _MISSING}
    return kind(**found) if found else _MISSING


def _value(hint: Any, values: Mapping[str, str], key: str, unit: str) -> Any:
    """Return the value of a type from key-value pairs; `_MISSING` if there is none."""
    if get_origin(hint) is UnionType:
        (hint,) = (one for one in get_args(hint) if one is not NoneType)
    if hint is RequestStatus:
        return RequestStatus.from_values(values)
    if is_dataclass(hint):
        return _filled(hint, values, key)
    if get_origin(hint) is Mapping:
        return _entries(get_args(hint)[1], values, key, unit)
    text = values.get(_with_unit(key, unit))
    try:
        return _MISSING if text is None else _parsed(hint, text)
    except ValueError:
        return _MISSING


def _entries(hint: Any, values: Mapping[str, str], key: str, unit: str) -> Any:
    """Return a mapping whose names follow a key; names with nested fields have no spaces."""
    start, end = f'{key} ', _with_unit('', unit)
    names = [
        name[len(start) : len(name) - len(end)]
        for name in values
        if name.startswith(start) and name.endswith(end)
    ]
    if is_dataclass(hint):
        names = [name.partition(' ')[0] for name in names]
    found = {name: _value(hint, values, f'{key} {name}', unit) for name in names}
    return {name: value for name, value in found.items() if value is not _MISSING} or _MISSING


def _parsed(hint: Any, text: str) -> Any:
    """Parse a text as a type; raise ValueError if it is invalid."""
    if hint is bool:
        if text not in ('True', 'False'):
            raise ValueError(text)
        return text == 'True'
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        return tuple(
            _parsed(kind, part) for kind, part in zip(kinds, text.split(', '), strict=True)
        )
    return hint(text)
