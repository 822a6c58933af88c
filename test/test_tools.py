# SPDX-License-Identifier: Apache-2.0
"""Checks of language, commit messages and licenses."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess

from hypothesis import given
from hypothesis import strategies as st
import pytest
from tools.commit_message import faults, LONGEST, messages
from tools.language import idioms, texts_of_code
from tools.license import license_line, licensed


@pytest.mark.parametrize(
    ('idiom', 'plain'),
    [
        ('What a message says of the needle.', 'Content of a needle message.'),
        (
            'How far the tip is from the one that is nominal.',
            'Distance of the tip from the prior.',
        ),
        ('joint_states does not come', 'no joint_states received within 0.5 s'),
        ('A look at the tip.', 'A tip measurement.'),
        ('It shall begin anew.', 'It must restart.'),
    ],
)
def test_idioms_are_found_and_plain_sentences_pass(idiom: str, plain: str) -> None:
    assert idioms(idiom)
    assert not idioms(plain)


def test_each_kind_of_text_in_code_is_read() -> None:
    """Docstrings, comments and messages, each with its line; short strings are keys."""
    source = (
        '"""Page."""\n# A comment.\ndef f():\n    """Doc."""\n    return "a longer text", "key"\n'
    )
    found = {(text.kind, text.line, text.content) for text in texts_of_code('a.py', source)}
    assert found == {
        ('docstring', 1, 'Page.'),
        ('comment', 2, '# A comment.'),
        ('docstring', 4, 'Doc.'),
        ('message', 5, 'a longer text'),
    }


@given(st.text(st.characters(categories=['Ll', 'Nd']), min_size=1, max_size=2 * LONGEST))
def test_only_the_length_of_a_subject_is_limited(subject: str) -> None:
    found = faults(f'{subject}\n\nReason.\n')
    assert bool(found) == (len(subject) > LONGEST)


@pytest.mark.parametrize(
    ('message', 'fault'),
    [
        ('', 'the subject is empty'),
        ('Add a law\n', 'a body with the reason is missing'),
        ('Add a law\nReason.\n', 'the second line is not blank'),
        ('Add a law.\n\nReason.\n', 'the subject ends with a period'),
        ('Add a law\n\n# a comment of Git\n', 'a body with the reason is missing'),
    ],
)
def test_invalid_commit_messages_are_rejected(message: str, fault: str) -> None:
    assert fault in faults(message)


def test_new_commits_are_checked_also_in_a_shallow_clone(tmp_path: Path) -> None:
    """Without commits before the rule; without a repository nothing is checked."""

    def git(*words: str, at: str = '2030-01-01T00:00:00Z') -> None:
        who = {
            f'GIT_{one}_{key}': 'a@b'
            for one in ('AUTHOR', 'COMMITTER')
            for key in ('NAME', 'EMAIL')
        }
        known = {**os.environ, **who, 'GIT_COMMITTER_DATE': at}
        subprocess.run(
            ['/usr/bin/env', 'git', *words],
            cwd=tmp_path,
            env=known,
            check=True,
            capture_output=True,
        )

    assert messages(tmp_path) is None
    git('init', 'old')
    git('-C', 'old', 'commit', '--allow-empty', '-m', 'Before', at='2026-01-01T00:00:00Z')
    assert messages(tmp_path / 'old') == {}
    for number in (1, 2):
        git('-C', 'old', 'commit', '--allow-empty', '-m', f'Add {number}', '-m', 'Reason.')
    git('clone', '--depth', '1', f'file://{tmp_path}/old', 'new')
    for folder, subjects in (('old', ['Add 2', 'Add 1']), ('new', ['Add 2'])):
        found = (messages(tmp_path / folder) or {}).values()
        assert [message.rstrip() for message in found] == [f'{one}\n\nReason.' for one in subjects]


@pytest.mark.parametrize(
    ('before', 'after'),
    [
        ('"""Page."""\n', '{}"""Page."""\n'),
        ('#!/usr/bin/env python3\n"""Page."""\n', '#!/usr/bin/env python3\n{}"""Page."""\n'),
        ('', '{}'),
        ('# A comment.\n', '{}# A comment.\n'),
    ],
)
def test_license_is_the_first_line_after_the_interpreter(before: str, after: str) -> None:
    """Once."""
    line = license_line()
    assert line == '# SPDX-License-Identifier: Apache-2.0\n'
    assert licensed(before, line) == after.format(line)
    assert licensed(after.format(line), line) == after.format(line)


@pytest.mark.parametrize(
    ('ending', 'line'),
    [
        ('.js', '// SPDX-License-Identifier: Apache-2.0\n'),
        ('.html', '{# SPDX-License-Identifier: Apache-2.0 #}\n'),
        ('.xacro', '<!-- SPDX-License-Identifier: Apache-2.0 -->\n'),
        ('.yaml', license_line()),
    ],
)
def test_license_is_a_comment_of_each_kind_of_file(ending: str, line: str) -> None:
    """After the declaration of XML."""
    assert license_line(ending) == line
    assert licensed('<?xml version="1.0"?>\n<a/>', line) == f'<?xml version="1.0"?>\n{line}<a/>'
