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
from rclpy.task import Future


def answer_later(service: Any) -> None:
    """Let the callback of a service return a future of its response."""
    # The events executor of rclpy accepts no coroutines as callbacks, and sends the value.
    send = service.send_response

    def send_later(response: Any, header: Any) -> None:
        if isinstance(response, Future):
            response.add_done_callback(lambda done: send(done.result(), header))
        else:
            send(response, header)

    service.send_response = send_later


class _Change(NamedTuple):
    #: Its long checks; None where other callbacks may be executed.
    steps: Iterator[Callable[[], object] | None]
    response: Any
    later: Future  #: of the response


class ParameterServices:
    """
    Set parameters in the order of the requests, with their long checks in a thread.

    The services of rclpy respond in the callback, and the node does nothing else during a check.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._changes: deque[_Change] = deque()
        for service in node.services:
            if service.srv_type is SetParameters:
                service.callback = self._set_each
            elif service.srv_type is SetParametersAtomically:
                service.callback = self._set_together
            else:
                continue
            answer_later(service)

    def _set_each(self, request: Any, response: Any) -> Future:
        groups = [[Parameter.from_parameter_msg(one)] for one in request.parameters]
        return self._set(groups, response.results.append, response)

    def _set_together(self, request: Any, response: Any) -> Future:
        group = [Parameter.from_parameter_msg(one) for one in request.parameters]
        return self._set([group], partial(setattr, response, 'result'), response)

    def _set(
        self,
        groups: list[list[Parameter]],
        keep: Callable[[SetParametersResult], None],
        response: Any,
    ) -> Future:
        change = _Change(self._steps(groups, keep), response, Future())
        self._changes.append(change)
        if len(self._changes) == 1:
            self._continue()
        return change.later

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

    def _continue(self) -> None:
        """Make the changes until a thread checks one, or other callbacks come first."""
        while self._changes:
            change = self._changes[0]
            for check in change.steps:
                if check is None:
                    self._continue_later()
                else:
                    Thread(target=self._run, args=(check,), name='check', daemon=True).start()
                return
            self._changes.popleft()
            change.later.set_result(change.response)

    def _run(self, check: Callable[[], object]) -> None:
        leave_realtime()
        try:
            check()
        finally:
            self._continue_later()

    def _continue_later(self) -> None:
        if (executor := self._node.executor) is not None:
            executor.create_task(self._continue)
