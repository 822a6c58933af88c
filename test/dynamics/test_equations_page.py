"""docs/equations.md: every equation and table of the source has its row, and every name exists."""

from __future__ import annotations

import ast
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / 'docs' / 'equations.md').read_text(encoding='utf-8')
#: What stands in backticks and looks like a name of ours.
FUNCTIONS = sorted(set(re.findall(r'`(needle_\w+(?:\.\w+)+)`', PAGE)))
TESTS = sorted(set(re.findall(r'`(test_\w+\.test_\w+)`', PAGE)))
ROWS = [
    line for line in PAGE.splitlines() if re.match(r'\| (?!no\.|where|table|place|what )', line)
]


@cache
def names_in(name: str) -> set[str]:
    """Return the names of the tests in all files of a name."""
    files = list((ROOT / 'test').rglob(f'{name}.py'))
    return {
        node.name
        for file in files
        for node in ast.walk(ast.parse(file.read_text(encoding='utf-8')))
        if isinstance(node, ast.FunctionDef)
    }


def test_the_page_names_functions_and_tests() -> None:
    """The patterns of this file find what the page holds."""
    assert len(FUNCTIONS) > 30
    assert len(TESTS) > 60


@pytest.mark.parametrize('name', FUNCTIONS)
def test_function_on_the_page_exists(name: str) -> None:
    """Every function, class or attribute that the page names is there."""
    parts = name.split('.')
    count = next(k for k in range(len(parts), 0, -1) if _is_module('.'.join(parts[:k])))
    found = import_module('.'.join(parts[:count]))
    assert count > 1, f'{name} names no module'
    for part in parts[count:]:
        assert hasattr(found, part), f'{name}: {found} has no {part}'
        found = getattr(found, part)


def _is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        # What stands before the last dot is not a package.
        return False


@pytest.mark.parametrize('name', TESTS)
def test_test_on_the_page_exists(name: str) -> None:
    """Every test that the page names is there."""
    file, test = name.split('.')
    assert test in names_in(file)


@pytest.mark.parametrize('number', range(1, 20))
def test_each_numbered_equation_has_one_row(number: int) -> None:
    """Equations (1) to (19) each have a row of their own."""
    section = PAGE.partition('## Numbered equations')[2].partition('## ')[0]
    rows = [line for line in section.splitlines() if line.startswith(f'| ({number}) |')]
    assert len(rows) == 1
    assert re.search(r'`needle_\w+(\.\w+)+`', rows[0])


def test_each_table_has_a_row() -> None:
    """Tables 1 to 3 each have a row."""
    for number in (1, 2, 3):
        assert sum(row.startswith(f'| {number} |') for row in ROWS) == 1


@pytest.mark.parametrize('row', ROWS)
def test_a_row_has_a_test_or_says_that_there_is_nothing(row: str) -> None:
    """A row names a test, and a function where it maps one; or it says: not in the package."""
    assert re.search(r'`test_\w+\.test_\w+`', row) or 'not in the package' in row
    assert row.count(' | ') >= 2


def test_links_of_the_page_lead_somewhere() -> None:
    """Pages and pictures that it refers to are there."""
    for target in re.findall(r'\]\(([^)]+)\)', PAGE):
        assert (ROOT / 'docs' / target).is_file()
