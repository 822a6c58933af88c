# SPDX-License-Identifier: Apache-2.0
"""Tables of the paper from the shipped recordings, and verdicts that can fail."""

from functools import cache
import json
from pathlib import Path
import re
from typing import Any

from needle_identification import ParameterEstimate, Statistic
from needle_insertion.cli import main
from needle_insertion.report import controllability
from needle_insertion.report.paper_tables import FORCE_LEVELS, TABLE_1, TABLE_2
import numpy as np
import pytest
from reproduction import figures, identified, mismatch, results
from reproduction.claims import judge
from reproduction.command import RESULTS
from reproduction.content import ReportSection
from reproduction.identified import IdentifiedTable, identify_table, PublishedValue
from reproduction.protocol import SHIPPED_BAGS
from reproduction.truth import _stiffness, Coverage, TruthComparison
from support.pages import look_at


@pytest.fixture(scope='module')
def tables() -> dict[str, IdentifiedTable]:
    """Identify the tables from the shipped bags."""
    return {name: identify_table(name) for name in identified.TABLES}


@pytest.fixture
def once(monkeypatch: pytest.MonkeyPatch, tables: dict[str, IdentifiedTable]) -> None:
    """Use one identification of the shipped bags in all tests."""
    monkeypatch.setattr(results, 'identify_table', lambda name, _recorded: tables[name])


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use fewer points in the map of controllability."""
    monkeypatch.setattr(controllability, 'DEPTHS', 9)
    monkeypatch.setattr(controllability, 'DEFLECTIONS', 7)


@pytest.mark.usefixtures('once')
def test_shipped_bags_reproduce_table_1(capsys: pytest.CaptureFixture[str]) -> None:
    """Both means and both STDs of the paper are in their intervals, from 20 recordings."""
    assert main(['reproduce', 'table-1', '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found['bags']) == 20
    assert [
        (line['paper']['mean'], line['paper']['deviation']) for line in found['lines']
    ] == list(TABLE_1.values())
    assert found['holds']
    assert all(line['holds'] for line in found['lines'])
    assert found['truth']['of'] == 40


@pytest.mark.usefixtures('once')
def test_shipped_bags_reproduce_table_2(capsys: pytest.CaptureFixture[str]) -> None:
    """Every entry at every level, and k_a, is in its intervals, from 20 places."""
    assert main(['reproduce', 'table-2']) == 0
    text = capsys.readouterr().out
    assert 'DOES NOT HOLD' not in text
    lines = text.splitlines()
    for entry in TABLE_2:
        for force in FORCE_LEVELS:
            assert sum(line.startswith(f'{entry} at {force:g} N') for line in lines) == 1
    assert any(line.startswith('k_a at 1.5 N [N/m^2]') and '520' in line for line in lines)
    assert 'of 400' in lines[-1]


def line(mean: float, deviation: float | None, count: int = 20) -> PublishedValue:
    """Return a line with published values 10 ± 1."""
    reach = 2.1 * (deviation or 1.0) / np.sqrt(count)
    found = Statistic(
        name='a', symbol='a', unit='N', mean=mean, deviation=deviation, error=0.2,
        interval=(mean - reach, mean + reach), count=count,
    )  # fmt: skip
    return PublishedValue(quantity='a [N]', paper=(10.0, 1.0), found=found, truth=Coverage(19, 20))


@pytest.mark.parametrize(
    ('mean', 'deviation', 'holds'),
    [
        (10.1, 1.0, True),
        (11.0, 1.0, False),
        (9.0, 1.0, False),
        # Half and twice the STD are outside the chi-squared interval of 20 samples.
        (10.0, 0.5, False),
        (10.0, 2.0, False),
        (10.0, None, True),
    ],
)
def test_lines_hold_if_mean_and_std_are_in_their_intervals(
    mean: float, deviation: float | None, holds: bool
) -> None:
    """Mean or STD alone can fail; the STD of a single recording is unknown."""
    judged = line(mean, deviation)
    assert judged.holds == holds
    assert ('DOES NOT HOLD' in judged.row) == (not holds)


def test_std_intervals_follow_the_chi_squared_distribution() -> None:
    """The interval contains the STD of the population in 95 of 100 samples."""
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(4000, 20)).std(axis=1, ddof=1)
    bounds = np.array([line(10.0, float(s)).deviation_interval for s in samples])
    held = np.mean((bounds[:, 0] <= 1.0) & (bounds[:, 1] >= 1.0))
    # Four standard errors of a share of 0.95 in 4000.
    assert held == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / 4000))
    # Published factors for 20: the square roots of 19/32.852 and of 19/8.907.
    assert line(10.0, 1.0).deviation_interval == pytest.approx((0.76049, 1.46057), abs=1e-4)
    assert line(10.0, None, 1).deviation_interval == (0.0, np.inf)


@pytest.mark.parametrize('trials', [1, 20, 40, 400])
def test_least_coverage_is_the_one_percent_quantile(trials: int) -> None:
    """With a coverage of 95 %, fewer intervals hold with a probability of 1 % at most."""
    least = Coverage(known=trials).least
    held = np.random.default_rng(trials).binomial(trials, 0.95, size=20000)
    # Three standard errors of a share of 0.01 in 20000.
    assert np.mean(held < least) <= 0.01 + 3.0 * np.sqrt(0.01 / 20000)
    assert np.mean(held <= least) >= 0.01 - 3.0 * np.sqrt(0.01 / 20000)


def test_coverage_counts_intervals_with_a_true_value() -> None:
    """Hit, miss, undetermined estimate, and unknown true value."""
    held = ParameterEstimate(
        name='a', symbol='a', unit='N', value=1.0, error=0.5, interval=(0.0, 2.0), determined=True
    )
    unknown = ParameterEstimate(name='a', symbol='a', unit='N')
    pairs = ((held, 1.5), (held, 2.5), (unknown, 1.0), (held, None))
    compared = [TruthComparison(estimate=e, truth=t) for e, t in pairs]
    assert Coverage.of(compared) == Coverage(held=1, known=3)


def test_true_stiffness_is_taken_at_the_nearest_level() -> None:
    """There is no interpolation; without a configuration the true value is unknown."""
    truth = {'indenter.force_levels': [1.1, 1.2], 'indenter.stiffness_zz': [900.0, 700.0]}
    assert _stiffness(truth, 'k_zz', 1.198) == 700.0
    assert _stiffness(truth, 'k_xx', 1.1) is None
    assert _stiffness(None, 'k_zz', 1.1) is None


def test_missing_recordings_are_a_one_line_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The error names the missing recordings, with exit status 2."""
    monkeypatch.setattr(identified, 'SHIPPED_BAGS', tmp_path)
    assert main(['reproduce', 'table-2']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert 'holds no stiffness_*' in said


def test_tables_that_do_not_hold_return_status_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two recordings of one kind do not represent the population of the paper."""
    for k, bag in enumerate(sorted(SHIPPED_BAGS.glob('friction_*'))[:2]):
        (tmp_path / f'friction_{k}').symlink_to(bag)
    monkeypatch.setitem(TABLE_1, 'coulomb_friction', (5.6, 0.0374))
    monkeypatch.setattr(identified, 'SHIPPED_BAGS', tmp_path)
    assert main(['reproduce', 'table-1', '--json']) == 1
    assert not json.loads(capsys.readouterr().out)['holds']


def test_every_result_is_a_choice_of_the_command() -> None:
    """Figures 4 to 8, tables 1 to 3, analysis, claims, mismatch, or all of them."""
    tables = dict.fromkeys(identified.TABLES)
    assert {*RESULTS} == {*results._jobs(tables, '')} - {'figures'} | {'all'}
    assert len(RESULTS) == 12


@pytest.mark.parametrize(
    ('what', 'pictures', 'words'),
    [
        ('table-1', 0, ['Table 1', 'holds', '2 quantities', '299.9 ± 44.4', 'no unit']),
        ('table-3', 0, ['Table 3', 'kg/m³', 'round wire of 1.27 mm']),
        ('figure-4', 1, ['Figure 4', 'metrics of each run', '0.3 N s/mm, as_printed']),
        ('controllability', 1, ['control 4 of 8 states', 'q1, q2, q\u03071, q\u03072']),
    ],
)
@pytest.mark.usefixtures('once', 'coarse')
def test_results_are_pages_for_a_browser(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str, pictures: int, words: list[str]
) -> None:
    """The page fits a phone, sends no external requests and matches the terminal output."""
    assert main(['reproduce', what, '-o', str(tmp_path)]) == 0
    assert f'wrote {tmp_path}/reproduce.html' in capsys.readouterr().out
    seen = look_at(tmp_path / 'reproduce.html')
    source = (tmp_path / 'reproduce.html').read_text(encoding='utf-8')
    for word in words:
        # On a phone the heads of a wide table are repeated in its cells by the style.
        assert word in seen.text or f' data-head="{word}"' in source
    assert [width > 0 for _, width in seen.images] == [True] * pictures
    assert seen.requests == []
    assert seen.overflow == 0


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch, once: Any, coarse: Any) -> None:
    """Compute all results with few runs."""
    figure = figures.FIGURES['figure-4']
    study = cache(lambda: mismatch.study(8))
    monkeypatch.setattr(results, '_study', study)
    few = ('table_3', 'linear', 'reading_of_table_1', 'not_zero')
    entries = [entry for entry in judge._entries() if entry['name'] in few]
    monkeypatch.setattr(judge, '_entries', lambda: entries)
    monkeypatch.setattr(
        figures, 'section',
        lambda: ReportSection(
            title='Figures 4 to 8', paragraphs=(), pictures=(figure().picture,)
        ),
    )  # fmt: skip


@pytest.mark.usefixtures('cheap')
def test_all_results_are_sections_of_one_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sections are in order, claims use the results of the bags, bytes are reproducible."""
    monkeypatch.setenv('SOURCE_DATE_EPOCH', '86400')
    first, second = tmp_path / 'first', tmp_path / 'second'
    assert main(['reproduce', 'all', '-o', str(first)]) == 0
    said = capsys.readouterr().out
    assert said.count('holds only if') == 2
    assert said.count('does not hold') == 1
    seen = look_at(first / 'reproduce.html')
    titles = [
        *('Claims of the paper', 'Table 1', 'Table 2', 'Table 3', 'Figures 4 to 8'),
        *('Controllability and observability', 'Mismatch between needle and model'),
    ]
    places = [seen.text.index(f'\n{title}\n') for title in titles[1:]]
    assert places == sorted(places)
    assert titles[0] in seen.text
    assert '1 of 4 hold' in seen.text
    # Means of the shipped bags in the units of the paper, not of ours.
    assert 'From the shipped simulated recordings: 0.3 with an STD of 0.044 N s/mm' in seen.text
    assert 'From the shipped simulated recordings: k_zz decreases by' in seen.text.replace(
        'kzz', 'k_zz'
    )
    assert [width > 0 for _, width in seen.images] == [True] * 3
    assert (seen.requests, seen.overflow) == ([], 0)
    assert main(['reproduce', 'all', '--json', '-o', str(second)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['holds']
    assert len(found['results']['claims']['claims']) == 4
    assert found['results']['table-1']['lines'][0]['holds']
    one, other = (
        {
            # The footer has the command, which differs.
            path.name: re.sub(b'<footer>.*</footer>', b'', path.read_bytes())
            for path in folder.iterdir()
        }
        for folder in (first, second)
    )
    assert one == other


@pytest.mark.usefixtures('cheap')
def test_false_claims_are_not_failures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Only a table that does not hold is a failure."""
    assert main(['reproduce', 'claims', '-o', str(tmp_path)]) == 0
    assert 'does not hold' in capsys.readouterr().out


def test_recording_of_computed_results_is_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--record with a figure gives a one-line error."""
    assert main(['reproduce', 'figure-6', '--record', str(tmp_path / 'bags')]) == 2
    assert 'nothing to --record' in capsys.readouterr().err
    assert not (tmp_path / 'bags').exists()
    assert {*results.campaigns('all')} == {'friction', 'stiffness'}
