# SPDX-License-Identifier: Apache-2.0
"""Fault injection into steered insertions of `needle bench safety`."""

from __future__ import annotations

from math import inf
from typing import Final

from benchmarks import steering_bars
from benchmarks.message_faults import MESSAGES, places
from benchmarks.steering_faults import (
    allowed,
    cells,
    measure,
    NODE_FAULTS,
    OUTCOMES,
    PHASES,
    SteeringCell,
)
from benchmarks.steering_graph import AIM, SteeringGraph
from benchmarks.steering_nodes import (
    ACCELERATION,
    CALLS,
    COMMANDED,
    DIRECT,
    HARDWARE,
    NODES,
    RATE,
    ROBOTS,
    ROUTES,
    SETTINGS,
    WORLD,
)
from needle_ros.system_state import CLEAR_STOP, PAUSE, RESUME, RETRACT, RETRACT_DEPTH, STOP
import numpy as np
import pytest

#: Place, fault, phase and duration of a fault, and the possible outcomes.
_SAMPLE: Final = [
    ('joint_states', 'lost', 'inserting', inf, {'stopped'}),
    ('joint_states', 'doubled', 'inserting', inf, {'hit'}),
    ('base_wrench', 'in mN', 'measuring', inf, {'stopped'}),
    ('/diagnostics', 'lost', 'guiding', inf, {'hit'}),
    ('target', 'in mm', 'at rest', inf, {'ended'}),
    ('steering', 'killed', 'inserting', inf, {'ended'}),
    ('controller', 'stopped', 'braking', inf, {'stopped'}),
    ('joint_trajectory to controller', 'in mm', 'measuring', inf, {'stopped'}),
    ('goal', 'lost', 'inserting', inf, {'stopped'}),
    ('joint_commands', 'in mm', 'inserting', inf, {'stopped'}),
    ('joint_trajectory', 'lost', 'guiding', inf, {'stopped'}),
    ('emergency_stop', 'late', 'inserting', inf, {'stopped'}),
    ('emergency_stop to steering', 'lost', 'guiding', inf, {'stopped'}),
    ('emergency_stop', 'lost', 'inserting', inf, {'hit'}),
    ('pause at robot', 'doubled after 1 s', 'inserting', inf, {'paused'}),
    ('retract at steering', 'first lost', 'inserting', inf, {'retracted'}),
    ('resume at steering', 'late', 'guiding', inf, {'hit'}),
    ('response of stop at robot', 'first lost', 'measuring', inf, {'stopped'}),
]


@pytest.mark.requirement('S-185', 'S-301')
def test_steered_cells_cover_messages_nodes_and_phases() -> None:
    """At least 2000 cells without duplicates; every topic and every node has faults."""
    all_cells = cells()
    assert len(all_cells) == len(set(all_cells)) >= 2000
    assert {cell.robot for cell in all_cells} == {*ROBOTS}
    assert {cell.phase for cell in all_cells} == {*PHASES}
    assert {name.partition(' to ')[0] for name in MESSAGES} == {*ROUTES}
    nodes = {name for robot in ROBOTS for name in NODES[robot]}
    assert {cell.place for cell in all_cells} == {*MESSAGES} | nodes
    assert {cell.fault for cell in all_cells if cell.place in nodes} == {*NODE_FAULTS}
    requests = {(cell.place, cell.phase) for cell in all_cells if cell.place in CALLS}
    assert requests == {(place, phase) for place in CALLS for phase in PHASES}


@pytest.mark.requirement('S-302', 'S-313')
@pytest.mark.parametrize(
    ('place', 'fault', 'phase', 'outcome'),
    [
        ('retract at steering', 'late', 'guiding', 'retracted'),
        ('response of resume at robot', f'first lost, then {PAUSE}', 'braking', 'paused'),
    ],
)
@pytest.mark.parametrize('acceleration', [0.5 * ACCELERATION, ACCELERATION, 2.0 * ACCELERATION])
def test_position_robot_of_any_acceleration_reverses_and_pauses(
    monkeypatch: pytest.MonkeyPatch,
    place: str,
    fault: str,
    phase: str,
    outcome: str,
    acceleration: float,
) -> None:
    """Also one that cannot follow the reference."""
    monkeypatch.setitem(WORLD, 'base.acceleration_limit', acceleration)
    cell = SteeringCell(HARDWARE, False, place, fault, phase)
    found = measure(cell)
    assert found.outcome == outcome
    assert found.advance <= allowed(cell)


@pytest.mark.requirement('S-309')
@pytest.mark.parametrize('robot', ROBOTS)
def test_retraction_withdraws_the_needle_and_returns_the_guide(robot: str) -> None:
    graph = SteeringGraph(robot, continuous=False)
    # Without measurements a target is rejected.
    for _ in range(round(0.3 * RATE)):
        graph.step()
    graph.target()
    for _ in range(round(10.0 * RATE)):
        graph.step()
        if graph.world.depth > 0.5 * AIM[1]:
            break
    aside = max(map(abs, graph.world.guide))
    graph.steering.request(RETRACT, graph.now)
    # 15 mm at 10 mm/s, with the times of reaction, braking and settling.
    for _ in range(round(5.0 * RATE)):
        graph.step()
    # A robot that withdraws by itself ends deeper than the controller.
    assert graph.world.depth <= RETRACT_DEPTH + SETTINGS.depth_tolerance
    # The tilted guide of the insertion is far from its zero.
    assert aside > 5.0 * SETTINGS.guide_tolerance
    assert max(map(abs, graph.world.guide)) <= SETTINGS.guide_tolerance


@pytest.mark.requirement('S-304')
@pytest.mark.parametrize(
    ('word', 'later', 'outcome'), [(RESUME, PAUSE, 'paused'), (CLEAR_STOP, STOP, 'stopped')]
)
def test_lost_response_of_a_resume_does_not_end_a_later_pause(
    word: str, later: str, outcome: str
) -> None:
    """Nor a lost one of a clearance a later stop: they are not sent again."""
    place, fault = f'response of {word} at steering', f'first lost, then {later}'
    cell = SteeringCell(DIRECT, False, place, fault, 'inserting')
    found = measure(cell)
    assert found.outcome == outcome
    assert found.advance <= allowed(cell)


@pytest.mark.requirement('S-303')
@pytest.mark.parametrize('fault', ['late', 'doubled'])
def test_driver_moves_nothing_after_a_clearance(fault: str) -> None:
    cell = SteeringCell(COMMANDED, False, 'clear_stop at robot', fault, 'inserting')
    assert measure(cell).advance <= allowed(cell)


@pytest.mark.requirement('S-186')
@pytest.mark.parametrize('seed', range(5))
def test_random_cells_rest_without_an_unnoticed_miss(seed: int) -> None:
    """Cells drawn at random; the whole matrix is the benchmark."""
    all_cells = cells()
    for k in np.random.default_rng(seed).choice(len(all_cells), 6, replace=False).tolist():
        found = measure(all_cells[k])
        assert found.outcome in OUTCOMES, all_cells[k]
        assert found.advance <= allowed(all_cells[k]), all_cells[k]


@pytest.mark.requirement('S-186', 'S-302')
@pytest.mark.parametrize('continuous', [False, True])
@pytest.mark.parametrize(
    ('robot', 'place', 'fault', 'phase', 'lasts', 'outcomes'),
    [
        (robot, *row)
        for robot in ROBOTS
        for row in _SAMPLE
        if row[0] in (*places(robot), *NODES[robot])
    ],
)
def test_outcome_of_a_steered_cell_is_measured(
    robot: str, continuous: bool, place: str, fault: str, phase: str, lasts: float,
    outcomes: set[str],
) -> None:  # fmt: skip
    """With all robots that have the message or node, and both strategies; reproducible."""
    cell = SteeringCell(robot, continuous, place, fault, phase, lasts)
    found = measure(cell)
    assert found.outcome in outcomes
    assert found.advance <= allowed(cell)
    if robot == ROBOTS[0]:
        assert measure(cell) == found


@pytest.mark.requirement('S-185')
def test_unknown_fault_has_no_steered_cells() -> None:
    assert steering_bars.compare(lambda _stage: None, fault='swapped') == ([], [])
