# SPDX-License-Identifier: Apache-2.0
"""Read the newest measurements of a running graph on demand."""

from dataclasses import replace
from math import inf
from time import time_ns
from typing import Final

from needle_controller.controller import Measurement
from needle_controller.hardware import Robot
from needle_insertion.graph.messages import waiting
from needle_ros import contract
from needle_ros.contract import Topic
from needle_ros.errors import MessageError, ParameterError
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import MessageReader, Reading
from rclpy.node import Node

#: Tolerance of the position [m] and the velocity [m/s] of a reference at rest at its target.
_SAME: Final = 1e-9

_TOPICS: Final = (
    contract.JOINT_STATES,
    contract.BASE_WRENCH,
    contract.TIP_DEFLECTION,
    contract.REFERENCE,
)


class Readings:
    """
    Newest message of each sensor and of the reference.

    Messages arrive at 1 kHz: only a message that is requested is taken from the middleware. The
    node subscribes and must not be spun. A `robot` has topics, joints and units of its own.
    """

    def __init__(self, node: Node, robot: Robot | None = None) -> None:
        self._robot = robot
        own: dict[Topic, str] = {}
        if robot is not None:
            own[contract.JOINT_STATES] = robot.settings.state_topic
            own[contract.BASE_WRENCH] = robot.settings.wrench_topic
        #: Kept alive for its subscriptions.
        self._node = node
        self._newest: dict[str, bytes] = {}
        #: Time of the last message [ns], for a robot without stamps.
        self._received = 0
        self._readers = {topic.name: MessageReader(topic.type_name) for topic in _TOPICS}
        self._waiting = {}
        for topic in _TOPICS:
            used = replace(topic, name=own.get(topic) or topic.name)
            self._waiting[topic.name] = waiting(node, used, topic.qos._replace(depth=1))

    def newest(self, topic: Topic) -> Reading | None:
        """Return the newest message of a topic; None before the first, or if unreadable."""
        for message in self._waiting[topic.name]():
            self._newest[topic.name], self._received = message, time_ns()
        data = self._newest.get(topic.name)
        try:
            return None if data is None else self._readers[topic.name].read(data)
        except MessageError:
            # Controller and recorder report invalid messages; they are ignored here.
            return None

    def insertion(self, topic: Topic = contract.JOINT_STATES) -> tuple[float, float] | None:
        """Return insertion depth [m] and velocity [m/s] of a topic; None if unknown."""
        robot, reading = None, self.newest(topic)
        if topic is contract.JOINT_STATES:
            robot, reading = self._robot, self._state()
        if reading is None:
            return None
        convert = Measurement.from_reading if robot is None else robot.measurement
        try:
            measured = convert(reading)
        except ParameterError:
            # The controller reports the missing joint.
            return None
        return measured.depth, measured.velocity

    def _state(self) -> Reading | None:
        """Return the newest joint states, with the time of arrival if they have no stamp."""
        reading = self.newest(contract.JOINT_STATES)
        if reading is None or self._robot is None or self._robot.settings.stamped:
            return reading
        return reading._replace(stamp=self._received)

    @property
    def time(self) -> float:
        """Stamp of the newest measurement [s], by the clock of the robot; 0 before the first."""
        reading = self._state()
        return 0.0 if reading is None else reading.stamp / NANOSECONDS

    def reference_rests_at(self, target: float) -> bool:
        reference = self.insertion(contract.REFERENCE)
        if reference is None:
            return False
        depth, velocity = reference
        return abs(depth - target) < _SAME and abs(velocity) < _SAME

    def distance(self, target: float) -> float:
        """Return the distance of the measured depth from a target [m]; inf if unknown."""
        insertion = self.insertion()
        return inf if insertion is None else abs(insertion[0] - target)

    def line(self) -> str:
        words = []
        if (insertion := self.insertion()) is not None:
            words.append(f'depth {1e3 * insertion[0]:.2f} mm')
            words.append(f'{1e3 * insertion[1]:+.1f} mm/s')
        if (wrench := self.newest(contract.BASE_WRENCH)) is not None:
            wrench = wrench if self._robot is None else self._robot.wrench(wrench)
            words.append(f'force {wrench.values[0][1]:+.2f} N')
        if (tip := self.newest(contract.TIP_DEFLECTION)) is not None:
            x, _, z = tip.values[0]
            words.append(f'tip x {1e3 * x:+.2f} mm, z {1e3 * z:+.2f} mm')
        return ', '.join(words) or 'no measurements'
