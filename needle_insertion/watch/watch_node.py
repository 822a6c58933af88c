"""Node `watch`: subscribes to the topics of the page, at the least cost for the other nodes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from math import inf
import os
from time import monotonic
from typing import Any, Final

from needle_insertion.live.operator import Operator
from needle_insertion.live.waiting import waiting
from needle_insertion.watch.recorded import STREAMS
from needle_insertion.watch.scene import CONFIGURED, parameters_of
from needle_insertion.watch.view import View
from needle_ros import contract
from needle_ros.contract import Qos, Topic
from needle_ros.errors import JobError, MessageError
from needle_ros.network import domain_of, stay_local
from needle_ros.wire import read_line, read_string, Reader
from rclpy.context import Context
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node

#: Only the newest reading counts.
_NEWEST: Final = contract.SENSOR._replace(depth=1)

#: Needle and path of a picture, and those of the one before.
_LINES: Final = contract.SENSOR._replace(depth=4)

#: Longest time to plan an insertion, and time between two checks for the answer of a node [s].
_PLANNED: Final = 60.0
_LOOK: Final = 0.01

#: Events that are worked off at a time: the rest waits.
_EVENTS: Final = 50

#: A burst at the start: every node says something.
_SAID: Final = contract.SENSOR._replace(depth=50)


class WatchNode(Node):
    """
    Brings the newest of every topic to a view, when it is asked to.

    It is not spun: messages wait in the middleware, which keeps the newest ones only, and `poll`
    takes these. It asks for best effort, so that nobody waits for it or sends anything again, and
    it publishes nothing.

    Parameters
    ----------
    view : View
        Where the messages go.
    context : Context
        Context of the node.

    """

    def __init__(self, view: View, context: Context) -> None:
        super().__init__(
            'watch', context=context, enable_rosout=False, start_parameter_services=False
        )
        self._view = view
        self._takers: list[tuple[Callable[[], Iterator[Any]], Callable[[Any, float], None]]] = []
        for topic in STREAMS:
            read = Reader(topic.type_name).read

            def take(data: bytes, now: float, name: str = topic.name, read: Any = read) -> None:
                view.reading(name, read(data), now)

            self._listen(topic, _NEWEST, take)
        self._listen(
            contract.NEEDLE_SHAPE, _LINES, lambda data, now: view.line(*read_line(data), now)
        )
        for node in CONFIGURED:
            topic = replace(contract.CONFIGURATION, name=f'{node}/configuration')
            self._listen(topic, contract.LATCHED, partial(self._configured, node))
        self._listen(
            contract.TIP_EXPECTED, _NEWEST, lambda said, _: view.expected(said), raw=False
        )
        self._listen(contract.DIAGNOSTICS, _SAID, self._told, raw=False)

    def _listen(
        self,
        topic: Topic,
        qos: Qos,
        take: Callable[[Any, float], None],
        *,
        raw: bool = True,
    ) -> None:
        """Keep what comes on a topic until it is taken."""
        self._takers.append((waiting(self, topic, qos, raw=raw), take))

    def _configured(self, node: str, data: bytes, _now: float) -> None:
        self._view.configuration(node, parameters_of(read_string(data)))

    def _told(self, array: Any, now: float) -> None:
        for status in array.status:
            self._view.status(status, now)

    def poll(self, now: float) -> None:
        """
        Take what has come.

        Parameters
        ----------
        now : float
            Time of a steady clock [s].

        """
        for come, take in self._takers:
            for message in come():
                try:
                    take(message, now)
                except MessageError:  # noqa: PERF203
                    self._view.invalid += 1


class Buttons:
    """
    Requests of the buttons of the page, through an `Operator`.

    Parameters
    ----------
    context : Context
        Context of its node.

    """

    def __init__(self, context: Context) -> None:
        self._node = Node(
            'watch_control', context=context, enable_rosout=False, start_parameter_services=False
        )
        self._operator = Operator(self._node)
        self._executor = EventsExecutor(context=context)
        self._executor.add_node(self._node)

    def spin(self) -> None:
        """Receive the answers of nodes."""
        for _ in range(_EVENTS):
            self._executor.spin_once(timeout_sec=0.0)

    async def target(self, x: float, y: float, z: float) -> tuple[bool, str]:
        """
        Send a target of the tip.

        Parameters
        ----------
        x, y, z : float
            The target [m].

        Returns
        -------
        bool, str
            Whether it is accepted, and the answer of the node.

        Raises
        ------
        JobError
            If there is no answer.

        """
        # One of them is the `WatchNode` of this process.
        if self._node.count_subscribers(contract.TARGET.name) < 2:
            raise JobError('no node takes targets: start a controller or the node steering')
        pending = self._operator.target(x, y, z)
        await self._spin_until(lambda: pending.done, 'the target', _PLANNED)
        return pending.outcome

    async def _spin_until(self, done: Callable[[], bool], what: str, timeout: float = inf) -> None:
        """Spin the node until a request is answered."""
        end = monotonic() + timeout
        while not done():
            if monotonic() > end:
                raise JobError(f'no answer to {what} within {timeout:g} s')
            await asyncio.sleep(_LOOK)
            self.spin()

    async def ask(self, what: str) -> tuple[bool, str]:
        """
        Call the services of a request.

        Parameters
        ----------
        what : str
            A key of `needle_insertion.live.requests.REQUESTS`.

        Returns
        -------
        bool, str
            Whether it was executed, and the answers of the nodes.

        """
        answer = self._operator.ask(what)
        # Without an answer it is done, too.
        await self._spin_until(answer.done, what)
        success, words = answer.result()
        return bool(success), str(words)

    def end(self) -> None:
        """Leave the graph."""
        self._executor.remove_node(self._node)
        self._executor.shutdown()
        self._node.destroy_node()


@contextmanager
def watching(*, control: bool) -> Iterator[tuple[View, Callable[[float], None], Buttons | None]]:
    """
    Join the graph of the user, to watch it.

    Parameters
    ----------
    control : bool
        Whether there are buttons.

    Yields
    ------
    View
        What is seen.
    callable
        Brings what has come to the view.
    Buttons or None
        What the buttons do.

    """
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
