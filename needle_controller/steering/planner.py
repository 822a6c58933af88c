"""Planner of an insertion: check its start, and compute the steering law in a job."""

from __future__ import annotations

from math import ceil
from typing import Final, NamedTuple

from needle_controller.steering.law import build_law, SteeringLaw
from needle_controller.steering.planning import Job, Progress, StartJob
from needle_controller.steering.prior import SteeringPrior
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.errors import JobError, ParameterError
import numpy as np

#: Largest depth of a needle outside tissue, where the guide may move freely [m].
_OUTSIDE: Final = 1e-3

#: Tolerance of equal numbers of steps.
_SAME: Final = 1e-6

#: Most steps of a plan.
_MOST_STEPS: Final = 200


class PlannedInsertion(NamedTuple):
    """Request of an insertion."""

    #: Stamp of its message [ns].
    stamp: int
    #: Target of the tip, x, y, z [m].
    point: tuple[float, float, float]
    #: Depths of the tip measurements [m], shape (n + 1,).
    depths: FloatArray
    #: Positions of the joints at its start [m, rad].
    at: FloatArray


class InsertionPlanner:
    """Compute the law of an insertion, one at a time; arguments as for `SteeringExecutive`."""

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters,
        prior: SteeringPrior,
        settings: ExecutiveSettings,
        start: StartJob,
        law: str,
    ) -> None:
        self._needle, self._steering, self.prior = needle, steering, prior
        self._settings, self._start, self._law = settings, start, law
        #: Computation under way, and its request.
        self.job: Job[SteeringLaw] | None = None
        self.request: PlannedInsertion | None = None

    def depths(
        self, point: tuple[float, float, float], at: FloatArray, begun: float | None
    ) -> FloatArray:
        """
        Return the depths of the steps to a target, if an insertion can begin.

        ``at`` are the positions of the joints [m, rad], and ``begun`` is the depth at which the
        last insertion began, if there was one [m].
        """
        settings = self._settings
        if at[0] < -_OUTSIDE:
            raise JobError(f'the needle is {-1e3 * at[0]:.2f} mm before the skin')
        depth, straight = max(0.0, float(at[0])), begun or 0.0
        if begun is not None and depth > begun + _OUTSIDE:
            raise JobError(
                f'the needle is at {1e3 * depth:.2f} mm and has been steered; retract it to '
                f'{1e3 * begun:.2f} mm first'
            )
        off = np.abs(at[1:3]).max()
        if depth > straight + _OUTSIDE and off > settings.guide_tolerance:
            raise JobError(
                f'the guide is {1e3 * off:.2f} mm off its zero with the needle at '
                f'{1e3 * depth:.2f} mm; a needle has to be straight at the start'
            )
        if point[1] < depth + min(settings.step_length, _OUTSIDE):
            raise ParameterError(
                f'the needle is at {1e3 * depth:.2f} mm already, the target at '
                f'{1e3 * point[1]:.2f} mm'
            )
        steps = max(1, ceil((point[1] - depth) / settings.step_length - _SAME))
        if steps > _MOST_STEPS:
            raise ParameterError(
                f'it would take {steps} steps of {1e3 * settings.step_length:g} mm, at most '
                f'{_MOST_STEPS} are possible: increase step_length'
            )
        return np.linspace(depth, point[1], steps + 1)

    def start(self, request: PlannedInsertion) -> None:
        """Start to compute the law of a request."""
        _, point, depths, at = request
        settings, steps = self._settings, len(depths) - 1

        def work(progress: Progress) -> SteeringLaw:
            model = SteeringModel(
                self._needle,
                self._steering,
                depths,
                self.prior,
                together=settings.continuous,
                progress=progress,
            )
            return build_law(
                self._law,
                model,
                (point[0], point[2]),
                settings.limits(float(point[1] - depths[0]) / steps),
                roll=float(at[3]) if settings.turns else 0.0,
            )

        self.request, self.job = request, self._start(work)

    def take(self) -> tuple[PlannedInsertion, Job[SteeringLaw]] | None:
        """Return the request and its job once it is computed, and discard both."""
        request, job = self.request, self.job
        if request is None or job is None or not job.done:
            return None
        self.request = self.job = None
        return request, job

    def cancel(self) -> PlannedInsertion | None:
        """Cancel the computation and return its request, None without one."""
        if self.job is not None:
            self.job.cancel()
        request = self.request
        self.request = self.job = None
        return request


def describe_target(point: tuple[float, float, float]) -> str:
    """Describe a target x, y, z [m] for users."""
    x, y, z = (1e3 * one for one in point)
    return f'x = {x:.2f} mm, z = {z:.2f} mm at a depth of {y:.2f} mm'
