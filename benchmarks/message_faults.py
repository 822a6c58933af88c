# SPDX-License-Identifier: Apache-2.0
"""Faults of the messages of a steered insertion, by message."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from math import inf
from typing import Any, Final, TypeAlias

from benchmarks.steering_graph import GraphFault
from benchmarks.steering_nodes import (
    CALLS,
    COMMAND,
    COMMANDED,
    CONTRACT,
    CONTROLLER,
    DIRECT,
    GOAL,
    GOAL_ANSWER,
    HARDWARE,
    NODES,
    Posted,
    RESPONSE,
    ROBOT,
    ROUTES,
    SERVERS,
    STEERING,
)
from needle_controller.steering.motion import JointMotion
from needle_ros.contract import (
    BASE_WRENCH,
    DIAGNOSTICS,
    EMERGENCY_STOP,
    GUIDE_X,
    GUIDE_Z,
    INSERTION,
    JOINT_COMMANDS,
    JOINT_STATES,
    JOINT_TRAJECTORY,
    SYSTEM_STATE,
    TARGET,
    TIP_DEFLECTION,
)
from needle_ros.requests import REPEAT_AFTER, Verdict
from needle_ros.system_state import CLEAR_STOP, PAUSE, RESUME, STOP
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading
import numpy as np

#: Delays of messages [s].
DELAYS: Final = {'late': 0.1, 'very late': 0.6, 'late by 1 s': 1.0}

#: Maps the number of a message since the start of the fault, the message, and the first message
#: of the fault to the received messages, each with its delay [s].
Alter: TypeAlias = Callable[[int, Any, Any], Iterable[tuple[float, Any]]]


def _change(alter: Callable[[Any], Any]) -> Alter:
    return lambda _k, content, _first: ((0.0, alter(content)),)


def _frozen(_k: int, content: Any, first: Any) -> Iterable[tuple[float, Any]]:
    """Repeat the first message with new stamps."""
    if isinstance(content, Reading | JointMotion):
        first = first._replace(stamp=content.stamp)
    return ((0.0, first),)


_LOST: Final[dict[str, Alter]] = {
    'lost': lambda _k, _content, _first: (),
    'late': lambda _k, content, _first: ((DELAYS['late'], content),),
    'very late': lambda _k, content, _first: ((DELAYS['very late'], content),),
}
_ANY: Final[dict[str, Alter]] = {
    **_LOST,
    'doubled': lambda _k, content, _first: ((0.0, content), (DELAYS['late'], content)),
    'frozen': _frozen,
}


def _shifted(place: int, size: float) -> Alter:
    """Add a number to a value of a measurement."""

    def shift(reading: Reading) -> Reading:
        values = list(reading.values[0])
        values[place] += size
        return reading._replace(values=(tuple(values), *reading.values[1:]))

    return _change(shift)


def _scaled(factor: float) -> Alter:
    """Scale all values of a measurement."""
    return _change(
        lambda reading: reading._replace(
            values=tuple(tuple(factor * one for one in column) for column in reading.values)
        )
    )


def _permuted(order: Sequence[int], signs: Sequence[float]) -> Alter:
    """Exchange the first values of a measurement."""

    def permute(reading: Reading) -> Reading:
        first = reading.values[0]
        turned = [sign * first[k] for k, sign in zip(order, signs, strict=True)]
        values = *turned, *first[len(turned) :]
        return reading._replace(values=(values, *reading.values[1:]))

    return _change(permute)


def _trajectory(change: Callable[[np.ndarray[Any, Any], str], np.ndarray[Any, Any]]) -> Alter:
    """Change the positions of each joint in a trajectory."""

    def changed(move: JointMotion) -> JointMotion:
        columns = [change(move.positions[:, k], joint) for k, joint in enumerate(move.joints)]
        return move._replace(positions=np.column_stack(columns))

    return _change(changed)


def _exchanged(move: JointMotion) -> JointMotion:
    other = {GUIDE_X: GUIDE_Z, GUIDE_Z: GUIDE_X}
    return move._replace(joints=tuple(other.get(name, name) for name in move.joints))


_FRAME: Final = _change(lambda reading: reading._replace(frame='elsewhere'))
_NO_STAMP: Final = _change(lambda reading: reading._replace(stamp=0))
_OLD: Final[Alter] = lambda _k, _content, first: ((0.0, first),)  # noqa: E731
_AXES: Final = _permuted((2, 1, 0), (1.0, 1.0, -1.0))
_MILLIMETERS: Final[dict[str, Alter]] = {'in mm': _scaled(1e3), 'in km': _scaled(1e-3)}

_TRAJECTORY: Final[dict[str, Alter]] = {
    **_ANY,
    'depth biased by 2 mm': _trajectory(lambda p, name: p + 2e-3 * (name == INSERTION)),
    'guide biased by 1 mm': _trajectory(lambda p, name: p + 1e-3 * (name == GUIDE_X)),
    'in mm': _trajectory(lambda p, _name: 1e3 * p),
    'in km': _trajectory(lambda p, _name: 1e-3 * p),
    'opposite direction': _trajectory(lambda p, _name: -p),
    'guide axes exchanged': _change(_exchanged),
}

_LATER: Final[Alter] = lambda _k, content, _first: ((DELAYS['late by 1 s'], content),)  # noqa: E731
_ONCE: Final[Alter] = lambda k, content, _first: ((0.0, content),) if k else ()  # noqa: E731


def _again(delay: float) -> Alter:
    """Transmit a message again after a delay [s]."""
    return lambda _k, content, _first: ((0.0, content), (delay, content))


#: Faults of a stop on the emergency topic; frozen: a device repeats it ten times a second.
_EMERGENCY: Final[dict[str, Alter]] = {
    **_LOST,
    'late by 1 s': _LATER,
    'doubled': _ANY['doubled'],
    'doubled after 1 s': _again(1.0),
    'frozen': lambda _k, content, _first: tuple((0.1 * n, content) for n in range(10)),
    'false': _change(lambda _content: False),
}

#: Faults of the request to a service.
_REQUEST: Final[dict[str, Alter]] = {
    'lost': _LOST['lost'],
    'first lost': _ONCE,
    'late': _LOST['late'],
    'very late': _LOST['very late'],
    'late by 1 s': _LATER,
    'doubled': _ANY['doubled'],
    'doubled after 1 s': _again(1.0),
}

#: Faults of the response of a service.
_RESPONSE: Final[dict[str, Alter]] = {'lost': _LOST['lost'], 'first lost': _ONCE}

#: Separates a fault of a request from the request of another user that follows it.
THEN: Final = ', then '

#: Requests of another user that must not be ended by the repetition of an earlier request.
_OPPOSITES: Final = {RESUME: PAUSE, CLEAR_STOP: STOP}


def _of_response(topic: str) -> dict[str, Alter]:
    """Return the faults of a response, and the one before a later request."""
    later, first = _OPPOSITES.get(CALLS[topic][0]), 'first lost'
    return {**_RESPONSE, **({f'{first}{THEN}{later}': _ONCE} if later else {})}


#: Time from a request to its arrival, if it is not immediate [s]; infinite: it never arrives.
ARRIVALS: Final = {**DELAYS, 'lost': inf, 'false': inf, 'first lost': REPEAT_AFTER}

#: Faults by message, or by message and receiver.
MESSAGES: Final[dict[str, dict[str, Alter]]] = {
    JOINT_STATES.name: {
        **_ANY,
        'frozen, old stamps': _OLD,
        'depth biased by 2 mm': _shifted(0, 2e-3),
        'guide biased by 1 mm': _shifted(1, 1e-3),
        **_MILLIMETERS,
        'opposite direction': _permuted((0,), (-1.0,)),
        'guide axes exchanged': _permuted((0, 2, 1), (1.0, 1.0, 1.0)),
        'no stamps': _NO_STAMP,
    },
    f'{JOINT_STATES.name} to {CONTROLLER}': _LOST,
    f'{JOINT_STATES.name} to {STEERING}': _LOST,
    TIP_DEFLECTION.name: {
        **_ANY,
        'frozen, old stamps': _OLD,
        'x biased by 2 mm': _shifted(0, 2e-3),
        'depth biased by 2 mm': _shifted(1, 2e-3),
        **_MILLIMETERS,
        'other frame': _FRAME,
        'axes exchanged': _AXES,
        'no stamps': _NO_STAMP,
    },
    BASE_WRENCH.name: {
        **_ANY,
        'biased by 3 N': _shifted(2, 3.0),
        'in mN': _scaled(1e3),
        'other frame': _FRAME,
        'axes exchanged': _AXES,
    },
    COMMAND: {
        **_ANY,
        'biased by 3 N or mm': lambda k, content, first: _shifted(0 if content.names else 1, 3.0)(
            k, content, first
        ),
        'a thousandfold': _scaled(1e3),
        'a thousandth': _scaled(1e-3),
        'opposite direction': _scaled(-1.0),
        'other frame': _FRAME,
    },
    JOINT_COMMANDS.name: {
        **_ANY,
        'depth biased by 2 mm': _shifted(0, 2e-3),
        'guide biased by 1 mm': _shifted(1, 1e-3),
        **_MILLIMETERS,
        'opposite direction': _scaled(-1.0),
        'guide axes exchanged': _permuted((0, 2, 1), (1.0, 1.0, 1.0)),
    },
    JOINT_TRAJECTORY.name: _TRAJECTORY,
    f'{JOINT_TRAJECTORY.name} to {CONTROLLER}': _TRAJECTORY,
    f'{JOINT_TRAJECTORY.name} to {ROBOT}': _TRAJECTORY,
    GOAL: _TRAJECTORY,
    GOAL_ANSWER: {
        **_ANY,
        'rejected': _change(lambda answer: replace(answer, verdict=Verdict.REJECTED)),
    },
    DIAGNOSTICS.name: _ANY,
    SYSTEM_STATE.name: _ANY,
    TARGET.name: {
        **_LOST,
        'doubled': _ANY['doubled'],
        'in mm': _change(lambda aim: (*aim[:2], tuple(1e3 * one for one in aim[2]))),
        'in km': _change(lambda aim: (*aim[:2], tuple(1e-3 * one for one in aim[2]))),
        'other frame': _change(lambda aim: (aim[0], 'elsewhere', aim[2])),
        'depth and x exchanged': _change(
            lambda aim: (*aim[:2], (aim[2][1], aim[2][0], aim[2][2]))
        ),
    },
    EMERGENCY_STOP.name: _EMERGENCY,
    **{f'{EMERGENCY_STOP.name} to {node}': _LOST for node in SERVERS},
    **dict.fromkeys(CALLS, _REQUEST),
    **{f'{RESPONSE}{topic}': _of_response(topic) for topic in CALLS},
}


#: Topics that exist with some robots only.
_OF_ROBOTS: Final = {
    CONTRACT: {COMMAND, JOINT_TRAJECTORY.name},
    HARDWARE: {COMMAND, JOINT_TRAJECTORY.name},
    DIRECT: {JOINT_TRAJECTORY.name},
    COMMANDED: {GOAL, GOAL_ANSWER, JOINT_COMMANDS.name},
}


def places(robot: str) -> list[str]:
    """Return the messages, or messages to one of several receivers, that a robot has."""
    return [place for place in MESSAGES if _exists(place, robot)]


def _exists(place: str, robot: str) -> bool:
    topic, _, receiver = place.partition(' to ')
    if topic in set().union(*_OF_ROBOTS.values()) - _OF_ROBOTS[robot]:
        return False
    call = CALLS.get(topic.removeprefix(RESPONSE))
    if call is not None:
        return call[1] in NODES[robot]
    receivers = [name for name in ROUTES[topic] if name in NODES[robot]]
    return receiver in receivers and len(receivers) > 1 if receiver else bool(receivers)


class TopicFault(GraphFault):
    """Fault of a message, or of a message to a receiver (`topic to receiver`)."""

    def __init__(self, place: str, alter: Alter) -> None:
        self._topic, _, self._receiver = place.partition(' to ')
        self._alter = alter
        #: Number of messages since the start of the fault, and first message, by receiver.
        self._counts: dict[str, int] = {}
        self._first: dict[str, Any] = {}

    def received(self, receiver: str, posted: Posted) -> Iterator[Posted]:
        if posted.topic != self._topic or self._receiver not in ('', receiver):
            yield posted
            return
        k = self._counts.get(receiver, 0)
        self._counts[receiver] = k + 1
        first = self._first.setdefault(receiver, posted.content)
        for late, content in self._alter(k, posted.content, first):
            yield Posted(posted.topic, content, round(late * NANOSECONDS))
