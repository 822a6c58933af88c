# SPDX-License-Identifier: Apache-2.0
"""Tables and paragraphs as text, tables as files, and pictures of pages."""

from __future__ import annotations

import base64
from collections.abc import Sequence
import csv
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO, StringIO
from itertools import zip_longest
from pathlib import Path
import re
from shutil import get_terminal_size
from textwrap import fill, wrap
from typing import Final, TYPE_CHECKING

from needle_dynamics.arrays import FloatArray

if TYPE_CHECKING:
    # Takes half a second to import; only pictures need it.
    from matplotlib.figure import Figure

_WIDTH: Final = 100  #: largest width of a table, unless words are longer

#: Spaces without line break: between number, unit and error, and within an interval.
_TOGETHER: Final = re.compile(r' (±|to) (?=[-\d])|(?<=\d) (?=[A-Za-z%])')

_SPACE: Final = re.compile(' ')
_NEVER: Final = re.compile('(?!)')


def table(rows: Sequence[Sequence[str]], heads: Sequence[str]) -> str:
    """Return rows as aligned text; cells are wrapped beyond 100 columns or the terminal."""
    limit = _limit()
    # Avoid breaks in numbers and in the first column if the width permits.
    for first, inside in ((_SPACE, _TOGETHER), (_SPACE, _NEVER), (_NEVER, _NEVER)):
        cells = [
            [first.sub(_joined, name), *(inside.sub(_joined, cell) for cell in others)]
            for name, *others in (heads, *rows)
        ]
        widths = _widths(cells, limit)
        if _total(widths) <= limit:
            break
    lines: list[tuple[str, ...]] = []
    for row in cells:
        parts = [_folded(cell, width) for cell, width in zip(row, widths, strict=True)]
        lines += zip_longest(*parts, fillvalue='')
        if row is cells[0]:
            lines.append(tuple('-' * width for width in widths))
    return '\n'.join(
        '  '.join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        .replace('\xa0', ' ')
        .rstrip()
        for line in lines
    )


def filled(text: str) -> str:
    return fill(text, _limit(), break_long_words=False, break_on_hyphens=False)


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return names of recordings without their folders, unless they are ambiguous."""
    short = [Path(name).name or name for name in names]
    return dict(zip(names, short if len(set(short)) == len(names) else names, strict=True))


def _joined(found: re.Match[str]) -> str:
    return found[0].replace(' ', '\xa0')


def _limit() -> int:
    return min(_WIDTH, get_terminal_size((_WIDTH, 1)).columns)


def _widths(cells: Sequence[Sequence[str]], limit: int) -> list[int]:
    """Return column widths; the widest columns are narrowed down to their longest words."""
    columns = list(zip(*cells, strict=True))
    widths = [max(map(len, column)) for column in columns]
    least = [max(map(len, ' '.join(column).split(' '))) for column in columns]
    while _total(widths) > limit:
        narrow = [i for i, width in enumerate(widths) if width > least[i]]
        if not narrow:
            break
        widths[max(narrow, key=lambda i: widths[i])] -= 1
    return widths


def _folded(cell: str, width: int) -> list[str]:
    if len(cell) <= width:
        return [cell]
    return wrap(cell, width, break_long_words=False, break_on_hyphens=False)


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + 2 * (len(widths) - 1)


def png(figure: Figure) -> bytes:
    """Return a figure as PNG; equal figures give equal bytes."""
    buffer = BytesIO()
    figure.savefig(buffer, format='png', dpi=120)
    return buffer.getvalue()


def csv_table(heads: Sequence[str], rows: FloatArray) -> bytes:
    """Return rows of numbers, shape (n, columns), as a CSV file."""
    text = StringIO(newline='')
    writer = csv.writer(text)
    writer.writerow(heads)
    writer.writerows(rows.tolist())
    return text.getvalue().encode()


@dataclass(frozen=True, eq=False)
class Picture:
    """Figure with caption."""

    #: File name of the PNG next to the page, without extension.
    name: str
    caption: str
    figure: Figure
    description: str = ''  #: alternative text for screen readers; default: the caption

    @cached_property
    def image(self) -> bytes:
        return png(self.figure)

    @property
    def source(self) -> str:
        """PNG as a data URL."""
        return f'data:image/png;base64,{base64.b64encode(self.image).decode("ascii")}'

    @property
    def width(self) -> int:
        return int.from_bytes(self.image[16:20], 'big')

    @property
    def height(self) -> int:
        return int.from_bytes(self.image[20:24], 'big')
