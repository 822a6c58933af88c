# SPDX-License-Identifier: Apache-2.0
"""Record of a steered insertion and its file, from which a restarted executive resumes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
import json
import os
from pathlib import Path
from threading import Lock
from typing import Any, Final, NamedTuple

from needle_controller.steering.continuous import ContinuousInsertion
from needle_controller.steering.guarded_law import GuardedLaw
from needle_controller.steering.insertion import SteppedInsertion
from needle_controller.steering.motion_control import LAGGING
from needle_controller.steering.planning import ThreadJob
from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics.arrays import FloatArray
from needle_ros.errors import JobError, MessageError, ParameterError
from needle_ros.files import write_whole
from needle_ros.status import SteeringPhase
from needle_ros.system_state import Authority
import numpy as np

_STEEPEST: Final = 0.5  #: Largest slope of the path of a tip.
_SAME: Final = 1e-9  #: Tolerance of a computed setpoint [m, rad].

_LONGEST: Final = 0.05  #: Longest time that a callback waits for the disk [s].


class PlannedInsertion(NamedTuple):
    """Request of an insertion."""

    stamp: int  #: Stamp of its message [ns].
    point: tuple[float, float, float]  #: Target of the tip, x, y, z [m].
    at: FloatArray  #: Positions of the joints now [m, rad].
    depths: FloatArray = np.empty(0)  #: Depths of the tip measurements [m], shape (n + 1,).
    record: SteeringRecord | None = None  #: Record of the insertion that is resumed, if it is.


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringRecord:
    """Plan and estimate of an insertion; its fields are values of JSON."""

    point: Sequence[float]  #: target of the tip at the start, x, y, z [m]
    depths: Sequence[float]  #: depths of the tip measurements [m]
    start: Sequence[float]  #: positions of the joints at the start [m, rad]
    continuous: bool  #: whether the needle is inserted without rests
    history: Sequence[Mapping[str, Any]]  #: `GuardedLaw.history`, which determines the estimate
    #: Expected position of the tip at the target depth, x, z [m], and its covariance [m^2].
    expected: Sequence[float]
    covariance: Sequence[Sequence[float]]
    ended: str  #: reason why it has ended, '' while it is under way
    state: int  #: time of the newest change of the system state [ns]

    def to_values(self) -> dict[str, Any]:
        """Return the fields as values of JSON."""
        return asdict(self)

    @classmethod
    def from_values(cls, values: Any) -> SteeringRecord:
        """Parse the values of `to_values`, or raise `MessageError`."""
        try:
            return cls(**values)
        except TypeError as error:
            raise MessageError(f'not a record of an insertion: {error}') from error

    @property
    def target(self) -> tuple[float, float, float]:
        """Newest target of the tip, x, y, z [m]."""
        aims = [entry['aim'] for entry in self.history if 'aim' in entry]
        x, z = aims[-1] if aims else (self.point[0], self.point[2])
        return x, self.depths[-1], z

    @property
    def plans(self) -> list[Sequence[float]]:
        """Setpoints so far: guide at x, z [m], roll [rad]."""
        return [entry['plan'] for entry in self.history if 'plan' in entry]

    def over(self, state: int) -> str:
        """Return why it cannot be continued at a time of the newest system state [ns], or ''."""
        if self.ended or state <= self.state:
            return self.ended
        return 'the system was stopped, paused or retracted'

    def check(
        self, at: FloatArray, tip: Sequence[float] | None, state: int, own: ExecutiveSettings
    ) -> None:
        """Raise `JobError` if joints [m, rad], tip x, y, z [m] or state [ns] have changed."""
        if why := self.over(state):
            raise JobError(why)
        if self.continuous or own.continuous:
            raise JobError('the needle is inserted without rests')
        before, goal = self._motion
        low = np.minimum(before, goal)[: len(at)] - LAGGING * own.tolerances
        high = np.maximum(before, goal)[: len(at)] + LAGGING * own.tolerances
        for k in np.flatnonzero((at < low) | (at > high)):
            raise JobError(
                f'{own.joints[k]} is at {at[k]:.5f}, outside its last motion from {before[k]:.5f} '
                f'to {goal[k]:.5f}'
            )
        self._check_tip(float(at[0]), tip, own.slip_tolerance)

    @property
    def _motion(self) -> tuple[FloatArray, FloatArray]:
        """Positions between which the joints are: the last depth and setpoint, and the next."""
        roll = self.start[3] if len(self.start) > len('xyz') else 0.0
        plans, step = [(0.0, 0.0, roll), *self.plans], len(self.plans)
        before = np.array([self.depths[max(step - 1, 0)], *plans[max(step - 1, 0)]])
        return before, np.array([self.depths[min(step, len(self.depths) - 1)], *plans[step]])

    def _check_tip(self, depth: float, tip: Sequence[float] | None, slip: float) -> None:
        measured = [entry for entry in self.history if entry.get('tip') is not None]
        if tip is None or not measured:
            raise JobError('the tip is not measured')
        last = measured[-1]
        off, moved = np.subtract(tip, last['tip']), depth - last['depth']
        across = slip + _STEEPEST * abs(moved)
        if abs(off[1] - moved) > slip or np.hypot(off[0], off[2]) > across:
            x, y, z = (1e3 * off).tolist()
            raise JobError(
                f'the tip has moved by {x:.2f}, {y:.2f}, {z:.2f} mm since its last measurement, '
                f'the needle by {1e3 * moved:.2f} mm'
            )

    def restore(self, law: GuardedLaw) -> None:
        """Repeat the inputs of a law, or raise `JobError` if it does not plan the same."""
        for entry in self.history:
            if 'plan' not in entry:
                law.repeat(entry)
            elif np.abs(np.subtract(law.plan(), entry['plan'])).max() > _SAME:
                raise JobError('its law or constants have changed')


class RecordKeeper:
    """The record of the latest insertion, created when it has changed."""

    def __init__(self) -> None:
        self._insertion: SteppedInsertion | None = None
        self._key: tuple[Any, ...] = ()

    def begin(
        self, request: PlannedInsertion, insertion: SteppedInsertion, authority: Authority
    ) -> None:
        """Keep the record of an insertion from now on."""
        self._insertion, self._request, self._authority = insertion, request, authority

    def changed(self, fault: str) -> SteeringRecord | None:
        """Return the record if it has changed since the last call; ``fault`` ends it."""
        insertion = self._insertion
        if insertion is None:
            return None
        law, request, state = insertion.law, self._request, self._authority.state.newest
        ended = fault or ('it is done' if insertion.phase is SteeringPhase.DONE else '')
        if self._key == (key := (law, len(law.history), ended, state)):
            return None
        self._key, there, before = key, law.expected, request.record
        return SteeringRecord(
            point=request.point if before is None else before.point,
            depths=law.depths.tolist(),
            start=request.at.tolist() if before is None else before.start,
            continuous=isinstance(insertion, ContinuousInsertion),
            history=law.history,
            expected=[] if there is None else there.mean.tolist(),
            covariance=[] if there is None else there.covariance.tolist(),
            ended=ended,
            state=state,
        )


class RecordFile:
    """
    The record of a node on a domain, and the source of its measurements.

    The source identifies the process of the robot: with another one, the needle may be another.
    Threads read and write, so that a disk without a response delays a callback by 0.05 s at most.
    """

    def __init__(self, node: str, domain: int) -> None:
        home = Path(os.environ.get('ROS_HOME') or Path.home() / '.ros')
        name = node.strip('/').replace('/', '.')
        self._path = home / 'needle_insertion' / f'{name}.{domain}.json'
        self._lock = Lock()
        #: Newest content that the thread has not begun to write, and the thread while it writes.
        self._next: bytes | None = None
        self._writer: ThreadJob[None] | None = None

    def write(self, record: str, source: str) -> None:
        """
        Replace the file, or raise `ParameterError`.

        A file that is not replaced within 0.05 s is an error, too; its thread continues.
        """
        with self._lock:
            self._next = json.dumps({'source': source, 'record': record}).encode()
            if self._writer is None:
                self._writer = ThreadJob(self._write)
            writer = self._writer
        if not writer.wait(_LONGEST):
            raise ParameterError(f'{self._path} is not written within {_LONGEST:g} s')
        writer.result()

    def _write(self, _progress: Any) -> None:
        """Write the newest content until there is none; raise the error of the last one."""
        failed: ParameterError | None = None
        while True:
            with self._lock:
                content, self._next = self._next, None
                if content is None:
                    self._writer = None
                    break
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_whole(self._path, content)
                failed = None
            except OSError as error:
                failed = ParameterError(f'{self._path} cannot be written: {error.strerror}')
            except ParameterError as error:
                failed = error
        if failed is not None:
            raise failed

    def read(self) -> tuple[SteeringRecord, str] | None:
        """Return the record and its source; None without a file, `MessageError` if invalid."""
        reader = ThreadJob(self._read)
        if not reader.wait(_LONGEST):
            raise MessageError(f'{self._path} is not read within {_LONGEST:g} s')
        return reader.result()

    def _read(self, _progress: Any) -> tuple[SteeringRecord, str] | None:
        try:
            content = json.loads(self._path.read_bytes())
            record = SteeringRecord.from_values(json.loads(content['record']))
            return record, str(content['source'])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise MessageError(f'{self._path} cannot be read: {error}') from error
