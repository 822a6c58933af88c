"""Messages read and written as bytes are those of rmw."""

from itertools import pairwise
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics import ShapeError
from needle_dynamics.plant_node import PlantNode
from needle_identification import deserialize, encode, Topic
from needle_ros import base_node
from needle_ros.base_node import layout_of, reading_of, SENSOR
from needle_ros.packed import Layout, Reading
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from support.ros_graph import RosGraph

numbers = st.lists(st.floats(allow_nan=False), min_size=9, max_size=9)
stamps = st.integers(0, 2**31 * 10**9 - 1)
words = st.text('ab_é→', max_size=9)
lengths = st.tuples(*[st.integers(0, 3)] * 3)


def is_one(
    kind: type[PointStamped] | type[WrenchStamped] | type[JointState],
    layout: Layout,
    reading: Reading,
) -> PointStamped | WrenchStamped | JointState:
    """Hold against rmw, and against a reader that knows the length to the byte, both ways."""
    data = layout.serialize(reading.stamp, *sum(reading.values, ()))
    package, _, _ = kind.__module__.partition('.')
    assert encode(deserialize(Topic('/t', f'{package}/msg/{kind.__name__}'), data)) == data
    message = deserialize_message(data, kind)
    # What rmw writes has anything in its gaps.
    written = layout_of(kind, reading).deserialize(serialize_message(message))
    assert written == layout.deserialize(data) == reading_of(message) == reading
    return message


@given(stamps, words, st.lists(words, max_size=3), lengths, numbers)
def test_joint_states_are_those_of_rmw(
    stamp: int, frame: str, names: list[str], counts: tuple[int, ...], values: list[float]
) -> None:
    """Whatever the lengths, which decide where fields are aligned."""
    ends = [sum(counts[:k]) for k in range(4)]
    blocks = tuple(tuple(values[ends[k] : ends[k + 1]]) for k in range(3))
    layout = Layout(frame, names=names, counts=counts)
    message = is_one(JointState, layout, Reading(stamp, frame, tuple(names), blocks))
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
    assert message.header.frame_id == frame
    assert list(message.name) == names
    assert (tuple(message.position), tuple(message.velocity), tuple(message.effort)) == blocks


@given(stamps, words, numbers)
def test_wrenches_and_points_are_those_of_rmw(stamp: int, frame: str, values: list[float]) -> None:
    """Single numbers follow the header."""
    reading = Reading(stamp, frame, (), (tuple(values[:6]),))
    message = is_one(WrenchStamped, Layout(frame, numbers=6), reading)
    assert message.header.frame_id == frame
    force, torque = message.wrench.force, message.wrench.torque
    assert [force.x, force.y, force.z, torque.x, torque.y, torque.z] == values[:6]
    reading = Reading(stamp, frame, (), (tuple(values[:3]),))
    point = is_one(PointStamped, Layout(frame, numbers=3), reading).point
    assert [point.x, point.y, point.z] == values[:3]


layouts = st.tuples(words, st.lists(words, max_size=3), lengths)


@given(layouts, layouts, stamps, numbers)
def test_a_layout_does_not_read_another(
    one: tuple[str, list[Any], tuple[int, int, int]] | tuple[str, list[str], tuple[int, int, int]],
    other: tuple[str, list[Any], tuple[int, int, int]]
    | tuple[str, list[str], tuple[int, int, int]],
    stamp: int,
    values: list[float],
) -> None:
    """Nothing is taken for what it is not."""
    frame, names, counts = other
    layout = Layout(frame, names=names, counts=counts)
    data = layout.serialize(stamp, *values[: sum(counts)])
    reading = Layout(one[0], names=one[1], counts=one[2]).deserialize(data)
    assert (reading is not None) == (one == other)


@pytest.mark.parametrize('length', [0, 3, 12, 75])
def test_a_message_cut_short_is_none(length: int) -> None:
    """Fewer bytes than the layout has; more do not matter, nor do options of the encoding."""
    layout = Layout('needle_base', numbers=6)
    data = layout.serialize(1, *[0.5] * 6)
    reading = layout.deserialize(data)
    assert len(data) == 76
    assert reading.values == ((0.5,) * 6,)
    assert layout.deserialize(data[:length]) is None
    assert layout.deserialize(data + b'\0') == reading
    assert layout.deserialize(data[:2] + b'\0\3' + data[4:]) == reading


@pytest.mark.parametrize('count', [0, 5, 7])
def test_values_that_are_not_as_many_are_refused(count: int) -> None:
    """And do no harm to those that follow."""
    layout = Layout('needle_base', numbers=6)
    with pytest.raises(ShapeError, match=f'has 6 values, got {count}'):
        layout.serialize(1, *[0.5] * count)
    assert layout.deserialize(layout.serialize(1, *[0.5] * 6)).values == ((0.5,) * 6,)


#: The same layout twice, others, and back; what is no message at all.
JOINTS = [
    JointState(name=names, position=[float(k)] * len(names), effort=[0.5] * (k % 3))
    for k, names in enumerate([['d'], ['a', 'bc'], ['d'], [], ['é→'], ['é→']])
]
WRENCHES, POINTS = ([kind() for _ in range(3)] for kind in (WrenchStamped, PointStamped))
WRENCHES[2].header.frame_id = POINTS[2].header.frame_id = 'needle_base'
JUNK = [b'', b'\0\1\0\0', b'\0\1\0\0' + b'\xff' * 40]


@pytest.mark.parametrize('messages', [JOINTS, WRENCHES, POINTS], ids=['joints', 'wrench', 'point'])
def test_a_node_takes_any_layout(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch, messages: list[Any]
) -> None:
    """As rclpy writes them; it reads the first of each layout. Junk is counted, and said."""
    asked = []

    def deserialized(
        data: bytes, kind: type[PointStamped] | type[WrenchStamped] | type[JointState]
    ) -> PointStamped | WrenchStamped | JointState:
        asked.append(data)
        return deserialize_message(data, kind)

    monkeypatch.setattr(base_node, 'deserialize_message', deserialized)
    node, teller = ros_graph.add(PlantNode, start=False), ros_graph.node('teller')
    kind = type(messages[0])
    taken: list[Any] = []
    node.listen(kind, 'words', SENSOR, taken.append)
    sender = teller.create_publisher(kind, 'words', SENSOR)
    ros_graph.spin_until(sender.get_subscription_count, 'the reader')
    twice = [message for message in messages for _ in range(2)]
    for message in [*JUNK, *twice]:
        sender.publish(message)
    ros_graph.spin_until(lambda: len(taken) == len(twice), 'the messages')
    assert taken == [reading_of(message) for message in twice]
    shapes = [(one.frame, one.names, [len(block) for block in one.values]) for one in taken]
    assert len(asked) == len(JUNK) + 1 + sum(a != b for a, b in pairwise(shapes))
    assert node.unreadable['words'] == len(JUNK)
    told = ('messages of words that cannot be read', f'{len(JUNK)}')
    arrays = ros_graph.listen(teller, DiagnosticArray, '/diagnostics', 10)
    ros_graph.spin_until(
        lambda: told in [(v.key, v.value) for a in arrays for v in a.status[0].values], 'the count'
    )
