"""The faults of `needle bench safety`, and what they show."""

from __future__ import annotations

from math import inf

from benchmarks import safety
from benchmarks.safety import Cell, cells, measure
from needle_ros.errors import ParameterError
import pytest


def test_every_fault_meets_every_topic_at_every_moment() -> None:
    """In 500 cells and more, none of them twice."""
    all_cells = cells()
    assert len(all_cells) == len(set(all_cells)) >= 500
    assert {cell.moment for cell in all_cells} == set(safety.MOMENTS)


@pytest.mark.parametrize(
    ('cell', 'outcome'),
    [
        (Cell('base_wrench', 'twice', 'moving'), 'borne'),
        (Cell('joint_states', 'lost', 'moving'), 'no force'),
        (Cell('joint_states', 'frozen, new stamps', 'moving'), 'no force'),
        (Cell('tip_deflection', 'a number of 1e300', 'moving'), 'stop'),
        (Cell('wrench_command', 'a second commander', 'moving'), 'no force'),
    ],
)
def test_a_cell_is_measured(cell: Cell, outcome: str) -> None:
    """What was done, and that the motion goes on afterwards; the same each time."""
    found = measure(cell)
    assert found.outcome == outcome
    assert found.force <= 15.0
    assert found.beyond < 4e-3
    assert found.recovery < inf
    assert measure(cell) == found


def test_one_fault_alone() -> None:
    """A table for each topic that has it, and bars that are met; another name is refused."""
    sections, bars = safety.compare(lambda _stage: None, fault='swapped')
    assert [section.title for section in sections][:4] == [
        '`base_wrench`', '`tip_deflection`', '`joint_states`', '`wrench_command`',
    ]  # fmt: skip
    assert not any(bar.missed for bar in bars)
    with pytest.raises(ParameterError, match='--fault must be one of lost, half lost'):
        safety.compare(lambda _stage: None, fault='none')
