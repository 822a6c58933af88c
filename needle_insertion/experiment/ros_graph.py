"""A private ROS graph: nodes as processes on a domain of their own, and nodes to watch them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
import gc
import os
from pathlib import Path
import subprocess
import time
from types import SimpleNamespace
from typing import Any, Final, IO

from domain_coordinator import domain_id
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from needle_insertion.experiment.node_process import GraphError, NodeProcess
from needle_ros.network import domain_of, LOCAL, stay_local
from needle_ros.run_node import END_WITH_PARENT
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

CONFIGURE = Transition.TRANSITION_CONFIGURE
ACTIVATE = Transition.TRANSITION_ACTIVATE
DEACTIVATE = Transition.TRANSITION_DEACTIVATE
CLEANUP = Transition.TRANSITION_CLEANUP

#: Longest start of a node, with everything to compile on a busy machine [s].
_START: Final = 180.0

#: Time after which a node is asked for its state again [s].
_ASK: Final = 0.2

#: Time in which the nodes may end by themselves at the end of a graph [s].
_PATIENCE: Final = 3.0


class Graph:
    """
    A ROS graph on a free domain, on this machine only; leaving it ends all its processes.

    Parameters
    ----------
    logs : Path
        Folder for what the nodes print.
    executor : type of executor
        Runs the nodes of this process in the thread of the caller: an error in a callback is an
        error of the caller.
    shared : bool
        Whether it is the domain of the user instead, with whoever else is on it, and open to
        other machines if the environment says so.

    """

    def __init__(
        self,
        logs: Path,
        executor: Callable[..., Executor] = EventsExecutor,
        *,
        shared: bool = False,
    ) -> None:
        self._logs = logs
        self._executor_kind = executor
        self._shared = shared
        self._processes: list[NodeProcess] = []
        self._files: list[IO[str]] = []
        self._nodes: list[Node] = []
        self._life_cycles: dict[str, Client] = {}

    def __enter__(self) -> Graph:
        # The context of this process reads the environment too.
        if self._shared:
            stay_local(os.environ)
            self._domain: AbstractContextManager[int] = nullcontext(domain_of(os.environ))
        else:
            os.environ.update(LOCAL)
            self._domain = domain_id()
        self.domain = self._domain.__enter__()
        self.environment = {
            **os.environ,
            'ROS_DOMAIN_ID': str(self.domain),
            END_WITH_PARENT: '1',
        }
        self.context = Context()
        self.context.init(domain_id=self.domain)
        self.executor = self._executor_kind(context=self.context)
        return self

    def __exit__(self, *raised: Any) -> None:
        try:
            for node in self._nodes:
                self.executor.remove_node(node)
                node.destroy_node()
            self.executor.shutdown()
            self.context.try_shutdown()
            self._nodes.clear()
            self._life_cycles.clear()
            del self.executor
            # rclpy's nodes are in reference cycles. Until these are collected DDS keeps the nodes
            # in the domain, where the next graph would find them.
            gc.collect()
            # Asked first: a recorder closes its bag.
            for started in self._processes:
                if started.process.poll() is None:
                    started.process.terminate()
            deadline = time.monotonic() + _PATIENCE
            for started in self._processes:
                with suppress(subprocess.TimeoutExpired):
                    started.process.wait(max(0.0, deadline - time.monotonic()))
        finally:
            # Kill all before waiting for any: a second interrupt may come while waiting.
            for started in self._processes:
                if started.process.poll() is None:
                    started.process.kill()
            for started in self._processes:
                started.process.wait()
            for file in self._files:
                file.close()
            self._domain.__exit__(*raised)

    def add(self, kind: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """
        Make a node in this process.

        Parameters
        ----------
        kind : callable
            Its class.
        *arguments, **options : object
            Arguments of the class, besides the context.

        Returns
        -------
        Node
            Spun by `spin_until`.

        """
        node = kind(*arguments, context=self.context, **options)
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def node(self, name: str) -> Node:
        """
        Make a plain node in this process, to watch and to command.

        Parameters
        ----------
        name : str
            Its name.

        Returns
        -------
        Node
            Spun by `spin_until`.

        """
        node: Node = self.add(Node, name)
        return node

    def latest(self, node: Node, kind: type, topic: str, qos: QoSProfile) -> SimpleNamespace:
        """
        Watch a topic for its newest message.

        Parameters
        ----------
        node : Node
            Node of this process that subscribes.
        kind : type
            Message type.
        topic : str
            Name of the topic.
        qos : QoSProfile
            Quality of service.

        Returns
        -------
        SimpleNamespace
            Its ``message`` is the newest one; None before the first.

        """
        latest = SimpleNamespace(message=None)
        node.create_subscription(kind, topic, partial(setattr, latest, 'message'), qos)
        return latest

    def start(
        self,
        name: str,
        parameters: Mapping[str, object] | None = None,
        file: Path | None = None,
    ) -> NodeProcess:
        """
        Start a node of the suite as a process.

        Parameters
        ----------
        name : str
            A key of `NODES`.
        parameters : Mapping[str, object], optional
            Parameters by name.
        file : Path, optional
            ROS parameter file; what `parameters` says counts more.

        Returns
        -------
        NodeProcess
            The process.

        """
        self._logs.mkdir(parents=True, exist_ok=True)
        # The process writes to it until the graph closes it.
        log = (self._logs / f'{name}.log').open('a', encoding='utf-8')
        self._files.append(log)
        process = NodeProcess(name, parameters or {}, self.environment, log, file)
        self._processes.append(process)
        return process

    def wait_for(self, node: Node, name: str) -> None:
        """
        Wait until a node of the suite answers a node of this process.

        Parameters
        ----------
        node : Node
            Node of this process, with all its clients.
        name : str
            Name of the other node.

        Raises
        ------
        GraphError
            If it does not.

        """
        if name in self._life_cycles:
            return
        self._life_cycles[name] = node.create_client(ChangeState, f'{name}/change_state')
        probe = node.create_client(GetState, f'{name}/get_state')
        self.spin_until(probe.service_is_ready, f'the node {name}', _START)
        # The answer to a client that the other side does not know yet is lost. Clients become
        # known in the order in which they were made: once the last has an answer, all will.
        answers: list[Future] = []
        start = time.monotonic()

        def answered() -> bool:
            if time.monotonic() - start >= len(answers):
                answers.append(probe.call_async(GetState.Request()))
            return any(answer.done() for answer in answers)

        self.spin_until(answered, f'the answer of {name}', _START)
        node.destroy_client(probe)

    def wait_active(
        self, node: Node, name: str, show: Callable[[str], object] = lambda _name: None
    ) -> None:
        """
        Wait until a node that starts by itself is active.

        Parameters
        ----------
        node : Node
            Node of this process.
        name : str
            Name of the other node.
        show : callable
            Called with the name while it is not active.

        Raises
        ------
        GraphError
            If it ends, or is not active in time.

        """
        show(name)
        self.wait_for(node, name)
        client = node.create_client(GetState, f'{name}/get_state')
        self.spin_until(client.service_is_ready, f'the node {name}', _START)
        answer = client.call_async(GetState.Request())
        sent = time.monotonic()

        def active() -> bool:
            nonlocal answer, sent
            show(name)
            if answer.done() and answer.result().current_state.id == State.PRIMARY_STATE_ACTIVE:
                return True
            if time.monotonic() - sent > _ASK:
                answer, sent = client.call_async(GetState.Request()), time.monotonic()
            return False

        self.spin_until(active, f'the activation of {name}', _START)
        node.destroy_client(client)

    def change(self, node: Node, name: str, *transitions: int) -> None:
        """
        Change the life cycle state of a node that was started without ``autostart``.

        Parameters
        ----------
        node : Node
            Node of this process that asks for it.
        name : str
            Name of the other node.
        *transitions : int
            `CONFIGURE`, `ACTIVATE`, `DEACTIVATE` or `CLEANUP`, in order.

        Raises
        ------
        GraphError
            If a transition fails.

        """
        self.wait_for(node, name)
        client = self._life_cycles[name]
        for transition in transitions:
            answer = client.call_async(ChangeState.Request(transition=Transition(id=transition)))
            self.spin_until(answer.done, f'the answer of {name}', _START)
            if not answer.result().success:
                said = [p.last_line for p in self._processes if p.name == name]
                raise GraphError(f'{name} refused to start: {"".join(said[-1:])}')

    def spin_until(
        self,
        condition: Callable[[], Any],
        what: str,
        timeout: float = 60.0,
        sign: Callable[[], object] = lambda: None,
        period: float = 0.0,
    ) -> None:
        """
        Run the nodes of this process until a condition holds.

        Parameters
        ----------
        condition : callable
            Returns whether it holds.
        what : str
            What is waited for, for the message.
        timeout : float
            Longest time to wait [s].
        sign : callable
            The time begins again whenever its result changes: a sign of progress.
        period : float
            Time between two checks of the condition [s]; 0 for one after each event, which costs
            more.

        Raises
        ------
        GraphError
            If it does not hold in time, or a process of the graph has ended.

        """
        deadline, seen = time.monotonic() + timeout, sign()
        while not condition():
            if (now := sign()) != seen:
                deadline, seen = time.monotonic() + timeout, now
            for started in self._processes:
                # A process that was interrupted on purpose ends with status 0.
                if started.process.poll() not in (None, 0) and not started.killed:
                    started.check()
            if time.monotonic() > deadline:
                raise GraphError(f'{what} did not come within {timeout:g} s')
            if period:
                self.executor.spin_until_future_complete(Future(), timeout_sec=period)
            else:
                self.executor.spin_once(timeout_sec=0.05)
