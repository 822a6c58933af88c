"""Plant and controller, and optionally a recorder and RViz."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare
import yaml

#: Default and meaning of each argument; an empty one leaves the value of the parameter file.
ARGUMENTS = {
    'params_file': ('', 'ROS parameter file; empty: config/insertion.yaml of this package'),
    'mode': (
        '',
        'mode of the plant: simulation, robot or indenter; the controller runs only in simulation',
    ),
    'preset': (
        '',
        'constants of the model in plant and controller: phantom, paper_si or paper_mm',
    ),
    'law': ('', 'law of the controller: adaptive, inverse_dynamics or pid'),
    'lockstep': ('', 'true: each sample waits for the command that answers the sample before'),
    'real_time_factor': ('', 'simulated seconds per second; 0: as fast as possible'),
    'bag': ('', 'folder to record to; empty: no recording'),
    'rviz': ('false', 'true: show the needle in RViz, which must be installed'),
    'discovery': ('LOCALHOST', 'which nodes may join: LOCALHOST, SUBNET, OFF or SYSTEM_DEFAULT'),
}

#: Parameters that arguments set, by node.
PARAMETERS = {
    'plant': {
        'mode': 'mode',
        'preset': 'model.preset',
        'lockstep': 'lockstep',
        'real_time_factor': 'real_time_factor',
    },
    'controller': {'preset': 'model.preset', 'law': 'law'},
    'recorder': {'bag': 'path'},
}


def start(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    config = PathJoinSubstitution([FindPackageShare('needle_insertion'), 'config'])
    values = {
        # Typed as in a parameter file.
        node: {key: yaml.safe_load(given[name]) for name, key in table.items() if given[name]}
        for node, table in PARAMETERS.items()
    }
    names = ['plant']
    if given['mode'] in ('', 'simulation'):
        names.append('controller')
    if given['bag']:
        names.append('recorder')
    if values['plant'].get('lockstep') or given['real_time_factor']:
        values['plant']['publish_clock'] = True
        values['controller']['use_sim_time'] = True
    file = given['params_file'] or PathJoinSubstitution([config, 'insertion.yaml'])
    nodes = [
        Node(package='needle_insertion', executable=name, parameters=[file, values[name]])
        for name in names
    ]
    if yaml.safe_load(given['rviz']):
        layout = PathJoinSubstitution([config, 'insertion.rviz'])
        nodes.append(Node(package='rviz2', executable='rviz2', arguments=['-d', layout]))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of an insertion."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=meaning)
                for name, (default, meaning) in ARGUMENTS.items()
            ),
            SetEnvironmentVariable(
                'ROS_AUTOMATIC_DISCOVERY_RANGE', LaunchConfiguration('discovery')
            ),
            OpaqueFunction(function=start),
        ]
    )
