"""The plant as hardware of ros2_control, with its stock controllers and robot_state_publisher."""

import os

from ament_index_python.packages import get_package_share_path, PackageNotFoundError
from launch import LaunchContext, LaunchDescription
from launch.action import Action
from launch.actions import (
    DeclareLaunchArgument,
    OpaqueFunction,
    SetEnvironmentVariable,
    Shutdown,
)
from launch.substitutions import Command, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from needle_dynamics.steering.parameters import NEEDLES, STEERING_PRESETS, SteeringParameters
from needle_ros.network import LOCAL, RANGE, stay_local

#: Default, meaning and values of each argument; without a list of values all are allowed.
ARGUMENTS = {
    'mode': (
        'robot',
        'robot: controllers send positions; simulation: they send forces',
        ['robot', 'simulation'],
    ),
    'steered': (
        'false',
        'the needle bends, cuts its own path, and has a guide that moves',
        ['true', 'false'],
    ),
    'preset': ('phantom', 'constants of needle and tissue', [*NEEDLES]),
    'depth': ('0.02', 'inserted length at the start [m]', []),
    'namespace': ('', 'namespace of all nodes', []),
    'discovery': (
        '',
        'SUBNET lets other machines in; empty: ROS_AUTOMATIC_DISCOVERY_RANGE or LOCALHOST',
        ['', 'LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT'],
    ),
}

#: Packages of a ROS machine that no wheel has.
NEEDED = (
    'controller_manager',
    'effort_controllers',
    'joint_state_topic_hardware_interface',
    'joint_trajectory_controller',
    'robot_state_publisher',
    'tf2_msgs',
    'xacro',
)


def installed(package: str) -> bool:
    """Tell whether a package is installed."""
    try:
        get_package_share_path(package)
    except PackageNotFoundError:
        return False
    return True


def spawned(mode: str, *, steered: bool) -> tuple[list[str], list[str]]:
    """Return the controllers of config/ros2_control.yaml to activate, and those to have ready."""
    active, ready = ['insertion_position'], []
    if mode == 'simulation':
        active, ready = ['insertion_effort'], ['force']
    return active + ['guide_position'] * steered, ready


def start(context: LaunchContext) -> list[Action]:
    """Return what the arguments ask for, or refuse it before any node has started."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    lacking = [name for name in NEEDED if not installed(name)]
    if lacking:
        raise RuntimeError(f'this launch file needs {", ".join(lacking)}, not installed')
    share = get_package_share_path('needle_insertion')
    mode, preset, steered = given['mode'], given['preset'], given['steered'] == 'true'
    needle = NEEDLES[preset]
    known = STEERING_PRESETS.get(preset)
    steering = known.steering if known else SteeringParameters()
    described = {
        'mode': mode,
        'steered': given['steered'],
        'length': needle.length,
        'minimum_depth': needle.minimum_depth,
        'free_length': steering.free_length,
    }
    words = [f' {name}:={value}' for name, value in described.items()]
    urdf = Command(['xacro ', str(share / 'description/needle_insertion.urdf.xacro'), *words])
    controllers = str(share / 'config/ros2_control.yaml')
    plant = {
        'mode': mode,
        'steered': steered,
        'model.preset': preset,
        'depth': float(given['depth']),
        'publish_tf': True,
    }
    common = {'namespace': given['namespace'], 'on_exit': Shutdown()}
    nodes = [
        Node(
            package='needle_insertion',
            executable='plant',
            parameters=[plant],
            additional_env={'NEEDLE_END_WITH_PARENT': '1'},
            **common,
        ),
        # It tells the controller manager, too, what the robot is.
        Node(
            package='robot_state_publisher',
            executable='robot_state_publisher',
            parameters=[{'robot_description': ParameterValue(urdf, value_type=str)}],
            **common,
        ),
        Node(
            package='controller_manager',
            executable='ros2_control_node',
            parameters=[controllers],
            **common,
        ),
    ]
    active, ready = spawned(mode, steered=steered)
    # No joint_state_broadcaster: the plant itself publishes joint_states.
    for names, options in ((active, []), (ready, ['--inactive'])):
        if names:
            nodes.append(
                Node(
                    package='controller_manager',
                    executable='spawner',
                    arguments=[*names, *options, '--param-file', controllers],
                    namespace=given['namespace'],
                )
            )
    # What is open is said: by the argument, or by the environment.
    environment = {**os.environ, **({RANGE: given['discovery']} if given['discovery'] else {})}
    stay_local(environment)
    variables = [
        SetEnvironmentVariable(name, environment[name]) for name in LOCAL if name in environment
    ]
    return [*variables, *nodes]


def generate_launch_description() -> LaunchDescription:
    """Return the plant, the controller manager and what describes the robot."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    name, default_value=default, description=meaning, choices=values or None
                )
                for name, (default, meaning, values) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
