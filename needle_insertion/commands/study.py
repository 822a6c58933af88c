# SPDX-License-Identifier: Apache-2.0
"""`needle study`: simulate a population of insertions on all cores or on a cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
import sys
from typing import Any, Final, TYPE_CHECKING

from needle_insertion.commands.common import check_folder, print_result
from needle_insertion.progress import ProgressLine
from needle_insertion.report.content import table
from needle_ros.errors import JobError, missing_extra, ParameterError
from needle_ros.process import cores
from needle_ros.process_pool import processes

if TYPE_CHECKING:
    # Needs optional packages.
    from needle_study.engine import Results

_PATIENCE: Final = 10  #: timeout for the answer of a scheduler, and for its first worker [s]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('study', type=Path, metavar='STUDY.yaml', help='definition of the study')
    parser.add_argument(
        '-o', '--output', type=Path, metavar='DIR',
        help='folder of the results (default: named as the study); existing results are kept',
    )  # fmt: skip
    parser.add_argument(
        '--workers', type=int, help='processes of this machine (default: one per core)'
    )
    parser.add_argument(
        '--scheduler', metavar='ADDRESS', help='Dask scheduler, such as tcp://host:8786'
    )
    parser.add_argument(
        '--replay',
        type=int,
        metavar='NUMBER',
        help='compute one sample again and record it to a bag',
    )


def run(options: argparse.Namespace) -> int:
    try:
        with ProgressLine('study', brief=True):
            from needle_insertion.report.study_page import write_study
            from needle_study import engine
            from needle_study.study import read_study
    except ModuleNotFoundError as error:
        raise missing_extra(error, 'needle study', 'study') from error
    study = read_study(options.study)
    folder = options.output or Path(f'{options.study.stem}_study')
    check_folder(folder)
    workers = options.workers if options.workers is not None else cores()
    if workers < 1:
        raise ParameterError(f'--workers must be >= 1, got {workers}')
    if options.replay is not None and not 0 <= options.replay < study.samples:
        raise ParameterError(
            f'--replay must be from 0 to {study.samples - 1}, the samples of the study, got '
            f'{options.replay}'
        )
    results = engine.Results(folder, study)
    if options.replay is not None:
        bag = folder / f'sample_{options.replay}'
        compared = _replay(results, options.replay, bag)
        same = 'the same numbers as in the table' if compared else 'there is no table yet'
        sys.stdout.write(f'sample {options.replay}: {bag}; {same}\n')
        return 0
    if not results.table.exists():
        done = study.samples - sum(end - first for first, end in results.missing())
        with (
            ProgressLine('study', brief=True) as show,
            _executor(options.scheduler, workers) as (executor, count),
        ):

            def count_samples(more: int) -> None:
                nonlocal done
                done += more
                show(f'{done} of {study.samples} samples', done / study.samples)

            show('starting the processes, and loading or compiling')
            engine.compute(results, executor, count, count_samples)
    file = folder / 'study.html'
    with ProgressLine('page', brief=True):
        found = write_study(results, file)
    print_result(
        found, table(found, ('result', 'value', 'interval')), (results.table, file), as_json=False
    )
    return 0


def _replay(results: Results, number: int, bag: Path) -> bool:
    """Record a sample to a bag; return whether it was compared with a table of the study."""
    from needle_insertion.report.trajectory import write_bag
    from needle_study.summary import picked
    import numpy as np

    study = results.study
    row = study.rows(number, 1)
    if compared := results.table.exists():
        for name, values in row.items():
            (recorded,) = picked(results.table, name, [number])
            if not np.array_equal(values, [recorded], equal_nan=True):
                raise JobError(
                    f'sample {number} differs from {results.table}: {name} was {recorded!r}, '
                    f'and is {values[0]!r}'
                )
    drawn = {name: float(row[name][0]) for name in study.population}
    write_bag(bag, study.scenario.replay(drawn, study.design.noise(number)))
    return compared


@contextmanager
def _executor(
    scheduler: str | None, workers: int
) -> Iterator[tuple[Callable[[], AbstractContextManager[Executor]], int]]:
    from needle_study import engine

    if scheduler is None:
        yield partial(processes, workers), workers
        return
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise missing_extra(error, '--scheduler', 'dask') from error
    try:
        client: Any = Client(scheduler, timeout=_PATIENCE)
    except (OSError, ValueError, TimeoutError) as error:
        raise JobError(f'no Dask scheduler at {scheduler}: {error}') from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise JobError(f'the scheduler at {scheduler} has no workers') from error
        count = sum(client.nthreads().values())
        yield partial(engine.dask, client), count
