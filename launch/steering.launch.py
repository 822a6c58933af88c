# SPDX-License-Identifier: Apache-2.0
"""Launch a steered insertion: `insertion.launch.py` with the node `steering`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource


def generate_launch_description() -> LaunchDescription:
    """Include `insertion.launch.py` with steering; the arguments are the same."""
    here = Path(__file__).resolve().parent
    return LaunchDescription(
        [
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(here / 'insertion.launch.py')),
                launch_arguments={'steering': 'true'}.items(),
            )
        ]
    )
