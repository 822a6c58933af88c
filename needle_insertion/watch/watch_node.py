# SPDX-License-Identifier: Apache-2.0
"""Node `watch`: subscriptions of the page, with minimum load on the other nodes."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from math import inf
import os
from time import monotonic
from typing import Any, Final

from needle_controller.hardware_node import named
from needle_insertion.graph.messages import waiting
from needle_insertion.live.operator import Operator, RequestOutcome
from needle_insertion.watch.recorded import STREAMS
from needle_insertion.watch.view import CONFIGURED, View
from needle_ros import contract
from needle_ros.contract import Qos, Topic
from needle_ros.errors import JobError, MessageError, ParameterError
from needle_ros.network import check_security, domain_of, stay_local
from needle_ros.parameter_file import parameters_in
from needle_ros.status import read_reports
from needle_ros.wire import MessageReader, read_line, read_string
from rclpy.context import Context
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node

_NEWEST: Final = contract.SENSOR._replace(depth=1)  #: QoS for the newest message only
_SEVERAL: Final = contract.SENSOR  #: QoS for a topic of several publishers
_LINES: Final = contract.SENSOR._replace(depth=4)  #: QoS for needle and path of two pictures

#: Timeout of a target, including planning, and polling period of answers [s].
_PLANNED: Final = 60.0
_CHECK: Final = 0.01

#: Options of a node without a topic of its log and services of its parameters.
_QUIET: Final[dict[str, Any]] = {'enable_rosout': False, 'start_parameter_services': False}

_EVENTS: Final = 50  #: largest number of events per call

#: QoS for the burst of status messages at the start.
_STATUSES: Final = contract.SENSOR._replace(depth=50)


class WatchNode(Node):
    """
    Forward the newest message of each topic to a view on request.

    The node is not spun: `poll` takes the messages, of which the middleware keeps the newest.
    Subscriptions are best effort, so that no publisher waits, and the node publishes nothing.
    """

    def __init__(self, view: View, context: Context) -> None:
        super().__init__('watch', context=context, **_QUIET)
        self._view = view
        self._takers: dict[str, tuple[Callable[[], Iterator[Any]], Callable[[Any, float], None]]]
        self._takers = {}
        #: Topic and QoS of each measurement, and its subscription.
        self._streams: dict[str, tuple[str, Qos, Any]] = {}
        for topic in STREAMS:
            self._listen_to_robot(topic)
        self._listen(
            contract.NEEDLE_SHAPE, _LINES, lambda data, now: view.line(*read_line(data), now)
        )
        for node in CONFIGURED:
            topic = replace(contract.CONFIGURATION, name=f'{node}/configuration')
            self._listen(topic, contract.LATCHED, partial(self._configured, node))
        self._listen(
            contract.TIP_EXPECTED, _NEWEST, lambda message, _: view.expected(message), raw=False
        )
        self._listen(contract.DIAGNOSTICS, _STATUSES, self._on_diagnostics, raw=False)

    def _listen_to_robot(self, topic: Topic) -> None:
        """Subscribe to a measurement, again if the topic of the robot or its QoS has changed."""
        name, view = self._view.robot.topic(topic.name), self._view
        qos = _SEVERAL if view.lacks_joint(topic.name) else _NEWEST
        known, used, subscription = self._streams.get(topic.name, ('', qos, None))
        if (known, used) == (name, qos):
            return
        if subscription is not None:
            self.destroy_subscription(subscription)
        try:
            own = named(topic, name, topic.type_name)
        except ParameterError as error:
            own, view.robot.words = topic, str(error)
        read = MessageReader(topic.type_name).read
        self._listen(
            own, qos, lambda data, now: view.reading(topic.name, read(data), now), topic.name
        )
        self._streams[topic.name] = name, qos, [*self.subscriptions][-1]

    def _listen(
        self,
        topic: Topic,
        qos: Qos,
        take: Callable[[Any, float], None],
        name: str = '',
        *,
        raw: bool = True,
    ) -> None:
        self._takers[name or topic.name] = waiting(self, topic, qos, raw=raw), take

    def _configured(self, node: str, data: bytes, _now: float) -> None:
        self._view.configuration(node, parameters_in(read_string(data)))

    def _on_diagnostics(self, array: Any, now: float) -> None:
        for report in read_reports(array):
            self._view.report(report, now)

    def poll(self, now: float) -> None:
        """Process waiting messages at a time of a steady clock [s]."""
        for topic in STREAMS:
            self._listen_to_robot(topic)
        for waiting_messages, take in self._takers.values():
            for message in waiting_messages():
                try:
                    take(message, now)
                except MessageError:  # noqa: PERF203
                    self._view.invalid += 1


class Buttons:
    """Requests of the buttons of the page, through an `Operator` in a node of its own."""

    def __init__(self, context: Context) -> None:
        self._node = Node('watch_control', context=context, **_QUIET)
        self._operator = Operator(self._node)
        self._executor = EventsExecutor(context=context)
        self._executor.add_node(self._node)

    def spin(self) -> None:
        for _ in range(_EVENTS):
            self._executor.spin_once(timeout_sec=0.0)

    async def target(self, x: float, y: float, z: float) -> tuple[bool, str]:
        # The `WatchNode` of this process is a subscriber too.
        if self._node.count_subscribers(contract.TARGET.name) < 2:
            raise JobError('no node subscribes to target: start a controller or the node steering')
        pending = self._operator.target(x, y, z)
        await self._spin_until(lambda: pending.done, 'the target', _PLANNED)
        return pending.outcome

    async def _spin_until(self, done: Callable[[], bool], what: str, timeout: float = inf) -> None:
        end = monotonic() + timeout
        while not done():
            if monotonic() > end:
                raise JobError(f'no answer to {what} within {timeout:g} s')
            await asyncio.sleep(_CHECK)
            self.spin()

    async def ask(self, what: str) -> tuple[bool, str]:
        answer = self._operator.ask(what)
        # Ends without an answer, too.
        await self._spin_until(answer.done, what)
        outcome: RequestOutcome = answer.result()
        return outcome

    def end(self) -> None:
        self._executor.remove_node(self._node)
        self._executor.shutdown()
        self._node.destroy_node()


@contextmanager
def watching(*, control: bool) -> Iterator[tuple[View, Callable[[float], None], Buttons | None]]:
    """Join the ROS graph of the user; yield the view, a function to update it, and buttons."""
    check_security(os.environ)
    stay_local(os.environ)
    context = Context()
    context.init(domain_id=domain_of(os.environ))
    try:
        view = View()
        node = WatchNode(view, context)
        buttons = Buttons(context) if control else None

        def poll(now: float) -> None:
            node.poll(now)
            if buttons is not None:
                buttons.spin()

        yield view, poll, buttons
        if buttons is not None:
            buttons.end()
        node.destroy_node()
    finally:
        context.try_shutdown()
