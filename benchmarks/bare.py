# SPDX-License-Identifier: Apache-2.0
"""
Bare rclpy nodes for comparison: they publish the same messages without any computation.

Run as ``python -m benchmarks.bare ROLE KIND``, with message objects or with serialized messages.
No package of the suite is imported, so that its memory and garbage collection do not slow down
these nodes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
import ctypes
import gc
import signal
import struct
import sys
import time
from typing import Any, Final

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped, WrenchStamped
import rclpy
from rclpy.executors import Executor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

#: Quality of service of the topics of the suite.
SENSOR: Final = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
COMMAND: Final = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
LATCHED: Final = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)

#: Messages of the plant for each sample, in order.
STREAMS: Final = {
    'base_wrench': WrenchStamped,
    'tip_deflection': PointStamped,
    'ground_truth': JointState,
    'joint_states': JointState,
}

#: Samples per second [Hz] and their period [ns].
RATE: Final = 1000
PERIOD: Final = 1_000_000_000 // RATE

#: Largest number of late samples per timer tick.
_BURST: Final = 10

_PR_SET_PDEATHSIG = 1


def _time_message(stamp: int) -> Time:
    """Convert a time [ns] to a message."""
    return Time(sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)


class Sender:
    """Publishes samples of the plant with new numbers in each message, as the plant does."""

    def __init__(self, node: Node) -> None:
        self._publishers = [node.create_publisher(t, n, SENSOR) for n, t in STREAMS.items()]
        self._wrench, self._tip = WrenchStamped(), PointStamped()
        self._wrench.header.frame_id, self._tip.header.frame_id = 'needle_base', 'needle_entry'
        self._truth = JointState(name=['d', 'theta', 'q1', 'q2'])
        self._joints = JointState(name=['insertion', 'rotation'])

    def destroy(self, node: Node) -> None:
        for publisher in self._publishers:
            node.destroy_publisher(publisher)

    def has_readers(self) -> bool:
        """Return whether each topic has a subscription."""
        return all(publisher.get_subscription_count() for publisher in self._publishers)

    def send(self, stamp: int, depth: float = 0.05) -> int:
        """
        Send a sample with a stamp [ns] and an insertion depth [m].

        Returns the time just before the last message, ``joint_states``, was sent [ns].
        """
        wrench, tip, truth, joints = self._wrench, self._tip, self._truth, self._joints
        stamped = _time_message(stamp)
        for message in (wrench, tip, truth, joints):
            message.header.stamp = stamped
        force, torque = wrench.wrench.force, wrench.wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = 0.0, 0.5, 0.0, 0.0, 0.0, 0.0
        tip.point.y, tip.point.z = depth, 0.0
        truth.position, truth.velocity = [0.15, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]
        joints.position, joints.velocity, joints.effort = [depth, 0.0], [0.0, 0.0], [0.5, 0.0]
        publishers = self._publishers
        publishers[0].publish(wrench)
        publishers[1].publish(tip)
        publishers[2].publish(truth)
        left = time.time_ns()
        publishers[3].publish(joints)
        return left


class BytesTemplate:
    """Serialized message whose time and groups of numbers, distinct at first, are replaced."""

    def __init__(self, message: Any, *groups: tuple[float, ...]) -> None:
        self._data = bytearray(serialize_message(message))
        packers = [struct.Struct(f'<{len(group)}d') for group in groups]
        self._parts = [
            (packer, self._data.index(packer.pack(*group)))
            for packer, group in zip(packers, groups, strict=True)
        ]

    def write(self, stamp: bytes, *groups: tuple[float, ...]) -> bytes:
        """Return the message with a serialized time and other numbers."""
        self._data[_STAMP] = stamp
        for (packer, at), group in zip(self._parts, groups, strict=True):
            packer.pack_into(self._data, at, *group)
        return bytes(self._data)

    def read(self, data: bytes, group: int = 0) -> tuple[float, ...]:
        """Return a group of the numbers of a message with the same names and frame."""
        packer, at = self._parts[group]
        return packer.unpack_from(data, at)


#: Time of the header in a serialized message.
_STAMP: Final = slice(4, 12)

_FORCE: Final = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


def _wrench() -> BytesTemplate:
    message = WrenchStamped()
    message.header.frame_id = 'needle_base'
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = _FORCE
    return BytesTemplate(message, _FORCE)


def _point() -> BytesTemplate:
    message = PointStamped()
    message.header.frame_id = 'needle_entry'
    message.point.x, message.point.y, message.point.z = 1.0, 2.0, 3.0
    return BytesTemplate(message, (1.0, 2.0, 3.0))


def _joint_state(*names: str, effort: bool = False) -> BytesTemplate:
    count = len(names)
    groups = [tuple(float(count * k + i + 1) for i in range(count)) for k in range(3)]
    message = JointState(name=names, position=groups[0], velocity=groups[1])
    if effort:
        message.effort = groups[2]
    return BytesTemplate(message, *groups[: 2 + effort])


class BytesSender:
    """Publishes samples as `Sender`, as serialized messages."""

    def __init__(self, node: Node) -> None:
        self._publishers = [node.create_publisher(t, n, SENSOR) for n, t in STREAMS.items()]
        self._templates = (
            _wrench(),
            _point(),
            _joint_state('d', 'theta', 'q1', 'q2'),
            _joint_state('insertion', 'rotation', effort=True),
        )

    def send(self, stamp: int, depth: float = 0.05) -> None:
        time = struct.pack('<iI', stamp // 1_000_000_000, stamp % 1_000_000_000)
        wrench, tip, truth, joints = self._templates
        first, second, third, last = self._publishers
        first.publish(wrench.write(time, (0.0, 0.5, 0.0, 0.0, 0.0, 0.0)))
        second.publish(tip.write(time, (0.0, depth, 0.0)))
        third.publish(truth.write(time, (0.15, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
        last.publish(joints.write(time, (depth, 0.0), (0.0, 0.0), (0.5, 0.0)))


class Clocked(Node, ABC):
    """Runs periodically while the topic ``run`` is true, and catches up missed periods."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._timer: Any = None
        self.create_subscription(Bool, 'run', self._on_run, LATCHED)

    def _on_run(self, message: Bool) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        if message.data:
            self._start, self._done = self.get_clock().now().nanoseconds, 0
            self._timer = self.create_timer(1.0 / RATE, self._on_timer)

    def _on_timer(self) -> None:
        due = (self.get_clock().now().nanoseconds - self._start) // PERIOD - self._done
        for _ in range(min(due, _BURST)):
            self._done += 1
            self.sample(self._start + self._done * PERIOD)

    @abstractmethod
    def sample(self, stamp: int) -> None:
        """Process one period with its time stamp [ns]."""


class BarePlant(Clocked):
    """Publishes the messages of the plant and subscribes to its command."""

    def __init__(self, **options: Any) -> None:
        super().__init__('bare_plant', **options)
        self._force = 0.0
        self._sender = Sender(self)
        self.create_subscription(WrenchStamped, 'wrench_command', self._on_command, COMMAND)

    def sample(self, stamp: int) -> None:
        self._sender.send(stamp)

    def _on_command(self, message: WrenchStamped) -> None:
        self._force = message.wrench.force.y


class BytesPlant(Clocked):
    """`BarePlant` with serialized messages."""

    def __init__(self, **options: Any) -> None:
        super().__init__('bare_plant', **options)
        self._force, self._template = 0.0, _wrench()
        self._sender = BytesSender(self)
        self.create_subscription(
            WrenchStamped, 'wrench_command', self._on_command, COMMAND, raw=True
        )

    def sample(self, stamp: int) -> None:
        self._sender.send(stamp)

    def _on_command(self, data: bytes) -> None:
        self._force = self._template.read(data)[1]


class Echo(Node, ABC):
    """Subscribes to the measurements, and publishes command, reference and error."""

    def __init__(self, *, raw: bool, **options: Any) -> None:
        super().__init__('bare_echo', **options)
        self._command = self.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
        self._reference = self.create_publisher(JointState, 'reference', SENSOR)
        self._error = self.create_publisher(JointState, 'tracking_error', SENSOR)
        self._seen = 0.0
        for kind, topic, take in (
            (PointStamped, 'tip_deflection', self._on_tip),
            (WrenchStamped, 'base_wrench', self._on_wrench),
            (JointState, 'joint_states', self._on_joint_states),
        ):
            self.create_subscription(kind, topic, take, SENSOR, raw=raw)

    @abstractmethod
    def _on_tip(self, message: Any) -> None: ...

    @abstractmethod
    def _on_wrench(self, message: Any) -> None: ...

    @abstractmethod
    def _on_joint_states(self, message: Any) -> None: ...


class BareEcho(Echo):
    """Responds to each ``joint_states`` with the messages of the controller, the command first."""

    def __init__(self, **options: Any) -> None:
        super().__init__(raw=False, **options)
        self._wrench = WrenchStamped()
        self._wrench.header.frame_id = 'needle_base'
        self._aim = JointState(name=['insertion'])
        self._off = JointState(name=['insertion'])

    def _on_tip(self, message: PointStamped) -> None:
        self._seen = message.point.z

    def _on_wrench(self, message: WrenchStamped) -> None:
        self._seen = message.wrench.force.z

    def _on_joint_states(self, message: JointState) -> None:
        depth, speed = message.position[0], message.velocity[0]
        wrench, aim, off = self._wrench, self._aim, self._off
        for answer in (wrench, aim, off):
            answer.header.stamp = message.header.stamp
        wrench.wrench.force.y, wrench.wrench.torque.x = depth, speed
        self._command.publish(wrench)
        aim.position, aim.velocity = [depth], [speed]
        off.position, off.velocity = [depth], [speed]
        self._reference.publish(aim)
        self._error.publish(off)


class BytesEcho(Echo):
    """`BareEcho` with serialized messages."""

    def __init__(self, **options: Any) -> None:
        super().__init__(raw=True, **options)
        self._wrench, self._tip, self._aim = _wrench(), _point(), _joint_state('insertion')
        self._joints = _joint_state('insertion', 'rotation', effort=True)

    def _on_tip(self, data: bytes) -> None:
        self._seen = self._tip.read(data)[2]

    def _on_wrench(self, data: bytes) -> None:
        self._seen = self._wrench.read(data)[2]

    def _on_joint_states(self, data: bytes) -> None:
        (depth, _), (speed, _) = self._joints.read(data, 0), self._joints.read(data, 1)
        stamp = data[_STAMP]
        self._command.publish(self._wrench.write(stamp, (0.0, depth, 0.0, speed, 0.0, 0.0)))
        aim = self._aim.write(stamp, (depth,), (speed,))
        self._reference.publish(aim)
        self._error.publish(aim)


class BareSource(Clocked):
    """
    Sends numbered messages of the four plant topics and the command to a recorder.

    The time stamp is the sample number, in periods. The first sample is sent when each topic has a
    subscription. When ``run`` becomes false, the node prints the number of samples and the
    duration [s].
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('bare_source', **options)
        self._sender = Sender(self)
        self._wrench = WrenchStamped()
        self._command = self.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
        self._sent = 0

    def _on_run(self, message: Bool) -> None:
        super()._on_run(message)
        if not message.data and self._sent:
            sys.stdout.write(f'{self._sent} {time.monotonic() - self._begin}\n')
            sys.stdout.flush()

    def sample(self, _stamp: int) -> None:
        """Send the next number on each topic, once all have a subscription."""
        if self._sent or (self._sender.has_readers() and self._command.get_subscription_count()):
            if not self._sent:
                self._begin = time.monotonic()
            self._sent += 1
            self._sender.send(self._sent * PERIOD)
            self._wrench.header.stamp = _time_message(self._sent * PERIOD)
            self._command.publish(self._wrench)


#: Nodes by role and kind: message objects, or serialized messages.
NODES: Final = {
    'objects': {'plant': BarePlant, 'echo': BareEcho, 'source': BareSource},
    'bytes': {'plant': BytesPlant, 'echo': BytesEcho},
}


def main(role: str, kind: str) -> None:
    """Run a node of `NODES` on the events executor until it or its parent ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    executor: Executor = EventsExecutor()
    executor.add_node(NODES[kind][role]())
    # As the nodes of the suite do.
    gc.collect()
    gc.freeze()
    while True:
        # In rclpy 7.1 spin of the events executor returns at once, and spin_once at each event.
        executor.spin_until_future_complete(Future(), timeout_sec=0.5)


if __name__ == '__main__':
    main(*sys.argv[1:])
