# SPDX-License-Identifier: Apache-2.0
"""Launch the plant as ros2_control hardware, with stock controllers and robot_state_publisher."""

import os

from ament_index_python.packages import get_package_share_path, PackageNotFoundError
from launch import LaunchContext, LaunchDescription
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable, Shutdown
from launch.substitutions import Command, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from needle_dynamics import find_needle, NEEDLES
from needle_ros.network import LOCAL, RANGE, stay_local

#: Default, description and valid values of each argument; an empty list allows any value.
ARGUMENTS = {
    'mode': (
        'robot',
        'robot: controllers send positions; simulation: they send forces',
        ['robot', 'simulation'],
    ),
    'steered': (
        'false',
        'the needle bends and cuts a curved path, and the guide moves',
        ['true', 'false'],
    ),
    'needle': ('phantom', 'constants of needle and tissue', [*NEEDLES]),
    'depth': ('0.02', 'initial insertion depth [m]', []),
    'namespace': ('', 'namespace of all nodes', []),
    'frame_prefix': ('', 'prefix of all frames on /tf, such as left/', []),
    'discovery': (
        '',
        'SUBNET includes other machines; empty: ROS_AUTOMATIC_DISCOVERY_RANGE or LOCALHOST',
        ['', 'LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT'],
    ),
}

#: Packages of a ROS installation that are not available as wheels.
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
    """Return whether a package is installed."""
    try:
        get_package_share_path(package)
    except PackageNotFoundError:
        return False
    return True


def spawned(mode: str, *, steered: bool) -> tuple[list[str], list[str]]:
    """Return the controllers of config/ros2_control.yaml: active, and loaded but inactive."""
    active, ready = ['insertion_position'], []
    if mode == 'simulation':
        active, ready = ['insertion_effort'], ['force']
    return active + ['guide_position'] * steered, ready


def start(context: LaunchContext) -> list[Action]:
    """Return the actions for the launch arguments; reject invalid arguments before any start."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    lacking = [name for name in NEEDED if not installed(name)]
    if lacking:
        raise RuntimeError(f'this launch file needs {", ".join(lacking)}, not installed')
    share = get_package_share_path('needle_insertion')
    mode, name, steered = given['mode'], given['needle'], given['steered'] == 'true'
    needle, steering, _ = find_needle(name)
    described = {
        'mode': mode,
        'steered': given['steered'],
        'length': needle.length,
        'minimum_depth': needle.minimum_depth,
        'free_length': steering.free_length,
        'density': needle.density,
        'area': needle.area,
        'area_moment': needle.area_moment,
        'rotary_inertia': needle.rotary_inertia,
        'carriage_mass': needle.carriage_mass,
    }
    words = [f' {name}:={value}' for name, value in described.items()]
    urdf = Command(['xacro ', str(share / 'description/needle_insertion.urdf.xacro'), *words])
    controllers = str(share / 'config/ros2_control.yaml')
    plant = {
        'mode': mode,
        'steered': steered,
        'needle': name,
        'depth': float(given['depth']),
        'publish_tf': True,
        'frame_prefix': given['frame_prefix'],
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
        # The controller manager reads the robot description from this node, too.
        Node(
            package='robot_state_publisher',
            executable='robot_state_publisher',
            parameters=[
                {
                    'robot_description': ParameterValue(urdf, value_type=str),
                    'frame_prefix': given['frame_prefix'],
                }
            ],
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
    # No joint_state_broadcaster: the plant publishes joint_states.
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
    # The argument or the environment selects the discovery range.
    environment = {**os.environ, **({RANGE: given['discovery']} if given['discovery'] else {})}
    stay_local(environment)
    variables = [
        SetEnvironmentVariable(name, environment[name]) for name in LOCAL if name in environment
    ]
    return [*variables, *nodes]


def generate_launch_description() -> LaunchDescription:
    """Return the plant, the controller manager and the robot_state_publisher."""
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
