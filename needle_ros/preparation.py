"""Work that a node does before it is configured, in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from threading import Thread
from typing import NamedTuple


class Progress(NamedTuple):
    """
    State of a preparation.

    Attributes
    ----------
    done, total : int
        Steps that are complete, and all steps.
    step : str
        Name of the next step; '' after the last.

    """

    done: int
    total: int
    step: str

    def __str__(self) -> str:
        return f'preparing {self.done + 1} of {self.total} ({self.step})'


def imports(modules: Iterable[str]) -> Iterator[Progress]:
    """
    Import modules, one at each step of the iterator.

    Parameters
    ----------
    modules : iterable of str
        Their names.

    Yields
    ------
    Progress
        Before each step, and after the last.

    """
    names = list(modules)
    for done, name in enumerate(names):
        yield Progress(done, len(names), name)
        import_module(name)
    yield Progress(len(names), len(names), '')


class Preparation:
    """
    Steps that are taken once, by the caller or by a thread.

    Parameters
    ----------
    steps : iterable of Progress
        Taking the next element does the next step.

    Attributes
    ----------
    progress : Progress
        The latest state.
    error : Exception or None
        Error that ended it.
    is_complete : bool
        Whether all steps are done, or an error ended it.

    """

    def __init__(self, steps: Iterable[Progress]) -> None:
        self._steps = iter(steps)
        self.progress = Progress(0, 1, '')
        self.error: Exception | None = None
        self._thread: Thread | None = None
        self.is_complete = False

    @property
    def is_running(self) -> bool:
        """Whether the thread is at work."""
        return self._thread is not None and not self.is_complete

    def complete(self) -> None:
        """
        Take the steps that are left, in the thread of the caller.

        Raises
        ------
        Exception
            The error that ended it, now or earlier.

        """
        if self._thread is not None:
            self._thread.join()
        if not self.is_complete:
            self._run()
        if self.error is not None:
            raise self.error

    def start(self, report: Callable[[], None]) -> None:
        """
        Take the steps in a thread of its own.

        Parameters
        ----------
        report : callable
            Called by that thread after the last step, or an error.

        """

        def work() -> None:
            self._run()
            report()

        self._thread = Thread(target=work, name='preparation', daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            for progress in self._steps:
                self.progress = progress
        # Raised by `complete`, in the thread that waits for it.
        except Exception as error:  # noqa: BLE001
            self.error = error
        self.is_complete = True
