"""Plant, controller and, if a path is given, recorder, with one parameter file."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of an insertion."""
    parameters = LaunchConfiguration('params_file')
    bag = LaunchConfiguration('bag')
    default = PathJoinSubstitution(
        [FindPackageShare('needle_insertion'), 'config', 'insertion.yaml']
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params_file', default_value=default, description='ROS parameter file'
            ),
            DeclareLaunchArgument(
                'bag', default_value='', description='folder to record to; empty: no recorder'
            ),
            *(
                Node(package='needle_insertion', executable=name, parameters=[parameters])
                for name in ('plant', 'controller')
            ),
            Node(
                package='needle_insertion',
                executable='recorder',
                parameters=[{'path': bag}],
                condition=IfCondition(PythonExpression(["'", bag, "' != ''"])),
            ),
        ]
    )
