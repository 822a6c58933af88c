# SPDX-License-Identifier: Apache-2.0
"""The scripts of examples/ run and print the expected results."""

from __future__ import annotations

from pathlib import Path
import re
import runpy

import pytest

EXAMPLES = Path(__file__).parents[1] / 'examples'

#: Required output of each script, as a pattern.
PRINTED = {
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


#: Optional dependency of a script, which is skipped without it.
NEEDS = {'inference': 'sbi'}

#: Scripts run by `test_hardware.py` and `test_own_law.py`.
ELSEWHERE = {'robot_driver', 'steering_law'}


@pytest.mark.parametrize('name', sorted({path.stem for path in EXAMPLES.glob('*.py')} - ELSEWHERE))
def test_example_runs(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The script runs alone in an empty folder."""
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr('sys.argv', [name])
    runpy.run_path(str(EXAMPLES / f'{name}.py'), run_name='__main__')
    assert re.search(PRINTED[name], capsys.readouterr().out)


def test_readme_lists_every_example() -> None:
    page = (EXAMPLES / 'README.md').read_text(encoding='utf-8')
    assert set(re.findall(r'\]\((\w+)\.py\)', page)) == {
        path.stem for path in EXAMPLES.glob('*.py')
    }
