# SPDX-License-Identifier: Apache-2.0
"""Steering law: interface to executive and simulation, construction by name, and a base class."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, nan
from reprlib import repr as shortened
from typing import Final, NamedTuple, Protocol, TypeAlias

from needle_controller.steering.planned_path import PlannedPath
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics.arrays import FloatArray, floats
from needle_dynamics.steering.needle import SteeredNeedle
from needle_ros.errors import JobError, NeedleError, ParameterError, ShapeError
from needle_ros.quantities import NORMAL
from needle_ros.settings import checked, find_class
import numpy as np
from numpy.typing import ArrayLike

_LAWS: Final = 'needle_controller.steering.laws'

#: Steering laws by name: module and class.
STEERING_LAWS: Final[Mapping[str, str]] = {
    'multi_hypothesis': f'{_LAWS}.multi_hypothesis:MultiHypothesisLaw',
    'springs': f'{_LAWS}.springs:SpringsLaw',
    'broyden': f'{_LAWS}.broyden:BroydenLaw',
    'roll_to_target': f'{_LAWS}.roll_to_target:RollToTargetLaw',
    'open_loop': f'{_LAWS}.open_loop:OpenLoopLaw',
}
DEFAULT_LAW: Final = 'multi_hypothesis'  #: Default law of node, `needle steer` and studies.

#: Quantiles of the 95 % interval of a normal distribution, and of the 95 % ellipse.
_CHI_SQUARED: Final = 5.991


class SteeringFaultError(JobError):
    """The tip measurement is implausible, frozen or missing, or the law has failed."""


class LawError(SteeringFaultError):
    """A steering law raises an exception, or its results have the wrong form."""


class ContactError(SteeringFaultError):
    """The probability of contact along a plan is above its limit."""


@dataclass(frozen=True, slots=True, eq=False)
class TipEstimate:
    """Estimated or predicted position of the tip."""

    mean: FloatArray  #: position in x and z in the frame of the sensor [m], shape (2,)
    covariance: FloatArray  #: its covariance [m^2], shape (2, 2)

    @property
    def half_width(self) -> FloatArray:
        """Half width of the 95 % intervals of x and z [m], shape (2,)."""
        return np.asarray(NORMAL * np.sqrt(np.diag(self.covariance)))

    def contains(self, tip: FloatArray) -> bool:
        """Return whether the 95 % ellipse contains a position x, z [m], shape (2,)."""
        off = tip - self.mean
        return bool(off @ np.linalg.solve(self.covariance, off) <= _CHI_SQUARED)


class Forecast(NamedTuple):
    """Forecast of the tip from the depth of the last measurement on, over r depths of n + 1."""

    means: FloatArray  #: expected tip with the guide below, x and z [m], shape (r, 2)
    covariances: FloatArray  #: its covariances [m^2], shape (r, 2, 2)
    #: Expected shift of the tip at each depth per shift of the guide in each step, (n + 1, n).
    response: FloatArray
    guide: FloatArray  #: guide in each step, past and planned [m], shape (n, 2)


class GuideSetpoint(NamedTuple):
    """Guide setpoint for the next step: guide and roll move while the tip rests."""

    x: float  #: position of the guide along x [m]
    z: float  #: position of the guide along z [m]
    roll: float = 0.0  #: roll of the needle [rad]


class SteeringLaw(Protocol):
    """
    Compute a guide setpoint for each step from the tip measurements.

    The steps end at the depths of a `SteeringModel`. At each depth, `update` is called for every
    measurement that has become available, then `plan` once. A law is constructed by `build_law`,
    with the arguments of `LawClass`. It needs no base class; `GuideLaw` is a base class for
    laws that compute the guide from the newest measurement.
    """

    @property
    def target(self) -> FloatArray:
        """Target position of the tip at the last depth, x and z [m], shape (2,)."""

    @property
    def step(self) -> int:
        """Number of plans so far: the number of the present depth."""

    @property
    def warning(self) -> str:
        """Warning for the user, '' without a warning."""

    def aim(self, target: ArrayLike) -> None:
        """Change the target x, z [m], or raise `NeedleError` and keep the old one."""

    def update(
        self, tip: Sequence[float] | FloatArray | None, at: int, noise: float = 0.0
    ) -> None:
        """
        Process an averaged tip measurement x, z [m] in the frame of the sensor; None if missing.

        ``at`` is the number of its depth, not greater than `step`: the present or, if the needle
        does not rest, the depth before. ``noise`` is its standard deviation along each axis, if
        above the configured one [m]. Raises `SteeringFaultError` if the needle must stop, because
        the measurements are missing for too long, frozen or implausible.
        """

    def plan(self) -> GuideSetpoint:
        """Return guide and roll for the next step, and advance to it; unchanged at the end."""

    def expected(self) -> TipEstimate | None:
        """Return the predicted position of the tip at the last depth, None without prediction."""

    def status(self) -> Mapping[str, float]:
        """Return values for the status by name: turns_left, hit_probability, or others."""


#: Constructor of a steering law: model, target, limits and roll, as for `build_law`.
LawClass: TypeAlias = Callable[[SteeringModel, ArrayLike, SteeringLimits, float], SteeringLaw]


def law_name(law: SteeringLaw) -> str:
    """Return the class of a law as ``module:Class``."""
    return f'{type(law).__module__}:{type(law).__qualname__}'


def failed_law(law: SteeringLaw, what: str) -> LawError:
    return LawError(f'the steering law {law_name(law)} has failed: {what}')


def find_law(name: str) -> LawClass:
    """Return the class of a law: a key of `STEERING_LAWS`, or a class as ``module:Class``."""
    found: LawClass = find_class('law', name, STEERING_LAWS)
    needed = [one for one, part in vars(SteeringLaw).items() if one[0] != '_' and callable(part)]
    missing = [one for one in needed if not hasattr(found, one)]
    if missing:
        raise ParameterError(f'law {name!r} is no steering law: it lacks {", ".join(missing)}')
    return found


def build_law(
    name: str,
    model: SteeringModel,
    target: ArrayLike,
    limits: SteeringLimits,
    roll: float = 0.0,
    path: PlannedPath | None = None,
) -> SteeringLaw:
    """
    Construct a steering law by name.

    Parameters
    ----------
    name : str
        A key of `STEERING_LAWS`, or a class outside the package as ``module:Class``.
    model : SteeringModel
        Nominal needle, depths of the measurements, and responses of the tip.
    target : array_like, shape (2,)
        Target position of the tip at the last depth, x and z [m].
    limits : SteeringLimits
        Limits of the guide setpoints.
    roll : float
        Roll of the needle at the start [rad].
    path : PlannedPath, optional
        Path to follow, with the depths of the model; the law must have a method ``follow(path)``.

    Raises
    ------
    OutOfReachError
        If the law detects that the target is out of reach.
    """
    of_class = find_law(name)
    try:
        law = of_class(model, target, limits, roll)
    except NeedleError:
        raise
    # The constructor is any code of the user.
    except (Exception, SystemExit) as error:
        raise ParameterError(f'law {name!r} cannot be constructed: {error}') from error
    members = 'target', 'step', 'warning', 'aim', 'update', 'plan', 'expected', 'status'
    missing = [name for name in members if not hasattr(law, name)]
    if missing:
        raise ParameterError(f'law {name!r} has no {", ".join(missing)}')
    if path is not None:
        if not hasattr(law, 'follow'):
            raise ParameterError(f'law {name!r} cannot follow a planned path')
        law.follow(path)
    return law


def checked_tip(tip: ArrayLike | None, name: str = 'a tip measurement') -> FloatArray:
    """Return a tip measurement x, z [m], nan if it is missing."""
    try:
        found = np.full(2, nan) if tip is None else np.array(tip, dtype=np.float64)
    except (TypeError, ValueError):
        raise ShapeError(f'{name} must be x and z, got {shortened(tip)}') from None
    if found.shape != (2,):
        raise ShapeError(f'{name} must be x and z, got shape {found.shape}')
    return found


def checked_target(target: ArrayLike) -> FloatArray:
    """Return a target x, z [m], if it is two finite numbers."""
    return floats('target', target, (2,))


class GuideLaw(ABC):
    """
    Steering law that computes the guide from the newest tip measurement.

    A derived class implements `choose`, and may implement `prepare`. Position and change of the
    guide are clipped to their limits, and its load on the nominal needle to ``load_limit``.
    Parameters as for `LawClass`.
    """

    warning = ''

    def __init__(
        self, model: SteeringModel, target: ArrayLike, limits: SteeringLimits, roll: float = 0.0
    ) -> None:
        self.depths, self.limits = model.depths, limits
        self.turns, self.roll = limits.turns, checked('roll', roll)
        self._nominal = SteeredNeedle(model.needle, model.steering, roll=self.roll)
        self.step = 0
        self.guides = [np.zeros(2)]  #: guide at each depth so far [m], at last its setpoint
        self._newest: tuple[FloatArray, int] | None = None
        self.aim(target)
        self.prepare(model)

    def prepare(self, model: SteeringModel) -> None:  # noqa: B027
        """Compute constants before the first step; the default computes nothing."""

    def aim(self, target: ArrayLike) -> None:
        """Set the target, x and z of the tip at the last depth [m]."""
        self.target = checked_target(target)

    def update(
        self,
        tip: Sequence[float] | FloatArray | None,
        at: int,
        noise: float = 0.0,  # noqa: ARG002
    ) -> None:
        """Process a tip measurement, x and z [m], or None; see `SteeringLaw`."""
        measured = checked_tip(tip)
        if np.isfinite(measured).all():
            self._newest = measured, at

    def plan(self) -> GuideSetpoint:
        guide, most, change = self.guides[-1], self.limits.guide_limit, self.limits.guide_step
        if self._newest is not None and self.step < len(self.depths) - 1:
            wanted = np.clip(self._chosen(*self._newest), guide - change, guide + change)
            guide = self._within_load(np.clip(wanted, -most, most))
        self._newest = None
        self.guides.append(guide)
        self.step += 1
        x, z = guide.tolist()
        return GuideSetpoint(x, z, self.roll)

    def _chosen(self, tip: FloatArray, at: int) -> FloatArray:
        found: object = self.choose(tip, at)
        try:
            return floats('guide', found, (2,))
        except NeedleError as error:
            said = f'choose must return x and z of the guide [m], finite, got {shortened(found)}'
            raise failed_law(self, said) from error

    def _within_load(self, guide: FloatArray) -> FloatArray:
        """Return the guide [m], less of its motion where it would exceed the load limit."""
        limit, needle, before = self.limits.load_limit, self._nominal, self.guides[-1]
        if limit == inf:
            return guide
        needle.move(depth=float(self.depths[self.step]))
        now = needle.guide_load[0]
        needle.move(guide=guide.tolist(), roll=self.roll)
        # At a constant depth the load is linear in the guide, and each plane has its own.
        then = needle.guide_load[0]
        change, over = then - now, np.sign(then) * np.maximum(0.0, np.abs(then) - limit)
        back = np.divide(over, change, out=np.zeros(2), where=change != 0.0)
        guide = guide - np.clip(back, 0.0, 1.0) * (guide - before)
        needle.move(guide=guide.tolist())
        return guide

    @abstractmethod
    def choose(self, tip: FloatArray, at: int) -> FloatArray:
        """Return the guide for the next step [m] from a tip [m] measured at depth number at."""

    def expected(self) -> TipEstimate | None:
        """Return None: there is no prediction."""
        return None

    def status(self) -> Mapping[str, float]:
        return {'turns_left': self.turns}
