# SPDX-License-Identifier: Apache-2.0
"""Format tables and paragraphs as text for the terminal."""

from collections.abc import Sequence
from itertools import zip_longest
import re
from textwrap import fill, wrap
from typing import Final

_WIDTH: Final = 100  #: largest width of a table, unless words are longer

#: Spaces without line break: between number, unit and error, and within an interval.
_TOGETHER: Final = re.compile(r' (±|to) (?=[-\d])|(?<=\d) (?=[A-Za-z%])')

_SPACE: Final = re.compile(' ')
_NEVER: Final = re.compile('(?!)')


def table(rows: Sequence[Sequence[str]], heads: Sequence[str]) -> str:
    """Return rows as aligned text; cells of tables wider than 100 columns are wrapped."""
    # Avoid breaks in numbers and in the first column if the width permits.
    for first, inside in ((_SPACE, _TOGETHER), (_SPACE, _NEVER), (_NEVER, _NEVER)):
        cells = [
            [first.sub(_joined, name), *(inside.sub(_joined, cell) for cell in others)]
            for name, *others in (heads, *rows)
        ]
        widths = _widths(cells)
        if _total(widths) <= _WIDTH:
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
    return fill(text, _WIDTH, break_long_words=False, break_on_hyphens=False)


def _joined(found: re.Match[str]) -> str:
    return found[0].replace(' ', '\xa0')


def _widths(cells: Sequence[Sequence[str]]) -> list[int]:
    """Return column widths; the widest columns are narrowed down to their longest words."""
    columns = list(zip(*cells, strict=True))
    widths = [max(map(len, column)) for column in columns]
    least = [max(map(len, ' '.join(column).split(' '))) for column in columns]
    while _total(widths) > _WIDTH:
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
