# SPDX-License-Identifier: Apache-2.0
"""Adapter for robot drivers with their own topics, joints and units."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import isfinite, isnan, nan
from typing import Any, Final

from needle_controller.admittance import Admittance
from needle_controller.controller import Controller, Measurement
from needle_controller.force_command import ForceCommand
from needle_controller.laws.law import Axis
from needle_dynamics import NeedleParameters
from needle_ros.contract import BASE_WRENCH, INSERTION, ROTATION
from needle_ros.errors import ParameterError
from needle_ros.quantities import AXES, signed_axis
from needle_ros.settings import (
    check_constants,
    choice,
    constant,
    flag,
    from_values,
    positive,
    text,
)
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading

EFFORT: Final = 'effort'
POSITION: Final = 'position'
COMMANDS: Final = (EFFORT, POSITION)  #: Kinds of joint commands.
BY_TYPE: Final = 'auto'  #: Selects the only topic of its type.

#: Message types of commands and joint states; the first is the type of the contract.
COMMAND_TYPES: Final = {
    'wrench': 'geometry_msgs/msg/WrenchStamped',
    'float64_multi_array': 'std_msgs/msg/Float64MultiArray',
    'joint_trajectory': 'trajectory_msgs/msg/JointTrajectory',
    'joint_state': 'sensor_msgs/msg/JointState',
}
STATE_TYPES: Final = {
    'joint_state': 'sensor_msgs/msg/JointState',
    'dynamic_joint_state': 'control_msgs/msg/DynamicJointState',
}

STAMPS: Final = ('header', 'receive')  #: Source of measurement stamps: header or receive time.
_INTERFACES: Final = ('position', 'velocity', 'effort')  #: Order of the values of a JointState.
_FILTER: Final = 5e-3  #: Time constant of an estimated velocity [s].
_GAP: Final = 0.1  #: Gap after which the estimate of the velocity restarts [s].


@dataclass(frozen=True, slots=True, kw_only=True)
class HardwareSettings:
    """Joints, units, topics and commands of a robot driver; the defaults are the contract."""

    joint: str = text(INSERTION, 'insertion joint of the robot')
    sign: float = constant(
        1.0, '1', '1 if the position increases into the tissue, else -1', low=-1.0, high=1.0
    )
    scale: float = positive(1.0, 'm', 'depth per unit of the joint: 1e-3 for mm')
    zero: float = constant(0.0, 'unit of the robot', 'position at depth 0', low=-1e9, high=1e9)
    state_topic: str = text(
        '', f'topic of the joint states; empty: joint_states; {BY_TYPE}: the only one of its type'
    )
    state_type: str = choice('joint_state', STATE_TYPES)
    stamps: str = choice(
        STAMPS[0], STAMPS, 'measurement time from the header, or the receive time for a driver '
        'that does not stamp',
    )  # fmt: skip
    wrench_topic: str = text(
        '', f'topic of the force sensor; empty: base_wrench; {BY_TYPE}: the only one of its type'
    )
    wrench_frame: str = text('', 'frame of the force sensor; empty: needle_base')
    force_axis: str = text('y', 'axis of the force sensor into the tissue; may be signed: -z')
    lateral_axis: str = text(
        '', 'its axis along which the tip deflects; may be signed; empty: the one after force_axis'
    )
    reaction: bool = flag(
        False, 'the sensor reports the force of the needle on the sensor, not on the needle'
    )
    command: str = choice(EFFORT, COMMANDS, 'kind of joint command')
    command_topic: str = text('', 'topic of the commands; empty: wrench_command')
    command_type: str = choice('wrench', COMMAND_TYPES)
    command_joints: tuple[str, ...] = field(
        default=(),
        metadata={
            'description': 'joints of a command, in their order; empty: only the insertion joint. '
            'The others get zero effort, or hold their position at activation'
        },
    )
    speed: float = positive(0.05, 'm/s', 'largest speed of a commanded position')
    lead: float = positive(2e-3, 'm', 'largest distance of a commanded from the measured position')

    def __post_init__(self) -> None:
        check_constants(self)
        if abs(self.sign) != 1.0:
            raise ParameterError(f'sign must be 1 or -1, got {self.sign!r}')
        if not self.joint:
            raise ParameterError("joint must be the name of a joint, got ''")
        self.axes()
        joints = self.command_joints
        if joints and (self.joint not in joints or len({*joints}) < len(joints)):
            raise ParameterError(
                f'command_joints must have the joint {self.joint!r}, and each joint once, got '
                f'{list(joints)}'
            )
        if self.command == POSITION and self.command_type == 'wrench':
            others = ', '.join([*COMMAND_TYPES][1:])
            raise ParameterError(
                f"command_type must be one of {others} for the command position, got 'wrench'"
            )
        if self.command_type != 'wrench' and not self.command_topic:
            raise ParameterError(
                f"command_topic must be the driver's topic for {self.command_type}, got ''"
            )

    @property
    def stamped(self) -> bool:
        """Whether the time of a measurement is that of its header."""
        return self.stamps == STAMPS[0]

    @property
    def expected(self) -> tuple[str, ...]:
        """Sensors of a named topic: their readings must be valid."""
        return (BASE_WRENCH.name,) if self.wrench_topic else ()

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints of a command, in their order."""
        return self.command_joints or (self.joint,)

    def axes(self) -> tuple[tuple[int, float], ...]:
        """Return index and sign of the sensor axes along x, y and z of ``needle_base``."""
        sign, axis = signed_axis(self.force_axis, 'force_axis')
        along = AXES.index(axis)
        aside, other = (along + 1) % 3, 1.0
        if self.lateral_axis:
            other, axis = signed_axis(self.lateral_axis, 'lateral_axis')
            aside = AXES.index(axis)
        if along == aside:
            raise ParameterError(
                f'lateral_axis must be across force_axis {self.force_axis!r}, got '
                f'{self.lateral_axis!r}'
            )
        # x = y cross z.
        third = sign * other * (1.0 if (along + 1) % 3 == aside else -1.0)
        return (3 - along - aside, third), (along, sign), (aside, other)


def settings_in(parameters: Mapping[str, Any], **own: Any) -> HardwareSettings:
    """Return the settings in the parameters of a controller; `own` replaces values by name."""
    prefix = 'hardware.'
    names = [item.name for item in fields(HardwareSettings) if prefix + item.name in parameters]
    values = {name: parameters[prefix + name] for name in names}
    return from_values(HardwareSettings, values | own, prefix)


def dynamic_reading(
    stamp: int,
    frame: str,
    joints: Sequence[str],
    interfaces: Sequence[tuple[Sequence[str], Sequence[float]]],
) -> Reading:
    """Convert names and values by joint of a DynamicJointState; missing values are NaN."""
    columns = tuple(
        tuple(
            values[names.index(wanted)] if wanted in names else nan
            for names, values in ((list(one), list(two)) for one, two in interfaces)
        )
        for wanted in _INTERFACES
    )
    return Reading(stamp, frame, tuple(joints), columns)


class Robot:
    r"""
    Convert between the joints and units of a robot and the insertion axis.

    With the position p of its joint, the insertion depth is :math:`s = g (p - p_0)` with :math:`g`
    = sign * scale. Velocities scale with g, and the effort of the joint is :math:`e = g f`, so
    that power is the same on both sides: :math:`e \dot{p} = f \dot{s}`.

    With position commands, a velocity that the driver does not report is estimated by differences
    of positions, with a first-order filter of 5 ms.

    Parameters
    ----------
    settings : HardwareSettings
        Joints, units and commands.

    """

    def __init__(self, settings: HardwareSettings) -> None:
        self.settings = settings
        self._gain = settings.sign * settings.scale
        self._axes = settings.axes()
        self._base: Admittance | None = None
        #: Insertion depth to command for a check [m], NaN for no command; None without a check.
        self.probe: float | None = None
        self.begin()

    def begin(self) -> None:
        """Discard all measurements and commands."""
        self.estimates = False  #: Whether velocities are estimated.
        #: Last accepted force on the needle, along x, y and z of ``needle_base`` [N], NaN before.
        self.reaction = nan, nan, nan
        self._speed = _Speed()
        #: Positions of the other joints of a command to hold, in the unit of the robot.
        self._others: dict[str, float] = {}
        if self._base is not None:
            self._base.position = None
            self._base.hold(None)

    def configure(self, controller: Controller) -> None:
        """Take the nominal model and limits of a controller, for position commands."""
        self._base = Admittance(
            Axis.insertion(controller.parameters),
            period=controller.period,
            speed=self.settings.speed,
            lead=self.settings.lead,
            depths=controller.settings.depths(controller.parameters),
            delay=controller.delay,
        )

    def set_model(self, parameters: NeedleParameters) -> None:
        """Continue with another nominal friction."""
        if self._base is not None:
            self._base.axis = Axis.insertion(parameters)

    # From the robot.

    def length(self, position: float) -> float:
        """Return the insertion depth [m] at a position of the joint, in its unit."""
        return self._gain * (position - self.settings.zero)

    def velocity(self, speed: float) -> float:
        """Return the velocity of insertion [m/s] for a speed of the joint, in its unit."""
        return self._gain * speed

    def force(self, effort: float) -> float:
        """Return the axial force on the needle [N] for an effort of the joint, in its unit."""
        return effort / self._gain

    def measurement(self, reading: Reading, origin: int = 0) -> Measurement:
        """
        Convert a joint state, with any joints in any order, to a measurement.

        `origin` is the stamp of the time zero [ns].

        The force is NaN if it is not reported, or with position commands. A missing joint,
        position, or velocity for efforts is a `ParameterError`.
        """
        settings = self.settings
        position, speed, effort = self._find(settings.joint, reading)
        depth, velocity = self.length(position), self.velocity(speed)
        time = (reading.stamp - origin) / NANOSECONDS
        angle = angular_velocity = 0.0
        force = nan
        if settings.command == POSITION:
            if not self._others:
                self._others = {joint: self._find(joint, reading)[0] for joint in settings.joints}
            if isnan(velocity):
                velocity, self.estimates = self._speed.update(time, depth), True
        else:
            if isnan(velocity):
                raise ParameterError(
                    f'joint_states has no velocity of {settings.joint!r}: efforts need it '
                    '(ros2_control: a state interface for velocity), hardware.command position '
                    'does not'
                )
            force = self.force(effort)
            if settings.command_type == 'wrench' and (found := reading.joint(ROTATION)):
                angle, angular_velocity, _ = found
        base = None
        if self._base is not None and settings.command == POSITION and isfinite(depth):
            base = self._base.state(depth)
        return Measurement(time, depth, velocity, angle, angular_velocity, force, base)

    def _find(self, joint: str, reading: Reading) -> tuple[float, float, float]:
        state = reading.joint(joint)
        if state is None or isnan(state[0]):
            values = zip(reading.names, reading.values[0], strict=False)
            there = [repr(name) for name, one in values if one == one]
            found = ', '.join(there) or 'none'
            raise ParameterError(
                f'joint_states has no position of the joint {joint!r}; positions found: {found} '
                '(hardware.joint, hardware.command_joints)'
            )
        return state

    def wrench(self, reading: Reading) -> Reading:
        """Convert a force sensor reading to the axes of ``needle_base``, about its own origin."""
        numbers = reading.values[0]
        sign = -1.0 if self.settings.reaction else 1.0
        turned = tuple(
            sign * one * numbers[begin + axis] for begin in (0, 3) for axis, one in self._axes
        )
        return reading._replace(values=(turned,))

    # To the robot.

    def command(
        self,
        answer: ForceCommand,
        depth: float | None = None,
        load: float = 0.0,
        *,
        stopped: bool = False,
    ) -> list[float] | None:
        """
        Return efforts or positions in the units of the robot; None for no command.

        ``depth`` is the measured insertion depth [m], None if it is not known: then a robot that
        follows positions gets none, and stays where it is. ``load`` is the load against insertion
        that the force must overcome [N]. With ``stopped``, a latched stop, the position command
        moves to where the robot was measured at the stop, not faster than ``speed``.
        """
        settings = self.settings
        if settings.command == EFFORT:
            effort = self._gain * answer.force
            return [effort if joint == settings.joint else 0.0 for joint in settings.joints]
        base, length = self._base, None
        if base is not None:
            # Without a reference no motion is requested, except for a repeated message.
            if depth is None:
                # The other joints may be elsewhere, too.
                self._others.clear()
                length = base.hold(None)
            elif stopped:
                length = base.give_way(depth, answer.stamp)
            elif answer.reference and self.probe is not None:
                if isfinite(self.probe):
                    base.place(self.probe, answer.stamp)
                    length = base.hold(depth)
            elif answer.reference:
                length = base.step(answer.force - load, depth, answer.stamp)
            elif base.answered == answer.stamp:
                length = base.position
            else:
                length = base.hold(depth)
        if length is None:
            return None
        own = length / self._gain + settings.zero
        return [own if joint == settings.joint else self._others[joint]
                for joint in settings.joints]  # fmt: skip


class _Speed:
    """Velocity from differences of positions, with a first-order filter."""

    def __init__(self) -> None:
        self._time = self._position = nan
        self._value = 0.0

    def update(self, time: float, position: float) -> float:
        """Return the velocity [m/s] at a time [s]; zero at first, and after a gap."""
        elapsed, moved = time - self._time, position - self._position
        if elapsed == 0.0:
            return self._value
        self._time, self._position = time, position
        # NaN restarts the filter.
        if not (0.0 < elapsed < _GAP and isfinite(moved)):
            self._value = 0.0
        else:
            self._value += elapsed / (_FILTER + elapsed) * (moved / elapsed - self._value)
        return self._value
