# SPDX-License-Identifier: Apache-2.0
"""
Write self-contained HTML pages from the templates of this folder.

Pages load no other files, and their content security policy forbids it. The same content gives the
same bytes, except for the date. Templates escape all inserted text.
"""

from abc import ABC, abstractmethod
import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
import json
from pathlib import Path
import re
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import escape, Markup
from needle_insertion.report.content import Picture
from needle_insertion.report.insertion import evenly
from needle_insertion.report.made import made
from needle_ros.files import write_whole

_POINTS: Final = 40  #: largest number of points of a needle

#: Keys of a frame that are drawn.
_DRAWN: Final = ('time', 'needle', 'shape', 'target', 'expected', 'tip', 'depth')

#: Largest length of a cell with a number; longer text is for example a checksum.
_LONGEST_NUMBER: Final = 40

_SENTENCE: Final = 30  #: largest length of a cell without sentences
#: Largest width of a table that fits a telephone [characters], with the space after a column.
_NARROW, _SPACE = 42, 2
#: Headings, and smallest number of headings for a table of contents.
_HEADING: Final = re.compile('<h2 id="([^"]*)">(.*?)</h2>')
_FEWEST_HEADINGS: Final = 4

_NUMBER: Final = re.compile(r'[-+]?\d')

#: Style classes of cells with a verdict.
_VERDICTS: Final = {
    'pass': 'pass',
    'holds': 'pass',
    'FAIL': 'FAIL',
    'does not hold': 'FAIL',
    'DOES NOT HOLD': 'FAIL',
}

#: Symbols in plain text, such as mu_s or q1_dot.
_GREEK: Final = {'mu': 'μ', 'phi': 'φ', 'tau': 'τ', 'theta': 'θ', 'rho': 'ρ', 'omega': 'ω'}
_SYMBOL: Final = re.compile(
    rf'\b({"|".join(_GREEK)}|q(?=\d)|[kfIqcde](?=_))(\d?)(?:_(d?dot))?(?:_(\w{{1,3}}))?\b'
)
#: Combining dots, which follow their letter.
_DOTS: Final = {None: '', 'dot': '\u0307', 'ddot': '\u0308'}
_POWER: Final = re.compile(r'\^(?:([2-4])(?![\d/])|(-?\d+(?:/\d+)?|T\b))')
_MICROMETERS: Final = re.compile(r'(?<=\d )um\b')


class Interactive(ABC):
    """Figure of a page that its script draws."""

    caption: str

    @property
    @abstractmethod
    def content(self) -> Mapping[str, Any]:
        """Content of the script, for JSON."""

    @property
    @abstractmethod
    def scripts(self) -> Sequence[str]:
        """Files of the script, in the folder of the templates."""

    @property
    def data(self) -> Markup:
        """JSON data of the script, escaped so that it cannot close its HTML element."""
        text = json.dumps(self.content, separators=(',', ':'), allow_nan=False)
        return Markup(text.replace('<', r'\u003c'))  # noqa: S704

    @property
    def script(self) -> Markup:
        parts = [(TEMPLATE_FOLDER / name).read_text(encoding='utf-8') for name in self.scripts]
        # Trusted: the scripts are part of this package.
        return Markup('\n'.join(parts))  # noqa: S704

    @property
    def digest(self) -> str:
        """SHA-256 source expression of the script for the content security policy."""
        made = sha256(self.script.encode()).digest()
        return f'sha256-{base64.b64encode(made).decode("ascii")}'


@dataclass(frozen=True, eq=False)
class Animation(Interactive):
    """Animation of a needle from frames."""

    caption: str
    scene: Mapping[str, Any]  #: from `needle_insertion.watch.view.scene`
    #: Frames of `needle_insertion.watch.view.View.frame`, each with a needle.
    frames: Sequence[Mapping[str, Any]]

    @property
    def scripts(self) -> Sequence[str]:
        return 'needle.js', 'animation.js'

    @property
    def content(self) -> Mapping[str, Any]:
        frames = [{key: frame[key] for key in _DRAWN} for frame in self.frames]
        for frame in frames:
            frame['needle'] = [
                [round(value, 5) for value in evenly(column, min(len(column), _POINTS))]
                for column in frame['needle']
            ]
        paths = [frame['path'] for frame in self.frames if frame['path']]
        # The last cut path contains all earlier paths.
        path = paths[-1] if paths else [[], [], []]
        return {'scene': self.scene, 'frames': frames, 'path': path}


def _symbols(words: str) -> Markup:
    """Escape a text and typeset its symbols, powers and micrometers."""
    # `escape` makes the text safe: the substitutions insert only tags, letters and digits.
    text = _POWER.sub(_power, _SYMBOL.sub(_symbol, str(escape(words))))
    return Markup(_MICROMETERS.sub('μm', text))  # noqa: S704


def _symbol(found: re.Match[str]) -> str:
    letter, number, dots, index = found.groups()
    below = f'{number}{"," if number and index else ""}{index or ""}'
    subscript = f'<sub>{below}</sub>' if below else ''
    return f'<i>{_GREEK.get(letter, letter)}{_DOTS[dots]}</i>{subscript}'


def _power(found: re.Match[str]) -> str:
    return '⁰¹²³⁴'[int(found[1])] if found[1] else f'<sup>{found[2]}</sup>'


def _kind(cell: str) -> str:
    is_number = _NUMBER.match(cell) and len(cell) < _LONGEST_NUMBER
    return _VERDICTS.get(cell, 'number' if is_number else '')


def _layout(rows: Sequence[Sequence[str]], heads: Sequence[str]) -> str:
    """Return the style class of a table on a telephone: stacked cells, cards, or ''."""
    if any(len(cell) > _SENTENCE for row in rows for cell in row[1:]):
        return 'words'
    columns = zip(heads, *rows, strict=True)
    # Heads are broken between words.
    width = sum(
        max(*map(len, column[1:]), *map(len, column[0].split()), 0) + _SPACE for column in columns
    )
    return 'cards' if width > _NARROW else ''


def _anchor(words: str) -> str:
    return re.sub(r'\W+', '-', words.lower()).strip('-')


def _contents(content: str) -> Markup:
    """Return the table of contents of a page, empty for a short page."""
    found = _HEADING.findall(content)
    if len(found) < _FEWEST_HEADINGS:
        return Markup()
    # Both are from the page itself, where they are already escaped.
    links = ''.join(f'<a href="#{anchor}">{words}</a>\n' for anchor, words in found)
    return Markup(f'<nav aria-label="Contents">\n{links}</nav>')  # noqa: S704


#: Folder of templates, style and scripts.
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
    symbols=_symbols,
    kind=_kind,
    anchor=_anchor,
    contents=_contents,
    layout=_layout,
    zip=partial(zip, strict=True),
)


def write_page(
    path: Path,
    template: str | Template,
    pictures: Iterable[Picture] = (),
    animation: Interactive | None = None,
    **content: Any,
) -> None:
    """
    Write a page atomically, and each of its pictures as a PNG in the same folder.

    The template receives ``pictures`` by name, ``content`` with at least ``title`` and
    ``introduction``, and the ``animation`` with the only script that the policy permits.
    """
    shown = {one.name: one for one in pictures}
    page = TEMPLATES.get_template(template).render(
        pictures=shown, animation=animation, made=made(), **content
    )
    for name, one in shown.items():
        write_whole(path.parent / f'{name}.png', one.image)
    write_whole(path, page.encode())
