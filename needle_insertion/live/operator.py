"""What a person asks of running nodes: a target, a pause, a retreat, a stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any, Final, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from needle_insertion.live.requests import CONTROLLER, Request, REQUESTS, STEERING
from needle_ros import contract
from needle_ros.base_node import profile
from needle_ros.errors import printable
from needle_ros.publishers_node import request_stamp
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

#: Longest time to find a node that is asked for the first time [s].
_PATIENCE: Final = 1.0


class State(NamedTuple):
    """
    What a node last said of itself on /diagnostics.

    Attributes
    ----------
    level : int
        0 fine, 1 warning, 2 error.
    message : str
        Its state in one line.
    values : dict of str to str
        Values by name.
    heard : float
        When, by `time.monotonic` [s].

    """

    level: int
    message: str
    values: dict[str, str]
    heard: float

    @property
    def age(self) -> float:
        """Time since it was said [s]; a node says it every second."""
        return monotonic() - self.heard


class Outcome(NamedTuple):
    """
    What came of a request.

    Attributes
    ----------
    success : bool
        Whether it was done.
    message : str
        What the nodes said.

    """

    success: bool
    message: str


class Operator:
    """
    Asks nodes of the suite for what a person wants, and hears what they say of themselves.

    Parameters
    ----------
    node : Node
        Node of this process that speaks for it; whoever owns it spins it.

    Attributes
    ----------
    states : dict of str to State
        What each node last said, by its name without namespace.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.states: dict[str, State] = {}
        self._target = node.create_publisher(
            PointStamped, contract.TARGET.name, profile(contract.TARGET.qos)
        )
        self._clients: dict[tuple[str, str], Client] = {}
        for requests in REQUESTS.values():
            for request in requests:
                kind = Trigger if request.data is None else SetBool
                self._client(kind, request.node, request.service)
        node.create_subscription(
            DiagnosticArray,
            contract.DIAGNOSTICS.name,
            self._hear,
            profile(contract.DIAGNOSTICS.qos),
        )

    def _client(self, kind: Any, node: str, service: str) -> Client:
        if (node, service) not in self._clients:
            client = self._node.create_client(kind, f'{node}/{service}')
            self._clients[node, service] = client
        return self._clients[node, service]

    def _hear(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.states[printable(status.name.rpartition('/')[2])] = State(
                # A byte, as rclpy has it.
                int.from_bytes(status.level, 'little'),
                printable(status.message),
                {printable(one.key): printable(one.value) for one in status.values},
                monotonic(),
            )

    @property
    def aims(self) -> str:
        """Name of the node that takes targets: `steering` where it is, else `controller`."""
        return STEERING if STEERING in self.states else CONTROLLER

    def target(self, x: float, y: float, z: float) -> None:
        """
        Send a target.

        Parameters
        ----------
        x, y, z : float
            Where the tip shall be, in ``needle_entry`` [m]; without the node `steering` only the
            depth y counts.

        """
        message = PointStamped()
        message.header.frame_id = contract.ENTRY
        message.header.stamp = request_stamp(self._node)
        message.point.x, message.point.y, message.point.z = x, y, z
        self._target.publish(message)

    def ask(self, what: str) -> Future:
        """
        Ask for something without a value.

        Parameters
        ----------
        what : str
            A key of `REQUESTS`.

        Returns
        -------
        Future
            Its result is an `Outcome`. It is done at once where no node offers the service.

        """
        ready = [
            (request, client)
            for request in REQUESTS[what]
            if (client := self._clients[request.node, request.service]).service_is_ready()
        ]
        if not ready:
            return _done(Outcome(False, f'no node offers {_names(REQUESTS[what])}'))
        return _gathered(
            {
                request.node: client.call_async(
                    Trigger.Request()
                    if request.data is None
                    else SetBool.Request(data=request.data)
                )
                for request, client in ready
            },
            lambda answer: Outcome(answer.success, printable(answer.message)),
        )

    def set(self, node: str, name: str, value: Any) -> Future:
        """
        Set a parameter of a node.

        Parameters
        ----------
        node : str
            Name of the node.
        name : str
            Name of the parameter.
        value : object
            Its value.

        Returns
        -------
        Future
            Its result is an `Outcome`. It is done at once where there is no such node.

        """
        client = self._client(SetParameters, node, 'set_parameters')
        # It may have been made just now, and know nothing yet.
        if not client.wait_for_service(timeout_sec=_PATIENCE):
            return _done(Outcome(False, f'no node {node}'))
        parameter = Parameter(name, value=value).to_parameter_msg()

        def read(answer: SetParameters.Response) -> Outcome:
            (result,) = answer.results
            return Outcome(result.successful, printable(result.reason))

        request = SetParameters.Request(parameters=[parameter])
        return _gathered({node: client.call_async(request)}, read)


def _names(requests: tuple[Request, ...]) -> str:
    return ' or '.join(f'{request.node}/{request.service}' for request in requests)


def _done(outcome: Outcome) -> Future:
    future = Future()
    future.set_result(outcome)
    return future


def _gathered(answers: Mapping[str, Future], read: Callable[[Any], Outcome]) -> Future:
    """Return one outcome of all answers, when the last has come."""
    gathered = Future()

    def on_answer(_: Future) -> None:
        if gathered.done() or not all(answer.done() for answer in answers.values()):
            return
        outcomes = {node: read(answer.result()) for node, answer in answers.items()}
        words = '; '.join(f'{node}: {one.message or "done"}' for node, one in outcomes.items())
        gathered.set_result(Outcome(all(one.success for one in outcomes.values()), words))

    for answer in answers.values():
        answer.add_done_callback(on_answer)
    return gathered
