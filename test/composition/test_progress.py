"""What a long job shows: its activity and the time since its start."""

import io
from threading import Event

from needle_insertion.experiment import progress
from needle_insertion.experiment.progress import Progress
import pytest


class Terminal(io.StringIO):
    """A terminal that tells when something was written to it."""

    def __init__(self) -> None:
        super().__init__()
        self.written = Event()

    def isatty(self) -> bool:
        """Tell that it is one."""
        return True

    def write(self, text: str) -> int:
        """Write."""
        self.written.set()
        return super().write(text)


def test_where_there_is_no_terminal_each_activity_is_a_line() -> None:
    """Numbers that change within an activity are none; the last line says how it ended."""
    stream = io.StringIO()
    with Progress('insertion', stream) as show:
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


def test_a_job_that_fails_says_so() -> None:
    stream = io.StringIO()
    with pytest.raises(KeyError), Progress('insertion', stream):
        raise KeyError
    assert stream.getvalue().splitlines()[-1] == 'insertion: failed, 0 s'


def test_on_a_terminal_it_is_one_line_that_goes_on_by_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is written again while the job is busy with something else."""
    monkeypatch.setattr(progress, '_UPDATE', 0.01)
    stream = Terminal()
    with Progress('insertion', stream) as show:
        show('inserting', 0.35)
        for _ in range(3):
            stream.written.clear()
            assert stream.written.wait(10.0)
    text = stream.getvalue()
    assert text.count('\n') == 1
    assert text.endswith('\n')
    assert text.count('inserting 35 %') >= 2
    assert all('insertion' in part for part in text.split('\r\033[K')[1:])
