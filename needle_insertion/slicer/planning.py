# SPDX-License-Identifier: Apache-2.0
"""Plans for a segmentation and a target of 3D Slicer, computed as jobs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_controller.steering.insertion_plan import Plan, write_plan
from needle_controller.steering.planning import Job, Progress, StartJob, ThreadJob
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics.arrays import FloatArray
from needle_dynamics.needles import DEFAULT_NEEDLE, find_needle
from needle_insertion.slicer.link import Frame
from needle_insertion.slicer.needle import MILLIMETERS
from needle_insertion.slicer.plan_files import planned_shape, PlannedShape
from needle_planning.anatomy import Anatomy, plan_warnings
from needle_planning.labels import anatomy_of, read_labels
from needle_planning.planner import find_plan
from needle_planning.voxels import Layer
from needle_ros.errors import NeedleError, ParameterError, printable
from needle_ros.event_log import EventLog, Severity
from needle_ros.settings import flag, text

_WAITING: Final = 'waits for the label map SEGMENTATION and a target'


@dataclass(frozen=True, slots=True, kw_only=True)
class SlicerPlanSettings(SteeringLimits):
    """Files, needle and limits of the plans for segmentations of 3D Slicer."""

    labels: str = text(
        '', 'file with the role of each label: a label map and a target from 3D Slicer become a '
        'plan, and no target is published; empty: no plans',
    )  # fmt: skip
    output: str = text(
        '', 'file to write each plan to, which replaces the plan before; empty: not written'
    )
    needle: str = text(DEFAULT_NEEDLE, 'needle of the plans')
    straight: bool = flag(False, 'straight needles only')

    def __post_init__(self) -> None:
        SteeringLimits.__post_init__(self)
        if self.turns:
            raise ParameterError(f'turns must be 0: a plan has none, got {self.turns}')
        find_needle(self.needle)
        if self.output and not Path(self.output).absolute().parent.is_dir():
            raise ParameterError(f'output: {Path(self.output).parent} is not a folder')


class _Found(NamedTuple):
    """Result of a job that plans."""

    plan: Plan
    shape: PlannedShape
    warnings: list[str]  #: Lines of target and entry point.


class SlicerPlanner:
    """
    Planner of the newest segmentation and target; one job at a time reads or plans.

    Parameters
    ----------
    settings : SlicerPlanSettings
        Settings with a file of labels, which is read here and for each segmentation.
    read : callable
        Reads the label map of a message; NeedleError if it is invalid.
    events : EventLog
        Log for results and rejections.
    shape : PlannedShape, optional
        Needle to show before the first plan.
    start : callable
        Starts a job.

    """

    def __init__(
        self,
        settings: SlicerPlanSettings,
        read: Callable[[Frame], Layer],
        events: EventLog,
        shape: PlannedShape | None = None,
        start: StartJob = ThreadJob,
    ) -> None:
        #: Line about the inputs and the last plan, and why the last target was refused.
        self._line, self._refused = _WAITING, ''
        self.shape = shape  #: Needle of the last plan, None after a failure.
        #: Whether a peer may show a needle that is not of the newest inputs.
        self._shown = shape is not None
        self._settings, self._read, self._events, self._start = settings, read, events, start
        read_labels(settings.labels)
        #: Newest segmentation, until it is read, and then its anatomies.
        self._frame: Frame | None = None
        self._anatomies: tuple[Anatomy, ...] = ()
        self._target: FloatArray | None = None
        #: Whether segmentation and target are planned, or this has failed.
        self._planned = False
        self._job: tuple[Job[Any], Callable[[Job[Any]], None]] | None = None

    @property
    def state(self) -> str:
        """One line for users."""
        return '; '.join(filter(None, (self._refused, self._line)))

    def take_segmentation(self, frame: Frame) -> None:
        """Replace the segmentation."""
        self._frame, self._anatomies, self._planned = frame, (), False
        self.close()

    def take_target(self, position: FloatArray) -> None:
        """Replace the target: position in the images, shape (3,) [mm]."""
        self._target, self._planned, self._refused = position, False, ''
        # Without anatomies, a job reads the segmentation.
        if self._anatomies:
            self.close()
        elif self._job is None and self._frame is None:
            self._report(f'{_words(position)}; waits for the label map SEGMENTATION')

    def refuse_target(self, reason: str) -> None:
        """Discard the target, because the next one is invalid."""
        if self._anatomies:
            self.close()
            self._line = 'waits for a target'
        elif self._target is not None:
            self._line = _WAITING
        self._target = None
        self._refused = printable(self._failed(f'target refused: {reason}'))
        self._events.reject(self._refused)

    def poll(self) -> None:
        """End the job that is done, and start the next one."""
        if self._job is not None and self._job[0].done:
            (job, end), self._job = self._job, None
            if not job.cancelled:
                end(job)
        if self._job is None:
            self._begin()

    def close(self) -> None:
        """Cancel the job."""
        if self._job is not None:
            self._job[0].cancel()

    def _begin(self) -> None:
        target, anatomies = self._target, self._anatomies
        if (frame := self._frame) is not None:
            self._frame = None
            self._report('reads the segmentation')

            def read(_: Progress) -> tuple[Anatomy, ...]:
                # The user may have corrected it.
                labels = read_labels(self._settings.labels)
                layers = [(frame.device, self._read(frame))]
                return anatomy_of(layers, labels, self._settings.labels)

            self._job = self._start(read), self._end_reading
        elif anatomies and target is not None and not self._planned:
            self._planned = True
            self._report(f'plans for the {_words(target)}')

            def plan(progress: Progress) -> _Found:
                return self._plan(anatomies, target, progress)

            self._job = self._start(plan), self._end_planning

    def _plan(
        self, anatomies: tuple[Anatomy, ...], target: FloatArray, progress: Progress
    ) -> _Found:
        settings, at = self._settings, target / MILLIMETERS
        plan = find_plan(
            anatomies,
            at,
            needle=settings.needle,
            limits=settings,
            bow=not settings.straight,
            # It raises an error after a cancellation.
            progress=lambda _: progress(0, 1),
        )
        warnings = plan_warnings(anatomies, plan.target, plan.entry, plan.direction)
        return _Found(plan, planned_shape(plan), warnings)

    def _end_reading(self, job: Job[Any]) -> None:
        try:
            self._anatomies = job.result()
        except (NeedleError, MemoryError) as error:
            self._line = printable(self._failed(f'segmentation refused: {_reason(error)}'))
            self._events.reject(self._line)
            return
        count = sum(len(one.structures) for one in self._anatomies)
        waits = '' if self._target is not None else '; waits for a target'
        self._report(f'segmentation with {count} structures{waits}')

    def _end_planning(self, job: Job[Any]) -> None:
        target = _words(self._target)
        try:
            plan, self.shape, warnings = job.result()
            self._shown = True
        except (NeedleError, MemoryError) as error:
            line = self._failed(f'no plan for the {target}: {_reason(error)}')
            self._report(line, Severity.ERROR)
            return
        kind = 'bowed' if plan.guide.any() else 'straight'
        near = f' to {plan.structure}' if plan.structure else ' to all obstacles'
        line = (
            f'plan for the {target}: {kind}, entry {_point(MILLIMETERS * plan.entry)} mm, '
            f'clearance {"at least " * plan.at_limit}{MILLIMETERS * plan.clearance:.2f} mm{near}'
        )
        line = '; '.join([line, *warnings])
        severity = Severity.WARNING if warnings else Severity.INFO
        if self._settings.output:
            try:
                write_plan(plan, self._settings.output)
                line += f'; wrote {self._settings.output}'
            except ParameterError as error:
                line, severity = f'{line}; not written: {error}', Severity.ERROR
        self._report(line, severity)

    def _failed(self, line: str) -> str:
        """Forget the needle of an earlier plan; return a line with a note if it is shown."""
        self.shape = None
        return line + '; the needle shown is of an earlier plan' * self._shown

    def _report(self, line: str, severity: Severity = Severity.INFO) -> None:
        self._line = printable(line)
        self._events.add(severity, line)


def _point(at: FloatArray) -> str:
    return f'({", ".join(f"{one:.1f}" for one in at.tolist())})'


def _words(target: FloatArray | None) -> str:
    return 'target' if target is None else f'target {_point(target)} mm'


def _reason(error: Exception) -> str:
    return 'it exceeds the memory' if isinstance(error, MemoryError) else str(error)
