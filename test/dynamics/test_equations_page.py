"""docs/equations.md: every equation and table of the paper has its row, and every name exists."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
import re

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / 'docs' / 'equations.md').read_text(encoding='utf-8')
#: Everything in backticks that looks like a name of ours.
FUNCTIONS = sorted(set(re.findall(r'`(needle_\w+(?:\.\w+)+)`', PAGE)))
TESTS = sorted(set(re.findall(r'`(test_\w+\.test_\w+)`', PAGE)))
ROWS = [
    line for line in PAGE.splitlines() if re.match(r'\| (?!no\.|where|table|place|what )', line)
]


@cache
def names_in(file: str) -> set[str]:
    """Return the names of the functions in all test files of a name."""
    return {
        node.name
        for path in (ROOT / 'test').rglob(f'{file}.py')
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
        if isinstance(node, ast.FunctionDef)
    }


def missing_names(names: list[str]) -> Iterator[str]:
    """Say which functions, classes or attributes do not exist."""
    for name in names:
        parts = name.split('.')
        modules = ['.'.join(parts[:k]) for k in range(len(parts), 0, -1)]
        module = next((one for one in modules if is_module(one)), None)
        if module is None or '.' not in module:
            yield f'{name} names no module'
            continue
        found: object = import_module(module)
        for part in name.removeprefix(module).split('.')[1:]:
            if not hasattr(found, part):
                yield f'{name}: {found} has no {part}'
                break
            found = getattr(found, part)


def is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        # The part before the last dot is not a package.
        return False


def missing_tests(tests: list[str]) -> list[str]:
    """Say which tests do not exist."""
    return [one for one in tests if one.split('.')[1] not in names_in(one.split('.')[0])]


def unproved(rows: list[str]) -> list[str]:
    """Say which rows name no test and do not say: not in the package."""
    proof = re.compile(r'`test_\w+\.test_\w+`|not in the package')
    return [row for row in rows if not proof.search(row) or row.count(' | ') < 2]


def test_every_function_and_test_on_the_page_exists() -> None:
    assert len(FUNCTIONS) > 30
    assert len(TESTS) > 60
    assert list(missing_names(FUNCTIONS)) == []
    assert missing_tests(TESTS) == []


def test_every_equation_and_every_table_has_one_row() -> None:
    """Equations (1) to (19) name a function each; Tables 1 to 3 have their rows."""
    section = PAGE.partition('## Numbered equations')[2].partition('## ')[0]
    for number in range(1, 20):
        (row,) = [line for line in section.splitlines() if line.startswith(f'| ({number}) |')]
        assert re.search(r'`needle_\w+(\.\w+)+`', row), row
    for number in (1, 2, 3):
        assert sum(row.startswith(f'| {number} |') for row in ROWS) == 1


def test_every_row_has_a_test_or_says_that_it_is_not_in_the_package() -> None:
    assert len(ROWS) > 80
    assert unproved(ROWS) == []


def test_links_of_the_page_lead_somewhere() -> None:
    targets = re.findall(r'\]\(([^)]+)\)', PAGE)
    assert targets
    assert [target for target in targets if not (ROOT / 'docs' / target).is_file()] == []


def test_a_wrong_name_on_the_page_is_found() -> None:
    """The checks above can fail."""
    wrong = ['needle_dynamics.nothing', 'needle_dynamics.model.NeedleModel.nothing', 'none.such']
    assert len(list(missing_names(wrong))) == 3
    assert missing_tests(['test_model.test_nothing']) == ['test_model.test_nothing']
    assert unproved(['| (1) | a law | `needle_dynamics.model` | |']) != []
