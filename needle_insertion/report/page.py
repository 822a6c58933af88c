"""
Self-contained HTML pages from the templates of this folder.

A page needs no other file and loads nothing, and its own policy tells the browser so. The same
content gives the same bytes, but for the date. Templates escape all text that they are given.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
import re
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from needle_insertion.report.animation import Animation
from needle_insertion.report.content import Picture
from needle_insertion.report.made import made
from needle_insertion.report.symbols import symbols
from needle_ros.files import write_whole

#: A text that starts with a number and is longer, such as a checksum, is not a number.
_LONGEST_NUMBER: Final = 40

#: A longer cell has words for reading.
_SENTENCE: Final = 30
#: Headings, and how many of them are worth a table of contents.
_HEADING: Final = re.compile('<h2 id="([^"]*)">(.*?)</h2>')
_FEWEST_HEADINGS: Final = 4

_NUMBER: Final = re.compile(r'[-+]?\d')

#: Style classes of cells that hold a verdict.
_VERDICTS: Final = {
    'pass': 'pass',
    'holds': 'pass',
    'FAIL': 'FAIL',
    'does not hold': 'FAIL',
    'DOES NOT HOLD': 'FAIL',
}


def _kind(cell: str) -> str:
    """Return the style class of a table cell, '' if it needs none."""
    is_number = _NUMBER.match(cell) and len(cell) < _LONGEST_NUMBER
    return _VERDICTS.get(cell, 'number' if is_number else '')


def _has_sentences(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether the cells of a table are for reading rather than comparing."""
    return any(len(cell) > _SENTENCE for row in rows for cell in row[1:])


def _anchor(words: str) -> str:
    """Return the name of a heading in an address."""
    return re.sub(r'\W+', '-', words.lower()).strip('-')


def _contents(content: str) -> Markup:
    """Return the table of contents of a page, nothing for a short one."""
    found = _HEADING.findall(content)
    if len(found) < _FEWEST_HEADINGS:
        return Markup()
    # Both are from the page itself, where they have been escaped.
    links = ''.join(f'<a href="#{anchor}">{words}</a>\n' for anchor, words in found)
    return Markup(f'<nav aria-label="Contents">\n{links}</nav>')  # noqa: S704


#: Where the templates are, and what else pages are made of.
TEMPLATE_FOLDER: Final = Path(__file__).with_name('templates')

#: Templates of this folder.
TEMPLATES: Final = Environment(
    loader=PackageLoader('needle_insertion.report'),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.filters.update(
    symbols=symbols,
    kind=_kind,
    anchor=_anchor,
    contents=_contents,
    has_sentences=_has_sentences,
    zip=partial(zip, strict=True),
)


def write_page(
    path: Path,
    template: str | Template,
    pictures: Iterable[Picture] = (),
    animation: Animation | None = None,
    **content: Any,
) -> None:
    """
    Write one page, and each of its pictures as a PNG beside it.

    Parameters
    ----------
    path : Path
        Page to write; it appears completely or not at all.
    template : str or Template
        The template, or the name of its file.
    pictures : iterable of Picture
        Pictures of the page; the template gets them by name as ``pictures``.
    animation : Animation, optional
        A needle that moves; the only script that the browser then runs on the page is its own.
    **content : object
        What else the template shows; a ``title`` and an ``introduction`` at least.

    Raises
    ------
    ParameterError
        If a file cannot be written.

    """
    shown = {one.name: one for one in pictures}
    page = TEMPLATES.get_template(template).render(
        pictures=shown, animation=animation, made=made(), **content
    )
    for name, one in shown.items():
        write_whole(path.parent / f'{name}.png', one.image)
    write_whole(path, page.encode())
