"""An insertion whose tip is aimed: `insertion.launch.py` with the node `steering`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of an insertion that is steered; arguments are those of the other file."""
    here = Path(__file__).resolve().parent
    return LaunchDescription(
        [
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(here / 'insertion.launch.py')),
                launch_arguments={'steering': 'true'}.items(),
            )
        ]
    )
