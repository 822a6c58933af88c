# SPDX-License-Identifier: Apache-2.0
"""Event log of a node: log lines, and changes of /diagnostics."""

from collections import Counter
from collections.abc import Callable
from enum import IntEnum
from math import inf
import re
from time import monotonic
from typing import Final

from needle_ros.errors import printable

_PAUSE: Final = 1.0  #: Minimum time between two lines of the same kind [s].
_MOST_KINDS: Final = 100  #: Number of kinds after which a new reason is not its own kind.

#: A number in a line; digits in a name are none.
_NUMBER: Final = re.compile(r'(?<!\w)-?\d[\d.]*(?:e[-+]?\d+)?')


class Severity(IntEnum):
    """Severity of a state; the numbers are the levels of DiagnosticStatus."""

    INFO = 0
    WARNING = 1
    ERROR = 2

    @property
    def level(self) -> bytes:
        return bytes([self])


class EventLog:
    """Log lines until the node publishes them; `steady` is the time of a steady clock [s]."""

    def __init__(self, steady: Callable[[], float] = monotonic) -> None:
        self.rejected = 0  #: Number of rejected inputs.
        self.last_rejection = ''  #: Reason of the last rejection, or last fault of the motion.
        self.changed = False  #: Whether there are new lines or changes.
        self._steady = steady
        self._lines: list[tuple[Severity, str]] = []
        self._times: dict[str, float] = {}
        self._left_out: Counter[str] = Counter()

    def add(self, severity: Severity, line: str = '', kind: str = '') -> None:
        """Add a line (if any) and mark the change, at most once a second for a kind (if any)."""
        if kind:
            now = self._steady()
            if now - self._times.get(kind, -inf) < _PAUSE:
                self._left_out[kind] += 1
                return
            self._times[kind] = now
            more = self._left_out.pop(kind, 0)
            line = f'{line} ({more} similar omitted)' if line and more else line
        if line:
            self._lines.append((severity, printable(line)))
        self.changed = True

    def reject(self, reason: str) -> None:
        """
        Count a rejected input, and add an error line with its name and the reason.

        Reasons are of one kind if they differ in numbers only; after many, by their name.
        """
        self.rejected += 1
        self.last_rejection = printable(reason)
        kind = f'refused {_NUMBER.sub("0", self.last_rejection)}'
        if kind not in self._times and len(self._times) >= _MOST_KINDS:
            # The first word is the topic or service.
            kind = f'refused {reason.partition(" ")[0]}'
        self.add(Severity.ERROR, reason, kind)

    def take(self) -> list[tuple[Severity, str]]:
        """Return and clear the collected lines."""
        lines, self._lines, self.changed = self._lines, [], False
        return lines
