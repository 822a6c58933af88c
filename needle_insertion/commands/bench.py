"""`needle bench`: the benchmarks, which are run from a clone and not installed."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
import sys

_ROOT = Path(__file__).parents[2]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    Add the options of `needle bench`.

    Parameters
    ----------
    parser : ArgumentParser
        Parser of the command. It ends the process with status 2 if this is not a clone.

    """
    if not (_ROOT / 'benchmarks').is_dir():
        parser.error('only a clone of the repository has the benchmarks; run it from there')
    # A clone is not on the path.
    sys.path.insert(0, str(_ROOT))
    import_module('benchmarks.run').add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """
    Run a benchmark.

    Parameters
    ----------
    options : Namespace
        As declared by `add_arguments`.

    Returns
    -------
    int
        Exit status: 0 if no bar is missed, else 1.

    """
    return int(import_module('benchmarks.run').run(options))
