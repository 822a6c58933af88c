# SPDX-License-Identifier: Apache-2.0
"""Package for colcon, pip and rosdep."""

import ast
import json
import os
from pathlib import Path
import re
import shlex
import shutil
import signal
import subprocess
import sys
import sysconfig
import venv
import xml.etree.ElementTree as ET

from catkin_pkg.package import InvalidPackage, parse_package_string
from lxml import etree
from needle_insertion.nodes import NODES
import pytest
from reproduction.protocol import SHIPPED_BAGS
from support.installed import ROOT
from support.ros_graph import RosGraph
import yaml

DATA = ROOT / 'test/data'
PATH = f'{Path(sys.executable).parent}:{os.environ["PATH"]}'
#: Without PYTHONPATH, so that the installed package is not hidden by the source tree.
ENVIRONMENT = {**os.environ, 'PATH': PATH, 'PYTHONPATH': ''}
MANIFEST = ET.parse(ROOT / 'package.xml').getroot()  # noqa: S314

#: rosdep keys by imported module, if they differ from the module name.
KEYS = {
    'aiohttp': 'python3-aiohttp',
    'argcomplete': 'python3-argcomplete',
    # Installed with mcap.
    'lz4': 'mcap-ros2-support',
    'zstandard': 'mcap-ros2-support',
    'jinja2': 'python3-jinja2',
    # Installed with jinja2.
    'markupsafe': 'python3-jinja2',
    'matplotlib': 'python3-matplotlib',
    'mcap': 'mcap-ros2-support',
    'numba': 'python3-numba',
    'numpy': 'python3-numpy',
    'rosbags': 'python3-rosbags-pip',
    'scipy': 'python3-scipy',
    'tqdm': 'python3-tqdm',
    'yaml': 'python3-yaml',
}

#: Extras of setup.py without a rosdep key; the code that needs them reports the installation.
EXTRAS = {
    'distributed', 'gymnasium', 'nibabel', 'nrrd', 'pandas', 'pyarrow', 'pyigtl', 'trimesh',
}  # fmt: skip

OWN = {*(path.parent.name for path in ROOT.glob('needle_*/__init__.py')), 'reproduction'}


def imported() -> set[str]:
    """Return the external top-level modules imported by the shipped code."""
    modules = set()
    folders = (*OWN, 'launch')
    sources = [path for folder in folders for path in ROOT.glob(f'{folder}/**/*.py')]
    for node in (n for path in sources for n in ast.walk(ast.parse(path.read_text()))):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules.add(node.module)
    return {module.partition('.')[0] for module in modules} - OWN - sys.stdlib_module_names


def test_declared_dependencies_equal_imports() -> None:
    """For package.xml."""
    found = imported()
    assert found >= EXTRAS
    assert {KEYS.get(module, module) for module in found - EXTRAS} == declared('exec_depend')


def test_pip_and_ros_install_the_same_libraries() -> None:
    """Dependencies of pip without ROS equal the rosdep dependencies outside ROS."""
    text = (ROOT / 'setup.py').read_text()
    call = next(
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.keyword) and node.arg == 'install_requires'
    )
    wanted = {item.partition('>')[0].lower() for item in ast.literal_eval(call.value)}
    modules = {'pyyaml' if module == 'yaml' else module for module in KEYS}
    assert wanted == modules


def declared(*kinds: str) -> set[str]:
    """Return the dependencies of package.xml."""
    return {item.text for kind in kinds for item in MANIFEST.iter(kind)}


def complaints(text: str) -> list[str]:
    """Return the errors of a manifest, by the schema and by the parser of rosdep."""
    schema = etree.XMLSchema(etree.parse(DATA / 'package_format3.xsd'))
    schema.validate(etree.fromstring(text.encode()))
    found = [entry.message for entry in schema.error_log]
    try:
        warnings: list[str] = []
        parse_package_string(text, warnings=warnings)
        found += warnings
    except InvalidPackage as error:
        found.append(str(error))
    return found


def test_manifest_is_valid() -> None:
    """package.xml satisfies format 3, without a warning."""
    assert complaints((ROOT / 'package.xml').read_text()) == []


@pytest.mark.parametrize(
    ('part', 'other'),
    [
        ('</version>', '.x</version>'),
        ('<license>Apache-2.0</license>', ''),
        (' email="noreply@needle-insertion.invalid"', ''),
        ('noreply@', 'no..reply@'),
        ('exec_depend>rclpy</exec_depend', 'run_depend>rclpy</run_depend'),
        ('<name>needle_insertion</name>', '<name>Needle__Insertion</name>'),
        ('<package format="3">', '<package format="2">'),
    ],
)
def test_invalid_manifest_is_reported(part: str, other: str) -> None:
    """Each mutation is reported."""
    text = (ROOT / 'package.xml').read_text()
    changed = text.replace(part, other)
    assert changed != text
    assert complaints(changed)


def test_rosdep_resolves_every_dependency() -> None:
    """Each dependency is a package of the distribution or a key of rosdep."""
    tables = yaml.safe_load((DATA / 'rosdep.yaml').read_text())
    packages = {name for names in tables['jazzy/distribution.yaml'].values() for name in names}
    keys = set(tables['rosdep/python.yaml'])
    wanted = declared('exec_depend', 'test_depend')
    assert wanted <= packages | keys
    assert keys <= wanted


def test_pages_install_the_keys_of_pip() -> None:
    """On Ubuntu 24.04 rosdep skips them, and pip installs them for the user."""
    keys = yaml.safe_load((DATA / 'rosdep.yaml').read_text())['pip']
    texts = [
        page.read_text(encoding='utf-8')
        for page in [*ROOT.glob('*.md'), *ROOT.glob('docs/**/*.md')]
    ]
    texts = [text for text in texts if re.search('^rosdep install', text, re.MULTILINE)]
    assert len(texts) >= 2
    for text in texts:
        assert f"--skip-keys '{' '.join(keys)}'" in text
        (line,) = re.findall(r'^python3 -m pip install --user (.*)', text, re.MULTILINE)
        words = shlex.split(line.removeprefix('--break-system-packages '))
        assert [word.partition('>')[0] for word in words] == [*keys.values()]


@pytest.fixture(scope='module')
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the tracked files of this tree, in a colcon workspace."""
    folder = tmp_path_factory.mktemp('workspace') / 'src/needle_insertion'
    folders = ('config', 'description', 'launch', 'resource', 'scripts', 'test', 'tools')
    for name in (*OWN, *folders):
        shutil.copytree(ROOT / name, folder / name)
    for name in ('README.md', 'package.xml', 'setup.py', 'pyproject.toml', 'colcon.pkg'):
        shutil.copy(ROOT / name, folder)
    return folder


def shell(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a command with the tools of this environment on the path."""
    return subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope='module')
def workspace(source: Path) -> Path:
    """Return the built colcon workspace."""
    folder = source.parent.parent
    linked = ('--build-base', 'linked/build', '--install-base', 'linked/install')
    built = shell(folder, 'colcon', 'build', '--symlink-install', *linked)
    assert built.returncode == 0, built.stdout + built.stderr
    built = shell(folder, 'colcon', 'build')
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_ros2_run_finds_every_node(workspace: Path) -> None:
    """The index of the sourced workspace leads to a folder with the nodes as executables."""
    look = "import ament_index_python as a; print(a.get_package_prefix('needle_insertion'))"
    command = f'source install/setup.bash && exec {sys.executable} -c "{look}"'
    found = shell(workspace, 'bash', '-c', command)
    folder = Path(found.stdout.strip()) / 'lib/needle_insertion'
    # Each node once, and no other file.
    assert set(NODES) == {path.name for path in folder.iterdir() if os.access(path, os.X_OK)}


@pytest.mark.parametrize('install', ['install', 'linked/install'])
def test_commands_are_on_the_path_of_a_sourced_workspace(workspace: Path, install: str) -> None:
    """`needle` and the nodes by their own names."""
    script = f'source {install}/setup.bash && command -v needle needle-plant && needle --version'
    found = shell(workspace, 'bash', '-c', script)
    assert found.returncode == 0, found.stderr
    *places, version = found.stdout.split()
    assert all(str(workspace / install) in place for place in places)
    assert version.count('.') == 2


@pytest.mark.parametrize('name', NODES)
def test_built_nodes_start_and_end_normally(
    workspace: Path, ros_graph: RosGraph, name: str
) -> None:
    """Each node is an executable in the folder of ros2 run."""
    executable = workspace / 'install/needle_insertion/lib/needle_insertion' / name
    probe = ros_graph.node('probe')
    parameters = {
        'recorder': ['-p', f'path:={workspace / "bag"}'],
        'player': ['-p', f'path:={SHIPPED_BAGS / "friction_01"}', '-p', 'paused:=true'],
    }
    node = subprocess.Popen(
        [
            *('bash', '-c', f'source install/setup.bash && exec {executable} --ros-args "$@"'),
            *(name, *parameters.get(name, ())),
        ],
        cwd=workspace,
        env={**ros_graph.environment, 'PATH': PATH},
    )
    try:
        ros_graph.spin_until(lambda: probe.count_publishers(f'{name}/configuration'), name)
        node.send_signal(signal.SIGINT)
        # A fresh installation compiles first, for ten seconds on an idle machine.
        assert node.wait(120.0) == 0
    finally:
        node.kill()
        node.wait()


def test_colcon_test_reports_failures(workspace: Path, source: Path) -> None:
    """`colcon test` runs the tests of colcon.pkg; a failing test fails `test-result`."""
    selection = json.loads((ROOT / 'colcon.pkg').read_text())['pytest-args']
    shell(workspace, 'colcon', 'test')
    result = shell(workspace, 'colcon', 'test-result')
    assert result.returncode == 0, result.stdout
    # More tests than files: they were collected and run.
    count = re.search(r'(\d+) tests, 0 errors, 0 failures', result.stdout)
    assert int(count[1]) > len(selection)
    (source / 'test/test_slip.py').write_text('def test_slip():\n    assert 1 == 2\n')
    shell(workspace, 'colcon', 'test', '--pytest-args', 'test/test_slip.py')
    result = shell(workspace, 'colcon', 'test-result')
    assert result.returncode == 1, result.stdout
    assert '1 failure' in result.stdout


#: Required files of a ROS package below share/.
SHARED = [
    'ament_index/resource_index/packages/needle_insertion',
    'needle_insertion/package.xml',
    *(
        f'needle_insertion/{path.relative_to(ROOT).as_posix()}'
        for folder in ('config', 'description', 'launch')
        for path in sorted((ROOT / folder).rglob('*.*'))
        if '__pycache__' not in path.parts
    ),
]


def test_installation_contains_the_files_of_a_ros_package(workspace: Path) -> None:
    """Manifest, index entry, configuration, layouts, policies and launch files."""
    share = workspace / 'install/needle_insertion/share'
    assert [name for name in SHARED if not (share / name).is_file()] == []


@pytest.fixture(scope='module')
def environment(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a fresh virtual environment with the installed sdist and the dependencies."""
    folder = tmp_path_factory.mktemp('fresh')
    build = f'from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})'
    built = shell(source, sys.executable, '-c', build)
    assert built.returncode == 0, built.stderr
    (archive,) = folder.glob('*.tar.gz')
    venv.create(folder / 'venv')
    python = folder / 'venv/bin/python'
    places = sysconfig.get_paths(vars={'base': str(folder / 'venv')})
    # The dependencies of this environment, with lower priority than the fresh environment.
    Path(places['purelib'], 'dependencies.pth').write_text(sysconfig.get_paths()['purelib'])
    options = ('--no-index', '--no-deps', '--no-build-isolation', '--ignore-installed')
    pip = (sys.executable, '-m', 'pip', '--python', python)
    installed = shell(folder, *pip, 'install', *options, archive)
    assert installed.returncode == 0, installed.stdout + installed.stderr
    # Machine code of this checkout: its compilation is tested elsewhere.
    code = Path('needle_dynamics/compiled/__pycache__')
    shutil.copytree(ROOT / code, places['purelib'] / code, dirs_exist_ok=True)
    return folder / 'venv'


def test_sdist_installs_and_runs(environment: Path, ros_graph: RosGraph, tmp_path: Path) -> None:
    """From the archive only: all files exist, the command simulates, and a node starts."""
    share = environment / 'share'
    assert [name for name in SHARED if not (share / name).is_file()] == []
    look = (
        'import importlib.metadata as m, needle_dynamics as n; '
        "print(m.version('needle_insertion'), n.__file__)"
    )
    version, file = shell(tmp_path, environment / 'bin/python', '-c', look).stdout.split()
    assert version == MANIFEST.findtext('version')
    assert Path(file).is_relative_to(environment)
    needle = environment / 'bin/needle'
    simulated = shell(
        tmp_path, needle, 'simulate', '--needle', 'phantom', '--duration', '0.01', '-o', 'run.csv'
    )
    assert simulated.returncode == 0, simulated.stderr
    assert len((tmp_path / 'run.csv').read_text().splitlines()) > 1
    probe = ros_graph.node('probe')
    with subprocess.Popen(
        [environment / 'bin/needle-recorder', '--ros-args', '-p', f'path:={tmp_path / "bag"}'],
        env=ros_graph.environment,
    ) as node:
        try:
            ros_graph.spin_until(lambda: probe.count_publishers('recorder/configuration'), 'node')
            node.send_signal(signal.SIGINT)
            assert node.wait(30.0) == 0
        finally:
            node.kill()
