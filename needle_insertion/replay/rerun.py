"""A recorded run computed again, sample by sample, and compared with what was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, isnan
from pathlib import Path
from typing import Any, Final

from needle_dynamics import FloatArray, NeedleError
from needle_dynamics.simulated.commands import Command
from needle_dynamics.simulated.run import (
    CONFIGURED,
    Event,
    MOTION,
    PARAMETERS,
    PlantRun,
    RESET,
    TARE,
    TIME,
    TRAJECTORY,
)
from needle_insertion.replay.recorded_run import recorded_runs, RecordedRun
from needle_ros.contract import (
    BASE_WRENCH,
    END_EFFECTOR_POSE,
    GROUND_TRUTH,
    JOINT_STATES,
    TIP_DEFLECTION,
)
import numpy as np

#: Part of the largest value of a topic and unit that a difference may be: far above what another
#: processor or library rounds otherwise, far below what any sensor resolves.
TOLERANCE: Final = 1e-6

#: What is said of events, by kind.
_WORDS: Final = {
    MOTION: 'joint_commands from sample {number} on',
    TRAJECTORY: 'joint_trajectory from sample {number} on',
    PARAMETERS: '{names} changed before sample {number}',
    TARE: 'the sensor was zeroed (~/tare) before sample {number}',
    RESET: 'the plant was put back (~/reset) before sample {number}',
    TIME: 'time was paused, or samples were given up, before sample {number}',
    CONFIGURED: 'the plant was configured again before sample {number}',
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """
    What the comparison of a topic has given.

    Attributes
    ----------
    compared, differing : int
        Number of messages compared, and of those beyond the tolerance.
    largest : float
        Largest difference, relative to what is allowed.
    difference : float
        The same in its unit.
    quantity, unit : str
        The number that has it, '' if there is no difference.
    first : dict or None
        First difference beyond the tolerance.

    """

    compared: int
    differing: int
    largest: float
    difference: float
    quantity: str
    unit: str
    first: dict[str, Any] | None

    @property
    def verdict(self) -> str:
        """Identical, within tolerance or differs."""
        if self.differing:
            return 'differs'
        return 'within tolerance' if self.largest else 'identical'


class Rerun:
    """
    A recorded run, computed again.

    Parameters
    ----------
    recorded : RecordedRun
        The run.
    tolerance : float
        Part of the largest value of a topic and unit that a difference may be.

    Attributes
    ----------
    recorded : RecordedRun
        The run as the bag has it.
    topics : dict
        `Comparison` of each topic.
    first : dict or None
        First difference beyond the tolerance.
    reason : str
        Why it may be there, '' if there is none.
    notes : list of str
        What was done to the plant, what is broken in the bag, and what it does not say.

    """

    def __init__(self, recorded: RecordedRun, tolerance: float) -> None:
        self.recorded = recorded
        self.notes = [*recorded.notes]
        #: Why the computed plant gives no more samples.
        self._halted = ''
        #: Whether a motion of `joint_commands` has been noted.
        self._driven = False
        self._told = self._commands()
        numbers = recorded.numbers
        #: Samples before which it is not known which command acted.
        self._untold = 0
        if recorded.constants.mode == 'simulation':
            self._untold = numbers[-1] - numbers[0] + 1 - len(self._told)
        if self._untold:
            self.notes.append(
                f'which command acted before {self._untold} samples is not in the bag: each is '
                'taken to act one period after the sample that it answers'
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
        """The worst verdict of the topics: identical, within tolerance or differs."""
        verdicts = {topic.verdict for topic in self.topics.values()}
        return next((v for v in ('differs', 'within tolerance') if v in verdicts), 'identical')

    @property
    def document(self) -> dict[str, Any]:
        """Everything for JSON, by name."""
        recorded = self.recorded
        return {
            'bag': str(recorded.path),
            'plant': recorded.name,
            'mode': recorded.constants.mode,
            'samples': len(recorded.numbers),
            'first sample': recorded.numbers[0],
            'verdict': self.verdict,
            'topics': {
                name: {
                    'compared': topic.compared,
                    'differing': topic.differing,
                    'largest difference': topic.difference,
                    'quantity': topic.quantity,
                    'unit': topic.unit,
                    'verdict': topic.verdict,
                }
                for name, topic in self.topics.items()
            },
            'first difference': self.first,
            'reason': self.reason,
            'notes': self.notes,
        }

    def _commands(self) -> dict[int, Command]:
        """Return the commands that acted before samples, as far as the bag says."""
        for name, rows in self.recorded.rows.items():
            topic = self.recorded.topics[name]
            efforts = [k for k, q in enumerate(topic.quantities) if q.name.startswith('effort')]
            if topic.name == GROUND_TRUTH.name and efforts:
                told = zip(rows.numbers.tolist(), rows.values[:, efforts].tolist(), strict=True)
                # Insertion makes d smaller.
                return {n: Command(0, -d, torque) for n, (d, torque, *_) in told if not isnan(d)}
        return {}

    def _compute(self) -> dict[str, FloatArray]:
        """Return the numbers of each topic by number of the sample, nan where there are none."""
        recorded = self.recorded
        tip = recorded.constants.tip
        # A measurement of the tip leaves with a later sample.
        end = recorded.numbers[-1] + ceil(tip.delay * recorded.constants.own.rate)
        computed = {
            topic.name: np.full((end + 1, len(topic.quantities)), np.nan)
            for topic in recorded.topics.values()
        }
        plant = PlantRun(recorded.values)
        for number in range(1, end + 1):
            stamp = recorded.stamp(number)
            try:
                for event in recorded.events.get(number, ()):
                    plant = self._perform(plant, event, number)
                measured = plant.take(stamp, self._told.get(number))
            except NeedleError as error:
                self._halted = str(error)
                break
            for name, age, values in measured:
                computed[name][number - age] = values
            for command in recorded.commands.get(number, ()):
                plant.commands.offer(*command, now=stamp)
        return computed

    def _perform(self, plant: PlantRun, event: Event, number: int) -> PlantRun:
        """Do again what was done to the plant, and note it."""
        if event.kind in (CONFIGURED, TIME) and number == 1:
            return plant
        names = ', '.join(sorted(event.content))
        # A driver says where to go many times a second.
        if event.kind != MOTION or not self._driven:
            self.notes.append(_WORDS[event.kind].format(number=number, names=names))
        self._driven |= event.kind == MOTION
        if event.kind == CONFIGURED:
            return PlantRun(event.content, number - 1)
        plant.perform(event)
        return plant

    def _compare(self, name: str, computed: FloatArray, tolerance: float) -> Comparison:
        """Compare the messages of a topic with what was computed."""
        rows, quantities = self.recorded.rows[name], self.recorded.topics[name].quantities
        found = computed[rows.numbers]
        # An older plant did not publish some numbers.
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
        return Comparison(
            compared=len(part),
            differing=len(differing),
            largest=largest,
            difference=float(difference[row, column]),
            quantity=quantities[column].name if largest else '',
            unit=quantities[column].unit if largest else '',
            first=first,
        )

    def _limits(self, name: str, tolerance: float) -> FloatArray:
        """Return the largest difference allowed of each number of a topic."""
        topic, constants = self.recorded.topics[name], self.recorded.constants
        sizes = np.abs(self.recorded.rows[name].values)
        sizes = np.where(np.isfinite(sizes), sizes, 0.0).max(axis=0, initial=0.0)
        units = np.array([quantity.unit for quantity in topic.quantities])
        largest = np.array([sizes[units == unit].max() for unit in units])
        resolution = np.zeros(len(units))
        if topic.name == BASE_WRENCH.name:
            resolution[:] = constants.sensor.per_axis('resolution')
        elif topic.name == END_EFFECTOR_POSE.name:
            resolution[:3] = constants.indenter.encoder_resolution
        elif topic.name == JOINT_STATES.name and constants.mode == 'robot':
            resolution[0] = constants.base.encoder_resolution
        # A count is the difference of two rounded numbers.
        return np.asarray(tolerance * largest + (1.0 + 1e-6) * resolution)

    def _reason(self) -> str:
        """Say why the run may differ, as far as the bag tells."""
        recorded, start = self.recorded, self.recorded.numbers[0]
        simulated = recorded.constants.mode == 'simulation'
        differing = {name: topic.differing for name, topic in self.topics.items()}
        wrong = {recorded.topics[name].name for name, number in differing.items() if number}
        kinds = {event.kind for events in recorded.events.values() for event in events}
        reasons = {
            f'the computed plant stands still: {self._halted}': self._halted,
            f'{recorded.faults} altered what was measured': recorded.faults,
            'the rest is as computed: this one was altered on its way or in the bag': (
                sum(differing.values()) == 1
            ),
            'the bag holds no wrench_command and no joint_commands: record them with the rest': (
                self._untold and not recorded.commands
            ),
            'the bag holds no joint_trajectory: record it with the rest': (
                not simulated and not kinds & {MOTION, TRAJECTORY}
            ),
            f'the bag begins with sample {start}: the commands before it are not known': (
                simulated and start > 1
            ),
            'which command acted is not in the bag': self._untold,
            'the motion is as computed: the seed or the constants of a sensor were others': (
                len(wrong - {BASE_WRENCH.name, TIP_DEFLECTION.name}) == 0
                and len(differing) > len(wrong)
            ),
        }
        given = (words for words, holds in reasons.items() if holds)
        return next(given, 'the plant was of another version, or its parameters were others')


def verify(path: Path, tolerance: float = TOLERANCE) -> list[Rerun]:
    """
    Compute the runs in a bag again and compare.

    Parameters
    ----------
    path : Path
        The bag.
    tolerance : float
        Part of the largest value of a topic and unit that a difference may be.

    Returns
    -------
    list of Rerun
        One for each plant in the bag.

    Raises
    ------
    RecordingError
        If the bag is not readable, or lacks the parameters of a plant or all measurements.

    """
    return [Rerun(recorded, tolerance) for recorded in recorded_runs(path)]
