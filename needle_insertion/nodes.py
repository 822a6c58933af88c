# SPDX-License-Identifier: Apache-2.0
"""Entry points of the nodes: ``ros2 run needle_insertion plant``, or needle-plant."""

import os
from pathlib import Path
import runpy
import signal
import sys
from typing import Final

#: Module of each node by its program name in setup.py.
NODES: Final = {
    'plant': 'needle_dynamics.plant_node',
    'controller': 'needle_controller.controller_node',
    'steering': 'needle_controller.steering_node',
    'identification': 'needle_identification.identification_node',
    'recorder': 'needle_identification.recorder_node',
    'player': 'needle_identification.player_node',
    'slicer': 'needle_insertion.slicer.slicer_node',
}


def main() -> None:
    """Run the node with the name of this program as ``python -m`` does; exit with its status."""
    # Imports take a second: Ctrl-C ends them at once, without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    name = Path(sys.argv[0]).stem.removeprefix('needle-')
    # Imported here: setup.py reads this file without the packages.
    from needle_ros.process import ONE_THREAD

    # Before the import of NumPy; a value of the user stays.
    os.environ.update({**ONE_THREAD, **os.environ})
    try:
        runpy.run_module(NODES[name], run_name='__main__')
    except ModuleNotFoundError as error:
        from needle_ros.errors import missing_ros

        sys.exit(f'error: {missing_ros(error, f"needle-{name}")}')
