"""Messages of which only stamp and numbers are written."""

from geometry_msgs.msg import PointStamped, WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.base_node import Packed
from needle_identification.bag_io import deserialize, encode, Topic
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

numbers = st.lists(st.floats(allow_nan=False), min_size=9, max_size=9)
stamps = st.integers(0, 2**31 * 10**9 - 1)
words = st.text('abc_', max_size=9)


def is_one(kind, name, data, stamp, frame):
    """Read a message as rmw does, and as a reader does that knows its length to the byte."""
    assert encode(deserialize(Topic('/t', name), data)) == data
    message = deserialize_message(data, kind)
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
    assert message.header.frame_id == frame
    return message


@given(stamps, words, st.lists(words, max_size=3), st.tuples(*[st.integers(0, 3)] * 3), numbers)
def test_joint_states_are_those_of_rmw(stamp, frame, names, counts, values):
    """Whatever the lengths, which decide where fields are aligned."""
    data = Packed(frame, names=names, counts=counts).at(stamp, *values)
    read = is_one(JointState, 'sensor_msgs/msg/JointState', data, stamp, frame)
    assert list(read.name) == names
    assert [*read.position, *read.velocity, *read.effort] == values[: sum(counts)]
    assert (len(read.position), len(read.velocity), len(read.effort)) == counts


@given(stamps, words, numbers)
def test_wrenches_and_points_are_those_of_rmw(stamp, frame, values):
    """Single numbers follow the header."""
    data = Packed(frame, numbers=6).at(stamp, *values)
    read = is_one(WrenchStamped, 'geometry_msgs/msg/WrenchStamped', data, stamp, frame)
    force, torque = read.wrench.force, read.wrench.torque
    assert [force.x, force.y, force.z, torque.x, torque.y, torque.z] == values[:6]
    data = Packed(frame, numbers=3).at(stamp, *values)
    point = is_one(PointStamped, 'geometry_msgs/msg/PointStamped', data, stamp, frame).point
    assert [point.x, point.y, point.z] == values[:3]
