"""The launch file, read where launch is not installed and run where it is."""

from __future__ import annotations

import ast
import shutil
import subprocess
from typing import Any

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


def test_every_argument_has_a_meaning_and_a_use() -> None:
    """An argument sets a parameter, or the file asks for it by name."""
    used = {argument for table in PARAMETERS.values() for argument in table}
    assert used <= ARGUMENTS.keys()
    asked = {
        item.slice.value
        for item in ast.walk(TREE)
        if isinstance(item, ast.Subscript) and ast.unparse(item.value) == 'given'
        if isinstance(item.slice, ast.Constant)
    }
    asked |= {
        item.args[0].value
        for item in ast.walk(TREE)
        if isinstance(item, ast.Call)
        and ast.unparse(item.func) == 'LaunchConfiguration'
        and isinstance(item.args[0], ast.Constant)
    }
    assert used | asked == ARGUMENTS.keys()
    assert all(meaning for _, meaning in ARGUMENTS.values())


@pytest.mark.parametrize('name', PARAMETERS)
def test_arguments_set_parameters_that_the_nodes_have(ros_graph: RosGraph, name: str) -> None:
    """Each parameter is one of the node that setup.py installs under this name."""
    node = ros_graph.add(node_class(name), start=False)
    assert {key for key in PARAMETERS[name].values() if not node.has_parameter(key)} == set()


def test_where_ros2_launch_is_installed_it_takes_the_file() -> None:
    """`ros2 launch` loads the file and shows every argument; elsewhere it is at least Python."""
    compile(TREE, PATH, 'exec')
    if ros2 := shutil.which('ros2'):
        shown = subprocess.run(
            [ros2, 'launch', PATH, '--show-args'], capture_output=True, text=True, check=True
        )
        assert [name for name in ARGUMENTS if f"'{name}'" not in shown.stdout] == []
