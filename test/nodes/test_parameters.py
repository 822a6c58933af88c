"""Parameters from users: dumped and reloaded, as text, shared, and for other nodes."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys

from needle_controller.controller_node import ControllerNode
from needle_dynamics.plant_node import PlantNode
from needle_insertion.nodes import NODES
import pytest
from rclpy.parameter import Parameter
from support.installed import node_class
from support.ros_graph import RosGraph
import yaml


def arguments(file: Path) -> list[str]:
    return ['--ros-args', '--params-file', str(file)]


@pytest.mark.parametrize('name', NODES)
def test_dumped_parameters_can_be_loaded(ros_graph: RosGraph, tmp_path: Path, name: str) -> None:
    """Including empty lists, which rcl returns as None."""
    given: dict[str, object] = {'observer.cutoffs': []} if name == 'controller' else {}
    first = ros_graph.add(node_class(name), parameters=given, start=False)
    file = tmp_path / 'node.yaml'
    file.write_text(first.configuration())
    if name == 'controller':
        assert (
            yaml.safe_load(file.read_text())['/controller']['ros__parameters']['observer.cutoffs']
            == []
        )
    second = ros_graph.add(node_class(name), cli_args=arguments(file), start=False)
    assert second.configuration() == first.configuration()


def test_unchanged_values_may_be_set_while_configured(ros_graph: RosGraph) -> None:
    """`ros2 param load` of a dumped file succeeds; changes are still rejected."""
    node = ros_graph.add(ControllerNode)
    values = {name: value for name, value in node.values().items() if value != []}
    # rclpy rejects setting read-only parameters to any value.
    del values['model.preset']
    same = [Parameter(name, value=value) for name, value in values.items()]
    assert {r.reason for r in node.set_parameters(same)} == {''}
    assert node.set_parameters([Parameter('rate', value='1e3')])[0].successful
    refused = node.set_parameters([Parameter('rate', value=500.0)])[0]
    assert not refused.successful
    assert 'cannot change while configured' in refused.reason


def test_numeric_text_is_parsed_as_a_number(ros_graph: RosGraph) -> None:
    """PyYAML parses 1e-3 as text, and `ros2 param load` sends it as text."""
    node = ros_graph.add(PlantNode, parameters={'model.tissue_damping': '1e1'})
    assert node.is_active
    node = ros_graph.add(PlantNode, parameters={'model.length': 'long'}, start=False)
    assert not node.start()
    assert "model.length must be a number, got 'long'" in str(node.failure)


@pytest.mark.parametrize(
    ('section', 'name', 'status', 'said'),
    [
        ('/**', 'law', 0, 'shared parameters that this node does not declare: law'),
        ('/plant', 'law', 2, "unknown parameter 'law'"),
        ('/**/plant', 'law', 2, "unknown parameter 'law'"),
        ('/plnat', 'rate', 0, 'has no parameters for /plant, only for /plnat'),
    ],
)
def test_unused_sections_of_parameter_files_are_reported(
    ros_graph: RosGraph, tmp_path: Path, section: str, name: str, status: int, said: str
) -> None:
    """A file for all nodes is valid for each; a node without a section in its file warns."""
    file = tmp_path / 'all.yaml'
    file.write_text(f'{section}:\n  ros__parameters:\n    {name}: 500.0\n')
    log = tmp_path / 'log'
    with log.open('w') as target:
        plant = subprocess.Popen(
            [sys.executable, '-m', 'needle_dynamics.plant_node', *arguments(file)],
            env=ros_graph.environment, stderr=target,
        )  # fmt: skip
        try:
            ros_graph.spin_until(lambda: said in log.read_text(), said, timeout=60.0)
            if not status:
                plant.terminate()
            assert plant.wait(30) == status
        finally:
            plant.kill()
            plant.wait()
