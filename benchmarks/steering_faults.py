# SPDX-License-Identifier: Apache-2.0
"""
Effect of faults on a steered insertion: each message and node, each kind, each phase.

A cell is a steered insertion in simulated time in which one message or one node has a fault from a
phase of the insertion on, see `steering_graph`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import product
from math import inf, isfinite
from typing import Final, NamedTuple

from benchmarks.message_faults import ARRIVALS, DELAYS, MESSAGES, places, THEN, TopicFault
from benchmarks.steering_graph import AIM, GraphFault, SteeringGraph, World
from benchmarks.steering_nodes import (
    CALLS,
    COMMAND,
    DIRECT,
    GraphNode,
    HARDWARE,
    NODES,
    RATE,
    RESPONSE,
    ROBOT,
    ROBOTS,
    SERVERS,
    SETTINGS,
    SPEED,
)
from needle_controller.steering.motion_control import BRAKING
from needle_ros.contract import EMERGENCY_STOP, TARGET
from needle_ros.event_log import Severity
from needle_ros.status import SteeringPhase as Phase
from needle_ros.system_state import CLEAR_STOP, Mode, PAUSE, RESUME, RETRACT, RETRACT_DEPTH, STOP
from needle_ros.timing import NANOSECONDS
import numpy as np

#: Phases in which a fault begins. `braking` is after a stop by a user.
REST, GUIDING, INSERTING, LOOKING, LAST, BRAKED = PHASES = (
    'at rest', 'guiding', 'inserting', 'measuring', 'last measurement', 'braking',
)  # fmt: skip

#: Duration of a fault of messages that does not last until the end, while inserting [s].
_BRIEF: Final = 0.5

#: Target that is sent during an insertion [m].
_CHANGED: Final = (AIM[0] + 3e-4, AIM[1], AIM[2])

#: Position of the guide before an insertion, if its return is the phase [m].
_ASIDE: Final = 1e-3

#: Rest: largest change of a position within a time [m, s].
_STILL, _AT_REST = 5e-5, 0.3

#: Time from a request with a fault to the one of another user [s].
_LATER: Final = 0.5

#: Observation after a fault, and longest time to rest [s].
_WATCHED, _LONGEST = 0.6, 20.0

#: Largest distance of the tip from the target without a warning [m].
_HIT: Final = 1e-3

#: Motion after a stop: braking within 0.2 s from the highest speed, and two periods [m].
BRAKING_DISTANCE: Final = SPEED * (0.5 * BRAKING + 2.0 / RATE)

#: Outcomes of an insertion.
OUTCOMES: Final = ('hit', 'warning', 'stopped', 'paused', 'retracted', 'ended')
MISSED, RESTLESS, IGNORED = 'miss without a warning', 'no rest', 'request not executed'

#: Largest motion into the tissue after a clearance: nothing moves [m].
_NOTHING: Final = 1e-4

#: Tolerances of the end of a retraction: depth and guide [m].
_WITHDRAWN: Final = 5e-4

#: Faults of nodes, with their duration [s].
NODE_FAULTS: Final = {
    'stopped': inf, 'killed': inf, 'restarted': 0.5, 'paused for 0.3 s': 0.3,
    'paused for 1.5 s': 1.5,
}  # fmt: skip

#: Faults by which a driver misreads position commands: it moves against every command, also
#: against a stop.
_MISREAD: Final = ('biased by 3 N or mm', 'a thousandfold', 'a thousandth', 'opposite direction')


class SteeringCell(NamedTuple):
    """A fault of a message or node (`place`), its phase and its duration [s]."""

    robot: str
    continuous: bool
    place: str
    fault: str
    phase: str
    lasts: float = inf


@dataclass(frozen=True, slots=True)
class SteeringResult:
    """
    Outcome of a steered insertion with a fault.

    Attributes
    ----------
    outcome : str
        One of `OUTCOMES`: on the target, done with a warning, stopped, ended otherwise at rest;
        `MISSED` or `RESTLESS`.
    miss : float
        Distance of the tip from its target at the end [m].
    advance : float
        Motion into the tissue after the stop [m].
    deepest : float
        Largest depth beyond the target depth [m].
    travel : float
        Distance that the guide travels from the start of the fault on [m].
    load : float
        Largest lateral force of the guide from then on [N].
    safe : float
        Time from the start of the fault to rest, if the insertion does not reach its target [s].

    """

    outcome: str
    miss: float
    advance: float
    deepest: float
    travel: float
    load: float
    safe: float


def cells() -> list[SteeringCell]:
    """Return all cells."""
    found = []
    for robot, continuous, phase in product(ROBOTS, (False, True), PHASES):
        for place in places(robot):
            faults = MESSAGES[place]
            found += [SteeringCell(robot, continuous, place, fault, phase) for fault in faults]
            if phase == INSERTING and word_of(place) is None:
                found += [
                    SteeringCell(robot, continuous, place, fault, phase, _BRIEF)
                    for fault in faults
                ]
        found += [
            SteeringCell(robot, continuous, place, fault, phase, lasts)
            for place, (fault, lasts) in product(NODES[robot], NODE_FAULTS.items())
        ]
    return found


def word_of(place: str) -> str | None:
    """Return the request of a user that a message transmits, None without one."""
    if place.startswith(EMERGENCY_STOP.name):
        return STOP
    return CALLS.get(place.removeprefix(RESPONSE), (None,))[0]


def later_word(cell: SteeringCell) -> str | None:
    """Return the request of another user that follows the one with the fault, None without."""
    _, _, word = cell.fault.partition(THEN)
    return word or None


def arrives(cell: SteeringCell) -> float:
    """Return the time until a request of a user arrives at the first node [s]."""
    some = cell.place.startswith(RESPONSE) or ' to ' in cell.place
    return 0.0 if some else ARRIVALS.get(cell.fault.partition(THEN)[0], 0.0)


def allowed(cell: SteeringCell) -> float:
    """Return the largest motion into the tissue after a stop or request [m]; both may be late."""
    word = word_of(cell.place)
    if word is not None:
        if later_word(cell):
            return BRAKING_DISTANCE
        if word == CLEAR_STOP and cell.phase != BRAKED:
            return _NOTHING
        late = word != CLEAR_STOP and (cell.phase != BRAKED)
        return BRAKING_DISTANCE + (SPEED * arrives(cell) if late else 0.0)
    if cell.robot == DIRECT and cell.place == ROBOT and cell.fault != 'stopped':
        # No stop reaches this robot: it follows its trajectory, at most to the end.
        path = AIM[1] if cell.continuous else SETTINGS.step_length
        return BRAKING_DISTANCE + min(path, SPEED * cell.lasts)
    if cell.place != COMMAND:
        return BRAKING_DISTANCE
    if cell.robot == HARDWARE and cell.fault in _MISREAD:
        return inf
    return BRAKING_DISTANCE + SPEED * DELAYS.get(cell.fault, 0.0)


def _reach(graph: SteeringGraph, phase: str) -> None:
    """Run until a phase of the insertion begins."""
    for _ in range(round(_AT_REST * RATE)):
        graph.step()
    if phase == REST:
        return
    graph.target()
    before = graph.world
    while True:
        graph.step()
        world, now = graph.world, graph.phase
        moved = np.hypot(*np.subtract(world.guide, before.guide)) > _STILL
        before = world
        middle = graph.continuous or world.depth > 0.3 * AIM[1]
        if {
            GUIDING: now is Phase.GUIDING and moved and middle,
            LOOKING: now is Phase.MEASURING and middle,
            LAST: now is Phase.MEASURING and world.depth > AIM[1] - _HIT,
        }.get(phase, now is Phase.INSERTING and world.depth > 0.5 * AIM[1]):
            return
        if now in (Phase.STOPPED, Phase.DONE):
            raise RuntimeError(f'{phase} is not reached: {now}, {graph.steering.loop.fault}')


class _Observer:
    """Motion of needle and guide since the start of a fault."""

    def __init__(self, graph: SteeringGraph) -> None:
        self._graph, self._begin = graph, graph.now
        self._before = graph.world
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=round(_AT_REST * RATE))
        self.moved, self.stopped_at = graph.now, inf
        self.advance = self.travel = self.load = 0.0
        self.deepest = -inf

    @property
    def elapsed(self) -> float:
        """Time since the start of the fault [s]."""
        return (self._graph.now - self._begin) / NANOSECONDS

    @property
    def safe(self) -> float:
        """Time from the start of the fault to the last motion [s]."""
        return (self.moved - self._begin) / NANOSECONDS

    def stop(self) -> None:
        """Measure the motion from now on: the fault is detected."""
        if not isfinite(self.stopped_at):
            self.stopped_at = self._before.depth

    def restart(self) -> None:
        """Measure the motion from now on, instead of from the time before."""
        self.stopped_at, self.advance = self._before.depth, 0.0

    def update(self) -> None:
        """Process a step of the graph."""
        world: World = self._graph.world
        self.travel += float(np.hypot(*np.subtract(world.guide, self._before.guide)))
        self.load = max(self.load, world.load)
        self.deepest = max(self.deepest, world.depth - AIM[1])
        self.advance = max(self.advance, world.depth - self.stopped_at)
        self._before = world
        self._recent.append((world.depth, *world.guide))
        if np.ptp(self._recent, axis=0).max() > _STILL:
            self.moved = self._graph.now

    @property
    def rests(self) -> bool:
        """Whether needle and guide have rested for a while."""
        return (self._graph.now - self.moved) / NANOSECONDS >= _AT_REST


def _begin_fault(graph: SteeringGraph, cell: SteeringCell) -> None:
    """Begin the fault, and the request of the user in its phase or message."""
    if cell.place in MESSAGES:
        graph.fault = TopicFault(cell.place, MESSAGES[cell.place][cell.fault])
    else:
        node = graph.nodes[cell.place]
        if cell.fault == 'stopped':
            node.stop(graph.now)
        elif cell.fault.startswith('paused'):
            node.paused = True
        else:
            node.runs = False
    word = word_of(cell.place)
    if cell.phase == REST and word is not None:
        graph.target()
    if cell.place.startswith(EMERGENCY_STOP.name):
        graph.post(EMERGENCY_STOP.name, True)
    elif word is not None:
        graph.call(cell.place.removeprefix(RESPONSE))
    elif cell.phase == BRAKED:
        servers = [graph.nodes[name] for name in SERVERS if name in graph.nodes]
        running = [one for one in reversed(servers) if one.runs and not one.paused]
        running[0].request(STOP, graph.now)
    elif cell.phase == REST or cell.place == TARGET.name:
        graph.target(AIM if cell.phase == REST else _CHANGED)


def _end_fault(graph: SteeringGraph, cell: SteeringCell) -> None:
    graph.fault = GraphFault()
    node: GraphNode | None = graph.nodes.get(cell.place)
    if node is not None and node.paused:
        node.resume(graph.now)
    elif node is not None:
        node.start()


def _prepare(graph: SteeringGraph, cell: SteeringCell) -> None:
    """Reach the phase of a fault, and the state that a request of a user ends."""
    _reach(graph, cell.phase)
    before = {CLEAR_STOP: STOP, RESUME: PAUSE}.get(word_of(cell.place) or '')
    if before is None and cell.phase == BRAKED and word_of(cell.place):
        before = STOP
    if before is not None:
        graph.steering.request(before, graph.now)
        for _ in range(0 if cell.phase == BRAKED else round(_WATCHED * RATE)):
            graph.step()


def measure(cell: SteeringCell) -> SteeringResult:
    """Simulate an insertion with a fault."""
    guide = _ASIDE if cell.continuous and cell.phase == GUIDING else 0.0
    graph = SteeringGraph(cell.robot, continuous=cell.continuous, guide=guide)
    _prepare(graph, cell)
    seen = _Observer(graph)
    _begin_fault(graph, cell)
    word = word_of(cell.place)
    judged = cell.phase == BRAKED if word is None else word != RESUME and isfinite(arrives(cell))
    if judged:
        seen.stop()
    ended, later = False, later_word(cell)
    while seen.elapsed < _LONGEST:
        if not ended and seen.elapsed >= cell.lasts:
            ended = True
            _end_fault(graph, cell)
        if later is not None and seen.elapsed >= _LATER:
            seen.restart()
            graph.steering.request(later, graph.now)
            later = None
        graph.step()
        seen.update()
        if graph.reason:
            seen.stop()
        least = _WATCHED + (cell.lasts if isfinite(cell.lasts) else 0.0)
        if word is not None and isfinite(arrives(cell)):
            least += 1.0 + _LATER
        if seen.rests and seen.elapsed > least and not _is_busy(graph):
            break
    return _result(graph, seen, cell)


def _is_busy(graph: SteeringGraph) -> bool:
    """Whether an insertion or retraction is under way, or a request waits for its answer."""
    loop, phase, called = graph.steering.loop, graph.phase, graph.called
    waits = graph.pending is not None and not graph.pending.done
    waits = waits or (called is not None and called.waits)
    if phase is None or graph.mode is Mode.PAUSED:
        return waits
    return waits or loop.steers or loop.busy or phase is Phase.RETRACTING


def _result(graph: SteeringGraph, seen: _Observer, cell: SteeringCell) -> SteeringResult:
    loop = graph.steering.loop
    aim = AIM
    if loop.law is not None:
        x, z = np.asarray(loop.law.target).tolist()
        aim = x, AIM[1], z
    miss = float(np.linalg.norm(np.subtract(graph.world.tip, aim)))
    outcome = _outcome(graph, cell, miss)
    if not seen.rests or _is_busy(graph):
        outcome = RESTLESS
    return SteeringResult(
        outcome, miss, seen.advance, seen.deepest, seen.travel, seen.load,
        0.0 if outcome in ('hit', 'warning') else inf if outcome == RESTLESS else seen.safe,
    )  # fmt: skip


def _outcome(graph: SteeringGraph, cell: SteeringCell, miss: float) -> str:
    wanted = {STOP: Mode.STOPPED, PAUSE: Mode.PAUSED, RETRACT: Mode.RETRACTING}
    mode = wanted.get(later_word(cell) or word_of(cell.place) or '')
    refused = cell.phase == BRAKED and later_word(cell) is None
    if graph.reason and (mode in (None, Mode.STOPPED) or refused):
        return 'stopped'
    if mode not in (None, graph.mode) and isfinite(arrives(cell)):
        return IGNORED
    if graph.mode is Mode.PAUSED:
        return 'paused'
    if graph.mode is Mode.RETRACTING:
        failed = graph.severity() is not Severity.INFO
        deep = graph.world.depth > RETRACT_DEPTH + _WITHDRAWN
        aside = np.abs(graph.world.guide).max() > _WITHDRAWN
        return IGNORED if (deep or aside) and not failed else 'retracted'
    if graph.phase is not Phase.DONE:
        return 'ended'
    if graph.severity() is not Severity.INFO:
        return 'warning'
    return 'hit' if miss <= _HIT else MISSED
