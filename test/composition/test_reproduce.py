"""The tables anew from the shipped recordings, and verdicts that can fail."""

from functools import cache
import json
from pathlib import Path
import re
from typing import Any

from needle_identification import ParameterEstimate, Statistic
from needle_insertion.cli import main
from needle_insertion.commands.reproduce import RESULTS
from needle_insertion.experiment.protocol import SHIPPED_BAGS
from needle_insertion.experiment.truth import _stiffness, Comparison, Coverage
from needle_insertion.paper import figures, identified, mismatch, results
from needle_insertion.paper.claims import judge
from needle_insertion.paper.identified import (
    IdentifiedTable,
    identify_table,
    Line,
)
from needle_insertion.paper.tables import FORCE_LEVELS, TABLE_1, TABLE_2
from needle_insertion.report import controllability
from needle_insertion.report.content import Section
import numpy as np
import pytest
from support.pages import look_at


@pytest.fixture(scope='module')
def tables() -> dict[str, IdentifiedTable]:
    """Return what the shipped bags give."""
    return {name: identify_table(name) for name in identified.TABLES}


@pytest.fixture
def once(monkeypatch: pytest.MonkeyPatch, tables: dict[str, IdentifiedTable]) -> None:
    """Have the shipped bags identified once for all tests."""
    monkeypatch.setattr(results, 'identify_table', lambda name, _recorded: tables[name])


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the map of controllability with fewer points."""
    monkeypatch.setattr(controllability, 'DEPTHS', 9)
    monkeypatch.setattr(controllability, 'DEFLECTIONS', 7)


@pytest.mark.usefixtures('once')
def test_table_1_comes_out_of_the_shipped_bags(capsys: pytest.CaptureFixture[str]) -> None:
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
def test_table_2_comes_out_of_the_shipped_bags(capsys: pytest.CaptureFixture[str]) -> None:
    """Every entry at every level is in its intervals, and k_a, from 20 places."""
    assert main(['reproduce', 'table-2']) == 0
    text = capsys.readouterr().out
    assert 'DOES NOT HOLD' not in text
    lines = text.splitlines()
    for entry in TABLE_2:
        for force in FORCE_LEVELS:
            assert sum(line.startswith(f'{entry} at {force:g} N') for line in lines) == 1
    assert any(line.startswith('k_a at 1.5 N [N/m^2]') and '520' in line for line in lines)
    assert 'of 400' in lines[-1]


def line(mean: float, deviation: float | None, count: int = 20) -> Line:
    """Return a made-up line: published are 10 ± 1."""
    reach = 2.1 * (deviation or 1.0) / np.sqrt(count)
    found = Statistic(
        name='a', symbol='a', unit='N', mean=mean, deviation=deviation, error=0.2,
        interval=(mean - reach, mean + reach), count=count,
    )  # fmt: skip
    return Line(quantity='a [N]', paper=(10.0, 1.0), found=found, truth=Coverage(19, 20))


@pytest.mark.parametrize(
    ('mean', 'deviation', 'holds'),
    [
        (10.1, 1.0, True),
        (11.0, 1.0, False),
        (9.0, 1.0, False),
        # Half and twice the STD are out of what chi-squared allows 20 to scatter.
        (10.0, 0.5, False),
        (10.0, 2.0, False),
        (10.0, None, True),
    ],
)
def test_a_line_holds_if_mean_and_std_are_in_their_intervals(
    mean: float, deviation: float | None, holds: bool
) -> None:
    """Each of the two can break it; of a single recording the STD is not known."""
    judged = line(mean, deviation)
    assert judged.holds == holds
    assert ('DOES NOT HOLD' in judged.row) == (not holds)


def test_the_interval_of_the_std_is_that_of_chi_squared() -> None:
    """It holds the STD of the population in 95 of 100 samples of it."""
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
def test_fewer_intervals_than_the_least_are_improbable(trials: int) -> None:
    """If each holds its truth in 95 %, fewer than `least` do so once in a hundred at most."""
    least = Coverage(known=trials).least
    held = np.random.default_rng(trials).binomial(trials, 0.95, size=20000)
    # Three standard errors of a share of 0.01 in 20000.
    assert np.mean(held < least) <= 0.01 + 3.0 * np.sqrt(0.01 / 20000)
    assert np.mean(held <= least) >= 0.01 - 3.0 * np.sqrt(0.01 / 20000)


def test_an_interval_counts_where_the_truth_is_known() -> None:
    """Held, missed, not determined, not known."""
    held = ParameterEstimate(
        name='a', symbol='a', unit='N', value=1.0, error=0.5, interval=(0.0, 2.0), determined=True
    )
    unknown = ParameterEstimate(name='a', symbol='a', unit='N')
    pairs = ((held, 1.5), (held, 2.5), (unknown, 1.0), (held, None))
    compared = [Comparison(estimate=e, truth=t) for e, t in pairs]
    assert Coverage.of(compared) == Coverage(held=1, known=3)


def test_the_truth_of_a_place_is_that_of_the_level() -> None:
    """The nearest level counts, not what lies between; without a configuration it is unknown."""
    truth = {'indenter.force_levels': [1.1, 1.2], 'indenter.stiffness_zz': [900.0, 700.0]}
    assert _stiffness(truth, 'k_zz', 1.198) == 700.0
    assert _stiffness(truth, 'k_xx', 1.1) is None
    assert _stiffness(None, 'k_zz', 1.1) is None


def test_without_recordings_there_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is missing, and where to get it, with exit status 2."""
    monkeypatch.setattr(identified, 'SHIPPED_BAGS', tmp_path)
    assert main(['reproduce', 'table-2']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert 'holds no stiffness_*' in said


def test_a_table_that_does_not_hold_ends_in_status_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three recordings of one kind are not the population of the paper."""
    for k, bag in enumerate(sorted(SHIPPED_BAGS.glob('friction_*'))[:2]):
        (tmp_path / f'friction_{k}').symlink_to(bag)
    monkeypatch.setitem(TABLE_1, 'coulomb_friction', (5.6, 0.0374))
    monkeypatch.setattr(identified, 'SHIPPED_BAGS', tmp_path)
    assert main(['reproduce', 'table-1', '--json']) == 1
    assert not json.loads(capsys.readouterr().out)['holds']


def test_every_result_can_be_asked_for() -> None:
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
def test_a_result_is_a_page_that_a_browser_shows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str, pictures: int, words: list[str]
) -> None:
    """It is whole, fits a telephone, asks for nothing outside, and says what the terminal says."""
    assert main(['reproduce', what, '-o', str(tmp_path)]) == 0
    assert f'wrote {tmp_path}/reproduce.html' in capsys.readouterr().out
    seen = look_at(tmp_path / 'reproduce.html')
    for word in words:
        assert word in seen.text
    assert [width > 0 for _, width in seen.images] == [True] * pictures
    assert seen.requests == []
    assert seen.overflow == 0


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch, once: Any, coarse: Any) -> None:
    """Have all results, but few runs behind them."""
    figure = figures.FIGURES['figure-4']
    study = cache(lambda: mismatch.study(8))
    monkeypatch.setattr(results, '_study', study)
    few = ('table_3', 'linear', 'reading_of_table_1', 'not_zero')
    entries = [entry for entry in judge._entries() if entry['name'] in few]
    monkeypatch.setattr(judge, '_entries', lambda: entries)
    monkeypatch.setattr(
        figures, 'section',
        lambda: Section(
            title='Figures 4 to 8', paragraphs=(), pictures=(figure().picture,)
        ),
    )  # fmt: skip


@pytest.mark.usefixtures('cheap')
def test_all_is_one_page_with_every_part(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parts in order, claims judged by what the bags gave, and the same bytes each time."""
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
    assert 'From the shipped simulated recordings: k_zz falls by' in seen.text.replace(
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
            # The command differs, and is said at the end.
            path.name: re.sub(b'<footer>.*</footer>', b'', path.read_bytes())
            for path in folder.iterdir()
        }
        for folder in (first, second)
    )
    assert one == other


@pytest.mark.usefixtures('cheap')
def test_a_claim_that_does_not_hold_is_a_finding(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only a table that does not come out is a failure."""
    assert main(['reproduce', 'claims', '-o', str(tmp_path)]) == 0
    assert 'does not hold' in capsys.readouterr().out


def test_a_computed_result_cannot_be_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A recording for a figure is rejected in one line."""
    assert main(['reproduce', 'figure-6', '--record', str(tmp_path / 'bags')]) == 2
    assert 'nothing to --record' in capsys.readouterr().err
    assert not (tmp_path / 'bags').exists()
    assert {*results.campaigns('all')} == {'friction', 'stiffness'}
