"""
Requests on topics and their acknowledgement in the status of the node that receives them.

A request is a message on a topic whose stamp is `Stamp.REQUEST` in the contract: a target or a
trajectory. Its receiver answers through its status on ``/diagnostics``, at once and again each
second, so that a lost message is healed. The sender repeats the request until it is answered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from time import monotonic
from typing import Final

from needle_ros.contract import REQUEST_AGE, Stamp, Topic
from needle_ros.errors import printable
from needle_ros.timing import apart, NANOSECONDS

#: Time without an answer after which a request is repeated [s], and the number of repetitions.
REPEAT_AFTER: Final = 1.0
REPEATS: Final = 3

#: Time after which a request without an answer has failed [s]: a receiver that gets it later
#: rejects it as stale, so that it is not executed after that.
_GIVE_UP: Final = REQUEST_AGE + 1.0

#: Time after which the call of a service without an answer has failed [s]: longer than a node
#: needs on a slow machine.
CALL_TIMEOUT: Final = 10.0

#: Acknowledgements that a status contains, and that are kept to recognize duplicates.
_PUBLISHED: Final = 8
_KEPT: Final = 64

#: Shortest time between two statuses that are published for an acknowledgement [s].
_PAUSE: Final = 0.05

#: Keys in a status, and beginnings of keys.
_TAKES: Final = 'takes '
_REQUEST: Final = 'request '
_PAUSED: Final = 'paused'

_MOST_AGE: Final = round(REQUEST_AGE * NANOSECONDS)


class Verdict(Enum):
    """The answer of a receiver to a request."""

    #: Received and being examined; another verdict follows.
    RECEIVED = 'received'
    ACCEPTED = 'accepted'
    REJECTED = 'rejected'
    #: Not executed, because the receiver follows a newer request.
    SUPERSEDED = 'superseded'


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """
    The answer of a receiver to one request.

    Attributes
    ----------
    topic : str
        Topic of the request, as the contract names it.
    stamp : int
        Stamp of its message [ns]; 0 for a message without a stamp.
    verdict : Verdict
        The answer.
    reason : str
        Why it was not accepted, for people.

    """

    topic: str
    stamp: int
    verdict: Verdict
    reason: str = ''

    @property
    def refused(self) -> bool:
        """Whether the request is not executed."""
        return self.verdict in (Verdict.REJECTED, Verdict.SUPERSEDED)


@dataclass(frozen=True, slots=True)
class RequestStatus:
    """
    The requests that a node takes and its latest answers: typed fields of its status.

    Attributes
    ----------
    takes : Mapping of str to tuple of str
        Joints that it moves, by topic of the request.
    answers : tuple of Acknowledgement
        Its latest answers, the newest last.
    paused : bool
        Whether a person has paused its motion: it may take any time.

    """

    takes: Mapping[str, tuple[str, ...]]
    answers: tuple[Acknowledgement, ...] = ()
    paused: bool = False

    def to_values(self) -> dict[str, object]:
        """Return the fields as values of a DiagnosticStatus."""
        values: dict[str, object] = {
            f'{_TAKES}{topic}': ', '.join(joints) for topic, joints in self.takes.items()
        }
        values[_PAUSED] = self.paused
        for one in self.answers:
            key = f'{_REQUEST}{one.topic} {one.stamp}'
            values[key] = f'{one.verdict.value}: {one.reason}' if one.reason else one.verdict.value
        return values

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> RequestStatus:
        """
        Read the fields from values of a DiagnosticStatus.

        Parameters
        ----------
        values : Mapping of str to str
            Values by key; other values are left out.

        Returns
        -------
        RequestStatus
            The fields.

        """
        takes: dict[str, tuple[str, ...]] = {}
        answers = []
        for key, value in values.items():
            if key.startswith(_TAKES):
                takes[key[len(_TAKES) :]] = tuple(filter(None, value.split(', ')))
            elif key.startswith(_REQUEST):
                topic, _, stamp = key[len(_REQUEST) :].rpartition(' ')
                verdict, _, reason = value.partition(': ')
                if stamp.isdecimal() and verdict in _VERDICTS:
                    answers.append(Acknowledgement(topic, int(stamp), Verdict(verdict), reason))
        return cls(takes, tuple(answers), values.get(_PAUSED) == str(True))

    def answer_to(self, topic: str, stamp: int) -> Acknowledgement | None:
        """
        Return the answer to a request.

        Parameters
        ----------
        topic : str
            Its topic.
        stamp : int
            Its stamp [ns].

        Returns
        -------
        Acknowledgement or None
            The answer; None without an answer.

        """
        for one in self.answers:
            if (one.topic, one.stamp) == (topic, stamp):
                return one
        return None


_VERDICTS: Final = {one.value for one in Verdict}


class RequestLog:
    """
    Receive each request once, in the order of the stamps, and record the answers.

    Parameters
    ----------
    takes : Mapping of Topic to sequence of str
        Joints that the node moves, by topic of the request.
    frames : sequence of str
        Valid frames of a request.
    steady : callable
        Returns the time of a clock that never jumps [s].

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
        #: Stamp of the newest request that was accepted, by joint [ns].
        self._newest: dict[str, int] = {}
        self._changed = False
        self._published = -_PAUSE

    def forget(self) -> None:
        """Forget all requests: after a start, or when the clock was set back."""
        self._answers.clear()
        self._newest.clear()

    def check(
        self, topic: Topic, stamp: int, now: int, frame: str = '', joints: Iterable[str] = ()
    ) -> Acknowledgement | None:
        """
        Check whether a request is new; else answer it.

        Parameters
        ----------
        topic : Topic
            Topic of the request.
        stamp : int
            Stamp of its message [ns]; 0 for none: it counts as new.
        now : int
            Time [ns].
        frame : str
            Its frame.
        joints : iterable of str
            Joints that it moves.

        Returns
        -------
        Acknowledgement or None
            None if it is to be executed; the caller then answers it. Otherwise the answer: that
            of the first time for a duplicate, and a refusal for a request that is stale, in a
            wrong frame, or older than the one that is followed.

        """
        known = self._answers.get((topic.name, stamp)) if stamp else None
        if known is not None:
            # The status with the answer may have been lost.
            self._changed = True
            return known
        verdict, reason = Verdict.REJECTED, ''
        if stamp and not -_MOST_AGE <= now - stamp <= _MOST_AGE:
            reason = f'{topic.name} is stale: its stamp is {apart(now - stamp)}'
        elif frame not in self._frames:
            valid = ' or '.join(map(repr, self._frames))
            reason = f'{topic.name} must be in frame {valid}, got {frame!r}'
        elif stamp and any(stamp < self._follows(joint, now) for joint in joints):
            verdict, reason = Verdict.SUPERSEDED, 'a newer request has priority'
        return self.answer(topic, stamp, verdict, reason) if reason else None

    def _follows(self, joint: str, now: int) -> int:
        newest = self._newest.get(joint, 0)
        # The clock was set back since.
        return newest if newest <= now + _MOST_AGE else 0

    def answer(
        self,
        topic: Topic,
        stamp: int,
        verdict: Verdict,
        reason: str = '',
        joints: Iterable[str] = (),
    ) -> Acknowledgement:
        """
        Record the answer to a request.

        Parameters
        ----------
        topic, stamp, joints
            As for `check`.
        verdict : Verdict
            The answer.
        reason : str
            Why it is not accepted.

        Returns
        -------
        Acknowledgement
            The answer.

        """
        made = Acknowledgement(topic.name, stamp, verdict, printable(reason))
        if stamp and not made.refused:
            for joint in joints:
                self._newest[joint] = max(stamp, self._newest.get(joint, 0))
        # The newest last.
        self._answers.pop((topic.name, stamp), None)
        self._answers[topic.name, stamp] = made
        while len(self._answers) > _KEPT:
            del self._answers[next(iter(self._answers))]
        self._changed = True
        return made

    def supersede(self, now: int) -> None:
        """
        Supersede all requests that were sent before now: a stop, or a retraction, has priority.

        Parameters
        ----------
        now : int
            Time [ns].

        """
        for joints in self._takes.values():
            for joint in joints:
                self._newest[joint] = max(now, self._newest.get(joint, 0))

    def due(self) -> bool:
        """
        Return whether the status is to be published now, for an answer that is not in it yet.

        Call it after each request and with a timer of at most 0.1 s: so many requests at once do
        not lead to as many statuses.
        """
        now = self._steady()
        if not self._changed or now - self._published < _PAUSE:
            return False
        self._changed, self._published = False, now
        return True

    def status(self, *, paused: bool = False) -> RequestStatus:
        """
        Return the fields of the status.

        Parameters
        ----------
        paused : bool
            As in `RequestStatus`.

        Returns
        -------
        RequestStatus
            The fields, with the latest answers.

        """
        answers = tuple(self._answers.values())[-_PUBLISHED:]
        return RequestStatus(self._takes, answers, paused)


class PendingRequest:
    """
    A request that is repeated until it is answered.

    Parameters
    ----------
    topic : Topic
        Its topic.
    stamp : int
        Its stamp [ns], which all repetitions have, so that it is executed once.
    node : str
        Name of the node that should answer.
    steady : callable
        Returns the time of a clock that never jumps [s].

    Attributes
    ----------
    answer : Acknowledgement or None
        The latest answer.
    node : str
        Name of the node that should answer, or has answered.

    """

    def __init__(
        self, topic: Topic, stamp: int, node: str, steady: Callable[[], float] = monotonic
    ) -> None:
        self._topic, self._stamp, self._steady = topic.name, stamp, steady
        self._begun, self._repeats = steady(), 0
        self.answer: Acknowledgement | None = None
        self.node = node

    def hear(self, node: str, status: RequestStatus) -> None:
        """
        Take the status of a node.

        Parameters
        ----------
        node : str
            Its name.
        status : RequestStatus
            Its status.

        """
        answer = status.answer_to(self._topic, self._stamp)
        if answer is not None and (self.answer is None or not self.done):
            self.answer, self.node = answer, node

    @property
    def done(self) -> bool:
        """Whether it is accepted, refused, or so old that no node accepts it any more."""
        if self.answer is not None:
            return self.answer.verdict is not Verdict.RECEIVED
        return self._elapsed > _GIVE_UP

    @property
    def _elapsed(self) -> float:
        return self._steady() - self._begun

    def repeat(self) -> bool:
        """Return whether it is to be sent again now."""
        due = self._repeats < min(REPEATS, int(self._elapsed / REPEAT_AFTER))
        if self.answer is not None or not due:
            return False
        self._repeats += 1
        return True

    @property
    def outcome(self) -> tuple[bool, str]:
        """Whether it was accepted, and one line for people; once it is done."""
        if self.answer is None:
            return False, f'{self.node}: no answer to {self._topic} within {_GIVE_UP:g} s'
        verb = self.answer.verdict.value
        if self.answer.refused:
            return False, f'{self.node}: {self._topic} {verb}: {self.answer.reason}'
        return True, f'{self.node}: {self._topic} {verb}'


def no_answer(service: str) -> str:
    """
    Return the error of a call without an answer, in one line.

    Parameters
    ----------
    service : str
        Names of node and service.

    Returns
    -------
    str
        The error.

    """
    return f'{service}: no answer within {CALL_TIMEOUT:g} s'
