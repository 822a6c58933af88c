"""What a node has to say: lines for the log, and when /diagnostics have changed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import IntEnum
from math import inf
from time import monotonic
from typing import Final

from needle_ros.errors import printable

#: Shortest time between two lines of one kind [s].
_PAUSE: Final = 1.0


class Severity(IntEnum):
    """How bad a state is; the numbers are the levels of DiagnosticStatus."""

    INFO = 0
    WARNING = 1
    ERROR = 2

    @property
    def level(self) -> bytes:
        """The level, as DiagnosticStatus has it."""
        return bytes([self])


class Journal:
    """
    Collects what there is to say until somebody takes it.

    Parameters
    ----------
    steady : callable
        Returns the time of a clock that never jumps [s].

    Attributes
    ----------
    refused : int
        Number of inputs refused.
    complaint : str
        Why the last one was, or what was last wrong with the motion.
    changed : bool
        Whether there is anything to take.

    """

    def __init__(self, steady: Callable[[], float] = monotonic) -> None:
        self.refused = 0
        self.complaint = ''
        self.changed = False
        self._steady = steady
        self._lines: list[tuple[Severity, str]] = []
        self._told: dict[str, float] = {}
        self._left_out: Counter[str] = Counter()

    def say(self, severity: Severity, line: str = '', kind: str = '') -> None:
        """
        Say a line, if any, and tell that /diagnostics changed: at most once a second of a kind.

        The next line of a kind says how many have been left out.

        Parameters
        ----------
        severity : Severity
            How bad it is.
        line : str
            The line; '' only tells of the change.
        kind : str
            What is said at most once a second; '' for what is always said.

        """
        if kind:
            now = self._steady()
            if now - self._told.get(kind, -inf) < _PAUSE:
                self._left_out[kind] += 1
                return
            self._told[kind] = now
            more = self._left_out.pop(kind, 0)
            line = f'{line} ({more} more like it)' if line and more else line
        if line:
            self._lines.append((severity, printable(line)))
        self.changed = True

    def refuse(self, complaint: str) -> None:
        """
        Say what was not taken, and why; count it.

        Parameters
        ----------
        complaint : str
            What was not taken, and why.

        """
        self.refused += 1
        self.complaint = printable(complaint)
        # Those of one topic or service begin alike.
        self.say(Severity.ERROR, complaint, f'refused {complaint.partition(" ")[0]}')

    def take(self) -> list[tuple[Severity, str]]:
        """Return what was said since the last call."""
        lines, self._lines, self.changed = self._lines, [], False
        return lines
