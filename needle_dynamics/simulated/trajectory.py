# SPDX-License-Identifier: Apache-2.0
"""Simulation of one insertion under a given force."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, count
from math import inf, nan
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray, floats
from needle_dynamics.compiled.friction import COULOMB, FRICTION_LAWS
from needle_dynamics.compiled.intervals import advance_extrapolated, run, run_refined
from needle_dynamics.compiled.step import Inputs
from needle_dynamics.display import Displayed
from needle_dynamics.errors import ToleranceError
from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.integrator import checked_step, not_completed, SHORTEST_STEP
from needle_ros.errors import ParameterError
from needle_ros.settings import checked, is_whole
import numpy as np
from numpy.typing import ArrayLike

DEFAULT_TOLERANCE: Final = 1e-3  #: default tolerance of a run, as in `Trajectory.error`
DEFAULT_SAMPLES: Final = 2000  #: default number of samples of a run
_MOST_INTERVALS: Final = 10_000_000  #: largest number of intervals of a run, limited by memory

#: Smallest tolerance: smaller differences are of rounding.
LEAST_TOLERANCE: Final = 1e-11

#: Least travel for relative errors, as a fraction of the needle length.
_LEAST_TRAVEL: Final = 1e-4

#: Orders of accuracy of a run.
ORDERS: Final = (2, 4, 6, 8)
_SMALL: Final = 1e-4  #: tolerance below which the order is raised before the steps are halved

#: Number of changes of order or step without a smaller error after which rounding dominates.
_TRIES: Final = 3


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory(Displayed):
    """A simulated run, sampled evenly, with dense output."""

    parameters: NeedleParameters  #: constants
    time: FloatArray  #: time of the samples [s], shape (k + 1,)
    states: FloatArray  #: states at the samples, shape (k + 1, 2 (2 + n))
    forces: FloatArray  #: force over each interval [N], shape (k,)
    steps: FloatArray  #: longest step in each interval, or shortest if they vary [s], shape (k,)
    graded: bool = False  #: as in `Integrator`
    #: Difference of the samples from a run with steps twice as long or of lower order: the larger
    #: of the tip deflection error relative to its largest value and the depth error relative to
    #: the travel. NaN if the step was given, since there is no comparison.
    error: float = nan
    order: int = 2  #: order of accuracy while the motion is smooth: 2, 4, 6 or 8

    @property
    def depth(self) -> FloatArray:
        """Insertion depth at the samples [m], shape (k + 1,)."""
        return np.asarray(self.parameters.length - self.states[:, 0])

    @property
    def velocity(self) -> FloatArray:
        """Insertion velocity at the samples [m/s], shape (k + 1,)."""
        return np.asarray(-self.states[:, self.states.shape[1] // 2])

    @property
    def tip_deflection(self) -> FloatArray:
        """Tip deflection at the samples [m], shape (k + 1,)."""
        return NeedleModel(self.parameters).tip_deflections(self.states)

    def columns(self) -> dict[str, FloatArray]:
        force = np.append(self.forces, self.forces[-1:])
        modal = self.states[:, 2 : self.states.shape[1] // 2]
        return {
            'time [s]': self.time,
            'depth [m]': self.depth,
            'velocity [m/s]': self.velocity,
            'force [N]': force,
            'tip_deflection [m]': self.tip_deflection,
            **{f'q{i} [m^3/2]': q for i, q in enumerate(modal.T, 1)},
        }

    def at(self, time: float) -> FloatArray:
        """Return the state at a time [s], integrated from the previous sample (dense output)."""
        if not self.time[0] <= time <= self.time[-1]:
            raise ParameterError(f'time must be in [0, {self.time[-1]:g}] s, got {time!r}')
        k = int(np.searchsorted(self.time, time, side='right')) - 1
        rest = time - self.time[k]
        if rest <= 0.0:
            return np.array(self.states[k])
        state, inputs = np.array(self.states[k]), Inputs(float(self.forces[k]), 0.0, 0.0, False)
        begin, step = float(self.time[k]), float(self.steps[k])
        model = NeedleModel(self.parameters)
        left = advance_extrapolated(
            model.compiled, state, begin, inputs, step, self.graded, rest, self.order // 2
        )
        if left != 0.0:
            raise not_completed(model, state, left)
        return state


def simulate(
    parameters: NeedleParameters,
    state: ArrayLike,
    force: float | Callable[[float], float],
    *,
    duration: float,
    interval: float | None = None,
    tolerance: float | None = None,
    step: float | None = None,
    graded: bool = False,
    order: int | None = None,
) -> Trajectory:
    """
    Simulate the needle under a piecewise constant force.

    Steps are short where the needle vibrates fast and strongly. They are halved until the samples
    have converged: the tip deflection changes by no more than ``tolerance`` of its largest value,
    and the insertion depth by no more than ``tolerance`` of the travel. The finer of the last two
    runs is returned; at second order its error is a third of the change. Below a tolerance of
    1e-4 with Coulomb friction, whose flow is exact, the order is first raised, to 8 at most, by
    extrapolation where the motion is smooth.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    state : array_like, shape (2 (2 + n),)
        Initial state, see `NeedleModel.state_at`.
    force : float or callable
        Insertion force [N], or a function of time [s] evaluated at the start of each interval.
    duration : float
        Time to simulate [s].
    interval : float, optional
        Time between samples [s]; by default 2000 samples. Required if the force is a function of
        time.
    tolerance : float, optional
        Largest `Trajectory.error`, by default 1e-3, at least 1e-11.
    step : float, optional
        Longest step of the integrator [s], instead of a tolerance: a single run, as in
        `Integrator` and `simulate_batch`.
    graded : bool
        As in `Integrator`, with ``step``.
    order : int, optional
        Order of accuracy with ``step``, one of 2 (default), 4, 6 and 8, above 2 with Coulomb
        friction only; a step costs 1, 3, 6 and 10 times as much, and 1, 19, 38 and 74 times where
        the needle starts, stops, reverses or changes layer.

    Returns
    -------
    Trajectory
        Samples at 0, ``interval``, ..., ``duration``.

    Raises
    ------
    InsertionDepthError
        If the needle leaves its range.
    ToleranceError
        If the tolerance cannot be met.

    Examples
    --------
    >>> from needle_dynamics import NeedleModel, NeedleParameters, simulate
    >>> parameters = NeedleParameters.preset('phantom')
    >>> start = NeedleModel(parameters).state_at(0.05, tip_deflection=5e-4)
    >>> run = simulate(parameters, start, force=3.0, duration=0.5, interval=1e-2)
    >>> run
    <Trajectory: 51 samples, time 0 to 0.5 s, depth 0.05 to 0.05407 m>
    >>> print(f'{run.velocity[-1]:.4f} m/s')
    0.0081 m/s
    >>> run.error < 1e-3
    True

    """
    if tolerance is not None and step is not None:
        raise ParameterError('tolerance and step exclude each other')
    if (graded or order is not None) and step is None:
        raise ParameterError('graded and order require a step')
    order = ORDERS[0] if order is None else order
    if not is_whole(order) or order not in ORDERS:
        raise ParameterError(f'order must be one of {", ".join(map(str, ORDERS))}, got {order!r}')
    if order > ORDERS[0] and parameters.friction_law != FRICTION_LAWS[COULOMB]:
        raise ParameterError(
            f'order must be {ORDERS[0]} unless friction_law is {FRICTION_LAWS[COULOMB]}, '
            f'got {order!r} and {parameters.friction_law}'
        )
    tolerance = DEFAULT_TOLERANCE if tolerance is None else tolerance
    checked('tolerance', tolerance, low=LEAST_TOLERANCE)
    if interval is None:
        if callable(force):
            raise ParameterError('interval must be given with a force that is a function of time')
        interval = checked('duration', duration, 's') / DEFAULT_SAMPLES
    count = count_of(duration, interval)
    time = np.arange(count + 1, dtype=np.float64) * interval
    if callable(force):
        forces = floats('force', [force(t) for t in time[:-1]], (count,))
    else:
        forces = np.full(count, floats('force', force, ()))
    model = NeedleModel(parameters)
    start = model.checked_state(state)
    if step is None:
        found = refined(model, start, forces, np.zeros(count), float(interval), tolerance)
        if found.done < count:
            raise not_completed(model, found.end, found.left)
        return Trajectory(
            parameters, time, found.states, forces, found.steps, error=found.error,
            order=found.order,
        )  # fmt: skip
    step, states = checked_step(step), np.empty((count + 1, start.size))
    done = run(
        model.compiled, start, forces, np.zeros(count), float(interval), step, graded, order // 2,
        states,
    )  # fmt: skip
    if done < count:
        raise not_completed(model, start, interval if np.isfinite(start).all() else nan)
    steps = np.full(count, step)
    return Trajectory(parameters, time, states, forces, steps, graded, order=order)


class Refined(NamedTuple):
    """Run that meets a tolerance, or that leaves the range of the needle."""

    states: FloatArray  #: states at the samples, shape (k + 1, 2 (2 + n)), valid up to ``done``
    steps: FloatArray  #: shortest step of each interval [s], shape (k,)
    error: float  #: as `Trajectory.error`, of the samples up to ``done``
    order: int  #: as `Trajectory.order`
    done: int  #: completed intervals
    end: FloatArray  #: state after them, or the last valid one, shape (2 (2 + n),)
    left: float  #: time left undone of the last interval [s]


def refined(
    model: NeedleModel,
    start: FloatArray,
    forces: FloatArray,
    torques: FloatArray,
    interval: float,
    tolerance: float,
) -> Refined:
    """Raise the order or halve the steps until the samples have converged, see `simulate`."""
    states, steps = np.empty((len(forces) + 1, start.size)), np.empty(len(forces))
    before: tuple[int, FloatArray] | None = None
    best, tries, error = inf, 0, inf
    exact = model.parameters.friction_law == FRICTION_LAWS[COULOMB]
    orders = ORDERS[1:] if exact and tolerance < _SMALL else ORDERS[:1]
    # Divisions of the steps and order of the runs to compare, by rising cost.
    rising = chain(((1, one) for one in orders), ((2**k, orders[-1]) for k in count(1)))
    while True:
        (finer, order), state = next(rising), start.copy()
        done, left = run_refined(
            model.compiled, state, forces, torques, interval, finer, order // 2, states, steps
        )
        if before is not None:
            error = _difference(model, before[1], states[: done + 1]) if before[0] == done else inf
            if error <= tolerance:
                return Refined(states, steps, error, order, done, state, left)
            tries = tries + 1 if error >= best and finer > 1 else 0
            best = min(best, error)
            if tries == _TRIES or steps[:done].min(initial=interval) < 2.0 * SHORTEST_STEP:
                raise ToleranceError(
                    f'tolerance {tolerance:g} cannot be met at any step; the best is {best:.1g}'
                )
        before = done, states[: done + 1].copy()


def _difference(model: NeedleModel, one: FloatArray, two: FloatArray) -> float:
    """Return the difference of the samples of two runs, see `Trajectory.error`."""
    tips, others = model.tip_deflections(two), model.tip_deflections(one)
    distances, peak = np.abs(two[:, 0] - two[0, 0]), float(np.abs(tips).max())
    farthest = max(float(distances.max()), _LEAST_TRAVEL * model.parameters.length)
    apart = float(np.abs(tips - others).max())
    return max(
        float(np.abs(two[:, 0] - one[:, 0]).max()) / farthest, apart / peak if peak else apart
    )


def count_of(duration: float, interval: float, name: str = 'interval') -> int:
    """Return the number of intervals in a duration [s], which must be a whole number."""
    interval = checked(name, interval, 's', low=0.0, open_low=True)
    duration = checked('duration', duration, 's', low=interval)
    if duration / interval > _MOST_INTERVALS:
        raise ParameterError(
            f'duration must be at most {_MOST_INTERVALS:g} {name}s, got {duration!r} s and '
            f'{interval!r} s'
        )
    count = round(duration / interval)
    # Tolerance for rounding of the quotient.
    if abs(count * interval - duration) > 1e-9 * duration:
        raise ParameterError(
            f'duration must be a whole number of {name}s, got {duration!r} s and {interval!r} s'
        )
    return count
