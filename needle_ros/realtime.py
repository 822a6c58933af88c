# SPDX-License-Identifier: Apache-2.0
"""Real-time scheduling of a process."""

from contextlib import suppress
import os
from pathlib import Path
from typing import Final

from needle_ros.errors import ParameterError

HIGHEST: Final = 99  #: Highest real-time priority of Linux.


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
