"""Messages read and written as bytes are those of rmw."""

from geometry_msgs.msg import PointStamped, WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.base_node import reading_of, SENSOR
from needle_dynamics.packed import Packed
from needle_dynamics.plant_node import PlantNode
from needle_identification.bag_io import deserialize, encode, Topic
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

numbers = st.lists(st.floats(allow_nan=False), min_size=9, max_size=9)
stamps = st.integers(0, 2**31 * 10**9 - 1)
words = st.text('abc_', max_size=9)
lengths = st.tuples(*[st.integers(0, 3)] * 3)


def is_one(kind, packed, stamp, values):
    """Hold against rmw, and against a reader that knows the length to the byte, both ways."""
    data = packed.at(stamp, *values)
    package, _, _ = kind.__module__.partition('.')
    topic = Topic('/t', f'{package}/msg/{kind.__name__}')
    assert encode(deserialize(topic, data)) == data
    message = deserialize_message(data, kind)
    # What rmw writes has anything in its gaps.
    assert packed.read(serialize_message(message)) == packed.read(data) == reading_of(message)
    return message


@given(stamps, words, st.lists(words, max_size=3), lengths, numbers)
def test_joint_states_are_those_of_rmw(stamp, frame, names, counts, values):
    """Whatever the lengths, which decide where fields are aligned."""
    packed = Packed(frame, names=names, counts=counts)
    read = is_one(JointState, packed, stamp, values)
    assert read.header.stamp.sec * 10**9 + read.header.stamp.nanosec == stamp
    assert read.header.frame_id == frame
    assert list(read.name) == names
    assert [*read.position, *read.velocity, *read.effort] == values[: sum(counts)]
    assert (len(read.position), len(read.velocity), len(read.effort)) == counts


@given(stamps, words, numbers)
def test_wrenches_and_points_are_those_of_rmw(stamp, frame, values):
    """Single numbers follow the header."""
    wrench = is_one(WrenchStamped, Packed(frame, numbers=6), stamp, values)
    assert wrench.header.frame_id == frame
    force, torque = wrench.wrench.force, wrench.wrench.torque
    assert [force.x, force.y, force.z, torque.x, torque.y, torque.z] == values[:6]
    point = is_one(PointStamped, Packed(frame, numbers=3), stamp, values).point
    assert [point.x, point.y, point.z] == values[:3]


layouts = st.tuples(words, st.lists(words, max_size=3), lengths)


@given(layouts, layouts, stamps, numbers)
def test_a_layout_does_not_read_another(one, other, stamp, values):
    """Nothing is taken for what it is not."""
    data = Packed(other[0], names=other[1], counts=other[2]).at(stamp, *values)
    reading = Packed(one[0], names=one[1], counts=one[2]).read(data)
    assert (reading is not None) == (one == other)


@pytest.mark.parametrize('length', [0, 3, 12, 67])
def test_a_message_cut_short_is_none(length):
    """Fewer bytes than the layout has."""
    packed = Packed('needle_base', numbers=6)
    assert packed.read(packed.at(1, *[0.5] * 6)) is not None
    assert len(packed.at(1, *[0.5] * 6)) > 67
    assert packed.read(packed.at(1, *[0.5] * 6)[:length]) is None


def test_a_reader_takes_any_layout(ros_graph):
    """Also one after another on a topic, as rclpy writes them; what is none is passed over."""
    node, teller = ros_graph.add(PlantNode, start=False), ros_graph.node('teller')
    taken = []
    node.listen(JointState, 'words', SENSOR, taken.append)
    sender = teller.create_publisher(JointState, 'words', SENSOR)
    ros_graph.spin_until(sender.get_subscription_count, 'the reader')
    messages = [
        JointState(name=names, position=[float(k)] * len(names), effort=[0.5] * (k % 3))
        for k, names in enumerate([['d'], ['d'], ['a', 'bc'], ['d'], [], ['é\u2192'], ['é\u2192']])
    ]
    for message in [b'', b'\0\1\0\0', b'\0\1\0\0' + b'\xff' * 40, *messages]:
        sender.publish(message)
    ros_graph.spin_until(lambda: len(taken) == len(messages), 'the messages')
    assert taken == [reading_of(message) for message in messages]
