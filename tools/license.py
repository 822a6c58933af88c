# SPDX-License-Identifier: Apache-2.0
"""
Check that each Python file names its license in its first line, after an interpreter line.

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


def license_line(root: Path = ROOT) -> str:
    """Return the line with the license of package.xml."""
    name = ET.parse(root / 'package.xml').findtext('license')  # noqa: S314
    return f'# SPDX-License-Identifier: {name}\n'


def sources(root: Path = ROOT) -> Iterator[Path]:
    """Yield the tracked Python files: modules, and the scripts of the nodes."""
    listed = subprocess.run(
        ['git', 'ls-files', '-z', '*.py', 'scripts'],  # noqa: S607
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    yield from (root / name for name in listed.stdout.split('\0') if name)


def licensed(text: str, line: str) -> str:
    """Return the text of a file with the line of its license."""
    first, end, rest = text.partition('\n')
    if not first.startswith('#!'):
        return text if text.startswith(line) else line + text
    return text if rest.startswith(line) else first + end + line + rest


def main() -> int:
    """List the files without a license, or write it; return the exit status."""
    line = license_line()
    status = 0
    for path in sources():
        text = path.read_text('utf-8')
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
