# SPDX-License-Identifier: Apache-2.0
"""
Requests on topics with stamp `Stamp.REQUEST`, and their acknowledgement.

The receiver answers in its status on ``/diagnostics``, immediately and then once a second, so that
a lost message is replaced. The sender repeats the request until the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from time import monotonic
from typing import Any, Final, NamedTuple, TypeAlias

from needle_ros.contract import REQUEST_AGE, Stamp, Topic
from needle_ros.errors import NeedleError, ParameterError, printable
from needle_ros.timing import apart, NANOSECONDS, parse_nanoseconds

REPEAT_AFTER: Final = 1.0  #: Interval of repetitions without an answer [s].
REPEATS: Final = 3  #: Maximum number of repetitions.

_GIVE_UP: Final = REQUEST_AGE + 1.0  #: Timeout without an answer [s]: the request is stale then.
CALL_TIMEOUT: Final = 10.0  #: Timeout of a service call [s].

_PUBLISHED: Final = 8  #: Number of answers in a status.
_KEPT: Final = 64  #: Number of answers kept to detect duplicates.
_PAUSE: Final = 0.05  #: Minimum time between two statuses published for an answer [s].
_TAKES, _REQUEST = 'takes ', 'request '  #: Beginnings of keys in a status.
_MOST_AGE: Final = round(REQUEST_AGE * NANOSECONDS)

#: Executes a request with an object of the caller and the time since the stamp [s], or raises.
RequestAction: TypeAlias = Callable[[Any, float], None]


class LateTrajectoryError(ParameterError):
    """All points of a trajectory are in the past."""


class Verdict(Enum):
    """Result of a request."""

    RECEIVED = 'received'  #: Received and being checked; another verdict follows.
    ACCEPTED = 'accepted'
    REJECTED = 'rejected'
    LATE = 'rejected as late'  #: All its points are in the past: it may be sent again.
    SUPERSEDED = 'superseded'  #: Not executed, because the receiver executes a newer request.


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """Answer of a receiver to a request."""

    topic: str  #: Topic of the request, by its name in the contract.
    stamp: int  #: Stamp of the request [ns]; 0 for a message without a stamp.
    verdict: Verdict
    reason: str = ''  #: Reason of a rejection, for users.

    @property
    def refused(self) -> bool:
        """Whether the request is not executed."""
        return self.verdict in (Verdict.REJECTED, Verdict.LATE, Verdict.SUPERSEDED)


@dataclass(frozen=True, slots=True)
class RequestStatus:
    """Accepted request topics of a node and its latest answers, as part of a DiagnosticStatus."""

    #: Moved joints by topic of the request.
    takes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    answers: tuple[Acknowledgement, ...] = ()  #: The latest answers, the newest last.

    def to_values(self) -> dict[str, str]:
        values = {f'{_TAKES}{topic}': ', '.join(joints) for topic, joints in self.takes.items()}
        for one in self.answers:
            key = f'{_REQUEST}{one.topic} {one.stamp}'
            values[key] = f'{one.verdict.value}: {one.reason}' if one.reason else one.verdict.value
        return values

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> RequestStatus:
        takes, answers = {}, []
        verdicts = {one.value: one for one in Verdict}
        for key, value in values.items():
            if key.startswith(_TAKES):
                takes[key[len(_TAKES) :]] = tuple(filter(None, value.split(', ')))
            elif key.startswith(_REQUEST):
                topic, _, stamp = key[len(_REQUEST) :].rpartition(' ')
                verdict, _, reason = value.partition(': ')
                time = parse_nanoseconds(stamp)
                if time is not None and verdict in verdicts:
                    answers.append(Acknowledgement(topic, time, verdicts[verdict], reason))
        return cls(takes, tuple(answers))

    def answer_to(self, topic: str, stamp: int) -> Acknowledgement | None:
        found = (one for one in self.answers if (one.topic, one.stamp) == (topic, stamp))
        return next(found, None)


#: Takes an answer to a request, and the joints that something else moves from then on.
Listener: TypeAlias = Callable[[Acknowledgement, Collection[str]], None]


class _Watched(NamedTuple):
    joints: frozenset[str]
    report: Listener


def is_stale(stamp: int, now: int) -> bool:
    """Return whether a stamp [ns] is too far from the present time [ns]; 0 never is."""
    return stamp != 0 and not -_MOST_AGE <= now - stamp <= _MOST_AGE


class RequestLog:
    """
    Log of received requests: accept each once, in the order of the stamps, and record answers.

    `takes` are the moved joints by topic, `frames` the valid frames, `steady` a steady clock [s].
    """

    def __init__(
        self,
        takes: Mapping[Topic, Sequence[str]],
        frames: Sequence[str] = ('',),
        steady: Callable[[], float] = monotonic,
    ) -> None:
        for topic in takes:
            if topic.stamp is not Stamp.REQUEST:
                raise ValueError(f'{topic.name} is not a request')
        self._takes = {topic.name: tuple(joints) for topic, joints in takes.items()}
        self._frames, self._steady = frames, steady
        self._answers: dict[tuple[str, int], Acknowledgement] = {}
        self._newest: dict[str, int] = {}  #: Stamp of the newest accepted request, by joint [ns].
        self._watched: dict[tuple[str, int], _Watched] = {}  #: By topic and stamp [ns].
        self._changed = False
        self._published = -_PAUSE

    def forget(self) -> None:
        """Delete all requests, after a start or after the clock was set back."""
        self.end('the clock was set back')
        self._answers.clear()
        self._newest.clear()

    def check(
        self, topic: Topic, stamp: int, now: int, frame: str = '', joints: Iterable[str] = ()
    ) -> Acknowledgement | None:
        """
        Return None for a new request, else its answer; times are in ns.

        The caller answers a new request; a stamp of 0 always counts as new.
        """
        known = self._answers.get((topic.name, stamp)) if stamp else None
        if known is not None:
            # The status with the answer may have been lost.
            self._changed = True
            return known
        verdict, reason = Verdict.REJECTED, ''
        if is_stale(stamp, now):
            reason = f'{topic.name} is stale: its stamp is {apart(now - stamp)}'
        elif frame not in self._frames:
            valid = ' or '.join(map(repr, self._frames))
            reason = f'{topic.name} must be in frame {valid}, got {frame!r}'
        # A much newer request is from before the clock was set back.
        elif stamp and any(
            stamp < self._newest.get(joint, 0) <= now + _MOST_AGE for joint in joints
        ):
            verdict, reason = Verdict.SUPERSEDED, 'a newer request has priority'
        return self.answer(topic, stamp, verdict, reason) if reason else None

    def answer(
        self,
        topic: Topic,
        stamp: int,
        verdict: Verdict,
        reason: str = '',
        joints: Iterable[str] = (),
    ) -> Acknowledgement:
        """Record and return the answer to a request; arguments as for `check`."""
        made = Acknowledgement(topic.name, stamp, verdict, printable(reason))
        if stamp and not made.refused:
            for joint in joints:
                self._newest[joint] = max(stamp, self._newest.get(joint, 0))
        # Newest answer last.
        self._answers.pop((topic.name, stamp), None)
        self._answers[topic.name, stamp] = made
        while len(self._answers) > _KEPT:
            del self._answers[next(iter(self._answers))]
        self._changed = True
        watched = self._watched.get((topic.name, stamp))
        if watched is not None:
            if made.refused:
                self.unwatch(topic, stamp)
            watched.report(made, ())
        if verdict is Verdict.ACCEPTED:
            newer = f'a newer {topic.name} is followed'
            self.end(newer, {*joints}, besides=(topic.name, stamp))
        return made

    def watch(self, topic: Topic, stamp: int, joints: Iterable[str], report: Listener) -> int:
        """Report answers to a request, and its end; return its stamp [ns], made unique."""
        while {(topic.name, stamp)} & (self._answers.keys() | self._watched.keys()):
            stamp += 1
        self._watched[topic.name, stamp] = _Watched(frozenset(joints), report)
        return stamp

    def unwatch(self, topic: Topic, stamp: int) -> None:
        self._watched.pop((topic.name, stamp), None)

    def end(
        self,
        reason: str,
        moved: Collection[str] | None = None,
        *,
        besides: tuple[str, int] | None = None,
    ) -> None:
        """Report the end of the watched requests, of ``moved`` joints or all, `besides` one."""
        for key, watched in [*self._watched.items()]:
            concerned = moved is None or watched.joints & {*moved}
            # A report may end other requests.
            if key != besides and concerned and key in self._watched:
                del self._watched[key]
                ended = Acknowledgement(*key, Verdict.SUPERSEDED, printable(reason))
                watched.report(ended, moved or ())

    def reject(self, topic: Topic, stamp: int, why: str | NeedleError) -> None:
        """Answer that a request is rejected, for a reason or an error."""
        late = isinstance(why, LateTrajectoryError)
        self.answer(topic, stamp, Verdict.LATE if late else Verdict.REJECTED, str(why))

    def supersede(self, now: int) -> None:
        """Supersede all requests sent before `now` [ns]: a stop or a retraction has priority."""
        for joints in self._takes.values():
            for joint in joints:
                self._newest[joint] = max(now, self._newest.get(joint, 0))

    def due(self) -> bool:
        """Return whether to publish the status now: call after each request and every 0.1 s."""
        if not self._changed or (now := self._steady()) - self._published < _PAUSE:
            return False
        self._changed, self._published = False, now
        return True

    def status(self) -> RequestStatus:
        answers = tuple(self._answers.values())[-_PUBLISHED:]
        return RequestStatus(self._takes, answers)


class PendingRequest:
    """A request that is repeated with its stamp [ns] until it is answered."""

    def __init__(
        self, topic: Topic, stamp: int, node: str, steady: Callable[[], float] = monotonic
    ) -> None:
        self._topic, self._stamp, self._steady = topic.name, stamp, steady
        self._begun, self._repeats = steady(), 0
        self.answer: Acknowledgement | None = None  #: The latest answer.
        self.node = node  #: Name of the expected receiver, or of the node that has answered.

    def take_status(self, node: str, status: RequestStatus) -> None:
        answer = status.answer_to(self._topic, self._stamp)
        if answer is not None and (self.answer is None or not self.done):
            self.answer, self.node = answer, node

    @property
    def done(self) -> bool:
        """Whether the request is accepted, refused, or expired."""
        if self.answer is not None:
            return self.answer.verdict is not Verdict.RECEIVED
        return self._elapsed > _GIVE_UP

    @property
    def _elapsed(self) -> float:
        return self._steady() - self._begun

    def repeat(self) -> bool:
        """Return whether the request must be sent again now."""
        due = self._repeats < min(REPEATS, int(self._elapsed / REPEAT_AFTER))
        if self.answer is not None or not due:
            return False
        self._repeats += 1
        return True

    @property
    def outcome(self) -> tuple[bool, str]:
        """Result of a request that is done: whether accepted, and one line for users."""
        if self.answer is None:
            return False, f'{self.node}: no answer to {self._topic} within {_GIVE_UP:g} s'
        verb = self.answer.verdict.value
        if self.answer.refused:
            return False, f'{self.node}: {self._topic} {verb}: {self.answer.reason}'
        return True, f'{self.node}: {self._topic} {verb}'


def no_answer(service: str) -> str:
    """Return the one-line error of a service call without a response."""
    return f'{service}: no answer within {CALL_TIMEOUT:g} s'


class WaitingRequest(NamedTuple):
    """A received request: topic, stamp [ns], moved joints, and action."""

    topic: Topic
    stamp: int
    joints: tuple[str, ...]
    act: RequestAction

    def elapsed(self, now: int) -> float:
        """Return the time since the stamp [s]; 0 without a stamp, or before it."""
        return max(0, now - self.stamp) / NANOSECONDS if self.stamp else 0.0


class WaitingRequests:
    """Requests of a log that are not executed yet: the newest of each joint."""

    def __init__(self, requests: RequestLog) -> None:
        self._requests = requests
        self._waiting: list[WaitingRequest] = []

    def add(
        self, topic: Topic, stamp: int, joints: Iterable[str], act: RequestAction
    ) -> WaitingRequest:
        """Add a request; it replaces those of the same joints."""
        request = WaitingRequest(topic, stamp, tuple(joints), act)
        self.discard(f'a newer {topic.name} is followed', request.joints)
        self._waiting.append(request)
        self._requests.answer(topic, stamp, Verdict.RECEIVED)
        return request

    def take(self, stamp: int, only: WaitingRequest | None = None) -> WaitingRequest | None:
        """Return and remove a request, or this one, that was sent before a stamp [ns], if any."""
        for one in self._waiting:
            if only is not None and one is not only:
                continue
            if one.stamp - stamp > REQUEST_AGE * NANOSECONDS:
                # The clock was set back after its arrival.
                self._drop(one, 'the clock was set back', Verdict.REJECTED)
                break
            if one.stamp < stamp:
                self._waiting.remove(one)
                return one
        return None

    def execute(
        self, until: int, context: Any, elapsed: float, only: WaitingRequest | None = None
    ) -> list[ParameterError]:
        """Execute and answer the requests, or one, sent before `until` [ns]; return the errors."""
        errors = []
        while (request := self.take(until, only)) is not None:
            topic, stamp, joints, act = request
            try:
                act(context, elapsed)
            except ParameterError as error:
                errors.append(error)
                self._requests.reject(topic, stamp, error)
            else:
                self._requests.answer(topic, stamp, Verdict.ACCEPTED, joints=joints)
        return errors

    def discard(self, reason: str, joints: Iterable[str]) -> None:
        """Discard the requests of some joints, superseded for a reason."""
        for one in [*self._waiting]:
            if {*joints} & {*one.joints}:
                self._drop(one, reason, Verdict.SUPERSEDED)

    def end(self, reason: str, verdict: Verdict = Verdict.REJECTED) -> None:
        """Discard and answer all requests, and report the end of all in execution."""
        for one in [*self._waiting]:
            self._drop(one, reason, verdict)
        self._requests.end(reason)

    def _drop(self, one: WaitingRequest, reason: str, verdict: Verdict) -> None:
        self._waiting.remove(one)
        self._requests.answer(one.topic, one.stamp, verdict, reason)
