# SPDX-License-Identifier: Apache-2.0
"""
Control laws on needles, robots and tissues with unknown parameters.

Each law uses the nominal model `phantom` without a carriage. A cell of the study has its own
delay, carriage and width of the uniform distributions of mu_s, mu_v and k_a, and a situation: an
insertion, a reversal, a membrane puncture, tissue with increasing friction. All laws are tested on
the same needles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_controller import (
    Adaptive,
    AdaptiveGains,
    Axis,
    InverseDynamics,
    InverseDynamicsGains,
    Law,
    LoopBatch,
    MinimumJerk,
    Pid,
    PidGains,
    Reference,
    ReferenceLimits,
    run_batch,
    Setpoint,
)
from needle_controller.reference.path import Trapezoid
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters, ParameterError
import numpy as np

PERIOD: Final = 1e-3
_LIMIT: Final = 15.0
_PRESET: Final = 'phantom'
_DEFLECTION: Final = 5e-4

#: Time after the end of the reference [s], and its last part, in which a needle must rest.
_REST: Final = 2.0
_END: Final = 0.5

_DELAYS: Final = (0, 1, 2)
_CARRIAGES: Final = (0.0, 0.5, 2.0)
_WIDTHS: Final = (0.3, 0.5)

#: Smallest final motion with reversals that is a limit cycle [m], and smallest error that is
#: unstable [m].
_CYCLE: Final = 1e-5
_LOST: Final = 5e-3

#: Bars: median and 95 % of the final error at 30 % [um], and the overshoot at a drop of 3 N [mm].
_MEDIAN: Final = 5.0
_MOST: Final = 20.0
_OVERSHOOT: Final = 0.3


class _ThereAndBack(Reference):
    """Reference to a target and from there to a second target."""

    def __init__(self, there: MinimumJerk, back: MinimumJerk) -> None:
        self.there, self.back = there, back
        self.duration = there.duration + back.duration

    def at(self, time: float) -> Setpoint:
        first = self.there.duration
        return self.there.at(time) if time < first else self.back.at(time - first)


@dataclass(frozen=True)
class Situation:
    """
    Motion and disturbance of the needle.

    Attributes
    ----------
    name : str
        Name.
    start : float
        Initial insertion depth [m].
    reference : Reference
        Motion.
    duration : float
        Duration of the motion [s].
    added : sequence of tuple
        Additional friction by depth; see `run_batch`.

    """

    name: str
    start: float
    reference: Reference
    duration: float
    added: Sequence[tuple[float, float, float]] = ()


def _moved(start: float, target: float) -> MinimumJerk:
    return MinimumJerk(Setpoint(start), target, ReferenceLimits())


def situations() -> list[Situation]:
    """Return the situations: motions of at most 2 cm and less than 6 s."""
    into = _moved(0.02, 0.04)
    turn = _ThereAndBack(_moved(0.04, 0.05), _moved(0.05, 0.042))
    steady = Trapezoid(Setpoint(0.02), 0.04, ReferenceLimits())
    return [
        Situation('insertion', 0.02, into, into.duration),
        Situation('reversal', 0.04, turn, turn.duration),
        Situation(
            'puncture, 3 N', 0.02, steady, steady.duration, [(0.028, 3.0, 0.0), (0.03, 0.0, 0.0)]
        ),
        Situation(
            'layers',
            0.02,
            into,
            into.duration,
            [(0.025, 0.2, 0.0), (0.03, 0.5, 100.0), (0.035, 1.0, 200.0)],
        ),
    ]


def laws() -> dict[str, Law]:
    """Return the laws by name, the default first, with default gains unless in the name."""
    axis = Axis.insertion(NeedleParameters.preset(_PRESET))

    def inverse(bandwidth: float) -> InverseDynamics:
        gains = replace(InverseDynamicsGains(), bandwidth=bandwidth)
        return InverseDynamics(axis=axis, gains=gains, period=PERIOD)

    return {
        'adaptive': Adaptive(axis=axis, gains=AdaptiveGains(), period=PERIOD),
        'inverse dynamics': inverse(InverseDynamicsGains().bandwidth),
        'PID, feed-forward': Pid(axis=axis, gains=PidGains(feed_forward=True), period=PERIOD),
        'PID': Pid(axis=axis, gains=PidGains(), period=PERIOD),
        'inverse dynamics of the paper': inverse(0.0),
        'PID of the paper': Pid(axis=axis, gains=PidGains(ki=0.0), period=PERIOD),
    }


@dataclass(frozen=True)
class LawCell:
    """
    Results of a law in one cell.

    Attributes
    ----------
    final, rms : ndarray, shape (needles,)
        Modulus of the final error, and rms error [m].
    beyond : ndarray, shape (needles,)
        Largest overshoot over the reference [m].
    cycles, lost : int
        Number of needles with a limit cycle, and with an error above 5 mm.

    """

    final: FloatArray
    rms: FloatArray
    beyond: FloatArray
    cycles: int
    lost: int

    @classmethod
    def of(cls, batch: LoopBatch, goal: FloatArray) -> LawCell:
        """Evaluate runs for a reference (k + 1,) [m]."""
        lost = (batch.completed < len(goal) - 1) | (batch.largest > _LOST)
        end = batch.depths[:, -round(_END / PERIOD) :]
        steps = np.sign(np.diff(end, axis=1))
        turns = np.array([np.count_nonzero(np.diff(row[row != 0.0])) for row in steps])
        cycles = ~lost & (np.ptp(end, axis=1) > _CYCLE) & (turns > 1)
        return cls(
            final=np.abs(batch.final),
            rms=batch.rms,
            beyond=np.nanmax(batch.depths - goal, axis=1),
            cycles=int(cycles.sum()),
            lost=int(lost.sum()),
        )

    def __str__(self) -> str:
        """Return rms, median and 95 % of the final error [um], or the number of limit cycles."""
        if self.lost or self.cycles:
            words = [(self.lost, 'lost'), (self.cycles, 'cycle')]
            return '**' + ', '.join(f'{count} {word}' for count, word in words if count) + '**'
        final = 1e6 * np.quantile(self.final, (0.5, 0.95))
        return f'{1e6 * np.median(self.rms):.0f}; {final[0]:.0f} / {final[1]:.0f}'


def study(
    situation: Situation, law: Law, width: float, delay: int, carriage: float, needles: int
) -> LawCell:
    """
    Run one law in one cell.

    `width` is the largest relative deviation of mu_s, mu_v and k_a, `delay` the periods from
    measurement to effect, and `carriage` a mass unknown to the law [kg].
    """
    nominal = NeedleParameters.preset(_PRESET)
    factors = np.random.default_rng(2014).uniform(1.0 - width, 1.0 + width, (needles, 3))
    # The corners first, which often contain the worst case.
    corners = 1.0 + width * np.array(np.meshgrid(*3 * [(-1.0, 1.0)])).reshape(3, -1).T
    factors[: len(corners)] = corners[:needles]
    plants = [
        replace(
            nominal,
            coulomb_friction=float(dry * nominal.coulomb_friction),
            viscous_friction=float(viscous * nominal.viscous_friction),
            tissue_stiffness=float(stiff * nominal.tissue_stiffness),
            carriage_mass=carriage,
        )
        for dry, viscous, stiff in factors
    ]
    duration = situation.duration + _REST
    batch = run_batch(
        law,
        plants,
        NeedleModel(nominal).state_at(situation.start, _DEFLECTION),
        situation.reference,
        delay=delay,
        limit=_LIMIT,
        duration=duration,
        added=situation.added,
        step=PERIOD,
        keep=True,
    )
    goal = np.array(
        [situation.reference.at(k * PERIOD).position for k in range(batch.depths.shape[1])]
    )
    return LawCell.of(batch, goal)


def compare(tick: Tick, needles: int = 1000) -> Answer:
    """Run all laws in all cells, with a number of needles per cell."""
    if needles < 1:
        raise ParameterError(f'needles must be at least 1, got {needles!r}')
    grid = [(delay, carriage) for delay in _DELAYS for carriage in _CARRIAGES]
    heads = ['law', *(f'{delay}, {carriage:g} kg' for delay, carriage in grid)]
    sections, beyond = [], []
    medians, most, over, restless, slower = [], [], [], 0, 0
    default = next(iter(laws()))
    for situation in situations():
        title = situation.name[0].upper() + situation.name[1:]
        for width in _WIDTHS:
            cells = {}
            for name, law in laws().items():
                tick(f'{situation.name}, {100.0 * width:g} %, {name}')
                cells[name] = [study(situation, law, width, *at, needles) for at in grid]
            sections.append(
                PageSection(
                    f'{title}, up to {100.0 * width:g} % off',
                    heads,
                    [[name, *map(str, row)] for name, row in cells.items()],
                )
            )
            if situation.added and len(situation.added) == 2:
                beyond += [
                    [f'{name}, {100.0 * width:g} %']
                    + [f'{1e3 * np.max(cell.beyond):.2f}' for cell in row]
                    for name, row in cells.items()
                ]
                over += [1e3 * float(np.max(cell.beyond)) for cell in cells[default]]
            restless += sum(cell.cycles + cell.lost for cell in cells[default])
            if width == min(_WIDTHS):
                medians += [1e6 * float(np.median(cell.final)) for cell in cells[default]]
                most += [1e6 * float(np.quantile(cell.final, 0.95)) for cell in cells[default]]
                slower += sum(
                    bool(np.median(ours.rms) > np.median(theirs.rms))
                    for ours, theirs in zip(cells[default], cells['PID'], strict=True)
                )
    sections[0] = replace(
        sections[0],
        notes=f'Columns: delay in periods of 1 ms, and a carriage unknown to the laws. {needles} '
        'needles in each cell. Cells: median of the rms error; median / 95 % of the final error, '
        'in micrometers. Bold: needles with an error above 5 mm (lost) or with a '
        'limit cycle at the end (cycle).',
    )
    sections.append(PageSection('Largest overshoot after the puncture [mm]', heads, beyond))
    return sections, [
        Bar(
            f'{default}, 30 %: median of the final error, worst cell', max(medians), _MEDIAN, 'um'
        ),
        Bar(f'{default}, 30 %: 95 % of the final error, worst cell', max(most), _MOST, 'um'),
        Bar(f'{default}: needles lost or cycling, all cells', float(restless), 0.0, ''),
        Bar(f'{default}, 30 %: cells with more rms error than PID', float(slower), 0.0, ''),
        Bar(f'{default}: overshoot after a drop of 3 N', max(over), _OVERSHOOT, 'mm'),
    ]
