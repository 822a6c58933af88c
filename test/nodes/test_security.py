"""Who may do what in the graph: policies that fit the nodes, and nothing without credentials."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from functools import partial
from pathlib import Path
import subprocess
import sys
from typing import NamedTuple

from lxml import etree
from needle_insertion.experiment.protocol import SHIPPED_BAGS
from needle_insertion.nodes import NODES
from needle_ros.base_node import BaseNode
import pytest
from support.installed import node_class, ROOT
from support.ros_graph import RosGraph

POLICIES = ROOT / 'config/security/policies.xml'

#: Parameters that a node must have to start, and those that make it use all it may use.
SETTINGS: Mapping[str, list[dict[str, object]]] = {
    'plant': [{'publish_clock': True}, {'use_sim_time': True, 'mode': 'robot'}],
    'controller': [{'use_sim_time': True}, {'deflection_feedback': 'ground_truth'}],
    'identification': [{'live': True, 'use_sim_time': True}],
    'recorder': [{'path': 'bag', 'use_sim_time': True}],
    'player': [{'path': str(SHIPPED_BAGS / 'friction_01'), 'use_sim_time': True}],
}

#: What these may record or play depends on the other nodes.
FOR_ALL = {'recorder': 'subscribe', 'player': 'publish'}

#: Published by every node, and recorded by none.
NOT_RECORDED = {'/rosout', '/parameter_events'}


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


@pytest.mark.parametrize('name', NODES)
def test_each_node_may_do_what_it_does_and_no_more(
    ros_graph: RosGraph, tmp_path: Path, name: str
) -> None:
    """The policy names every topic and service that the node has, and none that it never has."""
    uses = []
    for settings in SETTINGS[name]:
        parameters = {
            key: str(tmp_path / 'bag') if value == 'bag' else value
            for key, value in settings.items()
        }
        node = ros_graph.add(node_class(name), parameters=parameters)
        uses.append(made(node))
        if len(uses) == 1:
            # What rcl makes for every node is known to the graph only.
            ros_graph.spin_until(partial(is_seen, node), 'its topics and services in the graph')
            uses.append(used(node))
        node.stop()
    together = Profile(*map(frozenset().union, *uses))
    for rule, allowed, there in zip(Profile._fields, POLICY[name], together, strict=True):
        assert there <= allowed, rule
        if FOR_ALL.get(name) != rule:
            assert there == allowed, rule


def test_all_that_nodes_say_can_be_recorded_and_played() -> None:
    """Recorder and player know every topic of the others; each request has a node to answer."""
    said = frozenset().union(*(profile.publish for profile in POLICY.values())) - NOT_RECORDED
    assert POLICY['recorder'].subscribe == said
    assert POLICY['player'].publish - NOT_RECORDED == said
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
    """Our processes and the launch file look for others on this machine only, unless asked."""
    assert ros_graph.environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    launch = ast.parse((ROOT / 'launch/insertion.launch.py').read_text())
    calls = [ast.unparse(item) for item in ast.walk(launch) if isinstance(item, ast.Call)]
    assert "SetEnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', reach)" in calls
    assert "os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')" in calls
    assert "'discovery': ('', " in ast.unparse(launch)
