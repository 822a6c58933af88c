# SPDX-License-Identifier: Apache-2.0
"""Lifecycle service: reject invalid transitions, and defer `configure` until preparation ends."""

from collections.abc import Callable
from typing import Any, Final

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from needle_ros.preparation import Preparation
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

_CONFIGURE: Final = Transition.TRANSITION_CONFIGURE

#: Methods of a lifecycle node by transition.
_TRIGGERS: Final = {
    _CONFIGURE: LifecycleNode.trigger_configure,
    Transition.TRANSITION_CLEANUP: LifecycleNode.trigger_cleanup,
    Transition.TRANSITION_ACTIVATE: LifecycleNode.trigger_activate,
    Transition.TRANSITION_DEACTIVATE: LifecycleNode.trigger_deactivate,
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: LifecycleNode.trigger_shutdown,
    Transition.TRANSITION_INACTIVE_SHUTDOWN: LifecycleNode.trigger_shutdown,
    Transition.TRANSITION_ACTIVE_SHUTDOWN: LifecycleNode.trigger_shutdown,
}


class LifeCycle:
    """Handler of the `change_state` service; that of rclpy ends at an invalid transition."""

    def __init__(
        self, node: LifecycleNode, preparation: Preparation, is_valid: Callable[[], bool]
    ) -> None:
        self._node, self._preparation, self._is_valid = node, preparation, is_valid
        self._waiting: Callable[[], object] | None = None  #: Called after the preparation.
        self._later: ChangeState.Response | None = None  #: Deferred response.
        self._header: Any = None  #: Header of its request.
        service: Any = node._service_change_state
        self._send = service.send_response
        service.callback, service.send_response = self._on_request, self._on_response

    def when_prepared(self, act: Callable[[], object]) -> None:
        """Call `act` after the preparation: immediately if complete, else from the executor."""
        # With invalid parameters, `configure` fails at once.
        if self._preparation.is_complete or not self._is_valid():
            act()
            return
        self._waiting = act
        if self._preparation.is_running:
            return

        def wake() -> None:
            executor = self._node.executor
            if executor is not None:
                executor.create_task(self._resume)

        self._preparation.start(wake)

    def _resume(self) -> None:
        act, self._waiting = self._waiting, None
        if act is not None:
            act()

    def _on_request(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        machine, log = self._node._state_machine, self._node.get_logger()
        valid = {label: number for number, label, *_ in machine.available_transitions}
        asked = request.transition
        number = valid.get(asked.label, 0) if asked.label else asked.id
        if number not in valid.values():
            log.error(
                f'transition {asked.label or asked.id} is not valid in state '
                f'{machine.current_state[1]}; valid are {", ".join(valid) or "none"}'
            )
        elif number != _CONFIGURE or self._preparation.is_complete:
            response.success = self._trigger(number)
        elif self._waiting is not None:
            log.error(f'configure is under way: {self._preparation.progress}')
        else:
            self._later = response
            self.when_prepared(self._configure)
        return response

    def _on_response(self, response: ChangeState.Response, header: Any) -> None:
        """Send a response, unless it is deferred; the executor calls this."""
        if response is self._later:
            self._header = header
        else:
            self._send(response, header)

    def _configure(self) -> None:
        response, self._later = self._later, None
        if response is None:
            return
        # The node may have been shut down meanwhile.
        if self._node._state_machine.current_state[1] == 'unconfigured':
            response.success = self._trigger(_CONFIGURE)
        self._send(response, self._header)

    def _trigger(self, transition: int) -> bool:
        done = _TRIGGERS[transition](self._node)
        return bool(done == TransitionCallbackReturn.SUCCESS)
