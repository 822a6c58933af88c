# SPDX-License-Identifier: Apache-2.0
"""
Check that each source file names its license in its first line, after a line for its interpreter.

``--write`` inserts the missing lines. The identifier is the license of package.xml.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import subprocess
import sys
from typing import Final
import xml.etree.ElementTree as ET

ROOT: Final = Path(__file__).parents[1]

#: Start and end of a comment, by the ending of the name; other files have those of Python.
COMMENTS: Final = {
    '.js': ('// ', ''),
    '.css': ('/* ', ' */'),
    # Templates of reports: the report of a user does not have this license.
    '.html': ('{# ', ' #}'),
    '.xml': ('<!-- ', ' -->'),
    '.xacro': ('<!-- ', ' -->'),
}

#: First lines that precede everything else.
FIRST: Final = '#!', '<?xml'

#: Files of others and recordings; sros2 includes parts of a policy with their comments.
EXCLUDED: Final = (
    'bags/',
    'config/security/',
    'test/data/',
    'needle_insertion/watch/page/watch.html',
)

_PATTERNS: Final = (
    '*.py', '*.yaml', '*.yml', '*.toml', '*.rviz', 'scripts', 'Dockerfile', 'Makefile',
    *(f'*{ending}' for ending in COMMENTS),
)  # fmt: skip


def license_line(ending: str = '.py') -> str:
    """Return the line with the license of package.xml, for a file with this ending."""
    name = ET.parse(ROOT / 'package.xml').findtext('license')  # noqa: S314
    before, after = COMMENTS.get(ending, ('# ', ''))
    return f'{before}SPDX-License-Identifier: {name}{after}\n'


def sources() -> Iterator[Path]:
    """Yield the tracked source files."""
    listed = subprocess.run(
        ['git', 'ls-files', '-z', *_PATTERNS],  # noqa: S607
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in listed.stdout.split('\0'):
        if name and not name.startswith(EXCLUDED):
            yield ROOT / name


def licensed(text: str, line: str) -> str:
    """Return the text of a file with the line of its license."""
    first, end, rest = text.partition('\n')
    if not first.startswith(FIRST):
        return text if text.startswith(line) else line + text
    return text if rest.startswith(line) else first + end + line + rest


def main() -> int:
    """List the files without a license, or write it; return the exit status."""
    status = 0
    for path in sources():
        line, text = license_line(path.suffix), path.read_text('utf-8')
        if (changed := licensed(text, line)) != text:
            if '--write' in sys.argv:
                path.write_text(changed, encoding='utf-8')
            else:
                status = 1
                sys.stderr.write(
                    f'{path.relative_to(ROOT)} has no license: python -m tools.license --write\n'
                )
    return status


if __name__ == '__main__':
    sys.exit(main())
