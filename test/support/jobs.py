# SPDX-License-Identifier: Apache-2.0
"""Jobs for worker processes, in an importable file."""

from __future__ import annotations

import os
from pathlib import Path
import signal
from threading import Event, Timer

from needle_ros.errors import ParameterError

#: Size of a result with a write time of about 0.02 s [bytes].
LARGE = 50_000_000


def divide(a: float, b: float) -> float:
    return a / b


def refuse(value: float) -> None:
    raise ParameterError(f'value must be > 0, got {value:g}')


def kill_once(marker: str, delay: float) -> bytes:
    """Return a large result; in the first call the worker is killed after a delay [s]."""
    if not Path(marker).exists():
        Path(marker).touch()
        Timer(delay, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return bytes(LARGE)


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wait_for_ever(marker: str) -> None:
    Path(marker).write_text(str(os.getpid()))
    Event().wait()
