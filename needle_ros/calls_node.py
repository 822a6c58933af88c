# SPDX-License-Identifier: Apache-2.0
"""Service calls with repetition until a response."""

from dataclasses import dataclass
from time import monotonic
from typing import Any, Final

from needle_ros import requests
from needle_ros.base_node import steady_timer
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

_CHECK: Final = 0.25  #: Period of the checks [s].


@dataclass(slots=True)
class _Call:
    client: Client
    request: Any
    later: Future
    begun: float
    most: int  #: largest number of repetitions
    repeats: int = 0

    def send(self) -> None:
        answer = self.client.call_async(self.request)
        answer.add_done_callback(lambda done: self.end(done.result()))

    def end(self, result: Any = None) -> None:
        """Set the first result: a response, or None without one."""
        if not self.later.done():
            self.later.set_result(result)


class Calls:
    """Service client that repeats calls without a response; services must be idempotent."""

    def __init__(self, node: Node) -> None:
        self._calls: list[_Call] = []
        steady_timer(node, _CHECK, self._check)

    def call(self, client: Client, request: Any, *, once: bool = False) -> Future:
        """Call a service; the future has result None after `CALL_TIMEOUT` without a response."""
        made = _Call(client, request, Future(), monotonic(), 0 if once else requests.REPEATS)
        self._calls.append(made)
        made.send()
        return made.later

    def _check(self) -> None:
        now = monotonic()
        self._calls = [one for one in self._calls if not one.later.done()]
        for one in self._calls:
            elapsed = now - one.begun
            if elapsed > requests.CALL_TIMEOUT:
                one.end()
            elif one.repeats < min(one.most, int(elapsed / requests.REPEAT_AFTER)):
                one.repeats += 1
                one.send()

    def abandon(self) -> None:
        """End all calls without a response, before their clients are destroyed."""
        calls, self._calls = self._calls, []
        for one in calls:
            one.end()
