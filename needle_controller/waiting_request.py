"""Requests of the axial supervisor: they wait for the first sample after their stamp."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from needle_controller.controller import Controller
from needle_ros.contract import INSERTION, Topic
from needle_ros.errors import ParameterError
from needle_ros.requests import RequestLog, Verdict
from needle_ros.trajectories import joint_values, MOST_POINTS, Points


class AxialRequest(NamedTuple):
    """A received request: topic, stamp [ns], and execution, which raises its errors."""

    topic: Topic
    stamp: int
    execute: Callable[[Controller], None]


class WaitingRequest:
    """The newest request of a log, until it is executed or discarded."""

    def __init__(self, requests: RequestLog) -> None:
        self._requests = requests
        self._request: AxialRequest | None = None

    def set(self, request: AxialRequest) -> None:
        """Replace the request."""
        self.discard(f'a newer {request.topic.name} is followed', Verdict.SUPERSEDED)
        self._request = request
        self._requests.answer(request.topic, request.stamp, Verdict.RECEIVED)

    def take(self, stamp: int) -> AxialRequest | None:
        """Return and remove the request if it was sent before a stamp [ns]."""
        request = self._request
        if request is None or request.stamp >= stamp:
            return None
        self._request = None
        return request

    def discard(self, reason: str, verdict: Verdict = Verdict.REJECTED) -> None:
        """Discard the request, if any, and answer it."""
        request, self._request = self._request, None
        if request is not None:
            self._requests.answer(request.topic, request.stamp, verdict, reason)


class JointPath(NamedTuple):
    """Path of joints: times from now [s], positions [m] and velocities [m/s] or none, by joint."""

    joints: Sequence[str]
    times: Sequence[float]
    positions: Points
    velocities: Points = ()


def follow_path(controller: Controller, path: JointPath) -> None:
    """Follow the insertion in a path."""
    joints, times, positions, velocities = path
    if len(times) > MOST_POINTS:
        raise ParameterError(f'a path may have at most {MOST_POINTS} points')
    lengths, rates = (
        [one for one in joint_values(INSERTION, joints, values) if one is not None]
        for values in (positions, velocities)
    )
    controller.follow(times, lengths, rates or None)
