# SPDX-License-Identifier: Apache-2.0
"""Fault injection of `needle bench safety` and its results."""

from __future__ import annotations

from math import inf

from benchmarks import safety
from benchmarks.safety import cells, FaultCell, measure
from needle_ros.errors import ParameterError
import pytest


@pytest.mark.requirement('S-152', 'S-153')
def test_cells_cover_faults_topics_and_moments() -> None:
    """At least 500 cells without duplicates."""
    all_cells = cells()
    assert len(all_cells) == len(set(all_cells)) >= 500
    assert {cell.moment for cell in all_cells} == set(safety.MOMENTS)


@pytest.mark.requirement('S-001')
@pytest.mark.parametrize(
    ('cell', 'outcome'),
    [
        (FaultCell('base_wrench', 'twice', 'moving'), 'continued'),
        (FaultCell('joint_states', 'lost', 'moving'), 'no force'),
        (FaultCell('joint_states', 'frozen, new stamps', 'moving'), 'no force'),
        (FaultCell('tip_deflection', 'a number of 1e300', 'moving'), 'stop'),
        (FaultCell('wrench_command', 'a second commander', 'moving'), 'no force'),
    ],
)
def test_cell_outcome_is_measured(cell: FaultCell, outcome: str) -> None:
    """Outcome and recovery of the motion; reproducible."""
    found = measure(cell)
    assert found.outcome == outcome
    assert found.force <= 15.0
    assert found.beyond < 4e-3
    assert found.recovery < inf
    assert measure(cell) == found


@pytest.mark.requirement('S-153')
def test_single_fault_is_selected() -> None:
    """Tables of the topics with this fault, and bars that are met; an unknown name is rejected."""
    sections, bars = safety.compare(lambda _stage: None, fault='swapped')
    assert [section.title for section in sections][:4] == [
        '`base_wrench`', '`tip_deflection`', '`joint_states`', '`wrench_command`',
    ]  # fmt: skip
    assert not any(bar.missed for bar in bars)
    with pytest.raises(ParameterError, match='--fault must be one of lost, half lost'):
        safety.compare(lambda _stage: None, fault='none')
