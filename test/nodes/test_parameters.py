# SPDX-License-Identifier: Apache-2.0
"""Parameters from users: dumped and reloaded, as text, shared, and for other nodes."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
import re
import subprocess
import sys

from diagnostic_msgs.msg import DiagnosticArray
from needle_controller.controller_node import ControllerNode
from needle_dynamics.plant_node import PlantNode
from needle_insertion.nodes import NODES
from needle_ros.base_node import LATCHED
from needle_ros.status import read_reports, STALE
import pytest
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import String
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
    del values['needle']
    same = [Parameter(name, value=value) for name, value in values.items()]
    assert {r.reason for r in node.set_parameters(same)} == {''}
    assert node.set_parameters([Parameter('rate', value='1e3')])[0].successful
    refused = node.set_parameters([Parameter('rate', value=500.0)])[0]
    assert not refused.successful
    assert 'cannot change while configured' in refused.reason


def test_other_callbacks_are_executed_during_a_whole_file(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by `ros2 param load`; without a new value, no configuration is published."""
    node, user = ros_graph.add(ControllerNode), ros_graph.node('user')
    client = user.create_client(SetParameters, 'controller/set_parameters')
    found = ros_graph.listen(user, String, 'controller/configuration', LATCHED)
    ros_graph.spin_until(client.service_is_ready, 'the service')
    ros_graph.spin_until(lambda: found, 'the configuration')
    values = {name: value for name, value in node.values().items() if value != []}
    del values['needle']
    same = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    done: list[Parameter] = []
    between: set[int] = set()
    set_parameters = node.set_parameters_atomically

    def counted(group: list[Parameter]) -> SetParametersResult:
        done.extend(group)
        return set_parameters(group)

    monkeypatch.setattr(node, 'set_parameters_atomically', counted)
    node.create_timer(1e-4, lambda: between.add(len(done)))
    everything = client.call_async(SetParameters.Request(parameters=same))
    ros_graph.spin_until(everything.done, 'the parameters')
    assert len(between - {0, len(same)}) > 10
    results = everything.result().results
    assert len(results) == len(same)
    assert all(one.successful for one in results)
    assert len(found) == 1


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [('axes', [], 'axes must be two'), ('apply_to', ['my-robot/x'], 'must have names of nodes')],
)
def test_lists_of_the_node_identification(
    ros_graph: RosGraph, tmp_path: Path, name: str, value: list[str], reason: str
) -> None:
    """An empty list of a file is None in rcl; each error is one line."""
    file = tmp_path / 'identification.yaml'
    empty = {'bags': [], 'apply_to': [], name: value}
    file.write_text(yaml.safe_dump({'identification': {'ros__parameters': empty}}))
    node = ros_graph.add(node_class('identification'), cli_args=arguments(file), start=False)
    assert not node.start()
    assert reason in node.failure


def test_numeric_text_is_parsed_as_a_number(ros_graph: RosGraph) -> None:
    """PyYAML parses 1e-3 and 5mm as text, and `ros2 param load` sends it as text."""
    texts = {'model.tissue_damping': '1e1', 'rate': '200Hz', 'depth': '20mm'}
    node = ros_graph.add(PlantNode, parameters=texts)
    assert node.is_active
    assert '200 Hz' in node.about()
    assert node.values()['depth'] == 0.02
    node = ros_graph.add(PlantNode, parameters={'model.length': 'long'}, start=False)
    assert not node.start()
    assert 'model.length must be a number, or text with a unit of m' in str(node.failure)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('plant:\n  ros_parameters:\n    rate: 200.0\n', "found 'plant', 'plant.ros_parameters'"),
        ('plant:\n  ros__parameters:\n      rate: 1.0\n    law: pid\n', 'line 4, column 5'),
        ('plant:\n  ros__parameters:\n    rate: [[1.0], [2.0]]\n', 'parse params file'),
    ],
)
def test_invalid_parameter_file_gives_one_line(tmp_path: Path, text: str, said: str) -> None:
    """Without the source files of the parser."""
    file = tmp_path / 'plant.yaml'
    file.write_text(text)
    found = subprocess.run(
        [sys.executable, '-m', 'needle_dynamics.plant_node', *arguments(file)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert found.returncode == 2
    assert re.fullmatch('error: .*\n', found.stderr)
    assert str(file) in found.stderr
    assert said in found.stderr
    assert '/src/' not in found.stderr


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


@pytest.mark.parametrize('name', NODES)
def test_descriptions_of_parameters_are_complete(ros_graph: RosGraph, name: str) -> None:
    """Finite bounds, and the valid values of parameters that are not numbers."""
    node = ros_graph.add(node_class(name), start=False)
    names = [
        one for one in node._parameters if not one.startswith(('qos_overrides', 'start_type'))
    ]
    for descriptor in node.describe_parameters(names):
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        bounds = [bound for one in ranges for bound in (one.from_value, one.to_value)]
        assert all(map(isfinite, bounds)), descriptor.name
        if descriptor.name != 'use_sim_time':
            assert descriptor.description, descriptor.name
            assert ranges or descriptor.additional_constraints, descriptor.name
        value = node.get_parameter(descriptor.name).value
        if descriptor.additional_constraints.startswith('one of '):
            valid = descriptor.additional_constraints.removeprefix('one of ').split(', ')
            assert value in valid


@pytest.mark.parametrize(('namespace', 'hardware'), [('', 'needle'), ('left', 'left')])
def test_status_names_node_task_and_hardware(
    ros_graph: RosGraph, namespace: str, hardware: str
) -> None:
    """In the form of diagnostic_updater; stale when the values are no longer updated."""
    probe = ros_graph.node('probe')
    received = ros_graph.listen(probe, DiagnosticArray, '/diagnostics', 10)
    node = ros_graph.add(ControllerNode, namespace=namespace)
    full = f'/{namespace}/controller' if namespace else '/controller'

    def levels() -> set[bytes]:
        found = [status for array in received for status in array.status]
        assert {status.name for status in found} <= {f'{full}: state'}
        assert {status.hardware_id for status in found} <= {hardware}
        assert {one.node for array in received for one in read_reports(array)} <= {full}
        return {status.level for status in found}

    ros_graph.spin_until(levels, 'the status')
    assert STALE not in levels()
    node.trigger_shutdown()
    ros_graph.spin_until(lambda: STALE in levels(), 'the last status')
