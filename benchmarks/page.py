# SPDX-License-Identifier: Apache-2.0
"""Format the result of a benchmark as one Markdown page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import metadata
import os
from pathlib import Path
import platform
import sys
from typing import Final, TypeAlias

from benchmarks.measure import Bar

#: Distributions with versions on all pages, and on the page of one benchmark.
_COMMON: Final = ('needle_insertion', 'numpy', 'scipy', 'numba')
_TOOLS: Final = {
    'dynamics': ('mujoco', 'pyelastica', 'jax', 'diffrax'),
    'identification': ('mcap', 'rosbags', 'mcap-ros2-support'),
    'graph': ('rclpy',),
    'slicer': ('rclpy', 'pyigtl'),
    'study': ('pyarrow', 'distributed'),
    'environments': ('gymnasium',),
    'learning': ('gymnasium', 'stable-baselines3', 'torch'),
    'plan': ('ompl',),
}


@dataclass(frozen=True, slots=True)
class PageSection:
    """
    Part of a page: a table with its heading.

    Attributes
    ----------
    title : str
        Heading.
    heads : sequence of str
        Column heads.
    rows : sequence of sequence of str
        Cells.
    notes : str
        Text below the table.

    """

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: str = ''

    def __str__(self) -> str:
        parts = [f'## {self.title}', table(self.heads, self.rows), self.notes]
        return '\n\n'.join(part for part in parts if part)


#: Progress callback, called with the name of each stage before its start.
Tick: TypeAlias = Callable[[str], None]

#: Result of a benchmark: sections of the page, and bars.
Answer: TypeAlias = tuple[list[PageSection], list[Bar]]


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with aligned columns; ``|`` is not allowed in cells."""
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = [heads, ['-' * width for width in widths], *rows]
    return '\n'.join(
        f'| {" | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))} |'
        for line in lines
    )


def version(name: str) -> str:
    """Return a distribution and its version, such as ``numpy 2.0.0``."""
    try:
        return f'{name} {metadata.version(name)}'
    except metadata.PackageNotFoundError:
        return f'{name} not installed'


def header(name: str, command: str) -> str:
    """Return the head of a page: the command, the date, the machine and the versions."""
    processor = platform.processor() or platform.machine()
    information = Path('/proc/cpuinfo')
    if information.exists():
        lines = information.read_text('utf-8').splitlines()
        about = {key.strip(): value.strip() for key, _, value in (x.partition(':') for x in lines)}
        processor = about.get('model name', processor)
        # Lanes are as wide as the widest vector registers.
        wide = {'avx512f': 'AVX-512', 'avx2': 'AVX2'}
        flags = about.get('flags', '').split()
        processor += ''.join([f', {wide[name]}' for name in wide if name in flags][:1])
    system = f'{platform.system()} {platform.machine()}'
    tools = map(version, (*_COMMON, *_TOOLS.get(name, ())))
    return '\n'.join(
        [
            f'# Benchmark: {name}',
            '',
            'This page is generated. Do not edit it, but run the command again.',
            '',
            f'- command: `{command}`',
            f'- date: {datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC',
            f'- machine: {processor}, {os.cpu_count()} cores, {system}',
            f'- versions: Python {platform.python_version()}, {", ".join(tools)}',
        ]
    )


def conclusion(bars: Iterable[Bar], seconds: float) -> str:
    """
    Return the end of a page: the table of the bars and the verdict.

    The first word of the last line is ``missed`` if a bar is missed, else ``met``.
    """
    bars = list(bars)
    missed = sum(bar.missed for bar in bars)
    absent = sum(bar.found is None for bar in bars)
    verdict = (
        f'missed: {missed} of {len(bars)} bars' if missed else f'met: {len(bars) - absent} bars'
    )
    if absent:
        verdict += f', {absent} not measured'
    section = PageSection(
        'Bars',
        ('metric', 'required', 'found', 'verdict'),
        [bar.row() for bar in bars],
        f'The benchmark took {seconds:.0f} s.',
    )
    return f'{section}\n\n{verdict}'


def report(sections: Iterable[PageSection], bars: Sequence[Bar], seconds: float) -> int:
    """Print sections and the end of a page; return the exit status."""
    for part in (*sections, conclusion(bars, seconds)):
        sys.stdout.write(f'\n{part}\n')
    return int(any(bar.missed for bar in bars))
