# SPDX-License-Identifier: Apache-2.0
"""Fault injection into steered insertions of `needle bench safety`."""

from __future__ import annotations

from math import inf

from benchmarks import steering_faults
from benchmarks.message_faults import MESSAGES
from benchmarks.steering_faults import (
    allowed,
    BRAKING_DISTANCE,
    cells,
    measure,
    NODE_FAULTS,
    OUTCOMES,
    PHASES,
    SteeringCell,
)
from benchmarks.steering_nodes import NODES, ROBOTS, ROUTES
import numpy as np
import pytest


@pytest.mark.requirement('S-185')
def test_steered_cells_cover_messages_nodes_and_phases() -> None:
    """At least 2000 cells without duplicates; every topic and every node has faults."""
    all_cells = cells()
    assert len(all_cells) == len(set(all_cells)) >= 2000
    assert {cell.robot for cell in all_cells} == {*ROBOTS}
    assert {cell.phase for cell in all_cells} == {*PHASES}
    assert {name.partition(' to ')[0] for name in MESSAGES} == {*ROUTES}
    assert {cell.fault for cell in all_cells if cell.place in NODES} == {*NODE_FAULTS}


@pytest.mark.requirement('S-186')
@pytest.mark.parametrize('seed', range(5))
def test_random_cells_rest_without_an_unnoticed_miss(seed: int) -> None:
    """Cells drawn at random; the whole matrix is the benchmark."""
    all_cells = cells()
    for k in np.random.default_rng(seed).choice(len(all_cells), 6, replace=False).tolist():
        found = measure(all_cells[k])
        assert found.outcome in OUTCOMES, all_cells[k]
        assert found.advance <= allowed(all_cells[k]), all_cells[k]


@pytest.mark.requirement('S-186')
@pytest.mark.parametrize('robot', ROBOTS)
@pytest.mark.parametrize('continuous', [False, True])
@pytest.mark.parametrize(
    ('place', 'fault', 'phase', 'lasts', 'outcomes'),
    [
        ('joint_states', 'lost', 'inserting', inf, {'stopped'}),
        ('joint_states', 'doubled', 'inserting', inf, {'hit'}),
        ('base_wrench', 'in mN', 'measuring', inf, {'stopped'}),
        ('/diagnostics', 'lost', 'guiding', inf, {'hit'}),
        ('target', 'in mm', 'at rest', inf, {'ended'}),
        ('steering', 'killed', 'inserting', inf, {'ended'}),
        ('controller', 'stopped', 'braking', inf, {'stopped'}),
    ],
)
def test_outcome_of_a_steered_cell_is_measured(
    robot: str, continuous: bool, place: str, fault: str, phase: str, lasts: float,
    outcomes: set[str],
) -> None:  # fmt: skip
    """With both robots and strategies; reproducible."""
    cell = SteeringCell(robot, continuous, place, fault, phase, lasts)
    found = measure(cell)
    assert found.outcome in outcomes
    assert found.advance <= BRAKING_DISTANCE
    if robot == ROBOTS[0]:
        assert measure(cell) == found


@pytest.mark.requirement('S-185')
def test_unknown_fault_has_no_steered_cells() -> None:
    assert steering_faults.compare(lambda _stage: None, fault='swapped') == ([], [])
