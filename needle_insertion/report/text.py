"""Tables as text for the terminal."""

from __future__ import annotations

from collections.abc import Sequence


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
