# SPDX-License-Identifier: Apache-2.0
"""Check a commit message: subject of at most 60 characters, blank line, body with the reason."""

from __future__ import annotations

from pathlib import Path
import sys
from typing import Final

#: Longest subject [characters].
LONGEST: Final = 60


def faults(message: str) -> list[str]:
    """Return the rules that a message breaks."""
    lines = [line for line in message.splitlines() if not line.startswith('#')]
    subject, *rest = lines or ['']
    if subject.startswith(('Merge ', 'Revert ')):
        return []
    found = []
    if not subject.strip():
        found.append('the subject is empty')
    if len(subject) > LONGEST:
        found.append(f'the subject has {len(subject)} characters, the limit is {LONGEST}')
    if subject.endswith('.'):
        found.append('the subject ends with a period')
    if rest and rest[0].strip():
        found.append('the second line is not blank')
    if not any(line.strip() for line in rest):
        found.append('a body with the reason is missing')
    return found


def main() -> int:
    """Check the message in a file, as a commit-msg hook does; return the exit status."""
    if len(sys.argv) != 2:
        sys.stderr.write('usage: python -m tools.commit_message FILE\n')
        return 2
    found = faults(Path(sys.argv[1]).read_text('utf-8'))
    sys.stderr.writelines(f'commit message: {fault}\n' for fault in found)
    return int(bool(found))


if __name__ == '__main__':
    sys.exit(main())
