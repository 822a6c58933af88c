# SPDX-License-Identifier: Apache-2.0
"""ROS adapter for a robot driver with its own topics and message types."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from time import monotonic, sleep
from typing import Any, Final, NamedTuple

from builtin_interfaces.msg import Duration
from needle_controller import hardware
from needle_controller.commissioning import Commissioning, CommissioningSettings
from needle_controller.controller import Controller
from needle_controller.force_command import ForceCommand
from needle_controller.safety.safety import SafetyLimits
from needle_ros import contract
from needle_ros.base_node import BaseNode, message_class, NEWEST
from needle_ros.contract import Topic
from needle_ros.errors import MessageError, ParameterError
from needle_ros.life_cycle_node import PreparationProgress
from needle_ros.status import ControllerStatus
from needle_ros.timing import NANOSECONDS, nanoseconds, set_time
from needle_ros.wire import Reading
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidTopicNameException
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

_DISCOVERY: Final = 10.0  #: Longest time to find a topic by its type [s].
_PAUSE: Final = 0.1  #: Time between two checks for the topic [s].


def named(topic: Topic, name: str, type_name: str) -> Topic:
    """Return a topic of the contract under the driver's name and type."""
    if name:
        try:
            validate_topic_name(name)
        except InvalidTopicNameException as error:
            reason = ' '.join(str(error).split())
            raise ParameterError(f'hardware: the topic {name!r}: {reason}') from error
    return replace(topic, name=name or topic.name, type_name=type_name)


def _of(lease: Topic, topic: Topic) -> Topic:
    return replace(lease, name=f'{topic.name}/{lease.name.rpartition("/")[2]}')


class Topics(NamedTuple):
    """Topics of a controller."""

    state: Topic  #: joint states
    wrench: Topic  #: force sensor
    command: Topic
    measurer: Topic  #: lease of the publishers of joint states
    commander: Topic  #: lease of the publishers of commands


#: Topics of the contract.
CONTRACT: Final = Topics(
    contract.JOINT_STATES,
    contract.BASE_WRENCH,
    contract.WRENCH_COMMAND,
    contract.MEASURER,
    contract.COMMANDER,
)


def _readings(settings: hardware.HardwareSettings) -> tuple[tuple[Topic, str, str], ...]:
    """Return the topics of measurements in the contract, with name and type of the driver."""
    return (
        (contract.JOINT_STATES, settings.state_topic, hardware.STATE_TYPES[settings.state_type]),
        (contract.BASE_WRENCH, settings.wrench_topic, contract.BASE_WRENCH.type_name),
    )


def await_topics(
    node: BaseNode, settings: hardware.HardwareSettings
) -> Iterator[PreparationProgress]:
    """Wait for the discovery of the topics that are found by their type, for a limited time."""
    types = [kind for _, name, kind in _readings(settings) if name == hardware.BY_TYPE]
    deadline = monotonic() + _DISCOVERY
    for kind in types:
        yield PreparationProgress(0, 0, f'a topic of {kind}, {_DISCOVERY:g} s at most')
        while not _published(node, kind) and monotonic() < deadline:
            sleep(_PAUSE)


def _published(node: BaseNode, type_name: str) -> list[str]:
    own = node.get_name(), node.get_namespace()
    return sorted(
        name
        for name, kinds in node.get_topic_names_and_types()
        if type_name in kinds
        and any(
            (one.node_name, one.node_namespace) != own
            for one in node.get_publishers_info_by_topic(name)
        )
    )


class Driver:
    """
    Read and command a robot by its own `topics` and message types, for the node of a controller.

    A topic that is found by its type must be in the graph already, see `await_topics`. An invalid
    topic name or not exactly one topic of its type is a `ParameterError`.
    """

    def __init__(self, node: BaseNode, settings: hardware.HardwareSettings) -> None:
        self.robot = hardware.Robot(settings)
        self._node, self._settings = node, settings
        state, wrench = (self._found(*reading) for reading in _readings(settings))
        kind = hardware.COMMAND_TYPES[settings.command_type]
        command = named(contract.WRENCH_COMMAND, settings.command_topic, kind)
        self.topics = Topics(
            state, wrench, command, _of(contract.MEASURER, state), _of(contract.COMMANDER, command)
        )
        self._dynamic: Any = None
        if state.type_name != contract.JOINT_STATES.type_name:
            try:
                self._dynamic = message_class(state.type_name)
            except MessageError as error:
                raise MessageError(
                    f'hardware.state_type {settings.state_type}: {error}'
                ) from error
        self._write_wrench = contract.WRENCH_COMMAND.template().serialize
        self._period = Duration()
        self._check: Commissioning | None = None

    def _found(self, topic: Topic, name: str, type_name: str) -> Topic:
        """Return the driver's topic; `BY_TYPE` selects the only topic of its type."""
        if name != hardware.BY_TYPE:
            return named(topic, name, type_name)
        found = _published(self._node, type_name)
        if len(found) != 1:
            raise ParameterError(
                f'hardware: {hardware.BY_TYPE} for {topic.name} needs one topic of {type_name} '
                f'that other nodes publish, found {", ".join(found) or "none"}'
            )
        return named(topic, found[0], type_name)

    # From the robot.

    def listen(
        self,
        take_state: Callable[[Reading], None],
        take_wrench: Callable[[Reading], None],
        matched: Callable[[int], None],
    ) -> None:
        """Subscribe to joint states, unconverted, and forces, converted; see `BaseNode.listen`."""
        node, robot = self._node, self.robot

        def stamped(take: Callable[[Reading], None]) -> Callable[[Reading], None]:
            if self._settings.stamped:
                return take
            return lambda reading: take(reading._replace(stamp=node.now()))

        take_state = stamped(take_state)
        if self._dynamic is None:
            node.listen(self.topics.state, take_state, matched, NEWEST)
        else:
            self._listen_to_dynamic(take_state, matched)
        take = stamped(take_wrench)
        node.listen(
            self.topics.wrench, lambda reading: take(robot.wrench(reading)), matched, NEWEST
        )

    def _listen_to_dynamic(
        self, take: Callable[[Reading], None], matched: Callable[[int], None]
    ) -> None:
        def on_message(message: Any) -> None:
            interfaces = [(one.interface_names, one.values) for one in message.interface_values]
            header = message.header
            take(
                hardware.dynamic_reading(
                    nanoseconds(header.stamp), header.frame_id, message.joint_names, interfaces
                )
            )

        def on_match(event: Any) -> None:
            matched(event.total_count_change)

        events = SubscriptionEventCallbacks(matched=on_match)
        self._node.create_subscription(
            self._dynamic, self.topics.state.name, on_message, NEWEST, event_callbacks=events
        )

    def with_robot(self, status: ControllerStatus) -> ControllerStatus:
        joints = ', '.join(self._settings.joints)
        return replace(
            status,
            robot=f'{self.topics.state.name}, {self._settings.command} of {joints} on '
            f'{self.topics.command.name}',
            velocity_source='estimated' if self.robot.estimates else 'reported',
            commissioning=self._check.phase if self._check else None,
            commissioning_result=self._check.result if self._check else '',
        )

    def missing(self, name: str) -> str:
        """Describe from the ROS graph why an input, by its name in the contract, is missing."""
        node, topic = self._node, self.topics.wrench
        setting, also = 'hardware.wrench_topic', ''
        if name == contract.JOINT_STATES.name:
            topic, setting, also = self.topics.state, 'hardware.state_topic', 'hardware.state_type'
        types = {one.topic_type for one in node.get_publishers_info_by_topic(topic.name)}
        if types == {topic.type_name}:
            return f'{topic.name} is published, but no message was received'
        if types:
            return (
                f'{topic.name} is published as {", ".join(sorted(types))}, and read as '
                f'{topic.type_name} ({", ".join(filter(None, (setting, also)))})'
            )
        others = _published(node, topic.type_name)
        return (
            f'no node publishes {topic.name}; {topic.type_name} is published on '
            f'{", ".join(others) or "no topic"} ({setting})'
        )

    # To the robot.

    def configure(
        self, controller: Controller, settings: CommissioningSettings, limits: SafetyLimits
    ) -> None:
        """Take the nominal model and the period of a controller, and check its first motion."""
        self.robot.configure(controller)
        self._check = Commissioning(settings, self.robot, controller, limits)
        controller.check = self._check.command
        set_time(self._period, round(controller.period * NANOSECONDS))

    def message(
        self, answer: ForceCommand, depth: float | None, load: float, *, stopped: bool
    ) -> Any:
        """Return the message for a command, see `Robot.command`, or None."""
        settings, stamp = self._settings, answer.stamp
        kind, joints = settings.command_type, list(settings.joints)
        if kind == 'wrench':
            return self._write_wrench(stamp, 0.0, answer.force, 0.0, answer.torque, 0.0, 0.0)
        values = self.robot.command(answer, depth, load, stopped=stopped)
        if values is None:
            return None
        if kind == 'float64_multi_array':
            return Float64MultiArray(data=values)
        pushes = settings.command == hardware.EFFORT
        if kind == 'joint_trajectory':
            # Without a stamp it begins at once; without velocities its end velocity is free.
            field = {'effort' if pushes else 'positions': values}
            point = JointTrajectoryPoint(**field, time_from_start=self._period)
            return JointTrajectory(joint_names=joints, points=[point])
        message = JointState(name=joints, **{'effort' if pushes else 'position': values})
        set_time(message.header.stamp, stamp)
        return message
