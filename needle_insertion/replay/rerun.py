# SPDX-License-Identifier: Apache-2.0
"""Recompute a recorded run sample by sample, and compare it with the recording."""

from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf, isnan
from pathlib import Path
from typing import Any, Final

from needle_dynamics import FloatArray, NeedleError
from needle_dynamics.simulated import run
from needle_dynamics.simulated.commands import AppliedForces
from needle_insertion.replay.recorded_run import recorded_runs, RecordedRun
from needle_ros import contract
import numpy as np

#: Largest accepted difference relative to the largest value of a topic and unit: far above
#: rounding differences between processors or libraries, far below the resolution of sensors.
TOLERANCE: Final = 1e-6

#: Descriptions of events, by kind.
_WORDS: Final = {
    run.MOTION: 'joint_commands from sample {number} on',
    run.TRAJECTORY: 'joint_trajectory from sample {number} on',
    run.PARAMETERS: '{names} changed before sample {number}',
    run.TARE: 'the sensor was zeroed (~/tare) before sample {number}',
    run.RESET: 'the plant was reset (~/reset) before sample {number}',
    run.TIME: 'time was paused, or samples were given up, before sample {number}',
    run.CONFIGURED: 'the plant was configured again before sample {number}',
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicComparison:
    """Comparison of a recorded topic with the recomputed topic."""

    #: Number of compared messages, and of messages beyond the tolerance.
    compared: int
    differing: int
    #: Largest difference, relative to the accepted difference, and in its unit.
    largest: float
    largest_difference: float
    #: Of the largest difference, '' if there is no difference.
    quantity: str
    unit: str
    first: dict[str, Any] | None  #: First difference beyond the tolerance.

    @property
    def document(self) -> dict[str, Any]:
        names = ('compared', 'differing', 'largest_difference', 'quantity', 'unit', 'verdict')
        return {name.replace('_', ' '): getattr(self, name) for name in names}

    @property
    def verdict(self) -> str:
        if self.differing:
            return 'differs'
        return 'within tolerance' if self.largest else 'identical'


class Rerun:
    """Recomputation of a recorded run, its first difference, and the probable reason of it."""

    def __init__(self, recorded: RecordedRun, tolerance: float) -> None:
        self.recorded = recorded
        #: Events, faults of the bag, and missing information.
        self.notes = [*recorded.notes]
        #: Reason for which the recomputed plant stopped.
        self._halted = ''
        #: Whether a motion by `joint_commands` has been noted.
        self._driven = False
        self._active = self._commands()
        numbers = recorded.numbers
        #: Number of samples without a recorded active command.
        self._unknown = 0
        if recorded.constants.mode == 'simulation':
            self._unknown = numbers[-1] - numbers[0] + 1 - len(self._active)
        if self._unknown:
            self.notes.append(
                f'which command acted before {self._unknown} samples is not in the bag: each is '
                'assumed to act one period after the sample that it responds to'
            )
        computed = self._compute()
        self.topics = {
            name: self._compare(name, computed[topic.name], tolerance)
            for name, topic in recorded.topics.items()
            if name in recorded.rows
        }
        found = [topic.first for topic in self.topics.values() if topic.first is not None]
        self.first = min(found, key=lambda at: int(at['sample']), default=None)
        self.reason = '' if self.first is None else self._reason()

    @property
    def verdict(self) -> str:
        """Worst verdict of the topics: identical, within tolerance or differs."""
        verdicts = {topic.verdict for topic in self.topics.values()}
        return next((v for v in ('differs', 'within tolerance') if v in verdicts), 'identical')

    @property
    def document(self) -> dict[str, Any]:
        recorded = self.recorded
        return {
            'bag': str(recorded.path),
            'plant': recorded.name,
            'mode': recorded.constants.mode,
            'samples': len(recorded.numbers),
            'first sample': recorded.numbers[0],
            'verdict': self.verdict,
            'topics': {name: topic.document for name, topic in self.topics.items()},
            'first difference': self.first,
            'reason': self.reason,
            'notes': self.notes,
        }

    def _commands(self) -> dict[int, AppliedForces]:
        for name, rows in self.recorded.rows.items():
            topic = self.recorded.topics[name]
            efforts = [k for k, q in enumerate(topic.quantities) if q.name.startswith('effort')]
            if topic.name == contract.GROUND_TRUTH.name and efforts:
                forces = zip(rows.numbers.tolist(), rows.values[:, efforts].tolist(), strict=True)
                # Insertion reduces d.
                return {
                    n: AppliedForces(0, -d, torque)
                    for n, (d, torque, *_) in forces
                    if not isnan(d)
                }
        return {}

    def _compute(self) -> dict[str, FloatArray]:
        """Return values of each topic by sample number, nan for missing values."""
        recorded = self.recorded
        tip = recorded.constants.tip
        # Tip measurements are published with a later sample; a bag may end within a sample.
        last = max(int(rows.numbers[-1]) for rows in recorded.rows.values())
        end = max(recorded.numbers[-1] + ceil(tip.delay * recorded.constants.own.rate), last)
        computed = {
            topic.name: np.full((end + 1, len(topic.quantities)), np.nan)
            for topic in recorded.topics.values()
        }
        plant = run.PlantRun(recorded.values)
        for number in range(1, end + 1):
            stamp = recorded.stamp(number)
            try:
                for event in recorded.events.get(number, ()):
                    plant = self._perform(plant, event, number)
                measured = plant.take(stamp, self._active.get(number))
            except NeedleError as error:
                self._halted = str(error)
                break
            for name, age, values in measured:
                computed[name][number - age] = values
            for command in recorded.commands.get(number, ()):
                plant.commands.offer(*command, now=stamp)
        return computed

    def _perform(self, plant: run.PlantRun, event: run.Event, number: int) -> run.PlantRun:
        if event.kind in (run.CONFIGURED, run.TIME) and number == 1:
            return plant
        names = ', '.join(sorted(event.content))
        # A driver sends motion commands many times a second.
        if event.kind != run.MOTION or not self._driven:
            self.notes.append(_WORDS[event.kind].format(number=number, names=names))
        self._driven |= event.kind == run.MOTION
        if event.kind == run.CONFIGURED:
            return run.PlantRun(event.content, number - 1)
        plant.perform(event)
        return plant

    def _compare(self, name: str, computed: FloatArray, tolerance: float) -> TopicComparison:
        rows, quantities = self.recorded.rows[name], self.recorded.topics[name].quantities
        found = computed[rows.numbers]
        # Older versions of the plant did not publish all values.
        efforts = np.array([quantity.name.startswith('effort') for quantity in quantities])
        missing = efforts & np.isnan(rows.values).all(axis=0)
        difference = np.where(missing, 0.0, np.abs(found - rows.values))
        with np.errstate(all='ignore'):
            part = np.where(difference == 0.0, 0.0, difference / self._limits(name, tolerance))
        part = np.nan_to_num(part, nan=np.inf, posinf=np.inf)
        row, column = np.unravel_index(part.argmax(), part.shape)
        largest = float(part[row, column])
        differing = np.flatnonzero((part > 1.0).any(axis=1))
        first = None
        if len(differing):
            at = differing[0], part[differing[0]].argmax()
            first = {
                'stamp': int(rows.stamps[at[0]]),
                'sample': int(rows.numbers[at[0]]),
                'topic': name,
                'quantity': quantities[at[1]].name,
                'unit': quantities[at[1]].unit,
                'recorded': float(rows.values[at]),
                'computed': None if np.isnan(found[at]) else float(found[at]),
            }
        return TopicComparison(
            compared=len(part),
            differing=len(differing),
            largest=largest,
            largest_difference=float(difference[row, column]),
            quantity=quantities[column].name if largest else '',
            unit=quantities[column].unit if largest else '',
            first=first,
        )

    def _limits(self, name: str, tolerance: float) -> FloatArray:
        topic, constants = self.recorded.topics[name], self.recorded.constants
        sizes = np.abs(self.recorded.rows[name].values)
        sizes = np.where(np.isfinite(sizes), sizes, 0.0).max(axis=0, initial=0.0)
        units = np.array([quantity.unit for quantity in topic.quantities])
        largest = np.array([sizes[units == unit].max() for unit in units])
        resolution = np.zeros(len(units))
        if topic.name == contract.BASE_WRENCH.name:
            resolution[:] = constants.sensor.per_axis('resolution')
        elif topic.name == contract.END_EFFECTOR_POSE.name:
            resolution[:3] = constants.indenter.encoder_resolution
        elif topic.name == contract.JOINT_STATES.name and constants.mode == 'robot':
            resolution[0] = constants.base.encoder_resolution
        # Rounded values may differ by a count.
        return np.asarray(tolerance * largest + (1.0 + 1e-6) * resolution)

    def _reason(self) -> str:
        recorded, start = self.recorded, self.recorded.numbers[0]
        simulated = recorded.constants.mode == 'simulation'
        differing = {name: topic.differing for name, topic in self.topics.items()}
        wrong = {recorded.topics[name].name for name, number in differing.items() if number}
        kinds = {event.kind for events in recorded.events.values() for event in events}
        reasons = {
            f'the recomputed plant stopped: {self._halted}': self._halted,
            f'{recorded.faults} altered the measurements': recorded.faults,
            'all other messages are as computed: one was altered in transit or in the bag': (
                sum(differing.values()) == 1
            ),
            self._unknown_pause(): True,
            'the bag holds no wrench_command and no joint_commands: record them with the rest': (
                self._unknown and not recorded.commands
            ),
            'the motion is as computed: the seed or the constants of a sensor differ': (
                len(wrong - {contract.BASE_WRENCH.name, contract.TIP_DEFLECTION.name}) == 0
                and len(differing) > len(wrong)
            ),
            'the bag holds no joint_trajectory: record it with the rest': (
                not simulated and not kinds & {run.MOTION, run.TRAJECTORY}
            ),
            f'the bag begins with sample {start}: earlier commands are missing': (
                simulated and start > 1
            ),
            'which command acted is not in the bag': self._unknown,
        }
        given = (words for words, holds in reasons.items() if words and holds)
        return next(given, 'the plant was of another version, or its parameters differ')

    def _unknown_pause(self) -> str:
        """Return samples before the first difference that a pause may have left out, or ''."""
        recorded, first = self.recorded, int((self.first or {'sample': 0})['sample'])
        # Later events are not in a truncated bag; a pause before the last event is known.
        known = max(recorded.events, default=inf)
        for before, after in pairwise(recorded.numbers):
            if known <= before and after - before > 1 and after <= first:
                return (
                    f'samples {before + 1} to {after - 1} are missing after the last message of '
                    f'{recorded.name}/events: the plant may have paused there'
                )
        return ''


def verify(path: Path, tolerance: float = TOLERANCE) -> list[Rerun]:
    return [Rerun(recorded, tolerance) for recorded in recorded_runs(path)]
