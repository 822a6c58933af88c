# SPDX-License-Identifier: Apache-2.0
"""Encoders that freeze in motion and report no velocity, and needles with other friction."""

from __future__ import annotations

from collections.abc import Iterable

from benchmarks.loop import Loop, LoopFault, Sent
from needle_controller.controller import LAWS
import pytest

#: Position, velocity and effort of `insertion` in the values of `joint_states`.
POSITION, VELOCITY, EFFORT = 0, 2, 4


class Frozen(LoopFault):
    """Repeats the first position, and reports no velocity, as encoders with differences do."""

    def __init__(self, *, effort: bool) -> None:
        self._position: float | None = None
        self._effort = effort

    def measured(self, sent: Sent) -> Iterable[Sent]:
        values = list(sent.values)
        self._position = values[POSITION] if self._position is None else self._position
        values[POSITION], values[VELOCITY] = self._position, 0.0
        if not self._effort:
            values[EFFORT] = float('nan')
        return (sent._replace(values=values),)


@pytest.mark.requirement('S-056', 'S-070')
@pytest.mark.parametrize('law', LAWS)
@pytest.mark.parametrize('effort', [True, False], ids=['effort', 'no effort'])
@pytest.mark.parametrize('begin', [40, 60, 150])
@pytest.mark.parametrize('target', [0.09, 0.005])
def test_encoders_frozen_in_motion_stop_the_needle(
    law: str, effort: bool, begin: int, target: float
) -> None:
    """The needle moves by some millimeters, and the force is zero until the stop is cleared."""
    loop = Loop(law, 200.0)
    loop.target(target)
    for _ in range(begin):
        loop.step()
    depth, fault = loop.depth, Frozen(effort=effort)
    for _ in range(400):
        loop.step('joint_states', fault)
    # Expected are 1 mm with 1.5 times the friction, which is 1.5 mm; 1.5 mm more until the force
    # exceeds this friction at 10 mm/s, and 0.5 mm within two periods at 50 mm/s.
    assert abs(loop.depth - depth) < 3.6e-3
    assert loop.acting == 0.0
    assert 'encoders do not move' in loop.supervisor.authority.reason


@pytest.mark.requirement('S-070')
@pytest.mark.parametrize('law', LAWS)
@pytest.mark.parametrize('factor', [0.2, 1.0, 2.0, 4.0])
def test_other_friction_is_no_stall(law: str, factor: float) -> None:
    """The needle reaches its target with friction that differs from the nominal one."""
    loop = Loop(law, 200.0, friction=factor)
    loop.target(0.05)
    for _ in range(1600):
        loop.step()
    assert loop.supervisor.authority.reason == ''
    # Dry friction holds the needle where the law has less force; a tenth of the stall limit.
    assert loop.depth == pytest.approx(0.05, abs=1e-4)
