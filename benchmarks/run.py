# SPDX-License-Identifier: Apache-2.0
"""Command `needle bench`: run benchmarks, print a page, and check the bars."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
import subprocess
import sys
import time
from typing import Final, TypeAlias

from benchmarks.measure import Bar
from benchmarks.page import Answer, conclusion, header, Tick
from needle_insertion.progress import ProgressLine
from needle_ros.errors import ParameterError

#: A measurement.
Question: TypeAlias = Callable[[Tick], Answer]

#: Modules of each benchmark, each with a function `compare`; safety, graph and slicer need ROS.
MODULES = {
    'dynamics': ('step', 'solvers', 'precision', 'rods', 'batches'),
    'honesty': ('honesty',),
    'identification': ('identification',),
    'calibration': ('calibration', 'noises'),
    'damage': ('damage',),
    'control': ('control',),
    'steering-model': ('steering_model',),
    'steering-fit': ('steering_fit',),
    'steering': ('steering', 'worlds.compare'),
    'laws': ('laws',),
    'safety': ('safety', 'steering_bars'),
    'commissioning': ('commissioning',),
    'graph': ('graph',),
    'slicer': ('slicer',),
    'study': ('study',),
    'environments': ('environments', 'policies'),
    'pool': ('pool',),
    'learning': ('learning',),
    'plan': ('plans',),
}

#: Arguments of each benchmark with a page, which ``python -m benchmarks.run FOLDER`` makes.
PAGES: Final = {name: '' for name in MODULES if name not in ('damage', 'pool', 'steering-fit')} | {
    'calibration': '--recordings 300'
}

#: Extras of a benchmark that needs more than ``bench`` and ``ros``.
_EXTRAS: Final = {'learning': 'learning'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``needle bench`` to a parser."""
    parser.description = 'Measure side by side. The last line begins with met or missed.'
    names = parser.add_subparsers(required=True, dest='name', metavar='NAME')
    output = argparse.ArgumentParser(add_help=False)
    output.add_argument('-o', '--output', type=Path, metavar='FILE', help='write the page, too')
    add = partial(names.add_parser, parents=[output])
    add('dynamics', help='the integrator compared with SciPy, JAX, MuJoCo and PyElastica')
    honesty = add('honesty', help='the error stated by simulate, compared with the true error')
    honesty.add_argument('--needles', type=int, metavar='N', help='needles of each friction law')
    add('identification', help='time from a bag to a result, compared with other readers')
    calibration = add('calibration', help='coverage and efficiency of the estimates')
    calibration.add_argument(
        '--recordings', type=int, metavar='N', help='simulated recordings of each kind'
    )
    calibration.add_argument(
        '--seed', type=int, metavar='N', help='seed of the true values and the noise'
    )
    damage = add('damage', help='identification from damaged recordings')
    damage.add_argument('--files', type=int, metavar='N', help='damaged recordings')
    add('control', help='cost of a control step')
    add('steering-model', help='cost of the steered needle, compared with NumPy and SciPy')
    fit = add('steering-fit', help='identification of the bending of a needle from insertions')
    fit.add_argument('--recordings', type=int, metavar='N', help='fits of each kind')
    steering = add('steering', help='controllers that steer the tip to a target')
    steering.add_argument('--needles', type=int, metavar='N', help='needles of each case')
    laws = add('laws', help='control laws on unknown needles, robots and tissues')
    laws.add_argument('--needles', type=int, metavar='N', help='needles in a cell')
    safety = add('safety', help='effect of faults, other nodes and kills on a motion')
    safety.add_argument('--fault', metavar='NAME', help='only this fault, in simulated time')
    check = add('commissioning', help='errors in hardware.*, refused by the first motion')
    check.add_argument('--errors', type=int, metavar='N', help='random errors')
    graph = add('graph', help='cost of the nodes compared with bare rclpy nodes')
    graph_plan = graph.add_mutually_exclusive_group()
    graph_plan.add_argument(
        '--full',
        dest='plan',
        action='store_const',
        const='full',
        help='record for 60 s and watch the memory for 10 min',
    )
    slicer = add('slicer', help='the node `slicer` for 10 min, and killed')
    study = add(
        'study', help='populations of insertions: rates, memory, and workers that are killed'
    )
    pool = add('pool', help='a study whose workers are killed at random times')
    pool.add_argument('--kills', type=int, metavar='N', help='workers that are killed')
    plans = add('plan', help='planners in synthetic anatomies, and their plans in the plant')
    plans.add_argument('--anatomies', type=int, metavar='N', help='number of anatomies')
    environments = add(
        'environments', help='speed of the Gymnasium environments, and policies without a model'
    )
    learning = add('learning', help='laws compared with policies learned by PPO')
    for trial in (graph_plan, slicer, study, environments, learning):
        trial.add_argument(
            '--quick',
            dest='plan',
            action='store_const',
            const='quick',
            help='a trial, too short for reliable figures',
        )


def run(options: argparse.Namespace) -> int:
    """Run a benchmark and print its page; return 0 if no bar is missed, else 1."""
    given = {key: value for key, value in vars(options).items() if value is not None}
    name, output = given.pop('name'), given.pop('output', None)
    words = [f'--{value}' if key == 'plan' else f'--{key} {value}' for key, value in given.items()]
    try:
        modules = [import_module(f'benchmarks.{module}') for module in MODULES[name]]
    except ModuleNotFoundError as error:
        raise ParameterError(
            f'needle bench {name} needs {error.name}: pip install -e '
            f"'.[{_EXTRAS.get(name, 'bench,ros')}]'"
        ) from error
    questions = [partial(module.compare, **given) for module in modules]
    page, missed = ask(name, ' '.join(('needle bench', name, *words)), questions)
    if output is not None:
        output.write_text(page, encoding='utf-8')
    return int(missed)


def ask(name: str, command: str, questions: Sequence[Question]) -> tuple[str, bool]:
    """Run measurements, and print the page as it grows; return it and whether a bar is missed."""
    begin = time.perf_counter()
    page = ''
    bars: list[Bar] = []

    def tell(text: object) -> None:
        nonlocal page
        page += f'{text}\n'
        sys.stdout.write(f'{text}\n')
        sys.stdout.flush()

    tell(header(name, command))
    for question in questions:
        with ProgressLine(name, brief=True) as show:
            sections, found = question(show)
        bars += found
        for section in sections:
            tell(f'\n{section}')
    tell(f'\n{conclusion(bars, time.perf_counter() - begin)}')
    return page, any(bar.missed for bar in bars)


def make_pages(folder: Path) -> int:
    """Make all pages; return 1 if a benchmark fails or misses a bar, which stops no other one."""
    failed = 0
    for name, words in PAGES.items():
        command = ['needle_insertion.cli', 'bench', name, *words.split()]
        page = str(folder / f'{name}.md')
        done = subprocess.run([sys.executable, '-m', *command, '-o', page], check=False)
        failed |= done.returncode
    return int(bool(failed))


if __name__ == '__main__':
    sys.exit(make_pages(Path(sys.argv[1])))
