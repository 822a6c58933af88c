# SPDX-License-Identifier: Apache-2.0
"""Tables and bars of faults of steered insertions, for the page of `needle bench safety`."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.steering_faults import (
    allowed,
    cells,
    IGNORED,
    measure,
    MISSED,
    OUTCOMES,
    RESTLESS,
    SteeringCell,
    SteeringResult,
    word_of,
)
from benchmarks.steering_nodes import CALLS, COMMAND, NODES, RESPONSE, ROBOT
from needle_ros.process import cores
from needle_ros.process_pool import processes
from needle_ros.system_state import CLEAR_STOP


def measure_all(chosen: Sequence[SteeringCell], workers: int) -> list[SteeringResult]:
    """Measure cells in a number of processes."""
    with processes(workers) as pool:
        return list(pool.map(measure, chosen))


def compare(tick: Tick, fault: str = '') -> Answer:
    """Measure all cells, or a single fault; an empty page without cells of this fault."""
    chosen = [cell for cell in cells() if fault in ('', cell.fault)]
    if not chosen:
        return [], []
    tick('steered insertions')
    found = measure_all(chosen, cores())
    heads = dict.fromkeys(_place(cell) for cell in chosen)
    sections = [_section(head, chosen, found) for head in heads]
    beyond = [
        cell.place for cell, one in zip(chosen, found, strict=True) if one.advance > allowed(cell)
    ]
    cleared = sum(word_of(place) == CLEAR_STOP for place in beyond)
    bars = [
        Bar(
            'steered: misses of more than 1 mm without a warning',
            float(sum(one.outcome == MISSED for one in found)),
            0.0,
        ),
        Bar(
            'steered: requests of a user that are not executed',
            float(sum(one.outcome == IGNORED for one in found)),
            0.0,
        ),
        Bar('steered: cells without rest', float(sum(o.outcome == RESTLESS for o in found)), 0.0),
        Bar(
            'steered: cells that move into the tissue after a stop by more than the braking '
            'distance',
            float(len(beyond) - cleared),
            0.0,
        ),
        Bar(
            'steered: clearances of a stop after which the needle moves into the tissue',
            float(cleared),
            0.0,
        ),
    ]
    if not fault:
        bars.insert(0, Bar('steered: cells', float(len(chosen)), 2000.0, at_least=True))
    return sections, bars


def _place(cell: SteeringCell) -> str:
    """Return the message or node of a cell; requests of a user at all nodes are one."""
    call = CALLS.get(cell.place.removeprefix(RESPONSE))
    return f'~/{call[0]}' if call else cell.place


def _fault(cell: SteeringCell) -> str:
    return f'response {cell.fault}' if cell.place.startswith(RESPONSE) else cell.fault


def _section(
    place: str, chosen: Sequence[SteeringCell], found: Sequence[SteeringResult]
) -> PageSection:
    """Return the table of a message or node: one row per fault, over all phases and robots."""
    rows = []
    for fault in dict.fromkeys(_fault(cell) for cell in chosen if _place(cell) == place):
        own = [
            one
            for cell, one in zip(chosen, found, strict=True)
            if (_place(cell), _fault(cell)) == (place, fault)
        ]
        rows.append(
            (
                fault,
                *(str(sum(one.outcome == outcome for one in own)) for outcome in OUTCOMES),
                f'{1e3 * max(one.advance for one in own):.2f}',
                f'{1e3 * max(one.deepest for one in own):.2f}',
                f'{1e3 * max(one.travel for one in own):.1f}',
                f'{max(one.load for one in own):.1f}',
                f'{max(one.safe for one in own):.2f}',
            )
        )
    kind = 'node ' if place in set().union(*NODES.values()) else ''
    notes = ''
    if place == COMMAND:
        notes = (
            'A driver that misreads its position commands (biased, in another unit or direction) '
            'moves against every command: no stop of the controller ends this motion. These '
            'cells are in the table, but not in the bar of the motion after a stop. Of late '
            'commands, the bar is larger by the motion within the delay.'
        )
    if place == ROBOT:
        notes = (
            'A robot without a controller that is killed or paused receives no stop: it follows '
            'its trajectory, at most to its end. The bar of these cells is larger by this motion.'
        )
    return PageSection(
        f'Steered: {kind}`{place}`',
        (
            'fault', *OUTCOMES, 'motion into the tissue after a stop [mm]',
            'beyond the target depth [mm]', 'guide travel [mm]', 'lateral load [N]',
            'time to safe [s]',
        ),
        rows,
        notes,
    )  # fmt: skip
