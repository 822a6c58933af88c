# SPDX-License-Identifier: Apache-2.0
"""Files of a release: changelog of REP-132, dependencies of pixi, workflows."""

from __future__ import annotations

import ast
from itertools import chain
from pathlib import Path
import re
from typing import Any

from catkin_pkg.changelog import get_changelog_from_path
from docutils.core import publish_string
from needle_insertion import cli
import pytest
from tools.changelog import written
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / '.github/workflows').glob('*.yml'))

#: Names in conda-forge that differ from the names in PyPI.
CONDA = {'matplotlib': 'matplotlib-base'}

#: Not in conda-forge.
FROM_PYPI = {'mcap', 'rosbags'}


def requirements() -> dict[str, list[str]]:
    """Return the requirements of setup.py: by extra, and '' for the library."""
    tree = ast.parse((ROOT / 'setup.py').read_text())
    words = [node for node in ast.walk(tree) if isinstance(node, ast.keyword)]
    (library,) = (word.value for word in words if word.arg == 'install_requires')
    (extras,) = (word.value for word in words if word.arg == 'extras_require')
    assert isinstance(extras, ast.Dict)
    found = {'': library, **dict(zip(map(ast.unparse, extras.keys), extras.values, strict=True))}
    return {
        # Without the names of other lists.
        name.strip("'"): [
            str(item.value)
            for item in getattr(value, 'elts', [])
            if isinstance(item, ast.Constant)
        ]
        for name, value in found.items()
    }


def bounds(lines: list[str]) -> dict[str, str]:
    """Return the lower bound of each requirement."""
    return {name.lower(): f'>={bound}' for name, _, bound in (s.partition('>=') for s in lines)}


# Of catkin_pkg.
@pytest.mark.filterwarnings('ignore:nodes.Node.traverse:PendingDeprecationWarning')
def test_changelogs_agree(tmp_path: Path) -> None:
    """CHANGELOG.rst has each release, is valid, and is read by the tools of ROS."""
    path = ROOT / 'CHANGELOG.rst'
    text = path.read_text('utf-8')
    assert written((ROOT / 'CHANGELOG.md').read_text('utf-8'), 'needle_insertion') == text
    publish_string(text, writer_name='null', settings_overrides={'halt_level': 2})
    changes = get_changelog_from_path(str(path), 'needle_insertion')
    releases = re.findall(r'^## (\d\S*) - (\S+)', (ROOT / 'CHANGELOG.md').read_text(), re.M)
    assert releases
    for version, date in releases:
        assert f'{changes.get_date_of_version(version):%Y-%m-%d}' == date
        assert changes.get_content_of_version(version)


def test_changelog_has_one_line_for_each_change() -> None:
    """Of releases only, with section and subject, and without marks of Markdown."""
    text = (
        '# Changelog\n\n## Unreleased\n\n- Later.\n\n## 1.2.0 - 2026-01-02\n\n### Added\n\n'
        'Model:\n\n- A `b_c` of\n  [d](e.md) f_g.\n- H.\n\n### Fixed\n\n- I.\n'
    )
    assert written(text, 'p').splitlines()[3:] == [
        '',
        '1.2.0 (2026-01-02)',
        '------------------',
        '* Added, Model: A ``b_c`` of d f\\_g.',
        '* Added, Model: H.',
        '* Fixed: I.',
    ]


def test_pixi_has_the_requirements_of_the_package() -> None:
    """With the same lower bounds; `launch` is not in the wheels of ROS."""
    tomllib = pytest.importorskip('tomllib', reason='Python 3.11')
    manifest: dict[str, Any] = tomllib.loads((ROOT / 'pixi.toml').read_text())
    conda, pypi = manifest['dependencies'], manifest['pypi-dependencies']
    wanted = bounds(requirements()[''])
    for name, bound in wanted.items():
        assert (pypi if name in FROM_PYPI else conda)[CONDA.get(name, name)] == bound
    ros = {name: bound for name, bound in conda.items() if name.startswith('ros-')}
    assert ros == bounds(requirements()['ros']) | {'ros-jazzy-launch-ros': '*'}
    assert len(conda) + len(pypi) == len(wanted) + len(ros) + len(
        ['python', 'setuptools', 'needle_insertion']
    )


def test_workflows_name_existing_commands() -> None:
    """Extras, modules of tools, and commands of `needle`, also in the Dockerfile."""
    extras = requirements().keys()
    lines = (ROOT / 'Dockerfile').read_text().splitlines()
    for path in WORKFLOWS:
        jobs = yaml.safe_load(path.read_text())['jobs'].values()
        steps = chain.from_iterable(job['steps'] for job in jobs)
        lines += chain.from_iterable(step.get('run', '').splitlines() for step in steps)
        for job in jobs:
            assert set(job.get('strategy', {}).get('matrix', {}).get('ros', [])) <= extras
    text = '\n'.join(lines)
    for names in re.findall(r'(?:\.|/src)\[([a-z,]+)\]', text):
        assert set(names.split(',')) <= extras
    for module in re.findall(r'-m (tools\.\w+)', text):
        assert (ROOT / f'{module.replace(".", "/")}.py').is_file()
    commands = re.findall(r'\bneedle ([a-z]+)([^<\\&|\n]*)', text)
    assert {name for name, _ in commands} >= {'run', 'simulate', 'compile'}
    for name, options in commands:
        if name in cli.COMMANDS:
            cli._parser(name, cli._load(name)).parse_args([name, *options.split()])
