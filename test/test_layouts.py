# SPDX-License-Identifier: Apache-2.0
"""Layouts of RViz, Foxglove and PlotJuggler, compared with the published topics."""

from __future__ import annotations

from collections.abc import Mapping
import json
from pathlib import Path
import re
from typing import Any
import xml.etree.ElementTree as ET

from diagnostic_msgs.msg import DiagnosticArray
from needle_insertion.graph.ros_graph import Graph
from needle_ros.status import read_reports, RecorderStatus
import pytest
from rosbags.highlevel import AnyReader
import yaml

CONFIG = Path(__file__).parent.parent / 'config'
NODES = ('plant', 'controller')

#: Streams of an insertion under control.
STREAMS = (
    '/joint_states',
    '/base_wrench',
    '/tip_deflection',
    '/ground_truth',
    '/wrench_command',
    '/reference',
    '/tracking_error',
)

#: Visualization topics, which recordings do not need, and their types.
DRAWN = {
    '/needle_shape': 'visualization_msgs/msg/Marker',
    '/needle_poses': 'geometry_msgs/msg/PoseArray',
}

#: Message types by RViz display.
DISPLAYS = {
    'Marker': 'visualization_msgs/msg/Marker',
    'PoseArray': 'geometry_msgs/msg/PoseArray',
    'PointStamped': 'geometry_msgs/msg/PointStamped',
}


class Recording:
    """Types and last messages of the topics of a bag."""

    def __init__(self, path: Path) -> None:
        self.types = dict(DRAWN)
        self.last: dict[str, Any] = {}
        #: Values by node and key.
        self.diagnostics: dict[str, dict[str, str]] = {}
        with AnyReader([path]) as reader:
            self.types |= {item.topic: item.msgtype for item in reader.connections}
            for connection, _, raw in reader.messages():
                message: Any = reader.deserialize(raw, connection.msgtype)
                self.last[connection.topic] = message
                if connection.topic == '/diagnostics':
                    for status in message.status:
                        values = {item.key: item.value for item in status.values}
                        name = f'{status.hardware_id}/{status.name}'
                        self.diagnostics.setdefault(name, {}).update(values)

    def number(self, topic: str, path: str) -> float:
        """Return a field of the last message by its path, ``a.b[0]``."""
        value = self.last[topic]
        for name, index in re.findall(r'(\w+)(?:\[(\d+)\])?', path):
            value = getattr(value, name)
            if index:
                value = value[int(index)]
        return float(value)

    def curve(self, name: str) -> float:
        """Return the last value of a curve by its name in PlotJuggler."""
        _, topic, path = name.split('/', 2)
        topic = f'/{topic}'
        if topic == '/diagnostics':
            # Hardware id, name with its slash, and key.
            found = re.fullmatch(r'(\w+//\w+: \w+)/(.+)', path)
            assert found
            return float(self.diagnostics[found[1]][found[2]])
        if self.types[topic] == 'sensor_msgs/msg/JointState':
            joint, field = path.split('/')
            message = self.last[topic]
            return float(getattr(message, field)[message.name.index(joint)])
        return self.number(topic, path.replace('/', '.'))


@pytest.fixture(scope='module')
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Return a bag of an insertion with the shipped parameters, recorded by the nodes."""
    folder = tmp_path_factory.mktemp('layouts')
    settings = yaml.safe_load((CONFIG / 'insertion.yaml').read_text())
    counts: dict[str, int] = {}
    heard: list[str] = []

    def hear(message: DiagnosticArray) -> None:
        for report in read_reports(message):
            heard.append(report.node)
            if isinstance(report.status, RecorderStatus):
                counts.update(report.status.recorded)

    with Graph(folder / 'logs') as graph:
        probe = graph.node('probe')
        probe.create_subscription(DiagnosticArray, '/diagnostics', hear, 10)
        recorder = graph.start('recorder', {'path': str(folder / 'bag')})
        for node in NODES:
            graph.start(node, settings[f'/**/{node}']['ros__parameters'])
        # On a fresh machine the first nodes compile, in parallel with other tests.
        graph.spin_until(
            lambda: all(counts.get(topic, 0) for topic in STREAMS), 'the streams', 400.0
        )
        # The recorder has subscribed, so further messages of the nodes are recorded.
        heard.clear()
        graph.spin_until(lambda: set(heard) >= {'/plant', '/controller'}, 'diagnostics')
        heard.clear()
        graph.spin_until(lambda: '/recorder' in heard, 'the recorder')
        recorder.interrupt()
    return Recording(folder / 'bag')


def test_rviz_displays_match_topic_types(recording: Recording) -> None:
    """
    Each display has a topic of its type, a matching QoS, and a frame of the suite.

    Names of topics are relative: RViz may run in the namespace of one of several robots.
    """
    layout = yaml.safe_load((CONFIG / 'insertion.rviz').read_text())['Visualization Manager']
    shown = {}
    for display in layout['Displays']:
        if 'Topic' in display:
            topic = display['Topic']
            assert not topic['Value'].startswith('/')
            name = f'/{topic["Value"]}'
            shown[name] = DISPLAYS[display['Class'].removeprefix('rviz_default_plugins/')]
            # Sensor QoS of the nodes; RViz would receive nothing otherwise.
            assert (topic['Reliability Policy'], topic['Durability Policy']) == (
                'Best Effort',
                'Volatile',
            )
            assert recording.types[name] == shown[name]
    assert {*DRAWN, '/tip_deflection'} <= shown.keys()
    frame = layout['Global Options']['Fixed Frame']
    assert recording.last['/tip_deflection'].header.frame_id == frame


def panels(node: Any) -> set[str]:
    """Return the panels of a Foxglove arrangement."""
    if isinstance(node, str):
        return {node}
    return panels(node['first']) | panels(node['second'])


def test_foxglove_plots_fields_of_the_recording(recording: Recording) -> None:
    """Each path is a number of a recorded topic, and every panel is placed."""
    layout = json.loads((CONFIG / 'insertion.foxglove.json').read_text())
    configuration: Mapping[str, Any] = layout['configById']
    assert panels(layout['layout']) == configuration.keys()
    plotted = set()
    for name, panel in configuration.items():
        for line in panel.get('paths', ()):
            topic, _, path = line['value'].partition('.')
            recording.number(topic, path)
            # Plotted over the sample time.
            assert recording.last[topic].header.stamp.sec > 0
            plotted.add(topic)
        if name.startswith('3D!'):
            assert panel['topics'].keys() <= recording.types.keys()
            assert panel['followTf'] == recording.last['/tip_deflection'].header.frame_id
        if 'topicToRender' in panel:
            assert recording.types[panel['topicToRender']] == 'diagnostic_msgs/msg/DiagnosticArray'
            hardware = panel.get('selectedHardwareId', 'needle')
            node = panel.get('selectedName', '/plant: state')
            assert f'{hardware}/{node}' in recording.diagnostics
    assert set(STREAMS) - {'/ground_truth'} <= plotted


def test_plotjuggler_finds_every_curve(recording: Recording) -> None:
    """Each curve is a number with the name that PlotJuggler generates."""
    root = ET.parse(CONFIG / 'insertion.plotjuggler.xml').getroot()  # noqa: S314
    names = [curve.attrib['name'] for curve in root.iter('curve')]
    for name in names:
        recording.curve(name)
    assert len(names) == len(set(names)) > 10
    for splitter in root.iter('DockSplitter'):
        sizes = splitter.attrib['sizes'].split(';')
        assert int(splitter.attrib['count']) == len(splitter) == len(sizes)


@pytest.mark.parametrize(
    'name', ['/joint_states/insertion/force', '/joint_states/elbow/position', '/tip/point/z']
)
def test_missing_curve_is_reported(recording: Recording, name: str) -> None:
    """Wrong field, joint or topic."""
    with pytest.raises((AttributeError, KeyError, ValueError)):
        recording.curve(name)
