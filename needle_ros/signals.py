# SPDX-License-Identifier: Apache-2.0
"""Signals that end a process."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any, Final

#: Signals that end a node or a command; closing a terminal sends SIGHUP.
ENDINGS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


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
