# SPDX-License-Identifier: Apache-2.0
"""The scripts of examples/ and docs/notebooks run and print the expected results."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
import re
import runpy
import subprocess
import sys

from matplotlib import pyplot as plt
import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES, NOTEBOOKS = ROOT / 'examples', ROOT / 'docs/notebooks'

#: Required output of each script, as a pattern.
PRINTED = {
    'anatomy': r'tumor: target, 3\.0 ml',
    'aiming': r'steered: 0\.0\d mm from the target\nopen loop: 6\.\d\d mm',
    'batch': r'median \d+\.\d mm, 95 % of them between',
    'inference': r'bending length: intervals of 95 % hold 9\d\.\d % of the true values',
    'fit_from_arrays': r'coulomb_friction: 0\.50\d* N',
    'observer': r'1\.00 s: estimate -?0\.0\d\d mm, true -?0\.000 mm',
    'own_controller': r'own law: 0\.280 mm short of the target',
    'plot': r'wrote insertion\.png',
    'steering': r'tip at \(0\.00, 100\.00, -3\.0\d\) mm',
    'simulate': r'depth at the end: 28\.1\d mm',
}


#: Required output of each notebook, as a pattern; its tolerance is that of the shown digits.
CELLS = {
    '1_own_recordings': r'warnings: none\ncoulomb_friction: 0\.55\d+ N, 95 % interval 0\.5',
    '2_own_needle': r"unknown parameter 'lenght'; did you mean 'length'\?",
    '3_aiming': r'estimated bending length: 11\d % of the nominal value',
    '4_own_law': r'own law: \+0\.280 mm from the target',
    '5_studies': r'steered: hit 9\d % \(8\d to 9\d\), median miss 0\.2\d mm',
    '6_own_robot': r'slide from 160\.00 mm to 120\.\d\d mm\n.*\n.*no position of the joint',
}

#: Optional dependency of a script, which is skipped without it.
NEEDS = {'inference': 'sbi'}

#: Scripts run by `test_hardware.py`, `test_own_law.py` and below.
ELSEWHERE = {'robot_driver', 'steering_law', 'test_own_node'}


@pytest.mark.parametrize('name', sorted({path.stem for path in EXAMPLES.glob('*.py')} - ELSEWHERE))
def test_example_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The script runs alone in an empty folder."""
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr('sys.argv', [name])
    runpy.run_path(str(EXAMPLES / f'{name}.py'), run_name='__main__')
    assert re.search(PRINTED[name], capsys.readouterr().out)


def test_own_node_is_tested_as_documented() -> None:
    words = ['-p', 'no:cacheprovider', '-q', 'examples/test_own_node.py']
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )
    assert '1 passed' in done.stdout, done.stdout


def test_readme_lists_every_example() -> None:
    page = (EXAMPLES / 'README.md').read_text(encoding='utf-8')
    assert set(re.findall(r'\]\((\w+)\.py\)', page)) == {
        path.stem for path in EXAMPLES.glob('*.py')
    }


@pytest.mark.parametrize('name', CELLS)
def test_notebook_runs(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The notebook runs in its folder, draws, and prints the expected results."""
    monkeypatch.chdir(NOTEBOOKS)
    runpy.run_path(str(NOTEBOOKS / f'{name}.py'), run_name='__main__')
    assert plt.get_fignums()
    plt.close('all')
    assert re.search(CELLS[name], capsys.readouterr().out)


def test_notebooks_import_public_names() -> None:
    """Every name of our packages is in the `__all__` of its root."""
    assert {path.stem for path in NOTEBOOKS.glob('*.py')} == set(CELLS)
    found = {
        (node.module, alias.name)
        for path in NOTEBOOKS.glob('*.py')
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('needle_')
        for alias in node.names
    }
    assert len(found) > 20
    assert [one for one in found if one[1] not in import_module(one[0]).__all__] == []
