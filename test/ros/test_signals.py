# SPDX-License-Identifier: Apache-2.0
"""Signals that are handled after an event."""

import os
import signal
from types import FrameType

from needle_ros.process import cores, DeferredSignals
import pytest


def test_handlers_run_after_an_event_and_may_replace_handlers() -> None:
    """A handler that ends the process ignores all further signals, also after the block."""

    def end(_number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, end)

    def interrupt() -> None:
        with DeferredSignals() as signals:
            signal.raise_signal(signal.SIGTERM)
            reached.append(signals)
            signals.handle()

    reached: list[DeferredSignals] = []
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupt()
        assert reached
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, previous)


def test_signal_before_the_end_of_the_block_is_handled() -> None:
    """Handlers are those of before the block again."""
    received: list[int] = []
    previous = signal.signal(signal.SIGTERM, lambda number, _frame: received.append(number))
    try:
        before = signal.getsignal(signal.SIGTERM)
        with DeferredSignals():
            signal.raise_signal(signal.SIGTERM)
            assert received == []
        assert received == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGTERM) is before
    finally:
        signal.signal(signal.SIGTERM, previous)


def test_cores_are_those_that_the_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an affinity, as on macOS, all of the machine."""
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert cores() == 1
    finally:
        os.sched_setaffinity(0, before)
    assert cores() == len(before)
    monkeypatch.delattr(os, 'sched_getaffinity')
    assert cores() == os.cpu_count()
