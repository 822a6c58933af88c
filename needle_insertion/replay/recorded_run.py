# SPDX-License-Identifier: Apache-2.0
"""Read a recorded plant run from a bag: events, commands and measurements by sample number."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import fields
from itertools import chain, pairwise
import json
from math import inf, nan
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_dynamics import FloatArray, NeedleError
from needle_dynamics.needles import FILES
from needle_dynamics.parameters import PAPER_NEEDLE
from needle_dynamics.simulated.assembly import SETTINGS
from needle_dynamics.simulated.run import CONFIGURED, Event, PARAMETERS, PlantRun, TRAJECTORY
from needle_identification import Bag, RecordingError
from needle_identification.bags.messages import deserialize
from needle_identification.bags.topics import BagTopic
from needle_ros.contract import TIP_DEFLECTION, TOPICS
from needle_ros.errors import MessageError, ParameterError
from needle_ros.parameter_file import parameters_by_node
from needle_ros.timing import NANOSECONDS, nanoseconds, seconds
from needle_ros.wire import MessageReader, TYPES
import numpy as np
from numpy.typing import NDArray

#: Message types by the last part of the name of a topic.
_TYPES: Final = {topic.name.rpartition('/')[2]: topic.type_name for topic in TOPICS}

#: Topics that are read in addition to measurements and commands.
_OTHERS: Final = ('configuration', 'events', 'joint_trajectory')

#: Parameters that are required to recreate a plant.
_NEEDED: Final = ('mode', 'seed', 'rate', 'step', 'depth', 'force_limit', 'command_timeout')

#: Limits that older versions of the plant did not have.
_UNLIMITED: Final = {'force_rate_limit': 1e12, 'power_limit': 1e12}

_Messages = list[tuple[int, Any]]  #: Messages of a topic with their recording time [ns].


def recorded_runs(path: Path) -> list[RecordedRun]:
    """Read the runs of all plants in a bag; raise `RecordingError` without a plant."""
    bag, invalid = Bag(path), Counter[str]()
    messages: dict[str, _Messages] = defaultdict(list)
    readers: dict[str, MessageReader] = {}

    def wanted(topic: BagTopic) -> bool:
        kind = topic.name.rpartition('/')[2]
        return _TYPES.get(kind) == topic.type_name and (
            kind in _OTHERS or topic.type_name in TYPES
        )

    for received, topic, data in bag.messages(wanted):
        name, kind = topic.name, topic.type_name
        try:
            if kind in TYPES:
                message = readers.setdefault(name, MessageReader(kind)).read(data)
            else:
                message = deserialize(topic, data)
            messages[name].append((received, message))
        except (MessageError, RecordingError):
            invalid[name] += 1
    losses = [*bag.losses, *(f'{n} messages of {name} are invalid' for name, n in invalid.items())]
    runs = [
        RecordedRun(path, name.removesuffix('/configuration'), messages, losses)
        for name, found in messages.items()
        if name.endswith('/configuration') and _configurations(found)
    ]
    if not runs:
        # Raises the error of a bag without messages.
        bag.topics()
        lacking = 'holds no parameters of a plant; record /plant/configuration with the rest'
        unreadable = [
            name
            for name, found in messages.items()
            if name.endswith('/configuration')
            and not any(parameters_by_node(message.data) for _, message in found)
        ]
        if unreadable:
            lacking = f'holds no parameters: {", ".join(unreadable)} cannot be read as parameters'
        raise RecordingError('; '.join([f'{path} {lacking}', *losses]))
    return runs


def _configurations(messages: _Messages) -> list[tuple[int, dict[str, Any]]]:
    # Other nodes are skipped.
    return [
        (received, values)
        for received, message in messages
        for values in parameters_by_node(message.data).values()
        if 'mode' in values and 'sensor.force_noise' in values
    ]


def _events(messages: _Messages) -> list[tuple[int, int, Event]]:
    """Read events with stamp [ns] and number of the first affected sample."""
    found = []
    for _, message in messages:
        for status in message.status:
            # Skip other diagnostics.
            with suppress(ValueError, KeyError):
                content = {item.key: json.loads(item.value) for item in status.values}
                number = int(content.pop('sample'))
                event = Event(status.message, content)
                found.append((nanoseconds(message.header.stamp), number, event))
    return found


class Rows(NamedTuple):
    """Messages of a topic, sorted by sample number, from 1, with stamps [ns], shape (n,)."""

    numbers: NDArray[np.int64]
    stamps: NDArray[np.int64]
    values: FloatArray  #: Shape (n, k), nan for values that an older version did not publish.


class RecordedRun:
    """Recorded run of a plant; `RecordingError` for invalid parameters or no measurements."""

    def __init__(
        self, path: Path, name: str, messages: Mapping[str, _Messages], losses: list[str]
    ) -> None:
        self.path, self.name = path, name
        space = name.rpartition('/')[0]
        configurations = _configurations(messages[f'{name}/configuration'])
        recorded = _events(messages.get(f'{name}/events', []))
        made = (event.content for _, _, event in recorded if event.kind == CONFIGURED)
        #: Parameters and constants at the start, and topics by full name.
        self.values = {**_UNLIMITED, **next(made, configurations[0][1])}
        # `model.preset` in older versions. All constants are recorded: no file is read.
        needle = self.values.pop('needle', self.values.pop('model.preset', PAPER_NEEDLE))
        self.values['needle'] = PAPER_NEEDLE if str(needle).endswith(FILES) else needle
        lacking = next((name for name in _NEEDED if name not in self.values), None)
        if lacking:
            raise RecordingError(f'{path}: the parameters of {name} lack {lacking!r}')
        try:
            plant = PlantRun(self.values)
        except NeedleError as error:
            raise RecordingError(f'{path}: the parameters of {name}: {error}') from error
        self.constants = plant.constants
        self.topics = {f'{space}/{topic.name}': topic for topic in plant.topics.values()}
        self._period = NANOSECONDS / self.constants.own.rate
        #: Known pairs of stamp [ns] and sample number, from which the others are interpolated.
        self._anchors = [(stamp, number) for stamp, number, _ in recorded]
        #: Recording times [ns] and sample numbers.
        self._arrivals: list[tuple[int, int]] = []
        self.rows = self._measured(messages)
        self.numbers = sorted({number for _, number in self._arrivals})
        trajectories = messages.get(f'{space}/joint_trajectory', [])
        done = [(number, event) for _, number, event in recorded]
        #: Events by the number of the first affected sample.
        self.events: dict[int, list[Event]] = defaultdict(list)
        for number, event in done or self._guessed(configurations, trajectories):
            self.events[number].append(event)
        #: Stamp [ns], frame, force [N] and torque [N m] of commands, by the number of the last
        #: sample before their arrival.
        self.commands: dict[int, list[tuple[int, str, float, float]]] = defaultdict(list)
        for received, (stamp, frame, _, (values,)) in messages.get(f'{space}/wrench_command', []):
            number = self._number(stamp) if stamp else self._newest(received)
            self.commands[number].append((stamp, frame, values[1], values[3]))
        for stamp, force, torque in self._efforts(messages.get(f'{space}/joint_commands', [])):
            self.commands[self._number(stamp)].append((stamp, '', force, torque))
        faults = {
            f'fault.kind = {values["fault.kind"]} on {values.get("fault.topic")}'
            for _, values in configurations
            if values.get('fault.kind', 'none') != 'none'
        }
        self.faults = ' and '.join(sorted(faults))
        self.notes = [*losses, *self._missing(has_events=bool(recorded))]

    def _measured(self, messages: Mapping[str, _Messages]) -> dict[str, Rows]:
        sampled = [name for name in self.topics if not name.endswith(TIP_DEFLECTION.name)]
        stamps = [reading.stamp for name in sampled for _, reading in messages.get(name, [])]
        if not stamps:
            raise RecordingError(f'{self.path} holds no measurements; record {", ".join(sampled)}')
        self._anchors = self._anchors or [(min(stamps), 1)]
        rows = {}
        for name, topic in self.topics.items():
            found, width = [], len(topic.quantities)
            for received, reading in messages.get(name, []):
                values = [*chain(*reading.values)]
                if len(values) not in (width, 2 * len(topic.joints)):
                    raise RecordingError(
                        f'{self.path}: {name} holds {len(values)} numbers, a plant in mode '
                        f'{self.constants.mode} publishes {width}'
                    )
                number = self._number(reading.stamp)
                if name in sampled:
                    self._arrivals.append((received, number))
                values += [np.nan] * (width - len(values))
                found.append((number, reading.stamp, values))
            if found:
                numbers, times, table = zip(*sorted(found, key=lambda row: row[0]), strict=True)
                rows[name] = Rows(np.array(numbers), np.array(times), np.array(table))
        self._arrivals.sort()
        return rows

    def _number(self, stamp: int) -> int:
        begin, number = self._anchors[max(bisect_right(self._anchors, (stamp, inf)) - 1, 0)]
        return number + round((stamp - begin) / self._period)

    def _efforts(self, messages: _Messages) -> Iterator[tuple[int, float, float]]:
        """Yield stamp [ns], force [N] and torque [N m] of `joint_commands`."""
        reader = self.constants.joint_commands()
        for received, reading in messages:
            # Commands that the plant rejects have no force.
            force = torque = nan
            stamp = reading.stamp or self.stamp(self._newest(received))
            with suppress(ParameterError):
                asked = reader.read(reading, {}, stamp)
                reader.accept(asked)
                force, torque = asked.force, asked.torque
            yield stamp, force, torque

    def stamp(self, number: int) -> int:
        after = bisect_right(self._anchors, number, key=lambda anchor: anchor[1])
        begin, known = self._anchors[max(after - 1, 0)]
        return begin + round((number - known) * self._period)

    def _newest(self, received: int) -> int:
        """Return the newest sample number at a recording time [ns], 0 for none."""
        before = self._arrivals[: bisect_left(self._arrivals, (received, 0))]
        return max((number for _, number in before), default=0)

    def _guessed(
        self, configurations: list[tuple[int, dict[str, Any]]], trajectories: _Messages
    ) -> Iterator[tuple[int, Event]]:
        """Yield events of a plant without recorded events, with the next sample number."""
        found = list[tuple[int, Event]]()
        for received, message in () if self.constants.mode == 'simulation' else trajectories:
            content = {
                'joints': list(message.joint_names),
                'times': [seconds(point.time_from_start) for point in message.points],
                'positions': [point.positions.tolist() for point in message.points],
                'efforts': [point.effort.tolist() for point in message.points],
            }
            found.append((received, Event(TRAJECTORY, content)))
        for (_, old), (received, new) in pairwise(configurations):
            changes = {name: new[name] for name in new if new[name] != old.get(name)}
            if changes:
                found.append((received, Event(PARAMETERS, changes)))
        for received, event in sorted(found, key=lambda each: each[0]):
            yield self._newest(received) + 1, event

    def _missing(self, *, has_events: bool) -> Iterator[str]:
        if not has_events:
            yield (
                f'{self.name}/events is not in the bag: trajectories and changes of parameters '
                'are assumed to apply from the sample after they were recorded'
            )
        for name, rows in self.rows.items():
            repeated = len(rows.stamps) - len(np.unique(rows.stamps))
            if repeated:
                yield f'{repeated} of {len(rows.stamps)} messages of {name} repeat a stamp'
        missing = [topic for topic in self.topics if topic not in self.rows]
        if missing:
            yield f'not in the bag: {", ".join(missing)}'
        known = {f'{prefix}{x.name}' for prefix, kind in SETTINGS.items() for x in fields(kind)}
        namespaces = tuple(filter(None, SETTINGS))
        given = {name for name in self.values if name.startswith(namespaces)}
        if foreign := given - known:
            yield f'recorded by another version, with {", ".join(sorted(foreign))}'
