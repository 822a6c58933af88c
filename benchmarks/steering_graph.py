# SPDX-License-Identifier: Apache-2.0
"""
Steered insertion in simulated time: nodes connected by messages, without ROS.

Every message passes `SteeringGraph.post`, where a fault may drop, delay, repeat or change it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from heapq import heappop, heappush
from math import hypot
from typing import Any, Final, NamedTuple

from benchmarks.steering_nodes import (
    COMMANDER,
    CONTROLLER,
    EPOCH,
    GraphNode,
    NodeNetwork,
    NODES,
    PERIOD,
    Posted,
    RATE,
    RESPONSE,
    ROBOT,
    ROUTES,
    SimulatedController,
    SimulatedSteering,
    STEERING,
    USER,
)
from benchmarks.steering_robots import CommanderNode, RobotNode
from needle_dynamics.errors import InsertionDepthError
from needle_dynamics.simulated.run import Event, TRAJECTORY
from needle_ros.contract import ENTRY, GUIDE_X, TARGET
from needle_ros.event_log import Severity
from needle_ros.requests import PendingRequest, REPEAT_AFTER, REPEATS
from needle_ros.status import SteeringPhase as Phase
from needle_ros.system_state import CLEAR_STOP, Mode, RESUME

#: Target of the tip, x, y, z [m].
AIM: Final = (5e-4, 0.031, -4e-4)


class World(NamedTuple):
    """State of needle and guide at a sample."""

    depth: float  #: insertion depth [m]
    guide: tuple[float, float]  #: position of the guide [m]
    load: float  #: lateral force of the guide on the needle [N]
    tip: tuple[float, float, float]  #: position of the tip [m]


@dataclass(slots=True)
class ServiceCall:
    """Call of a service by a user, repeated without a response, as `Operator` does."""

    topic: str
    begun: float
    repeats: int = 0
    success: bool | None = None  #: response; None without one

    @property
    def waits(self) -> bool:
        """Whether the call has no response and will be sent again."""
        most = 0 if self.topic.startswith((RESUME, CLEAR_STOP)) else REPEATS
        return self.success is None and self.repeats < most

    def repeat(self, now: float) -> bool:
        """Return whether the call must be sent again."""
        due = self.waits and self.repeats < int((now - self.begun) / REPEAT_AFTER)
        self.repeats += due
        return due


class GraphFault:
    """Fault of messages; the base class transmits every message unchanged."""

    def received(self, _receiver: str, posted: Posted) -> Iterable[Posted]:
        """Return the messages that a receiver gets in place of a message."""
        return (posted,)


class SteeringGraph(NodeNetwork):
    """
    A steered insertion of a simulated needle, with faults.

    Parameters
    ----------
    robot : str
        One of `ROBOTS`.
    continuous : bool
        Strategy of the insertion.
    guide : float
        Position of the guide along x before the insertion [m].

    Attributes
    ----------
    now : int
        Time [ns].
    fault : GraphFault
        Fault of the messages that are sent from now on.
    nodes : dict
        Nodes by name.

    """

    def __init__(self, robot: str, *, continuous: bool, guide: float = 0.0) -> None:
        super().__init__(robot, continuous=continuous)
        self._order, self._left = 0, False
        self._waiting: list[tuple[int, int, str, Posted]] = []
        self.fault = GraphFault()
        self.pending: PendingRequest | None = None
        self._target: tuple[int, str, tuple[float, float, float]] = 0, '', AIM
        self.called: ServiceCall | None = None
        self.axis = RobotNode(self, ROBOT)
        self.steering = SimulatedSteering(self, STEERING)
        others: dict[str, type[GraphNode]] = {
            CONTROLLER: SimulatedController, COMMANDER: CommanderNode,
        }  # fmt: skip
        for name in NODES[robot]:
            own = {ROBOT: self.axis, STEERING: self.steering}.get(name)
            self.nodes[name] = own or others[name](self, name)
        if guide:
            start = {'joints': [GUIDE_X], 'times': [0.1], 'positions': [[guide]], 'efforts': [[]]}
            self.run.perform(Event(TRAJECTORY, start))
            if isinstance(commander := self.nodes.get(COMMANDER), CommanderNode):
                commander.place(GUIDE_X, guide)

    def post(self, topic: str, content: Any, sender: str = USER) -> None:
        for receiver in ROUTES[topic]:
            if receiver != sender and (receiver == USER or receiver in self.nodes):
                for one in self.fault.received(receiver, Posted(topic, content)):
                    self._order += 1
                    heappush(self._waiting, (self.now + one.late, self._order, receiver, one))

    def target(self, point: tuple[float, float, float] = AIM) -> None:
        """Send a target, and repeat it until it is acknowledged."""
        self._target = self.now, ENTRY, point
        self.pending = PendingRequest(TARGET, self.now, STEERING, self.steady)
        self.post(TARGET.name, self._target)

    def call(self, topic: str) -> None:
        """Call a service, and repeat the call until it has a response."""
        self.called = ServiceCall(topic, self.steady())
        self.post(topic, None)

    def step(self) -> None:
        """Advance by a period: sample, transmit, check."""
        self.now += PERIOD
        self._sample()
        number = (self.now - EPOCH) // PERIOD
        active = [one for one in self.nodes.values() if one.runs and not one.paused]
        for node in active:
            if number % 2 == 0:
                node.watch(self.now)
        self._deliver()
        for node in active:
            # Only nodes that still run publish.
            if node.runs and not node.paused:
                node.publish(again=number % round(RATE) == 0)
        if self.pending is not None and self.pending.repeat():
            self.post(TARGET.name, self._target)
        if self.called is not None and self.called.repeat(self.steady()):
            self.post(self.called.topic, None)
        self._deliver()

    def _sample(self) -> None:
        """Advance the world, and publish its measurements, unless the needle has left it."""
        if not self._left:
            try:
                self.axis.measure(self.run.take(self.now), self.now)
            except InsertionDepthError:
                self._left, self.axis.runs = True, False

    def _deliver(self) -> None:
        while self._waiting and self._waiting[0][0] <= self.now:
            _, _, receiver, posted = heappop(self._waiting)
            if receiver == USER and posted.topic.startswith(RESPONSE):
                if self.called is not None and self.called.success is None:
                    self.called.success = posted.content
            elif receiver == USER:
                node, status = posted.content
                if node == STEERING and self.pending is not None:
                    self.pending.take_status(node, status)
            else:
                self.nodes[receiver].receive(posted, self.now)

    @property
    def world(self) -> World:
        """State of needle and guide."""
        needle: Any = self.run.plant
        lateral = needle.insertion.needle
        x, z = lateral.guide
        return World(
            self.run.plant.depth,
            (float(x), float(z)),
            hypot(*lateral.guide_load[0].tolist()),
            tuple(lateral.tip.tolist()),
        )

    @property
    def reason(self) -> str:
        """Reason of a stop of the system in any running node, '' without a stop."""
        nodes = [one for one in self.nodes.values() if one.runs]
        return next((one.authority.reason for one in nodes if one.authority.reason), '')

    @property
    def mode(self) -> Mode:
        """Mode of the system in the first running node."""
        nodes = [one for one in self.nodes.values() if one.runs and not one.paused]
        return nodes[0].authority.mode if nodes else Mode.STOPPED

    @property
    def phase(self) -> Phase | None:
        """Phase of the steered insertion; None while its node does not run."""
        node = self.steering
        return node.loop.phase if node.runs and not node.paused else None

    def severity(self) -> Severity:
        """Return the severity of the state of the steering executive."""
        return self.steering.loop.diagnose(self.now)[0]
