# SPDX-License-Identifier: Apache-2.0
"""
Safety file: hazards, causes, controls, requirements, their tests and the last results.

Each sentence of `PAGES` ends with an ID, and each row of a table has one: `(S-012)` is a
requirement, which a test must check, and `(N-012)` a note, which promises nothing. Headings, code
and sentences that end with a colon need none. Tests name requirements by
``@pytest.mark.requirement('S-012')``; docs/hazards.yaml assigns them to hazards and causes.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator, Mapping
import json
from pathlib import Path
import re
import sys
from typing import Any, Final, NamedTuple

import yaml

ROOT: Final = Path(__file__).parents[1]
PAGES: Final = ('docs/safety.md', 'docs/security.md')
HAZARDS: Final = 'docs/hazards.yaml'

#: Last results of the tests, written by test/conftest.py in the cache of pytest.
RESULTS: Final = 'needle/requirements'

_ID: Final = re.compile(r'\(([SN]-\d{3})\)')
_AT_END: Final = re.compile(r' \([SN]-\d{3}\)[.!?:]?[)*]{0,2}$')
_BORDER: Final = re.compile(r'[.!?][)*]{0,2}(\s+)(?=["A-Z`*\[~(])')
_CODE: Final = re.compile(r'`[^`]*`')
_LABEL: Final = re.compile(r'^\*\*[^*]+\.\*\* ')
_NAMED: Final = re.compile(r'`(?:test_\w+\.)?(test_\w+)`')
_SHOWN: Final = 60
_FUNCTIONS: Final = ast.FunctionDef, ast.AsyncFunctionDef

_HEAD: Final = """# Safety file

This page is generated from [safety](../safety.md), [security](../security.md),
`docs/hazards.yaml` and the tests.

**It is evidence of research software, not a certificate.** It lists the tests of each requirement
and their last results. No notified body has examined it, no hazard analysis of a medical device
has been made, and the software must not be used on people or animals.
"""


class Sentence(NamedTuple):
    """A sentence or a row of a table, with its place."""

    page: str
    line: int
    content: str
    #: Heads of the columns; empty for a sentence.
    heads: tuple[str, ...] = ()

    @property
    def identifiers(self) -> list[str]:
        """IDs in the sentence."""
        return _ID.findall(self.content)

    @property
    def fault(self) -> str:
        """Describe a missing or additional ID, '' if there is none."""
        if not (self.heads or self.identifiers) and self.content.endswith(':'):
            return ''
        at_end = self.heads or _AT_END.search(self.content)
        if len(self.identifiers) == 1 and at_end:
            return ''
        return (
            f'{self.page}:{self.line}: one ID is required at the end of {self.content[:_SHOWN]!r}'
        )


def sentences(page: str, text: str) -> Iterator[Sentence]:
    """Yield the sentences and the rows of tables of a page."""
    block: list[str] = []
    heads: tuple[str, ...] = ()
    begin, fenced = 0, False
    for number, line in enumerate([*text.splitlines(), ''], 1):
        content = line.strip()
        fence = content.startswith('```')
        fenced ^= fence
        row = content.startswith('|')
        ends = fenced or fence or row or not content or content.startswith(('#', '- '))
        if ends and block:
            yield from _split(page, begin, ' '.join(block))
            block = []
        if row and not heads:
            heads = _cells(content)
        elif row and not set(content) <= {*'|-: '}:
            yield Sentence(page, number, content, heads)
        elif not row:
            heads = ()
        if content and not (fenced or fence or row or content.startswith('#')):
            begin = begin if block else number
            block.append(content.removeprefix('- '))


def _split(page: str, line: int, block: str) -> Iterator[Sentence]:
    """Yield the sentences of a paragraph or a list item."""
    block = _LABEL.sub('', block)
    # A period in code ends no sentence.
    masked = _CODE.sub(lambda code: '`' + 'x' * (len(code[0]) - 2) + '`', block)
    begin = 0
    for border in [*_BORDER.finditer(masked), None]:
        end = len(block) if border is None else border.start(1)
        yield Sentence(page, line, block[begin:end])
        begin = end if border is None else border.end(1)


def _cells(row: str) -> tuple[str, ...]:
    return tuple(' '.join(cell.split()) for cell in row.strip('|').split('|'))


class NamedTest(NamedTuple):
    """A test and its requirements."""

    path: str
    name: str
    requirements: tuple[str, ...]

    def __str__(self) -> str:
        return f'{self.path}::{self.name}'


def named_tests(root: Path) -> list[NamedTest]:
    """Return all tests, with the requirements that they name."""
    found = []
    for path in sorted(root.glob('test/**/test_*.py')):
        for node in ast.walk(ast.parse(path.read_text('utf-8'))):
            if isinstance(node, _FUNCTIONS) and node.name.startswith('test_'):
                named = tuple(name for one in node.decorator_list for name in _named(one))
                found.append(NamedTest(path.relative_to(root).as_posix(), node.name, named))
    return found


def _named(decorator: ast.expr) -> Iterator[str]:
    """Yield the requirements in a decorator."""
    if isinstance(decorator, ast.Call) and ast.unparse(decorator.func).endswith('.requirement'):
        for argument in decorator.args:
            yield ast.literal_eval(argument)


class SafetyFile:
    """
    Requirements with hazards and tests; `faults` are the errors that fail the build.

    Attributes
    ----------
    identifiers : list of str
        All IDs.
    requirements : dict
        Sentence of each requirement, by ID.
    hazards : list of dict
        Content of docs/hazards.yaml: `hazard`, and its `causes` with `cause`, `control` and
        `requirements`.
    tests : dict
        Tests of each requirement, by ID.

    """

    def __init__(self, root: Path = ROOT) -> None:
        self._sentences = [
            one for page in PAGES for one in sentences(page, (root / page).read_text('utf-8'))
        ]
        content: Any = yaml.safe_load((root / HAZARDS).read_text('utf-8'))
        self.hazards: list[dict[str, Any]] = content['hazards']
        self._all_tests, self._files = named_tests(root), set(content['files'])
        self.identifiers = [name for one in self._sentences for name in one.identifiers]
        self.requirements = {
            name: one for one in self._sentences for name in one.identifiers if name[0] == 'S'
        }
        self.tests: dict[str, list[NamedTest]] = {name: [] for name in self.requirements}
        for test in self._all_tests:
            for name in test.requirements:
                self.tests.setdefault(name, []).append(test)

    @property
    def faults(self) -> list[str]:
        """Sentences without an ID, requirements without a test or hazard, and the reverse."""
        named = Counter(self.identifiers)
        assigned = Counter(
            name
            for hazard in self.hazards
            for cause in hazard['causes']
            for name in cause['requirements']
        )
        known = self.requirements
        return [
            *filter(None, (one.fault for one in self._sentences)),
            *(f'{name} is used {count} times' for name, count in named.items() if count > 1),
            *(f'{name} has no test: {known[name].content[:_SHOWN]!r}' for name in known
              if not self.tests[name]),
            *(f'{self.tests[name][0]} names {name}, which is no requirement'
              for name in self.tests if name not in known),
            *(f'{name} names {test}, which does not name {name}' for name, one in known.items()
              for test in _NAMED.findall(one.content)
              if test not in {found.name for found in self.tests[name]}),
            *(f'{test} names no requirement' for test in self._all_tests
              if test.path in self._files and not test.requirements),
            *(f'{name} must have one cause in {HAZARDS}, got {assigned[name]}' for name in known
              if assigned[name] != 1),
            *(f'{HAZARDS} names {name}, which is no requirement' for name in assigned
              if name not in known),
        ]  # fmt: skip

    def page(self, results: Mapping[str, Mapping[str, str]]) -> str:
        """Return the page; ``results`` are the last results by test, see `last_results`."""
        lines = [_HEAD]
        for hazard in self.hazards:
            lines.append(f'\n## {hazard["hazard"]}\n')
            lines += [
                '| cause | control | requirement | tests | last result |',
                '|---|---|---|---|---|',
            ]
            for cause in hazard['causes']:
                shown = cause['cause'], cause['control']
                for name in sorted(cause['requirements']):
                    tests = self.tests[name]
                    cells = (
                        *shown, f'{name}: {_plain(self.requirements[name])}',
                        '<br>'.join(f'`{test.name}`' for test in tests),
                        '<br>'.join(_result(results.get(str(test))) for test in tests),
                    )  # fmt: skip
                    lines.append(f'| {" | ".join(cells)} |')
                    shown = '', ''
        return '\n'.join(lines) + '\n'


def _plain(sentence: Sentence) -> str:
    """Return a requirement for a cell of a table, without its ID, links and tests."""
    text = re.sub(r'\[([^]]*)\]\([^)]*\)', r'\1', _ID.sub('', sentence.content))
    text = text.replace('**', '').replace(' .', '.')
    if not sentence.heads:
        return text
    first, *others = zip(sentence.heads, _cells(text), strict=True)
    named = (f'{head}: {cell}' for head, cell in others if cell and not head.startswith('test'))
    return '; '.join((first[1], *named))


def _result(result: Mapping[str, str] | None) -> str:
    return 'not run' if result is None else f'{result["outcome"]} {result["date"]}'


def last_results() -> dict[str, dict[str, str]]:
    """Return outcome and date of the last run of each test with a requirement."""
    path = ROOT / '.pytest_cache' / 'v' / RESULTS
    return json.loads(path.read_text('utf-8')) if path.exists() else {}


def main() -> int:
    """Print the faults and the next free numbers; return the exit status."""
    file = SafetyFile()
    for line in file.faults:
        sys.stdout.write(f'{line}\n')
    for kind in 'SN':
        last = max((int(name[2:]) for name in file.identifiers if name[0] == kind), default=0)
        sys.stdout.write(f'next free number: {kind}-{last + 1:03d}\n')
    return int(bool(file.faults))


if __name__ == '__main__':
    sys.exit(main())
