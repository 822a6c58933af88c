r"""
Structure-preserving integrator of the needle: frozen-depth modal flow, exact friction flow.

One step of length h from (s, u, q, p), u = s_dot and p = rho A G q_dot, is a symmetric
splitting of the Hamiltonian system:

1. drift the depth to the middle of the step with the speed at its start;
2. with the depth frozen there, the modal part is linear: tissue damping and the rotation in the
   eigenbasis of (E I_y H + k_a G, rho A G) are exact, whatever their frequency. With the
   momenta as variables dG/dt needs no term. The impulse -dH/ds that the modes exert on the
   insertion axis along that rotation is an exact integral too;
   Constant generalized forces on q1..qn shift the deflections about which the modes rotate;
3. insertion force and mean modal force being constant over the step, the insertion axis under
   viscous and set-valued Coulomb friction has an exact flow, including stops and sticking.

It is of second order, symplectic without friction and damping (the total displacement then
equals that of drift-kick-drift), sticks exactly, and has no stability limit from the modes nor
from viscous friction. Source of the idea: E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical
Integration", 2nd ed., 2006, sections II.5 and XIII (splitting, highly oscillatory problems).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from math import copysign, inf, isfinite, isnan, sqrt
import os
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.kernels import (
    advance,
    Constants,
    run,
    SUM_CONTACT,
    SUM_DAMPING_WORK,
    SUM_FRICTION_WORK,
    SUM_IMPACT,
    SUM_INPUT_WORK,
    SUM_TIP,
    SUMS,
    Tables,
)
from needle_dynamics.errors import (
    InsertedLengthError,
    ToleranceError,
)
from needle_dynamics.friction import FRICTION_LAWS
from needle_dynamics.model import NeedleModel, ROUNDING
from needle_dynamics.parameters import NeedleParameters
from needle_ros.errors import (
    NeedleError,
    ParameterError,
    ShapeError,
)
import numpy as np
from numpy.typing import ArrayLike

#: Default step [s]. The tip deflection of the source's open-loop run is then good to 2e-4.
DEFAULT_STEP: Final = 1e-5

#: Tolerance of `needle simulate`: a coast over the whole needle then keeps its energy to 1e-8.
DEFAULT_TOLERANCE: Final = 1e-8

#: Step at which a tolerance is given up, and shortest step taken [s]: rounding has taken over
#: long before.
_SHORTEST_STEP: Final = 1e-9

#: Most intervals of a run: more would not fit into memory.
_MOST_INTERVALS: Final = 100_000_000


def kernel_constants(model: NeedleModel) -> Constants:
    """Return the numbers that the kernels take."""
    p, tissue, friction = model.parameters, model.tissue, model.friction
    return Constants(
        length=p.length,
        linear_density=p.linear_density,
        bending_stiffness=p.bending_stiffness,
        tissue_damping=p.tissue_damping,
        moving_mass=p.moving_mass,
        rotary_inertia=p.rotary_inertia,
        minimum_depth=p.minimum_depth - ROUNDING * p.length,
        maximum_depth=model.modes.reach * p.length,
        hub_stop=p.hub_stop,
        as_printed=p.formulation == 'as_printed',
        friction_law=FRICTION_LAWS.index(friction.law),
        coulomb=friction.coulomb,
        viscous=friction.viscous,
        withdrawal=friction.withdrawal,
        breakaway=friction.breakaway,
        stribeck_speed=friction.stribeck_speed,
        smoothing_speed=friction.smoothing_speed,
        swelling=tissue.swelling,
        swelling_time=tissue.swelling_time,
        carriage_mass=p.carriage_mass,
    )


def kernel_tables(model: NeedleModel) -> Tables:
    """Return the arrays that the kernels take."""
    return Tables(
        series=model.modes.series,
        terms=model.modes.terms,
        modes=model.modes.constants,
        layer_start=np.array(model.tissue.starts),
        layer_stiffness=np.array(model.tissue.stiffnesses),
        layer_offset=model.tissue.offsets(model.modes),
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
    felt : ndarray, shape (parts, 3)
        These three over each of the equal parts of the interval.
    friction_work, damping_work : float
        Energy lost to friction and to tissue damping [J].
    input_work : float
        Work done by force, torque and generalized forces [J].
    impact_loss : float
        Energy lost on the hub [J].
    contact_time : float or None
        Time of the last contact with the hub [s], on the integrator's clock.

    """

    tip_deflection: float
    axial_force: float
    lateral_force: float
    moment: float
    felt: FloatArray = field(compare=False)
    friction_work: float
    damping_work: float
    input_work: float
    impact_loss: float
    contact_time: float | None


class Integrator:
    """
    Advances one needle in time.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    state : array_like, shape (2 (2 + n),)
        Initial state.
    step : float
        Longest step [s].
    tolerance : float, optional
        If given, the step is halved until the estimated error of each call to `advance` is less
        than this part of the state in the norm of energy, and of the needle's length.
    graded : bool
        Let the step grow with the inserted length once that exceeds a tenth of the needle's: the
        modes slow down as its square.

    Raises
    ------
    ParameterError
        If ``step`` or ``tolerance`` is not positive and finite.
    ShapeError, InsertedLengthError
        If the state is not valid.
    ToleranceError
        By `advance`, if the tolerance cannot be met.

    """

    def __init__(
        self,
        parameters: NeedleParameters,
        state: ArrayLike,
        step: float = DEFAULT_STEP,
        tolerance: float | None = None,
        *,
        graded: bool = False,
    ) -> None:
        self.step = _checked_step(step)
        if tolerance is not None and not 0.0 < tolerance < inf:
            raise ParameterError(f'tolerance must be positive and finite, got {tolerance!r}')
        self.tolerance = tolerance
        self.graded = graded
        self.time = 0.0
        self._sums = np.zeros(SUMS)
        self._refinement = 1.0
        self._take_on(parameters, state)

    def _take_on(self, parameters: NeedleParameters, state: ArrayLike) -> None:
        model = NeedleModel(parameters)
        self._state = model.checked_state(state)
        self.model = model
        self._constants = kernel_constants(model)
        self._tables = kernel_tables(model)

    def change(self, parameters: NeedleParameters) -> None:
        """
        Go on with other constants from the state now.

        Parameters
        ----------
        parameters : NeedleParameters
            Constants.

        Raises
        ------
        ShapeError, InsertedLengthError
            If the state does not suit them; the old constants then stay.

        """
        self._take_on(parameters, self._state)

    @property
    def state(self) -> FloatArray:
        """State now, a copy; shape (2 (2 + n),)."""
        return self._state.copy()

    @property
    def depth(self) -> float:
        """Inserted length s [m]."""
        return float(self._constants.length - self._state[0])

    @property
    def speed(self) -> float:
        """Insertion speed s_dot [m/s]."""
        return float(-self._state[self.model.coordinates])

    def advance(
        self,
        duration: float,
        force: float = 0.0,
        torque: float = 0.0,
        modal: FloatArray | None = None,
        parts: int = 1,
    ) -> Interval:
        """
        Advance under a constant force and torque at the base.

        Parameters
        ----------
        duration : float
            Time to advance [s], taken in steps no longer than the step.
        force : float
            Insertion force f_y [N], positive into the tissue.
        torque : float
            Torque tau about x [N m].
        modal : ndarray, shape (n,), optional
            Constant generalized forces on q1..qn [N m^-1/2], what the source's modal inputs are.
            No force at the base belongs to them: the base does not feel them.
        parts : int
            In how many equal parts of the interval to tell what the base feels. Steps end where
            these do.

        Returns
        -------
        Interval
            Means and works over the interval.

        Raises
        ------
        ShapeError
            If ``modal`` does not have one finite number for each mode.
        InsertedLengthError
            If the inserted length fell below its minimum; the state is the last valid one.

        """
        if modal is not None:
            n = self.model.modes.count
            modal = _floats('modal', modal)
            if modal.shape != (n,) or not np.isfinite(modal).all():
                raise ShapeError(f'modal must be finite with shape ({n},), got {modal.tolist()}')
        return self._run(duration, force, torque, 0.0, modal, parts, moved=False)

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
        return self._run(duration, 0.0, 0.0, speed, None, 1, moved=True)

    def advance_pushed(self, duration: float, force: float, speed_limit: float) -> Interval:
        """
        Advance under a constant force of a base that goes no faster than a limit.

        Parameters
        ----------
        duration : float
            Time to advance [s].
        force : float
            Insertion force that the base applies while it is slow enough [N].
        speed_limit : float
            Highest speed of the base at the end [m/s].

        Returns
        -------
        Interval
            Means over the interval; at the limit the axial force is what that motion took.

        Raises
        ------
        InsertedLengthError
            If the inserted length fell below its minimum; the state is the last valid one.

        """
        before, clock, depth = self._state.copy(), self.time, self.depth
        way = force
        try:
            seen = self.advance(duration, force)
        except InsertedLengthError:
            # At the limit it may stay within.
            too_fast = True
        else:
            # The hub may have stopped what went too fast.
            gone = abs(self.depth - depth)
            too_fast = max(abs(self.speed), gone / duration) > speed_limit
            way = self.speed or force
        if too_fast:
            self._state[:], self.time = before, clock
            seen = self.advance_moved(duration, copysign(speed_limit, way))
        return seen

    def _run(
        self,
        duration: float,
        force: float,
        torque: float,
        speed: float,
        modal: FloatArray | None,
        parts: int,
        *,
        moved: bool,
    ) -> Interval:
        if not 0.0 < duration < inf:
            raise ParameterError(f'duration must be positive and finite, got {duration!r} s')
        for name, value in (('force', force), ('torque', torque), ('speed', speed)):
            if not isfinite(value):
                raise ParameterError(f'{name} must be finite, got {value!r}')
        # An integer would have the kernel compiled anew for it.
        duration, force, torque, speed = map(float, (duration, force, torque, speed))
        felt = np.empty((parts, 3))

        def take(longest: float) -> None:
            self._take(duration, (force, torque, speed), modal, longest, felt, moved=moved)

        if self.tolerance is None:
            take(self.step)
        else:
            self._refine(take, min(duration, self.step / self._refinement), self.tolerance)
        self.time += duration
        return self._interval(duration, felt)

    def _take(
        self,
        duration: float,
        inputs: tuple[float, float, float],
        modal: FloatArray | None,
        longest: float,
        felt: FloatArray,
        *,
        moved: bool,
    ) -> None:
        """Take steps under constant inputs: force, torque, and speed of a moved base."""
        self._sums[:] = 0.0
        known = (
            self._constants, self._tables, self._state, self.time,
            *inputs, moved, longest, self.graded, duration, self._sums,
        )  # fmt: skip
        left = advance(*known, modal, felt)
        if isnan(left):
            raise NeedleError(
                'the motion is not finite: constants, state or inputs are out of proportion'
            )
        if left > 0.0:
            self.time += duration - left
            p, far = self.model.parameters, self._constants.maximum_depth
            limit = (
                f'minimum_depth = {p.minimum_depth:g} m while withdrawing'
                if self.depth - p.minimum_depth < far - self.depth
                else f'the largest inserted length, {far:g} m'
            )
            raise InsertedLengthError(f'inserted length {self.depth:.6g} m reached {limit}')

    def _refine(self, take: Callable[[float], None], longest: float, tolerance: float) -> None:
        """Halve the step until the end of the interval no longer depends on it."""
        start, clock = self._state.copy(), self.time

        def attempt(longest: float) -> InsertedLengthError | None:
            self._state[:], self.time = start, clock
            try:
                take(longest)
            except InsertedLengthError as error:
                return error
            return None

        left_range = attempt(longest)
        while True:
            coarse, left_before = self._state.copy(), left_range
            longest *= 0.5
            if longest < _SHORTEST_STEP:
                self._state[:], self.time = start, clock
                raise ToleranceError(f'tolerance {tolerance:g} cannot be met at any step')
            left_range = attempt(longest)
            # The finer run is kept; second order makes its error a third of the difference.
            change = self._distance(coarse, self._state) / 3.0
            if change <= tolerance and (left_range is None) == (left_before is None):
                break
        if left_range is not None:
            raise left_range
        # The next interval begins with the step before the last one, or one more before where
        # the error allows it: a step twice as long has four times the error.
        growth = 4.0 if change < tolerance / 32.0 else 2.0
        self._refinement = max(1.0, self.step / (growth * longest))

    def _distance(self, one: FloatArray, two: FloatArray) -> float:
        """Return how far apart two states are: energy of the difference, and depth."""
        model, m = self.model, self.model.coordinates
        depth = model.parameters.length - two[0]
        gram = model.parameters.linear_density * model.modes.integrals(depth).gram
        stiffness = model.stiffness_matrix(depth, self.time)
        mass = model.parameters.moving_mass

        def energy(x: FloatArray) -> float:
            rate = x[m + 2 :]
            elastic = x[2:m] @ stiffness @ x[2:m]
            return float(0.5 * (elastic + rate @ gram @ rate + mass * x[m] ** 2))

        scale = max(energy(one), energy(two))
        part = sqrt(energy(two - one) / scale) if scale > 0.0 else 0.0
        return max(part, float(abs(two[0] - one[0])) / model.parameters.length)

    def _interval(self, duration: float, felt: FloatArray) -> Interval:
        sums = self._sums.tolist()
        axial, lateral, moment = (np.add.reduce(felt) / len(felt)).tolist()
        return Interval(
            tip_deflection=sums[SUM_TIP] / duration,
            axial_force=axial,
            lateral_force=lateral,
            moment=moment,
            felt=felt,
            friction_work=sums[SUM_FRICTION_WORK],
            damping_work=sums[SUM_DAMPING_WORK],
            input_work=sums[SUM_INPUT_WORK],
            impact_loss=sums[SUM_IMPACT],
            contact_time=sums[SUM_CONTACT] if sums[SUM_CONTACT] >= 0.0 else None,
        )


@dataclass(frozen=True, slots=True, eq=False)
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

    @property
    def tip_deflection(self) -> FloatArray:
        """Deflection of the tip at the samples [m], shape (k + 1,)."""
        model = NeedleModel(self.parameters)
        return np.array([model.tip_deflection(x) for x in self.states])

    @property
    def depth(self) -> FloatArray:
        """Inserted length at the samples [m], shape (k + 1,)."""
        return np.asarray(self.parameters.length - self.states[:, 0])

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
        Initial state.
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
    InsertedLengthError
        If the needle leaves its range.

    """
    integrator = Integrator(parameters, state, step, tolerance, graded=graded)
    count = _count(duration, interval)
    time = np.arange(count + 1, dtype=np.float64) * interval
    forces = _floats('force', [force(t) if callable(force) else force for t in time[:-1]])
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


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """
    Many simulated runs.

    Attributes
    ----------
    time : ndarray, shape (k + 1,), or (1,) for the ends only
        Time of the samples [s].
    states : ndarray, shape (runs, k + 1, 2 (2 + n)), or (runs, 1, ...) for the ends only
        States; not a number after a run has left its range.
    completed : ndarray, shape (runs,)
        Time up to which each run is valid [s].

    """

    time: FloatArray
    states: FloatArray
    completed: FloatArray


def simulate_batch(
    parameters: NeedleParameters | Sequence[NeedleParameters],
    states: ArrayLike,
    forces: ArrayLike,
    torques: ArrayLike = 0.0,
    *,
    duration: float,
    interval: float,
    step: float = DEFAULT_STEP,
    graded: bool = False,
    keep: bool = True,
    workers: int | None = None,
) -> Batch:
    """
    Simulate many insertions at once on all cores; the result does not depend on how many.

    Parameters
    ----------
    parameters : NeedleParameters or sequence of them
        Constants, for all runs or for each.
    states : array_like, shape (runs, 2 (2 + n)) or (2 (2 + n),)
        Initial states.
    forces, torques : array_like, shape (), (runs,) or (runs, k)
        Insertion force [N] and torque [N m], constant over each interval.
    duration, interval, step : float
        As in `simulate` [s].
    graded : bool
        As in `Integrator`.
    keep : bool
        Keep the states at all samples, or only at the end.
    workers : int, optional
        Threads; one per core if not given.

    Returns
    -------
    Batch
        Results.

    Raises
    ------
    ShapeError
        If the numbers of runs do not agree.
    ParameterError, InsertedLengthError
        If a value is not valid.

    """
    each = [parameters] if isinstance(parameters, NeedleParameters) else list(parameters)
    starts = np.atleast_2d(_floats('states', states))
    pushes, turns = (
        values.reshape(-1, 1) if values.ndim < 2 else values
        for values in (_floats('forces', forces), _floats('torques', torques))
    )
    count, sizes = (
        _count(duration, interval),
        {len(each), len(starts), len(pushes), len(turns)} - {1},
    )
    shaped = starts.ndim == 2 and all(
        values.ndim == 2 and values.shape[1] in (1, count) for values in (pushes, turns)
    )
    if len(sizes) > 1 or 0 in sizes or not shaped:
        raise ShapeError(
            f'parameters, states and inputs must be for one number of runs and inputs constant or '
            f'for {count} intervals, got {len(each)} parameters, states {starts.shape}, '
            f'forces {pushes.shape}, torques {turns.shape}'
        )
    if not (np.isfinite(pushes).all() and np.isfinite(turns).all()):
        raise ParameterError('forces and torques must be finite')
    step = _checked_step(step)
    if workers is not None and (not isinstance(workers, int) or workers < 1):
        raise ParameterError(f'workers must be an integer >= 1, got {workers!r}')
    runs = sizes.pop() if sizes else 1
    models = [NeedleModel(p) for p in each]
    tables = [(kernel_constants(model), kernel_tables(model)) for model in models]
    starts = np.array(
        [models[i % len(models)].checked_state(starts[i % len(starts)]) for i in range(runs)]
    )
    result = np.full((runs, count + 1 if keep else 1, starts.shape[1]), np.nan)
    completed = np.empty(runs)

    def one(i: int) -> None:
        constants, table = tables[i % len(tables)]
        push, turn = (
            np.ascontiguousarray(np.broadcast_to(values[i % len(values)], (count,)))
            for values in (pushes, turns)
        )
        done = run(
            constants, table, starts[i], push, turn, float(interval), step, graded, result[i]
        )
        completed[i] = done * interval
        if not keep and done == count:
            result[i, 0] = starts[i]

    def share_of_runs(share: range) -> None:
        for i in share:
            one(i)

    workers = min(workers or os.cpu_count() or 1, runs)
    with ThreadPoolExecutor(workers) as pool:
        # A thread takes its share at once: one task per run would cost more than short runs do.
        shares = [range(k, runs, workers) for k in range(workers)]
        list(pool.map(share_of_runs, shares))
    time = np.arange(count + 1 if keep else 1, dtype=np.float64) * interval
    return Batch(time if keep else time + count * interval, result, completed)


def _floats(name: str, values: object) -> FloatArray:
    """Return values as an array of floats, or refuse them."""
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ShapeError(f'{name} must be numbers, got {values!r}') from None


def _checked_step(step: float) -> float:
    """Return a longest step as a float, or refuse it."""
    if isinstance(step, bool) or not isinstance(step, (int, float)):
        raise ParameterError(f'step must be a number, got {step!r}')
    if not _SHORTEST_STEP <= step < inf:
        raise ParameterError(f'step must be finite and >= {_SHORTEST_STEP:g} s, got {step!r} s')
    return float(step)


def _count(duration: float, interval: float) -> int:
    """Return how many intervals a duration has."""
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
