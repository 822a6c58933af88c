# SPDX-License-Identifier: Apache-2.0
"""
Kill and restart the node `steering` at random times of an insertion, over DDS.

The plant (mode `robot`, real time) and the user are nodes of this process, `steering` is a
process of its own. It is killed at a random time of the insertion, and started again when needle
and guide rest. Without a request it must not move them. When its target is sent again, it must
resume the insertion and end at the target, or name an action.
Run it by ``python -m benchmarks.restarts --count 50 --seed 1``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import re
import sys
from time import monotonic
from typing import Final, NamedTuple

from benchmarks.random_insertions import arguments, at_target, HANGS, PLANT, repeat, STEERING
from needle_dynamics.plant_node import PlantNode
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_insertion.live.operator import Operator
from needle_ros import contract
from needle_ros.base_node import message_class, profile
from needle_ros.status import NodeStatus, SteeringPhase, SteeringStatus
import numpy as np
from rclpy.parameter import Parameter

#: Target x, y, z [m].
TARGET: Final = (1.5e-3, 0.051, -1e-3)

#: Ends of an interrupted insertion, see `RestartOutcome`.
_GOOD: Final = ('target', 'named')
_BAD: Final = ('missed', 'stopped', 'moved', 'hangs')

#: Latest time of the kill, after the first motion [s]: the insertion takes about 6 s.
LATEST: Final = 6.0

#: Displacement of a joint at rest [m].
_STILL: Final = 1e-6

_PLANT: Final = PLANT | {'mode': 'robot'}
_STEERING: Final = STEERING | {'speed': 0.02, 'measurement_timeout': 5.0}

#: Actions in the line of a rejected target, as docs/steering.md and docs/safety.md document them.
_ACTION: Final = re.compile(
    r'retract (the needle|it) (to -?[\d.]+ mm )?first$|~/clear_stop releases$'
)


class RestartOutcome(NamedTuple):
    """
    End of an interrupted insertion.

    Attributes
    ----------
    end : str
        ``target``, ``missed``, ``named`` (an action of the user), ``stopped``, ``moved`` (without
        a request) or ``hangs``.
    phase : str
        Phase of the node at the last status before the kill.
    line : str
        Result or reason.

    """

    end: str
    phase: str
    line: str


class InterruptedInsertion:
    """An insertion whose node `steering` is killed at a time after its first motion [s]."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        parameters = [Parameter(name, value=value) for name, value in _PLANT.items()]
        self._plant = graph.add(PlantNode, parameter_overrides=parameters)
        if not self._plant.start():
            raise GraphError(f'plant does not start: {self._plant.failure}')
        self._user = user = graph.node('user')
        self._operator = Operator(user)
        self._moves = 0
        topic = contract.JOINT_TRAJECTORY
        user.create_subscription(
            message_class(topic.type_name),
            topic.name,
            self._count,
            profile(topic.qos, request=True),
            raw=True,
        )

    def _count(self, _data: bytes) -> None:
        self._moves += 1

    def _status(self) -> SteeringStatus | None:
        found = self._operator.states.get('steering')
        status: NodeStatus | None = None if found is None else found.report.status
        return status if isinstance(status, SteeringStatus) else None

    def _is_ready(self) -> bool:
        status = self._status()
        return (
            status is not None
            and bool(status.input)
            and all(one.accepted for one in status.input.values())
        )

    def _positions(self) -> np.ndarray:
        found = self._plant._run._positions()
        return np.array(list(found.values()))

    def run(self, after: float) -> RestartOutcome:
        """Interrupt the insertion, and resume it."""
        graph, operator = self._graph, self._operator
        node = graph.start('steering', _STEERING)
        graph.spin_until(self._is_ready, 'the measurements', HANGS)
        operator.target(*TARGET)
        graph.spin_until(lambda: self._moves, 'the first motion', HANGS)
        end = monotonic() + after
        graph.spin_until(lambda: monotonic() > end, 'the time of the kill', HANGS)
        status = self._status()
        phase = '' if status is None else status.phase.value
        node.kill()
        operator.states.pop('steering', None)
        self._await_rest()
        before = self._moves
        graph.start('steering', _STEERING)
        graph.spin_until(self._is_ready, 'the measurements after the restart', HANGS)
        # Two periods of the diagnostics without a request.
        end = monotonic() + 2.0
        graph.spin_until(lambda: monotonic() > end, 'two seconds', HANGS)
        if self._moves > before:
            return RestartOutcome('moved', phase, 'a motion without a request')
        return self._resume(phase)

    def _await_rest(self) -> None:
        """Wait until no joint has moved for half a second."""
        last, since = self._positions(), monotonic()

        def rests() -> bool:
            nonlocal last, since
            now = self._positions()
            if np.abs(now - last).max() > _STILL:
                last, since = now, monotonic()
            return monotonic() > since + 0.5

        self._graph.spin_until(rests, 'rest', HANGS)

    def _resume(self, phase: str) -> RestartOutcome:
        """Send the target again, and wait for the end."""
        pending = self._operator.target(*TARGET)

        def ended() -> bool:
            status = self._status()
            if pending.done and not pending.outcome[0]:
                return True
            phases = (SteeringPhase.DONE, SteeringPhase.STOPPED)
            return pending.done and status is not None and status.phase in phases

        self._graph.spin_until(ended, 'the end', HANGS)
        success, line = pending.outcome
        if not success:
            return RestartOutcome('named' if names_action(line) else 'stopped', phase, line)
        status = self._status()
        if status is not None and status.phase is SteeringPhase.STOPPED:
            return RestartOutcome('stopped', phase, status.fault)
        end, line = at_target(self._plant, TARGET)
        return RestartOutcome(end, phase, line)


def names_action(line: str) -> bool:
    """Return whether the line of a rejected target names an action of the user."""
    return _ACTION.search(line) is not None


def interrupt(after: float, logs: Path) -> RestartOutcome:
    """Insert a needle with a kill at a time after the first motion [s]."""
    with Graph(logs) as graph:
        try:
            return InterruptedInsertion(graph).run(after)
        except GraphError as error:
            return RestartOutcome('hangs', '', str(error))


def main(words: Sequence[str] | None = None) -> int:
    """Run the insertions, print a table and the verdict; return the exit status."""
    count, seed = arguments('benchmarks.restarts', str(__doc__), 50, words)

    def killed(_number: int, rng: np.random.Generator, logs: Path) -> tuple[str, str, str]:
        after = float(rng.uniform(0.0, LATEST))
        end, phase, line = interrupt(after, logs)
        return phase, end, f'killed after {after:.2f} s, {phase}: {end}, {line}'

    return repeat(killed, _GOOD, _BAD, 'killed while', count, seed)


if __name__ == '__main__':
    sys.exit(main())
