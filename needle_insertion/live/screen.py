# SPDX-License-Identifier: Apache-2.0
"""Read lines from a terminal or a script, and write lines to it."""

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from io import FileIO
import readline
import sys
import termios
from threading import Semaphore, Thread
from typing import Final

from needle_insertion.progress import CLEAR
from needle_ros.errors import ParameterError

_PROMPT: Final = 'needle> '


class Screen:
    """The terminal, or a script on the standard input; `typed` is True if a person types."""

    def __init__(self) -> None:
        self._terminal = bool(sys.stdout and sys.stdout.isatty())
        self.typed = self._terminal and bool(sys.stdin and sys.stdin.isatty())
        self._lines: deque[str | Exception | None] = deque()
        self._wanted = Semaphore(0)
        self._asked = self._shown = False

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Read lines in a separate thread: nodes continue while a person types."""
        before = termios.tcgetattr(sys.stdin) if self.typed else None
        Thread(target=self._read, daemon=True).start()
        try:
            yield
        finally:
            if self._shown:
                self._clear()
            if before is not None:
                # The thread may still wait for a line. A closed terminal is an error.
                with suppress(termios.error, OSError):
                    termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
                    if self._asked:
                        sys.stdout.write('\n')

    def complete(self, words: Sequence[str]) -> None:

        def complete(begin: str, number: int) -> str | None:
            found = [word for word in words if word.startswith(begin)]
            return found[number] if number < len(found) else None

        readline.set_completer(complete)
        readline.parse_and_bind('tab: complete')

    def _read(self) -> None:
        while self._wanted.acquire():
            self._lines.append(self._line())

    def _line(self) -> str | Exception | None:
        try:
            if self.typed or not sys.stdin:
                return input(_PROMPT)
            # A thread that holds the lock of a buffer would abort the end of the process.
            line = FileIO(sys.stdin.fileno(), closefd=False).readline().decode()
            return line.rstrip('\r\n') if line else None
        except EOFError:
            return None
        except (OSError, ValueError, RuntimeError) as error:
            # Unreadable input, invalid text, or no standard input.
            return error

    def ask(self) -> None:
        """Read the next line, unless it is read already."""
        if self._asked:
            return
        self._clear()
        self._asked = True
        self._wanted.release()

    @property
    def answered(self) -> bool:
        return bool(self._lines)

    @property
    def next_words(self) -> list[str]:
        """Words of the next line, if it is read."""
        return str(self._lines[0]).split() if self._lines else []

    def take(self) -> str | None:
        """Return the line, or None at the end; raise `ParameterError` if it is not text."""
        line = self._lines.popleft()
        if isinstance(line, Exception):
            raise ParameterError(f'the standard input is not readable as text: {line}')
        self._asked = False
        if self.typed:
            if line is None:
                sys.stdout.write('\n')
        elif line:
            sys.stdout.write(f'{_PROMPT}{line}\n')
        return line

    def say(self, line: str) -> None:
        """Write one or several lines above the prompt."""
        self._clear()
        sys.stdout.write(f'{line}\n{self._typed_part}')
        sys.stdout.flush()

    @property
    def _typed_part(self) -> str:
        """Prompt, and the characters that a person has typed."""
        return f'{_PROMPT}{readline.get_line_buffer()}' if self._asked and self.typed else ''

    def show(self, line: str) -> None:
        """Show a line that the next line replaces; no effect in a file or pipe."""
        if self._terminal:
            typed = self._typed_part
            sys.stdout.write(f'{CLEAR}{line}{typed and "  "}{typed}')
            sys.stdout.flush()
            self._shown = True

    def _clear(self) -> None:
        if self._shown or (self._asked and self.typed):
            sys.stdout.write(CLEAR)
        self._shown = False
