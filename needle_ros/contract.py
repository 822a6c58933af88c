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

#: Frames: fixed at the entry point; at the needle base, parallel to the first.
ENTRY: Final = 'needle_entry'
BASE: Final = 'needle_base'
TIP: Final = 'needle_tip'  #: Frame at the tip, y along the needle.

#: Joint along the needle, and joint of the base about x.
INSERTION: Final = 'insertion'
ROTATION: Final = 'rotation'

#: Joints of a steering robot: lateral position and tilt of the guide, and roll of the needle.
GUIDE_X: Final = 'guide_x'
GUIDE_Z: Final = 'guide_z'
TILT_X: Final = 'guide_tilt_x'
TILT_Z: Final = 'guide_tilt_z'
ROLL: Final = 'roll'

EVERY_NODE: Final = 'every node'
USER: Final = 'user'


class Qos(NamedTuple):
    """Quality of service that the publishers of a topic offer."""

    name: str  #: Name in the documentation.
    reliable: bool  #: Whether a lost message is sent again.
    latched: bool  #: Whether late-joining subscribers receive the previous messages.
    depth: int  #: Messages kept for a busy or late-joining subscriber.
    #: Whether the nodes of the suite subscribe with best effort also to a reliable publisher.
    lossy: bool = False
    #: Liveliness lease [s]; 0 leaves the detection of a dead publisher to DDS, which takes 20 s.
    lease: float = 0.0


class Stamp(Enum):
    """
    Meaning of the stamp of a message, which decides whether its age matters.

    `needle_controller.safety.input_monitor.InputMonitor` checks samples by this rule,
    `needle_ros.requests.RequestLog` checks requests.
    """

    #: Time of a sample, or of the sample that a command answers. Older messages and messages
    #: out of order are discarded; the limit is a parameter of the subscriber
    #: (``measurement_timeout``, ``sensor_timeout``, ``command_timeout``).
    SAMPLE = 'sample'
    #: Time at which the request was sent. It identifies and orders requests: a duplicate is
    #: answered but not executed again, and a request older than the current request is not
    #: executed. It is valid for `REQUEST_AGE`. Zero means now.
    REQUEST = 'request'
    UNCHECKED = 'unchecked'  #: Not checked: the message is a result, or information for users.


#: Maximum age of a request [s]. It covers three repetitions at intervals of 1 s and a delay of
#: 1 s, and excludes requests of a recording that is played back.
REQUEST_AGE: Final = 5.0


#: Compatible with subscribers with default QoS; nodes of the suite do not need retransmission of a
#: late sample. The depth holds a burst after a stall of the subscriber.
SENSOR: Final = Qos('reliable or best effort', reliable=True, latched=False, depth=50, lossy=True)

#: Only the newest message matters, and delivery must be reliable.
COMMAND: Final = Qos('reliable', reliable=True, latched=False, depth=1)

#: No messages: liveliness of a publisher.
ALIVE: Final = Qos('lease of 0.5 s', reliable=True, latched=False, depth=1, lease=0.5)

#: The last message reaches late-joining subscribers.
LATCHED: Final = Qos('latched', reliable=True, latched=True, depth=1)


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

    #: Name, relative to the namespace of the node; ``~`` stands for the node.
    name: str
    type_name: str
    publisher: str  #: Publishing nodes, `EVERY_NODE`, or `USER`.
    #: Content of the messages, for the documentation.
    meaning: str
    qos: Qos = SENSOR
    frame: str = ''  #: Frame of the header, '' without a frame.
    #: Joints of a JointState.
    joints: tuple[Joint, ...] = ()
    stamp: Stamp = Stamp.UNCHECKED

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

    def without_efforts(self) -> Topic:
        """Return the topic of a JointState without efforts."""
        return replace(self, joints=tuple(joint._replace(effort='') for joint in self.joints))

    def template(self) -> Template:
        """Return a template that writes and reads messages of this topic."""
        efforts = sum(bool(joint.effort) for joint in self.joints)
        return Template(
            self.type_name,
            self.frame,
            names=[joint.name for joint in self.joints],
            counts=(len(self.joints), len(self.joints), efforts),
        )


JOINT_STATES: Final = Topic(
    'joint_states',
    JOINT_STATE,
    'plant',
    'encoders of the robot: insertion depth and rotation; effort: axial force and torque '
    'on the needle; steered: `insertion`, `guide_x`, `guide_z` [m], `guide_tilt_x`, '
    '`guide_tilt_z`, `roll` [rad]',
    joints=(Joint(INSERTION, 'm', 'N'), Joint(ROTATION, 'rad', 'N m')),
    stamp=Stamp.SAMPLE,
)

#: Joints of a steered needle in addition to `insertion`.
STEERING_JOINTS: Final = (
    Joint(GUIDE_X, 'm', 'N'), Joint(GUIDE_Z, 'm', 'N'), Joint(TILT_X, 'rad', 'N m'),
    Joint(TILT_Z, 'rad', 'N m'), Joint(ROLL, 'rad', 'N m'),
)  # fmt: skip


def steered_states() -> Topic:
    """Return `JOINT_STATES` of a steered needle: `insertion` and the guide joints."""
    return replace(JOINT_STATES, joints=(JOINT_STATES.joints[0], *STEERING_JOINTS))


BASE_WRENCH: Final = Topic(
    'base_wrench',
    WRENCH,
    'plant',
    'force sensor, force of the base on the needle: `force.y` axial, `force.z` lateral '
    '[N], `torque.x` [N m]; mode `indenter`: force of the end-effector on the tissue',
    frame=BASE,
    stamp=Stamp.SAMPLE,
)

TIP_DEFLECTION: Final = Topic(
    'tip_deflection',
    POINT,
    'plant',
    'tracker or imager: `point.y` insertion depth, `point.z` deflection of the tip [m]; '
    'steered: `point.x` too',
    frame=ENTRY,
    stamp=Stamp.SAMPLE,
)

GROUND_TRUTH: Final = Topic(
    'ground_truth',
    JOINT_STATE,
    'plant',
    'simulation only: d (length outside the tissue), theta and q1..qn, the full state; '
    'steered: d, `tip_x`, `tip_z` [m], `tip_roll` [rad]; effort, in mode `simulation`: '
    'generalized forces applied since the previous sample',
    joints=(Joint('d', 'm'), Joint('theta', 'rad'), Joint('q1', 'm^1.5'), Joint('q2', 'm^1.5')),
    stamp=Stamp.SAMPLE,
)


def ground_truth(modes: int, *, commanded: bool) -> Topic:
    """
    Return `GROUND_TRUTH` with all joints of a plant with a number of shape modes.

    `commanded` adds the efforts of mode `simulation`, in which commands move the needle.
    """
    bending = [Joint(f'q{k + 1}', 'm^1.5', 'N m^-0.5') for k in range(modes)]
    joints = (Joint('d', 'm', 'N'), Joint('theta', 'rad', 'N m'), *bending)
    truth = replace(GROUND_TRUTH, joints=joints)
    return truth if commanded else truth.without_efforts()


def steered_truth(*, commanded: bool) -> Topic:
    """Return `GROUND_TRUTH` of a steered needle; `commanded` adds the efforts."""
    joints = (
        Joint('d', 'm', 'N'), Joint('tip_x', 'm', 'N'), Joint('tip_z', 'm', 'N'),
        Joint('tip_roll', 'rad', 'N m'),
    )  # fmt: skip
    truth = replace(GROUND_TRUTH, joints=joints)
    return truth if commanded else truth.without_efforts()


END_EFFECTOR_POSE: Final = Topic(
    'end_effector_pose',
    POSE,
    'plant',
    'mode `indenter`: position of the end-effector [m]',
    frame=ENTRY,
)

NEEDLE_SHAPE: Final = Topic(
    'needle_shape',
    'visualization_msgs/msg/Marker',
    'plant',
    'the needle as a line, and its cut path, 30 Hz while there is a subscriber',
    frame=ENTRY,
)

NEEDLE_POSES: Final = Topic(
    'needle_poses',
    'geometry_msgs/msg/PoseArray',
    'plant',
    'poses along the needle, y along it, 30 Hz while there is a subscriber',
    frame=ENTRY,
)

CLOCK: Final = Topic(
    '/clock',
    'rosgraph_msgs/msg/Clock',
    'plant',
    'simulated time, with `publish_clock` or `lockstep`',
    # Like the subscription of rclpy.
    qos=SENSOR._replace(depth=1),
)

EVENTS: Final = Topic(
    '~/events',
    'diagnostic_msgs/msg/DiagnosticArray',
    'plant',
    'inputs of the plant other than commands (trajectories, disturbances), with the number of '
    'their first sample: [replay.md](replay.md)',
    # All events, also for a late-joining subscriber.
    qos=LATCHED._replace(depth=1000),
)

WRENCH_COMMAND: Final = Topic(
    'wrench_command',
    WRENCH,
    'controller',
    'force and torque on the needle: `force.y` [N], `torque.x` [N m]; stamp of the answered '
    'sample',
    qos=COMMAND,
    frame=BASE,
    stamp=Stamp.SAMPLE,
)

JOINT_COMMANDS: Final = Topic(
    'joint_commands',
    JOINT_STATE,
    'ros2_control',
    'from the hardware interface of ros2_control, NaN without a command; mode `simulation`: '
    'efforts, in place of `wrench_command`; mode `robot`: positions, or velocities; steered, '
    'in both modes: guide and roll: [howto/ros2-control.md](howto/ros2-control.md)',
    qos=COMMAND,
    joints=(Joint(INSERTION, 'm', 'N'), Joint(ROTATION, 'rad', 'N m')),
    stamp=Stamp.SAMPLE,
)

COMMANDER: Final = Topic(
    'wrench_command/alive',
    'std_msgs/msg/Empty',
    'controller',
    'no messages: the end of its lease indicates a dead controller',
    qos=ALIVE,
)

MEASURER: Final = replace(
    COMMANDER,
    name='joint_states/alive',
    publisher='plant',
    meaning='no messages: the end of its lease indicates a dead plant',
)

PROCESSED: Final = Topic(
    'joint_states/_processed',
    'std_msgs/msg/Header',
    'steering',
    'lockstep: stamp of a sample that a node (named in `frame_id`) has processed, after its '
    'motions; a plant with `lockstep` waits for all publishers; not recorded',
    # Several nodes publish.
    qos=COMMAND._replace(depth=10),
)

RECORDED: Final = replace(
    PROCESSED,
    name='joint_states/_recorded',
    publisher='recorder',
    meaning='stamp of the newest recorded sample, zero at the end of recording; a plant with an '
    'independent time is at most 80 samples ahead of it, with `lockstep` 10; not recorded',
)

REFERENCE: Final = Topic(
    'reference',
    JOINT_STATE,
    'controller',
    'insertion depth and velocity of the reference',
    joints=(Joint(INSERTION, 'm'),),
)

TRACKING_ERROR: Final = Topic(
    'tracking_error',
    JOINT_STATE,
    'controller',
    'reference minus measurement',
    joints=(Joint(INSERTION, 'm'),),
)

TARGET: Final = Topic(
    'target',
    POINT,
    f'{USER}, slicer',
    '`point.y`: target insertion depth [m]; to the node `steering`: target position of the tip, '
    'x, y, z [m]',
    qos=COMMAND,
    frame=ENTRY,
    stamp=Stamp.REQUEST,
)

SYSTEM_STATE: Final = Topic(
    'system_state',
    'diagnostic_msgs/msg/DiagnosticStatus',
    'controller, steering, plant',
    'mode of the system (running, paused, retracting, stopped) with the reason of a stop; on '
    'change and 1 Hz',
    # Several nodes publish.
    qos=LATCHED._replace(depth=10),
)

EMERGENCY_STOP: Final = Topic(
    'emergency_stop',
    'std_msgs/msg/Bool',
    USER,
    'true stops the system, as `~/stop` of any node',
    qos=COMMAND,
)

TIP_EXPECTED: Final = Topic(
    'tip_expected',
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    'steering',
    'predicted tip pose at the target depth, with covariance, after each tip measurement',
    qos=COMMAND,
    frame=ENTRY,
)

INSERTION_RECORD: Final = Topic(
    'insertion_record',
    'std_msgs/msg/String',
    'steering',
    'plan and estimate of the latest insertion, as JSON: depths, tip measurements and guide '
    'setpoints so far, expected tip; a restarted node resumes from it',
    qos=LATCHED,
)

TIP_POSE: Final = Topic(
    'tip_pose',
    POSE,
    'slicer',
    'tip pose, y along the needle, 20 Hz; the direction is measured only if `needle_poses` are '
    'published',
    # SlicerROS2 requests reliable QoS.
    qos=COMMAND,
    frame=ENTRY,
)

JOINT_TRAJECTORY: Final = Topic(
    'joint_trajectory',
    'trajectory_msgs/msg/JointTrajectory',
    f'{USER}, steering',
    'to the controller: `insertion`, positions [m], and optionally velocities [m/s]; '
    'to a plant in mode `robot`: `insertion`, positions [m], or efforts [N] of a push; '
    'steered, in both modes: guide and roll [m, rad]; in mode `indenter`: efforts of `x` and '
    '`z` [N]',
    qos=COMMAND,
    stamp=Stamp.REQUEST,
)

ROBOT_DESCRIPTION: Final = Topic(
    'robot_description',
    'std_msgs/msg/String',
    'robot_state_publisher',
    'URDF of the robot from `description/`, with `ros2_control.launch.py`',
    qos=LATCHED,
)

TF: Final = Topic(
    '/tf',
    'tf2_msgs/msg/TFMessage',
    'robot_state_publisher; with `publish_tf`: plant',
    'robot_state_publisher: the joints, with `ros2_control.launch.py`; plant: `needle_tip` in '
    '`needle_base`, 30 Hz',
    qos=COMMAND._replace(depth=100),
)

FRICTION: Final = Topic(
    'friction',
    'diagnostic_msgs/msg/DiagnosticArray',
    'identification',
    'estimate, interval, unit and number of samples of each coefficient',
    qos=LATCHED,
)

STIFFNESS: Final = replace(FRICTION, name='stiffness')

CONFIGURATION: Final = Topic(
    '~/configuration',
    'std_msgs/msg/String',
    EVERY_NODE,
    'all parameters of the node as a parameter file',
    qos=LATCHED,
)

DIAGNOSTICS: Final = Topic(
    '/diagnostics',
    'diagnostic_msgs/msg/DiagnosticArray',
    EVERY_NODE,
    'state of the node, 1 Hz and on change',
    qos=COMMAND._replace(depth=10),
)


class Action(NamedTuple):
    """An action of the contract."""

    #: Name, relative to the node.
    name: str
    type_name: str


#: Offered by the nodes that receive `joint_trajectory`, if its package is installed.
FOLLOW_JOINT_TRAJECTORY: Final = Action(
    '~/follow_joint_trajectory', 'control_msgs/action/FollowJointTrajectory'
)

#: All topics, in the order above.
TOPICS: Final = tuple(value for value in [*globals().values()] if isinstance(value, Topic))
