# SPDX-License-Identifier: Apache-2.0
"""
Process pool without shared queues, robust against killed workers.

The pools of the standard library and of joblib give all workers one queue: a worker that is killed
while it holds its lock, or writes a long result, blocks the others or the parent forever. Here
each worker has a pipe, which the kernel closes when the worker ends; a new worker gets the job.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
import os
import pickle
import signal
from threading import Lock, Thread
from traceback import format_exc
from typing import Any, Final, ParamSpec, TypeVar

from needle_ros.errors import JobError

_TRIES: Final = 10  #: Number of lost workers after which a job fails.

_P = ParamSpec('_P')
_T = TypeVar('_T')


class _WorkerError(Exception):
    """Traceback of an exception in a worker, used as its cause."""

    def __str__(self) -> str:
        return f'\n{self.args[0]}'


class _Worker:
    def __init__(self) -> None:
        context = get_context('spawn')
        self._pipe, end = context.Pipe()
        self.process = context.Process(target=_work, args=(end,), daemon=True)
        # A copy of the worker end in this process would keep the pipe open after the worker.
        with end:
            self.process.start()

    def run(self, job: bytes) -> bytes:
        """Return the pickled result of a job; EOFError or OSError if the worker ends earlier."""
        self._pipe.send_bytes(job)
        return self._pipe.recv_bytes()

    def end(self) -> int:
        """Kill the worker; return its exit code."""
        self.process.kill()
        self.process.join()
        self._pipe.close()
        return self.process.exitcode or 0


class _Pool(ThreadPoolExecutor):
    """Threads that pass each job to a worker, and wait for the result or the end of the worker."""

    def __init__(self, workers: int) -> None:
        super().__init__(workers)
        self._guard = Lock()
        self._workers = set[_Worker]()
        self._idle = list[_Worker]()
        self._open = True

    def submit(
        self, function: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs
    ) -> Future[_T]:
        return super().submit(self._run, function, *args, **kwargs)

    def _run(self, *job: Any, **kwargs: Any) -> Any:
        """Execute a job, and repeat it in a new worker after the loss of a worker."""
        data = pickle.dumps((job, kwargs))
        code = 0
        for _ in range(_TRIES):
            worker = self._take()
            try:
                answer = worker.run(data)
            except (EOFError, OSError):
                with self._guard:
                    self._workers.remove(worker)
                code = worker.end()
                continue
            with self._guard:
                self._idle.append(worker)
            result, error, trace = pickle.loads(answer)  # noqa: S301
            if error is not None:
                raise error from _WorkerError(trace)
            return result
        reason = f'by {signal.Signals(-code).name}' if code < 0 else f'with status {code}'
        raise JobError(
            f'{_TRIES} worker processes ended in a row without a result, the last one {reason}'
        )

    def _take(self) -> _Worker:
        with self._guard:
            if not self._open:
                raise JobError('the pool of worker processes has ended')
            if self._idle:
                return self._idle.pop()
            worker = _Worker()
            self._workers.add(worker)
            return worker

    def end(self) -> None:
        """Kill all workers: waiting threads return, and no new worker starts."""
        self.shutdown(wait=False, cancel_futures=True)
        with self._guard:
            self._open = False
            for worker in self._workers:
                worker.process.kill()
        self.shutdown()
        for worker in self._workers:
            worker.end()


@contextmanager
def processes(workers: int) -> Iterator[Executor]:
    """
    Start a pool of at most `workers` processes; each is started when the first job needs it.

    A job must be a pure function: it is executed again if its worker is killed, and raises
    `JobError` after the loss of 10 workers. Workers are spawned, ignore SIGINT, and end with this
    process, also after SIGKILL. The end of the context kills or cancels all jobs.
    """
    pool = _Pool(workers)
    try:
        yield pool
    finally:
        pool.end()


def _work(pipe: Connection) -> None:
    # Only the parent handles Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A busy worker does not read its pipe, and would outlive a killed parent.
    Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(_answer(pipe.recv_bytes()))


def _answer(data: bytes) -> bytes:
    """Return the pickled result of a job, or its exception with the traceback."""
    try:
        (function, *args), kwargs = pickle.loads(data)  # noqa: S301
        return pickle.dumps((function(*args, **kwargs), None, ''))
    except BaseException as error:  # noqa: BLE001
        return pickle.dumps((None, error, format_exc()))


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
