# SPDX-License-Identifier: Apache-2.0
"""Alignment of text tables, and complete self-contained pages."""

import asyncio
from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from html.parser import HTMLParser
import json
from pathlib import Path
import re
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from markupsafe import Markup
from matplotlib.figure import Figure
from needle_dynamics import ParameterError
from needle_insertion.report.content import Picture, table
from needle_insertion.report.made import COMMAND
from needle_insertion.report.page import TEMPLATES, write_page
import pytest
from reproduction.content import Check, CHECK_HEADS
from reproduction.insertions.aiming import animate_aiming
from support.pages import look_at
from support.watched import TARGET, write_watched
from tools.browser import BROWSER, browser

#: The blocks of pages, by name.
BLOCKS: Any = TEMPLATES.get_template('blocks.html').module

#: A page with pieces of HTML and pictures.
PAGE = TEMPLATES.from_string(
    "{% extends 'page.html' %}{% from 'blocks.html' import picture %}{% block content %}"
    '{% for one in blocks %}{{ one }}{% endfor %}'
    '{% for one in pictures.values() %}{{ picture(one) }}{% endfor %}{% endblock %}'
)

cells = st.text(st.characters(categories=('L', 'N', 'P', 'S')), min_size=1, max_size=12)
#: Any text without carriage returns, which HTML does not preserve.
texts = st.text(st.characters(exclude_categories=('Cs', 'Cc')), max_size=30)


@settings(deadline=None)
@given(st.lists(st.tuples(cells, cells, cells), max_size=6))
def test_table_columns_are_aligned(rows: list[tuple[str, str, str]]) -> None:
    """All cells of a column start at the same position and are complete."""
    lines = table(rows, ('a', 'b', 'c')).splitlines()
    widths = [len(dashes) for dashes in lines[1].split('  ')]
    assert len(lines) == len(rows) + 2
    for line, row in zip(lines[2:], rows, strict=True):
        start = 0
        for cell, width in zip(row, widths, strict=True):
            assert line[start : start + width].rstrip() == cell
            start += width + 2


WORDS = st.lists(st.text('ab-', min_size=1, max_size=12), min_size=1, max_size=12).map(' '.join)


@given(
    st.lists(st.tuples(WORDS, WORDS, WORDS, WORDS), min_size=1, max_size=3), st.integers(54, 120)
)
@settings(deadline=None)
def test_tables_fit_a_terminal(rows: list[tuple[str, ...]], width: int) -> None:
    """At most 100 columns or the width of the terminal, with every word in its column."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('COLUMNS', str(width))
        lines = table(rows, ('a', 'b', 'c', 'd')).splitlines()
    assert max(map(len, lines)) <= min(100, width)
    starts = [match.start() for match in re.finditer('-+', lines[1])]
    columns = [
        ' '.join(' '.join(line[start:end].split()) for line in lines[2:])
        for start, end in zip(starts, [*starts[1:], None], strict=True)
    ]
    for column, cells in zip(columns, zip(*rows, strict=True), strict=True):
        assert column.split() == ' '.join(cells).split()


def test_failed_checks_are_printed_in_capitals() -> None:
    assert Check('x', '1', '2', passed=False).row == ('x', '1', '2', 'FAIL')
    assert Check('y', '1', '1', passed=True).row == ('y', '1', '1', 'pass')


class Reader(HTMLParser):
    """HTML parser that collects texts and tags, and requires that tags are closed in order."""

    def __init__(self, piece: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(piece)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ('meta', 'img'):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@settings(deadline=None)
@given(texts)
def test_texts_are_escaped(text: str) -> None:
    """Each block contains its text unchanged, and only its own tags."""
    for block in (
        BLOCKS.heading(text),
        BLOCKS.paragraph(text),
        BLOCKS.bullets([text]),
        BLOCKS.notice(text, [text], [text, text]),
        BLOCKS.code(text),
        BLOCKS.headline([(text, text, text)]),
        BLOCKS.grid([(text, text)], (text, text), text),
    ):
        reader = Reader(block)
        assert not reader.open
        assert {tag for tag, _ in reader.tags} <= {
            *('h2', 'p', 'ul', 'li', 'aside', 'pre', 'code', 'dl', 'div', 'dt', 'dd', 'strong'),
            *(
                'details',
                'summary',
                'span',
                'table',
                'caption',
                'thead',
                'tbody',
                'tr',
                'th',
                'td',
                'i',
                'sub',
                'sup',
            ),
        }
        # Symbols are typeset; all other text is unchanged.
        if not re.search(r'[_^]|mu|phi|tau|theta|rho|omega|\d um', text):
            assert text in ''.join(reader.texts)


def test_symbols_are_typeset() -> None:
    """The name of a coefficient becomes a letter with a subscript, also within words."""
    paragraph = BLOCKS.paragraph
    assert '<i>μ</i><sub>s</sub> = 1' in paragraph('mu_s = 1')
    assert '<i>k</i><sub>zz</sub>' in paragraph('k_zz')
    assert 'k_coulomb' in paragraph('k_coulomb')
    assert '<i>q\u0307</i><sub>1</sub> and <i>θ\u0308</i>' in paragraph('q1_dot and theta_ddot')
    assert '<i>q\u0307</i><sub>e</sub>' in paragraph('q_dot_e')
    assert 'a d e, 5 μm, an um' in paragraph('a d e, 5 um, an um')
    assert 'm² M<sup>T</sup> m<sup>-1/2</sup>' in paragraph('m^2 M^T m^-1/2')


def test_empty_notices_are_omitted() -> None:
    assert BLOCKS.notice('Warnings', []).strip() == ''


def test_tables_mark_their_headers() -> None:
    """Column and row headers have a scope, and the table has a caption."""
    reader = Reader(BLOCKS.grid([('mu_s', '0.56')], ('parameter', 'value'), 'Friction'))
    scopes = [given['scope'] for tag, given in reader.tags if tag == 'th']
    assert scopes == ['col', 'col', 'row']
    assert 'caption' in dict(reader.tags)


def picture() -> Picture:
    """Return a picture with a curve."""
    figure = Figure()
    figure.subplots().plot([1.0, 2.0])
    return Picture('plot', 'caption "x"', figure, 'a line that "rises"')


def show(path: Path, blocks: list[Markup], pictures: Sequence[Picture] = ()) -> None:
    """Write a page of blocks and pictures."""
    write_page(path, PAGE, pictures, title='A page', introduction='of blocks', blocks=blocks)


def test_pages_are_self_contained(tmp_path: Path) -> None:
    """Pictures are embedded, texts are escaped, and no draft remains."""
    path = tmp_path / 'report.html'
    checks = [Check('a < b', '<script>', '1 & 2', passed=True)]
    write_page(
        path,
        'checks.html',
        [picture()],
        title='title',
        introduction='text',
        cards=[('Checks', '1 of 1', 'pass')],
        rows=[check.row for check in checks],
        heads=CHECK_HEADS,
    )
    reader = Reader(path.read_text())
    assert not reader.open
    assert not {'script', 'link', 'iframe'} & {tag for tag, _ in reader.tags}
    sources = [given[key] for _, given in reader.tags for key in ('src', 'href') if key in given]
    assert all(source.startswith('data:image/png;base64,') for source in sources)
    assert len(sources) == 1
    assert {'a < b', '<script>', '1 & 2'} <= set(reader.texts)
    assert {item.name for item in tmp_path.iterdir()} == {'report.html', 'plot.png'}


def test_pages_are_reproducible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bytes do not depend on the folder, and the date is SOURCE_DATE_EPOCH."""
    monkeypatch.setenv('SOURCE_DATE_EPOCH', '86400')
    pages = []
    for name in ('one', 'two'):
        folder = tmp_path / name
        folder.mkdir()
        show(folder / 'page.html', [], [picture()])
        pages.append([(folder / file).read_bytes() for file in ('page.html', 'plot.png')])
    assert pages[0] == pages[1]
    assert b'1970-01-02 00:00 UTC</footer>' in pages[0][0]


def test_long_pages_have_a_table_of_contents(tmp_path: Path) -> None:
    """Each heading is linked on a page of four headings; a page of three has no links."""
    path = tmp_path / 'page.html'
    titles = ['mu_s & more', 'Data <fit>', 'Files', 'k_xx']
    for count in (3, 4):
        show(path, [BLOCKS.heading(title) for title in titles[:count]])
        reader = Reader(path.read_text())
        links = [given['href'] for tag, given in reader.tags if tag == 'a']
        anchors = [f'#{given["id"]}' for tag, given in reader.tags if tag == 'h2']
        assert links == (anchors if count == 4 else [])
    assert len(set(links)) == 4


def test_pages_show_their_origin(tmp_path: Path) -> None:
    """Version, command line and date."""
    token = COMMAND.set("needle identify friction 'a b'")
    show(tmp_path / 'page.html', [])
    COMMAND.reset(token)
    made = re.search('<footer>(.*)</footer>', (tmp_path / 'page.html').read_text())
    assert made
    assert re.fullmatch(
        r'needle_insertion [\d.]+, needle identify friction &#39;a b&#39;, [-\d]+ [:\d]+ UTC',
        made[1],
    )


def test_pages_fit_a_phone_screen(tmp_path: Path) -> None:
    """All pictures load, no external requests are sent, and nothing overflows."""
    path = tmp_path / 'page.html'
    blocks = [
        BLOCKS.headline([('Friction mu_s', '0.5604 N', '95 % interval 0.5594 to 0.5614')]),
        BLOCKS.grid([['one', *['1234567890'] * 12]], ['x'] * 13, 'a wide table'),
        BLOCKS.code('ros2 run ' + 'word ' * 60),
        BLOCKS.paragraph('/a/path/that/is/long' * 10),
    ]
    show(path, blocks, [picture()])
    seen = look_at(path)
    assert 'μs' in seen.text
    assert '0.5604 N' in seen.text
    assert [alt for alt, width in seen.images if width > 0] == ['a line that "rises"']
    assert seen.requests == []
    assert seen.overflow == 0


@pytest.mark.skipif(BROWSER is None, reason='no Chromium on this machine')
def test_nothing_is_cut_on_a_phone(tmp_path: Path) -> None:
    """Wide tables become cards, and long lines and narrow pictures fit: nothing scrolls."""
    path = tmp_path / 'page.html'
    drawn = picture().figure
    drawn.set_size_inches(4.8, 3.0)
    blocks = [
        BLOCKS.grid([['one', *['0.5604 ± 0.0011'] * 12]], ['mu_s [N]'] * 13, 'numbers'),
        BLOCKS.grid([['file', 'ab' * 32]], ['file', 'SHA-256'], 'checksums'),
        BLOCKS.code('ros2 param set /plant model.coulomb_friction 0.559888'),
    ]
    show(path, blocks, [Picture('plot', 'a plot', drawn)])

    async def look() -> None:
        async with browser() as tab:
            await tab.size(400, 900)
            await tab.open(path.as_uri())
            await tab.wait("document.querySelector('img').naturalWidth", 'the picture')
            cut = (
                "[...document.querySelectorAll('.wide, figure, pre')]"
                '.filter((one) => one.scrollWidth > one.clientWidth).map((one) => one.innerText)'
            )
            assert await tab.run(cut) == []
            # Each number has its head.
            assert await tab.run(
                "getComputedStyle(document.querySelector('.cards td'), '::before').content"
            ) == '"mu_s [N]"'  # fmt: skip

    asyncio.run(look())


def test_external_requests_are_detected(tmp_path: Path) -> None:
    """An external image is reported as missing and as requested."""
    path = tmp_path / 'page.html'
    show(path, [Markup('<img src="http://127.0.0.1:9/outside.png">')])
    seen = look_at(path)
    assert all(width == 0 for _, width in seen.images)
    assert seen.requests == ['http://127.0.0.1:9/outside.png']


def test_write_errors_name_the_page(tmp_path: Path) -> None:
    """A missing folder gives a one-line error, and no file remains."""
    with pytest.raises(ParameterError, match=r'no/page.html cannot be written: No such file'):
        show(tmp_path / 'no' / 'page.html', [])
    assert not list(tmp_path.iterdir())


def show_moving(folder: Path) -> Path:
    """Write a page with a picture and an animated needle."""
    write_watched(folder / 'bag')
    path = folder / 'page.html'
    write_page(
        path, 'checks.html', [picture()], animate_aiming(folder / 'bag'), title='A page',
        introduction='of a needle', cards=[], rows=[], heads=CHECK_HEADS,
    )  # fmt: skip
    return path


def test_animations_run_only_their_own_script(tmp_path: Path) -> None:
    """The content security policy allows the animation script only; the page stays small."""
    path = show_moving(tmp_path)
    text = path.read_text()
    (script,) = re.findall('<script>(.*?)</script>', text, re.DOTALL)
    digest = b64encode(sha256(script.encode()).digest()).decode()
    (policy,) = re.findall('Content-Security-Policy" content="([^"]*)"', text)
    assert policy.startswith("default-src 'none'; ")
    assert f"script-src 'sha256-{digest}'" in policy.replace('&#39;', "'").replace('&#43;', '+')
    (data,) = re.findall('<script type="application/json" id="frames">(.*?)</script>', text)
    content = json.loads(data)
    assert len(content['frames']) == 80
    assert content['frames'][-1]['target'] == list(TARGET)
    assert [len(column) for column in content['frames'][-1]['needle']] == [40, 40, 40]
    assert content['path'][1][-1] == pytest.approx(0.08)
    assert 'data:image/png;base64,' in text
    show(tmp_path / 'other.html', [], [picture()])
    without = (tmp_path / 'other.html').read_text()
    assert 'script' not in without
    assert len(text) - len(without) < 300_000


@pytest.mark.skipif(BROWSER is None, reason='no Chromium on this machine')
def test_animations_play_in_a_browser(tmp_path: Path) -> None:
    """The animation starts at its end, seeks, plays to its end, and is omitted in print."""
    path = show_moving(tmp_path)

    async def look() -> None:
        async with browser() as tab:
            await tab.size(400, 900)
            await tab.open(path.as_uri())
            clock = "document.querySelector('.animation output').textContent"
            await tab.wait(f"{clock} === '4.0 of 4.0 s'", 'the end')
            slider = "document.querySelector('.animation input')"
            await tab.run(f"{slider}.value = 1, {slider}.dispatchEvent(new Event('input'))")
            assert await tab.run(clock) == '1.0 of 4.0 s'
            pixels = (
                "(() => { const one = document.querySelector('.animation canvas'); return one"
                ".getContext('2d').getImageData(0, 0, one.width, one.height).data.join() })()"
            )
            early = await tab.run(pixels)
            await tab.run("document.querySelector('.animation button').click()")
            await tab.wait(f"{clock} === '4.0 of 4.0 s'", 'the end')
            assert await tab.run(pixels) != early
            wide = 'document.documentElement.scrollWidth - document.documentElement.clientWidth'
            assert await tab.run(wide) == 0
            await tab.picture(tmp_path / 'page.png')
            await tab.call('Emulation.setEmulatedMedia', media='print')
            assert await tab.run("document.querySelector('.animation').clientHeight") == 0
            assert await tab.run("document.querySelector('img').clientHeight") > 0
            assert tab.faults == []

    asyncio.run(look())
