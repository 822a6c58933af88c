# SPDX-License-Identifier: Apache-2.0
"""`needle compile`: compile the kernels of all packages for this machine, on all processors."""

import argparse
from collections.abc import Sequence
from concurrent.futures import as_completed
from importlib.util import find_spec
import os
import sys
from typing import Final

from needle_dynamics.compiled.cache import is_kept, kernels, prepare, where_kept
from needle_dynamics.compiled.store import clear, PORTABLE, writable_folder
from needle_insertion.commands.common import add_flag
from needle_insertion.progress import ProgressLine
from needle_ros.process import cores
from needle_ros.process_pool import processes

#: Modules with kernels, the slowest to compile first.
MODULES: Final = (
    'needle_controller.compiled.filter',
    'needle_dynamics.compiled.step',
    'needle_controller.compiled.loop',
    'needle_controller.compiled.guide_plan',
    'needle_controller.compiled.hypotheses',
    'needle_dynamics.compiled.lanes',
    'needle_dynamics.compiled.intervals',
    'needle_dynamics.compiled.cut',
    'needle_dynamics.compiled.cutting_needle',
    'needle_dynamics.compiled.superposition',
    'needle_planning.compiled.boxes',
    'needle_controller.compiled.laws',
    'needle_controller.compiled.quintic',
    'needle_dynamics.compiled.axis',
    'needle_dynamics.compiled.force_sensor',
    'needle_dynamics.compiled.friction',
    'needle_dynamics.compiled.integrals',
    'needle_dynamics.compiled.normal_modes',
    # Needs Gymnasium, which is optional.
    *(('needle_study.gym.pushed', 'needle_study.gym.steered') if find_spec('gymnasium') else ()),
)

#: Modules compiled at their first call: batches of needles with three or four modes, which few
#: need, and no node calls.
LATER: Final = ('needle_controller.compiled.many_loop', 'needle_dynamics.compiled.many_batch')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    portable = 'compile for every processor of the level x86-64-v3, for a wheel'
    add_flag(parser, '--portable', portable)
    add_flag(parser, '--clear', 'delete all compiled functions, as before an uninstallation')


def run(options: argparse.Namespace) -> int:
    if options.clear:
        sys.stdout.write(f'deleted {clear()} compiled functions\n')
        return 0
    if options.portable:
        # Numba reads these when it is imported, with the first kernel.
        os.environ.update(PORTABLE)
    if compile_kernels() and writable_folder() is None:
        sys.stderr.write(f'error: {where_kept()}\n')
        return 1
    sys.stdout.write(f'{len(kernels(MODULES))} compiled functions: {where_kept()}\n')
    return 0


def compile_kernels(names: Sequence[str] = MODULES) -> int:
    """Compile the kernels that are not in the cache, with progress; return their number."""
    missing = [name for name in kernels(names) if not is_kept(name)]
    if not missing:
        return 0
    with ProgressLine('compiling for this machine') as show, processes(cores()) as pool:
        show(where_kept())
        futures = [pool.submit(_compile, name) for name in missing]
        for done, future in enumerate(as_completed(futures), 1):
            show(f'{done} of {len(missing)} ({future.result()})')
    return len(missing)


def compile_nodes() -> int:
    from needle_controller.controller_node import ControllerNode
    from needle_controller.steering_node import SteeringNode
    from needle_dynamics.plant_node import PlantNode

    return compile_kernels([*ControllerNode.KERNELS, *PlantNode.KERNELS, *SteeringNode.KERNELS])


def _compile(name: str) -> str:
    for _ in prepare([name]):
        pass
    return name.partition(':')[2]
