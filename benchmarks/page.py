"""The result of a benchmark as one Markdown page, for the terminal and for a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import metadata
import os
from pathlib import Path
import platform
from typing import Final, TypeAlias

from benchmarks.measure import Bar

#: Distributions whose versions every page names, and those of the tools of one benchmark.
_COMMON: Final = ('needle_insertion', 'numpy', 'scipy', 'numba')
_TOOLS: Final = {
    'dynamics': ('mujoco', 'pyelastica'),
    'identification': ('mcap', 'rosbags', 'mcap-ros2-support'),
    'graph': ('rclpy',),
    'slicer': ('rclpy', 'pyigtl'),
    'study': ('pyarrow', 'distributed', 'gymnasium'),
}


@dataclass(frozen=True, slots=True)
class Section:
    """
    A part of a page: one table with its heading.

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
        """Return the section as Markdown."""
        parts = [f'## {self.title}', table(self.heads, self.rows), self.notes]
        return '\n\n'.join(part for part in parts if part)


#: Called with the name of each stage before it begins.
Tick: TypeAlias = Callable[[str], None]

#: What a benchmark returns: parts of the page, and its bars.
Answer: TypeAlias = tuple[list[Section], list[Bar]]


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    Return a Markdown table, with aligned columns.

    Parameters
    ----------
    heads : sequence of str
        Column heads.
    rows : sequence of sequence of str
        Cells; ``|`` is not allowed in them.

    Returns
    -------
    str
        Lines without a final newline.

    """
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = [heads, ['-' * width for width in widths], *rows]
    return '\n'.join(
        f'| {" | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))} |'
        for line in lines
    )


def version(name: str) -> str:
    """
    Return the name and the version of a distribution.

    Parameters
    ----------
    name : str
        Distribution.

    Returns
    -------
    str
        For example ``numpy 2.0.0`` or ``mujoco not installed``.

    """
    try:
        return f'{name} {metadata.version(name)}'
    except metadata.PackageNotFoundError:
        return f'{name} not installed'


def header(name: str, command: str) -> str:
    """
    Return the head of a page: the command, the date, the machine and the versions.

    Parameters
    ----------
    name : str
        Name of the benchmark.
    command : str
        Command line that makes the page.

    Returns
    -------
    str
        Markdown.

    """
    processor = platform.processor() or platform.machine()
    information = Path('/proc/cpuinfo')
    if information.exists():
        for line in information.read_text('utf-8').splitlines():
            if line.startswith('model name'):
                processor = line.partition(':')[2].strip()
                break
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

    Parameters
    ----------
    bars : iterable of Bar
        All bars of the benchmark.
    seconds : float
        Duration of the benchmark [s].

    Returns
    -------
    str
        Markdown. The first word of the last line is ``missed`` if a bar is missed, else ``met``.

    """
    bars = list(bars)
    missed = sum(bar.missed for bar in bars)
    absent = sum(bar.found is None for bar in bars)
    verdict = (
        f'missed: {missed} of {len(bars)} bars' if missed else f'met: {len(bars) - absent} bars'
    )
    if absent:
        verdict += f', {absent} not measured'
    section = Section(
        'Bars',
        ('figure', 'wanted', 'found', 'verdict'),
        [bar.row() for bar in bars],
        f'The benchmark took {seconds:.0f} s.',
    )
    return f'{section}\n\n{verdict}'
