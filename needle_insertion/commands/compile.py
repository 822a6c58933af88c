# SPDX-License-Identifier: Apache-2.0
"""`needle compile`: compile all functions for this machine, once."""

import argparse
import os
import sys

from needle_insertion.commands.common import add_flag


def add_arguments(parser: argparse.ArgumentParser) -> None:
    portable = 'compile for every processor of the level x86-64-v3, for a wheel'
    add_flag(parser, '--portable', portable)


def run(options: argparse.Namespace) -> int:
    from needle_dynamics.compiled.store import PORTABLE, writable_folder

    if options.portable:
        # Numba reads these when it is imported.
        os.environ.update(PORTABLE)
    from needle_dynamics.compiled.cache import kernels, where_kept
    from needle_insertion.compilation import compile_kernels, MODULES

    if compile_kernels() and writable_folder() is None:
        sys.stderr.write(f'error: {where_kept()}\n')
        return 1
    sys.stdout.write(f'{len(kernels(MODULES))} compiled functions: {where_kept()}\n')
    return 0
