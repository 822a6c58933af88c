# SPDX-License-Identifier: Apache-2.0
"""Command line, signals and log of a node process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
import signal
import subprocess
import sys
import time

from needle_insertion.nodes import NODES
from needle_ros.base_node import SENSOR
import pytest
from sensor_msgs.msg import JointState
from support.installed import node_class, ROOT
from support.ros_graph import RosGraph


def started(
    ros_graph: RosGraph,
    name: str,
    *words: str,
    python: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
    errors: int = subprocess.STDOUT,
) -> subprocess.Popen[str]:
    """Start a node with arguments of the node and of Python."""
    return subprocess.Popen(
        [sys.executable, *python, ROOT / 'scripts' / name, *words],
        env={**ros_graph.environment, **(environment or {})},
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
    )


@pytest.mark.parametrize('name', NODES)
def test_help_names_every_parameter(ros_graph: RosGraph, name: str) -> None:
    """The help contains the summary of the node, too."""
    asked = started(ros_graph, name, '--help', errors=subprocess.DEVNULL)
    said, _ = asked.communicate(timeout=60.0)
    assert asked.returncode == 0
    assert said.startswith(f'usage: {name} [-h] [--ros-args')
    assert f'\n{(node_class(name).__doc__ or "").strip().splitlines()[0]}\n' in said
    node = ros_graph.add(node_class(name), start=False)
    assert [key for key in node.values() if f'\n  {key}: ' not in said] == []


@pytest.mark.parametrize(('chosen', 'used'), [({}, '1'), ({'OMP_NUM_THREADS': '2'}, '2')])
@pytest.mark.parametrize('name', NODES)
def test_blas_threads_are_limited_before_the_import_of_numpy(
    ros_graph: RosGraph, name: str, chosen: dict[str, str], used: str
) -> None:
    """BLAS reads the variable at this import; a value of the user stays."""
    code = (
        f'import os, sys; sys.argv = ["{name}", "--help"]; sys.addaudithook(lambda event, given: '
        'event == "import" and given[0] == "numpy" and '
        'print("at", os.environ.get("OMP_NUM_THREADS"))); '
        'from needle_insertion.nodes import main; main()'
    )
    environment = {**ros_graph.environment, **chosen}
    if not chosen:
        environment.pop('OMP_NUM_THREADS', None)
    said = subprocess.check_output(
        [sys.executable, '-c', code], env=environment, text=True, timeout=60.0
    )
    assert next(line for line in said.splitlines() if line.startswith('at ')) == f'at {used}'


def test_blas_threads_of_started_nodes_are_limited(ros_graph: RosGraph) -> None:
    """Also without the programs of pip and ros2 run, as in `needle run`."""
    ros_graph.environment.pop('OMP_NUM_THREADS', None)
    node = ros_graph.start('plant')
    environment = Path(f'/proc/{node.process.pid}/environ')
    # Empty while the program is being loaded.
    ros_graph.spin_until(environment.read_text, 'the environment')
    assert 'OMP_NUM_THREADS=1' in environment.read_text().split('\0')


def test_unknown_argument_is_rejected(ros_graph: RosGraph) -> None:
    """Before the node is created, with the syntax of a parameter."""
    asked = started(ros_graph, 'plant', 'rate:=500')
    said, _ = asked.communicate(timeout=60.0)
    assert asked.returncode == 2
    assert 'unknown: rate:=500; set parameters with --ros-args -p NAME:=VALUE' in said


def test_missing_home_folder_names_the_remedy(ros_graph: RosGraph, tmp_path: Path) -> None:
    (tmp_path / 'file').touch()
    for name in ('ROS_LOG_DIR', 'ROS_HOME'):
        ros_graph.environment.pop(name, None)
    home = {'HOME': str(tmp_path / 'file' / 'home')}
    asked = started(ros_graph, 'plant', environment=home)
    said, _ = asked.communicate(timeout=60.0)
    assert asked.returncode == 2
    assert said.startswith('error: failed to initialize logging')
    assert said.endswith('set ROS_LOG_DIR to a folder that can be written\n')


def test_active_node_logs_its_state_and_ignores_repeated_ctrl_c(ros_graph: RosGraph) -> None:
    """One line has needle, rate and topics. The exit status is 0 for any number of Ctrl-C."""
    came = ros_graph.listen(ros_graph.node('probe'), JointState, 'joint_states', SENSOR)
    node = started(ros_graph, 'plant', '--ros-args', '-p', 'rate:=500.0')
    assert node.stdout is not None
    said = next(line for line in node.stdout if 'active' in line)
    assert 'active: mode simulation, needle phantom, 500 Hz; takes wrench_command' in said
    ros_graph.spin_until(lambda: came, 'joint_states')
    deadline = time.monotonic() + 30.0
    while node.poll() is None and time.monotonic() < deadline:
        node.send_signal(signal.SIGINT)
        time.sleep(0.005)
    node.communicate(timeout=60.0)
    assert node.returncode == 0


_ENDED = """
from pathlib import Path
import sys
from needle_ros.run_node import run
from support.installed import node_class
status = run(node_class(sys.argv.pop(1)))
print('threads', *[one.read_text().strip() for one in Path('/proc/self/task').glob('*/comm')])
sys.exit(status)
"""


@pytest.mark.parametrize('name', ['plant', 'controller', 'recorder'])
def test_ended_node_leaves_no_thread_of_dds(
    ros_graph: RosGraph, tmp_path: Path, name: str
) -> None:
    """A remaining thread would use the memory of the interpreter while that ends."""
    words = ['-p', f'path:={tmp_path / "bag"}'] if name == 'recorder' else []
    node = subprocess.Popen(
        [sys.executable, '-c', _ENDED, name, '--ros-args', *words],
        env={**ros_graph.environment, 'PYTHONPATH': str(ROOT / 'test')},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert node.stdout is not None
    assert any(': active' in line for line in node.stdout)
    node.send_signal(signal.SIGINT)
    said, _ = node.communicate(timeout=60.0)
    assert node.returncode == 0
    word, *threads = said.splitlines()[-1].split()
    assert (word, 'python' in ' '.join(threads)) == ('threads', True)
    assert [one for one in threads if one.startswith('dds.')] == []


@pytest.mark.parametrize('stage', ['numpy', 'rclpy', 'visualization_msgs.msg'])
def test_ctrl_c_during_import_ends_the_process(ros_graph: RosGraph, stage: str) -> None:
    """Immediately, without a traceback."""
    node = started(ros_graph, 'plant', python=('-X', 'importtime'))
    assert node.stdout is not None
    assert any(line.endswith(f' {stage}\n') for line in node.stdout)
    begin = time.monotonic()
    node.send_signal(signal.SIGINT)
    said, _ = node.communicate(timeout=60.0)
    assert time.monotonic() - begin < 5.0
    assert node.returncode in (-signal.SIGINT, 0)
    assert 'Traceback' not in said


def test_ctrl_c_during_compilation_ends_the_process(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Compilation takes a minute on a fresh machine."""
    fresh = {'NUMBA_CACHE_DIR': str(tmp_path)}
    node = started(ros_graph, 'controller', environment=fresh)
    assert node.stdout is not None
    assert any('compiling' in line for line in node.stdout)
    begin = time.monotonic()
    node.send_signal(signal.SIGINT)
    said, _ = node.communicate(timeout=60.0)
    assert time.monotonic() - begin < 5.0
    assert (node.returncode, 'Traceback' in said) == (0, False)
