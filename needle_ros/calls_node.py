"""Calls of services that are repeated until a node answers."""

from __future__ import annotations

from dataclasses import dataclass
from time import monotonic
from typing import Any, Final

from needle_ros import status
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.task import Future

#: Time between two checks [s].
_CHECK: Final = 0.25


@dataclass(slots=True)
class _Call:
    """A call that is repeated."""

    client: Client
    request: Any
    later: Future
    begun: float
    repeats: int = 0

    def send(self) -> None:
        """Send the request; the first answer counts."""
        answer = self.client.call_async(self.request)

        def on_answer(done: Future) -> None:
            if not self.later.done():
                self.later.set_result(done.result())

        answer.add_done_callback(on_answer)


class Calls:
    """
    Calls services, and repeats each call without an answer after 1 s, three times.

    A request may so be executed twice: only services for which that is the same as once may be
    called, which all services of the suite are.

    Parameters
    ----------
    node : Node
        Node that calls; its owner spins it.

    """

    def __init__(self, node: Node) -> None:
        self._calls: list[_Call] = []
        # A simulation that is paused does not keep a caller waiting.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_CHECK, self._check, clock=steady)

    def call(self, client: Client, request: Any) -> Future:
        """
        Call a service.

        Parameters
        ----------
        client : Client
            Its client.
        request : object
            The request.

        Returns
        -------
        Future
            Its result is the response; None if the node does not answer within `CALL_TIMEOUT`.

        """
        made = _Call(client, request, Future(), monotonic())
        self._calls.append(made)
        made.send()
        return made.later

    def _check(self) -> None:
        """Repeat calls without an answer, or give them up."""
        now = monotonic()
        for one in self._calls:
            elapsed = now - one.begun
            repeats = min(status.REPEATS, int(elapsed / status.REPEAT_AFTER))
            if one.later.done():
                continue
            if elapsed > status.CALL_TIMEOUT:
                one.later.set_result(None)
            elif one.repeats < repeats:
                one.repeats += 1
                one.send()
        self._calls = [one for one in self._calls if not one.later.done()]

    def abandon(self) -> None:
        """End all calls without a response, before their clients are destroyed."""
        calls, self._calls = self._calls, []
        for one in calls:
            if not one.later.done():
                one.later.set_result(None)
