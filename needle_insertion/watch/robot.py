# SPDX-License-Identifier: Apache-2.0
"""Conversion of the readings of any robot to the topics, joints and units of the contract."""

from collections.abc import Mapping
from typing import Any, Final

from needle_controller.hardware import BY_TYPE, HardwareSettings, Robot, settings_in, STATE_TYPES
from needle_ros import contract
from needle_ros.errors import ParameterError
from needle_ros.wire import Reading

_STATES, _WRENCH, _TIP = (
    topic.name for topic in (contract.JOINT_STATES, contract.BASE_WRENCH, contract.TIP_DEFLECTION)
)

_STATE_TYPE: Final = next(iter(STATE_TYPES))  #: the only type of joint states that is read


class WatchedRobot:
    """
    Convert readings by the configuration of the controller; by default they are of the contract.

    `words` is why the page does not follow the configuration, '' if it does.
    """

    def __init__(self) -> None:
        self.words = ''
        self._robot = Robot(HardwareSettings())

    def configure(self, parameters: Mapping[str, Any]) -> None:
        """Take the parameters ``hardware`` of the controller."""
        self.words = ''
        try:
            self._robot = Robot(settings_in(parameters))
        except ParameterError as error:
            self.words = f'configuration of the controller: {error}'
        settings = self._robot.settings
        if settings.state_type != _STATE_TYPE:
            self.words = (
                f'hardware.state_type {settings.state_type} is not read by this page, only '
                f'{_STATE_TYPE}'
            )
        elif BY_TYPE in (settings.state_topic, settings.wrench_topic):
            self.words = (
                f'topics that the controller finds by their type (hardware, {BY_TYPE}) are not '
                f'found by this page: it reads {_STATES} and {_WRENCH}'
            )

    def topic(self, name: str) -> str:
        """Return the topic of the robot for a topic of the contract."""
        settings = self._robot.settings
        own = {_STATES: settings.state_topic, _WRENCH: settings.wrench_topic}.get(name, '')
        if name == _STATES and settings.state_type != _STATE_TYPE:
            own = ''
        return name if own in ('', BY_TYPE) else own

    def stamped(self, name: str) -> bool:
        """Whether the stamps of a topic are times of its measurements."""
        return name == _TIP or (name in (_STATES, _WRENCH) and self._robot.settings.stamped)

    def fault(self, name: str, reading: Reading) -> str:
        """Return why the controller would refuse a reading of a topic, '' if it would not."""
        wrench = self._robot.settings.wrench_frame or contract.BASE
        frame = {_WRENCH: wrench, _TIP: contract.ENTRY}.get(name, reading.frame)
        if reading.frame == frame:
            return ''
        return f'{name} must be in frame {frame!r}, got {reading.frame!r}'

    def reading(self, name: str, reading: Reading) -> Reading:
        """Return a reading in the contract; `ParameterError` without the insertion joint."""
        if name == _WRENCH:
            return self._robot.wrench(reading)
        return self._state(reading) if name == _STATES else reading

    def _state(self, reading: Reading) -> Reading:
        robot, joint = self._robot, self._robot.settings.joint
        if joint not in reading.names:
            found = ', '.join(map(repr, reading.names)) or 'none'
            raise ParameterError(
                f'joint_states has no joint {joint!r}; joints found: {found} (hardware.joint of '
                'the controller)'
            )
        k = reading.names.index(joint)
        values = [list(column) for column in reading.values]
        for column, convert in zip(
            values, (robot.length, robot.velocity, robot.force), strict=False
        ):
            if k < len(column):
                column[k] = convert(column[k])
        # No other joint has the name of the contract.
        names = ['' if name == contract.INSERTION else name for name in reading.names]
        names[k] = contract.INSERTION
        return reading._replace(names=tuple(names), values=tuple(map(tuple, values)))
