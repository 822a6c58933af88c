# SPDX-License-Identifier: Apache-2.0
"""
Count private idioms in the text of the project, per 1000 words.

Counts docstrings, comments, messages (strings of three words or more), names of tests, and pages.
Exit status 1 if a kind of text has more than the limit; the worst lines are printed then.
docs/glossary.md has the terms to use instead.
"""

from __future__ import annotations

import ast
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
import re
import sys
import tokenize
from typing import Final, NamedTuple

#: Largest number of idioms in 1000 words of a kind of text.
LIMIT: Final = 4.0

#: Lines that are printed of each kind above the limit.
_PRINTED: Final = 10

#: Idioms, by the term or the form that replaces them.
IDIOMS: Final = {
    'name the thing': r'what(?!\?)|whatever|whoever|wherever|whichever',
    'report, publish, return, contain': r'says?|said|tells?|told|speaks?',
    'repeat the noun': r'(?:that|those) of|(?:that|this|no|another|other|such an?) one|ones',
    'assume, estimate, prior': r'believ\w+|knows?|trusts?',
    'request, require': r'wants?|wish(?:es|ed)?|minds?',
    'arrive, receive, continue': r'comes?|came|goes on|go on|went on',
    'is missing, is invalid': r'(?:is|are|was|were) none',
    'must': r'shall',
    'distance, range, up to': r'how far|farther|farthest|(?:as|so) far as',
    'search, examine, measurement': r'look(?:s|ed)? (?:at|for|back)|a look',
    'again, additional, alone': r'anew|besides?|whence|thereof|by itself|in sight|at will',
    'invalid, duplicate, out of order, error': (
        r'absurd|strangers?|rivals?|muddled|complain(?:s|ts?)?'
    ),
}
_PATTERNS: Final = {
    term: re.compile(rf'\b(?:{words})\b', re.IGNORECASE) for term, words in IDIOMS.items()
}
_WORD: Final = re.compile(r"[A-Za-z][A-Za-z']*")
_TEST: Final = re.compile(r'\s*(?:async )?def test_(\w+)')


class Text(NamedTuple):
    """A line of text, its kind, and its place."""

    kind: str
    path: str
    line: int
    content: str


def texts_of_code(path: str, source: str) -> Iterator[Text]:
    """Yield the docstrings, comments and messages of a Python file."""
    tree, docstrings = ast.parse(source), set()
    for node in ast.walk(tree):
        if not isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        ):
            continue
        if ast.get_docstring(node, clean=False) is None:
            continue
        value = node.body[0].value  # type: ignore[attr-defined]
        docstrings.add(value)
        for k, line in enumerate(value.value.splitlines()):
            yield Text('docstring', path, value.lineno + k, line)
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and node not in docstrings
            and node.value.count(' ') >= 2
        ):
            yield Text('message', path, node.lineno, node.value)
    lines = iter(source.splitlines(keepends=True))
    for token in tokenize.generate_tokens(lambda: next(lines, '')):
        if token.type == tokenize.COMMENT:
            yield Text('comment', path, token.start[0], token.string)


def texts(root: Path) -> Iterator[Text]:
    """Yield all text of a checkout that is written by hand."""
    patterns = ('needle_*/**/*.py', 'reproduction/**/*.py', 'docs/notebooks/*.py')
    for path in sorted(chain.from_iterable(map(root.glob, patterns))):
        yield from texts_of_code(str(path.relative_to(root)), path.read_text('utf-8'))
    for path in sorted(root.glob('test/**/*.py')):
        for k, line in enumerate(path.read_text('utf-8').splitlines(), 1):
            if found := _TEST.match(line):
                name = found[1].replace('_', ' ')
                yield Text('test name', str(path.relative_to(root)), k, name)
    for pattern in ('*.md', 'docs/**/*.md', 'examples/*.md'):
        for path in sorted(root.glob(pattern)):
            # Generated pages, and the site.
            if {'results', '_build', 'api', 'repository'} & set(path.relative_to(root).parts):
                continue
            for k, line in enumerate(path.read_text('utf-8').splitlines(), 1):
                yield Text('page', str(path.relative_to(root)), k, line)


def idioms(content: str) -> list[str]:
    """Return the terms that replace the idioms of a text, one for each idiom."""
    return [term for term, pattern in _PATTERNS.items() for _ in pattern.finditer(content)]


def main() -> int:
    """Print the rate of each kind of text; return the exit status."""
    words, counts = Counter[str](), Counter[str]()
    found: defaultdict[str, list[tuple[int, Text, str]]] = defaultdict(list)
    for text in texts(Path(sys.argv[1] if len(sys.argv) > 1 else '.')):
        words[text.kind] += len(_WORD.findall(text.content))
        if terms := idioms(text.content):
            counts[text.kind] += len(terms)
            found[text.kind].append((len(terms), text, '; '.join(dict.fromkeys(terms))))
    failed = False
    for kind, number in words.items():
        rate = 1000.0 * counts[kind] / max(number, 1)
        sys.stdout.write(f'{kind:10s} {rate:5.1f} idioms per 1000 words (limit {LIMIT:g})\n')
        if rate > LIMIT:
            failed = True
            worst = sorted(found[kind], key=lambda item: -item[0])[:_PRINTED]
            for _, text, replacements in worst:
                line = ' '.join(text.content.split())[:100]
                sys.stdout.write(f'  {text.path}:{text.line}: {line} -> {replacements}\n')
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
