# SPDX-License-Identifier: Apache-2.0
"""Lifecycle service: reject invalid transitions, and prepare a node before `configure`."""

from collections.abc import Callable, Iterable, Iterator
import gc
from importlib import import_module
from threading import Thread
from typing import Any, Final, NamedTuple

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from needle_ros.services_node import answer_later
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.task import Future


class PreparationProgress(NamedTuple):
    """
    Progress of a preparation: completed steps, total steps, and name of the next step.

    After all steps it may wait for an event, the name of which is then `step`.
    """

    done: int
    total: int
    step: str

    def __str__(self) -> str:
        if self.done >= self.total:
            return f'waiting for {self.step}' if self.step else 'prepared'
        return f'preparing {self.done + 1} of {self.total} ({self.step})'


def imports(modules: Iterable[str]) -> Iterator[PreparationProgress]:
    """Import modules, one per iteration, and yield the progress."""
    names = list(modules)
    for done, name in enumerate(names):
        yield PreparationProgress(done, len(names), name)
        import_module(name)
    yield PreparationProgress(len(names), len(names), '')


class Preparation:
    """Iteration of `steps`, once, in the thread of the caller or in a separate thread."""

    def __init__(self, steps: Iterable[PreparationProgress]) -> None:
        self._steps = iter(steps)
        self.progress = PreparationProgress(0, 1, '')
        self.error: Exception | None = None  #: Error of a step.
        self._thread: Thread | None = None
        self.is_complete = False  #: Whether all steps are done, or a step failed.

    @property
    def is_running(self) -> bool:
        return self._thread is not None and not self.is_complete

    def complete(self) -> None:
        """Run the remaining steps in the calling thread; raise the error of a failed step."""
        if self._thread is not None:
            self._thread.join()
        if not self.is_complete:
            self._run()
        if self.error is not None:
            raise self.error

    def start(self, report: Callable[[], None]) -> None:
        """Run the steps in a thread, which calls `report` at the end, also after an error."""

        def work() -> None:
            # A full collection takes 0.2 s: what is loaded so far is excluded from it.
            self._run(gc.freeze)
            report()

        self._thread = Thread(target=work, name='preparation', daemon=True)
        self._thread.start()

    def _run(self, after_step: Callable[[], object] = lambda: None) -> None:
        try:
            for progress in self._steps:
                self.progress = progress
                after_step()
        # `complete` raises the error in the waiting thread.
        except Exception as error:  # noqa: BLE001
            self.error = error
        self.is_complete = True


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
        #: Deferred response, and its future.
        self._later: tuple[ChangeState.Response, Future] | None = None
        service: Any = node._service_change_state
        service.callback = self._on_request
        answer_later(service)

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
    ) -> ChangeState.Response | Future:
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
            later = Future()
            self._later = response, later
            self.when_prepared(self._configure)
            return later
        return response

    def _configure(self) -> None:
        deferred, self._later = self._later, None
        if deferred is None:
            return
        response, later = deferred
        # The node may have been shut down meanwhile.
        if self._node._state_machine.current_state[1] == 'unconfigured':
            response.success = self._trigger(_CONFIGURE)
        later.set_result(response)

    def _trigger(self, transition: int) -> bool:
        done = _TRIGGERS[transition](self._node)
        return bool(done == TransitionCallbackReturn.SUCCESS)
