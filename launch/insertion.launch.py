# SPDX-License-Identifier: Apache-2.0
"""Launch plant and controller, and optionally steering, a recorder and RViz."""

import os
from pathlib import Path
import signal

from ament_index_python.packages import get_package_share_directory, PackageNotFoundError
from launch import LaunchContext, LaunchDescription
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable, Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from needle_ros.network import LOCAL, RANGE, stay_local
import yaml

#: Default, description and valid values of each argument. An empty argument keeps the value of the
#: parameter file; an empty list allows any value.
ARGUMENTS = {
    'params_file': (
        '',
        'ROS parameter file; empty: insertion.yaml or steering.yaml in config/ of this package',
        [],
    ),
    'mode': (
        '',
        'mode of the plant; the controller runs only in simulation',
        ['', 'simulation', 'robot', 'indenter'],
    ),
    'needle': (
        '',
        'needle and tissue of all nodes, by name or file, such as phantom or bending_35mm',
        [],
    ),
    'steered': (
        '',
        'the needle bends and cuts a curved path, and the guide moves',
        ['', 'true', 'false'],
    ),
    'steering': (
        'false',
        'the node steering guides the tip to the target; implies steered',
        ['true', 'false'],
    ),
    'law': ('', 'law of the controller', ['', 'adaptive', 'inverse_dynamics', 'pid']),
    'lockstep': (
        '',
        'each sample waits for the command, and for steering, of the previous sample',
        ['', 'true', 'false'],
    ),
    'real_time_factor': ('', 'simulated seconds per second; 0: as fast as possible', []),
    'use_sim_time': (
        '',
        'controller and recorder take their time from /clock',
        ['', 'true', 'false'],
    ),
    'namespace': ('', 'namespace of all nodes', []),
    'frame_prefix': ('', 'prefix of the frames on /tf and displays, such as left/', []),
    'publish_tf': ('', 'the plant publishes needle_tip on /tf', ['', 'true', 'false']),
    'bag': ('', 'folder to record to; empty: no recording', []),
    'rviz': ('false', 'show the needle in RViz, which must be installed', ['true', 'false']),
    'discovery': (
        '',
        'SUBNET includes other machines; empty: ROS_AUTOMATIC_DISCOVERY_RANGE or LOCALHOST',
        ['', 'LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT'],
    ),
}

#: Parameters set by launch arguments, by node.
PARAMETERS = {
    'plant': {
        'mode': 'mode',
        'needle': 'needle',
        'steered': 'steered',
        'lockstep': 'lockstep',
        'real_time_factor': 'real_time_factor',
        'frame_prefix': 'frame_prefix',
        'publish_tf': 'publish_tf',
    },
    'controller': {'needle': 'needle', 'law': 'law', 'use_sim_time': 'use_sim_time'},
    'steering': {'needle': 'needle', 'use_sim_time': 'use_sim_time'},
    'recorder': {'bag': 'path', 'use_sim_time': 'use_sim_time'},
}


def ended(event: ProcessExited, context: LaunchContext) -> Action | None:
    """End all nodes with the first node; a failed node makes launch fail."""
    if context.is_shutdown:
        return None
    reason = f'{event.process_name} has ended with exit code {event.returncode}'
    if event.returncode:
        raise RuntimeError(f'{reason}; see its log. All nodes are stopped')
    return Shutdown(reason=reason)


def share(package: str, why: str) -> Path:
    """Return the share directory of a package; the error names the option that needs it."""
    try:
        return Path(get_package_share_directory(package))
    except PackageNotFoundError:
        raise RuntimeError(f'{why} needs the package {package}, which is not installed') from None


def start(context: LaunchContext) -> list[Action]:
    """Return the actions for the launch arguments; reject invalid arguments before any start."""
    # Closing the terminal ends launch and must end the nodes too.
    signal.signal(signal.SIGHUP, lambda *_: os.kill(os.getpid(), signal.SIGINT))
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    config = share('needle_insertion', 'this launch file') / 'config'
    file = Path(given['params_file']).expanduser() if given['params_file'] else None
    steering = given['steering'] == 'true'
    file = file or config / ('steering.yaml' if steering else 'insertion.yaml')
    if not file.is_file():
        raise RuntimeError(f'params_file {file} does not exist')
    values = {
        # Types as in a parameter file.
        node: {key: yaml.safe_load(given[name]) for name, key in table.items() if given[name]}
        for node, table in PARAMETERS.items()
    }
    names = ['plant']
    if given['mode'] in ('', 'simulation'):
        names.append('controller')
    if steering:
        if given['mode'] == 'indenter' or given['steered'] == 'false':
            raise RuntimeError('steering:=true needs a steered needle')
        names.append('steering')
        values['plant'].setdefault('steered', True)
        values['controller']['steered'] = True
    if given['bag']:
        names.append('recorder')
        values['recorder']['path'] = str(Path(given['bag']).expanduser())
    clock = []
    if values['plant'].get('lockstep') or given['real_time_factor']:
        # Each plant has its own time.
        clock.append(('/clock', 'clock'))
        values['plant']['publish_clock'] = True
        for name in ('controller', 'steering'):
            values[name].setdefault('use_sim_time', True)
    common = {
        'namespace': given['namespace'],
        'remappings': clock,
        'on_exit': ended,
        # On SIGTERM, launch leaves its nodes running.
        'additional_env': {'NEEDLE_END_WITH_PARENT': '1'},
    }
    nodes = [
        Node(
            package='needle_insertion',
            executable=name,
            parameters=[str(file), values[name]],
            **common,
        )
        for name in names
    ]
    if given['rviz'] == 'true':
        share('rviz2', 'rviz:=true')
        frame = f'{given["frame_prefix"]}needle_entry'
        words = ['-d', str(config / 'insertion.rviz'), '-f', frame]
        nodes.append(Node(package='rviz2', executable='rviz2', arguments=words, **common))
    # The argument or the environment selects the discovery range.
    environment = {**os.environ, **({RANGE: given['discovery']} if given['discovery'] else {})}
    stay_local(environment)
    variables = [
        SetEnvironmentVariable(name, environment[name]) for name in LOCAL if name in environment
    ]
    return [*variables, *nodes]


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of an insertion."""
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
