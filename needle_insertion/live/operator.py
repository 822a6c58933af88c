# SPDX-License-Identifier: Apache-2.0
"""Send requests of a person to running nodes: target, pause, retraction, stop."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from geometry_msgs.msg import PointStamped
from needle_insertion.graph.messages import listen_states, target_message
from needle_insertion.live.requests import CONTROLLER, NODES, ONCE, REQUESTS, STEERING
from needle_ros import contract
from needle_ros.base_node import profile, steady_timer
from needle_ros.calls_node import Calls
from needle_ros.errors import printable
from needle_ros.publishers_node import next_stamp, request_stamp
from needle_ros.requests import no_answer, PendingRequest
from needle_ros.status import NodeReport
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

_DISCOVERY: Final = 1.0  #: Timeout of the discovery of a node at the first request [s].
_CHECK: Final = 0.1  #: Period of the checks for answers to a target [s].


class RequestOutcome(NamedTuple):
    """Result of a request: whether it was executed, and the answers of the nodes."""

    success: bool
    message: str


class Operator:
    """
    Send requests to nodes of the suite, and repeat them until they are answered.

    The owner of `node` spins it. `states` has the latest status of each node by its bare name.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._calls = Calls(node)
        #: Targets without a final answer, with their messages.
        self._sending: list[tuple[PendingRequest, PointStamped]] = []
        #: Stamp of the latest target [ns].
        self._stamp = 0
        self._target = node.create_publisher(
            PointStamped, contract.TARGET.name, profile(contract.TARGET.qos)
        )
        self._clients: dict[tuple[str, str], Client] = {}
        for service, data in REQUESTS.values():
            for name in NODES:
                self._client(Trigger if data is None else SetBool, name, service)
        self.states = listen_states(node, self._on_state)
        steady_timer(node, _CHECK, self._repeat)

    def _client(self, kind: Any, node: str, service: str) -> Client:
        if (node, service) not in self._clients:
            client = self._node.create_client(kind, f'{node}/{service}')
            self._clients[node, service] = client
        return self._clients[node, service]

    def _on_state(self, report: NodeReport) -> None:
        for pending, _ in self._sending:
            pending.take_status(report.name, report.requests)

    def _repeat(self) -> None:
        """Repeat targets without an answer; use simulated time if it is published."""
        # Before the first target: a node that has not received the time has no stamp.
        request_stamp(self._node)
        self._sending = [one for one in self._sending if not one[0].done]
        for pending, message in self._sending:
            if pending.repeat():
                self._target.publish(message)

    @property
    def aims(self) -> str:
        """Name of the node that takes targets: `steering` if it runs, else `controller`."""
        return STEERING if STEERING in self.states else CONTROLLER

    def target(self, x: float, y: float, z: float) -> PendingRequest:
        """Send a target in ``needle_entry`` [m], of which `controller` uses the depth y only."""
        self._stamp = next_stamp(self._node, self._stamp)
        message = target_message(self._stamp, (x, y, z))
        pending = PendingRequest(contract.TARGET, self._stamp, self.aims)
        self._sending.append((pending, message))
        self._target.publish(message)
        return pending

    def ask(self, word: str) -> Future:
        """Call the services of a key of `REQUESTS`; the future has a `RequestOutcome`."""
        service, data = REQUESTS[word]
        clients = {f'{name}/{service}': self._clients[name, service] for name in NODES}
        request = Trigger.Request() if data is None else SetBool.Request(data=data)
        missing = f'no node offers {" or ".join(clients)}'
        return self._call(clients, request, missing, once=word in ONCE)

    def set(self, node: str, name: str, value: Any) -> Future:
        """Set a parameter of a node; the future has a `RequestOutcome`."""
        client = self._client(SetParameters, node, 'set_parameters')
        # A new client has not discovered the service yet.
        client.wait_for_service(timeout_sec=_DISCOVERY)
        parameter = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[parameter])
        return self._call({f'{node}/set_parameters': client}, request, f'no node {node}')

    def _call(
        self, clients: Mapping[str, Client], request: Any, missing: str, *, once: bool = False
    ) -> Future:
        """Return one outcome of all calls, when the last has an answer or has failed."""
        gathered = Future()
        answers = {
            service: self._calls.call(client, request, once=once)
            for service, client in clients.items()
            if client.service_is_ready()
        }

        def on_answer(_: Future) -> None:
            if not gathered.done() and all(answer.done() for answer in answers.values()):
                found = [_outcome(name, answer.result()) for name, answer in answers.items()]
                lines = '; '.join(one.message for one in found)
                gathered.set_result(RequestOutcome(all(one.success for one in found), lines))

        for answer in answers.values():
            answer.add_done_callback(on_answer)
        if not answers:
            gathered.set_result(RequestOutcome(False, missing))
        return gathered


def _outcome(service: str, response: Any) -> RequestOutcome:
    if response is None:
        return RequestOutcome(False, no_answer(service))
    if isinstance(response, SetParameters.Response):
        (result,) = response.results
        success, words = result.successful, result.reason
    else:
        success, words = response.success, response.message
    return RequestOutcome(success, f'{service.partition("/")[0]}: {printable(words) or "done"}')
