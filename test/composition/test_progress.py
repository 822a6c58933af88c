# SPDX-License-Identifier: Apache-2.0
"""Progress display of long jobs: activity and elapsed time."""

import io
from threading import Event

from needle_insertion import progress
from needle_insertion.live.screen import Screen
from needle_insertion.progress import ProgressLine
import pytest


class Terminal(io.StringIO):
    """Terminal that records the times of writes."""

    def __init__(self) -> None:
        super().__init__()
        self.written = Event()

    def isatty(self) -> bool:
        """Return True."""
        return True

    def write(self, text: str) -> int:
        """Write and record the time."""
        self.written.set()
        return super().write(text)


def test_each_activity_is_a_line_without_a_terminal() -> None:
    """Changing numbers within an activity add no lines; the last line reports the end."""
    stream = io.StringIO()
    with ProgressLine('insertion', stream) as show:
        show('starting plant: compiling 1 of 9')
        show('starting plant: compiling 2 of 9')
        show('inserting', 0.1)
        show('inserting', 0.9)
    assert stream.getvalue().splitlines() == [
        'insertion: starting, 0 s',
        'insertion: starting plant: compiling 1 of 9, 0 s',
        'insertion: inserting 10 %, 0 s',
        'insertion: done, 0 s',
    ]


def test_failed_job_is_reported() -> None:
    stream = io.StringIO()
    with pytest.raises(KeyError), ProgressLine('insertion', stream):
        raise KeyError
    assert stream.getvalue().splitlines()[-1] == 'insertion: failed, 0 s'


def test_terminal_line_is_updated_during_the_job(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line is rewritten while the job is busy."""
    monkeypatch.setattr(progress, '_UPDATE', 0.01)
    stream = Terminal()
    with ProgressLine('insertion', stream) as show:
        show('inserting', 0.35)
        for _ in range(3):
            stream.written.clear()
            assert stream.written.wait(10.0)
    text = stream.getvalue()
    assert text.count('\n') == 1
    assert text.endswith('\n')
    assert text.count('inserting 35 %') >= 2
    assert all('insertion' in part for part in text.split('\r\033[K')[1:])


def test_brief_line_is_removed_from_a_terminal_and_absent_elsewhere() -> None:
    stream, elsewhere = Terminal(), io.StringIO()
    for one in (stream, elsewhere):
        with ProgressLine('reading', one, brief=True) as show:
            show('recording 1 of 2')
    assert elsewhere.getvalue() == ''
    # Carriage return and clearing of the line.
    assert stream.getvalue().endswith('\r\033[K')
    assert '\n' not in stream.getvalue()


@pytest.mark.parametrize('stream', [io.StringIO, Terminal])
def test_a_note_is_a_line_of_its_own(stream: type[io.StringIO]) -> None:
    written = stream()
    with ProgressLine('recording', written, brief=True) as show:
        show('1 of 2')
        show.note('samples are lost')
    assert 'samples are lost\n' in written.getvalue()
    assert '1 of 2samples' not in written.getvalue()


@pytest.mark.parametrize(('output', 'shown'), [(Terminal, True), (io.StringIO, False)])
def test_position_is_shown_while_a_script_waits(
    monkeypatch: pytest.MonkeyPatch, output: type[io.StringIO], shown: bool
) -> None:
    """A person who watches a script sees the motion; a file holds the answers only."""
    stream = output()
    monkeypatch.setattr('sys.stdin', io.StringIO('wait\n'))
    monkeypatch.setattr('sys.stdout', stream)
    screen = Screen()
    screen.show('insertion 12 mm')
    screen.say('arrived')
    assert not screen.typed
    assert ('insertion 12 mm' in stream.getvalue()) == shown
    assert stream.getvalue().endswith('arrived\n')
