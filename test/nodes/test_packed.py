"""Messages written in place."""

from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from needle_dynamics.base_node import CHANGES, Packed
from needle_identification.bag_io import deserialize, encode, Topic
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState


def joints(numbers):
    """Return joint states of six numbers."""
    return JointState(
        name=['insertion', 'rotation'],
        position=numbers[:2],
        velocity=numbers[2:4],
        effort=numbers[4:],
    )


def wrench(numbers):
    """Return a wrench of six numbers."""
    message = WrenchStamped()
    for part, own in ((message.wrench.force, numbers[:3]), (message.wrench.torque, numbers[3:])):
        part.x, part.y, part.z = own
    return message


def state(numbers):
    """Return joint states without efforts, of which rmw takes too much to be the length."""
    return JointState(
        name=['d', 'theta', 'q1'], position=numbers[:3], velocity=numbers[3:], effort=[]
    )


@pytest.mark.parametrize('frame', ['', 'a', 'needle_base'])
@pytest.mark.parametrize('kind', [joints, wrench, state])
def test_packed_bytes_are_those_of_the_message(frame, kind):
    """Whatever the alignment that the frame leads to, and whatever the numbers."""
    values = [1.0, -2.5, float('nan'), 4.0, float('inf'), 6.0]
    form, message = kind([CHANGES] * 6), kind(values)
    for one in (form, message):
        one.header.frame_id = frame
    message.header.stamp = Time(sec=12, nanosec=345)
    packed = Packed(form).at(12_000_000_345, *values)
    # Of this one nothing but what is in the message is written.
    name = f'{type(message).__module__.split(".")[0]}/msg/{type(message).__name__}'
    read = deserialize(Topic('/t', name), packed)
    assert packed == encode(read)
    again = deserialize(Topic('/t', name), serialize_message(message)[: len(packed)])
    assert encode(again) == packed
