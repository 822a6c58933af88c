# SPDX-License-Identifier: Apache-2.0
"""Without ROS 2 the library and its commands work, and all others name what to install."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys
import xml.etree.ElementTree as ET

from needle_insertion.nodes import NODES
from needle_ros.errors import missing_ros
import pytest
from reproduction.protocol import SHIPPED_BAGS
from support.installed import ROOT

MANIFEST = ET.parse(ROOT / 'package.xml').getroot()  # noqa: S314

#: Python modules of ROS 2 that the nodes import.
MODULES = {
    item.text
    for item in MANIFEST.iter('exec_depend')
    if not item.text.startswith(('python3-', 'mcap-'))
}

#: Import of a machine without them, executed at the start of Python.
BLOCK = f"""
import sys
from importlib.abc import MetaPathFinder

class Missing(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {MODULES}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Missing())
"""

INSTALL = "pip install 'needle_insertion[ros]', or source the setup file of an installed ROS 2"


def run(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, without ROS 2."""
    (folder / 'sitecustomize.py').write_text(BLOCK)
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=folder,
        env={**os.environ, 'PYTHONPATH': f'{folder}:{ROOT}'},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


def test_every_module_of_ros_is_known() -> None:
    for module in MODULES:
        assert INSTALL in missing_ros(ModuleNotFoundError(name=module), 'needle run')
    with pytest.raises(ModuleNotFoundError, match='pyarrow'):
        missing_ros(ModuleNotFoundError('no pyarrow', name='pyarrow'), 'needle study')


@pytest.mark.parametrize(
    'words',
    [
        ('run',),
        ('watch',),
        ('demo',),
        ('experiment', 'friction', 'bags'),
        ('reproduce', 'table-1', '--record', 'bags'),
    ],
    ids=' '.join,
)
def test_commands_with_nodes_name_what_to_install(tmp_path: Path, words: tuple[str, ...]) -> None:
    """One line, and nothing is written."""
    ended = run(tmp_path, '-m', 'needle_insertion.cli', *words)
    assert (ended.returncode, ended.stdout) == (1, '')
    (line,) = ended.stderr.splitlines()
    assert line.startswith(f'error: needle {words[0]} needs ROS 2 (no module ')
    assert line.endswith(INSTALL)
    assert [path.name for path in tmp_path.iterdir()] == ['sitecustomize.py']


@pytest.mark.parametrize('name', NODES)
def test_nodes_name_what_to_install(tmp_path: Path, name: str) -> None:
    """The programs that pip installs."""
    start = f'import sys; sys.argv = ["needle-{name}"]; from needle_insertion.nodes import main; '
    ended = run(tmp_path, '-c', f'{start} main()')
    assert (ended.returncode, ended.stdout) == (1, '')
    (line,) = ended.stderr.splitlines()
    assert line.startswith(f'error: needle-{name} needs ROS 2 (no module ')
    assert line.endswith(INSTALL)


@pytest.mark.parametrize(
    'words',
    [
        ('simulate', '--needle', 'phantom', '--duration', '0.01', '-o', 'run.csv'),
        ('identify', 'friction', SHIPPED_BAGS / 'friction_01'),
        ('inspect', SHIPPED_BAGS / 'friction_01'),
        ('verify', SHIPPED_BAGS / 'friction_01'),
        ('steer', '--target', '4mm,100mm,-2mm'),
        ('reproduce', 'table-3'),
        ('study', '--help'),
    ],
    ids=lambda words: words[0],
)
def test_commands_of_the_library_work(tmp_path: Path, words: tuple[object, ...]) -> None:
    ended = run(tmp_path, '-m', 'needle_insertion.cli', *words)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout


@pytest.mark.parametrize(
    'package',
    [
        'needle_dynamics',
        'needle_controller',
        'needle_identification',
        'needle_study',
        'needle_planning',
    ],
)
def test_packages_of_the_library_are_imported(tmp_path: Path, package: str) -> None:
    ended = run(tmp_path, '-c', f'import {package}')
    assert (ended.returncode, ended.stderr) == (0, '')
