# SPDX-License-Identifier: Apache-2.0
"""
Write CHANGELOG.rst, in the format of REP-132, from the releases in CHANGELOG.md.

The tools that release ROS packages read CHANGELOG.rst only. Unreleased changes are not in it, so
that it changes with a release only.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import sys
from typing import Final
import xml.etree.ElementTree as ET

ROOT: Final = Path(__file__).parents[1]
TARGET: Final = ROOT / 'CHANGELOG.rst'

_RELEASE: Final = re.compile(r'^## (\d+\.\d+\.\d+) - (\d{4}-\d{2}-\d{2})\n', re.MULTILINE)
_CODE: Final = re.compile(r'(`[^`]*`)')
_LINK: Final = re.compile(r'\[([^]]*)\]\([^)]*\)')


def written(markdown: str, package: str) -> str:
    """Return the text of CHANGELOG.rst for the text of CHANGELOG.md."""
    head = f'Changelog for package {package}'
    rule = '^' * len(head)
    _, *parts = _RELEASE.split(markdown)
    lines = [rule, head, rule]
    for version, date, text in zip(parts[::3], parts[1::3], parts[2::3], strict=True):
        title = f'{version} ({date})'
        lines += ['', title, '-' * len(title), *_items(text)]
    return '\n'.join(lines) + '\n'


def _items(markdown: str) -> Iterator[str]:
    """Yield one line for each change: section, subject, and the text of the change."""
    section = subject = ''
    for block in re.split(r'\n(?=- |#|[A-Z])|\n\n', markdown):
        text = ' '.join(block.split())
        if text.startswith('### '):
            section, subject = text.removeprefix('### '), ''
        elif text.startswith('- '):
            label = ', '.join(part for part in (section, subject) if part)
            yield f'* {label}: {_converted(text.removeprefix("- "))}'
        elif text:
            subject = text.rstrip(':')


def _converted(markdown: str) -> str:
    """Return a line with the marks of reStructuredText; links keep their text."""
    parts = _CODE.split(_LINK.sub(r'\1', markdown))
    return ''.join(
        # Other text must not be read as a mark.
        f'`{part}`' if part.startswith('`') else re.sub(r'([*_|\\])', r'\\\1', part)
        for part in parts
    )


def main() -> int:
    """Write the file, or compare it with ``--check``; return the exit status."""
    manifest = ET.parse(ROOT / 'package.xml')  # noqa: S314
    text = written((ROOT / 'CHANGELOG.md').read_text('utf-8'), manifest.findtext('name') or '')
    if '--check' not in sys.argv:
        TARGET.write_text(text, encoding='utf-8')
    elif not TARGET.is_file() or TARGET.read_text('utf-8') != text:
        sys.stderr.write('CHANGELOG.rst is not up to date: run python -m tools.changelog\n')
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
