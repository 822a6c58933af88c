# SPDX-License-Identifier: Apache-2.0
"""Services with later responses, and the services that set the parameters of a node."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from threading import Thread
from typing import Any, NamedTuple

from needle_ros.process import leave_realtime
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter


class DeferredService:
    """
    Service whose responses may be sent after the callback; EventsExecutor awaits no coroutine.

    ``take`` receives a request and its response, and returns whether the response is complete.
    Otherwise `send` sends it later; within ``take`` it does nothing.
    """

    def __init__(self, service: Any, take: Callable[[Any, Any], bool]) -> None:
        self._take, self._send = take, service.send_response
        self._headers: dict[int, Any] = {}  #: Header of the request, by response.
        service.callback, service.send_response = self._on_request, self._on_response

    def _on_request(self, request: Any, response: Any) -> Any:
        if not self._take(request, response):
            self._headers[id(response)] = None
        return response

    def _on_response(self, response: Any, header: Any) -> None:
        if id(response) in self._headers:
            self._headers[id(response)] = header
        else:
            self._send(response, header)

    def send(self, response: Any) -> None:
        if (header := self._headers.pop(id(response), None)) is not None:
            self._send(response, header)


class _Change(NamedTuple):
    #: Its long checks; None where other callbacks may be executed.
    steps: Iterator[Callable[[], object] | None]
    send: Callable[[], None]


class ParameterServices:
    """
    Set parameters in the order of the requests, with their long checks in a thread.

    The services of rclpy respond in the callback, and the node does nothing else during a check.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._changes: deque[_Change] = deque()
        for service in node.services:
            if service.srv_type in (SetParameters, SetParametersAtomically):
                self._serve(service)

    def _serve(self, service: Any) -> None:

        parameter: Any = Parameter

        def take(request: Any, response: Any) -> bool:
            given = [parameter.from_parameter_msg(one) for one in request.parameters]
            if service.srv_type is SetParameters:
                steps = self._steps([[one] for one in given], response.results.append)
            else:
                steps = self._steps([given], partial(setattr, response, 'result'))
            self._changes.append(_Change(steps, partial(deferred.send, response)))
            return len(self._changes) == 1 and self._continue()

        deferred = DeferredService(service, take)

    def _steps(
        self, groups: list[list[Parameter]], keep: Callable[[SetParametersResult], None]
    ) -> Iterator[Callable[[], object] | None]:
        for k, group in enumerate(groups):
            if k > 0:
                # A whole parameter file takes long.
                yield None
            if (check := self._node.long_check(group)) is not None:
                yield check
            keep(self._node.set_parameters_atomically(group))

    def _continue(self) -> bool:
        """Continue the oldest change; return whether it is complete, or continued later."""
        for check in self._changes[0].steps:
            if check is None:
                self._continue_later()
            else:
                Thread(target=self._run, args=(check,), name='check', daemon=True).start()
            return False
        self._changes.popleft()
        return True

    def _run(self, check: Callable[[], object]) -> None:
        leave_realtime()
        try:
            check()
        finally:
            self._continue_later()

    def _continue_later(self) -> None:
        if (executor := self._node.executor) is not None:
            executor.create_task(self._resume)

    def _resume(self) -> None:
        while self._changes:
            change = self._changes[0]
            if not self._continue():
                return
            change.send()
