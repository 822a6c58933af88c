# SPDX-License-Identifier: Apache-2.0
"""Preparation of a node in a thread before `configure`."""

from collections.abc import Callable, Iterable, Iterator
import gc
from importlib import import_module
from threading import Thread
from typing import NamedTuple


class PreparationProgress(NamedTuple):
    """Progress of a preparation: completed steps, total steps, and name of the next step."""

    done: int
    total: int
    step: str

    def __str__(self) -> str:
        return f'preparing {self.done + 1} of {self.total} ({self.step})'


def imports(modules: Iterable[str]) -> Iterator[PreparationProgress]:
    """Import modules, one per iteration, and yield the progress."""
    names = list(modules)
    for done, name in enumerate(names):
        yield PreparationProgress(done, len(names), name)
        import_module(name)
    yield PreparationProgress(len(names), len(names), '')


class Preparation:
    """Iteration of `steps`, once, in the thread of the caller or in a separate thread."""

    def __init__(self, steps: Iterable[PreparationProgress]) -> None:
        self._steps = iter(steps)
        self.progress = PreparationProgress(0, 1, '')
        self.error: Exception | None = None  #: Error of a step.
        self._thread: Thread | None = None
        self.is_complete = False  #: Whether all steps are done, or a step failed.

    @property
    def is_running(self) -> bool:
        return self._thread is not None and not self.is_complete

    def complete(self) -> None:
        """Run the remaining steps in the calling thread; raise the error of a failed step."""
        if self._thread is not None:
            self._thread.join()
        if not self.is_complete:
            self._run()
        if self.error is not None:
            raise self.error

    def start(self, report: Callable[[], None]) -> None:
        """Run the steps in a thread, which calls `report` at the end, also after an error."""

        def work() -> None:
            # A full collection takes 0.2 s: what is loaded so far is excluded from it.
            self._run(gc.freeze)
            report()

        self._thread = Thread(target=work, name='preparation', daemon=True)
        self._thread.start()

    def _run(self, after_step: Callable[[], object] = lambda: None) -> None:
        try:
            for progress in self._steps:
                self.progress = progress
                after_step()
        # `complete` raises the error in the waiting thread.
        except Exception as error:  # noqa: BLE001
            self.error = error
        self.is_complete = True
