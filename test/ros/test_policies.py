# SPDX-License-Identifier: Apache-2.0
"""SROS2 reads the shipped policies, and their permissions agree with the contract of topics."""

from __future__ import annotations

from pathlib import Path
import shutil

from lxml import etree
from needle_insertion.nodes import NODES
from needle_ros.contract import EVERY_NODE, FOLLOW_JOINT_TRAJECTORY, TF, TOPICS, USER
import pytest
from support.installed import ROOT
from support.policies import load, NOT_RECORDED, POLICIES, POLICY, REPORTS

#: The user with the tools of ROS.
OPERATOR = 'operator'

#: Published by nodes of other packages only.
FOREIGN = {'ros2_control', 'robot_state_publisher'}


def complaints(path: Path = POLICIES) -> list[str]:
    """Return the reasons for which sros2 rejects a policy file."""
    tree = load(path)
    schema = etree.XMLSchema(etree.parse(ROOT / 'test/data/sros2_policy.xsd'))
    schema.validate(tree)
    # sros2 reads each child of `enclaves` as an enclave, also a comment, which a schema ignores.
    return [
        *(entry.message for entry in schema.error_log),
        *(
            f'line {child.sourceline}: comment between enclaves'
            for parent in tree.iterfind('enclaves')
            for child in parent
            if child.tag != 'enclave'
        ),
    ]


@pytest.mark.requirement('S-178', 'S-240')
def test_policies_are_valid_for_sros2() -> None:
    """Includes too."""
    assert complaints() == []


@pytest.mark.requirement('S-240')
@pytest.mark.parametrize(
    ('part', 'other'),
    [
        ('enclaves>', 'contexts>'),
        ('    <enclave path="/needle_insertion/operator">', '    <!-- x -->\n\\g<0>'),
        (' version="0.2.0"', ''),
        (' version="0.2.0"', ' version="0.1.0"'),
        ('/needle_insertion/steering"', '/needle_insertion/plant"'),
        (' node="plant"', ''),
        ('publish="ALLOW"', 'publish="YES"'),
        ('<topic>target</topic>', '<topic>*</topic>'),
        ('<topic>target</topic>', '<service>target</service>'),
    ],
)
def test_invalid_policies_are_reported(tmp_path: Path, part: str, other: str) -> None:
    """Each mutation is reported."""
    folder = shutil.copytree(POLICIES.parent, tmp_path / 'security')
    text = POLICIES.read_text()
    changed = text.replace(part, other.replace('\\g<0>', part))
    assert changed != text
    (folder / 'policies.xml').write_text(changed)
    assert complaints(folder / 'policies.xml')


@pytest.mark.requirement('S-179')
def test_each_node_and_the_user_have_an_enclave() -> None:
    assert POLICY.keys() == {*NODES, OPERATOR}


@pytest.mark.requirement('S-180', 'S-241')
def test_permissions_to_publish_agree_with_the_contract() -> None:
    """Each topic may be published by the nodes of the contract, and by the player if recorded."""
    for topic in TOPICS:
        if topic is TF:  # Optional, and not in the policies.
            continue
        publishers = {*NODES} if topic.publisher == EVERY_NODE else {*topic.publisher.split(', ')}
        wanted = {OPERATOR if name == USER else name for name in publishers - FOREIGN}
        for node in NODES if topic.name.startswith('~') else ['']:
            name = topic.name.replace('~', f'/{node}') if node else f'/{topic.name.lstrip("/")}'
            allowed = {n for n, profile in POLICY.items() if name in profile.publish}
            played = {'player'} if name not in NOT_RECORDED | REPORTS else set()
            own = wanted & {node} if node else wanted
            if topic.publisher == 'robot_state_publisher':
                assert not allowed
            elif own:
                assert allowed == own | played, name


@pytest.mark.requirement('S-249')
def test_goals_are_accepted_from_operator_and_steering_only() -> None:
    """Each action that may be called is executed by a node that receives trajectories."""
    offered = {node: profile.execute for node, profile in POLICY.items() if profile.execute}
    name = FOLLOW_JOINT_TRAJECTORY
    assert offered == {n: {name.replace('~', f'/{n}')} for n in ('plant', 'controller')}
    assert {*offered} == {n for n in NODES if '/joint_trajectory' in POLICY[n].subscribe} - {
        'recorder'
    }
    called = {node: profile.call for node, profile in POLICY.items() if profile.call}
    assert called == {OPERATOR: frozenset().union(*offered.values()), 'steering': offered['plant']}


@pytest.mark.requirement('S-241')
def test_policies_name_topics_of_the_contract_only() -> None:
    """Besides topics that rcl creates for each node."""
    names = {f'/{topic.name.lstrip("/")}' for topic in TOPICS if not topic.name.startswith('~')}
    own = {
        topic.name.replace('~', f'/{node}')
        for topic in TOPICS
        if topic.name.startswith('~')
        for node in NODES
    }
    life = {f'/{node}/transition_event' for node in NODES}
    for profile in POLICY.values():
        assert profile.publish | profile.subscribe <= names | own | life | NOT_RECORDED
