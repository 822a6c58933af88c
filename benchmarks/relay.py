# SPDX-License-Identifier: Apache-2.0
"""
Steered insertions in which one message is dropped, delayed or duplicated by a relay between nodes.

Plant, controller, steering and operator are real nodes over DDS, in lock-step. All their topics
pass through the relay, each link from one node to another separately. In each insertion one random
message of one link has a fault. The insertion must then reach its target, or stop with a message
within 5 s. Run it by ``python -m benchmarks.relay --count 200 --seed 1``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any, Final, NamedTuple

from benchmarks.random_insertions import arguments, at_target, HANGS, PLANT, repeat, STEERING
from needle_controller.controller_node import ControllerNode
from needle_controller.steering_node import SteeringNode
from needle_dynamics.plant_node import PlantNode
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_insertion.live.operator import Operator
from needle_ros import contract
from needle_ros.base_node import message_class, profile
from needle_ros.contract import Topic
from needle_ros.status import SteeringPhase
from needle_ros.timing import NANOSECONDS
import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter

#: Faults of a message.
KINDS: Final = ('drop', 'delay', 'duplicate')

#: Longest delay, and longest time from a fault to a stop if the target is not reached, in
#: simulated time [s].
LONGEST_DELAY: Final = 1.0
LONGEST_STOP: Final = 5.0

#: Target x, y, z [m].
TARGET: Final = (5e-4, 0.041, -3e-4)

#: Ends of an insertion, see `InsertionOutcome`.
_GOOD: Final = ('target', 'stopped', 'rejected')
_BAD: Final = ('missed', 'late', 'hangs')

#: Time between two checks for messages to deliver [s].
_CHECK: Final = 2e-3

_PLANT: Final = PLANT | {'mode': 'simulation', 'lockstep': True, 'real_time_factor': 4.0}
_STEERING: Final = STEERING | {'use_sim_time': True, 'speed': 0.05}
_CONTROLLER: Final[dict[str, object]] = {
    'needle': 'bending_35mm',
    'use_sim_time': True,
    'steered': True,
    'rate': PLANT['rate'],
    'deflection_feedback': 'none',
    'reference.speed': 0.05,
    'reference.acceleration': 1.0,
}


class TopicLink(NamedTuple):
    """A topic from one node (source) to another (sink)."""

    source: str
    sink: str
    topic: Topic

    def __str__(self) -> str:
        return f'{self.topic.name.lstrip("/")}: {self.source} -> {self.sink}'


_STATES: Final = (contract.JOINT_STATES, contract.BASE_WRENCH, contract.TIP_DEFLECTION)

#: All links between the nodes of a steered insertion.
LINKS: Final = (
    *(TopicLink('plant', 'controller', topic) for topic in (*_STATES, contract.CLOCK)),
    *(
        TopicLink('plant', 'steering', topic)
        for topic in (contract.JOINT_STATES, contract.TIP_DEFLECTION, contract.CLOCK)
    ),
    TopicLink('controller', 'plant', contract.WRENCH_COMMAND),
    TopicLink('steering', 'controller', contract.JOINT_TRAJECTORY),
    TopicLink('steering', 'plant', contract.JOINT_TRAJECTORY),
    TopicLink('user', 'steering', contract.TARGET),
    TopicLink('plant', 'steering', contract.DIAGNOSTICS),
    TopicLink('controller', 'steering', contract.DIAGNOSTICS),
    TopicLink('steering', 'user', contract.DIAGNOSTICS),
    TopicLink('plant', 'user', contract.CLOCK),
)


class MessageFault(NamedTuple):
    """
    A fault of one message.

    Attributes
    ----------
    link : TopicLink
        Link of the message.
    number : int
        Number of the message on the link since the target was sent, from 1.
    kind : str
        One of `KINDS`.
    delay : float
        Delay of the message, or of its duplicate [s].

    """

    link: TopicLink
    number: int
    kind: str
    delay: float

    def __str__(self) -> str:
        delay = '' if self.kind == 'drop' else f' {self.delay:.3f} s'
        return f'{self.kind}{delay} message {self.number} of {self.link}'


def _name(node: str, topic: Topic) -> str:
    """Return the name of a topic at a node."""
    return f'/at_{node}/{topic.name.lstrip("/")}'


def _remaps(node: str) -> list[str]:
    """Return arguments that remap all topics of a node to its own names."""
    topics = {one.topic.name: one.topic for one in LINKS if node in one[:2]}
    rules = [f'{topic.name}:={_name(node, topic)}' for topic in topics.values()]
    return ['--ros-args', *(word for rule in rules for word in ('-r', rule))]


class Relay(Node):
    """
    Forwards the messages of all links, with one fault.

    Attributes
    ----------
    fault : MessageFault or None
        Fault to insert.
    counts : Counter
        Number of messages of each link since the target was sent.
    now : float
        Simulated time [s].
    struck : float or None
        Simulated time of the fault [s].

    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('relay', **node_options)
        self.fault: MessageFault | None = None
        self.counts: Counter[TopicLink] = Counter()
        self.armed = False
        self.now = 0.0
        self.struck: float | None = None
        #: Delayed messages: simulated and wall time of delivery [s], and the delivery.
        self._held: list[tuple[float, float, Callable[[], None]]] = []
        for source, topic in {(one.source, one.topic) for one in LINKS}:
            kind, name = message_class(topic.type_name), _name(source, topic)
            sinks = []
            for link in LINKS:
                if (link.source, link.topic) == (source, topic):
                    to = self.create_publisher(kind, _name(link.sink, topic), profile(topic.qos))
                    sinks.append((link, to.publish))
            take = partial(self._take, sinks)
            self.create_subscription(kind, name, take, profile(topic.qos, request=True), raw=True)
        self.create_subscription(
            message_class(contract.CLOCK.type_name),
            _name('plant', contract.CLOCK),
            self._on_clock,
            profile(contract.CLOCK.qos, request=True),
        )
        # Simulated time may wait for a delayed message.
        self.create_timer(_CHECK, self._deliver, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_clock(self, message: Any) -> None:
        self.now = message.clock.sec + message.clock.nanosec / NANOSECONDS

    def _take(
        self, sinks: Sequence[tuple[TopicLink, Callable[[bytes], None]]], data: bytes
    ) -> None:
        for link, publish in sinks:
            self.counts[link] += self.armed
            fault = self.fault
            if not self.armed or fault is None or fault[:2] != (link, self.counts[link]):
                publish(data)
                continue
            self.struck = self.now
            if fault.kind == 'duplicate':
                publish(data)
            if fault.kind != 'drop':
                later = self.now + fault.delay, monotonic() + fault.delay, partial(publish, data)
                self._held.append(later)

    def _deliver(self) -> None:
        wall = monotonic()
        due = [one for one in self._held if self.now >= one[0] or wall >= one[1]]
        self._held = [one for one in self._held if one not in due]
        for _, _, deliver in due:
            deliver()


class InsertionOutcome(NamedTuple):
    """
    End of an insertion.

    Attributes
    ----------
    end : str
        ``target``, ``stopped``, ``rejected``, ``missed`` (done, but not at the target), ``late``
        (stopped too late) or ``hangs``.
    line : str
        Reason of the stop, or the state.
    after : float
        Simulated time from the fault to the end [s].
    counts : Counter
        Messages of each link.
    struck : bool
        Whether the fault occurred.

    """

    end: str
    line: str
    after: float
    counts: Counter[TopicLink]
    struck: bool


def insert(
    fault: MessageFault | None, logs: Path, *, continuous: bool = False
) -> InsertionOutcome:
    """Insert a needle with one fault, in steps or continuously (without rests)."""
    with Graph(logs) as graph:

        def add(name: str, kind: Callable[..., Any], **parameters: object) -> Any:
            overrides = [Parameter(key, value=value) for key, value in parameters.items()]
            return graph.add(kind, parameter_overrides=overrides, cli_args=_remaps(name))

        relay: Relay = graph.add(Relay)
        user = add('user', partial(Node, 'user'), use_sim_time=True)
        operator = Operator(user)
        plant = add('plant', PlantNode, **_PLANT)
        steering = add('steering', SteeringNode, **_STEERING, continuous=continuous, rate=50.0)
        controller = add('controller', ControllerNode, **_CONTROLLER)
        for node in (steering, controller, plant):
            if not node.start():
                raise GraphError(f'{node.get_name()} does not start: {node.failure}')

        def ready() -> bool:
            inputs = steering.diagnose().status.input
            accepted = [inputs[one.name].accepted for one in _STATES[::2] if one.name in inputs]
            heard = {'controller', 'plant'} <= {*steering._loop._motions.monitor._receivers}
            known = 'steering' in operator.states
            return known and heard and len(accepted) == len(_STATES[::2]) and all(accepted)

        graph.spin_until(ready, 'the nodes', HANGS)
        relay.fault, relay.armed = fault, True
        pending = operator.target(*TARGET)
        loop = steering._loop
        ends = (SteeringPhase.DONE, SteeringPhase.STOPPED)

        def ended() -> bool:
            return loop.phase in ends or (pending.done and not pending.outcome[0])

        try:
            graph.spin_until(ended, 'the end', HANGS)
            end = relay.now
            # A delayed message may still arrive, and must not cause motion.
            later = relay.now + LONGEST_DELAY + 0.5
            graph.spin_until(lambda: relay.now > later, 'the last message', HANGS)
        except GraphError as error:
            line = f'{loop.phase.value}; {error}'
            return InsertionOutcome('hangs', line, np.inf, relay.counts, relay.struck is not None)
        struck = relay.struck is not None
        after = end - relay.struck if relay.struck is not None else 0.0
        if loop.phase is SteeringPhase.DONE:
            return InsertionOutcome(*at_target(plant, TARGET), after, relay.counts, struck)
        if loop.phase is SteeringPhase.STOPPED:
            kind = 'stopped' if after <= LONGEST_STOP else 'late'
            return InsertionOutcome(kind, loop.fault, after, relay.counts, struck)
        return InsertionOutcome('rejected', pending.outcome[1], after, relay.counts, struck)


def choose(counts: Mapping[TopicLink, int], rng: np.random.Generator) -> MessageFault:
    """Draw a link, one of its messages, and a fault; `counts` is from an undisturbed insertion."""
    link = LINKS[int(rng.integers(len(LINKS)))]
    number = 1 + int(rng.integers(max(1, counts[link])))
    return MessageFault(
        link, number, str(rng.choice(KINDS)), float(rng.uniform(0.0, LONGEST_DELAY))
    )


def main(words: Sequence[str] | None = None) -> int:
    """Run the insertions, print a table and the verdict; return the exit status."""
    count, seed = arguments('benchmarks.relay', str(__doc__), 200, words)
    # Each link with and without rests.
    with TemporaryDirectory() as folder:
        clean = [insert(None, Path(folder), continuous=one) for one in (False, True)]
    for one in clean:
        if one.end != 'target':
            sys.stdout.write(f'missed: without a fault: {one.end}, {one.line}\n')
            return 1

    def faulty(number: int, rng: np.random.Generator, logs: Path) -> tuple[str, str, str]:
        continuous = bool(number % 2)
        fault = choose(clean[continuous].counts, rng)
        found = insert(fault, logs, continuous=continuous)
        kind = 'continuous' if continuous else 'steps'
        line = f'{kind}, {fault}: {found.end} after {found.after:.2f} s: {found.line}'
        row = str(fault.link) if found.struck else 'no fault: fewer messages'
        return row, found.end, '' if found.end == 'target' else line

    return repeat(faulty, _GOOD, _BAD, 'link', count, seed)


if __name__ == '__main__':
    sys.exit(main())
