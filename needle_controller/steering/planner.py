# SPDX-License-Identifier: Apache-2.0
"""Planner of an insertion: check its start, and compute the steering law in a job."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from needle_controller.steering.guarded_law import GuardedLaw
from needle_controller.steering.insertion_plan import Plan
from needle_controller.steering.insertion_record import PlannedInsertion, SteeringRecord
from needle_controller.steering.law import build_law, SteeringLaw
from needle_controller.steering.planning import Job, Progress, StartJob
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import (
    ContactSettings,
    ExecutiveSettings,
    SteeringPrior,
    step_depths,
)
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import longest_insertion, SteeringParameters
from needle_ros.errors import JobError, NeedleError, ParameterError
import numpy as np

_OUTSIDE: Final = 1e-3  #: Depth of a needle outside tissue, where the guide may move freely [m].
_SAME: Final = 1e-6  #: Tolerance of equal depths and targets [m].


@dataclass(slots=True, eq=False)
class InsertionPlanner:
    """Compute the law of an insertion, one at a time; arguments as for `SteeringExecutive`."""

    needle: NeedleParameters
    steering: SteeringParameters
    prior: SteeringPrior
    settings: ExecutiveSettings
    start_job: StartJob
    law: str
    plan: Plan | None = None
    contact: ContactSettings = field(default_factory=ContactSettings)
    job: Job[SteeringLaw] | None = None  #: computation under way
    request: PlannedInsertion | None = None  #: its request
    recalled: SteeringRecord | None = None  #: record of the insertion before a restart

    def advice(self, depth: float, state: int) -> str:
        """
        Return advice to the user after a restart with a needle at a depth [m], or ''.

        ``state`` is the time of the newest change of the system state [ns].
        """
        record = self.recalled
        if record is None or not depth > record.depths[0] + _OUTSIDE:
            return ''
        at = describe_target(record.target)
        if why := record.over(state):
            remedy = self._retract('the needle', float(record.depths[0]))
            return f'; the insertion to {at} has ended ({why}): {remedy}'
        return (
            f'; the insertion to {at} was interrupted in step {len(record.plans)} of '
            f'{len(record.depths) - 1}: send its target again to resume it, or retract the needle'
        )

    def prepare(
        self,
        request: PlannedInsertion,
        begun: float | None,
        tip: Sequence[float] | None,
        state: int,
    ) -> PlannedInsertion:
        """Return a request with its depths, if an insertion can begin or resume."""
        record, depth = self.recalled, float(request.at[0])
        if begun is None and record is not None:
            begun = float(record.depths[0])
            same = abs(request.point[1] - record.target[1]) <= _SAME
            if same and depth > begun + _OUTSIDE:
                try:
                    record.check(request.at, tip, state, self.settings)
                except JobError as error:
                    raise self._cannot_resume(error, begun) from error
                return request._replace(depths=np.array(record.depths), record=record)
        return request._replace(depths=self._depths(request, begun))

    def _retract(self, what: str, begun: float) -> str:
        """Return the action that permits the next insertion; the last began at a depth [m]."""
        to, own = f'{1e3 * begun:.2f} mm', self.settings.retract_depth
        deeper = f'set retract_depth to {to} (it is {1e3 * own:.2f} mm), and '
        return f'{deeper if own > begun + _OUTSIDE else ""}retract {what} to {to}'

    def _cannot_resume(self, error: NeedleError, begun: float) -> JobError:
        remedy = self._retract('the needle', begun)
        return JobError(f'the insertion cannot be resumed: {error}; {remedy} first')

    def resume(self, request: PlannedInsertion, law: GuardedLaw) -> None:
        """Restore a law to the record of its request, if it has one."""
        record, (x, _, z) = request.record, request.point
        if record is None:
            return
        try:
            record.restore(law)
        except NeedleError as error:
            raise self._cannot_resume(error, float(record.depths[0])) from error
        if np.abs(np.subtract(law.report.target, (x, z))).max() > _SAME:
            law.aim(np.array([x, z]))

    def _depths(self, request: PlannedInsertion, begun: float | None) -> FloatArray:
        """Return the depths of the steps, if an insertion can begin; the last began at a depth."""
        point, at, settings = request.point, request.at, self.settings
        if self.plan is not None and abs(point[1] - self.plan.length) > _SAME:
            raise ParameterError(
                f'the plan is to a depth of {1e3 * self.plan.length:.3f} mm, the target at '
                f'{1e3 * point[1]:.3f} mm'
            )
        if at[0] < -_OUTSIDE:
            raise JobError(f'the needle is {-1e3 * at[0]:.2f} mm before the skin')
        depth, straight = max(0.0, float(at[0])), begun or 0.0
        if begun is not None and depth > begun + _OUTSIDE:
            raise JobError(
                f'the needle is at {1e3 * depth:.2f} mm and has been steered; '
                f'{self._retract("it", begun)} first'
            )
        off = np.abs(at[1:3]).max()
        if depth > straight + _OUTSIDE and off > settings.guide_tolerance:
            raise JobError(
                f'the guide is {1e3 * off:.2f} mm off its zero with the needle at '
                f'{1e3 * depth:.2f} mm; a needle has to be straight at the start: retract it first'
            )
        if point[1] < depth + min(settings.step_length, _OUTSIDE):
            raise ParameterError(
                f'the needle is at {1e3 * depth:.2f} mm already, the target at '
                f'{1e3 * point[1]:.2f} mm'
            )
        if self.plan is not None:
            return self.plan.tip_path.since(depth).depths
        most = longest_insertion(self.needle, self.steering)
        if point[1] > most:
            raise ParameterError(
                f'the target must be at a depth of at most {1e3 * most:g} mm with this needle, '
                f'got {1e3 * point[1]:g} mm; targets are in m'
            )
        return step_depths(point[1], settings.step_length, depth)

    def start(self, request: PlannedInsertion) -> None:
        settings, depths, record = self.settings, request.depths, request.record
        # The law of a record was constructed for the target at the start.
        x, _, z = request.point if record is None else record.point
        at = request.at if record is None else record.start
        limits = settings.limits(float(request.point[1] - depths[0]) / (len(depths) - 1))
        roll, path, plan = float(at[3]) if settings.turns else 0.0, None, self.plan
        if plan is not None:
            roll, path = plan.roll, plan.tip_path.since(float(depths[0]))

        def work(progress: Progress) -> SteeringLaw:
            model = SteeringModel(
                self.needle,
                self.steering,
                depths,
                self.prior,
                together=settings.continuous,
                progress=progress,
            )
            law = build_law(self.law, model, (x, z), limits, roll, path)
            if plan is None or path is None:
                return law
            from needle_controller.steering.contact import monitored

            return monitored(law, model, plan, path, limits, self.contact)

        self.request, self.job = request, self.start_job(work)

    def take(self) -> tuple[PlannedInsertion, Job[SteeringLaw]] | None:
        """Return the request and its job once it is computed, and discard both."""
        request, job = self.request, self.job
        if request is None or job is None or not job.done:
            return None
        self.request = self.job = None
        return request, job

    def cancel(self) -> PlannedInsertion | None:
        """Cancel the computation and return its request, None without one."""
        request, job = self.request, self.job
        self.request = self.job = None
        if job is not None:
            job.cancel()
        return request


def describe_target(point: tuple[float, float, float]) -> str:
    """Describe a target x, y, z [m] for users."""
    x, y, z = (1e3 * one for one in point)
    return f'x = {x:.2f} mm, z = {z:.2f} mm at a depth of {y:.2f} mm'


def check_plan(plan: Plan, settings: ExecutiveSettings) -> None:
    """Raise `ParameterError` if an insertion cannot follow a plan within its settings."""
    travel = np.abs(np.diff(plan.guide, axis=0, prepend=0.0)).max()
    for name, found in (('guide_limit', np.abs(plan.guide).max()), ('guide_step', travel)):
        most = getattr(settings, name)
        if found > most + _SAME:
            raise ParameterError(
                f'the plan needs {name} >= {1e3 * found:.3f} mm, got {1e3 * most:g} mm'
            )
    if plan.guide[0].any():
        raise ParameterError('the plan must have a guide at zero in its first step')
    for name in ('continuous', 'turns'):
        if getattr(settings, name):
            raise ParameterError(f'{name} must be 0 with a plan, got {getattr(settings, name)}')
