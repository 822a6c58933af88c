"""
Self-contained HTML pages from the templates of this folder.

A page needs no other file and loads nothing, and its own policy tells the browser so. The same
content gives the same bytes. Templates escape all text that they are given.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
import re
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from needle_identification.result import write_whole
from needle_insertion.report.content import Picture
from needle_insertion.report.symbols import symbols

#: A text that starts with a number and is longer, such as a checksum, is not a number.
_LONGEST_NUMBER: Final = 40
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


#: Templates of this folder.
TEMPLATES: Final = Environment(
    loader=PackageLoader('needle_insertion.report'),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.filters.update(symbols=symbols, kind=_kind)


def write_page(
    path: Path, template: str | Template, pictures: Iterable[Picture] = (), **content: Any
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
    **content : object
        What else the template shows; a ``title`` and an ``introduction`` at least.

    Raises
    ------
    ParameterError
        If a file cannot be written.

    """
    shown = {one.name: one for one in pictures}
    page = TEMPLATES.get_template(template).render(pictures=shown, **content)
    for name, one in shown.items():
        write_whole(path.parent / f'{name}.png', one.image)
    write_whole(path, page.encode())
