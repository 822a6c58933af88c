# SPDX-License-Identifier: Apache-2.0
"""The published result pages have the bars of the benchmarks."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
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


def bars(modules: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield names and limits of the bars of modules, as regular expressions."""
    for module in modules:
        for item in ast.walk(source(module)):
            if isinstance(item, ast.Call) and ast.unparse(item.func) == 'Bar':
                figure, _, limit, *unit = item.args
                value = limit.value if isinstance(limit, ast.Constant) else None
                shown = ANY
                if isinstance(value, float) and all(isinstance(u, ast.Constant) for u in unit):
                    shown = rf'[<>]= {value:g}( .+)?'
                yield pattern(figure), shown


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

    assert [bar for bar in own if not any(equal(bar, row) for row in shown)] == []
    used = set().union(*map(imported, MODULES[name])) - {*MODULES[name]}
    every = [*own, *bars(sorted(used))]
    assert [row for row in shown if not any(equal(bar, row) for bar in every)] == []
