"""Who may do what in the graph: policies that fit the nodes, and nothing without credentials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import NamedTuple

from lxml import etree
from needle_insertion.experiment.node_process import GraphError
from needle_insertion.experiment.protocol import SHIPPED_BAGS
from needle_insertion.nodes import NODES
from needle_ros.base_node import BaseNode
from needle_ros.network import LOCAL, PROFILES, RANGE, stay_local
import pytest
from support.installed import node_class, ROOT
from support.ros_graph import RosGraph

POLICIES = ROOT / 'config/security/policies.xml'

#: Parameters that a node must have to start, and those that make it use all it may use.
SETTINGS: Mapping[str, list[dict[str, object]]] = {
    'plant': [{'lockstep': True}, {'use_sim_time': True, 'mode': 'robot'}],
    'controller': [{'use_sim_time': True}, {'deflection_feedback': 'ground_truth'}],
    'steering': [{'use_sim_time': True}],
    'identification': [{'live': True, 'use_sim_time': True}],
    'recorder': [{'path': 'bag', 'use_sim_time': True}],
    'player': [{'path': str(SHIPPED_BAGS / 'friction_01'), 'use_sim_time': True}],
    'slicer': [{'use_sim_time': True}],
}

#: What these may record or play depends on the other nodes.
FOR_ALL = {'recorder': 'subscribe', 'player': 'publish'}

#: Published by every node, and recorded by none.
NOT_RECORDED = {'/rosout', '/parameter_events'}

#: Reports to a plant in lock-step, which are not recorded.
REPORTS = {'/joint_states/_processed', '/joint_states/_recorded'}


class Profile(NamedTuple):
    """Names that a node may use, or uses."""

    publish: frozenset[str]
    subscribe: frozenset[str]
    reply: frozenset[str]
    request: frozenset[str]


def policies() -> dict[str, Profile]:
    """Read the policy file as sros2 does: includes first, then names."""
    tree = etree.parse(POLICIES)
    tree.xinclude()
    found = {}
    for context in tree.iterfind('contexts/context'):
        (profile,) = context.iterfind('profiles/profile')
        node, namespace = profile.get('node'), profile.get('ns')
        allowed: dict[str, set[str]] = {rule: set() for rule in Profile._fields}
        for block in profile.iterchildren('topics', 'services'):
            for rule in allowed.keys() & block.attrib.keys():
                assert block.get(rule) == 'ALLOW'
                for name in (item.text.replace('~', f'{namespace}{node}') for item in block):
                    allowed[rule].add(name if name.startswith('/') else namespace + name)
        assert context.get('path') == f'/needle_insertion/{node}'
        found[node] = Profile(**{rule: frozenset(names) for rule, names in allowed.items()})
    return found


POLICY = policies()


def used(node: BaseNode) -> Profile:
    """Return what a node offers and listens to, as the graph has it."""
    name, namespace = node.get_name(), node.get_namespace()
    return Profile(
        *(
            frozenset(item for item, _ in look(name, namespace))
            for look in (
                node.get_publisher_names_and_types_by_node,
                node.get_subscriber_names_and_types_by_node,
                node.get_service_names_and_types_by_node,
                node.get_client_names_and_types_by_node,
            )
        )
    )


def made(node: BaseNode) -> Profile:
    """Return what a node has made itself; the graph comes to know it a moment later."""
    return Profile(
        frozenset(item.topic_name for item in node.publishers),
        frozenset(item.topic_name for item in node.subscriptions),
        frozenset(node.resolve_service_name(item.srv_name) for item in node.services),
        frozenset(node.resolve_service_name(item.srv_name) for item in node.clients),
    )


def is_seen(node: BaseNode) -> bool:
    """Tell whether the graph knows all that a node has made."""
    return all(map(frozenset.issubset, made(node), used(node)))


def filled(settings: Mapping[str, object], folder: Path) -> dict[str, object]:
    """Return parameters with the name of a bag that may be made."""
    return {
        key: str(folder / 'bag') if value == 'bag' else value for key, value in settings.items()
    }


def seen_in_graph(folder: Path, name: str, tries: int = 3) -> Profile:
    """
    Return what a node uses with what rcl makes for every node, which the graph alone knows.

    On a machine that is busy Fast DDS 2.14 may lose one of a node's own topics for good, so that
    another node has to show it.
    """
    with RosGraph(folder) as graph:
        node = graph.add(node_class(name), parameters=filled(SETTINGS[name][0], folder))
        try:
            graph.spin_until(partial(is_seen, node), 'all that it has made', timeout=20.0)
            return used(node)
        except GraphError:
            if tries == 1:
                raise
        finally:
            node.stop()
            shutil.rmtree(folder / 'bag', ignore_errors=True)
    return seen_in_graph(folder, name, tries - 1)


@pytest.mark.parametrize('name', NODES)
def test_each_node_may_do_what_it_does_and_no_more(
    ros_graph: RosGraph, tmp_path: Path, name: str
) -> None:
    """The policy names every topic and service that the node has, and none that it never has."""
    uses = [seen_in_graph(tmp_path, name)]
    for settings in SETTINGS[name]:
        node = ros_graph.add(node_class(name), parameters=filled(settings, tmp_path))
        uses.append(made(node))
        node.stop()
    together = Profile(*map(frozenset().union, *uses))
    for rule, allowed, there in zip(Profile._fields, POLICY[name], together, strict=True):
        assert there <= allowed, rule
        if FOR_ALL.get(name) != rule:
            assert there == allowed, rule


def test_all_that_nodes_say_can_be_recorded_and_played() -> None:
    """Recorder and player know every topic of the others; each request has a node to answer."""
    said = frozenset().union(*(profile.publish for profile in POLICY.values())) - NOT_RECORDED
    assert POLICY['recorder'].subscribe == said - REPORTS
    assert POLICY['player'].publish - NOT_RECORDED == said - REPORTS
    answered = frozenset().union(*(profile.reply for profile in POLICY.values()))
    for name, profile in POLICY.items():
        assert profile.request <= answered, name
        # A name that nobody publishes is a slip.
        assert profile.subscribe <= said, name
    commanding = {n for n, profile in POLICY.items() if '/wrench_command' in profile.publish}
    assert commanding == {'controller', 'player'}


def test_no_node_starts_without_credentials_where_they_are_enforced(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """A node that has none, or whose middleware cannot check them, ends before it runs bare."""
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


def test_what_we_start_stays_on_this_machine(ros_graph: RosGraph) -> None:
    """Range and transports of our processes; of nodes and launch unless the environment opens."""
    assert LOCAL.items() <= ros_graph.environment.items()
    closed: list[dict[str, str]] = [{}, {RANGE: 'LOCALHOST'}]
    left: list[dict[str, str]] = [
        {RANGE: 'SUBNET'},
        {RANGE: 'OFF'},
        # What they say of transports is not ours to change.
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


@pytest.mark.parametrize('range_', ['LOCALHOST', 'SUBNET'])
def test_neighbors_find_each_other(ros_graph: RosGraph, range_: str) -> None:
    """A node of this machine that knows nothing of our profile hears the plant and finds it."""
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


#: Waits until it hears the plant and has found it.
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

#: Another machine: two network namespaces, joined by a cable.
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

#: A stranger there pushes for some seconds, and says how many plants it has found.
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
    """Return the names of two machines."""
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


@pytest.mark.parametrize(('opened', 'found'), [({}, '0'), ({RANGE: 'SUBNET'}, '1')])
def test_another_machine_cannot_reach_the_plant(
    ros_graph: RosGraph, cable: tuple[str, str], opened: dict[str, str], found: str
) -> None:
    """It names the plant's machine as its peer: that alone does not let it in. SUBNET does."""
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
        # Its own shared memory, as another machine has.
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
