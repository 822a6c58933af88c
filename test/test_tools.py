# SPDX-License-Identifier: Apache-2.0
"""Checks of language, commit messages and licenses."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import pytest
from tools.commit_message import faults, LONGEST
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
