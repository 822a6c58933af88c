# SPDX-License-Identifier: Apache-2.0
"""
Contract of all topics: type, publisher, QoS, frame, joints, units and stamp.

Lengths are in m, angles in rad, forces in N and torques in N m. Depths, velocities and forces
along the needle are positive into the tissue. Stamps are sample times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Final, NamedTuple

from needle_ros.wire import JOINT_STATE, POINT, POSE, Template, WRENCH

ENTRY: Final = 'needle_entry'  #: Frame fixed at the entry point.
BASE: Final = 'needle_base'  #: Frame at the needle base, parallel to `ENTRY`.
TIP: Final = 'needle_tip'  #: Frame at the tip, y along the needle.

INSERTION: Final = 'insertion'  #: Joint along the needle.
ROTATION: Final = 'rotation'  #: Joint of the base about x.

#: Joints of a steering robot: lateral position and tilt of the guide, and roll of the needle.
GUIDE_X: Final = 'guide_x'
GUIDE_Z: Final = 'guide_z'
TILT_X: Final = 'guide_tilt_x'
TILT_Z: Final = 'guide_tilt_z'
ROLL: Final = 'roll'

EVERY_NODE: Final = 'every node'
USER: Final = 'user'


class Qos(NamedTuple):
    """Quality of service that the publishers of a topic offer; all are reliable."""

    name: str  #: Name in the documentation.
    latched: bool = False  #: Whether late-joining subscribers receive the previous messages.
    depth: int = 1  #: Messages kept for a busy or late-joining subscriber.
    lossy: bool = False  #: Whether the nodes of the suite request best effort nevertheless.
    lease: float = 0.0  #: Liveliness lease [s]; 0: DDS detects a dead publisher after 20 s.


class Stamp(Enum):
    """Meaning of the stamp of a message, which decides whether its age matters."""

    #: Time of a sample, or of the sample that a command answers: an `InputMonitor` discards
    #: messages out of order or older than a parameter of the subscriber.
    SAMPLE = 'sample'
    #: Time at which the request was sent: it identifies and orders requests in a `RequestLog`, and
    #: is valid for `REQUEST_AGE`. Zero means now.
    REQUEST = 'request'
    UNCHECKED = 'unchecked'  #: Not checked: the message is a result, or information for users.


REQUEST_AGE: Final = 5.0  #: Maximum age of a request [s]: three repetitions, and a delay of 1 s.

#: Compatible with subscribers with default QoS; nodes of the suite do not need retransmission of a
#: late sample. The depth holds a burst after a stall of the subscriber.
SENSOR: Final = Qos('reliable or best effort', depth=50, lossy=True)

#: Requested by a control loop, which answers the newest samples while it is busy.
NEWEST: Final = SENSOR._replace(depth=2)

COMMAND: Final = Qos('reliable')  #: Only the newest message matters.
ALIVE: Final = Qos('lease of 0.5 s', lease=0.5)  #: No messages: liveliness of a publisher.
LATCHED: Final = Qos(
    'latched', latched=True
)  #: Late-joining subscribers receive the last message.


class Joint(NamedTuple):
    """A joint of a JointState."""

    name: str
    unit: str  #: Unit of the position; the unit of the velocity is the same per second.
    effort: str = ''  #: Unit of the effort, '' if the topic has no efforts.


class Quantity(NamedTuple):
    """A number of a message: name such as ``force.y`` or ``position of insertion``, SI unit."""

    name: str
    unit: str


def _vector(field: str, unit: str, axes: str = 'xyz') -> tuple[Quantity, ...]:
    return tuple(Quantity(f'{field}.{axis}', unit) for axis in axes)


#: Numbers of the message types with fixed fields, in order.
_QUANTITIES: Final = {
    WRENCH: _vector('force', 'N') + _vector('torque', 'N m'),
    POINT: _vector('point', 'm'),
    POSE: _vector('position', 'm') + _vector('orientation', '1', 'xyzw'),
}


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of the contract."""

    name: str  #: Name, relative to the namespace of the node; ``~`` stands for the node.
    type_name: str
    publisher: str  #: Publishing nodes, `EVERY_NODE`, or `USER`.
    qos: Qos = SENSOR
    frame: str = ''  #: Frame of the header, '' without a frame.
    joints: tuple[Joint, ...] = ()  #: Joints of a JointState.
    stamp: Stamp = Stamp.UNCHECKED
    meaning: str = ''  #: Content of the messages, for the documentation.

    def described(self, meaning: str) -> Topic:
        return replace(self, meaning=meaning)

    def with_joints(self, *joints: Joint, efforts: bool = True) -> Topic:
        """Return the topic of a JointState with other joints, optionally without efforts."""
        kept = joints if efforts else (joint._replace(effort='') for joint in joints)
        return replace(self, joints=tuple(kept))

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Numbers of a message in order; empty for types that `wire` does not parse."""
        if self.type_name != JOINT_STATE:
            return _QUANTITIES.get(self.type_name, ())
        return (
            *(Quantity(f'position of {joint.name}', joint.unit) for joint in self.joints),
            *(Quantity(f'velocity of {joint.name}', f'{joint.unit}/s') for joint in self.joints),
            *(Quantity(f'effort of {j.name}', j.effort) for j in self.joints if j.effort),
        )

    def template(self) -> Template:
        """Return a template that writes and reads messages of this topic."""
        names = [joint.name for joint in self.joints]
        efforts = sum(bool(joint.effort) for joint in self.joints)
        counts = (len(names), len(names), efforts)
        return Template(self.type_name, self.frame, names=names, counts=counts)


_STRING: Final = 'std_msgs/msg/String'
_DIAGNOSTICS: Final = 'diagnostic_msgs/msg/DiagnosticArray'

#: The newest messages of several publishers.
_COMMANDS: Final = COMMAND._replace(depth=10)

#: Joints of the needle, and joints of a steered needle in addition to `insertion`.
_NEEDLE_JOINTS: Final = (Joint(INSERTION, 'm', 'N'), Joint(ROTATION, 'rad', 'N m'))
STEERING_JOINTS: Final = (
    Joint(GUIDE_X, 'm', 'N'), Joint(GUIDE_Z, 'm', 'N'), Joint(TILT_X, 'rad', 'N m'),
    Joint(TILT_Z, 'rad', 'N m'), Joint(ROLL, 'rad', 'N m'),
)  # fmt: skip

JOINT_STATES: Final = Topic(
    'joint_states', JOINT_STATE, 'plant', joints=_NEEDLE_JOINTS, stamp=Stamp.SAMPLE
).described(
    'encoders of the robot: insertion depth and rotation; effort: axial force and torque '
    'on the needle; steered: `insertion`, `guide_x`, `guide_z` [m], `guide_tilt_x`, '
    '`guide_tilt_z`, `roll` [rad]'
)


def steered_states(*, efforts: bool = True) -> Topic:
    """Return `JOINT_STATES` of a steered needle: `insertion` and the guide joints."""
    return JOINT_STATES.with_joints(_NEEDLE_JOINTS[0], *STEERING_JOINTS, efforts=efforts)


BASE_WRENCH: Final = Topic(
    'base_wrench', WRENCH, 'plant', frame=BASE, stamp=Stamp.SAMPLE
).described(
    'force sensor, force of the base on the needle: `force.y` axial, `force.z` lateral '
    '[N], `torque.x` [N m]; mode `indenter`: force of the end-effector on the tissue'
)

TIP_DEFLECTION: Final = Topic(
    'tip_deflection', POINT, 'plant', frame=ENTRY, stamp=Stamp.SAMPLE
).described(
    'tracker or imager: `point.y` insertion depth, `point.z` deflection of the tip [m]; '
    'steered: `point.x` too'
)

GROUND_TRUTH: Final = Topic(
    'ground_truth',
    JOINT_STATE,
    'plant',
    joints=(Joint('d', 'm'), Joint('theta', 'rad'), Joint('q1', 'm^1.5'), Joint('q2', 'm^1.5')),
    stamp=Stamp.SAMPLE,
).described(
    'simulation only: d (length outside the tissue), theta and q1..qn, the full state; '
    'steered: d, `tip_x`, `tip_z` [m], `tip_roll` [rad]; effort, in mode `simulation`: '
    'generalized forces applied since the previous sample'
)


def ground_truth(modes: int, *, commanded: bool) -> Topic:
    """Return `GROUND_TRUTH` of a number of shape modes, with efforts if commands move it."""
    bending = [Joint(f'q{k + 1}', 'm^1.5', 'N m^-0.5') for k in range(modes)]
    axial = Joint('d', 'm', 'N'), Joint('theta', 'rad', 'N m')
    return GROUND_TRUTH.with_joints(*axial, *bending, efforts=commanded)


def steered_truth(*, commanded: bool) -> Topic:
    """Return `GROUND_TRUTH` of a steered needle, with efforts if commands move it."""
    joints = (
        Joint('d', 'm', 'N'), Joint('tip_x', 'm', 'N'), Joint('tip_z', 'm', 'N'),
        Joint('tip_roll', 'rad', 'N m'),
    )  # fmt: skip
    return GROUND_TRUTH.with_joints(*joints, efforts=commanded)


END_EFFECTOR_POSE: Final = Topic('end_effector_pose', POSE, 'plant', frame=ENTRY).described(
    'mode `indenter`: position of the end-effector [m]'
)

NEEDLE_SHAPE: Final = Topic(
    'needle_shape', 'visualization_msgs/msg/Marker', 'plant', frame=ENTRY
).described('the needle as a line, and its cut path, 30 Hz while there is a subscriber')

NEEDLE_POSES: Final = Topic(
    'needle_poses', 'geometry_msgs/msg/PoseArray', 'plant', frame=ENTRY
).described('poses along the needle, y along it, 30 Hz while there is a subscriber')

# The depth is that of the subscription of rclpy.
CLOCK: Final = Topic(
    '/clock', 'rosgraph_msgs/msg/Clock', 'plant', SENSOR._replace(depth=1)
).described('simulated time, with `publish_clock` or `lockstep`')

# All events, also for a late-joining subscriber.
EVENTS: Final = Topic('~/events', _DIAGNOSTICS, 'plant', LATCHED._replace(depth=1000)).described(
    'inputs of the plant other than commands (trajectories, disturbances), with the number of '
    'their first sample: [replay.md](replay.md)'
)

WRENCH_COMMAND: Final = Topic(
    'wrench_command', WRENCH, 'controller', COMMAND, BASE, stamp=Stamp.SAMPLE
).described(
    'force and torque on the needle: `force.y` [N], `torque.x` [N m]; stamp of the answered sample'
)

JOINT_COMMANDS: Final = Topic(
    'joint_commands', JOINT_STATE, 'ros2_control', COMMAND, '', _NEEDLE_JOINTS, Stamp.SAMPLE
).described(
    'from the hardware interface of ros2_control, NaN without a command; mode `simulation`: '
    'efforts, in place of `wrench_command`; mode `robot`: positions, or velocities; steered, '
    'in both modes: guide and roll: [howto/ros2-control.md](howto/ros2-control.md)'
)

COMMANDER: Final = Topic(
    'wrench_command/alive', 'std_msgs/msg/Empty', 'controller', ALIVE
).described('no messages: the end of its lease indicates a dead controller')

MEASURER: Final = Topic('joint_states/alive', 'std_msgs/msg/Empty', 'plant', ALIVE).described(
    'no messages: the end of its lease indicates a dead plant'
)

PROCESSED: Final = Topic(
    'joint_states/_processed', 'std_msgs/msg/Header', 'steering', _COMMANDS
).described(
    'lockstep: stamp of a sample that a node (named in `frame_id`) has processed, after its '
    'motions; a plant with `lockstep` waits for all publishers; not recorded'
)

RECORDED: Final = Topic(
    'joint_states/_recorded', 'std_msgs/msg/Header', 'recorder', _COMMANDS
).described(
    'stamp of the newest recorded sample, zero at the end of recording; a plant with an '
    'independent time is at most 80 samples ahead of it, with `lockstep` 10; not recorded'
)

REFERENCE: Final = Topic(
    'reference', JOINT_STATE, 'controller', joints=(Joint(INSERTION, 'm'),)
).described('insertion depth and velocity of the reference')

TRACKING_ERROR: Final = replace(
    REFERENCE, name='tracking_error', meaning='reference minus measurement'
)

TARGET: Final = Topic(
    'target', POINT, f'{USER}, slicer', COMMAND, ENTRY, stamp=Stamp.REQUEST
).described(
    '`point.y`: target insertion depth [m]; to the node `steering`: target position of the tip, '
    'x, y, z [m]'
)

# Several nodes publish.
SYSTEM_STATE: Final = Topic(
    'system_state',
    'diagnostic_msgs/msg/DiagnosticStatus',
    'controller, steering, plant',
    LATCHED._replace(depth=10),
).described(
    'mode of the system (running, paused, retracting, stopped) with the reason of a stop; on '
    'change and 1 Hz'
)

EMERGENCY_STOP: Final = Topic('emergency_stop', 'std_msgs/msg/Bool', USER, COMMAND).described(
    'true stops the system, as `~/stop` of any node'
)

TIP_EXPECTED: Final = Topic(
    'tip_expected', 'geometry_msgs/msg/PoseWithCovarianceStamped', 'steering', COMMAND, ENTRY
).described('predicted tip pose at the target depth, with covariance, after each tip measurement')

INSERTION_RECORD: Final = Topic('insertion_record', _STRING, 'steering', LATCHED).described(
    'plan and estimate of the latest insertion, as JSON: depths, tip measurements and guide '
    'setpoints so far, expected tip; a restarted node resumes from it'
)

# SlicerROS2 requests reliable QoS.
TIP_POSE: Final = Topic('tip_pose', POSE, 'slicer', COMMAND, ENTRY).described(
    'tip pose, y along the needle, 20 Hz; the direction is measured only if `needle_poses` are '
    'published'
)

JOINT_TRAJECTORY: Final = Topic(
    'joint_trajectory',
    'trajectory_msgs/msg/JointTrajectory',
    f'{USER}, steering',
    COMMAND,
    stamp=Stamp.REQUEST,
).described(
    'to the controller: `insertion`, positions [m], and optionally velocities [m/s]; '
    'to a plant in mode `robot`: `insertion`, positions [m], or efforts [N] of a push; '
    'steered, in both modes: guide and roll [m, rad]; in mode `indenter`: efforts of `x` and '
    '`z` [N]'
)

ROBOT_DESCRIPTION: Final = Topic(
    'robot_description', _STRING, 'robot_state_publisher', LATCHED
).described('URDF of the robot from `description/`, with `ros2_control.launch.py`')

TF: Final = Topic(
    '/tf',
    'tf2_msgs/msg/TFMessage',
    'robot_state_publisher; with `publish_tf`: plant',
    COMMAND._replace(depth=100),
).described(
    'robot_state_publisher: the joints, with `ros2_control.launch.py`; plant: `needle_tip` in '
    '`needle_base`, 30 Hz'
)

FRICTION: Final = Topic('friction', _DIAGNOSTICS, 'identification', LATCHED).described(
    'estimate, interval, unit and number of samples of each coefficient'
)

STIFFNESS: Final = replace(FRICTION, name='stiffness')

CONFIGURATION: Final = Topic('~/configuration', _STRING, EVERY_NODE, LATCHED).described(
    'all parameters of the node as a parameter file'
)

DIAGNOSTICS: Final = Topic('/diagnostics', _DIAGNOSTICS, EVERY_NODE, _COMMANDS).described(
    'state of the node, 1 Hz and on change'
)


#: Action of the nodes that receive `joint_trajectory`, if its package is installed.
FOLLOW_JOINT_TRAJECTORY: Final = '~/follow_joint_trajectory'
FOLLOW_JOINT_TRAJECTORY_TYPE: Final = 'control_msgs/action/FollowJointTrajectory'

#: All topics, in the order above.
TOPICS: Final = tuple(value for value in [*globals().values()] if isinstance(value, Topic))
