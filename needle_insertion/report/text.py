"""Tables and checks as text for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final


def table(rows: Sequence[Sequence[str]], heads: Sequence[str]) -> str:
    """
    Return rows as aligned text.

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
    lines = [list(heads), *(list(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(heads))]
    lines.insert(1, ['-' * width for width in widths])
    return '\n'.join(
        '  '.join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


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
