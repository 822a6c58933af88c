# SPDX-License-Identifier: Apache-2.0
"""Base of the state machines: event log, request log, clock, and checks of the inputs."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, TypeVar

from needle_controller.safety.input_monitor import InputMonitor, Refusal
from needle_ros.contract import ENTRY, INSERTION, Topic
from needle_ros.errors import NeedleError
from needle_ros.event_log import EventLog, Severity
from needle_ros.requests import RequestLog, Verdict
from needle_ros.system_state import Authority, Mode
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading

_Command = TypeVar('_Command')


class StateMachine(ABC, Generic[_Command]):
    """
    Events, requests, clock and inputs of the axial supervisor and the steering executive.

    `authority` is the state of the whole system, which the machine follows. `steady` is as for
    `EventLog`, `takes` as for `RequestLog`. Times are in ns; a command of None publishes nothing.
    """

    def __init__(self, steady: Callable[[], float], takes: Mapping[Topic, Sequence[str]]) -> None:
        self._steady = steady
        self.events = EventLog(steady)
        self.authority = Authority()
        #: Mode of the system that is followed, and time of the retraction that is followed [ns].
        self._obeyed = Mode.RUNNING
        self._retracted = 0
        self._time = 0  #: Time of the last event [ns].
        self._take_requests(takes)

    def _take_requests(self, takes: Mapping[Topic, Sequence[str]]) -> None:
        self.requests = RequestLog(takes, ('', ENTRY), self._steady)

    def request(self, word: str, now: int) -> tuple[bool, str, _Command | None]:
        """Execute a request of a user; return whether, one line for the user, and the command."""
        success, message = self.authority.request(word, self._obstacle(word, now))
        if not success:
            self.events.reject(message)
        return success, message, self.obey(now)

    @abstractmethod
    def _obstacle(self, word: str, now: int, /) -> str:
        """Return why a request of a user cannot be executed, or ''."""

    def obey(self, now: int) -> _Command | None:
        """Follow the state of the system; return the command to publish."""
        mode, before = self.authority.mode, self._obeyed
        new, self._retracted = self.authority.compare(before, self._retracted)
        self._obeyed = mode
        if not new:
            return None
        self.events.add(Severity.INFO)
        return self._change_mode(mode, before, now)

    @abstractmethod
    def _change_mode(self, mode: Mode, before: Mode, now: int, /) -> _Command | None:
        """Stop, pause, retract or continue; return the command to publish."""

    def _end_retraction(self) -> None:
        self.authority.run()
        self._obeyed = self.authority.mode

    def _is_new(self, topic: Topic, stamp: int, frame: str, now: int) -> bool:
        """Return whether a request must be executed; log why it is rejected."""
        known = self.requests.check(topic, stamp, now, frame, (INSERTION,))
        if known is not None and known.verdict in (Verdict.REJECTED, Verdict.LATE):
            self.events.reject(f'{topic.name} rejected: {known.reason}')
        return known is None

    def _accept(self, topic: Topic, stamp: int, verdict: Verdict = Verdict.ACCEPTED) -> None:
        self.requests.answer(topic, stamp, verdict, joints=(INSERTION,))

    def _reject(self, topic: Topic, stamp: int, reason: str | NeedleError) -> None:
        self.events.reject(f'{topic.name} rejected: {reason}')
        self.requests.reject(topic, stamp, reason)

    def clock_went_back(self, now: int, tolerance: int) -> float:
        """Return the step back of the clock since the last call [s], or 0; `tolerance` in ns."""
        back, self._time = self._time - now, now
        return back / NANOSECONDS if back > tolerance else 0.0

    def _is_valid(
        self, stream: InputMonitor, reading: Reading, values: Sequence[float], now: int
    ) -> bool:
        """Return whether a measurement is valid; report the reason if not."""
        refusal = stream.check(reading.stamp, now, reading.frame, values)
        if refusal is not None and not refusal.harmless:
            self._report(stream, refusal)
        return refusal is None

    @abstractmethod
    def _report(self, stream: InputMonitor, refusal: Refusal) -> None:
        """Log that a measurement is refused."""
