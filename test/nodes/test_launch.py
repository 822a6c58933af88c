# SPDX-License-Identifier: Apache-2.0
"""Launch file, parsed as source, and executed if launch is installed."""

from __future__ import annotations

import ast
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time
from typing import Any

from needle_ros.run_node import END_WITH_PARENT
import pytest
from support.installed import node_class, ROOT
from support.ros_graph import RosGraph

PATH = ROOT / 'launch/insertion.launch.py'
TREE = ast.parse(PATH.read_text())


def constant(name: str) -> Any:
    """Return a table of the launch file."""
    return next(
        ast.literal_eval(item.value)
        for item in TREE.body
        if isinstance(item, ast.Assign) and ast.unparse(item.targets[0]) == name
    )


ARGUMENTS, PARAMETERS = constant('ARGUMENTS'), constant('PARAMETERS')


def test_launch_arguments_are_described_and_used() -> None:
    """An argument sets a parameter, or the file reads it by name."""
    used = {argument for table in PARAMETERS.values() for argument in table}
    assert used <= ARGUMENTS.keys()
    asked = {
        item.slice.value
        for item in ast.walk(TREE)
        if isinstance(item, ast.Subscript) and ast.unparse(item.value) == 'given'
        if isinstance(item.slice, ast.Constant)
    }
    assert used | asked == ARGUMENTS.keys()
    assert f"'{END_WITH_PARENT}'" in PATH.read_text()
    assert all(meaning for _, meaning, _ in ARGUMENTS.values())


@pytest.mark.parametrize('name', PARAMETERS)
def test_launch_arguments_set_existing_parameters(ros_graph: RosGraph, name: str) -> None:
    """Each is a parameter of the node that setup.py installs under this name."""
    node = ros_graph.add(node_class(name), start=False)
    assert {key for key in PARAMETERS[name].values() if not node.has_parameter(key)} == set()


def test_ros2_launch_loads_the_file() -> None:
    """`ros2 launch` shows every argument; without it the file is valid Python."""
    compile(TREE, PATH, 'exec')
    if ros2 := shutil.which('ros2'):
        shown = subprocess.run(
            [ros2, 'launch', PATH, '--show-args'], capture_output=True, text=True, check=True
        )
        assert [name for name in ARGUMENTS if f"'{name}'" not in shown.stdout] == []


#: Equivalent of `ros2 launch PATH name:=value ...`.
LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

source = PythonLaunchDescriptionSource(sys.argv[1])
given = [tuple(word.split(':=', 1)) for word in sys.argv[2:]]
service = LaunchService()
included = IncludeLaunchDescription(source, launch_arguments=given)
service.include_launch_description(LaunchDescription([included]))
sys.exit(service.run())
"""


def start(*words: str) -> subprocess.Popen[str]:
    """Start the launch file, or skip the test if launch is not installed."""
    pytest.importorskip('launch_ros')
    return subprocess.Popen(
        [sys.executable, '-c', LAUNCH, str(PATH), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.parametrize(
    ('words', 'reason'),
    [
        (['params_file:=/no/such.yaml'], 'params_file /no/such.yaml does not exist'),
        (['law:=bang'], 'adaptive'),
        (['rviz:=true'], 'rviz2'),
        (['steering:=true', 'mode:=indenter'], 'needs a steered needle'),
    ],
)
def test_launch_rejects_invalid_arguments_before_starting_nodes(
    words: list[str], reason: str
) -> None:
    launch = start(*words)
    if reason == 'rviz2' and shutil.which('rviz2'):
        launch.kill()
    said, _ = launch.communicate(timeout=120)
    assert (launch.returncode != 0, reason in said, 'process started' in said) == (
        True,
        True,
        False,
    )


def test_failed_node_ends_the_others_and_launch() -> None:
    """`paper_si` has no carriage, so that the controller rejects its gains."""
    launch = start('needle:=paper_si')
    said, _ = launch.communicate(timeout=120)
    assert launch.returncode != 0
    assert said.count('process started') == 2
    assert '[ERROR] [plant-1]: process has died' not in said


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_signal_to_launch_ends_all_nodes(number: int) -> None:
    launch = start()
    assert launch.stdout is not None
    lines = []
    for line in launch.stdout:
        lines.append(line)
        if 'active' in line:
            break
    nodes = [int(pid) for pid in re.findall(r'process started with pid \[(\d+)\]', ''.join(lines))]
    assert len(nodes) == 2
    launch.send_signal(number)
    launch.communicate(timeout=60)
    deadline = time.monotonic() + 30.0
    while any(Path(f'/proc/{pid}').exists() for pid in nodes):
        assert time.monotonic() < deadline
        time.sleep(0.05)
