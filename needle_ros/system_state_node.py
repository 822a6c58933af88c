# SPDX-License-Identifier: Apache-2.0
"""System state of a node: its topic, the services of a user, and the emergency topic."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticStatus
from needle_ros import contract
from needle_ros.base_node import BaseNode, key_values, steady_timer
from needle_ros.event_log import Severity
from needle_ros.system_state import Authority, Mode, PAUSE, REQUESTS, RESUME, STOP, SystemState
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

_AGAIN: Final = 1.0  #: Period at which the state is published again [s].


class SystemStateTopics:
    """
    Publish and receive ``system_state``, and offer the requests of a user as services.

    ``request`` executes a word of `REQUESTS` and returns whether it succeeded, and a line for the
    user; ``obey`` follows a state of another node.
    """

    def __init__(
        self,
        node: BaseNode,
        authority: Authority,
        request: Callable[[str], tuple[bool, str]],
        obey: Callable[[], None],
    ) -> None:
        self._authority, self._request, self._obey = authority, request, obey
        authority.node = node.get_fully_qualified_name()
        self._publisher = node.publisher(contract.SYSTEM_STATE, always=True)
        node.subscribe(contract.SYSTEM_STATE, self._on_state)
        # A reliable subscription receives nothing from a best-effort publisher, the other one may
        # lose messages of a reliable publisher.
        for qos in (contract.COMMAND, contract.SENSOR):
            node.subscribe(replace(contract.EMERGENCY_STOP, qos=qos), self._on_emergency)
        for word in REQUESTS:
            if word not in (PAUSE, RESUME):
                node.create_service(Trigger, f'~/{word}', partial(self._answer, word))
        node.create_service(SetBool, f'~/{PAUSE}', self._on_pause)
        steady_timer(node, _AGAIN, self._publish)

    def _answer(self, word: str, _request: Any, response: Any) -> Any:
        response.success, response.message = self._request(word)
        self.publish()
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        return self._answer(PAUSE if request.data else RESUME, request, response)

    def _on_emergency(self, message: Bool) -> None:
        if message.data:
            self._request(STOP)
            self.publish()

    def _on_state(self, message: DiagnosticStatus) -> None:
        if message.name == self._authority.node:
            return
        values = {one.key: one.value for one in message.values}
        self._authority.receive(SystemState.from_values(values))
        if self._authority.changed:
            self._obey()
            self.publish()

    def publish(self) -> None:
        """Publish the state if it has changed."""
        if self._authority.changed:
            self._publish()

    def _publish(self) -> None:
        authority = self._authority
        authority.changed = False
        mode, reason = authority.mode, authority.reason
        severity = Severity.ERROR if reason else Severity.INFO
        if mode in (Mode.PAUSED, Mode.RETRACTING):
            severity = Severity.WARNING
        self._publisher.publish(
            DiagnosticStatus(
                level=severity.level,
                name=authority.node,
                message=f'{mode.value}: {reason}' if reason else mode.value,
                values=key_values(authority.state.to_values()),
            )
        )
