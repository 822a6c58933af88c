# SPDX-License-Identifier: Apache-2.0
"""Common parts of the benchmarks: timing, bars, and report with verdict."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks import measure, page, run
from benchmarks.measure import Bar, NOT_INSTALLED
from benchmarks.page import Answer, PageSection, Tick
from needle_insertion.cli import main
import numpy as np
from numpy.testing import assert_allclose
import pytest

MET = Bar('speed', 2.0, 1.0, 'x', at_least=True)
MISSED = Bar('cost', 5.0, 4.0)
ABSENT = Bar('other tool', None, 1.0)


@pytest.mark.parametrize(
    ('bar', 'wanted', 'found', 'verdict'),
    [
        (MET, '>= 1 x', '2 x', 'met'),
        (MISSED, '<= 4', '5', 'missed by a factor 1.25'),
        (Bar('speed', 50.0, 100.0, at_least=True), '>= 100', '50', 'missed by a factor 2.00'),
        (Bar('lost', 0.0, 0.0), '<= 0', '0', 'met'),
        (Bar('lost', 1.0, 0.0), '<= 0', '1', 'missed'),
        # Memory can decrease.
        (Bar('growth', -0.1, 2.0, 'MB'), '<= 2 MB', '-0.1 MB', 'met'),
        (Bar('ratio of nothing', np.nan, 2.0), '<= 2', 'nan', 'missed'),
        (ABSENT, '<= 1', '', NOT_INSTALLED),
    ],
)
def test_bar_reports_factor_of_miss(bar: Bar, wanted: str, found: str, verdict: str) -> None:
    assert bar.row() == (bar.figure, wanted, found, verdict)
    assert bar.missed == verdict.startswith('missed')


@pytest.mark.parametrize(
    ('bars', 'last', 'missed'),
    [
        ([MET, MET], 'met: 2 bars', False),
        ([MET, MISSED], 'missed: 1 of 2 bars', True),
        ([MET, ABSENT], 'met: 1 bars, 1 not measured', False),
        ([MISSED, ABSENT], 'missed: 1 of 2 bars, 1 not measured', True),
    ],
)
def test_last_line_is_verdict(
    capsys: pytest.CaptureFixture[str], bars: list[Bar], last: str, missed: bool
) -> None:
    def question(tick: Tick) -> Answer:
        tick('a stage')
        return [PageSection('A table', ('a', 'b'), [('1', '22')], 'A note.')], bars

    text, found = run.ask('x', 'needle bench x', [question])
    assert found == missed
    assert text == capsys.readouterr().out
    assert text.splitlines()[0] == '# Benchmark: x'
    for line in ('- command: `needle bench x`', '## A table', '| 1 | 22 |', 'A note.', '## Bars'):
        assert line in text.splitlines()
    assert text.splitlines()[-1] == last


@pytest.mark.parametrize(('bar', 'status'), [(MET, 0), (MISSED, 1)])
def test_command_writes_report_and_returns_verdict(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    bar: Bar,
    status: int,
) -> None:
    asked: list[dict[str, object]] = []

    def compare(tick: Tick, **options: object) -> Answer:
        asked.append(options)
        return [], [bar]

    monkeypatch.setattr(run, 'import_module', lambda _name: argparse.Namespace(compare=compare))
    file = tmp_path / 'page.md'
    assert main(['bench', 'graph', '--quick', '-o', str(file)]) == status
    assert asked == [{'plan': 'quick'}]
    assert file.read_text() == capsys.readouterr().out
    assert '- command: `needle bench graph --quick`' in file.read_text().splitlines()
    assert main(['bench', 'calibration', '--seed', '3']) == status
    assert asked[1:] == [{'seed': 3}] * len(run.MODULES['calibration'])
    assert '- command: `needle bench calibration --seed 3`' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('value', 'text'),
    [(0.00012345, '0.000123'), (999.6, '1000'), (1234.5, '1230'), (-45_678.0, '-45700')],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert measure.number(value) == text


def test_missing_tool_is_named() -> None:
    assert page.version('no-such-tool') == 'no-such-tool not installed'
    assert measure.optional('no_such_tool') is None


def test_table_columns_are_aligned() -> None:
    lines = page.table(('a', 'long head'), [('wide cell', '1')]).splitlines()
    assert lines == [
        '| a         | long head |',
        '| --------- | --------- |',
        '| wide cell | 1         |',
    ]


def test_geometric_settings_are_ordered() -> None:
    assert_allclose(measure.geometric(1.0, 8.0, 2.0), [1.0, 2.0, 4.0, 8.0])
    assert_allclose(measure.geometric(1.0, 0.1, 0.5), [1.0, 0.5, 0.25, 0.125])


def test_jobs_are_timed_alternately() -> None:
    calls: list[str] = []
    jobs: dict[str, Callable[[], object]] = {name: partial(calls.append, name) for name in 'ab'}
    times = measure.least_times(jobs, 2)
    assert set(times) == {'a', 'b'}
    # A warm-up of each job, then alternating repetitions.
    assert calls[:2] == ['a', 'b']
    turns = [name for i, name in enumerate(calls[2:], 2) if i == 2 or calls[i - 1] != name]
    assert turns == ['a', 'b', 'a', 'b']
