"""What a person sees of a run: a table of checks, pictures, one self-contained page."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
import os
from pathlib import Path

from matplotlib.figure import Figure
from needle_dynamics import ParameterError


@dataclass(frozen=True, slots=True)
class Check:
    """
    One line of a result: what was true or wanted, what was found, and whether that is well.

    Attributes
    ----------
    what : str
        What was looked at.
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
    def verdict(self) -> str:
        """Return the verdict as a word."""
        return 'pass' if self.passed else 'FAIL'


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure with what it shows."""

    name: str
    caption: str
    figure: Figure


def write_whole(path: Path, content: bytes) -> None:
    """
    Write a file that appears whole or not at all.

    Parameters
    ----------
    path : Path
        File to write.
    content : bytes
        All of it.

    Raises
    ------
    ParameterError
        If it cannot be written.

    """
    draft = path.with_name(f'{path.name}.{os.getpid()}.tmp')
    try:
        draft.write_bytes(content)
        draft.replace(path)
    except OSError as error:
        raise ParameterError(f'{path} cannot be written: {error.strerror}') from error


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG."""
    buffer = BytesIO()
    figure.savefig(buffer, format='png', dpi=120)
    return buffer.getvalue()


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


def check_table(checks: Sequence[Check]) -> str:
    """Return checks as aligned text."""
    rows = [(check.what, check.wanted, check.found, check.verdict) for check in checks]
    return table(rows, ('what', 'true or wanted', 'found', 'verdict'))


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .3rem .8rem .3rem 0; border-bottom: 1px solid #ddd; }
td.pass { color: #17692f; } td.FAIL { color: #b00020; font-weight: bold; }
figure { margin: 1.5rem 0; } figcaption { color: #555; } img { max-width: 100%; }
"""


def write_page(
    path: Path,
    title: str,
    introduction: str,
    checks: Sequence[Check],
    pictures: Sequence[Picture],
) -> None:
    """
    Write one self-contained page, and each picture as a PNG beside it.

    Parameters
    ----------
    path : Path
        Page to write; it appears whole or not at all.
    title, introduction : str
        Plain text.
    checks : sequence of Check
        Table of results.
    pictures : sequence of Picture
        Figures, in order.

    """
    rows = ''.join(
        f'<tr><td>{escape(c.what)}</td><td>{escape(c.wanted)}</td><td>{escape(c.found)}</td>'
        f'<td class="{c.verdict}">{c.verdict}</td></tr>\n'
        for c in checks
    )
    figures = []
    for picture in pictures:
        image = png(picture.figure)
        write_whole(path.parent / f'{picture.name}.png', image)
        data = base64.b64encode(image).decode('ascii')
        caption = escape(picture.caption)
        figures.append(
            f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
            f'<figcaption>{caption}</figcaption></figure>\n'
        )
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<title>{escape(title)}</title><style>{_STYLE}</style></head><body>\n'
        f'<h1>{escape(title)}</h1>\n<p>{escape(introduction)}</p>\n'
        '<table><tr><th>what</th><th>true or wanted</th><th>found</th><th>verdict</th></tr>\n'
        f'{rows}</table>\n{"".join(figures)}</body></html>\n'
    )
    write_whole(path, page.encode())
