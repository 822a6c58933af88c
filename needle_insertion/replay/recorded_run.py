"""A recorded run of a plant: its parameters, what was commanded, what was measured, by sample."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from itertools import pairwise
from math import inf, isfinite
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_dynamics import (
    ForceSensorParameters,
    NeedleError,
    NeedleParameters,
    PRESETS,
)
from needle_dynamics.simulated.assembly import assemble
from needle_dynamics.simulated.indenter import Indenter, IndenterParameters
from needle_dynamics.simulated.plant import BaseParameters, Plant, TipParameters
from needle_identification import Bag, deserialize, RecordingError, Topic
from needle_ros.settings import as_number
from needle_ros.timing import NANOSECONDS, nanoseconds
import yaml

#: The numbers of a message.
Values = tuple[float, ...]

#: Parameters by name, and when they were recorded [ns].
Configurations = list[tuple[int, dict[str, Any]]]


class Quantity(NamedTuple):
    """A number of a topic: its name, unit and, if it is rounded to counts, its resolution."""

    name: str
    unit: str
    resolution: float = 0.0


@dataclass(frozen=True, slots=True)
class Command:
    """Forces commanded, and the stamp of the sample that they answer [ns]."""

    stamp: int
    force: float = 0.0
    torque: float = 0.0


@dataclass(frozen=True, slots=True)
class Event:
    """A trajectory, or parameters that changed, and the sample before which it was recorded."""

    kind: str
    content: Any
    near: int


@dataclass(slots=True)
class Entry:
    """A sample: its stamp [ns], sample intervals since the one before, and what was recorded."""

    stamp: int
    gap: int = 1
    rows: dict[str, list[Values]] = field(default_factory=dict)


def configurations(path: Path) -> dict[str, Configurations]:
    """
    Return what the plants in a bag said of their parameters, by their names.

    Raises
    ------
    RecordingError
        If the bag is not readable or holds none.

    """
    plants: dict[str, Configurations] = {}
    for _, received, message in _messages(Bag(path), lambda name: name.endswith('/configuration')):
        # Some other text.
        with suppress(yaml.YAMLError, AttributeError, KeyError, TypeError):
            for name, node in yaml.safe_load(message.data).items():
                values = node['ros__parameters']
                if 'mode' in values and 'sensor.force_noise' in values:
                    plants.setdefault(str(name), []).append((received, values))
    if not plants:
        raise RecordingError(
            f'{path} holds no parameters of a plant; record /plant/configuration with the rest'
        )
    return plants


def _messages(bag: Bag, wanted: Callable[[str], bool]) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, receive time [ns] and decoded message."""
    for received, topic, data in bag.messages(lambda known: wanted(known.name)):
        yield topic.name, received, _decoded(bag, topic, data)


def _decoded(bag: Bag, topic: Topic, data: bytes) -> Any:
    try:
        return deserialize(topic, data)
    except RecordingError as error:
        raise RecordingError(f'{bag.path}: a message of {topic.name} {error}') from error


#: Constants that the parameters of a plant hold, by prefix.
_KINDS: Final[Mapping[str, Any]] = {
    'model.': NeedleParameters,
    'sensor.': ForceSensorParameters,
    'tip.': TipParameters,
    'base.': BaseParameters,
    'indenter.': IndenterParameters,
}


def settings(prefix: str, values: Mapping[str, Any]) -> Any:
    """Make constants from parameters; what the recording does not know is as it is by default."""
    kind = _KINDS[prefix]
    given: dict[str, Any] = {}
    for item in fields(kind):
        value = values.get(prefix + item.name)
        if value is not None:
            value = tuple(value) if isinstance(value, list) else value
            given[item.name] = as_number(value) if 'unit' in item.metadata else value
    if prefix == 'model.' and values.get('model.preset') in PRESETS:
        return NeedleParameters.preset(values['model.preset'], **given)
    return kind(**given)


def _foreign(values: Mapping[str, Any]) -> list[str]:
    """Name the constants that only the recording has, or only this version."""
    known = {
        f'{prefix}{item.name}' for prefix, kind in _KINDS.items() for item in fields(kind)
    } | {'model.preset'}
    given = {name for name in values if name.startswith(tuple(_KINDS))}
    # An empty list cannot be in a parameter file: then it is the default.
    lacking = {
        name
        for name in known - given - {'model.preset'}
        if getattr(settings(f'{name.partition(".")[0]}.', {}), name.partition('.')[2]) != ()
    }
    return [
        f'{words} {", ".join(sorted(names))}'
        for words, names in (('with', given - known), ('without', lacking))
        if names
    ]


def plant_from(values: Mapping[str, Any]) -> Plant | Indenter:
    """
    Make the plant that parameters describe.

    Parameters
    ----------
    values : mapping
        Parameters of the node by name.

    Raises
    ------
    ParameterError
        If one is not valid.
    KeyError
        If one is missing.

    """
    return assemble(
        values['mode'],
        rate=float(values['rate']),
        seed=values['seed'],
        step=float(values['step']),
        depth=float(values['depth']),
        tip_deflection=float(values['tip_deflection']),
        force_limit=float(values['force_limit']),
        model=settings('model.', values),
        sensor=settings('sensor.', values),
        tip=settings('tip.', values),
        base=settings('base.', values),
        indenter=settings('indenter.', values),
    )


def _vector(vector: Any) -> Values:
    return float(vector.x), float(vector.y), float(vector.z)


#: Outputs of a plant, and how their numbers are taken.
_OUTPUTS: Final[Mapping[str, Callable[[Any], Values]]] = {
    'joint_states': lambda m: tuple(map(float, (*m.position, *m.velocity, *m.effort))),
    'base_wrench': lambda m: (*_vector(m.wrench.force), *_vector(m.wrench.torque)),
    'tip_deflection': lambda m: (float(m.point.y), float(m.point.z)),
    'ground_truth': lambda m: tuple(map(float, (*m.position, *m.velocity))),
    'end_effector_pose': lambda m: _vector(m.pose.position),
}


def _named(values: Mapping[str, Any], plant: Plant | Indenter) -> dict[str, list[Quantity]]:
    """Name the numbers of each output."""
    counts = settings('sensor.', values).per_axis('resolution').tolist()
    axes = [f'{kind}.{axis}' for kind in ('force', 'torque') for axis in 'xyz']
    units = ['N'] * 3 + ['N m'] * 3
    wrench = [Quantity(*each) for each in zip(axes, units, counts, strict=True)]
    if isinstance(plant, Indenter):
        count = settings('indenter.', values).encoder_resolution
        pose = [Quantity(f'position.{axis}', 'm', count) for axis in 'xyz']
        return {'base_wrench': wrench, 'end_effector_pose': pose}
    count = plant.base.limits.encoder_resolution if plant.base is not None else 0.0
    names = plant.integrator.model.coordinate_names
    kinds = ['m', 'rad', *['m^1.5'] * (len(names) - 2)]
    return {
        'joint_states': [
            Quantity('position of insertion', 'm', count),
            Quantity('position of rotation', 'rad'),
            Quantity('velocity of insertion', 'm/s'),
            Quantity('velocity of rotation', 'rad/s'),
            Quantity('effort of insertion', 'N'),
            Quantity('effort of rotation', 'N m'),
        ],
        'base_wrench': wrench,
        'tip_deflection': [Quantity('point.y', 'm'), Quantity('point.z', 'm')],
        'ground_truth': [
            *(Quantity(name, unit) for name, unit in zip(names, kinds, strict=True)),
            *(Quantity(f'{name} rate', f'{u}/s') for name, u in zip(names, kinds, strict=True)),
        ],
    }


class RecordedRun:
    """
    A run of a plant as a bag has it.

    Parameters
    ----------
    path : Path
        The bag.
    name : str
        Full name of the plant.
    configurations : sequence
        Its parameters.

    Attributes
    ----------
    values : dict
        Its first parameters by name.
    mode : str
        What it stood in for.
    rate, period, timeout : float
        Samples per second [Hz], time from one to the next [ns], age at which a command no longer
        counts [ns].
    topics : dict
        Kind of output by topic.
    quantities : dict
        What the numbers of each topic are.
    rows : dict
        Stamps [ns] and numbers of each topic, as recorded.
    entries : list of Entry
        The same by sample, but for the tip.
    tips : dict
        Numbers of the tip by stamp.
    commands : list of Command
        In the order in which they count.
    events : list of Event
        What else was asked of it, in order.
    losses, missing, foreign : list of str
        What is broken in the bag, topics without messages, parameters of another version.
    faults : str
        Faults that were switched on, '' for none.

    Raises
    ------
    RecordingError
        If the bag is not readable, a parameter is missing or not valid, or nothing was measured.

    """

    def __init__(self, path: Path, name: str, configurations: Configurations) -> None:
        self.path, self.name = path, name
        self.values = dict(configurations[0][1])
        try:
            plant = plant_from(self.values)
            self.rate = float(self.values['rate'])
            self.timeout = NANOSECONDS * float(self.values['command_timeout'])
            self.mode = str(self.values['mode'])
        except KeyError as error:
            raise RecordingError(f'{path}: the parameters of {name} lack {error}') from error
        except NeedleError as error:
            raise RecordingError(f'{path}: the parameters of {name}: {error}') from error
        self.period = NANOSECONDS / self.rate
        self.foreign = _foreign(self.values)
        self.faults = _faults(configurations)
        named = _named(self.values, plant)
        space = name.rpartition('/')[0]
        self.topics = {f'{space}/{kind}': kind for kind in named}
        self.quantities = {f'{space}/{kind}': numbers for kind, numbers in named.items()}
        self.rows: dict[str, list[tuple[int, Values]]] = {topic: [] for topic in self.topics}
        self.tips: dict[int, list[Values]] = {}
        self.losses: list[str] = []
        #: When samples came, and which [ns].
        self._arrivals: list[tuple[int, int]] = []
        asked = self._read(space)
        self.missing = [topic for topic, found in self.rows.items() if not found]
        self.entries = self._samples()
        self.commands = self._commanded(asked)
        self.events = self._happened(asked, configurations)

    def _read(self, space: str) -> list[tuple[int, str, Any]]:
        """Read what was measured; return what was asked: receive time [ns], kind, message."""
        kinds = ('wrench_command', 'joint_trajectory')
        asked = {f'{space}/{kind}': kind for kind in kinds}
        bag = Bag(self.path)
        found: list[tuple[int, str, Any]] = []
        for topic, received, message in _messages(bag, {*self.topics, *asked}.__contains__):
            if topic in asked:
                found.append((received, asked[topic], message))
                continue
            kind = self.topics[topic]
            stamp, values = nanoseconds(message.header.stamp), _OUTPUTS[kind](message)
            if len(values) != len(self.quantities[topic]):
                raise RecordingError(
                    f'{self.path}: {topic} holds {len(values)} numbers, a plant in mode '
                    f'{self.mode} says {len(self.quantities[topic])}'
                )
            self.rows[topic].append((stamp, values))
            if kind == 'tip_deflection':
                self.tips.setdefault(stamp, []).append(values)
            else:
                self._arrivals.append((received, stamp))
        self.losses += bag.losses
        if not self._arrivals:
            listing = ', '.join(t for t, kind in self.topics.items() if kind != 'tip_deflection')
            raise RecordingError(f'{self.path} holds nothing that was measured; record {listing}')
        return found

    def _samples(self) -> list[Entry]:
        """Gather what was recorded of each sample, in the order of the stamps."""
        entries: dict[int, Entry] = {}
        for topic, found in self.rows.items():
            # A message of the tip is about an earlier sample than the one it leaves with.
            for stamp, values in found if self.topics[topic] != 'tip_deflection' else ():
                entry = entries.setdefault(stamp, Entry(stamp))
                entry.rows.setdefault(topic, []).append(values)
        ordered = [entries[stamp] for stamp in sorted(entries)]
        for early, late in pairwise(ordered):
            late.gap = max(1, round((late.stamp - early.stamp) / self.period))
        return ordered

    def _newest(self, received: int) -> int | None:
        """Return the stamp of the sample that came last before a message [ns]."""
        k = bisect_right(self._arrivals, (received, -1))
        return self._arrivals[k - 1][1] if k else None

    def _commanded(self, asked: Sequence[tuple[int, str, Any]]) -> list[Command]:
        """Return the forces commanded, without those that a newer one had overtaken."""
        limits = [float(self.values.get(f'{n}_limit', inf)) for n in ('force', 'torque')]
        commands: list[Command] = []
        for received, kind, message in asked:
            if kind == 'joint_trajectory':
                continue
            # Without a stamp it counts from when it came.
            stamp = nanoseconds(message.header.stamp) or self._newest(received) or 0
            if not commands or stamp >= commands[-1].stamp:
                commands.append(_command(stamp, message, limits))
        return commands

    def _happened(
        self, asked: Sequence[tuple[int, str, Any]], configurations: Configurations
    ) -> list[Event]:
        """Return trajectories and changes of parameters, and where among the samples they came."""
        found: list[tuple[int, str, Any]] = []
        if self.mode != 'simulation':
            found += [(at, kind, m) for at, kind, m in asked if kind == 'joint_trajectory']
        for (_, before), (at, after) in pairwise(configurations):
            if _without_faults(before) != _without_faults(after):
                found.append((at, 'configuration', (before, after)))
        found.sort(key=lambda event: event[0])
        stamps = [entry.stamp for entry in self.entries]
        events = []
        for at, kind, content in found:
            newest = self._newest(at)
            near = 0 if newest is None else bisect_right(stamps, newest)
            events.append(Event(kind, content, near))
        return events

    def limits(self, part: float) -> dict[str, list[float]]:
        """
        Return the largest difference allowed of each number of each topic.

        Parameters
        ----------
        part : float
            Part of the largest value of the same topic and unit; a count comes on top.

        """
        limits = {}
        for topic, found in self.rows.items():
            largest: dict[str, float] = {}
            for k, quantity in enumerate(self.quantities[topic]):
                sizes = (abs(values[k]) for _, values in found if isfinite(values[k]))
                largest[quantity.unit] = max(largest.get(quantity.unit, 0.0), *sizes, 0.0)
            limits[topic] = [
                # A count is the difference of two rounded numbers.
                part * largest[q.unit] + (1.0 + 1e-6) * q.resolution
                for q in self.quantities[topic]
            ]
        return limits


def _command(stamp: int, message: Any, limits: Sequence[float]) -> Command:
    """Return the forces of a message; none for one that a plant refuses."""
    force, torque = message.wrench.force.y, message.wrench.torque.x
    if abs(force) <= limits[0] and abs(torque) <= limits[1]:
        return Command(stamp, force, torque)
    return Command(stamp)


def _without_faults(values: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out what does not reach the plant, but what it measures."""
    return {name: value for name, value in values.items() if not name.startswith('fault.')}


def _faults(configurations: Sequence[tuple[int, Mapping[str, Any]]]) -> str:
    """Name the faults that were switched on."""
    found = {
        f'fault.kind = {values["fault.kind"]} on {values.get("fault.topic")}'
        for _, values in configurations
        if values.get('fault.kind', 'none') != 'none'
    }
    return ' and '.join(sorted(found))
