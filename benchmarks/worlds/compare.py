# SPDX-License-Identifier: Apache-2.0
"""
All steering laws in all scenarios, on the same needles, targets and noise.

Each target is where the needle of the scenario ends after random motions within the limits, so
that every target can be reached, and every stop is a false one.

    python -m benchmarks.worlds.compare --count 40 --jobs 2 -o worlds.json
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
import json
from math import nan
from pathlib import Path
import sys
from typing import cast, Final, NamedTuple

from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.worlds.scenarios import Case, SCENARIOS
from needle_controller.steering.law import build_law, SteeringFaultError
from needle_controller.steering.laws.multi_hypothesis import OutOfReachError
from needle_controller.steering.simulation import simulate_steering, SteeringPlant
from needle_dynamics import FloatArray
from needle_ros.errors import ParameterError
from needle_ros.process import cores
from needle_ros.process_pool import processes
import numpy as np

#: Laws by name.
LAWS: Final[Mapping[str, str]] = {
    'ours': 'multi_hypothesis',
    'springs': 'springs',
    'Broyden': 'broyden',
    'roll towards the target': 'roll_to_target',
    'open loop': 'open_loop',
}

#: Laws that turn the needle where its bevel steers it.
_ROLLED: Final = ('ours', 'roll towards the target')

#: Distance from the target that is a hit [m].
_HIT: Final = 1e-3

#: Largest ratio of our error to the least error of the other laws.
_RATIO: Final = 1.1


class ComparedInsertion(NamedTuple):
    """Result of an insertion; nan and None if it was stopped, or if the law has no such value."""

    miss: float = nan  #: distance of the tip from the target [m]
    travel: float = nan  #: travel of the guide [m]
    load: float = nan  #: largest lateral force on the guide [N]
    stopped: str = ''  #: why the law rejected the target or stopped
    warned: bool = False  #: whether the law warned
    forecast: bool | None = None  #: whether the interval before the last measurement held
    held: bool | None = None  #: whether the interval after the last measurement held
    chance: float = nan  #: stated probability of a hit, half of the way

    @property
    def hit(self) -> bool:
        """Whether the tip ended within 1 mm of the target."""
        return self.miss <= _HIT

    @property
    def silent(self) -> bool:
        """Whether the tip ended beyond 1 mm without a warning."""
        return self.miss > _HIT and not self.warned


def insert(name: str, laws: Sequence[str], seed: int) -> dict[str, ComparedInsertion]:
    """Insert the needle of a seed in a scenario under each law."""
    case = Case(name, seed)
    bent = bool(case.scenario.curvature)
    return {law: _insert(case, law) for law in laws if bent or law != 'roll towards the target'}


def _insert(case: Case, name: str) -> ComparedInsertion:
    rolled = bool(case.scenario.curvature) and name in _ROLLED
    limits = case.limits(roll=rolled)
    try:
        law = build_law(LAWS[name], case.model(), case.target, limits)
    except OutOfReachError as error:
        return ComparedInsertion(stopped=f'rejected: {error}')
    world, chance = case.world(), nan
    forecast: bool | None = None

    def watch(plant: SteeringPlant) -> None:
        nonlocal chance, forecast
        if plant.step == case.steps // 2:
            chance = law.status().get('hit_probability', nan)
        if plant.done and (expected := law.expected()) is not None:
            forecast = expected.contains(plant.tip)

    try:
        run = simulate_steering(law, cast(SteeringPlant, world), case.sensor(), watch, limits)
    except (SteeringFaultError, ArithmeticError) as error:
        # Including a rod that the guide bends so far that its shape cannot be computed.
        return ComparedInsertion(stopped=str(error), chance=chance)
    expected = law.expected()
    return ComparedInsertion(
        miss=float(np.hypot(*(world.tip - case.target))),
        travel=run.travel,
        load=run.load,
        warned=bool(run.warning),
        forecast=forecast,
        held=None if expected is None else expected.contains(world.tip),
        chance=chance,
    )


class Summary(NamedTuple):
    """Statistics of a law in a scenario; nan without a value."""

    mean: float  #: mean distance from the target of the insertions that ended [mm]
    most: float  #: 95 % quantile of it [mm]
    hit: float  #: insertions that ended within 1 mm [%]
    stopped: float  #: insertions that were rejected or stopped [%]
    silent: float  #: insertions that ended beyond 1 mm without a warning [%]
    forecast: float  #: 95 % intervals before the last measurement that contain the tip [%]
    held: float  #: 95 % intervals after it that contain the tip [%]
    chance: float  #: mean stated probability of a hit, half of the way [%]
    hits: float  #: hits of the insertions with a stated probability [%]
    travel: float  #: mean travel of the guide [mm]
    load: float  #: mean of the largest lateral load on the guide [N]

    @classmethod
    def of(cls, found: Sequence[ComparedInsertion]) -> Summary:
        """Summarize insertions."""
        ended = [one for one in found if not one.stopped]
        stated = [one for one in found if np.isfinite(one.chance)]
        miss = 1e3 * np.array([one.miss for one in ended])
        return cls(
            mean=_mean(miss),
            most=float(np.quantile(miss, 0.95)) if ended else nan,
            hit=100.0 * _mean([one.hit for one in found]),
            stopped=100.0 * _mean([bool(one.stopped) for one in found]),
            silent=100.0 * _mean([one.silent for one in found]),
            forecast=100.0 * _mean([one.forecast for one in ended if one.forecast is not None]),
            held=100.0 * _mean([one.held for one in ended if one.held is not None]),
            chance=100.0 * _mean([one.chance for one in stated]),
            hits=100.0 * _mean([one.hit for one in stated]),
            travel=1e3 * _mean([one.travel for one in ended]),
            load=_mean([one.load for one in ended]),
        )


def _mean(values: Sequence[float] | FloatArray) -> float:
    return float(np.mean(values)) if len(values) else nan


#: Table of summaries by scenario and law.
Table = dict[str, dict[str, Summary]]


def measure(
    worlds: Sequence[str], laws: Sequence[str], count: int, jobs: int, tick: Tick
) -> Table:
    """Insert the needles of seeds 0 to ``count`` - 1 in each scenario under each law."""
    for names, known in ((worlds, tuple(SCENARIOS)), (laws, tuple(LAWS))):
        for name in names:
            if name not in known:
                raise ParameterError(f'must be one of {", ".join(known)}, got {name!r}')
    if count < 1:
        raise ParameterError(f'count must be at least 1, got {count}')
    found: Table = {}
    with processes(jobs) as pool:
        for world in worlds:
            tick(world)
            results = list(pool.map(partial(insert, world, laws), range(count)))
            found[world] = {law: Summary.of([one[law] for one in results]) for law in results[0]}
    return found


_HEADS: Final = (
    'world', 'law', 'mean [mm]', '95 % [mm]', 'within 1 mm', 'stopped', 'missed, not warned',
    'forecast holds', 'end holds', 'stated chance', 'hits', 'travel [mm]', 'load [N]',
)  # fmt: skip


def section(table: Table, count: int) -> PageSection:
    """Return the table as a section of a page."""
    rows = []
    for world, laws in table.items():
        for law, one in laws.items():
            figures = [f'{one.mean:.2f}', f'{one.most:.2f}', *map(_percent, one[2:9])]
            rows.append((world, law, *figures, f'{one.travel:.0f}', f'{one.load:.1f}'))
    cells = [tuple('' if cell.startswith('nan') else cell for cell in row) for row in rows]
    return PageSection(
        'Worlds that differ from the model',
        _HEADS,
        cells,
        f'{count} needles in each world, with the same seeds for all laws. Each target is where '
        'the needle ends after random motions within the limits, so that all of them can be '
        'reached. The limits are the defaults of the node. Mean, 95 %, travel and load are of the '
        'insertions that ended. The chance of a hit is stated half of the way.',
    )


def _percent(value: float) -> str:
    return f'{value:.0f} %'


def bars(table: Table) -> list[Bar]:
    """Return the bars of our law against the least errors of the other laws."""
    found = []
    for world, laws in table.items():
        if 'ours' not in laws:
            continue
        ours, others = laws['ours'], [one for law, one in laws.items() if law != 'ours']
        if others:
            for what in ('mean', 'most'):
                least = min(getattr(one, what) for one in others)
                name = f'{world}: {"95 %" if what == "most" else what} over the best other law'
                found.append(Bar(name, getattr(ours, what) / least, _RATIO))
        found.append(Bar(f'{world}: stopped', ours.stopped, 1.0, '%'))
        found.append(Bar(f'{world}: missed by more than 1 mm, not warned', ours.silent, 1.0, '%'))
        found.append(Bar(f'{world}: intervals that hold', ours.forecast, 90.0, '%', at_least=True))
        off = abs(ours.chance - ours.hits)
        found.append(Bar(f'{world}: stated chance, distance from the hits', off, 5.0, '%'))
    return found


def compare(tick: Tick, needles: int = 200) -> Answer:
    """Compare the laws in all scenarios, as a part of ``needle bench steering``."""
    count = min(needles, 200)
    table = measure(list(SCENARIOS), list(LAWS), count, cores(), tick)
    return [section(table, count)], bars(table)


def main(words: Sequence[str] | None = None) -> None:
    """Print the table, and write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--count', type=int, default=40, help='targets in each world')
    parser.add_argument('--worlds', nargs='+', default=list(SCENARIOS), metavar='WORLD')
    parser.add_argument('--laws', nargs='+', default=list(LAWS), metavar='LAW')
    parser.add_argument('--jobs', type=int, default=cores(), help='processes')
    parser.add_argument('-o', '--output', type=Path, metavar='FILE', help='write JSON, too')
    options = parser.parse_args(words)
    table = measure(
        options.worlds,
        options.laws,
        options.count,
        options.jobs,
        lambda stage: print(stage, file=sys.stderr, flush=True),  # noqa: T201
    )
    print(section(table, options.count))  # noqa: T201
    if options.output is not None:
        rows = {
            world: {law: one._asdict() for law, one in laws.items()}
            for world, laws in table.items()
        }
        text = json.dumps({'count': options.count, 'worlds': rows}, indent=1)
        options.output.write_text(text + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
