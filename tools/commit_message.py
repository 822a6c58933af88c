# SPDX-License-Identifier: Apache-2.0
"""
Check commit messages: subject of at most 60 characters, blank line, body with the reason.

``python -m tools.commit_message FILE`` checks the message in a file, as a commit-msg hook does;
without a file the commits of the repository since the rule are checked.
"""

from __future__ import annotations

from pathlib import Path
from shutil import which
import subprocess
import sys
from typing import Final

#: Longest subject [characters].
LONGEST: Final = 60

#: Earlier commits are not checked. A date is known in a shallow clone, too.
_SINCE: Final = '2026-11-27T02:00:00Z'


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


def messages(folder: Path) -> dict[str, str] | None:
    """Return the messages of the checked commits by hash; None if a folder is no repository."""
    if not (folder / '.git').exists() or (git := which('git')) is None:
        return None
    words = 'log', '--no-merges', f'--since={_SINCE}', '--format=%h%n%B%x00'
    listed = subprocess.run(
        [git, '-C', str(folder), *words], check=True, capture_output=True, encoding='utf-8'
    )
    parts = (part.lstrip().partition('\n') for part in listed.stdout.split('\0') if part.strip())
    return {commit: message for commit, _, message in parts}


def main() -> int:
    """Check the message in a file, or the commits; return the exit status."""
    found: dict[str, str] | None
    if len(sys.argv) > 1:
        found = {'commit message': Path(sys.argv[1]).read_text('utf-8')}
    else:
        found = messages(Path(__file__).parents[1])
    if found is None:
        sys.stderr.write('commit messages are not checked: no repository, or no git\n')
    lines = [f'{one}: {fault}\n' for one, text in (found or {}).items() for fault in faults(text)]
    sys.stderr.writelines(lines)
    return int(bool(lines))


if __name__ == '__main__':
    sys.exit(main())
