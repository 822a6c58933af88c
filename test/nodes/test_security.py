# SPDX-License-Identifier: Apache-2.0
"""SROS2 policies match the nodes, and no node starts without credentials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
import os
from pathlib import Path
import shutil
import subprocess
import sys

from lxml import etree
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_insertion.nodes import NODES
from needle_insertion.watch.watch_node import watching
from needle_ros.base_node import BaseNode
from needle_ros.errors import ParameterError
from needle_ros.network import LOCAL, PROFILES, RANGE, stay_local
import pytest
from reproduction.protocol import SHIPPED_BAGS
from support.installed import node_class
from support.policies import ACTION, NOT_RECORDED, POLICY, Profile, REPORTS
from support.ros_graph import RosGraph

#: Parameters required by each node, and parameters that enable all of its topics.
SETTINGS: Mapping[str, list[dict[str, object]]] = {
    'plant': [{'lockstep': True}, {'use_sim_time': True, 'mode': 'robot'}],
    'controller': [{'use_sim_time': True}, {'deflection_feedback': 'ground_truth'}],
    'steering': [{'use_sim_time': True}],
    'identification': [{'live': True, 'use_sim_time': True}],
    'recorder': [{'path': 'bag', 'use_sim_time': True}],
    'player': [{'path': str(SHIPPED_BAGS / 'friction_01'), 'use_sim_time': True}],
    'slicer': [{'use_sim_time': True}],
}

#: Topics that depend on the other nodes.
FOR_ALL = {'recorder': 'subscribe', 'player': 'publish'}


def used(node: BaseNode) -> Profile:
    """Return the publishers, subscriptions and services of a node, except for actions."""
    name, namespace = node.get_name(), node.get_namespace()
    return Profile(
        *(
            frozenset(item for item, _ in look(name, namespace) if ACTION not in item)
            for look in (
                node.get_publisher_names_and_types_by_node,
                node.get_subscriber_names_and_types_by_node,
                node.get_service_names_and_types_by_node,
                node.get_client_names_and_types_by_node,
            )
        )
    )


def made(node: BaseNode) -> Profile:
    """Return the created entities of a node, before their discovery."""
    return Profile(
        frozenset(item.topic_name for item in node.publishers),
        frozenset(item.topic_name for item in node.subscriptions),
        frozenset(node.resolve_service_name(item.srv_name) for item in node.services),
        frozenset(node.resolve_service_name(item.srv_name) for item in node.clients),
    )


def is_seen(node: BaseNode) -> bool:
    """Return whether all entities of a node are discovered."""
    return all(map(frozenset.issubset, made(node), used(node)))


def filled(settings: Mapping[str, object], folder: Path) -> dict[str, object]:
    """Return parameters with the name of a new bag."""
    return {
        key: str(folder / 'bag') if value == 'bag' else value for key, value in settings.items()
    }


def seen_in_graph(folder: Path, name: str, tries: int = 3) -> Profile:
    """
    Return the entities of a node with those that rcl creates, known from the graph only.

    On a busy machine Fast DDS 2.14 may permanently lose an own topic of a node, so that another
    node has to observe it.
    """
    with RosGraph(folder) as graph:
        node = graph.add(node_class(name), parameters=filled(SETTINGS[name][0], folder))
        try:
            graph.spin_until(partial(is_seen, node), 'all entities', timeout=20.0)
            return used(node)
        except GraphError:
            if tries == 1:
                raise
        finally:
            node.stop()
            shutil.rmtree(folder / 'bag', ignore_errors=True)
    return seen_in_graph(folder, name, tries - 1)


@pytest.mark.requirement('S-116', 'S-178', 'S-179', 'S-180', 'S-181', 'S-182')
@pytest.mark.parametrize('name', NODES)
def test_policy_equals_the_entities_of_each_node(
    ros_graph: RosGraph, tmp_path: Path, name: str
) -> None:
    """Every topic and service of the node, and no others."""
    uses = [seen_in_graph(tmp_path, name)]
    for settings in SETTINGS[name]:
        node = ros_graph.add(node_class(name), parameters=filled(settings, tmp_path))
        uses.append(made(node))
        node.stop()
    together = Profile(*map(frozenset().union, *uses))
    # `test_trajectory_action` compares the actions.
    entities = ('publish', 'subscribe', 'reply', 'request')
    for rule, allowed, there in zip(entities, POLICY[name], together, strict=False):
        assert there <= allowed, rule
        if FOR_ALL.get(name) != rule:
            assert there == allowed, rule


@pytest.mark.requirement('S-178', 'S-180')
def test_recorder_and_player_may_use_all_topics() -> None:
    """Each request has a node that answers."""
    said = frozenset().union(*(profile.publish for profile in POLICY.values())) - NOT_RECORDED
    assert POLICY['recorder'].subscribe == said - REPORTS
    assert POLICY['player'].publish - NOT_RECORDED == said - REPORTS
    answered = frozenset().union(*(profile.reply for profile in POLICY.values()))
    for name, profile in POLICY.items():
        assert profile.request <= answered, name
        # A name without a publisher is an error of the policy.
        assert profile.subscribe <= said, name
    commanding = {n for n, profile in POLICY.items() if '/wrench_command' in profile.publish}
    assert commanding == {'controller', 'player'}


@pytest.mark.requirement('S-183', 'S-184')
def test_enforced_security_rejects_nodes_without_credentials(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """Also with a middleware that cannot check them."""
    probe = ros_graph.node('probe')
    (tmp_path / 'enclaves').mkdir()
    ended = subprocess.run(
        [sys.executable, '-m', NODES['plant']],
        env={
            **ros_graph.environment,
            'ROS_SECURITY_ENABLE': 'true',
            'ROS_SECURITY_STRATEGY': 'Enforce',
            'ROS_SECURITY_KEYSTORE': str(tmp_path),
        },
        capture_output=True,
        text=True,
        timeout=120.0,
        check=False,
    )
    assert ended.returncode != 0
    assert 'security' in ended.stderr.lower()
    assert probe.count_publishers('joint_states') == 0


@pytest.mark.requirement('S-346')
@pytest.mark.parametrize('strategy', ['Enforce', 'Permissive', ''])
@pytest.mark.parametrize('enable', ['true', 'True', '1'])
def test_requested_security_is_not_ignored(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, enable: str, strategy: str
) -> None:
    """Without a keystore, or with a value that ROS 2 does not know: one line."""
    monkeypatch.setenv('ROS_SECURITY_ENABLE', enable)
    monkeypatch.setenv('ROS_SECURITY_STRATEGY', strategy)
    monkeypatch.delenv('ROS_SECURITY_KEYSTORE', raising=False)
    said = (
        'ROS_SECURITY_KEYSTORE names no keystore' if enable == 'true' else 'must be true or false'
    )
    with pytest.raises(ParameterError, match=said), Graph(tmp_path):
        pass
    with pytest.raises(ParameterError, match=said), watching(control=False):
        pass
    if strategy == 'Permissive':
        ended = subprocess.run(
            [sys.executable, '-m', NODES['plant']],
            capture_output=True,
            text=True,
            timeout=120.0,
            check=False,
        )
        assert ended.returncode == 2
        (line,) = ended.stderr.splitlines()
        assert said in line


@pytest.mark.requirement('S-157', 'S-160')
def test_started_nodes_stay_on_this_machine(ros_graph: RosGraph) -> None:
    """Range and transports of all processes, unless the environment opens nodes and launch."""
    assert LOCAL.items() <= ros_graph.environment.items()
    closed: list[dict[str, str]] = [{}, {RANGE: 'LOCALHOST'}]
    left: list[dict[str, str]] = [
        {RANGE: 'SUBNET'},
        {RANGE: 'OFF'},
        # Transports of external profiles are not changed.
        {RANGE: 'LOCALHOST', PROFILES[0]: 'own.xml'},
        {RANGE: 'LOCALHOST', 'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'},
    ]
    for environment in closed:
        stay_local(environment)
        assert environment == LOCAL
    for environment in left:
        before = dict(environment)
        stay_local(environment)
        assert environment == before


@pytest.mark.requirement('S-154', 'S-156')
def test_profile_has_one_transport_on_this_machine() -> None:
    """UDP on 127.0.0.1, without the default transports, of which one is shared memory."""
    names = {'f': 'http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles'}
    tree = etree.parse(LOCAL[PROFILES[0]])

    def texts(path: str) -> list[str]:
        return [one.text for one in tree.iterfind(f'.//f:{path}', names)]

    assert texts('type') == ['UDPv4']
    assert texts('interfaceWhiteList/f:address') == ['127.0.0.1']
    assert texts('userTransports/f:transport_id') == texts('transport_descriptor/f:transport_id')
    assert texts('useBuiltinTransports') == ['false']


@pytest.mark.requirement('S-159')
@pytest.mark.parametrize('range_', ['LOCALHOST', 'SUBNET'])
def test_local_nodes_discover_each_other(ros_graph: RosGraph, range_: str) -> None:
    """A local node without the profile receives the plant topics, and is discovered."""
    ros_graph.start('plant')
    bare = {name: value for name, value in ros_graph.environment.items() if name not in LOCAL}
    neighbor = subprocess.run(
        [sys.executable, '-c', NEIGHBOR],
        env={**bare, RANGE: range_},
        capture_output=True,
        text=True,
        check=True,
        timeout=60.0,
    )
    heard, found = neighbor.stdout.split()
    assert (int(heard) > 0, found) == (True, '1')


#: Waits until it receives the plant topics and is discovered.
NEIGHBOR = """
import time
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node('neighbor')
heard = []
node.create_subscription(JointState, 'joint_states', heard.append, qos_profile_sensor_data)
begin = time.monotonic()
while time.monotonic() - begin < 20.0 and not (heard and node.count_subscribers('wrench_command')):
    rclpy.spin_once(node, timeout_sec=0.01)
print(len(heard), node.count_subscribers('wrench_command'))
"""

#: Another machine: two network namespaces connected by a virtual cable.
CABLE = """
link add {a} type veth peer name {b}
link set {a} netns {a}
link set {b} netns {b}
-n {a} addr add 10.77.0.1/24 dev {a}
-n {b} addr add 10.77.0.2/24 dev {b}
-n {a} link set lo up
-n {b} link set lo up
-n {a} link set {a} up
-n {b} link set {b} up
-n {a} route add default dev {a}
-n {b} route add default dev {b}
"""

#: An external node there commands forces for some seconds, and prints the number of discovered
#: plants.
STRANGER = """
import time
from geometry_msgs.msg import WrenchStamped
from needle_ros.base_node import COMMAND
import rclpy
rclpy.init()
node = rclpy.create_node('stranger')
publisher = node.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
push, found, begin = WrenchStamped(), 0, time.monotonic()
push.wrench.force.y = 5.0
while time.monotonic() - begin < 5.0:
    publisher.publish(push)
    rclpy.spin_once(node, timeout_sec=0.01)
    found = max(found, publisher.get_subscription_count())
print(found)
"""


@pytest.fixture
def cable() -> Iterator[tuple[str, str]]:
    """Return the names of two connected network namespaces."""
    ip = shutil.which('ip')
    if ip is None or os.geteuid() != 0:
        pytest.skip('making network namespaces needs root and ip')
    ends = f'needle-a{os.getpid()}', f'needle-b{os.getpid()}'
    try:
        for end in ends:
            made = subprocess.run([ip, 'netns', 'add', end], capture_output=True, check=False)
            if made.returncode:
                pytest.skip(f'this machine has no network namespaces: {made.stderr!r}')
        for line in CABLE.format(a=ends[0], b=ends[1]).strip().splitlines():
            made = subprocess.run([ip, *line.split()], capture_output=True, check=False)
            if made.returncode:
                pytest.skip(f'this machine cannot join network namespaces: {made.stderr!r}')
        yield ends
    finally:
        for end in ends:
            subprocess.run([ip, 'netns', 'delete', end], capture_output=True, check=False)


@pytest.mark.requirement('S-155', 'S-158')
@pytest.mark.parametrize(('opened', 'found'), [({}, '0'), ({RANGE: 'SUBNET'}, '1')])
def test_another_machine_cannot_reach_the_plant(
    ros_graph: RosGraph, cable: tuple[str, str], opened: dict[str, str], found: str
) -> None:
    """The address of the plant as its static peer is not sufficient. SUBNET is."""
    here, there = cable
    bare = {name: value for name, value in ros_graph.environment.items() if name not in LOCAL}
    plant = subprocess.Popen(
        [shutil.which('ip') or '', 'netns', 'exec', here, sys.executable, '-m', NODES['plant']],
        env={**bare, **opened},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        assert plant.stdout is not None
        assert any('active' in line for line in plant.stdout)
        # Separate shared memory, as on another machine.
        script = f'mount -t tmpfs tmpfs /dev/shm && exec "{sys.executable}" -c "$0"'
        stranger = subprocess.run(
            [
                *('ip', 'netns', 'exec', there, 'unshare', '--mount', '--ipc'),
                *('bash', '-c', script, STRANGER),
            ],
            env={**bare, RANGE: 'SUBNET', 'ROS_STATIC_PEERS': '10.77.0.1'},
            capture_output=True,
            text=True,
            check=True,
            timeout=60.0,
        )
        assert stranger.stdout.split() == [found]
    finally:
        plant.kill()
        plant.communicate()
