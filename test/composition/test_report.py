"""What a person sees: tables that line up, a page that is whole and self-contained."""

from html.parser import HTMLParser

from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from needle_insertion.report import Check, check_table, Picture, table, write_page

cells = st.text(st.characters(categories=('L', 'N', 'P', 'S')), min_size=1, max_size=12)


@settings(deadline=None)
@given(st.lists(st.tuples(cells, cells, cells), max_size=6))
def test_columns_of_a_table_line_up(rows):
    """Every cell of a column starts at the same place, and every cell is there whole."""
    lines = table(rows, ('a', 'b', 'c')).splitlines()
    widths = [len(dashes) for dashes in lines[1].split('  ')]
    assert len(lines) == len(rows) + 2
    for line, row in zip(lines[2:], rows, strict=True):
        start = 0
        for cell, width in zip(row, widths, strict=True):
            assert line[start : start + width].rstrip() == cell
            start += width + 2


def test_a_failure_is_told_in_capitals():
    """The verdict follows the check."""
    text = check_table([Check('x', '1', '2', passed=False), Check('y', '1', '1', passed=True)])
    assert text.splitlines()[2].endswith('FAIL')
    assert text.splitlines()[3].endswith('pass')


def test_the_page_needs_nothing_beside_it(tmp_path):
    """Pictures are inside, texts are escaped, and no draft is left."""
    path = tmp_path / 'report.html'
    checks = [Check('a < b', '<script>', '1 & 2', passed=True)]
    write_page(path, 'title', 'text', checks, [Picture('plot', 'caption "x"', Figure())])
    sources, rows = [], []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attrs):
            assert tag != 'script'
            sources.extend(value for name, value in attrs if name in ('src', 'href'))

        def handle_data(self, data):
            rows.append(data)

    Reader().feed(path.read_text())
    assert all(source.startswith('data:image/png;base64,') for source in sources)
    assert len(sources) == 1
    assert {'a < b', '<script>', '1 & 2'} <= set(rows)
    assert {item.name for item in tmp_path.iterdir()} == {'report.html', 'plot.png'}
