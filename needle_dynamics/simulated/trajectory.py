"""One simulated insertion under a given force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.integrator import DEFAULT_STEP, Integrator
from needle_ros.errors import ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike

#: Most intervals of a run: more would not fit into memory.
_MOST_INTERVALS: Final = 100_000_000


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory:
    """
    A simulated run, sampled evenly, that can be evaluated at any time.

    Attributes
    ----------
    parameters : NeedleParameters
        Constants.
    time : ndarray, shape (k + 1,)
        Time [s].
    states : ndarray, shape (k + 1, 2 (2 + n))
        States.
    forces : ndarray, shape (k,)
        Force over each interval [N].
    step : float
        Longest step of the integrator [s].
    tolerance : float or None
        As in `Integrator`.
    graded : bool
        As in `Integrator`.

    """

    parameters: NeedleParameters
    time: FloatArray
    states: FloatArray
    forces: FloatArray
    step: float
    tolerance: float | None = None
    graded: bool = False

    def __repr__(self) -> str:
        depth = self.depth
        return (
            f'Trajectory({len(self.time)} samples up to {self.time[-1]:g} s, '
            f'depth {depth[0]:.4g} to {depth[-1]:.4g} m)'
        )

    @property
    def depth(self) -> FloatArray:
        """Inserted length at the samples [m], shape (k + 1,)."""
        return np.asarray(self.parameters.length - self.states[:, 0])

    @property
    def velocity(self) -> FloatArray:
        """Insertion velocity at the samples [m/s], shape (k + 1,)."""
        return np.asarray(-self.states[:, self.states.shape[1] // 2])

    @property
    def tip_deflection(self) -> FloatArray:
        """Deflection of the tip at the samples [m], shape (k + 1,)."""
        return NeedleModel(self.parameters).tip_deflections(self.states)

    def at(self, time: float) -> FloatArray:
        """
        State at any time of the run, by integrating on from the sample before (dense output).

        Parameters
        ----------
        time : float
            Time [s].

        Returns
        -------
        ndarray, shape (2 (2 + n),)
            State.

        Raises
        ------
        ParameterError
            If the time is outside the run.

        """
        if not self.time[0] <= time <= self.time[-1]:
            raise ParameterError(f'time must be in [0, {self.time[-1]:g}] s, got {time!r}')
        k = int(np.searchsorted(self.time, time, side='right')) - 1
        rest = time - self.time[k]
        if rest <= 0.0:
            return np.array(self.states[k])
        integrator = Integrator(
            self.parameters, self.states[k], self.step, self.tolerance, graded=self.graded
        )
        integrator.time = float(self.time[k])
        integrator.advance(rest, self.forces[k])
        return integrator.state


def simulate(
    parameters: NeedleParameters,
    state: ArrayLike,
    force: float | Callable[[float], float],
    *,
    duration: float,
    interval: float,
    step: float = DEFAULT_STEP,
    tolerance: float | None = None,
    graded: bool = False,
) -> Trajectory:
    """
    Simulate the needle under a force that is constant over each interval.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    state : array_like, shape (2 (2 + n),)
        Initial state, see `NeedleModel.state_at`.
    force : float or callable
        Insertion force [N], or a function of time [s] read at the start of each interval.
    duration : float
        Time to simulate [s].
    interval : float
        Time between samples [s].
    step : float
        Longest step of the integrator [s].
    tolerance : float, optional
        As in `Integrator`.
    graded : bool
        As in `Integrator`.

    Returns
    -------
    Trajectory
        Samples at 0, ``interval``, ..., ``duration``.

    Raises
    ------
    ParameterError, ShapeError
        If an argument is not valid.
    InsertedLengthError
        If the needle leaves its range.

    Examples
    --------
    >>> from needle_dynamics import NeedleModel, NeedleParameters, simulate
    >>> parameters = NeedleParameters.preset('phantom')
    >>> start = NeedleModel(parameters).state_at(0.05, tip_deflection=5e-4)
    >>> run = simulate(parameters, start, force=3.0, duration=0.5, interval=1e-2)
    >>> run
    Trajectory(51 samples up to 0.5 s, depth 0.05 to 0.05407 m)
    >>> print(f'{run.velocity[-1]:.4f} m/s')
    0.0081 m/s

    """
    integrator = Integrator(parameters, state, step, tolerance, graded=graded)
    count = count_of(duration, interval)
    time = np.arange(count + 1, dtype=np.float64) * interval
    forces = floats('force', [force(t) if callable(force) else force for t in time[:-1]])
    if forces.shape != (count,) or not np.isfinite(forces).all():
        raise ShapeError(
            f'force must be one finite number at each of {count} times, got {force!r}'
        )
    states = np.empty((count + 1, integrator.state.size))
    states[0] = integrator.state
    for i in range(count):
        # Not the sum of the intervals, whose rounding would grow.
        integrator.time = float(time[i])
        integrator.advance(interval, forces[i])
        states[i + 1] = integrator.state
    return Trajectory(parameters, time, states, forces, step, tolerance, graded)


def floats(name: str, values: object) -> FloatArray:
    """
    Return values as an array of floats, a copy.

    Parameters
    ----------
    name : str
        Name for the message.
    values : object
        Numbers.

    Returns
    -------
    ndarray
        The numbers.

    Raises
    ------
    ShapeError
        If they are not an array of numbers.

    """
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ShapeError(f'{name} must be numbers, got {values!r}') from None


def count_of(duration: float, interval: float) -> int:
    """
    Return how many intervals a duration has.

    Parameters
    ----------
    duration, interval : float
        Times [s].

    Returns
    -------
    int
        Number of intervals.

    Raises
    ------
    ParameterError
        If it is not a whole number that fits into memory.

    """
    if not 0.0 < interval <= duration < inf:
        raise ParameterError(
            f'interval and duration must be positive and finite with interval <= duration, got '
            f'interval = {interval!r} s, duration = {duration!r} s'
        )
    if duration / interval > _MOST_INTERVALS:
        raise ParameterError(
            f'duration must be at most {_MOST_INTERVALS:g} intervals, got {duration!r} s and '
            f'{interval!r} s'
        )
    count = round(duration / interval)
    # Rounding of the quotient.
    if abs(count * interval - duration) > 1e-9 * duration:
        raise ParameterError(
            f'duration must be a whole number of intervals, got {duration!r} s and {interval!r} s'
        )
    return count
