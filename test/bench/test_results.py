# SPDX-License-Identifier: Apache-2.0
"""The published result pages have the bars of the benchmarks."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
import re
import subprocess
from subprocess import CompletedProcess

from benchmarks.run import make_pages, MODULES, PAGES
import pytest
from support.installed import ROOT

FOLDER = ROOT / 'docs/results'
#: Bar without a known limit.
ANY = '.+'


def source(module: str) -> ast.Module:
    found = find_spec(f'benchmarks.{module}')
    assert found is not None
    assert found.origin is not None
    return ast.parse(Path(found.origin).read_text(encoding='utf-8'))


def imported(module: str) -> set[str]:
    """Return the modules of the benchmarks that a module imports directly."""
    found = set()
    for item in ast.walk(source(module)):
        if isinstance(item, ast.ImportFrom) and item.module == 'benchmarks':
            found |= {alias.name for alias in item.names}
        elif isinstance(item, ast.ImportFrom) and (item.module or '').startswith('benchmarks.'):
            found.add(str(item.module).removeprefix('benchmarks.'))
    return found


def pattern(figure: ast.expr) -> str:
    """Return a regular expression of the names that an expression can give to a bar."""
    if isinstance(figure, ast.Constant):
        return re.escape(str(figure.value))
    if isinstance(figure, ast.JoinedStr):
        parts = (part if isinstance(part, ast.Constant) else None for part in figure.values)
        return ''.join(ANY if part is None else re.escape(str(part.value)) for part in parts)
    return ANY


def constant(module: str, item: ast.expr) -> object:
    """Return the value of a literal or of a constant of a module, None if it is neither."""
    if isinstance(item, ast.Constant):
        return item.value
    if isinstance(item, ast.Name):
        try:
            return getattr(import_module(f'benchmarks.{module}'), item.id, None)
        except ImportError:
            return None
    return None


def calls(module: str, name: str) -> Iterator[ast.Call]:
    for item in ast.walk(source(module)):
        if isinstance(item, ast.Call) and ast.unparse(item.func) == name:
            yield item


def bars(modules: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield names and limits of the bars of modules, as regular expressions."""
    for module in modules:
        for item in calls(module, 'Bar'):
            given = dict(
                zip(('figure', 'found', 'limit', 'unit', 'at_least'), item.args, strict=False)
            )
            given |= {str(one.arg): one.value for one in item.keywords}
            limit = constant(module, given['limit'])
            number = re.escape(f'{limit:g}') if isinstance(limit, int | float) else r'\S+'
            unit = constant(module, given.get('unit', ast.Constant('')))
            least = constant(module, given.get('at_least', ast.Constant(False)))
            sign = '[<>]' if least is None else '<>'[bool(least)]
            after = '( .+)?' if unit is None else re.escape(f' {unit}' if unit else '')
            yield pattern(given['figure']), f'{sign}= {number}{after}'


def heads(modules: Sequence[str]) -> Iterator[list[str]]:
    """Yield the heads of the tables of modules, as regular expressions, where they are literal."""
    for module in modules:
        for item in calls(module, 'PageSection'):
            of_table = item.args[1] if len(item.args) > 1 else None
            cells = of_table.elts if isinstance(of_table, ast.Tuple | ast.List) else []
            if cells and not any(isinstance(one, ast.Starred) for one in cells):
                yield [pattern(one) for one in cells]


def rows(name: str) -> list[tuple[str, str]]:
    """Return names and limits in the table of bars of a page."""
    _, _, table = (FOLDER / f'{name}.md').read_text(encoding='utf-8').partition('## Bars\n')
    cells = [line.strip('|').split('|') for line in table.splitlines() if line.startswith('|')]
    return [(one[0].strip(), one[1].strip()) for one in cells[2:]]


def test_docs_list_every_benchmark_and_its_page() -> None:
    """No other page of a benchmark exists."""
    text = (ROOT / 'docs/benchmarks.md').read_text(encoding='utf-8')
    found = dict(
        re.findall(r'^\| ([\w-]+) \|.*\| (?:\[[\w-]+\]\(results/)?([^|)]+).*\|$', text, re.M)
    )
    shown = {name: f'{name}.md' if name in PAGES else 'no page ' for name in MODULES}
    assert {name: found.get(name) for name in MODULES} == shown
    assert {name for name in MODULES if (FOLDER / f'{name}.md').exists()} == {*PAGES}


def test_all_pages_are_made_after_a_missed_bar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[list[str]]()

    def run(command: list[str], **_options: object) -> CompletedProcess[str]:
        asked.append(command[command.index('bench') + 1 :])
        return CompletedProcess(command, int(len(asked) == 1))

    monkeypatch.setattr(subprocess, 'run', run)
    assert make_pages(tmp_path) == 1
    expected = [[name, *PAGES[name].split(), '-o', str(tmp_path / f'{name}.md')] for name in PAGES]
    assert asked == expected


@pytest.mark.parametrize('name', PAGES)
def test_result_page_has_the_bars_of_the_benchmark(name: str) -> None:
    """Otherwise the page is older than the benchmark: run it again with ``-o``."""
    shown, own = rows(name), list(bars(MODULES[name]))
    assert shown

    def equal(bar: tuple[str, str], row: tuple[str, str]) -> bool:
        return all(re.fullmatch(*pair) for pair in zip(bar, row, strict=True))

    text = (FOLDER / f'{name}.md').read_text(encoding='utf-8')
    tables = [
        [cell.strip() for cell in head.strip('|').split('|')]
        for head in re.findall(r'^(\|.*\|)\n\| -', text, re.MULTILINE)
    ]
    for wanted in heads(MODULES[name]):
        assert any(
            len(head) == len(wanted) and all(map(re.fullmatch, wanted, head)) for head in tables
        ), wanted
    assert [bar for bar in own if not any(equal(bar, row) for row in shown)] == []
    used = set().union(*map(imported, MODULES[name])) - {*MODULES[name]}
    every = [*own, *bars(sorted(used))]
    unknown = ('phase of the moon', '<= 7 parsec')
    accepted = [row for row in (*shown, unknown) if any(equal(bar, row) for bar in every)]
    assert accepted == shown
