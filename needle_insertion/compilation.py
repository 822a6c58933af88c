"""All kernels of the packages, compiled once for this machine on all processors."""

from __future__ import annotations

from concurrent.futures import as_completed
from contextlib import closing
import os
import sys
from time import monotonic
from typing import Final

from needle_dynamics.compiled.cache import is_kept, kernels, prepare, where_kept
from needle_ros.process_pool import processes
from tqdm import tqdm

#: Modules with kernels; those that take longest are first.
MODULES: Final = (
    'needle_controller.compiled.filter',
    'needle_dynamics.compiled.step',
    'needle_controller.compiled.loop',
    'needle_controller.compiled.steering',
    'needle_dynamics.compiled.lanes',
    'needle_dynamics.compiled.refined',
    'needle_dynamics.compiled.cut',
    'needle_insertion.gym.pushed',
    'needle_controller.compiled.laws',
    'needle_controller.compiled.quintic',
    'needle_dynamics.compiled.axis',
    'needle_dynamics.compiled.force_sensor',
    'needle_dynamics.compiled.friction',
    'needle_dynamics.compiled.integrals',
    'needle_dynamics.compiled.normal_modes',
    'needle_dynamics.compiled.oscillator',
)


def compile_all() -> int:
    """
    Compile the kernels that are not on disk, with a progress bar on standard error.

    Returns
    -------
    int
        Number of kernels that were compiled.

    """
    missing = [name for name in kernels(MODULES) if not is_kept(name)]
    if not missing:
        return 0
    begin, count = monotonic(), os.cpu_count() or 1
    sys.stderr.write(f'compiling {len(missing)} functions for this machine: {where_kept()}\n')
    with (
        processes(count) as pool,
        closing(tqdm(total=len(missing), desc='compiling', disable=None)) as bar,
    ):
        for future in as_completed([pool.submit(_compile, name) for name in missing]):
            bar.set_postfix_str(future.result())
            bar.update()
    sys.stderr.write(f'compiled in {monotonic() - begin:.0f} s\n')
    return len(missing)


def _compile(name: str) -> str:
    """Compile a kernel in a worker; return its name."""
    for _ in prepare([name]):
        pass
    return name.partition(':')[2]
