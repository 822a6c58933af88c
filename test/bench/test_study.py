# SPDX-License-Identifier: Apache-2.0
"""Benchmark of studies: reported metrics; times are not tested."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import ModuleType

from benchmarks import environments, run
from benchmarks import study as bench_study
from benchmarks.episodes import InsertionPolicy, SteeringPolicy, total_rewards
from benchmarks.kills import again, written
from benchmarks.study import StudyPlan
from needle_controller import LAWS
from needle_insertion.cli import main
from needle_study.gym.insertion import InsertionVectorEnv
from needle_study.gym.steering import SteeringVectorEnv
import pytest
import yaml

#: Few short insertions, with a fast controller.
SMALL = {
    'scenario': 'steering',
    'samples': 1,
    'seed': 3,
    'settings': {'depth': 0.05, 'step_length': 0.01, 'law': 'springs'},
    'population': {'bending_length': {'uniform': [0.8, 1.2]}},
}

ALONG = {
    'scenario': 'insertion',
    'samples': 1,
    'seed': 3,
    'settings': {'wait': 0.1},
    'population': {'target': {'uniform': [0.02, 0.03]}},
}


def test_report_has_all_metrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables are equal, although workers and the study are killed."""
    file = tmp_path / 'study.yaml'
    file.write_text(yaml.safe_dump(SMALL))
    along = tmp_path / 'along.yaml'
    along.write_text(yaml.safe_dump(ALONG))
    monkeypatch.setattr(bench_study, 'STUDY', file)
    monkeypatch.setattr(bench_study, 'AXIS', along)
    monkeypatch.setitem(bench_study.PLANS, 'quick', StudyPlan(64, 32, 1, (4, 8, 16), 1, 2))
    told: list[str] = []
    [rates, axial, memory, tables], bars = bench_study.compare(told.append, 'quick')
    assert [row[0] for row in rates.rows] == list(bench_study.WAYS)
    for _, together, each, *_ in (*rates.rows, *axial.rows):
        assert float(together) >= float(each) > 0.0
    assert [row[0] for row in memory.rows] == ['4', '8', '16']
    # Memory of a process with NumPy and Numba.
    assert all(50.0 < float(peak) < 2000.0 for row in memory.rows for peak in row[2:])
    assert len({row[1] for row in tables.rows}) == 1
    killed = 'a worker of Dask is killed half way'
    assert [row[0] for row in tables.rows] == [*bench_study.WAYS, killed]
    found = {bar.figure: bar for bar in bars}
    assert found['tables that differ'].found == 0.0
    assert found['tables along the axis that differ'].found == 0.0
    assert found['insertions computed twice'].found == 0.0
    assert found['closed loop, per second and core'].limit == 200.0
    assert 'peak of parent, 16 over 8 insertions' in found
    assert 'the study is killed' in told


def test_repeated_computation_is_counted(tmp_path: Path) -> None:
    """In a rewritten part, a missing part, and an overlapping part."""
    for name in ('0000000000-0000000004-0.arrow', '0000000004-0000000010-0.arrow', 'x.tmp'):
        (tmp_path / name).write_text('')
    before = written(tmp_path)
    assert set(before) == {(0, 4), (4, 10)}
    assert written(tmp_path / 'none') == {}
    assert again(before, {**before, (10, 20): 0}) == 0
    assert again(before, {**before, (4, 10): 1}) == 6
    assert again(before, {(4, 10): before[4, 10]}) == 4
    assert again(before, {**before, (8, 20): 0}) == 2


def test_every_environment_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environments, 'STEPS', {'single': 30, 'vector': 3})
    [section], [bar] = environments.compare(lambda _stage: None, 'quick')
    assert bar.figure == '64 steered needles over one'
    assert bar.limit == 10.0
    names = ['NeedleInsertion-v0', 'NeedleSteering-v0', 'CartPole-v1', 'Pendulum-v1']
    assert [row[0] for row in section.rows] == names
    assert all(float(rate) > 0.0 for row in section.rows for rate in row[1:])


def test_laws_of_the_suite_reach_targets_of_the_environments() -> None:
    """From observations alone; a fixed guide does not."""
    for name in LAWS:
        # All needles arrive: progress and arrival are 2, less time and force.
        assert total_rewards(InsertionVectorEnv(4), partial(InsertionPolicy, name)).min() > 0.5
    # The negative distance [mm].
    for name in ('multi_hypothesis', 'springs'):
        assert total_rewards(SteeringVectorEnv(4), partial(SteeringPolicy, name)).min() > -2.0
    assert total_rewards(SteeringVectorEnv(4), partial(SteeringPolicy, 'open_loop')).max() < -2.0


def test_missing_package_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line, before the measurements."""

    def missing(_name: str) -> ModuleType:
        raise ModuleNotFoundError("No module named 'pyarrow'", name='pyarrow')

    monkeypatch.setattr(run, 'import_module', missing)
    for name, extra in (('study', 'bench,ros'), ('learning', 'learning')):
        assert main(['bench', name, '--quick']) == 2
        said = capsys.readouterr()
        assert (
            said.err == f"error: needle bench {name} needs pyarrow: pip install -e '.[{extra}]'\n"
        )
        assert said.out == ''
