# SPDX-License-Identifier: Apache-2.0
"""Process: the signals that end it, and its real-time scheduling."""

from __future__ import annotations

from contextlib import suppress
import os
from pathlib import Path
import signal
from types import FrameType
from typing import Any, Final

from needle_ros.errors import ParameterError

#: Signals that end a node or a command; closing a terminal sends SIGHUP.
ENDINGS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

#: Environment of a node: the threads of BLAS wait in a loop, for each other and for a free core,
#: and take several times as long on a busy machine.
ONE_THREAD: Final = {'OMP_NUM_THREADS': '1'}

HIGHEST: Final = 99  #: Highest real-time priority of Linux.


def cores() -> int:
    """Return the number of cores that this process may use, as set by `taskset` or a cluster."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class DeferredSignals:
    """
    Run the handlers of `ENDINGS` only in `handle` and after the block, of the main thread.

    An exception of a handler (KeyboardInterrupt) during the conversion of a message is lost in the
    C++ code of rclpy, which then raises RuntimeError.
    """

    def __init__(self) -> None:
        self._arrived: list[int] = []
        self._handlers: dict[signal.Signals, Any] = {}

    def __enter__(self) -> DeferredSignals:
        self._handlers = {
            one: handler for one in ENDINGS if callable(handler := signal.getsignal(one))
        }
        for one in self._handlers:
            signal.signal(one, self._defer)
        return self

    def __exit__(self, *_raised: object) -> None:
        # Once: a handler that raises may have replaced the handlers.
        handlers, self._handlers = self._handlers, {}
        for one, handler in handlers.items():
            signal.signal(one, handler)
        arrived, self._arrived = self._arrived, []
        for number in arrived:
            signal.raise_signal(number)

    def handle(self) -> None:
        """Run the handlers of the signals that have arrived."""
        if self._arrived:
            self.__exit__()
            self.__enter__()

    def _defer(self, number: int, _frame: FrameType | None) -> None:
        self._arrived.append(number)


def set_priority(priority: int) -> None:
    """Schedule all threads, which pass it on, with SCHED_FIFO and a priority; 0 ends it."""
    if not hasattr(os, 'sched_setscheduler'):
        if priority:
            raise ParameterError('realtime_priority must be 0: real-time scheduling needs Linux')
        return
    policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
    try:
        for thread in Path('/proc/self/task').iterdir():
            # It may have ended.
            with suppress(ProcessLookupError):
                os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))
    except PermissionError as error:
        raise ParameterError(
            f'realtime_priority {priority} is not permitted to this user: set the limit rtprio of '
            'the user in /etc/security/limits.conf, or realtime_priority 0'
        ) from error


def leave_realtime() -> None:
    """End the real-time scheduling of the calling thread, for a long computation."""
    if hasattr(os, 'sched_setscheduler') and os.sched_getscheduler(0) == os.SCHED_FIFO:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
