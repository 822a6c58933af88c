# SPDX-License-Identifier: Apache-2.0
"""Studies with scenarios, laws, distributions and tables of the user."""

from __future__ import annotations

from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any

from needle_insertion.cli import main
from needle_ros.errors import ParameterError
from needle_study.engine import order
from needle_study.study import build_study, read_study
import numpy as np
import pytest
from support.studies import check_refused
import yaml

_SCENARIO = """\
from needle_study.scenario import Metric, Scenario, Variable


class Base(Scenario):
    at_once = 10
    variables = {'speed': Variable(2.0, 'm/s', 'initial speed', low=0.0)}
    metrics = {'height': Metric('m', 'largest height'), 'hit': Metric('', 'above 0.2 m')}

    def __init__(self, settings):
        self.gravity = 9.81

    def insert(self, rows, streams):
        for row in rows:
            yield {'height': row['speed'] ** 2 / (2.0 * self.gravity), 'hit': True}

    def replay(self, sample, rng):
        return iter(())
"""

_LAW = """\
from needle_controller import GuideLaw


class Gain(GuideLaw):
    def choose(self, tip, at):
        return -0.3 * (tip - self.target)
"""

_CONES = """\
from scipy import stats


class Cone:
    def __init__(self, scale):
        self.ppf, self.cdf = stats.uniform(0.0, scale).ppf, stats.uniform(0.0, scale).cdf
"""

_STEERED = {'scenario': 'steering', 'settings': {'depth': 0.05, 'step_length': 0.01}}


def _in(folder: Path, monkeypatch: pytest.MonkeyPatch, **modules: str) -> None:
    """Write modules, which this process and its workers import."""
    for name, text in modules.items():
        (folder / f'{name}.py').write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv('PYTHONPATH', str(folder))


@pytest.mark.parametrize(
    ('module', 'text', 'document'),
    [
        ('own_base', _SCENARIO, {'scenario': 'own_base:Base'}),
        # A class whose base class is in another file.
        ('own_root', _SCENARIO, {'scenario': 'own_name:Derived'}),
        ('own_law', _LAW, {**_STEERED, 'settings': {'law': 'own_law:Gain'}}),
        ('own_cone', _CONES, {**_STEERED, 'population': {'skin': {'own_cone:Cone': [1.0]}}}),
    ],
    ids=['scenario', 'base class', 'law', 'distribution'],
)
def test_a_changed_source_file_is_another_study(
    module: str,
    text: str,
    document: Mapping[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The table of the old code is not printed as the result of the new code."""
    derived = 'from own_root import Base\n\n\nclass Derived(Base):\n    pass\n'
    _in(tmp_path, monkeypatch, **{module: text, 'own_name': derived})
    file = tmp_path / 'study.yaml'
    file.write_text(yaml.safe_dump({**document, 'samples': 2}))
    words = ['study', str(file), '-o', str(tmp_path / 'results'), '--workers', '1']
    assert main(words) == 0
    assert main(words) == 0
    capsys.readouterr()
    (tmp_path / f'{module}.py').write_text(f'{text}\n# changed\n')
    assert main(words) == 2
    assert 'belongs to another study; name another folder' in capsys.readouterr().err


def test_code_of_the_packages_is_identified_by_its_version() -> None:
    """A worker with the same versions accepts the study, wherever the packages are installed."""
    population = {'tilt_x': {'scipy.stats:laplace': [0.01, 0.001], 'within': [-0.1, 0.1]}}
    document = {**_STEERED, 'population': population}
    assert 'files' not in build_study(document).document
    named = {**document, 'scenario': 'needle_study.steering:SteeringScenario'}
    assert 'files' not in build_study(named).document


def test_a_worker_with_another_source_file_refuses_the_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _in(tmp_path, monkeypatch, own_there=_SCENARIO)
    given = json.loads(order(build_study({'scenario': 'own_there:Base'})))['study']
    assert build_study(given).document == given
    (tmp_path / 'own_there.py').write_text(f'{_SCENARIO}\n# changed\n')
    with pytest.raises(ParameterError, match=r'^own_there:Base is not the file with which'):
        build_study(given)


@pytest.mark.parametrize(
    ('variable', 'head', 'factor'),
    [
        ('target_x', 'target_x [mm]', 1e-3),
        ('target_x', 'target_x (cm)', 1e-2),
        ('target_x', 'shift_mm', 1e-3),
        ('target_x', 'target_x [inch]', 0.0254),
        ('target_x', 'target_x[1]', 1.0),
        ('target_x', 'target_x', 1.0),
        ('tilt_x', 'tilt_x [deg]', np.pi / 180.0),
        ('slow_time', 'time [ms]', 1e-3),
        ('skin', 'skin [1]', 1.0),
        ('path_noise', 'noise [rad^2/m]', 1.0),
    ],
)
def test_columns_with_a_unit_are_in_si_units(
    variable: str, head: str, factor: float, tmp_path: Path
) -> None:
    """Of a file and of a mapping with its folder; the study of the workers is the same."""
    (tmp_path / 'a.csv').write_text(f'{head},other\n0.0625,1\n0.125,2\n')
    document = {**_STEERED, 'samples': 32, 'population': {variable: {'table': ['a.csv', head]}}}
    file = tmp_path / 'study.yaml'
    file.write_text(yaml.safe_dump(document))
    for study in (read_study(file), build_study(document, tmp_path)):
        drawn = build_study(json.loads(order(study))['study']).draw(0, 32)[variable]
        assert sorted(set(drawn.tolist())) == [factor * 0.0625, factor * 0.125]


@pytest.mark.parametrize(
    ('variable', 'head', 'unit'),
    [('target_x', 'target_x [kg]', 'kg'), ('skin', 'skin [mm]', 'mm'), ('tilt_x', 'a (m)', 'm')],
)
def test_columns_with_an_unknown_unit_are_refused(
    variable: str, head: str, unit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'a.csv').write_text(f'{head}\n0.25\n')
    complaint = f'a.csv: the unit {unit!r} of the column {head!r} is not one of '
    change = {'population': {variable: {'table': ['a.csv', head]}}}
    check_refused({**_STEERED, **change}, complaint, tmp_path, capsys)


def test_tables_of_a_mapping_are_of_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'a.csv').write_text('skin\n1.5\n')
    monkeypatch.chdir(tmp_path)
    for name in ('a.csv', str(tmp_path / 'a.csv')):
        study = build_study({**_STEERED, 'population': {'skin': {'table': [name, 'skin']}}})
        assert study.draw(0, 1)['skin'] == 1.5
