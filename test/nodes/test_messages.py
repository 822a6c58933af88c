# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes agree with rmw, and nodes offer the topics of the contract."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, pairwise
from typing import Any

from geometry_msgs.msg import PointStamped, WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.plant_node import PlantNode
from needle_identification.bags.messages import deserialize, encode
from needle_identification.bags.topics import BagTopic
from needle_insertion.nodes import NODES
from needle_ros import wire
from needle_ros.base_node import message_class, profile, SENSOR
from needle_ros.contract import EVERY_NODE, Topic, TOPICS
from needle_ros.errors import MessageError
from needle_ros.status import NodeStatus
from needle_ros.timing import nanoseconds
from needle_ros.wire import JOINT_STATE, MessageReader, POINT, Reading, Template, WRENCH
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from reproduction.protocol import SHIPPED_BAGS
from sensor_msgs.msg import JointState
from support.installed import node_class
from support.ros_graph import RosGraph

numbers = st.lists(st.floats(allow_nan=False), min_size=9, max_size=9)
stamps = st.integers(0, 2**31 * 10**9 - 1)
words = st.text('ab_é→', max_size=9)
lengths = st.tuples(*[st.integers(0, 3)] * 3)


def content(message: Any) -> Reading:
    """Return stamp, frame, names and numbers of an rclpy message."""
    header = message.header
    names: Sequence[str] = ()
    values: tuple[Sequence[float], ...]
    if isinstance(message, JointState):
        names, values = message.name, (message.position, message.velocity, message.effort)
    elif isinstance(message, WrenchStamped):
        force, torque = message.wrench.force, message.wrench.torque
        values = ((force.x, force.y, force.z, torque.x, torque.y, torque.z),)
    else:
        values = ((message.point.x, message.point.y, message.point.z),)
    return Reading(
        nanoseconds(header.stamp), header.frame_id, tuple(names), tuple(map(tuple, values))
    )


def check(type_name: str, template: Template, reading: Reading) -> Any:
    """Compare with rmw, and with rosbags, which checks the length, in both directions."""
    data = template.serialize(reading.stamp, *chain(*reading.values))
    assert encode(deserialize(BagTopic('/t', type_name), data)) == data
    message = deserialize_message(data, message_class(type_name))
    assert Template.of(data, type_name).read(data) == template.read(data) == reading
    # rmw writes arbitrary bytes into padding.
    data = serialize_message(message)
    assert template.read(data) == content(message) == reading
    # It also appends some after empty arrays.
    assert (
        Template.of(data, type_name).read(data) == MessageReader(type_name).read(data) == reading
    )
    return message


@given(stamps, words, st.lists(words, max_size=3), lengths, numbers)
def test_joint_states_agree_with_rmw(
    stamp: int, frame: str, names: list[str], counts: tuple[int, int, int], values: list[float]
) -> None:
    """All array lengths, which determine the alignment of fields."""
    ends = [sum(counts[:k]) for k in range(4)]
    blocks = tuple(tuple(values[ends[k] : ends[k + 1]]) for k in range(3))
    template = Template(JOINT_STATE, frame, names=names, counts=counts)
    message = check(JOINT_STATE, template, Reading(stamp, frame, tuple(names), blocks))
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
    assert message.header.frame_id == frame
    assert list(message.name) == names
    assert (tuple(message.position), tuple(message.velocity), tuple(message.effort)) == blocks


@given(stamps, words, numbers)
def test_wrenches_and_points_agree_with_rmw(stamp: int, frame: str, values: list[float]) -> None:
    for type_name, count in ((WRENCH, 6), (POINT, 3)):
        reading = Reading(stamp, frame, (), (tuple(values[:count]),))
        check(type_name, Template(type_name, frame), reading)


#: Same template twice, others, and back; invalid bytes.
JOINTS = [
    JointState(name=names, position=[float(k)] * len(names), effort=[0.5] * (k % 3))
    for k, names in enumerate([['d'], ['a', 'bc'], ['d'], [], ['é→'], ['é→']])
]
WRENCHES, POINTS = ([kind() for _ in range(3)] for kind in (WrenchStamped, PointStamped))
WRENCHES[2].header.frame_id = POINTS[2].header.frame_id = 'needle_base'
JUNK = [b'', b'\0\1\0\0', b'\0\1\0\0' + b'\xff' * 40]


@pytest.mark.parametrize(
    ('type_name', 'messages'),
    [(JOINT_STATE, JOINTS), (WRENCH, WRENCHES), (POINT, POINTS)],
    ids=['joints', 'wrench', 'point'],
)
def test_node_parses_any_message(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch, type_name: str, messages: list[Any]
) -> None:
    """As serialized by rclpy; a change creates a new template. Invalid messages are counted."""
    made = []
    of = Template.of

    def counted(message: bytes, kind: str) -> Template:
        template = of(message, kind)
        made.append(template)
        return template

    monkeypatch.setattr(wire.Template, 'of', counted)
    node, teller = ros_graph.add(PlantNode, start=False), ros_graph.node('teller')
    taken: list[Reading] = []
    topic = Topic(name='words', type_name=type_name, publisher='user', meaning='')
    node.listen(topic, taken.append)
    sender = teller.create_publisher(message_class(type_name), 'words', SENSOR)
    ros_graph.spin_until(sender.get_subscription_count, 'the reader')
    twice = [message for message in messages for _ in range(2)]
    for message in [*JUNK, *twice]:
        sender.publish(message)
    ros_graph.spin_until(lambda: len(taken) == len(twice), 'the messages')
    assert taken == [content(message) for message in twice]
    shapes = [(one.frame, one.names, [len(block) for block in one.values]) for one in taken]
    # The first template is an empty message.
    empty = ('', (), [0, 0, 0] if type_name == JOINT_STATE else [len(taken[0].values[0])])
    assert len(made) == sum(a != b for a, b in pairwise([empty, *shapes]))
    assert node.invalid['words'] == len(JUNK)
    reports = ros_graph.statuses(teller, NodeStatus)
    ros_graph.spin_until(
        lambda: any(one.invalid_messages == {'words': len(JUNK)} for one in reports), 'the count'
    )


def test_missing_message_type_is_reported() -> None:
    """As an error of the suite, not as an ImportError."""
    with pytest.raises(MessageError, match='lab_msgs/msg/Thing is not installed'):
        message_class('lab_msgs/msg/Thing')


@pytest.mark.parametrize('name', NODES)
def test_nodes_offer_the_topics_of_the_contract(
    ros_graph: RosGraph, tmp_path: Any, name: str
) -> None:
    """Each topic with its type and QoS, and no other topic."""
    parameters: dict[str, dict[str, object]] = {
        'plant': {'publish_clock': True},
        'steering': {'use_sim_time': True},
        'recorder': {'path': str(tmp_path / 'bag')},
        'player': {'path': str(SHIPPED_BAGS / 'friction_01')},
    }
    node = ros_graph.add(node_class(name), parameters=parameters.get(name, {}))
    offered = {publisher.topic_name: publisher for publisher in node.publishers}
    node.stop()
    expected = {
        topic.name.replace('~', f'/{name}').join(('' if topic.name[0] in '~/' else '/', '')): topic
        for topic in TOPICS
        if topic.publisher == EVERY_NODE or name in topic.publisher.split(', ')
    }
    for topic, described in expected.items():
        publisher = offered[topic]
        assert publisher.msg_type is message_class(described.type_name), topic
        wanted, given = profile(described.qos), publisher.qos_profile
        for kind in ('reliability', 'durability', 'depth'):
            assert getattr(given, kind) == getattr(wanted, kind), (topic, kind)
    if name != 'player':
        of_rcl = {'/rosout', '/parameter_events', f'/{name}/transition_event'}
        assert offered.keys() - expected.keys() <= of_rcl
