# SPDX-License-Identifier: Apache-2.0
"""Run a private ROS graph: nodes as processes on their own domain, and nodes of this process."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
import gc
from itertools import filterfalse
from math import inf
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any, Final, IO

from domain_coordinator import domain_id
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from needle_insertion.nodes import NODES
from needle_ros.errors import JobError, ParameterError
from needle_ros.network import check_security, claim, domain_of, is_claimed, LOCAL, stay_local
from needle_ros.process import DeferredSignals, ONE_THREAD
from needle_ros.run_node import end, END_WITH_PARENT, INVALID_INPUT
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
import yaml

CONFIGURE = Transition.TRANSITION_CONFIGURE
ACTIVATE = Transition.TRANSITION_ACTIVATE
DEACTIVATE = Transition.TRANSITION_DEACTIVATE
CLEANUP = Transition.TRANSITION_CLEANUP

_START: Final = 180.0  #: Timeout of the start of a node, with compilation on a busy machine [s].
#: Time after which a client that is not ready for a discovered service is replaced [s].
_CLIENT: Final = 3.0
_REQUEST: Final = 0.2  #: Period of the requests for the state of a node [s].
#: Severity, time and name at the begin of a line of a log, or the word of another output.
_LOG_PREFIX: Final = re.compile(r'\[\w+\] \[[\d.]+\] \[[^]]*\]: |error: ')

_PATIENCE: Final = 3.0  #: Timeout of the clean end of the nodes, before they are killed [s].


class GraphError(JobError):
    """A node did not start, ended early, or timed out."""


class InvalidNodeError(ParameterError, GraphError):
    """A node rejected its parameters or arguments."""


class NodeProcess:
    """
    One node of the suite, a key of `NODES`, as a process.

    `environment` selects the domain, `log` receives the output of the node, and `parameters`
    override the ROS parameter file `file`. It inherits the files `inherited`, and no terminal.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, object],
        environment: Mapping[str, str],
        log: IO[str],
        file: Path | None = None,
        inherited: Sequence[int] = (),
    ) -> None:
        self.name = name
        #: Whether its end is intended or known.
        self.ended = False
        self._log = log
        settings = [] if file is None else ['--params-file', str(file)]
        for key, value in parameters.items():
            # One line of YAML, without the end-of-document mark of a bare scalar.
            text = yaml.safe_dump(value, default_flow_style=True, width=10_000).splitlines()[0]
            settings += ['-p', f'{key}:={text}']
        self.process = subprocess.Popen(
            [sys.executable, '-m', NODES[name], '--ros-args', *settings],
            env={**ONE_THREAD, **environment, END_WITH_PARENT: str(os.getpid())},
            stdout=log,
            stderr=subprocess.STDOUT,
            pass_fds=inherited,
            start_new_session=True,
        )

    def check(self) -> None:
        """
        Raise `GraphError` with the last line of output if the node has ended, once.

        `InvalidNodeError` if it has rejected its parameters.
        """
        status = self.process.poll()
        if status is not None and not self.ended:
            self.ended = True
            if status == INVALID_INPUT:
                raise InvalidNodeError(f'{self.name}: {self.last_line or "invalid parameters"}')
            raise GraphError(
                f'{self.name} ended early with status {status}: {self.last_line or "no output"}'
            )

    @property
    def last_line(self) -> str:
        """Last line of output, without time and name of the node."""
        self._log.flush()
        lines = Path(self._log.name).read_text(encoding='utf-8', errors='replace').splitlines()
        return _LOG_PREFIX.sub('', lines[-1]) if lines else ''

    def kill(self) -> None:
        self.ended = True
        self.process.kill()
        self.process.wait()

    def interrupt(self, timeout: float = 15.0) -> None:
        """End the node with SIGINT; raise `GraphError` after a timeout [s] or an error."""
        self.ended = True
        self.process.send_signal(signal.SIGINT)
        try:
            status = self.process.wait(timeout)
        except subprocess.TimeoutExpired as error:
            raise GraphError(f'{self.name} did not end within {timeout:g} s') from error
        if status != 0:
            raise GraphError(f'{self.name} ended with status {status}: {self.last_line}')


class Graph:
    """
    A ROS graph on a free domain of this machine; leaving the context ends all its processes.

    `logs` is the folder of the node output. The executor runs the nodes of this process in the
    thread of the caller, so that an error in a callback is an error of the caller. If `shared`,
    the graph claims the domain of the user, open to other machines as set in the environment.
    """

    def __init__(self, logs: Path, *, shared: bool = False) -> None:
        self._logs = logs
        self._shared = shared
        self._processes: list[NodeProcess] = []
        self._files: list[IO[str]] = []
        self._nodes: list[Node] = []
        self._domain = ExitStack()
        self._inherited: list[int] = []
        self._life_cycles: dict[str, Client] = {}

    def __enter__(self) -> Graph:
        check_security(os.environ)
        # The context of this process also reads the environment.
        if self._shared:
            stay_local(os.environ)
            self.domain = domain_of(os.environ)
            self._inherited.append(self._domain.enter_context(claim(self.domain)).fileno())
        else:
            os.environ.update(LOCAL)
            free = filterfalse(is_claimed, range(1, 101))
            self.domain = self._domain.enter_context(domain_id(partial(next, free)))
        if not {'ROS_LOG_DIR', 'ROS_HOME'} & os.environ.keys():
            # The default is in the home folder, which may be missing or not writable.
            os.environ['ROS_LOG_DIR'] = str(self._logs.absolute() / 'ros')
            self._domain.callback(os.environ.pop, 'ROS_LOG_DIR')
        self.environment = {**os.environ, 'ROS_DOMAIN_ID': str(self.domain), END_WITH_PARENT: '1'}
        self.context = Context()
        self.context.init(domain_id=self.domain)
        self.executor: Executor = EventsExecutor(context=self.context)
        return self

    def __exit__(self, *raised: Any) -> None:
        try:
            try:
                end(self.executor, self._nodes)
            finally:
                self.context.try_shutdown()
                self._nodes.clear()
                self._life_cycles.clear()
                del self.executor
                # rclpy nodes are in reference cycles. Until the cycles are collected DDS keeps the
                # nodes in the domain, where the next graph would discover them.
                gc.collect()
        finally:
            self._end_processes()

    def _end_processes(self) -> None:
        try:
            # SIGTERM first: a recorder closes its bag.
            for started in self._processes:
                started.process.terminate()
            deadline = time.monotonic() + _PATIENCE
            for started in self._processes:
                with suppress(subprocess.TimeoutExpired):
                    started.process.wait(max(0.0, deadline - time.monotonic()))
        finally:
            # Kill all before waiting: a second interrupt may arrive during the wait.
            for started in self._processes:
                started.process.kill()
            for started in self._processes:
                started.process.wait()
            for file in self._files:
                file.close()
            self._domain.close()

    def add(self, kind: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Create a node of a class in this process, spun by `spin_until`."""
        node = kind(*arguments, context=self.context, **options)
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def node(self, name: str) -> Node:
        node: Node = self.add(Node, name)
        return node

    def latest(self, node: Node, kind: type, topic: str, qos: QoSProfile) -> SimpleNamespace:
        """Subscribe to a topic; the result has the newest message, or None, as ``message``."""
        latest = SimpleNamespace(message=None)
        node.create_subscription(kind, topic, partial(setattr, latest, 'message'), qos)
        return latest

    def start(
        self, name: str, parameters: Mapping[str, object] | None = None, file: Path | None = None
    ) -> NodeProcess:
        """Start a node of `NODES` as a process; `parameters` override the ROS parameter file."""
        self._logs.mkdir(parents=True, exist_ok=True)
        # The process writes to it until the graph closes it.
        log = (self._logs / f'{name}.log').open('a', encoding='utf-8')
        self._files.append(log)
        process = NodeProcess(name, parameters or {}, self.environment, log, file, self._inherited)
        self._processes.append(process)
        return process

    def wait_for(self, node: Node, name: str) -> None:
        """Wait until a node of the suite answers a node of this process with all its clients."""
        if name not in self._life_cycles:
            # Clients are discovered in the order of their creation: when the last client receives
            # a response, the others are discovered too.
            self._life_cycles[name] = node.create_client(ChangeState, f'{name}/change_state')
            self._await_state(node, name, f'the answer of {name}', 1.0)

    def wait_active(
        self, node: Node, name: str, show: Callable[[str], object] = lambda _name: None
    ) -> None:
        """Wait until a node with automatic start is active; call `show` with its name."""
        show(name)
        self.wait_for(node, name)
        what, active = f'the activation of {name}', (State.PRIMARY_STATE_ACTIVE,)
        self._await_state(node, name, what, _REQUEST, active, lambda: show(name))

    def _await_state(
        self,
        node: Node,
        name: str,
        what: str,
        period: float,
        states: Container[int] = range(256),
        show: Callable[[], object] = lambda: None,
    ) -> None:
        """Request the state of a node at a period [s], until its state is in `states`."""
        service = f'{name}/get_state'
        clients = [node.create_client(GetState, service)]
        # A response to a client that the server has not discovered is lost.
        answers: list[Future] = []
        since, sent = time.monotonic(), -inf

        def answered() -> bool:
            nonlocal since, sent
            show()
            now = time.monotonic()
            if clients[-1].service_is_ready():
                since = now
                if now - sent >= period:
                    sent = now
                    answers.append(clients[-1].call_async(GetState.Request()))
            elif not node.count_services(service):
                since = now
            elif now - since > _CLIENT:
                # Rare: a client of rmw_fastrtps that is never ready for an active node.
                since = now
                clients.append(node.create_client(GetState, service))
            return any(one.done() and one.result().current_state.id in states for one in answers)

        self.spin_until(answered, what, _START)
        for client in clients:
            node.destroy_client(client)

    def change(self, node: Node, name: str, *transitions: int) -> None:
        """Execute lifecycle transitions of a node that was started without ``autostart``."""
        self.wait_for(node, name)
        client = self._life_cycles[name]
        for transition in transitions:
            answer = client.call_async(ChangeState.Request(transition=Transition(id=transition)))
            self.spin_until(answer.done, f'the answer of {name}', _START)
            if not answer.result().success:
                lines = [p.last_line for p in self._processes if p.name == name]
                raise GraphError(f'{name} failed to start: {"".join(lines[-1:])}')

    def spin_until(
        self,
        condition: Callable[[], Any],
        what: str,
        timeout: float = 60.0,
        sign: Callable[[], object] = lambda: None,
        period: float = 0.0,
    ) -> None:
        """
        Spin the nodes of this process until a condition holds.

        The timeout [s] restarts when the result of `sign` changes. With a `period` of 0 the
        condition is checked after each event, which costs more CPU time. Raises `GraphError` on a
        timeout, with the awaited event `what`, and if a process of the graph has ended.
        """
        deadline, last = time.monotonic() + timeout, sign()
        with DeferredSignals() as signals:
            while not condition():
                if (now := sign()) != last:
                    deadline, last = time.monotonic() + timeout, now
                for started in self._processes:
                    started.check()
                if time.monotonic() > deadline:
                    lines = [f'{one.name}: {one.last_line}' for one in self._processes]
                    waiting = f'timeout after {timeout:g} s: waiting for {what}'
                    raise GraphError('; '.join([waiting, *lines]))
                if period:
                    self.executor.spin_until_future_complete(Future(), timeout_sec=period)
                else:
                    self.executor.spin_once(timeout_sec=0.05)
                signals.handle()
