# SPDX-License-Identifier: Apache-2.0
"""
Steered insertion in simulated time: nodes connected by messages, without ROS.

Every message passes `SteeringGraph.post`, where a fault may drop, delay, repeat or change it.
"""

from __future__ import annotations

from collections.abc import Iterable
from heapq import heappop, heappush
from math import hypot
from typing import Any, Final, NamedTuple

from benchmarks.steering_nodes import (
    CONTROLLER,
    EPOCH,
    NodeNetwork,
    PERIOD,
    Posted,
    RATE,
    ROBOT,
    RobotNode,
    ROUTES,
    SimulatedController,
    SimulatedSteering,
    STEERING,
    USER,
)
from needle_dynamics.errors import InsertionDepthError
from needle_dynamics.simulated.run import Event, TRAJECTORY
from needle_ros.contract import ENTRY, GUIDE_X, TARGET
from needle_ros.event_log import Severity
from needle_ros.requests import PendingRequest
from needle_ros.status import SteeringPhase as Phase

#: Target of the tip, x, y, z [m].
AIM: Final = (5e-4, 0.031, -4e-4)


class World(NamedTuple):
    """State of needle and guide at a sample."""

    depth: float  #: insertion depth [m]
    guide: tuple[float, float]  #: position of the guide [m]
    load: float  #: lateral force of the guide on the needle [N]
    tip: tuple[float, float, float]  #: position of the tip [m]


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
        self._robot = RobotNode(self, ROBOT)
        self.controller = SimulatedController(self, CONTROLLER)
        self.steering = SimulatedSteering(self, STEERING)
        self.nodes = {one.name: one for one in (self._robot, self.controller, self.steering)}
        if guide:
            start = {'joints': [GUIDE_X], 'times': [0.1], 'positions': [[guide]], 'efforts': [[]]}
            self.run.perform(Event(TRAJECTORY, start))

    def post(self, topic: str, content: Any, sender: str = USER) -> None:
        for receiver in ROUTES[topic]:
            if receiver != sender:
                for one in self.fault.received(receiver, Posted(topic, content)):
                    self._order += 1
                    heappush(self._waiting, (self.now + one.late, self._order, receiver, one))

    def target(self, point: tuple[float, float, float] = AIM) -> None:
        """Send a target, and repeat it until it is acknowledged."""
        self._target = self.now, ENTRY, point
        self.pending = PendingRequest(TARGET, self.now, STEERING, self.steady)
        self.post(TARGET.name, self._target)

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
        self._deliver()

    def _sample(self) -> None:
        """Advance the world, and publish its measurements, unless the needle has left it."""
        if not self._left:
            try:
                self._robot.measure(self.run.take(self.now), self.now)
            except InsertionDepthError:
                self._left, self._robot.runs = True, False

    def _deliver(self) -> None:
        while self._waiting and self._waiting[0][0] <= self.now:
            _, _, receiver, posted = heappop(self._waiting)
            if receiver == USER:
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
    def phase(self) -> Phase | None:
        """Phase of the steered insertion; None while its node does not run."""
        node = self.steering
        return node.loop.phase if node.runs and not node.paused else None

    def severity(self) -> Severity:
        """Return the severity of the state of the steering executive."""
        return self.steering.loop.diagnose(self.now)[0]
