# SPDX-License-Identifier: Apache-2.0
"""One line of progress with the elapsed time: a page with much mathematics takes seconds."""

import gc
from typing import Any

from needle_insertion.progress import ProgressLine
from sphinx.application import Sphinx


class _Progress:
    def __init__(self) -> None:
        self._line = ProgressLine('documentation')
        self._read = self._written = 0

    def start(self, *_: Any) -> None:
        self._line.__enter__()

    def read(self, *_: Any) -> None:
        self._read += 1
        self._line(f'reading page {self._read}')

    def has_read(self, *_: Any) -> None:
        # A collection of the trees of all pages takes two seconds, and finds nothing.
        gc.freeze()

    def write(self, *_: Any) -> None:
        self._written += 1
        self._line(f'writing page {self._written}')

    def end(self, _app: Sphinx, error: Exception | None) -> None:
        self._line.__exit__(error and type(error))


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the line to the events of a build."""
    progress = _Progress()
    app.connect('config-inited', progress.start)
    app.connect('source-read', progress.read)
    app.connect('env-check-consistency', progress.has_read)
    app.connect('html-page-context', progress.write)
    app.connect('build-finished', progress.end)
    return {'parallel_read_safe': False, 'parallel_write_safe': False}
