"""The package as colcon, pip and rosdep see it."""

import ast
import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import venv
import xml.etree.ElementTree as ET

from catkin_pkg.package import InvalidPackage, parse_package_string
from lxml import etree
from needle_insertion.experiment.protocol import SHIPPED_BAGS
from needle_insertion.nodes import NODES
import pytest
from support.installed import ROOT
from support.ros_graph import RosGraph
import yaml

DATA = ROOT / 'test/data'
PATH = f'{Path(sys.executable).parent}:{os.environ["PATH"]}'
#: Without PYTHONPATH: what is installed must not be hidden by this tree.
ENVIRONMENT = {**os.environ, 'PATH': PATH, 'PYTHONPATH': ''}
MANIFEST = ET.parse(ROOT / 'package.xml').getroot()  # noqa: S314

#: rosdep keys by imported module, where they are not the module itself.
KEYS = {
    'aiohttp': 'python3-aiohttp',
    'argcomplete': 'python3-argcomplete',
    # Come with mcap.
    'lz4': 'mcap-ros2-support',
    'zstandard': 'mcap-ros2-support',
    'jinja2': 'python3-jinja2',
    # Comes with jinja2.
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

#: Extras of setup.py, without a key: what needs one says how to install it.
EXTRAS = {'distributed', 'gymnasium', 'pyarrow', 'pyigtl'}

OWN = {path.parent.name for path in ROOT.glob('needle_*/__init__.py')}


def imported() -> set[str]:
    """Return the top-level modules that the shipped code imports from elsewhere."""
    modules = set()
    sources = [*ROOT.glob('needle_*/**/*.py'), *ROOT.glob('launch/*.py')]
    for node in (n for path in sources for n in ast.walk(ast.parse(path.read_text()))):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules.add(node.module)
    return {module.partition('.')[0] for module in modules} - OWN - sys.stdlib_module_names


def test_every_import_is_declared_and_every_declaration_imported() -> None:
    """The dependencies in package.xml are what the code imports, no more and no less."""
    found = imported()
    assert found >= EXTRAS
    assert {KEYS.get(module, module) for module in found - EXTRAS} == declared('exec_depend')


def test_pip_and_ros_install_the_same_libraries() -> None:
    """What pip installs without ROS is what package.xml asks rosdep for outside ROS."""
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
    """Return the names that package.xml depends on."""
    return {item.text for kind in kinds for item in MANIFEST.iter(kind)}


def complaints(text: str) -> list[str]:
    """Say what is wrong with a manifest, by the schema and by the reader that rosdep uses."""
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


def test_the_manifest_is_valid() -> None:
    """package.xml is what format 3 allows, without a warning."""
    assert complaints((ROOT / 'package.xml').read_text()) == []


@pytest.mark.parametrize(
    ('part', 'other'),
    [
        ('<version>0.1.0</version>', '<version>0.1</version>'),
        ('<license>Apache-2.0</license>', ''),
        (' email="maintainers@needle-insertion.example"', ''),
        ('maintainers@', 'maint..ainers@'),
        ('exec_depend>rclpy</exec_depend', 'run_depend>rclpy</run_depend'),
        ('<name>needle_insertion</name>', '<name>Needle__Insertion</name>'),
        ('<package format="3">', '<package format="2">'),
    ],
)
def test_a_manifest_that_is_not_valid_is_found_out(part: str, other: str) -> None:
    """The check can fail: each slip is reported."""
    text = (ROOT / 'package.xml').read_text()
    changed = text.replace(part, other)
    assert changed != text
    assert complaints(changed)


def test_rosdep_knows_every_name() -> None:
    """Each dependency is a package of the distribution or a key of rosdep."""
    tables = yaml.safe_load((DATA / 'rosdep.yaml').read_text())
    packages = {name for names in tables['jazzy/distribution.yaml'].values() for name in names}
    keys = set(tables['rosdep/python.yaml'])
    wanted = declared('exec_depend', 'test_depend')
    assert wanted <= packages | keys
    assert keys <= wanted


@pytest.fixture(scope='module')
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the tracked files of this tree, in a colcon workspace."""
    folder = tmp_path_factory.mktemp('workspace') / 'src/needle_insertion'
    for pattern in ('needle_*', 'config', 'description', 'launch', 'resource', 'scripts', 'test'):
        for item in ROOT.glob(pattern):
            if not item.name.endswith('.egg-info'):
                shutil.copytree(item, folder / item.name)
    for name in (
        'README.md',
        'package.xml',
        'setup.py',
        'pyproject.toml',
        'colcon.pkg',
    ):
        shutil.copy(ROOT / name, folder)
    return folder


def shell(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a command with the tools of this environment on the path, as its users have them."""
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
    """Return the colcon workspace, built."""
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
    # Each once, and nothing else.
    assert set(NODES) == {path.name for path in folder.iterdir() if os.access(path, os.X_OK)}


@pytest.mark.parametrize('install', ['install', 'linked/install'])
def test_the_command_is_found_in_a_sourced_workspace(workspace: Path, install: str) -> None:
    """`needle` and the nodes by their own names are on the path."""
    script = f'source {install}/setup.bash && command -v needle needle-plant && needle --version'
    found = shell(workspace, 'bash', '-c', script)
    assert found.returncode == 0, found.stderr
    *places, version = found.stdout.split()
    assert all(str(workspace / install) in place for place in places)
    assert version.count('.') == 2


@pytest.mark.parametrize('name', NODES)
def test_colcon_builds_what_ros2_run_finds(
    workspace: Path, ros_graph: RosGraph, name: str
) -> None:
    """Each node is an executable where ros2 run looks for it, comes up, and ends well."""
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
        # A fresh installation compiles first, for ten seconds where nothing else runs.
        assert node.wait(120.0) == 0
    finally:
        node.kill()
        node.wait()


def test_colcon_test_runs_tests_and_tells_when_one_fails(workspace: Path, source: Path) -> None:
    """`colcon test` runs the tests that colcon.pkg names; a failing one fails `test-result`."""
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


#: What a ROS package carries, below share/.
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


def test_the_install_carries_what_a_ros_package_carries(workspace: Path) -> None:
    """Manifest, index entry, configuration, layouts, policies and launch files are installed."""
    share = workspace / 'install/needle_insertion/share'
    assert [name for name in SHARED if not (share / name).is_file()] == []


@pytest.fixture(scope='module')
def environment(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a fresh virtual environment with what an sdist brings and our dependencies."""
    folder = tmp_path_factory.mktemp('fresh')
    build = f'from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})'
    built = shell(source, sys.executable, '-c', build)
    assert built.returncode == 0, built.stderr
    (archive,) = folder.glob('*.tar.gz')
    venv.create(folder / 'venv')
    python = folder / 'venv/bin/python'
    places = sysconfig.get_paths(vars={'base': str(folder / 'venv')})
    # The dependencies of this environment, after what is installed in the fresh one.
    Path(places['purelib'], 'dependencies.pth').write_text(sysconfig.get_paths()['purelib'])
    options = ('--no-index', '--no-deps', '--no-build-isolation', '--ignore-installed')
    pip = (sys.executable, '-m', 'pip', '--python', python)
    installed = shell(folder, *pip, 'install', *options, archive)
    assert installed.returncode == 0, installed.stdout + installed.stderr
    return folder / 'venv'


def test_an_sdist_installs_and_runs(
    environment: Path, ros_graph: RosGraph, tmp_path: Path
) -> None:
    """From the archive alone: all files in place, the command simulates, a node comes up."""
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
    simulated = shell(tmp_path, needle, 'simulate', '--duration', '0.01', '-o', 'run.csv')
    assert simulated.returncode == 0, simulated.stderr
    assert len((tmp_path / 'run.csv').read_text().splitlines()) > 1
    probe = ros_graph.node('probe')
    with subprocess.Popen(
        [environment / 'bin/needle-recorder', '--ros-args', '-p', f'path:={tmp_path / "bag"}'],
        env=ros_graph.environment,
    ) as node:
        try:
            ros_graph.spin_until(lambda: probe.count_publishers('recorder/configuration'), 'it')
            node.send_signal(signal.SIGINT)
            assert node.wait(30.0) == 0
        finally:
            node.kill()
