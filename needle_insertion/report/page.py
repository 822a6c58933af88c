"""
What a person sees of a run: tables as text, and self-contained pages.

A page is made of blocks: pieces of HTML from the functions below, which escape what they are
given, and pictures. It needs nothing beside it and loads nothing, and its own policy says so to
the browser; the same content gives the same bytes.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
import re

from matplotlib.figure import Figure
from needle_identification.result import write_whole

__all__ = [
    'Check',
    'Picture',
    'bullets',
    'check_table',
    'code',
    'grid',
    'heading',
    'headline',
    'notice',
    'paragraph',
    'png',
    'table',
    'write_document',
    'write_page',
    'write_whole',
]

_GREEK = {'mu': 'μ', 'phi': 'φ', 'tau': 'τ', 'theta': 'θ', 'rho': 'ρ', 'omega': 'ω'}
_SYMBOL = re.compile(
    rf'\b({"|".join(_GREEK)}|q(?=\d)|[kfIqcde](?=_))(\d?)(?:_(d?dot))?(?:_(\w{{1,3}}))?\b'
)
#: Combining dots, which stand behind their letter.
_DOTS = {None: '', 'dot': '\u0307', 'ddot': '\u0308'}
_POWER = re.compile(r'\^(?:([2-4])(?![\d/])|(-?\d+(?:/\d+)?|T\b))')
_MICROMETERS = re.compile(r'(?<=\d )um\b')
_ROW_HEAD = 'th scope="row"'
#: What begins as a number and is longer is a text, such as a checksum.
_LONGEST_NUMBER = 40
#: Cells that are a verdict, and how they look.
_VERDICTS = {
    'pass': 'pass',
    'holds': 'pass',
    'FAIL': 'FAIL',
    'does not hold': 'FAIL',
    'DOES NOT HOLD': 'FAIL',
}
_NUMBER = re.compile(r'[-+]?\d')


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
    """
    A figure with what it shows.

    Attributes
    ----------
    name : str
        Name of the PNG beside the page, without its ending.
    caption : str
        What stands below it.
    figure : Figure
        The figure.
    description : str
        What it shows, for who cannot see it; the caption if empty.

    """

    name: str
    caption: str
    figure: Figure
    description: str = ''


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
    return table(_check_rows(checks), _CHECK_HEADS)


_CHECK_HEADS = ('what', 'true or wanted', 'found', 'verdict')


def _check_rows(checks: Sequence[Check]) -> list[tuple[str, str, str, str]]:
    return [(check.what, check.wanted, check.found, check.verdict) for check in checks]


# Blocks of a page.


def _text(words: str) -> str:
    """Escape, and write mu_s, q1_dot and their like, powers and um as in print."""

    def symbol(found: re.Match[str]) -> str:
        letter, number, dots, index = found.groups()
        below = f'{number}{"," if number and index else ""}{index or ""}'
        return (
            f'<i>{_GREEK.get(letter, letter)}{_DOTS[dots]}</i>'
            f'{f"<sub>{below}</sub>" if below else ""}'
        )

    def power(found: re.Match[str]) -> str:
        return '⁰¹²³⁴'[int(found[1])] if found[1] else f'<sup>{found[2]}</sup>'

    return _MICROMETERS.sub('μm', _POWER.sub(power, _SYMBOL.sub(symbol, escape(words))))


def heading(words: str) -> str:
    """Return the heading of a section."""
    return f'<h2>{_text(words)}</h2>\n'


def paragraph(words: str) -> str:
    """Return a paragraph."""
    return f'<p>{_text(words)}</p>\n'


def bullets(items: Iterable[str]) -> str:
    """Return a list of points."""
    return f'<ul>{"".join(f"<li>{_text(item)}</li>" for item in items)}</ul>\n'


def notice(title: str, items: Sequence[str], all_items: Sequence[str] = ()) -> str:
    """
    Return points that must not be overlooked, in a frame; nothing if there are none.

    Parameters
    ----------
    title : str
        What stands above them.
    items : sequence of str
        The points.
    all_items : sequence of str
        More of them, to unfold.

    Returns
    -------
    str
        HTML.

    """
    if not items:
        return ''
    folded = ''
    if all_items:
        summary = f'<summary>show all {len(all_items)}</summary>'
        folded = f'<details>{summary}\n{bullets(all_items)}</details>\n'
    return f'<aside class="notice"><h2>{_text(title)}</h2>\n{bullets(items)}{folded}</aside>\n'


def code(words: str) -> str:
    """Return lines to type or to copy, as they are."""
    return f'<pre tabindex="0"><code>{escape(words)}</code></pre>\n'


def headline(figures: Sequence[tuple[str, str, str]]) -> str:
    """
    Return the figures that the page is about.

    Parameters
    ----------
    figures : sequence of (str, str, str)
        What it is, its value, and what else to say of it.

    Returns
    -------
    str
        HTML.

    """
    cards = ''.join(
        f'<div><dt>{_text(what)}</dt><dd><strong>{_text(value)}</strong>'
        f'<span>{_text(note)}</span></dd></div>\n'
        for what, value, note in figures
    )
    return f'<dl class="headline">\n{cards}</dl>\n'


def grid(rows: Sequence[Sequence[str]], heads: Sequence[str], caption: str) -> str:
    """
    Return a table; what it holds beside its first column, which names the rows, may be numbers.

    Parameters
    ----------
    rows : sequence of sequence of str
        Cells.
    heads : sequence of str
        Column heads.
    caption : str
        What the table shows.

    Returns
    -------
    str
        HTML; a table that is wider than the screen scrolls by itself.

    """
    top = ''.join(f'<th scope="col">{_text(head)}</th>' for head in heads)
    body = ''.join(
        f'<tr>{_cell(first, _ROW_HEAD)}{"".join(map(_cell, others))}</tr>\n'
        for first, *others in rows
    )
    return (
        f'<div class="wide" role="region" aria-label="{escape(caption)}" tabindex="0"><table>\n'
        f'<caption>{_text(caption)}</caption>\n<thead><tr>{top}</tr></thead>\n'
        f'<tbody>\n{body}</tbody></table></div>\n'
    )


def _cell(words: str, tag: str = 'td') -> str:
    is_number = _NUMBER.match(words) and len(words) < _LONGEST_NUMBER
    kind = _VERDICTS.get(words, 'number' if is_number else '')
    mark = f' class="{kind}"' if kind else ''
    return f'<{tag}{mark}>{_text(words)}</{tag.partition(" ")[0]}>'


_STYLE = """
body { font: 16px/1.55 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
       color: #1c2128; background: #fff; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.2; margin-bottom: .5rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .5rem; }
.lead { color: #47505c; margin-top: 0; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; min-width: 100%; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: #47505c; padding-bottom: .3rem; }
th, td { text-align: left; vertical-align: top; padding: .3rem 1rem .3rem 0;
         border-bottom: 1px solid #dde1e6; }
thead th { border-bottom: 2px solid #1c2128; } tbody th { font-weight: 600; }
.number { white-space: nowrap; }
td.pass { color: #17692f; } td.FAIL { color: #b00020; font-weight: bold; }
.headline { display: flex; flex-wrap: wrap; gap: 1rem; margin: 1.5rem 0; }
.headline > div { flex: 1 1 14rem; border: 1px solid #dde1e6; border-top: 4px solid #1f5fa8;
                  padding: .7rem 1rem; }
.headline dt { color: #47505c; } .headline dd { margin: 0; }
.headline strong { display: block; font-size: 1.45rem; line-height: 1.3; }
.headline span { color: #47505c; }
.notice { border-left: 4px solid #b45309; background: #fdf6ec; padding: .1rem 1rem;
          margin: 1.5rem 0; }
.notice h2 { margin: .7rem 0 0; font-size: 1rem; } .notice ul { margin: .4rem 0 .8rem; }
.notice details { margin-bottom: .8rem; } summary { cursor: pointer; }
pre { overflow-x: auto; background: #f4f6f8; padding: .7rem 1rem; font-size: .9rem; }
figure { margin: 1.5rem 0; } figcaption { color: #47505c; }
img { max-width: 100%; height: auto; display: block; }
ul { padding-left: 1.3rem; } sub, sup { line-height: 0; }
@media (max-width: 40rem) {
  table, pre { font-size: .85rem; } th, td { padding-right: .7rem; }
  figure { overflow-x: auto; } img { max-width: none; width: 38rem; }
  figcaption { position: sticky; left: 0; }
}
@media print {
  body { max-width: none; margin: 0; font-size: 10pt; } table { font-size: 8pt; }
  th, td { padding-right: .6rem; } .number { white-space: normal; }
  td { overflow-wrap: anywhere; }
  figure, tr, .headline > div, .notice { break-inside: avoid; }
  h2 { break-after: avoid; } .wide, pre { overflow: visible; } pre { white-space: pre-wrap; }
}
"""

#: The browser refuses whatever is not in the page itself.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def write_document(
    path: Path, title: str, introduction: str, blocks: Sequence[str | Picture]
) -> None:
    """
    Write one self-contained page, and each picture as a PNG beside it.

    Parameters
    ----------
    path : Path
        Page to write; it appears whole or not at all.
    title, introduction : str
        Plain text.
    blocks : sequence of str or Picture
        What follows, in order: pictures, and HTML from the functions of this module.

    Raises
    ------
    ParameterError
        If a file cannot be written.

    """
    body = ''.join(
        _drawn(block, path.parent) if isinstance(block, Picture) else block for block in blocks
    )
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{escape(title)}</title>\n<style>{_STYLE}</style></head>\n<body><main>\n'
        f'<h1>{_text(title)}</h1>\n<p class="lead">{_text(introduction)}</p>\n'
        f'{body}</main></body></html>\n'
    )
    write_whole(path, page.encode())


def _drawn(picture: Picture, folder: Path) -> str:
    image = png(picture.figure)
    write_whole(folder / f'{picture.name}.png', image)
    data = base64.b64encode(image).decode('ascii')
    width, height = (int.from_bytes(image[at : at + 4], 'big') for at in (16, 20))
    words = escape(picture.description or picture.caption)
    return (
        f'<figure tabindex="0"><img src="data:image/png;base64,{data}" '
        f'width="{width}" height="{height}" alt="{words}">\n'
        f'<figcaption>{_text(picture.caption)}</figcaption></figure>\n'
    )


def write_page(
    path: Path,
    title: str,
    introduction: str,
    checks: Sequence[Check],
    pictures: Sequence[Picture],
) -> None:
    """
    Write one self-contained page of checks and pictures, and each picture as a PNG beside it.

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
    rows = grid(_check_rows(checks), _CHECK_HEADS, 'Results')
    write_document(path, title, introduction, [rows, *pictures])
