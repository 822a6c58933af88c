# SPDX-License-Identifier: Apache-2.0
"""`needle study`: reproducible tables, and recovery after interruptions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, contextmanager, ExitStack, nullcontext
from functools import partial
import hashlib
import json
from math import sqrt
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
from typing import Any

from benchmarks.kills import kill_again_and_again, kill_workers
from hypothesis import given
from hypothesis import strategies as st
from needle_controller.steering.settings import step_depths
from needle_dynamics import DEFAULT_NEEDLE, find_needle, FloatArray, insert_batch
from needle_identification.bags.bag import read_topic
from needle_insertion.cli import main
from needle_insertion.commands import study as study_command
from needle_insertion.report import study_page as page
from needle_ros.errors import JobError, ParameterError
from needle_ros.process_pool import processes
from needle_study.designs import DESIGNS, RandomDesign, SaltelliDesign, SobolDesign
from needle_study.distribution import Distribution, distribution, KINDS
from needle_study.engine import chunk, compute, dask, order, Results
from needle_study.steering import SteeringScenario
from needle_study.study import build_study, read_study, Study
from needle_study.summary import column, indices, NOISE, probability, quantile, worst
import numpy as np
from pyarrow import parquet
import pytest
from scipy import stats
from support.installed import ROOT
from support.pages import look_at
from support.studies import check_refused
import yaml

#: Small study: few needles, few steps.
SMALL: dict[str, Any] = {
    'scenario': 'steering',
    'samples': 40,
    'seed': 3,
    'settings': {'depth': 0.05, 'step_length': 0.01, 'law': 'springs'},
    'population': {
        'target_x': {'uniform': [-0.002, 0.002]},
        'bending_length': {'lognormal': [1.0, 0.1], 'within': [0.6, 1.6]},
        'tilt_z': {'normal': [0.0, 0.01], 'within': [-0.05, 0.05]},
        'skin': {'gamma': [1.0, 0.2], 'within': [0.0, 3.0]},
        'lost': {'choice': [0.0, 0.1]},
    },
    'correlations': [['bending_length', 'skin', -0.7]],
}


def small(design: str) -> dict[str, Any]:
    """Return the small study with a design, which may take no correlations."""
    correlations = [] if design == SaltelliDesign.name else SMALL['correlations']
    return {**SMALL, 'design': design, 'correlations': correlations}


class Here(Executor):
    """Executor that computes at once in this process."""

    def submit(self, function: Callable[..., Any], /, *words: Any, **options: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*words, **options))
        return future


def here() -> AbstractContextManager[Executor]:
    """Create an executor in this process."""
    return nullcontext(Here())


def checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize('design', DESIGNS)
def test_samples_are_independent_of_chunks(design: str) -> None:
    """Bit-identical, also with correlations."""
    study = build_study(small(design))
    whole = study.rows(0, 13)
    for first, count in ((0, 1), (1, 5), (6, 7)):
        part = study.rows(first, count)
        assert list(part) == list(whole)
        for name, values in part.items():
            assert np.array_equal(values, whole[name][first : first + count], equal_nan=True)


def test_progress_does_not_change_the_samples() -> None:
    study, calls = build_study({**SMALL, 'samples': 60}), list[None]()
    table = study.simulate(progress=lambda: calls.append(None))
    found = table.values
    assert re.match(r'<StudyTable: 60 samples, median miss \S+ m, hit \S+%>', repr(table))
    # At most 50 parts.
    assert len(calls) == 50
    whole = study.rows(0, 60)
    assert list(found) == list(whole)
    for name, values in found.items():
        assert np.array_equal(values, whole[name], equal_nan=True)


@pytest.mark.parametrize(('law', 'count'), [('multi_hypothesis', 5), ('open_loop', 300)])
def test_samples_are_independent_of_their_batch(law: str, count: int) -> None:
    """Bit-identical; open-loop samples are computed in batches of some hundreds."""
    study = build_study({**SMALL, 'settings': {**SMALL['settings'], 'law': law}})
    whole = study.rows(0, count)
    assert np.isfinite(whole['miss']).all()
    for number in (0, count // 2, count - 1):
        for name, values in study.rows(number, 1).items():
            assert np.array_equal(values, whole[name][[number]], equal_nan=True)


def test_errors_of_the_sensor_are_variables() -> None:
    """Sizes of zero change no bit, whatever the times and lengths; others change the insertion."""
    scenario = SteeringScenario({'law': 'springs', 'interval': 2.0})
    at = {'target_x': 2e-3, 'lost': 0.2}
    none = {'slow_time': 0.5, 'distortion_length': 0.02}
    errors = {'slow_noise': 5e-4}, {'dropout_time': 4.0}, {'distortion': 5e-4}
    rows = [scenario.row({**at, **one}) for one in ({}, none, *errors)]
    exact, same, *others = scenario.insert(rows, [np.random.default_rng(1) for _ in rows])
    assert same == exact
    assert all(one['tip_x'] != exact['tip_x'] for one in others)


@pytest.mark.parametrize('radius', [2e-4, 1e-3, 3e-3])
def test_hits_are_misses_up_to_the_hit_radius(radius: float) -> None:
    settings = {**SMALL['settings'], 'law': 'open_loop', 'hit_radius': radius}
    rows = build_study({**SMALL, 'settings': settings}).rows(0, 40)
    assert np.array_equal(rows['hit'], rows['miss'] <= radius)
    assert rows['hit'].any() or radius < 1e-3


@pytest.mark.parametrize('design', sorted({*DESIGNS} - {SaltelliDesign.name}))
def test_samples_follow_distributions_and_correlations(design: str) -> None:
    study = build_study({**SMALL, 'design': design, 'samples': 4096, 'population': {
        'tilt_x': {'normal': [0.01, 0.002], 'within': [-0.1, 0.1]},
        'tilt_z': {'uniform': [-0.02, 0.04]},
        'skin': {'gamma': [2.0, 0.5], 'within': [0.0, 10.0]},
        'bending_length': {'lognormal': [1.2, 0.1], 'within': [0.2, 5.0]},
    }, 'correlations': [['tilt_x', 'tilt_z', 0.8]]})  # fmt: skip
    drawn = study.draw(0, 4096)
    # Five standard errors of 4096 independent samples; the error of Sobol is smaller.
    near = 5.0 / sqrt(4096.0)
    assert drawn['tilt_x'].mean() == pytest.approx(0.01, abs=0.002 * near)
    assert drawn['tilt_x'].std() == pytest.approx(0.002, rel=near)
    assert drawn['tilt_z'].min() > -0.02
    assert drawn['tilt_z'].mean() == pytest.approx(0.01, abs=0.06 / sqrt(12.0) * near)
    assert drawn['skin'].mean() == pytest.approx(2.0, abs=0.5 * near)
    # Relative errors of a deviation of this gamma, and of a median: 0.77 and 1.25 x 0.1 over
    # the root of the number.
    assert drawn['skin'].std() == pytest.approx(0.5, rel=0.77 * near)
    assert np.median(drawn['bending_length']) == pytest.approx(1.2, rel=0.125 * near)
    # Rank correlation of a normal copula: 6 / pi asin(rho / 2).
    ranks = [np.argsort(np.argsort(drawn[name])) for name in ('tilt_x', 'tilt_z')]
    found = np.asarray(np.corrcoef(np.array(ranks)))
    assert found[0, 1] == pytest.approx(6 / np.pi * np.arcsin(0.4), abs=near)
    assert np.corrcoef(drawn['skin'], drawn['tilt_x'])[0, 1] == pytest.approx(0.0, abs=near)


@pytest.mark.parametrize('design', DESIGNS)
def test_samples_are_independent_of_the_order_of_variables(design: str) -> None:
    """A worker receives the study with sorted names; a replay reads the file."""
    given = SMALL['population']
    turned = {name: given[name] for name in reversed(given)}
    for names in (list(given), list(turned)):
        assert names != sorted(names)
    one, other = (build_study({**small(design), 'population': each}) for each in (given, turned))
    whole = one.draw(0, 20)
    for study in (other, build_study(json.loads(order(one))['study'])):
        drawn = study.draw(0, 20)
        for name, values in whole.items():
            assert np.array_equal(drawn[name], values)


def test_groups_of_a_saltelli_design_have_one_variable_in_common() -> None:
    """Or all but one; the noise is one of the variables."""
    study = build_study({**small('saltelli'), 'samples': 160})
    names = list(study.population)
    size = len(names) + 3
    drawn = study.draw(0, 160)
    noise = [study.design.noise(k).random() for k in range(160)]
    values = np.array([noise, *drawn.values()]).T[: 160 // size * size].reshape(-1, size, size - 2)
    first, second = values[:, 0], values[:, 1]
    assert len(np.unique(values[:, :2, 1:3], axis=0)) == len(values)
    for k in range(len(names) + 1):
        # The noise comes first.
        mixed = values[:, 2 + k]
        assert np.array_equal(mixed[:, k], second[:, k])
        assert np.array_equal(np.delete(mixed, k, axis=1), np.delete(first, k, axis=1))


def test_variables_of_a_table_have_values_of_the_same_row(tmp_path: Path) -> None:
    """Each row is equally probable, and the study of the workers needs no file."""
    (tmp_path / 'patients.csv').write_text('age,k,s\n50,0.8,1.5\n60,1.0,1.0\n70,1.2,0.5\n')
    file = tmp_path / 'study.yaml'
    population = {
        'bending_length': {'table': ['patients.csv', 'k']},
        'skin': {'table': ['patients.csv', 's']},
        'tilt_x': {'scipy.stats:laplace': [0.01, 0.001], 'within': [-0.1, 0.1]},
    }
    file.write_text(yaml.safe_dump({**SMALL, 'correlations': [], 'population': population}))
    study = build_study(json.loads(order(read_study(file)))['study'])
    drawn = study.draw(0, 480)
    rows, counts = np.unique(
        np.array([drawn['bending_length'], drawn['skin']]).T, axis=0, return_counts=True
    )
    assert rows.tolist() == [[0.8, 1.5], [1.0, 1.0], [1.2, 0.5]]
    # Of each of the 16 sequences 30 points: a third, plus or minus one.
    assert np.abs(counts - 160).max() <= 16
    # Exact at the probabilities of the design, in the order of names: the table, then the tilt.
    chances = study.design.parts(0, 480)[:, 1]
    np.testing.assert_allclose(
        stats.laplace(0.01, 0.001).cdf(drawn['tilt_x']), chances, atol=1e-12
    )
    # Mean deviation of a Laplace distribution; four standard errors of independent samples.
    assert np.abs(drawn['tilt_x'] - 0.01).mean() == pytest.approx(1e-3, rel=4.0 / sqrt(480.0))
    file.write_text(file.read_text().replace(', s]', ', t]').replace('- s\n', '- t\n'))
    with pytest.raises(ParameterError, match="has no column 't', it has age, k, s"):
        read_study(file)


@pytest.mark.parametrize('samples', [1, 2, 5, 64, 1000, 1025])
def test_latin_design_has_one_sample_per_stratum(samples: int) -> None:
    """In every dimension, and the strata of the dimensions are uncorrelated."""
    names = ('frame_x', 'frame_z', 'tilt_x')
    population = {name: {'uniform': [0.0, 0.5]} for name in names}
    drawn = build_study(
        {'scenario': 'steering', 'samples': samples, 'seed': 8, 'design': 'latin',
         'population': population}
    ).draw(0, samples)  # fmt: skip
    strata = np.array([np.floor(drawn[name] / 0.5 * samples) for name in names])
    assert np.array_equal(np.sort(strata, axis=1), np.tile(np.arange(samples), (3, 1)))
    if samples >= 64:
        # Five standard errors.
        off = np.corrcoef([*strata, np.arange(samples)]) - np.eye(4)
        assert np.abs(off).max() < 5.0 / sqrt(samples)


@pytest.mark.parametrize('correlation', [-0.9, 0.5])
def test_correlations_keep_the_strata_of_a_latin_design(correlation: float) -> None:
    """One sample per stratum in every dimension, and the rank correlation of a normal copula."""
    samples, names = 1000, ('frame_x', 'frame_z', 'tilt_x')
    drawn = build_study(
        {'scenario': 'steering', 'samples': samples, 'seed': 8, 'design': 'latin',
         'population': {name: {'uniform': [0.0, 0.5]} for name in names},
         'correlations': [['frame_x', 'tilt_x', correlation]]}
    ).draw(0, samples)  # fmt: skip
    strata = np.array([np.floor(drawn[name] / 0.5 * samples) for name in names])
    assert np.array_equal(np.sort(strata, axis=1), np.tile(np.arange(samples), (3, 1)))
    found = np.corrcoef(strata)
    expected = 6 / np.pi * np.arcsin(correlation / 2)
    # Five standard errors of a correlation of independent samples.
    near = 5.0 * (1.0 - expected**2) / sqrt(samples)
    assert found[0, 2] == pytest.approx(expected, abs=near)
    assert np.abs(found[1, ::2]).max() < 5.0 / sqrt(samples)


def test_weights_are_relative_probabilities() -> None:
    """Of the values of a choice; equal weights are no weights, to the bit."""
    parts = (np.arange(1000) + 0.5) / 1000
    weighted = distribution('x', {'choice': [3.0, 1.0, 2.0], 'weights': [1, 7, 2]})
    values, counts = np.unique(weighted.quantiles(parts), return_counts=True)
    assert values.tolist() == [1.0, 2.0, 3.0]
    assert counts.tolist() == [700, 200, 100]
    assert distribution('x', {'normal': ['1mm', '2mm']}, 'm').numbers == (1e-3, 2e-3)
    assert distribution('x', {'lognormal': ['1mm', 0.2]}, 'm').numbers == (1e-3, 0.2)
    one, other = (distribution('x', {'choice': [3, 1], **w}) for w in ({}, {'weights': [2, 2]}))
    assert np.array_equal(one.quantiles(parts), other.quantiles(parts))


#: Scenario and metric of the page on studies.
_OWN = '\n'.join(
    re.findall(
        r'^```py\n(from (?:math|needle_study).*?)^```',
        (ROOT / 'docs/howto/study.md').read_text('utf-8'),
        flags=re.DOTALL | re.MULTILINE,
    )
)


def test_page_lists_the_variables_of_the_scenario() -> None:
    page = (ROOT / 'docs/howto/study.md').read_text('utf-8')
    listed = dict[str, tuple[str, ...]]()
    for row in re.findall(r'^\| (`[^|]*) \| (\S+) \| (\S+) \| (.*) \|$', page, re.MULTILINE):
        listed |= dict.fromkeys(re.findall(r'`(\w+)`', row[0]), row[1:])
    variables = SteeringScenario({}).variables
    assert {name: listed[name] for name in variables} == {
        name: (f'{one.default:g}', one.unit, one.meaning) for name, one in variables.items()
    }


def test_unknown_distribution_names_the_valid_ones() -> None:
    with pytest.raises(ParameterError, match=rf"{', '.join(KINDS)}, .* got 'gama'$"):
        Distribution('gama', (1.0, 0.2)).quantiles(np.array([0.5]))


def test_own_scenario_of_a_file_outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its address; in this process and in workers the same table."""
    (tmp_path / 'own_throw.py').write_text(_OWN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    study = build_study(
        {'scenario': 'own_throw:Throw', 'samples': 100, 'settings': {'gravity': 1.62},
         'population': {'speed': {'triangular': [0.1, 0.5, 1.5]}}}
    )  # fmt: skip
    rows = study.rows(0, 100)
    assert np.allclose(rows['height'], rows['speed'] ** 2 / 3.24, rtol=1e-15)
    results = Results(tmp_path / 'results', study)
    compute(results, lambda: processes(2), 2, lambda _: None)
    for name, values in rows.items():
        assert np.array_equal(column(results.table, name), values)
    settings = {**SMALL['settings'], 'law': 'open_loop'}
    own = build_study({**SMALL, 'scenario': 'own_throw:Lateral', 'settings': settings}).rows(0, 5)
    assert np.array_equal(own['lateral'], np.hypot(own['tip_x'], own['tip_z']))


@pytest.mark.parametrize(
    ('body', 'reason'),
    [
        ("yield {'height': 1.0}", 'the metrics of each of 10 samples by name, got 1'),
        ('yield from 20 * [{}]', 'the metrics of each of 10 samples by name, got 20'),
        ('return None', 'of each of 10 samples by name, got 0'),
        ('yield from 10 * [1.0]', 'the metrics of a sample by name, got 1.0'),
        (
            "yield from len(rows) * [{'hit': None}]",
            'the metric hit must be a finite number, or NaN, got None',
        ),
        (
            "yield from len(rows) * [{'height': 'high'}]",
            "height must be a finite number, or NaN, got 'high'",
        ),
        (
            "yield from 9 * [{}] + [{'heigth': 1.0}]",
            "the metric 'heigth' is not one of metrics: height, hit",
        ),
        ("yield {'height': float('inf')}", 'height must be a finite number, or NaN, got inf'),
        ("yield {'height': -float('inf')}", 'height must be a finite number, or NaN, got -inf'),
        ("yield {'hit': 0.5}", 'the metric hit is yes or no: 1, 0 or NaN, got 0.5'),
        ("yield {'hit': 7}", 'the metric hit is yes or no: 1, 0 or NaN, got 7'),
        # At the first sample, before the others.
        ("yield {'hit': 2}\n        raise AssertionError", 'hit is yes or no'),
    ],
)
def test_faulty_results_of_an_own_scenario_are_one_line(
    body: str,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With its class; no table is written."""
    name = f'own_{tmp_path.name}'
    faulty = f'class Faulty(Throw):\n    def insert(self, rows, streams):\n        {body}\n'
    (tmp_path / f'{name}.py').write_text(_OWN + faulty)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(study_command, 'processes', lambda _: here())
    file = tmp_path / 'study.yaml'
    file.write_text(f'scenario: {name}:Faulty\nsamples: 20\n')
    assert main(['study', str(file), '-o', str(tmp_path / 'out'), '--workers', '1']) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith('error: Faulty.insert')
    assert reason in said[0]
    assert not (tmp_path / 'out/samples.parquet').exists()


def test_metrics_that_are_sometimes_missing_are_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether a part of the samples has all values, and whether they are Booleans."""
    some = 'class Some(Throw):\n    def insert(self, rows, streams):\n        for row in rows:\n'
    some += "            yield {'hit': True} if row['speed'] > 0.5 else {}\n"
    (tmp_path / 'own_some.py').write_text(_OWN + some)
    monkeypatch.syspath_prepend(tmp_path)
    study = build_study(
        {'scenario': 'own_some:Some', 'samples': 40, 'design': 'random',
         'population': {'speed': {'uniform': [0.0, 1.0]}}}
    )  # fmt: skip
    results = Results(tmp_path / 'results', study)
    for k in range(40):
        results.add(k, study.rows(k, 1))
    results.complete()
    values = column(results.table, 'hit')
    assert np.isnan(values).any()
    assert np.nanmin(values) == 1.0


@given(
    kind=st.sampled_from(sorted(KINDS)),
    first=st.floats(0.1, 10.0),
    second=st.floats(0.01, 5.0),
    parts=st.lists(st.floats(1e-6, 1.0 - 1e-6), min_size=2, max_size=20),
    cut=st.tuples(st.floats(0.1, 0.45), st.floats(0.55, 0.9)),
)
def test_quantiles_are_monotone_and_within_the_range(
    kind: str, first: float, second: float, parts: list[float], cut: tuple[float, float]
) -> None:
    """For all kinds of distributions, also truncated."""
    # Low, mode and high of a triangle; a, b, low and high of a beta distribution.
    numbers = {
        'uniform': [first, first + second],
        'triangular': [first - second, first, first + 2.0 * second],
        'beta': [first, 0.1 + second, -second, first],
    }.get(kind, [first, second])
    free = distribution('x', {kind: numbers})
    values = free.quantiles(np.sort(parts))
    # The inverses of the incomplete gamma and beta functions are monotone up to rounding.
    assert (np.diff(values) >= -1e-12 * np.abs(numbers).max()).all()
    low, high = free.quantiles(np.array(cut)).tolist()
    if not low < high:
        return
    within = distribution('x', {kind: numbers, 'within': [low, high]})
    some = within.quantiles(np.array(parts))
    assert ((some >= low) & (some <= high)).all()
    # The median of the truncated distribution, up to rounding in the far tail.
    (middle,) = within.quantiles(np.array([0.5]))
    assert middle == pytest.approx(free.quantiles(np.array([sum(cut) / 2]))[0], rel=1e-6)


def test_table_is_independent_of_workers_and_chunks(tmp_path: Path) -> None:
    """The bytes are equal in one process and with one or two workers."""
    study = build_study(SMALL)
    sums = set()
    for name, executor, workers in (
        ('here', here, 1), ('two', lambda: processes(2), 2), ('one', lambda: processes(1), 1),
    ):  # fmt: skip
        results = Results(tmp_path / name, study)
        seen: list[int] = []
        compute(results, executor, workers, seen.append)
        assert sum(seen) == study.samples
        assert results.missing() == []
        sums.add(checksum(results.table))
    assert len(sums) == 1
    assert np.array_equal(column(results.table, 'sample'), np.arange(study.samples))


def test_killed_workers_do_not_change_the_table(tmp_path: Path) -> None:
    """Four workers are killed at random times, most during their start; no process hangs."""
    document = {**SMALL, 'samples': 600}
    file, folder = tmp_path / 'study.yaml', tmp_path / 'killed'
    file.write_text(yaml.safe_dump(document))
    whole = Results(tmp_path / 'whole', build_study(document))
    compute(whole, here, 1, lambda _: None)
    words = [sys.executable, '-m', 'needle_insertion.cli', 'study', str(file), '--workers', '2']
    # Up to 2 s between kills, about the time until a worker starts its first chunk.
    losses = kill_workers([*words, '-o', str(folder)], folder, 4, 2.0, np.random.default_rng(1))
    assert losses.killed >= 2
    assert (losses.errors, losses.hangs) == (0, 0)
    assert checksum(folder / 'samples.parquet') == checksum(whole.table)


def test_killed_studies_are_resumed(tmp_path: Path) -> None:
    """Four kills with SIGKILL; no chunk is computed twice, and the table is the same."""
    document = {**SMALL, 'samples': 600, 'settings': {**SMALL['settings'], 'step_length': 0.005}}
    file = tmp_path / 'study.yaml'
    file.write_text(yaml.safe_dump(document))
    words = [sys.executable, '-m', 'needle_insertion.cli', 'study', str(file), '--workers', '1']
    folder, rng = tmp_path / 'killed', np.random.default_rng(1)
    whole = Results(tmp_path / 'whole', build_study(document))
    compute(whole, here, 1, lambda _: None)
    kills = kill_again_and_again([*words, '-o', str(folder)], folder, 4, rng)
    assert kills.killed >= 2
    assert kills.twice == 0
    assert kills.left == 0
    assert main(['study', str(file), '-o', str(folder), '--workers', '1']) == 0
    assert checksum(folder / 'samples.parquet') == checksum(whole.table)
    assert not (folder / 'parts').exists()


def test_page_and_replay_match_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The page shows the values of the table; the bag of a sample ends at its tip."""
    file, folder = tmp_path / 'study.yaml', tmp_path / 'results'
    file.write_text(yaml.safe_dump(SMALL, sort_keys=False))
    words = ['study', str(file), '-o', str(folder), '--workers', '1']
    assert main(words) == 0
    said = capsys.readouterr().out
    assert re.search(r'^Samples +40 ', said, re.MULTILINE)
    assert re.search(r'^Hit +[\d.]+% +95 %: ', said, re.MULTILINE)
    assert f'wrote {tmp_path}' in said
    seen = look_at(folder / 'study.html')
    assert seen.requests == []
    table = folder / 'samples.parquet'
    chance = probability([column(table, 'hit')])
    for expected in (f'{chance.value:.1%}', 'bending_length', 'Median miss', 'seed 3, sobol'):
        assert expected in seen.text
    assert [width > 300 for _, width in seen.images] == [True, True]
    assert main([*words, '--replay', '7']) == 0
    assert 'the same numbers as in the table' in capsys.readouterr().out
    *_, (_, last) = read_topic(folder / 'sample_7', '/tip_deflection')
    assert last.point.x == column(table, 'tip_x')[7]
    assert last.point.z == column(table, 'tip_z')[7]
    # A repeated command does not change the table.
    before = checksum(table)
    assert main(words) == 0
    assert checksum(table) == before
    assert main([*words, '--replay', '40']) == 2
    assert '--replay must be from 0 to 39' in capsys.readouterr().err


def test_pages_limit_the_number_of_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Quantiles and pictures use the first samples, probabilities and worst samples use all."""
    results = Results(tmp_path / 'results', build_study(SMALL))
    compute(results, here, 1, lambda _: None)
    asked: set[int | None] = set()

    def limited(table: Path, name: str, most: int | None = None) -> FloatArray:
        asked.add(most)
        return column(table, name, most)

    monkeypatch.setattr(page, '_MOST', 8)
    monkeypatch.setattr('needle_study.summary.column', limited)
    page.write_study(results, tmp_path / 'study.html')
    assert asked == {8}
    text = (tmp_path / 'study.html').read_text(encoding='utf-8')
    assert 'Of the first 8 samples.' in text
    last = int(np.nanargmax(column(results.table, 'miss')))
    assert last >= 8
    assert f'>{last}<' in text


def page_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: str, **document: Any) -> Any:
    """Write the page of a scenario of the page on studies; return its cards and its text."""
    name = f'own_{tmp_path.name}'
    (tmp_path / f'{name}.py').write_text(f'{_OWN}\n\nclass One(Throw):\n{more}')
    monkeypatch.syspath_prepend(tmp_path)
    results = Results(tmp_path / 'out', build_study({'scenario': f'{name}:One', **document}))
    compute(results, here, 1, lambda _: None)
    cards = page.write_study(results, tmp_path / 'study.html')
    return cards, (tmp_path / 'study.html').read_text(encoding='utf-8')


@pytest.mark.parametrize(
    ('design', 'kind'), [('sobol', ' alone'), ('saltelli', ', with interactions')]
)
def test_primary_metric_of_yes_or_no_is_a_probability(
    design: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside the hits, without a median; shares of its variance say of what kind they are."""
    more = """\
    metrics = {'success': Metric('', 'above 1 m'), **Throw.metrics}
    variables = {**Throw.variables, 'wind': Variable(0.0, 'm/s', 'wind')}

    def insert(self, rows, streams):
        for row, found in zip(rows, super().insert(rows, streams)):
            yield {**found, 'success': found['height'] + row['wind'] > 1.0}
"""
    population = {'speed': {'uniform': [2.0, 6.0]}, 'wind': {'uniform': [-0.1, 0.1]}}
    document = {'samples': 1600, 'design': design, 'population': population}
    cards, text = page_of(tmp_path, monkeypatch, more, **document)
    names = [name for name, *_ in cards]
    variances = [f'Variance by {name}{kind}' for name in ('speed', 'wind')]
    assert names[:4] == ['Samples', 'Success', 'Hit', variances[0]]
    assert variances[1] in names
    # Speeds above sqrt(2 g) = 4.43 m/s; the standard error of 1600 samples is 1.2 %.
    assert float(cards[1][1].rstrip('%')) == pytest.approx(39.3, abs=3.0)
    assert 'Fraction of success over the two most' in text
    assert 'edian success' not in text
    assert 'Distribution of success' not in text


def test_samples_without_a_value_are_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the number of those that were refused."""
    more = """\
    metrics = {**Throw.metrics, 'refused': Metric('', 'not simulated')}

    def insert(self, rows, streams):
        return [{'refused': k < 3} for k, _ in enumerate(rows)]
"""
    cards, text = page_of(tmp_path, monkeypatch, more, samples=10)
    words = 'no sample has a value', '3 refused'
    assert cards[1:] == [('Hit', *words), ('Median height', *words)]
    assert 'nan' not in text.partition('Probabilities')[0].partition('<dl')[2]


def test_medians_state_the_samples_without_a_value(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the terminal, on the page and in Python."""
    more = """\
    metrics = {**Throw.metrics, 'refused': Metric('', 'not simulated'),
               'stopped': Metric('', 'stopped before the end')}

    def insert(self, rows, streams):
        for row, found in zip(rows, super().insert(rows, streams)):
            speed = row['speed']
            yield {'refused': 1} if speed < 1.1 else {'stopped': 1} if speed < 1.3 else found
"""
    document = {'samples': 100, 'population': {'speed': {'uniform': [1, 2]}}}
    cards, text = page_of(tmp_path, monkeypatch, more, **document)
    speeds = column(tmp_path / 'out/samples.parquet', 'speed')
    counts = [int(np.sum(one)) for one in (speeds >= 1.3, speeds < 1.1)]
    counts.append(100 - sum(counts))
    words = '; of {} of 100 samples: {} refused, {} stopped'.format(*counts)
    ((_, _, note),) = [one for one in cards if one[0] == 'Median height']
    assert note.endswith(words)
    assert words in text
    (name,) = [path.stem for path in tmp_path.glob('own_*.py')]
    table = build_study({'scenario': f'{name}:One', **document}).simulate()
    said = ' m of {} samples, .*, {} refused, {} stopped>'.format(*counts)
    assert re.search(rf'median height \S+{said}', repr(table))


@pytest.mark.filterwarnings('error')
def test_table_of_refused_samples_has_no_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**SMALL['settings'], 'law': 'multi_hypothesis'}
    population = {'target_x': 0.1}
    table = build_study(
        {**SMALL, 'settings': settings, 'population': population, 'correlations': [], 'samples': 3}
    ).simulate()
    assert repr(table) == '<StudyTable: 3 samples, no value of miss, hit 0.0%, 3 refused>'


def test_columns_of_a_table_have_their_units(tmp_path: Path) -> None:
    """In the schema of the file, as in the names of Python."""
    study = build_study({**SMALL, 'samples': 2})
    results = Results(tmp_path / 'results', study)
    compute(results, here, 1, lambda _: None)
    schema = parquet.read_schema(results.table)
    heads = [f'{one.name} [{one.metadata[b"unit"].decode()}]' for one in schema]
    assert heads == [*study.simulate().columns()]
    assert {'target_x [m]', 'lost [1]', 'miss [m]', 'hit [1]', 'load [N]'} <= {*heads}


def test_page_of_one_sample_has_no_intervals(tmp_path: Path) -> None:
    results = Results(tmp_path / 'results', build_study({**SMALL, 'samples': 1}))
    compute(results, here, 1, lambda _: None)
    page.write_study(results, tmp_path / 'study.html')
    text = (tmp_path / 'study.html').read_text(encoding='utf-8')
    assert re.search('Median miss.*?>too few samples<', text, re.DOTALL)


def test_open_loop_equals_a_guide_at_rest(tmp_path: Path) -> None:
    """The batch gives the same tips as single insertions."""
    free = {**SMALL, 'settings': {**SMALL['settings'], 'law': 'open_loop'}}
    rows = build_study(free).rows(0, 20)
    still = {**SMALL, 'settings': {**SMALL['settings'], 'guide_limit': 0.0}}
    same = build_study(still).rows(0, 20)
    # A guide at position 0 and a missing guide differ by rounding.
    np.testing.assert_allclose(rows['tip_x'], same['tip_x'], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(rows['tip_z'], same['tip_z'], rtol=0.0, atol=1e-9)


def test_sampled_needle_has_the_bevel_of_each_layer() -> None:
    """Without population, open loop equals an insertion with the nominal constants."""
    constants = {'bevel_load': [0.3, 0.0], 'layer_depths': [0.03], 'layer_stiffnesses': [2e4]}
    settings = {'depth': 0.1, 'step_length': 0.01, 'law': 'open_loop', 'constants': constants}
    study = build_study(
        {'scenario': 'steering', 'settings': settings, 'population': {'path_noise': 0.0}}
    )
    needle, steering, _ = find_needle(DEFAULT_NEEDLE).changed(constants)
    tip = insert_batch([needle], [steering], step_depths(0.1, 0.01), workers=1)[0, -1]
    # The largest load instead in both layers moves the tip by 4 mm; the study adds rounding only.
    assert study.rows(0, 1)['tip_z'][0] == pytest.approx(tip[2], rel=1e-9)


def test_intervals_have_their_nominal_coverage() -> None:
    """Probabilities near 0 and in the middle, and quantiles, with known true values."""
    rng = np.random.default_rng(5)
    for truth in (0.01, 0.3, 0.95):
        found = [probability([(rng.random(300) < truth).astype(float)]) for _ in range(1000)]
        held = np.mean([one.low <= truth <= one.high for one in found])
        # Coverage of the Wilson interval is within some percent of 95 for any probability.
        assert 0.925 < held < 0.99
    for part, exact in ((0.5, 0.0), (0.9, 1.2815515655446004), (0.99, 2.3263478740408408)):
        for n in (1, 5, 20, 200):
            near = [quantile(rng.standard_normal(n), part) for _ in range(1000)]
            held = np.mean([one.low <= exact <= one.high for one in near])
            # Four standard errors below 95 %; intervals of few samples are conservative.
            assert held > 0.95 - 4.0 * sqrt(0.95 * 0.05 / 1000)
        assert held < 0.99
    # No upper end if no order statistic has the required probability.
    assert quantile(rng.standard_normal(367), 0.99).high == np.inf
    assert np.isfinite(quantile(rng.standard_normal(368), 0.99).high)


def ishigami(x: FloatArray) -> FloatArray:
    """Return a function of (n, 3) numbers in (0, 1) with known indices."""
    a, b, c = np.pi * (2.0 * x.T - 1.0)
    return np.asarray(np.sin(a) + 7.0 * np.sin(b) ** 2 + 0.1 * c**4 * np.sin(a))


def product(x: FloatArray) -> FloatArray:
    """Return the G-function of (n, 4) numbers in (0, 1)."""
    a = np.array([0.0, 1.0, 4.5, 9.0])
    return np.asarray(np.prod((np.abs(4.0 * x - 2.0) + a) / (1.0 + a), axis=1))


#: Partial variances of the variables alone and with interactions, and the variance, without noise:
#: T. Ishigami, T. Homma, ISUMA 1990, and A. Saltelli, I. M. Sobol', RESS 50, 1995.
ISHIGAMI = (
    (0.5 * (1.0 + 0.1 * np.pi**4 / 5.0) ** 2, 49.0 / 8.0, 0.0),
    (
        0.5 * (1.0 + 0.1 * np.pi**4 / 5.0) ** 2 + 0.01 * np.pi**8 * 8.0 / 225.0,
        49.0 / 8.0,
        0.01 * np.pi**8 * 8.0 / 225.0,
    ),
    49.0 / 8.0 + 0.1 * np.pi**4 / 5.0 + 0.01 * np.pi**8 / 18.0 + 0.5,
)
_ALONE = 1.0 / 3.0 / (1.0 + np.array([0.0, 1.0, 4.5, 9.0])) ** 2
PRODUCT = (
    tuple(_ALONE),
    tuple(_ALONE * np.prod(1.0 + _ALONE) / (1.0 + _ALONE)),
    float(np.prod(1.0 + _ALONE) - 1.0),
)


@pytest.mark.parametrize('noise', [0.0, 1.0])
@pytest.mark.parametrize(
    ('function', 'known'), [(ishigami, ISHIGAMI), (product, PRODUCT)], ids=['ishigami', 'product']
)
def test_intervals_of_sobol_indices_hold(
    function: Callable[[FloatArray], FloatArray], known: Any, noise: float
) -> None:
    """Of 95 %, alone and with interactions, without noise and with noise as one more variable."""
    alone, together, variance = known
    count, d = 100, len(alone)
    whole = (1.0 + noise) * variance
    true = np.array([[noise * variance, *alone], [noise * variance, *together]]) / whole
    held = np.zeros(true.shape)
    for seed in range(count):
        design = SaltelliDesign(256 * (d + 3), seed, np.eye(d))
        y = function(design.parts(0, design.samples))
        if noise:
            scores = [design.noise(k).standard_normal() for k in range(design.samples)]
            y += np.sqrt(noise * variance) * np.array(scores)
        names = list('wxyz'[:d])
        population = {name: distribution(name, {'uniform': [0, 1]}) for name in names}
        study = Study(SteeringScenario({}), design, population, {})
        found = indices(y, {}, study)
        assert list(found) == ['noise', *names]
        for k, one in enumerate(found.values()):
            for row, estimate in enumerate(one):
                held[row, k] += estimate.low <= true[row, k] <= estimate.high
    # Three standard errors of 100 intervals; indices of 0 are at an end of their interval.
    inside = held[(true > 0.0) & (true < 1.0)] / count
    assert inside.min() > 0.95 - 3.0 * sqrt(0.95 * 0.05 / count)
    assert 0.93 < inside.mean() < 0.99


def test_replicates_give_the_interval_of_a_sobol_design() -> None:
    """Narrower than of independent samples where the sequence helps, with the same coverage."""
    held, width = np.zeros((2, 2)), np.zeros((2, 2))
    for seed in range(300):
        for k, design in enumerate((SobolDesign, RandomDesign)):
            x = design(1024, seed, np.eye(2)).parts(0, 1024)
            total = x.sum(axis=1)
            one = design(1024, seed, np.eye(2))
            found = probability([(total < 0.5).astype(np.float64)], one)
            middle = quantile(total, 0.5, one)
            for row, (estimate, true) in enumerate(((found, 0.125), (middle, 1.0))):
                held[row, k] += estimate.low <= true <= estimate.high
                width[row, k] += estimate.high - estimate.low
    # Three standard errors of 300 intervals.
    assert held.min() / 300.0 > 0.95 - 3.0 * sqrt(0.95 * 0.05 / 300.0)
    assert (width[:, 0] < 0.5 * width[:, 1]).all()


@pytest.mark.parametrize('part', [0.5, 0.9])
@pytest.mark.parametrize('samples', [256, 1000, 1024])
@pytest.mark.parametrize('dimensions', [1, 2])
def test_quantiles_of_a_sobol_design_have_sensible_intervals(
    part: float, samples: int, dimensions: int
) -> None:
    """Of exp(u) and of u + v: each sequence may have the same number of values on each side."""
    true = np.exp(part) if dimensions == 1 else 2.0 - sqrt(2.0 - 2.0 * part)
    found, count = [], 300
    for seed in range(count):
        design = SobolDesign(samples, seed, np.eye(dimensions))
        x = design.parts(0, samples)
        found.append(quantile(np.exp(x[:, 0]) if dimensions == 1 else x.sum(axis=1), part, design))
    value, low, high, _ = np.transpose(found)
    assert ((low <= value) & (value <= high)).all()
    held = np.mean((low <= true) & (true <= high))
    assert held > 0.95 - 3.0 * sqrt(0.95 * 0.05 / count)
    half = 0.5 * np.mean(high - low) / value.std()
    # Of a normal distribution 1.96. Without scatter at the quantile of one variable the interval
    # has the nearest values of all sequences.
    assert 1.6 < half < 8.0


@pytest.mark.parametrize('part', [0.5, 0.95])
@pytest.mark.parametrize('more', [1, 4])
def test_quantiles_of_independent_samples_hold_in_replicates(part: float, more: int) -> None:
    """As noise gives them, from the least number of samples on."""
    samples, rng = round(more * 32 / (1.0 - part)), np.random.default_rng(2)
    design, true = SobolDesign(samples, 1, np.eye(1)), stats.expon.ppf(part)
    found = [quantile(rng.exponential(size=samples), part, design) for _ in range(1000)]
    held = np.mean([one.low <= true <= one.high for one in found])
    assert abs(held - 0.95) < 3.0 * sqrt(0.95 * 0.05 / 1000) + 0.005
    width = np.mean([one.high - one.low for one in found])
    # Student's interval of 16 replicates, with the density at the quantile. The root of a variance
    # of 15 degrees of freedom has a mean lower by 1.7 %, and the ends are at samples.
    normal = sqrt(part / (1.0 - part) / samples)
    assert width == pytest.approx(2.0 * stats.t.ppf(0.975, 15) * normal, rel=0.05)


def test_variance_fractions_of_a_sum_are_exact() -> None:
    """For y = 2 a + b with equal variances: 0.8 and 0.2, and 0 for an independent variable."""
    rng = np.random.default_rng(2)
    columns = dict(zip('abc', rng.standard_normal((3, 20_000)), strict=True))
    y = 2.0 * columns['a'] + columns['b']
    y[::100] = np.nan
    study = build_study({**SMALL, 'design': 'random'})
    found = indices(y, columns, study)
    for name, fraction in {'a': 0.8, 'b': 0.2, 'c': 0.0}.items():
        first, total = found[name]
        assert first.value == pytest.approx(fraction, abs=0.01)
        # The jackknife of a smooth statistic, and ranges of finite width.
        assert first.low - 0.01 <= fraction <= first.high + 0.01
        assert total is None
    # Rounding of a mean is not variance.
    assert (
        indices(np.full(1000, 1.23e-5), {'a': columns['a'][:1000]}, study)['a'].first.high == 0.0
    )
    assert indices(y[:199], {'a': columns['a'][:199]}, study) == {}


def test_values_without_variance_have_no_cause() -> None:
    study = build_study({**small('saltelli'), 'samples': 400})
    found = indices(np.zeros(400), {}, study)
    assert NOISE in found
    assert {value for one in found.values() for value in (*one.first[:3], *one.total[:3])} == {0.0}


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(('design', 'count'), [('random', 1), ('saltelli', 1), ('saltelli', 8)])
def test_a_single_event_determines_no_cause(design: str, count: int) -> None:
    """Without its part there is no variance; all 8 samples of a group are in the same part."""
    study = build_study({**small(design), 'samples': 1000})
    y = np.zeros(1000)
    y[:count] = 1.0
    found = indices(y, study.draw(0, 1000), study)
    assert found
    for one in found.values():
        for index in (one.first, one.total or one.first):
            assert 0.0 == index.low <= index.value <= index.high == 1.0


def test_worst_samples_do_not_depend_on_batches() -> None:
    y = np.random.default_rng(2).standard_normal(20_000)
    y[::100] = np.nan
    found = list(np.argsort(np.where(np.isnan(y), np.inf, -y))[:2])
    assert worst([y], 2) == worst(np.array_split(y, 7), 2) == found


def test_maps_include_samples_at_their_edges() -> None:
    """Two variables with two values each have all samples at an edge."""
    study, rng = build_study(SMALL), np.random.default_rng(3)
    over = {name: rng.integers(0, 2, 4000).astype(float) for name in ('tilt_z', 'skin')}
    values = over['tilt_z'] + 2.0 * over['skin']
    [picture] = page._map('miss', study.scenario.metrics['miss'], values, over, study)
    cells = picture.figure.axes[0].collections[0].get_array()
    seen = np.ma.masked_invalid(cells).compressed()
    assert sorted(seen) == pytest.approx([0.0, 1e3, 2e3, 3e3])


def test_quantiles_at_zero_and_one_are_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scrambled Sobol sequence may contain an exact 0, whose normal score is infinite."""
    study = build_study(SMALL)
    for part in (0.0, 1.0):
        monkeypatch.setattr(SobolDesign, 'uniform', lambda *_, at=part: np.full((3, 5), at))
        for name, values in study.draw(0, 3).items():
            variable = study.scenario.variables[name]
            assert ((values >= variable.low) & (values <= variable.high)).all()


def test_a_study_is_locked_by_one_process(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, folder = tmp_path / 'study.yaml', tmp_path / 'results'
    file.write_text(yaml.safe_dump(SMALL))
    results = Results(folder, build_study(SMALL))
    words = ['study', str(file), '-o', str(folder), '--workers', '1']
    with results.alone():
        assert main(words) == 1
    assert capsys.readouterr().err == f'error: another process computes {folder}\n'
    assert main(words) == 0


def flip(path: Path, where: float) -> None:
    """Flip a bit at a fraction of a file."""
    data = bytearray(path.read_bytes())
    data[int(where * len(data))] ^= 4
    path.write_bytes(data)


@pytest.mark.parametrize(
    'damage',
    [
        lambda part: part.write_bytes(b''),
        lambda part: part.write_bytes(part.read_bytes()[:-1]),
        lambda part: part.rename(part.with_name(part.name.replace('16-', '17-'))),
        lambda part: part.with_name(part.name.replace('0-', '7-', 1)).write_bytes(
            part.read_bytes()
        ),
        *(partial(flip, where=where) for where in (0.01, 0.2, 0.5, 0.7, 0.9, 0.99)),
    ],
    ids=['empty', 'cut', 'other number', 'twice', *(f'bit {k}' for k in range(6))],
)
def test_damaged_parts_are_computed_again(
    tmp_path: Path, damage: Callable[[Path], object]
) -> None:
    """Also a part with other samples than in its name, and overlapping parts."""
    study = build_study(SMALL)
    whole, broken = Results(tmp_path / 'whole', study), Results(tmp_path / 'broken', study)
    compute(whole, here, 1, lambda _: None)
    for first in (0, 16):
        broken.add(first, study.rows(first, 16))
    (part,) = (tmp_path / 'broken' / 'parts').glob('0000000000-*.arrow')
    damage(part)
    compute(broken, here, 1, lambda _: None)
    assert checksum(broken.table) == checksum(whole.table)


def test_flipped_bits_of_a_table_are_detected(tmp_path: Path) -> None:
    """At any place of the file."""
    study = build_study(SMALL)
    results = Results(tmp_path / 'whole', study)
    compute(results, here, 1, lambda _: None)
    whole = results.table.read_bytes()
    for where in np.linspace(0.0, 0.999, 150):
        results.table.write_bytes(whole)
        flip(results.table, where)
        with pytest.raises(JobError, match='is damaged; remove it to compute it again'):
            Results(tmp_path / 'whole', study)
    results.table.write_bytes(whole)
    assert not Results(tmp_path / 'whole', study).missing()


def test_damaged_tables_and_other_versions_are_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, folder = tmp_path / 'study.yaml', tmp_path / 'results'
    file.write_text(yaml.safe_dump(SMALL))
    words = ['study', str(file), '-o', str(folder), '--workers', '1']
    assert main(words) == 0
    table = folder / 'samples.parquet'
    whole = table.read_bytes()
    capsys.readouterr()
    table.write_bytes(whole[:-100])
    assert main(words) == 1
    assert f'{table} is damaged; remove it to compute it again' in capsys.readouterr().err
    table.unlink()
    assert main(words) == 0
    assert table.read_bytes() == whole
    # A study of other versions must not be resumed: the versions change the samples.
    table.unlink()
    begun = json.loads((folder / 'study.json').read_text())
    begun['versions']['numpy'] = '1.26.4'
    (folder / 'study.json').write_text(json.dumps(begun))
    capsys.readouterr()
    assert main(words) == 1
    assert f'{folder} has another version: numpy {np.__version__} and numpy 1.26.4;' in (
        capsys.readouterr().err
    )
    with pytest.raises(JobError, match='a worker has another version: numpy'):
        chunk(json.dumps(begun), 0, 1)
    for content in (b'\xff', b'{}', b'3', b'[1'):
        (folder / 'study.json').write_bytes(content)
        assert main(words) == 2
        assert 'study.json is not a study; name another folder' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'scenario': 'fishing'}, 'must be one of steering, insertion, plan, or module:Class'),
        ({'scenario': 'no_module:Class'}, 'cannot be imported: No module'),
        ({'scenario': 'json:JSONDecoder'}, 'is not a subclass of Scenario'),
        ({'population': {'skin': {'triangular': [1, 3, 2]}}}, 'must have low <= mode <= high'),
        ({'population': {'skin': {'beta': [1, 0, 0, 1]}}}, 'a and b from 0.1 to 10000'),
        ({'population': {'skin': {'choice': [1, 2], 'weights': [1]}}}, 'each value, got (1.0,)'),
        ({'population': {'skin': {'choice': [1, 2], 'weights': [1, 0]}}}, 'a positive number for'),
        ({'population': {'skin': {'normal': [1, 2], 'weights': [1]}}}, 'only a choice has'),
        ({'sample': 3}, "unknown parameter 'sample'"),
        ({'samples': 0}, 'samples must be an integer from 1 to'),
        ({'seed': True}, 'seed must be an integer from 0'),
        ({'design': 'grid'}, 'design must be one of sobol, random, latin, saltelli, got'),
        ({'population': {'tilt': 1}}, "population: unknown parameter 'tilt'; "),
        ({'population': {'tilt_x': 'big'}}, "population: tilt_x: 'big' is not an angle"),
        ({'population': {'tip_noise': {'lognormal': ['1um', '1um']}}}, "'1um' is not a number"),
        ({'population': {'tip_noise': {'uniform': ['1um', '1N']}}}, "'1N' is not a length"),
        ({'population': {'tilt_x': [1]}}, 'population: tilt_x must be a number or one of'),
        ({'population': {'skin': {'uniform': ['1mm', 2]}}}, "'1mm' is not a number"),
        ({'population': {'tilt_x': {'cauchy': [0, 1]}}}, 'tilt_x must be one of {uniform:'),
        ({'population': {'tilt_x': {'normal': [0]}}}, 'normal takes [mean, standard deviation]'),
        ({'population': {'tilt_x': {'normal': [0, -1]}}}, 'must have standard deviation > 0'),
        ({'population': {'tilt_x': {'uniform': [1, 0]}}}, 'uniform must have low < high'),
        ({'population': {'tilt_x': {'normal': [0, float('nan')]}}}, 'takes finite numbers'),
        ({'population': {'target_x': {'uniform': [-4, 4]}}}, 'finite and in [-0.2, 0.2] m, and w'),
        ({'population': {'target_z': 0.21}}, 'target_z must be finite and in [-0.2, 0.2] m'),
        ({'population': {'tilt_x': {'normal': [0, 0.2]}}}, 'in [-0.5, 0.5] rad, and would'),
        ({'population': {'skin': {'uniform': [-1, 1]}}}, 'skin must be finite and in [0, 1000]'),
        ({'population': {'skin': {'normal': [1, 0.1], 'within': [90, 91]}}}, 'with values of the'),
        ({'population': {'bending_length': {'choice': [1, 0, 1]}}}, 'finite and in [0.1, 10]'),
        ({'population': {'skin': {'gamma': [1, 1.0e+90]}}}, 'gamma must have mean > 0, standard'),
        ({'population': {'tilt_x': 10**400}}, 'tilt_x must be a number or one of'),
        ({'population': {'tilt_x': {'normal': [0, 10**400]}}}, 'takes finite numbers up to 1e+1'),
        ({'population': {'tip_noise': {'lognormal': [1, 1000]}}}, 'tip_noise must be finite'),
        ({'correlations': [['skin', 'tilt_z', 1]]}, 'value between -1 and 1'),
        ({'correlations': [['skin', 'tilt_z', 0.5], ['tilt_z', 'skin', 0.1]]}, 'skin twice'),
        ({'settings': {'depth': 0.3}}, 'settings.depth must be <='),
        ({'settings': {'step_length': 1e-9}}, 'increase settings.step_length'),
        ({'settings': {'turns': 0.7}}, 'settings.turns must be a whole number, got 0.7'),
        ({'settings': {'guide_limit': 0}}, 'settings: guide_limit and turns cannot both be 0'),
        ({'settings': {'guide_limit': 0, 'law': 'broyden'}}, 'settings: guide_limit cannot be 0'),
        ({'settings': {'law': 'roll_to_target'}}, 'settings: turns cannot be 0'),
        ({'correlations': [['skin', 'tilt', 0.5]]}, 'correlations takes [[name, name, value'),
        ({'correlations': [['skin', 'tilt_z', 2]]}, 'correlations takes [[name, name, value'),
        ({'correlations': [['skin', 'tilt_z', 0.9], ['tilt_z', 'target_x', 0.9],
                           ['skin', 'target_x', -0.9]]}, 'correlations are inconsistent'),
        ({'settings': {'deep': 1}}, "settings: unknown parameter 'deep'; did you mean 'depth'?"),
        ({'settings': {'depth': -1}}, 'settings.depth must be finite, > 0 m, got -1'),
        ({'settings': {'needle': 'bone'}}, 'needle must be one of'),
        ({'settings': {'law': 'me'}}, 'law must be one of multi_hypothesis'),
        ({'settings': {'needle': [1]}}, 'needle must be one of'),
        ({'settings': {'law': [1]}}, 'law must be one of multi_hypothesis'),
        ({'settings': {'constants': 1}}, 'settings: constants must be names with values, got 1'),
        ({'settings': {'constants': {1: 1}}}, "settings.constants: unknown parameter '1'"),
        ({'settings': {'constants': {'tissue_stifness': 3e4}}}, "mean 'tissue_stiffness'?"),
        ({'seed': 2**63}, f'seed must be an integer from 0 to {2**62}, got {2**63}'),
        ({'settings': {'prior': 1}}, 'settings: prior must be names with values, got 1'),
        ({'settings': {'prior': {'nose': 1}}}, "unknown parameter 'settings.prior.nose'"),
        ({'settings': 1}, 'settings must be names with values, got 1'),
        ({'population': [1]}, 'population must be names with values, got [1]'),
        ({'scenario': ['steering']}, "or module:Class, got ['steering']"),
        ({'design': ['sobol']}, 'design must be one of sobol, random, latin, saltelli, got'),
        ({'design': 'saltelli'}, 'design saltelli takes no correlations'),
        ({'population': {'skin': {'no_module:Class': [1]}}}, 'cannot be imported: No module'),
        ({'population': {'skin': {'scipy.stats:norm': [1, 2, 3]}}}, 'must have ppf and cdf: '),
        ({'population': {'skin': {'json:loads': [1]}}}, 'must have ppf and cdf: '),
        ({'population': {'skin': {'table': ['a.csv']}}}, 'table takes [file, column]'),
        ({'population': {'skin': {'table': ['a.csv', 'skin']}}}, 'a.csv cannot be read: '),
        ({'population': {'skin': {'rows': [], 'of': 'a'}}}, 'rows must have values'),
        ({'population': {'skin': {'rows': [1], 'of': 'a'}, 'lost': {'rows': [0, 0], 'of': 'a'}}},
         'variables of the same table must have as many rows'),
        ({'population': {'tilt_x': {'normal': [0, 0.01]}, 'skin': 1,
                         'tilt_z': {'rows': [0.01, 0.02], 'of': 'tilt_x'}}},
         "name of a variable without a table (skin, tilt_x), got 'tilt_x'"),
    ],
)  # fmt: skip
def test_invalid_studies_are_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Any, complaint: str
) -> None:
    """A one-line error names the file, and nothing is written."""
    check_refused({**SMALL, **change}, complaint, tmp_path, capsys)


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('a,b\n1,2,3\n', "a.csv has no column 'skin', it has a, b"),
        ('', 'a.csv must have a header and rows below it'),
        ('skin,a\n', 'a.csv must have a header and rows below it'),
        (
            'skin,a\n1,2\n0,9,0,8\n',
            "row 3 must have 2 cells as the header, also for the column 'skin', got 4",
        ),
        ('a,skin\n1,2\n1\n', 'a.csv: row 3 must have 2 cells as the header, also for the'),
        ('skin,a\n,2\n', "a.csv: row 2, column 'skin' must be a finite number, got ''"),
        ('skin,a\n1,2\nnan,2\n', "a.csv: row 3, column 'skin' must be a finite number, got 'nan'"),
        ('skin,a,skin\n1,2,3\n', "a.csv has 2 columns 'skin'"),
        (f'skin\n"{"1" * 200_000}"\n', 'a.csv cannot be read: field larger than'),
    ],
)
def test_invalid_tables_are_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, complaint: str
) -> None:
    (tmp_path / 'a.csv').write_text(text)
    change = {'population': {'skin': {'table': ['a.csv', 'skin']}}}
    check_refused({**SMALL, **change}, complaint, tmp_path, capsys)


def test_a_changed_needle_file_is_another_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Results of two needles are not mixed."""
    needle, file = tmp_path / 'mine.yaml', tmp_path / 'study.yaml'
    needle.write_text('length: 0.15\n')
    settings = {**SMALL['settings'], 'needle': str(needle)}
    file.write_text(yaml.safe_dump({**SMALL, 'settings': settings}))
    words = ['study', str(file), '-o', str(tmp_path / 'results'), '--workers', '1']
    assert main(words) == 0
    capsys.readouterr()
    needle.write_text('length: 0.16\n')
    assert main(words) == 2
    assert 'belongs to another study; name another folder' in capsys.readouterr().err


def test_a_study_without_samples_is_replaced(tmp_path: Path) -> None:
    """But not while another process computes it."""
    other = build_study({**SMALL, 'seed': 4})
    with (
        Results(tmp_path / 'results', build_study(SMALL)).alone(),
        pytest.raises(ParameterError, match='belongs to another study'),
    ):
        Results(tmp_path / 'results', other)
    results = Results(tmp_path / 'results', other)
    compute(results, here, 1, lambda _: None)
    assert len(column(results.table, 'miss')) == other.samples


def test_internal_key_is_not_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_refused({**SMALL, 'qqqq': 1}, 'valid: correlations, design, pop', tmp_path, capsys)
    file = tmp_path / 'study.yaml'
    file.write_text(yaml.safe_dump({**SMALL, 'qqqq': 1}))
    assert main(['study', str(file)]) == 2
    assert 'files' not in capsys.readouterr().err


def test_unusable_files_and_folders_are_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / 'study.yaml'
    file.write_text(yaml.safe_dump(SMALL))
    assert main(['study', str(tmp_path / 'none.yaml')]) == 2
    assert 'none.yaml cannot be read: No such file' in capsys.readouterr().err
    (tmp_path / 'other' / 'results').mkdir(parents=True)
    assert main(['study', str(file), '-o', str(tmp_path / 'other')]) == 2
    assert 'exists and is not a study; name another folder' in capsys.readouterr().err
    third = Results(tmp_path / 'third', build_study({**SMALL, 'seed': 4}))
    third.add(0, third.study.rows(0, 16))
    assert main(['study', str(file), '-o', str(tmp_path / 'third')]) == 2
    assert 'belongs to another study; name another folder' in capsys.readouterr().err
    assert main(['study', str(file), '-o', '/proc/x']) == 2
    assert capsys.readouterr().err.startswith('error: /proc/x cannot be written: ')
    assert main(['study', str(file), '-o', str(tmp_path / 'x'), '--workers', '0']) == 2
    assert '--workers must be >= 1' in capsys.readouterr().err


def test_a_full_disk_is_a_one_line_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Completed parts remain, and the study is resumed when there is space."""
    study = build_study(SMALL)
    results = Results(tmp_path / 'results', study)
    room = resource_limit(2000)
    with room, pytest.raises(JobError, match=r'cannot be written: .*File too large'):
        compute(results, here, 1, lambda _: None)
    files = {path.name for path in (tmp_path / 'results').rglob('*') if path.is_file()}
    assert not [name for name in files if name.endswith(('.tmp', '.part'))]
    compute(results, here, 1, lambda _: None)
    assert len(column(results.table, 'miss')) == study.samples


@contextmanager
def resource_limit(size: int) -> Any:
    """Limit the size of files of this process [bytes]."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_killed_scheduler_is_a_one_line_error(tmp_path: Path) -> None:
    """Completed parts remain."""
    from distributed import Client

    study, file = build_study({**SMALL, 'samples': 400}), tmp_path / 'scheduler.json'
    whole, results = Results(tmp_path / 'whole', study), Results(tmp_path / 'dask', study)
    compute(whole, here, 1, lambda _: None)
    words = ['--host', '127.0.0.1', '--no-dashboard', '--scheduler-file', str(file)]
    with ExitStack() as stack:
        scheduler, _ = (
            stack.enter_context(ended(subprocess.Popen([sys.executable, '-m', *command])))
            for command in (
                ['distributed.cli.dask_scheduler', *words, '--port', '0'],
                ['distributed.cli.dask_worker', *words, '--nthreads', '1', '--no-nanny'],
            )
        )
        client = stack.enter_context(Client(scheduler_file=str(file), timeout=60))
        with pytest.raises(JobError, match='the cluster has lost a chunk of the study'):
            compute(results, partial(dask, client), 1, lambda _: scheduler.kill())
    assert results.missing() != [(0, 400)]
    compute(results, here, 1, lambda _: None)
    assert checksum(results.table) == checksum(whole.table)


@contextmanager
def ended(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_a_dask_cluster_survives_a_killed_worker(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table is the same with two worker processes; a missing scheduler is reported."""
    from distributed import Client, LocalCluster

    study = build_study({**SMALL, 'samples': 200})
    whole = Results(tmp_path / 'whole', study)
    compute(whole, here, 1, lambda _: None)
    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, host='127.0.0.1', dashboard_address=None
        ) as cluster,
        Client(cluster) as client,
    ):
        results, pids = Results(tmp_path / 'dask', study), client.run(os.getpid)
        came: list[int] = []

        def kill(count: int) -> None:
            if not came:
                os.kill(next(iter(pids.values())), signal.SIGKILL)
            came.append(count)

        compute(results, partial(dask, client), 2, kill)
        address = cluster.scheduler_address
        file = tmp_path / 'study.yaml'
        file.write_text(yaml.safe_dump({**SMALL, 'samples': 200}))
        words = ['study', str(file), '--scheduler', address, '-o', str(tmp_path / 'command')]
        assert main(words) == 0
    assert sum(came) == 200
    sums = {checksum(tmp_path / name / 'samples.parquet') for name in ('whole', 'dask', 'command')}
    assert len(sums) == 1
    capsys.readouterr()
    empty = ['study', str(file), '-o', str(tmp_path / 'empty')]
    monkeypatch.setattr(study_command, '_PATIENCE', 1)
    with LocalCluster(n_workers=0, host='127.0.0.1', dashboard_address=None) as cluster:
        assert main([*empty, '--scheduler', cluster.scheduler_address]) == 1
    assert 'has no workers' in capsys.readouterr().err
    gone = ['study', str(file), '--scheduler', address, '-o', str(tmp_path / 'gone')]
    assert main(gone) == 1
    said = capsys.readouterr().err
    assert f'error: no Dask scheduler at {address}' in said
