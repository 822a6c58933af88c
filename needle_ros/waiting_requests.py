# SPDX-License-Identifier: Apache-2.0
"""Requests that wait for the first sample after their stamp."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeAlias

from needle_ros.contract import REQUEST_AGE, Topic
from needle_ros.errors import ParameterError
from needle_ros.requests import RequestLog, Verdict
from needle_ros.timing import NANOSECONDS

#: Executes a request with an object of the caller and the time since the stamp [s], or raises.
RequestAction: TypeAlias = Callable[[Any, float], None]


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
        for one in [one for one in self._waiting if only is None or one is only]:
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
