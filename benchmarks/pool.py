# SPDX-License-Identifier: Apache-2.0
"""Studies with workers killed at random times, also during their start, on a busy machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
import hashlib
from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, Final

from benchmarks.kills import kill_workers, Losses
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_ros.errors import ParameterError
from needle_ros.process_pool import processes
from needle_study.engine import chunk, order, TABLE
from needle_study.study import build_study
import numpy as np
import yaml

#: Insertions of a study, and kills of its workers.
_SAMPLES, _KILLS = 3000, 100

#: Number of processes for background load.
_BUSY: Final = 2

#: Short insertions, with a trivial controller.
_STUDY: Final[dict[str, Any]] = {
    'scenario': 'steering',
    'seed': 3,
    'settings': {'depth': 0.05, 'step_length': 0.01, 'law': 'springs'},
    'population': {'bending_length': {'uniform': [0.8, 1.2]}},
}


def compare(tick: Tick, kills: int = 500, samples: int = _SAMPLES) -> Answer:
    """Kill workers of studies, and compare the tables with the table of an undisturbed study."""
    if kills < 1:
        raise ParameterError(f'--kills must be >= 1, got {kills}')
    rng, sums, found = np.random.default_rng(1), set[str](), list[Losses]()
    begin = time.monotonic()
    with TemporaryDirectory() as name, _busy():
        study = partial(_study, Path(name), rng)
        tick('the start of a worker')
        between = [_start() for _ in range(2)][1]
        tick('no kills')
        sums.add(study('whole', samples, 0, 0.0)[0])
        while (left := kills - sum(one.killed for one in found)) > 0:
            tick(f'{kills - left} of {kills} kills')
            checksum, losses = study(str(len(found)), samples, min(left, _KILLS), between)
            sums.add(checksum)
            found.append(losses)
    taken = time.monotonic() - begin
    killed, young, errors, hangs = (sum(column) for column in zip(*found, strict=True))
    section = PageSection(
        'Workers that are killed',
        ('studies', 'workers killed', 'younger than 0.2 s', 'errors', 'hangs', 'time [s]'),
        [tuple(map(str, (len(found), killed, young, errors, hangs, round(taken))))],
        f'Each study has {samples} insertions, two workers, and up to {_KILLS} kills; {_BUSY} '
        f'other processes compute all the time. A hang is {120 + 10 * between:.0f} s '
        'without a result. After an error '
        '(a chunk that has lost its worker ten times in a row) the study is continued. '
        f'Kills are up to {between:.1f} s apart, the time from the start of a worker to its first '
        'result; most workers that replace a killed one are killed within 0.2 s.',
    )
    return [section], [
        Bar('workers killed', float(killed), float(kills), at_least=True),
        Bar('hangs', float(hangs), 0.0),
        Bar('tables that differ', float(len(sums) - 1), 0.0),
    ]


def _study(
    parent: Path, rng: np.random.Generator, name: str, samples: int, kills: int, between: float
) -> tuple[str, Losses]:
    """Compute a study; return the checksum of its table, and the outcome of its workers."""
    file, folder = parent / f'{name}.yaml', parent / name
    file.write_text(yaml.safe_dump({**_STUDY, 'samples': samples}), encoding='utf-8')
    command = [sys.executable, '-m', 'needle_insertion.cli', 'study', str(file)]
    words = [*command, '--workers', '2', '-o', str(folder)]
    losses = kill_workers(words, folder, kills, between, rng)
    return hashlib.sha256((folder / TABLE).read_bytes()).hexdigest(), losses


def _start() -> float:
    """Return the time from the start of a worker to its first result [s]."""
    begin = time.monotonic()
    with processes(1) as pool:
        pool.submit(chunk, order(build_study({**_STUDY, 'samples': 1})), 0, 1).result()
    return time.monotonic() - begin


@contextmanager
def _busy() -> Iterator[None]:
    """Load the processor."""
    command = [sys.executable, '-c', 'while True: pass']
    others = [subprocess.Popen(command) for _ in range(_BUSY)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
        for other in others:
            other.wait()
