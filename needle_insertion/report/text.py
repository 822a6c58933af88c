"""Tables and checks as text for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
import re
from textwrap import fill, wrap
from typing import Final

#: Widest line of a table, unless its words are too long.
_WIDTH: Final = 100

#: A number stays in one line with its unit and error, and an interval with its ends.
_TOGETHER: Final = re.compile(r' (±|to) (?=[-\d])|(?<=\d) (?=[A-Za-z%])')

_SPACE: Final = re.compile(' ')
_NEVER: Final = re.compile('(?!)')


def table(rows: Sequence[Sequence[str]], heads: Sequence[str]) -> str:
    """
    Return rows as aligned text; cells of a table wider than 100 columns go over several lines.

    Parameters
    ----------
    rows : sequence of sequence of str
        Cells.
    heads : sequence of str
        Column heads.

    Returns
    -------
    str
        Lines without a final newline.

    """
    # Without breaks in numbers and in the first column, which names the row, if there is room.
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
    """
    Return a paragraph in lines that are no wider than a table.

    Parameters
    ----------
    text : str
        Words.

    Returns
    -------
    str
        Lines without a final newline.

    """
    return fill(text, _WIDTH, break_long_words=False, break_on_hyphens=False)


def _joined(found: re.Match[str]) -> str:
    return found[0].replace(' ', '\xa0')


def _widths(cells: Sequence[Sequence[str]]) -> list[int]:
    """Return the widths of the columns, the widest narrowed as far as their words allow."""
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


#: Heads of the rows of `Check.row`.
CHECK_HEADS: Final = ('what', 'true or wanted', 'found', 'verdict')


@dataclass(frozen=True, slots=True)
class Check:
    """
    One line of a result: what was wanted, what was found, and whether that is good enough.

    Attributes
    ----------
    what : str
        Quantity that was checked.
    wanted, found : str
        With units.
    passed : bool
        The verdict.

    """

    what: str
    wanted: str
    found: str
    passed: bool

    @property
    def row(self) -> tuple[str, str, str, str]:
        """Cells of a table, the verdict as a word."""
        return self.what, self.wanted, self.found, 'pass' if self.passed else 'FAIL'
