"""Benchmarks: ratios measured side by side in one run, never a pass or fail on time."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import sys
import time
from typing import TypeAlias

from benchmarks import batches, control, identification, rods, solvers, step
from benchmarks.measure import Bar, environment
from needle_insertion.report.text import table
from tqdm import tqdm

#: Returns its text and what it says of the bars; it is given what to tell its stages to.
Question: TypeAlias = Callable[[Callable[[str], None]], tuple[str, list[Bar]]]

#: Questions by subject. That of the graph is asked by `bench_graph`: it needs ROS.
QUESTIONS: dict[str, tuple[Question, ...]] = {
    'dynamics': (
        step.compare,
        solvers.compare,
        rods.compare,
        batches.compare,
    ),
    'identification': (identification.compare,),
    'control': (control.compare,),
}


def run(options: argparse.Namespace) -> int:
    """
    Measure what is ours beside what else could be used, and print one table per question.

    Parameters
    ----------
    options : argparse.Namespace
        ``subject``, one of `QUESTIONS`.

    Returns
    -------
    int
        0, whatever was measured.

    """
    return ask(QUESTIONS[options.subject])


def ask(questions: Sequence[Question]) -> int:
    """Ask questions as `run` does."""
    begin = time.perf_counter()
    sys.stdout.write(f'{environment()}\n')
    bars: list[Bar] = []
    with tqdm(disable=None, leave=False, unit=' stages') as progress:

        def tick(what: str) -> None:
            progress.set_description(what, refresh=False)
            progress.update()

        for question in questions:
            text, found = question(tick)
            bars += found
            progress.clear()
            sys.stdout.write(f'\n{text}\n')
            sys.stdout.flush()
    heads = ('figure', 'wanted', 'found', 'verdict')
    sys.stdout.write(
        f'\n{table([bar.row() for bar in bars], heads)}\n'
        f'\n{time.perf_counter() - begin:.0f} s in all\n'
    )
    return 0
