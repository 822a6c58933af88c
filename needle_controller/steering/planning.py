"""Jobs that compute a plan: synchronously, or in a thread that can be cancelled."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Thread
from typing import Final, Generic, Protocol, TypeVar

from needle_ros.errors import JobError

_Result = TypeVar('_Result')
_Result_co = TypeVar('_Result_co', covariant=True)

#: Called by a job between its parts with the number of parts done and of all parts; it raises
#: `CancelledError` if the job has been cancelled.
Progress = Callable[[int, int], None]

_NOT_DONE: Final = 'the job is not done'


class CancelledError(JobError):
    """A job was cancelled."""


class Job(Protocol[_Result_co]):
    """A computation with a result."""

    @property
    def done(self) -> bool:
        """Whether it has ended, with a result or an error."""

    @property
    def fraction(self) -> float:
        """Fraction that is done, 0 to 1."""

    def result(self) -> _Result_co:
        """Return the result, or raise the error of the computation."""

    def cancel(self) -> None:
        """Cancel it; its result is not used."""


class StartJob(Protocol):
    """Starts a job: `ComputedJob`, `ThreadJob`, or another class with the same constructor."""

    def __call__(self, work: Callable[[Progress], _Result]) -> Job[_Result]:
        """Start a job that calls ``work``."""


class ComputedJob(Generic[_Result]):
    """
    A job that is computed synchronously, for simulations.

    Parameters
    ----------
    work : callable
        Computes the result.

    """

    done: Final = True
    fraction: Final = 1.0

    def __init__(self, work: Callable[[Progress], _Result]) -> None:
        self._error: Exception | None = None
        try:
            self._result = work(lambda _done, _parts: None)
        # Raised again by `result`.
        except Exception as error:  # noqa: BLE001
            self._error = error

    def result(self) -> _Result:
        if self._error is not None:
            raise self._error
        return self._result

    def cancel(self) -> None:
        """Do nothing: the job has ended."""


class ThreadJob(Generic[_Result]):
    """
    A job in its own thread.

    Parameters
    ----------
    work : callable
        Computes the result; it calls its argument between its parts.

    """

    def __init__(self, work: Callable[[Progress], _Result]) -> None:
        self._work = work
        self._cancelled, self._ended = Event(), Event()
        self._fraction = 0.0
        self._error: Exception | None = JobError(_NOT_DONE)
        # A daemon: the end of the process does not wait for it.
        Thread(target=self._run, name='plan', daemon=True).start()

    def _run(self) -> None:
        try:
            self._result = self._work(self._progress)
            self._error = None
        # Raised again by `result`, in the thread of the caller.
        except Exception as error:  # noqa: BLE001
            self._error = error
        self._ended.set()

    def _progress(self, done: int, parts: int) -> None:
        if self._cancelled.is_set():
            raise CancelledError('the job was cancelled')
        self._fraction = done / parts

    @property
    def done(self) -> bool:
        return self._ended.is_set()

    @property
    def fraction(self) -> float:
        return self._fraction

    def result(self) -> _Result:
        if self._error is not None:
            raise self._error
        return self._result

    def cancel(self) -> None:
        """Cancel it before its next part; its result is not used."""
        self._cancelled.set()
