"""`needle bench`: the benchmarks, which run from a clone and are not installed."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
import sys

from needle_insertion.commands.common import Subcommand

_ROOT = Path(__file__).parents[2]


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    if not (_ROOT / 'benchmarks').is_dir():
        parser.error('only a clone of the repository has the benchmarks; run it from there')
    # The clone is not on the import path.
    sys.path.insert(0, str(_ROOT))
    import_module('benchmarks.run').add_arguments(parser)


def _run(options: argparse.Namespace) -> int:
    """Run a benchmark; return 1 if a bar is missed."""
    return int(import_module('benchmarks.run').run(options))


COMMAND = Subcommand(_add_arguments, _run)
