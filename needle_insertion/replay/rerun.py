"""
A recorded run again: the plant made anew, given what was commanded, compared sample by sample.

A bag does not say between which two samples a message was taken, only when it reached the
recorder. So what is likely is tried first, and where it does not give the next sample, its
neighbors: the one that does is what happened.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, is_dataclass, replace
from math import ceil, inf, isfinite
from typing import Any, Final, NamedTuple

from needle_dynamics import ForceSensor, NeedleError, NeedleModel, ParameterError
from needle_dynamics.arrays import FloatArray
from needle_dynamics.simulated.indenter import Indenter, Press
from needle_dynamics.simulated.plant import Plant, Sample, TipReading
from needle_insertion.replay.recorded_run import (
    Command,
    Entry,
    Event,
    plant_from,
    Quantity,
    RecordedRun,
    settings,
    Values,
)
from needle_ros.timing import NANOSECONDS, seconds
import numpy as np

#: Samples in a row that differ before it is given up to look for what would explain them.
_BROKEN: Final = 3

#: Samples that show by their noise which ones they are, and how far they are looked for.
_FINGERPRINT: Final = 20
_FARTHEST: Final = 2**17

#: How far from where it was recorded a message may have been taken, by the recorder's clock [s]:
#: first, and if that does not do; and the most samples.
_NEAR: Final = 0.02
_FAR: Final = 0.25
_MOST: Final = 300

#: Stands for the command that joint_states shows.
_TOLD: Final = -2

#: Commands that are tried beyond those that their stamps allow: a plant that makes up for a stall
#: takes many samples under a command of after them.
_AHEAD: Final = 100

#: Samples back at which a tare is tried: it shows as soon as a reading is rounded otherwise.
_BACK: Final = 5

#: A gap longer than this is first taken for time that stood still, not for lost messages [s].
_STOOD_STILL: Final = 2.0


@dataclass(slots=True)
class Tally:
    """
    What the comparison of a topic has given.

    Attributes
    ----------
    compared : int
        Messages compared.
    differing : int
        Those beyond the tolerance.
    worst : float
        Largest difference over its tolerance, and which it is: quantity and difference.
    first : dict or None
        First difference beyond the tolerance.

    """

    compared: int = 0
    differing: int = 0
    worst: float = 0.0
    what: tuple[Quantity, float] | None = None
    first: dict[str, Any] | None = None

    @property
    def verdict(self) -> str:
        """Identical, within tolerance or diverges."""
        if self.differing:
            return 'diverges'
        return 'within tolerance' if self.worst else 'identical'


@dataclass(slots=True)
class _State:
    """The plant after a sample, the command that acts, and how many samples late they are."""

    plant: Plant | Indenter
    current: int = -1
    lag: int = 1

    def copy(self) -> _State:
        """Return a copy; constants, most of what a plant holds, are shared."""
        shared = {id(constant): constant for constant in _constants(self.plant)}
        return _State(deepcopy(self.plant, shared), self.current, self.lag)


def _constants(thing: object) -> Iterator[object]:
    """Yield models and frozen values that a thing holds."""
    for value in vars(thing).values():
        frozen = is_dataclass(value) and value.__dataclass_params__.frozen  # type: ignore[union-attr]
        if frozen or isinstance(value, NeedleModel):
            yield value
        elif hasattr(value, '__dict__'):
            yield from _constants(value)


@dataclass(slots=True)
class _Run:
    """A plant on its way through the samples, and what was found so far."""

    state: _State
    tallies: dict[str, Tally]
    notes: list[str] = field(default_factory=list)
    #: How many commands acted so many samples after the one they answer, None: never.
    delays: Counter[int | None] = field(default_factory=Counter)
    #: States before the latest samples, and the commands taken then.
    before: list[tuple[int, _State, list[int]]] = field(default_factory=list)
    #: Intervals under a command that is not in the bag.
    told: int = 0
    differing: int = 0
    exact: bool = True
    halted: str = ''

    def branch(self) -> _Run:
        """Return a copy that can go another way."""
        return _Run(
            self.state.copy(), deepcopy(self.tallies), list(self.notes), Counter(self.delays),
            # These are never changed.
            list(self.before), self.told, self.differing, self.exact, self.halted,
        )  # fmt: skip

    @property
    def is_broken(self) -> bool:
        """True if it no longer is the recorded run."""
        return bool(self.halted) or self.differing >= _BROKEN


class Rerun:
    """
    A recorded run, computed anew.

    Parameters
    ----------
    recorded : RecordedRun
        The run.
    tolerance : float
        Part of the largest value of a kind that a difference may be.

    Attributes
    ----------
    start : int
        Number of the first sample recorded since the activation, counted from 1.
    tallies : dict
        What the comparison of each topic has given.
    first : dict or None
        First difference beyond the tolerance.
    reason : str
        Why it may be there.
    notes : list of str
        What was found on the way.

    """

    def __init__(self, recorded: RecordedRun, tolerance: float) -> None:
        self._recorded = recorded
        self._limits = recorded.limits(tolerance)
        self._stamps = [command.stamp for command in recorded.commands]
        self._recognized = False
        self.start = self._find_start()
        # What was taken before the recording began has no messages.
        begin = recorded.entries[0].stamp
        lead = [Entry(begin - round(k * recorded.period)) for k in range(self.start - 1, 0, -1)]
        self._entries = lead + recorded.entries
        run = self._go([replace(event, near=event.near + len(lead)) for event in recorded.events])
        self.tallies = run.tallies
        found = [tally.first for tally in run.tallies.values() if tally.first is not None]
        self.first = min(found, key=lambda at: int(at['stamp']), default=None)
        self.notes = self._notes(run)
        self.reason = '' if self.first is None else self._reason(run, self.first)

    def _find_start(self) -> int:
        """Find by its noise which sample since the activation is the first one recorded."""
        recorded = self._recorded
        topic = next(name for name, kind in recorded.topics.items() if kind == 'base_wrench')
        found = recorded.rows[topic][:_FINGERPRINT]
        if not found:
            self._recognized = True
            return 1
        # Directions in which nothing pushes: noise, drift and bias only.
        idle = [1, 3, 4, 5] if recorded.mode == 'indenter' else [0, 4, 5]
        begin = recorded.entries[0].stamp
        offsets = [round((stamp - begin) / recorded.period) for stamp, _ in found]
        seen = np.array([values for _, values in found])[:, idle]
        limit = np.array(self._limits[topic])[idle]
        values = recorded.values
        sensor = ForceSensor(settings('sensor.', values), recorded.rate, values['seed'])
        still = np.zeros(6)
        noise: list[FloatArray] = []
        for k in range(_FARTHEST):
            while len(noise) <= k + offsets[-1]:
                noise.append(sensor.measure(still)[idle])
            if (np.abs(noise[k + offsets[0]] - seen[0]) <= limit).all():
                alike = np.array([noise[k + offset] for offset in offsets])
                if (np.abs(alike - seen) <= limit).all():
                    self._recognized = True
                    return k + 1
        return 1

    # The run.

    def _go(self, events: Sequence[Event]) -> _Run:
        """Compute the run, with what happened where it fits best."""
        recorded = self._recorded
        state = _State(plant_from(recorded.values))
        run = _Run(state, {topic: Tally() for topic, found in recorded.rows.items() if found})
        at, ends = 0, [*(event.near - self._width(_NEAR) for event in events[1:]), inf]
        for event, end in zip(events, ends, strict=False):
            run, at = self._place(run, at, event, int(min(end, len(self._entries))))
        self._proceed(run, at, len(self._entries), patient=True)
        return run

    def _width(self, reach: float) -> int:
        """Return the number of samples in a time of the recorder [s]."""
        factor = float(self._recorded.values.get('real_time_factor', 1.0))
        if factor == 0.0 or self._recorded.values.get('lockstep'):
            return _MOST
        return min(ceil(reach * self._recorded.rate * factor) + 2, _MOST)

    def _place(self, run: _Run, at: int, event: Event, end: int) -> tuple[_Run, int]:
        """Find the sample before which an event took place, judged by what comes up to an end."""
        if run.is_broken:
            self._proceed(run, at, event.near, patient=True)
            self._apply(run, event, event.near)
            return run, max(at, event.near)
        best: tuple[tuple[float, ...], _Run, int] | None = None
        for reach in (_NEAR, _FAR):
            first = max(at, event.near - self._width(reach))
            last = min(event.near + self._width(reach), len(self._entries))
            trunk, places = run.branch(), {}
            for k in range(at, last + 1):
                if k >= first:
                    places[k] = trunk.branch()
                # Without the event the run may go no further.
                if k == last or self._proceed(trunk, k, k + 1) <= k or trunk.is_broken:
                    break
            for k in sorted(places, key=lambda k: (abs(k - event.near), k)):
                branch = places[k]
                self._apply(branch, event, k)
                reached = self._proceed(branch, k, max(k, end))
                differing = sum(tally.differing for tally in branch.tallies.values())
                worst = max((tally.worst for tally in branch.tallies.values()), default=0.0)
                score = (-reached if branch.is_broken else -inf, differing, worst)
                if best is None or score < best[0]:
                    best = score, branch, reached
                if not (branch.is_broken or differing or worst):
                    return branch, reached
            if best is not None and not best[1].is_broken:
                break
        return (run, at) if best is None else best[1:]

    def _apply(self, run: _Run, event: Event, at: int) -> None:
        """Let the plant take a trajectory or parameters."""
        plant = run.state.plant
        number = at + 1
        if event.kind == 'joint_trajectory':
            points = event.content.points
            try:
                plant.follow(
                    event.content.joint_names,
                    # As the node has it, to the last bit.
                    [seconds(point.time_from_start) for point in points],
                    [point.positions.tolist() for point in points],
                    [point.effort.tolist() for point in points],
                )
            except ParameterError as error:
                run.notes.append(f'joint_trajectory before sample {number} refused: {error}')
            else:
                run.notes.append(f'joint_trajectory from sample {number} on')
            return
        old, new = event.content
        changed = (name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
        relevant = sorted(name for name in changed if not name.startswith('fault.'))
        run.notes.append(f'{", ".join(relevant)} changed before sample {number}')
        if isinstance(plant, Plant) and all(name.startswith('model.') for name in relevant):
            plant.integrator.change(settings('model.', new))
        else:
            run.state = _State(plant_from(new))

    def _proceed(self, run: _Run, begin: int, end: int, *, patient: bool = False) -> int:
        """Take the samples up to an end, or as far as it is the recorded run; return how far."""
        for k in range(begin, end):
            if run.halted or (run.is_broken and not patient):
                return k
            if self._step(run, k) > 1.0:
                run.differing += 1
            elif self._entries[k].rows and not run.is_broken:
                run.differing = 0
        return max(begin, end)

    def _step(self, run: _Run, k: int) -> float:
        """Take a sample, as it most likely was; return its largest difference over tolerance."""
        watched = bool(self._entries[k].rows) and not run.is_broken
        before = run.state.copy() if watched else run.state
        newest = run.state.current
        best = self._tried(k, _Other(run.state, self._due(run.state, k, run.state.lag)))
        if best.halted:
            run.halted = best.halted
            return self._stand_still(run, k)
        if watched and (best.error > 1.0 or (best.error > 0.0 and run.exact)):
            for other in self._alternatives(run, before, k):
                found = self._tried(k, other)
                # What is only less wrong explains nothing.
                if found.error <= 1.0 and found.error < best.error:
                    best = found
                if best.error == 0.0:
                    break
        if watched:
            run.before = [*run.before[1 - _BACK :], (k, before, best.takes)]
            run.exact &= best.error == 0.0
        run.state = best.state
        if best.note:
            run.notes.append(best.note)
        self._follow_commands(run, newest, best.takes, k)
        self._enter(run, k, best.seen)
        return best.error

    def _tried(self, k: int, other: _Other) -> _Other:
        """Take a sample one way, and say how far it is off."""
        try:
            other.seen = self._advance(other.state, other.takes, k)
            other.error = self._error(k, other.seen)
        except NeedleError as error:
            other.error, other.halted = inf, str(error)
        return other

    def _alternatives(self, run: _Run, before: _State, k: int) -> Iterator[_Other]:
        """Yield other ways in which a sample may have come about, the likely ones first."""
        gap = self._entries[k].gap
        tried = [self._due(before, k, before.lag)]

        def fresh(takes: list[int]) -> bool:
            if takes in tried:
                return False
            tried.append(takes)
            return True

        if self._recorded.mode == 'simulation':
            ways = [self._due(before, k, lag) for lag in (1, 0, 2, 3)]
            held, last = before.current, len(self._stamps) - 1
            newest = bisect_right(self._stamps, self._entries[k].stamp) - 1
            newest = min(max(newest, held + _AHEAD), last)
            ways += [[held] * n + ways[0][n:] for n in range(1, gap + 1)]
            ways += [[held] * (gap - 1) + [c] for c in range(held + 1, newest + 1)][-_MOST:]
            ways.append([-1] * gap)
            if self._told(k):
                ways += [[held] * n + [_TOLD] * (gap - n) for n in range(min(gap, _MOST))]
            for takes in filter(fresh, ways):
                yield _Other(before.copy(), takes)
        if gap > 1:
            # Time stood still for the plant: it took one sample.
            takes = self._due(before, k, before.lag)[-1:]
            note = f'no samples were taken for {gap - 1} periods before sample {k + 1}'
            yield _Other(before.copy(), takes, note)
        behind = [*run.before, (k, before, tried[0])]
        for back in range(1, min(_BACK, len(behind)) + 1):
            j, state, _ = behind[-back]
            state = state.copy()
            try:
                state.plant.tare()
                for i, _, takes in behind[-back:-1]:
                    self._advance(state, takes, i)
            except NeedleError:
                continue
            yield _Other(state, tried[0], f'the sensor was zeroed (~/tare) before sample {j + 1}')
        note = f'the plant was put back (~/reset) before sample {k + 1}'
        yield _Other(_State(plant_from(self._recorded.values), before.current), [-1], note)

    def _due(self, state: _State, k: int, lag: int) -> list[int]:
        """Return the commands that act over the intervals before a sample if each is so late."""
        entry = self._entries[k]
        takes, newest = [], state.current
        for i in range(entry.gap, 0, -1):
            tick = entry.stamp - i * self._recorded.period
            newest = max(
                newest, bisect_right(self._stamps, tick - (lag - 0.5) * self._recorded.period) - 1
            )
            age = tick - self._stamps[newest] if newest >= 0 else inf
            # Half a period: stamps are rounded.
            late = age > self._recorded.timeout + 0.5 * self._recorded.period
            takes.append(-1 if late else newest)
        return takes

    def _command(self, take: int, k: int) -> Command:
        if take == _TOLD:
            return self._told(k) or Command(0)
        return self._recorded.commands[take] if take >= 0 else Command(0)

    def _told(self, k: int) -> Command | None:
        """Return the forces that acted before a sample by its joint_states, if it has them."""
        for topic, rows in self._entries[k].rows.items():
            if self._recorded.topics[topic] == 'joint_states':
                *_, force, torque = rows[0]
                return Command(0, force, torque)
        return None

    def _advance(self, state: _State, takes: Sequence[int], k: int) -> _Seen:
        """Let the plant take a sample, over as many intervals as there are commands."""
        plant = state.plant
        for take in takes:
            state.current = max(state.current, take)
            command = self._command(take, k)
            if isinstance(plant, Plant):
                sample: Sample | Press = plant.advance(command.force, command.torque)
            else:
                sample = plant.advance()
        return _Seen(_shown(sample, command.torque), getattr(sample, 'tip', None))

    def _pairs(self, k: int, seen: _Seen) -> Iterator[tuple[str, int, list[float], list[Values]]]:
        """Yield topic, stamp, what was computed, and what was recorded, of a sample."""
        entry = self._entries[k]
        for topic, kind in self._recorded.topics.items():
            if kind != 'tip_deflection' and topic in entry.rows:
                yield topic, entry.stamp, seen.values[kind], entry.rows[topic]
            elif kind == 'tip_deflection' and seen.tip is not None:
                stamp = entry.stamp - round(seen.tip.age / self._recorded.rate * NANOSECONDS)
                if stamp in self._recorded.tips:
                    computed = [seen.tip.depth, seen.tip.deflection]
                    yield topic, stamp, computed, self._recorded.tips[stamp]

    def _error(self, k: int, seen: _Seen) -> float:
        """Return the largest difference of a sample over its tolerance."""
        return max(
            (
                _over(abs(value - recorded), limit)
                for topic, _, computed, rows in self._pairs(k, seen)
                for row in rows
                for value, recorded, limit in zip(computed, row, self._limits[topic], strict=True)
            ),
            default=0.0,
        )

    def _enter(self, run: _Run, k: int, seen: _Seen) -> None:
        """Enter the differences of a sample."""
        for topic, stamp, computed, rows in self._pairs(k, seen):
            tally = run.tallies[topic]
            quantities = self._recorded.quantities[topic]
            for row in rows:
                tally.compared += 1
                errors = [
                    _over(abs(value - recorded), limit)
                    for value, recorded, limit in zip(
                        computed, row, self._limits[topic], strict=True
                    )
                ]
                n = int(np.argmax(errors))
                if errors[n] > tally.worst:
                    tally.worst = errors[n]
                    tally.what = quantities[n], abs(computed[n] - row[n])
                if errors[n] > 1.0:
                    tally.differing += 1
                    tally.first = tally.first or {
                        'stamp': stamp,
                        'sample': k + 1,
                        'topic': topic,
                        'quantity': quantities[n].name,
                        'unit': quantities[n].unit,
                        'recorded': row[n],
                        'computed': computed[n],
                    }

    def _stand_still(self, run: _Run, k: int) -> float:
        """Enter that the plant gives no more samples, though some are recorded."""
        for topic, rows in self._entries[k].rows.items():
            run.tallies[topic].differing += len(rows)
            run.tallies[topic].first = run.tallies[topic].first or {
                'stamp': self._entries[k].stamp,
                'sample': k + 1,
                'topic': topic,
                'quantity': 'sample',
                'unit': '',
                'recorded': 'one',
                'computed': 'none',
            }
        return inf

    def _follow_commands(self, run: _Run, newest: int, takes: Sequence[int], k: int) -> None:
        """Count how late the commands act that are new."""
        run.told += takes.count(_TOLD)
        for i, take in enumerate(takes):
            if take <= newest:
                continue
            tick = self._entries[k].stamp - (len(takes) - i) * self._recorded.period
            late = round((tick - self._recorded.commands[take].stamp) / self._recorded.period)
            run.delays[late] += 1
            run.delays[None] += take - newest - 1
            run.state.lag = max(0, late)
            newest = take

    # What it means.

    def _notes(self, run: _Run) -> list[str]:
        """Say what was found on the way."""
        recorded = self._recorded
        notes = [*recorded.losses, *run.notes]
        if recorded.missing:
            notes.append(f'not in the bag: {", ".join(recorded.missing)}')
        if recorded.foreign:
            notes.append(f'recorded by another version: {", ".join(recorded.foreign)}')
        never = run.delays.pop(None, 0)
        usual = run.delays.pop(1, 0)
        if never or run.delays:
            most = max((abs(periods or 0) for periods in run.delays), default=1)
            notes.append(
                f'{usual} commands acted one period after the sample they answer, '
                f'{run.delays.total()} sooner or later (up to {most} periods), {never} never'
            )
        if run.told:
            notes.append(
                f'{run.told} samples are under a force that no command in the bag asks for; '
                'joint_states shows it'
            )
        return notes

    def _reason(self, run: _Run, first: Mapping[str, Any]) -> str:
        """Say why the run may differ, as far as the bag tells."""
        recorded = self._recorded
        simulated = recorded.mode == 'simulation'
        differing = {name: tally.differing for name, tally in run.tallies.items()}
        wrong = {recorded.topics[name] for name, number in differing.items() if number}
        gap = self._entries[int(first['sample']) - 1].gap
        reasons = {
            f'the computed plant stands still: {run.halted}': run.halted,
            f'{recorded.faults} altered what was measured': recorded.faults,
            'the rest is as computed: this one was altered on its way or in the bag': (
                sum(differing.values()) == 1
            ),
            'the bag holds no wrench_command: record it with the rest': (
                simulated and not recorded.commands
            ),
            'the bag holds no joint_trajectory: record it with the rest': (
                not simulated and not recorded.events
            ),
            f'the bag begins with sample {self.start}: what came before it is not known': (
                self.start > 1
            ),
            'it was recorded by another version, see above': recorded.foreign,
            f'the noise is not that of seed {recorded.values["seed"]}: the sensor was zeroed '
            'before the recording, or its constants were others': not self._recognized,
            f'{gap - 1} samples before it are not in the bag': gap > 1,
            'the motion is as computed: only the sensor differs': (
                wrong == {'base_wrench'} and len(differing) > 1
            ),
            'no command in the bag says so: it was lost on the way to the recorder': (
                simulated and first['quantity'].startswith('effort')
            ),
        }
        given = (words for words, holds in reasons.items() if holds)
        return next(given, 'the plant was of another version, or its parameters were others')


class _Seen(NamedTuple):
    """What a plant shows: numbers by output, and what leaves the sensor of the tip."""

    values: dict[str, list[float]]
    tip: TipReading | None


@dataclass(slots=True)
class _Other:
    """A way to a sample: the state before it, the commands that act, what else; and its result."""

    state: _State
    takes: list[int]
    note: str = ''
    seen: _Seen = field(default_factory=lambda: _Seen({}, None))
    error: float = 0.0
    halted: str = ''


def _shown(sample: Sample | Press, torque: float) -> dict[str, list[float]]:
    """Return the numbers of a sample as the node publishes them."""
    wrench = sample.wrench.tolist()
    if isinstance(sample, Press):
        return {'base_wrench': wrench, 'end_effector_pose': sample.position.tolist()}
    state = sample.state.tolist()
    middle = len(state) // 2
    return {
        'joint_states': [
            sample.joint_position, state[1], sample.speed, state[middle + 1], sample.force, torque,
        ],
        'base_wrench': wrench,
        'ground_truth': state,
    }  # fmt: skip


def _over(difference: float, limit: float) -> float:
    """Return a difference over its limit, infinite where one is not a number."""
    if difference == 0.0:
        return 0.0
    return difference / limit if limit > 0.0 and isfinite(difference) else inf
