"""The package as colcon, pip and rosdep see it."""

import ast
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET

import pytest

ROOT = Path(__file__).parent.parent.parent
MANIFEST = ET.parse(ROOT / 'package.xml').getroot()  # noqa: S314

#: rosdep keys by imported module, where they are not the module itself.
KEYS = {
    # Come with mcap.
    'lz4': 'mcap-ros2-support',
    'zstandard': 'mcap-ros2-support',
    'matplotlib': 'python3-matplotlib',
    'mcap': 'mcap-ros2-support',
    'numba': 'python3-numba',
    'numpy': 'python3-numpy',
    'rosbags': 'python3-rosbags-pip',
    'scipy': 'python3-scipy',
    'tqdm': 'python3-tqdm',
    'yaml': 'python3-yaml',
}

OWN = {'needle_controller', 'needle_dynamics', 'needle_identification', 'needle_insertion'}


def imported() -> set[str]:
    """Return the top-level modules that the shipped code imports from elsewhere."""
    modules = set()
    sources = [*ROOT.glob('needle_*/*.py'), *ROOT.glob('launch/*.py')]
    for node in (n for path in sources for n in ast.walk(ast.parse(path.read_text()))):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules.add(node.module)
    return {module.partition('.')[0] for module in modules} - OWN - sys.stdlib_module_names


def test_every_import_is_declared_and_every_declaration_imported():
    """The dependencies in package.xml are what the code imports, no more and no less."""
    declared = {item.text for item in MANIFEST.iter('exec_depend')}
    assert {KEYS.get(module, module) for module in imported()} == declared


def test_pip_and_ros_install_the_same_libraries():
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


@pytest.fixture(scope='module')
def workspace(tmp_path_factory) -> Path:
    """Return a colcon workspace with the tracked files of this tree, built."""
    folder = tmp_path_factory.mktemp('workspace')
    source = folder / 'src' / 'needle_insertion'
    for pattern in ('needle_*', 'bags', 'config', 'launch', 'resource', 'scripts'):
        for item in ROOT.glob(pattern):
            if not item.name.endswith('.egg-info'):
                shutil.copytree(item, source / item.name, dirs_exist_ok=True)
    for name in ('README.md', 'package.xml', 'setup.cfg', 'setup.py'):
        shutil.copy(ROOT / name, source)
    colcon = Path(sys.executable).with_name('colcon')
    built = subprocess.run(
        [colcon, 'build'], cwd=folder, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


@pytest.mark.parametrize('name', ['plant', 'controller', 'identification', 'recorder'])
def test_colcon_builds_what_ros2_run_finds(workspace, ros_graph, name):
    """Each node is an executable where ros2 run looks for it, comes up, and ends well."""
    executable = workspace / 'install/needle_insertion/lib/needle_insertion' / name
    assert os.access(executable, os.X_OK)
    probe = ros_graph.node('probe')
    parameters = ['-p', f'path:={workspace / "bag"}'] if name == 'recorder' else []
    node = subprocess.Popen(
        [
            *('bash', '-c', f'source install/setup.bash && exec {executable} --ros-args "$@"'),
            *(name, *parameters),
        ],
        cwd=workspace,
        env={
            **ros_graph.environment,
            'PATH': f'{Path(sys.executable).parent}:{os.environ["PATH"]}',
        },
    )
    try:
        ros_graph.spin_until(lambda: probe.count_publishers(f'{name}/configuration'), name)
        node.send_signal(signal.SIGINT)
        # A fresh installation compiles first, for ten seconds where nothing else runs.
        assert node.wait(120.0) == 0
    finally:
        node.kill()
        node.wait()


def test_the_install_carries_what_a_ros_package_carries(workspace):
    """Manifest, index entry, configuration and launch files are installed."""
    share = workspace / 'install/needle_insertion/share'
    for name in (
        'ament_index/resource_index/packages/needle_insertion',
        'needle_insertion/package.xml',
        'needle_insertion/config/insertion.yaml',
        'needle_insertion/launch/insertion.launch.py',
    ):
        assert (share / name).is_file(), name
