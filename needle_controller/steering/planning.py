# SPDX-License-Identifier: Apache-2.0
"""Jobs that compute a plan: synchronously, or in a thread that can be cancelled."""

from collections.abc import Callable
from threading import Thread
from typing import Any, Generic, TypeAlias, TypeVar

from needle_ros.errors import JobError
from needle_ros.process import leave_realtime

_Result = TypeVar('_Result')

#: Called by a job between its parts with the number of parts done and of all parts; it raises
#: `CancelledError` if the job has been cancelled.
Progress: TypeAlias = Callable[[int, int], None]


class CancelledError(JobError):
    """A job was cancelled."""


class Job(Generic[_Result]):
    """A synchronous computation with a result; ``work`` calls its argument between its parts."""

    def __init__(self, work: Callable[[Progress], _Result]) -> None:
        self._work = work
        self.fraction = 0.0  #: fraction that is done, 0 to 1
        self.done = False  #: whether it has ended, with a result or an error
        self.cancelled = False
        self._error: Exception | None = JobError('the job is not done')
        self._start()

    def _start(self) -> None:
        try:
            self._result = self._work(self._progress)
            self._error = None
        # Raised again by `result`, in the thread of the caller.
        except Exception as error:  # noqa: BLE001
            self._error = error
        self.done = True

    def _progress(self, done: int, parts: int) -> None:
        if self.cancelled:
            raise CancelledError('the job was cancelled')
        self.fraction = done / parts

    def result(self) -> _Result:
        """Return the result, or raise the error of the computation."""
        if self._error is not None:
            raise self._error
        return self._result

    def cancel(self) -> None:
        """Cancel it before its next part; its result is not used."""
        self.cancelled = True


#: Starts a job: `Job`, `ThreadJob`, or another class with the same constructor.
StartJob: TypeAlias = Callable[[Callable[[Progress], Any]], Job[Any]]


class ThreadJob(Job[_Result]):
    """A job in its own thread."""

    def _start(self) -> None:
        def run() -> None:
            leave_realtime()
            Job._start(self)

        # A daemon: the end of the process does not wait for it.
        self._thread = Thread(target=run, name='job', daemon=True)
        self._thread.start()

    def wait(self, timeout: float) -> bool:
        """Wait for the end of the job, at most `timeout` [s]; return whether it has ended."""
        self._thread.join(timeout)
        return self.done
