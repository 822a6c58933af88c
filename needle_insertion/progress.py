# SPDX-License-Identifier: Apache-2.0
"""Show the progress of a long job: its activity and the elapsed time."""

from __future__ import annotations

import re
import sys
from threading import Event, Thread
from time import monotonic
from typing import Any, Final, Protocol, TextIO

#: Time between two updates on a terminal, and between two lines elsewhere [s].
_UPDATE: Final = 0.5
_LINE: Final = 10.0

CLEAR: Final = '\r\033[K'  #: Moves to the start of the line and clears it.


class Show(Protocol):
    """Callback that shows the activity of a job and the completed fraction."""

    def __call__(self, activity: str, fraction: float | None = None) -> None:
        """Show an activity in a few words, and the completed fraction."""


class ProgressLine:
    """
    Write the activity of a job with the elapsed time, also while its thread is busy.

    On a terminal it is one line that changes; elsewhere a line for each new activity, and one
    every ten seconds. A `brief` line is on a terminal only, until the job ends.
    """

    def __init__(self, title: str, stream: TextIO | None = None, *, brief: bool = False) -> None:
        self._title, self._stream, self._brief = title, stream or sys.stderr, brief
        self._terminal = self._stream.isatty()
        #: Whether nothing is written.
        self._silent = brief and not self._terminal
        self._text, self._kind = '', ''
        self._begin = self._written = monotonic()
        self._end = Event()
        self._thread = Thread(target=self._update, daemon=True)

    def __enter__(self) -> ProgressLine:
        self('starting')
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *raised: Any) -> None:
        self._end.set()
        self._thread.join()
        self._text = 'done' if kind is None else 'failed'
        self._write()
        if self._terminal:
            self._stream.write(CLEAR if self._brief else '\n')
            self._stream.flush()

    def __call__(self, activity: str, fraction: float | None = None) -> None:
        self._text = activity if fraction is None else f'{activity} {100.0 * fraction:.0f} %'
        # A changed number is not a new activity.
        before, self._kind = self._kind, re.sub(r'\d+', '', activity)
        if self._kind != before and not self._terminal:
            self._write()

    def note(self, text: str) -> None:
        """Write a line of its own."""
        clear = CLEAR if self._terminal else ''
        self._stream.write(f'{clear}{text}\n')
        self._stream.flush()

    def _update(self) -> None:
        while not self._end.wait(_UPDATE):
            if self._terminal or monotonic() - self._written >= _LINE:
                self._write()

    def _write(self) -> None:
        if self._silent:
            return
        self._written = monotonic()
        elapsed = f'{self._written - self._begin:.0f} s'
        if self._terminal:
            self._stream.write(f'{CLEAR}{self._title:30} {self._text:40} {elapsed:>6}')
        else:
            self._stream.write(f'{self._title}: {self._text}, {elapsed}\n')
        self._stream.flush()
