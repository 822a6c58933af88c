r"""
Structure-preserving integrator of the needle: frozen-depth modal flow, exact friction flow.

One step of length h from (s, u, q, p), u = s_dot and p = rho A G q_dot, is a symmetric
splitting of the Hamiltonian system:

1. drift the depth to the middle of the step with the speed at its start;
2. with the depth frozen there, the modal part is linear: tissue damping and the rotation in the
   eigenbasis of (E I_y H + k_a G, rho A G) are exact, whatever their frequency. With the
   momenta as variables dG/dt needs no term. The impulse -dH/ds that the modes exert on the
   insertion axis along that rotation is an exact integral too;
3. insertion force and mean modal force being constant over the step, the insertion axis under
   viscous and set-valued Coulomb friction has an exact flow, including stops and sticking.

It is of second order, symplectic without friction and damping (the total displacement then
equals that of drift-kick-drift), sticks exactly, and has no stability limit from the modes nor
from viscous friction. Source of the idea: E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical
Integration", 2nd ed., 2006, sections II.5 and XIII (splitting, highly oscillatory problems).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, inf, isfinite
from typing import Final

from needle_dynamics.errors import InsertedLengthError, ParameterError
from needle_dynamics.kernels import (
    advance,
    Constants,
    FloatArray,
    INTEGRALS,
    SUM_AREA,
    SUM_AREA_RATE,
    SUM_DAMPING_WORK,
    SUM_FRICTION_WORK,
    SUM_INPUT_WORK,
    SUM_MOMENT,
    SUM_MOMENT_RATE,
    SUM_RESISTANCE,
    SUM_TIP,
    SUMS,
)
from needle_dynamics.model import COORDINATES, NeedleModel, ROUNDING
from needle_dynamics.parameters import NeedleParameters
import numpy as np
from numpy.typing import ArrayLike

#: Default step [s]. The tip deflection of the source's open-loop run is then good to 2e-4.
DEFAULT_STEP: Final = 1e-5


def _constants(p: NeedleParameters) -> Constants:
    return Constants(
        p.length,
        p.linear_density,
        p.bending_stiffness,
        p.tissue_stiffness,
        p.tissue_damping,
        p.moving_mass,
        p.rotary_inertia,
        p.coulomb_friction,
        p.viscous_friction,
        p.minimum_depth - ROUNDING * p.length,
        p.hub_stop,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """
    What a sensor that averages over an interval would have seen of it.

    Attributes
    ----------
    tip_deflection : float
        Mean deflection of the tip [m].
    axial_force : float
        Mean force of the base on the needle along y [N], positive into the tissue.
    lateral_force : float
        Mean force of the base on the needle along z [N], by balance of momentum.
    moment : float
        Mean moment of the base on the needle about x at the base [N m], with the torque.
    friction_work, damping_work : float
        Energy lost to friction and to tissue damping [J].
    input_work : float
        Work done by force and torque [J].

    """

    tip_deflection: float
    axial_force: float
    lateral_force: float
    moment: float
    friction_work: float
    damping_work: float
    input_work: float


class Integrator:
    """
    Advances one needle in time with its own scratch memory.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    state : array_like, shape (8,)
        Initial state.
    step : float
        Longest step [s].

    Raises
    ------
    ParameterError
        If ``step`` is not positive and finite.
    ShapeError, InsertedLengthError
        If the state is not valid.

    """

    def __init__(
        self, parameters: NeedleParameters, state: ArrayLike, step: float = DEFAULT_STEP
    ) -> None:
        if not 0.0 < step < inf:
            raise ParameterError(f'step must be positive and finite, got {step!r} s')
        self.model = NeedleModel(parameters)
        self.step = step
        self._constants = _constants(parameters)
        self._table = self.model.modes.series
        self._work = np.empty(self._table.shape[1])
        self._at = np.empty(INTEGRALS)
        self._sums = np.zeros(SUMS)
        self._state = self.model.checked_state(state)

    @property
    def state(self) -> FloatArray:
        """State now, a copy; shape (8,)."""
        return self._state.copy()

    @property
    def depth(self) -> float:
        """Inserted length s [m]."""
        return float(self._constants.length - self._state[0])

    @property
    def speed(self) -> float:
        """Insertion speed s_dot [m/s]."""
        return float(-self._state[COORDINATES])

    def advance(self, duration: float, force: float = 0.0, torque: float = 0.0) -> Interval:
        """
        Advance under a constant force and torque at the base.

        Parameters
        ----------
        duration : float
            Time to advance [s], taken in equal steps no longer than the step.
        force : float
            Insertion force f_y [N], positive into the tissue.
        torque : float
            Torque tau about x [N m].

        Returns
        -------
        Interval
            Means and works over the interval.

        Raises
        ------
        InsertedLengthError
            If the inserted length fell below its minimum; the state is the last valid one.

        """
        return self._run(duration, force, torque, 0.0, moved=False)

    def advance_moved(self, duration: float, speed: float) -> Interval:
        """
        Advance with the base brought evenly to a speed, whatever force that takes.

        Parameters
        ----------
        duration : float
            Time to advance [s].
        speed : float
            Insertion speed at the end [m/s], positive into the tissue.

        Returns
        -------
        Interval
            Means over the interval; the axial force is what the motion took. While the base
            rests, friction takes the value within its bounds that asks for the least force.

        Raises
        ------
        InsertedLengthError
            If the inserted length fell below its minimum; the state is the last valid one.

        """
        return self._run(duration, 0.0, 0.0, speed, moved=True)

    def _run(
        self, duration: float, force: float, torque: float, speed: float, *, moved: bool
    ) -> Interval:
        if not 0.0 < duration < inf:
            raise ParameterError(f'duration must be positive and finite, got {duration!r} s')
        for name, value in (('force', force), ('torque', torque), ('speed', speed)):
            if not isfinite(value):
                raise ParameterError(f'{name} must be finite, got {value!r}')
        # A duration of a whole number of steps is not rounded up.
        steps = max(1, ceil(duration / self.step * (1.0 - 1e-9)))
        sums, before = self._sums, self._state.copy()
        sums[:] = 0.0
        taken = advance(
            self._constants,
            self._table,
            self._work,
            self._at,
            self._state,
            force,
            torque,
            speed,
            moved,
            duration / steps,
            steps,
            sums,
        )
        if taken < steps:
            raise InsertedLengthError(
                f'inserted length {self.depth:.6g} m reached minimum_depth = '
                f'{self._constants.minimum_depth:g} m while withdrawing'
            )
        return self._interval(before, duration, force, torque, moved=moved)

    def _interval(
        self, before: FloatArray, duration: float, force: float, torque: float, *, moved: bool
    ) -> Interval:
        p, after, sums = self.model.parameters, self._state, self._sums
        rho, now = p.linear_density, self.model.modes.integrals
        start, end = now(p.length - before[0]), now(p.length - after[0])
        momentum = rho * (end.area @ after[6:] - start.area @ before[6:])
        angular = rho * (end.moment @ after[6:] - start.moment @ before[6:])
        k, c = p.tissue_stiffness, p.tissue_damping
        lateral = (momentum + k * sums[SUM_AREA] + c * sums[SUM_AREA_RATE]) / duration
        about_entry = (angular + k * sums[SUM_MOMENT] + c * sums[SUM_MOMENT_RATE]) / duration
        gain = (before[4] - after[4]) / duration
        if moved:
            force = p.linear_density * p.length * gain + sums[SUM_RESISTANCE] / duration
        else:
            force = force - p.carriage_mass * gain
        return Interval(
            tip_deflection=float(sums[SUM_TIP] / duration),
            axial_force=float(force),
            lateral_force=float(lateral),
            moment=float(about_entry + 0.5 * (before[0] + after[0]) * lateral + torque),
            friction_work=float(sums[SUM_FRICTION_WORK]),
            damping_work=float(sums[SUM_DAMPING_WORK]),
            input_work=float(sums[SUM_INPUT_WORK]),
        )


@dataclass(frozen=True, slots=True)
class Trajectory:
    """
    A simulated run, sampled evenly.

    Attributes
    ----------
    time : ndarray, shape (n,)
        Time [s].
    states : ndarray, shape (n, 8)
        States.
    tip_deflection : ndarray, shape (n,)
        Deflection of the tip [m] at these times.

    """

    time: FloatArray
    states: FloatArray
    tip_deflection: FloatArray


def simulate(
    parameters: NeedleParameters,
    state: ArrayLike,
    force: float | Callable[[float], float],
    *,
    duration: float,
    interval: float,
    step: float = DEFAULT_STEP,
) -> Trajectory:
    """
    Simulate the needle under a force that is constant over each interval.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    state : array_like, shape (8,)
        Initial state.
    force : float or callable
        Insertion force [N], or a function of time [s] read at the start of each interval.
    duration : float
        Time to simulate [s].
    interval : float
        Time between samples [s].
    step : float
        Longest step of the integrator [s].

    Returns
    -------
    Trajectory
        Samples at 0, ``interval``, ..., ``duration``.

    Raises
    ------
    InsertedLengthError
        If the needle leaves the tissue.

    """
    integrator = Integrator(parameters, state, step)
    count = round(duration / interval)
    time = np.arange(count + 1, dtype=np.float64) * interval
    states = np.empty((count + 1, 2 * COORDINATES))
    states[0] = integrator.state
    for i in range(count):
        integrator.advance(interval, force(time[i]) if callable(force) else force)
        states[i + 1] = integrator.state
    tips = np.array([integrator.model.tip_deflection(x) for x in states])
    return Trajectory(time, states, tips)
