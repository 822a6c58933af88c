# SPDX-License-Identifier: Apache-2.0
"""Study of the control laws: evaluation of runs; its metrics are not tested here."""

from benchmarks import laws as study_of_laws
from benchmarks.laws import compare, LawCell, laws, situations, study
from needle_controller import LAWS, LoopBatch
from needle_dynamics import ParameterError
import numpy as np
import pytest


def batch(depths: list[float], completed: int = 1000) -> LoopBatch:
    """Return a batch with a single run of these depths [m]."""
    path = np.array([depths])
    return LoopBatch(
        final=path[:, -1],
        largest=np.abs(path).max(axis=1),
        rms=np.sqrt(np.mean(path**2, axis=1)),
        states=np.empty((1, 8)),
        completed=np.array([completed]),
        goal=np.zeros(len(depths)),
        depths=path,
        trajectories=np.empty((1, 0, 8)),
        commands=np.empty((1, 0)),
    )


def test_limit_cycle_creep_and_lost_needle_are_distinguished() -> None:
    goal, time = np.zeros(1001), np.arange(1001)
    moving = LawCell.of(batch(list(2e-5 * np.sin(0.05 * time))), goal)
    assert (moving.cycles, moving.lost) == (1, 0)
    assert str(moving) == '**1 cycle**'
    creeping = LawCell.of(batch(list(1e-4 * np.exp(-0.005 * time))), goal)
    assert (creeping.cycles, creeping.lost) == (0, 0)
    assert creeping.beyond[0] == 1e-4
    assert LawCell.of(batch([0.0] * 1001, completed=10), goal).lost == 1
    assert LawCell.of(batch([6e-3] * 1001), goal).lost == 1


def test_every_scenario_ends_at_rest_within_20_mm() -> None:
    for one in situations():
        end = one.reference.at(one.duration)
        assert abs(one.reference.at(0.0).position - one.start) < 1e-12
        assert abs(end.velocity) < 1e-9
        assert 1e-3 < abs(end.position - one.start) < 0.021


def test_default_law_is_first() -> None:
    assert next(iter(laws())) == LAWS[0]


def test_puncture_causes_overshoot() -> None:
    """A force drop of 3 N causes an overshoot of a few tenths of a millimeter at most."""
    names = {one.name: one for one in situations()}
    puncture, law = names['puncture, 3 N'], laws()['adaptive']
    # The cell with the largest one; the corners of the needles are its worst.
    cell = study(puncture, law, 0.5, 2, 2.0, 8)
    plain = study(names['insertion'], law, 0.3, 1, 2.0, 4)
    assert 0.1e-3 < cell.beyond.max() < 0.3e-3
    assert plain.beyond.max() < 0.05e-3


def test_report_has_map_for_each_scenario(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study_of_laws, '_DELAYS', (1,))
    monkeypatch.setattr(study_of_laws, '_CARRIAGES', (0.0,))
    sections, bars = compare(lambda _stage: None, needles=2)
    assert len(sections) == 2 * len(situations()) + 1
    assert 'Puncture, 3 N, up to 30 % off' in [section.title for section in sections]
    # No two situations measure the same.
    assert len({tuple(map(tuple, section.rows)) for section in sections}) == len(sections)
    assert [len(section.rows) for section in sections[:-1]] == [len(laws())] * 8
    assert not any(bar.missed for bar in bars)
    with pytest.raises(ParameterError, match='needles must be at least 1, got 0'):
        compare(lambda _stage: None, needles=0)
