"""
The laws inside the simulation: the continuous closed loop, and sampled loops one by one or many.

The continuous loop has dry friction as a set-valued law: the motion is solved piece by piece, with
the direction of sliding fixed in each, and the pieces end where the needle comes to rest, where
friction can no longer hold it, or on the hub. Nothing is smoothed and nothing chatters.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import inf, isfinite, sqrt
import os
from typing import Final

from needle_controller.compiled.laws import law_step
from needle_controller.controller import Controller, Measurement
from needle_controller.laws.axis import Law
from needle_controller.laws.continuous import acceleration, ContinuousLaw
from needle_controller.reference.reference import Reference
from needle_dynamics import (
    FloatArray,
    InsertedLengthError,
    Integrator,
    NeedleModel,
    NeedleParameters,
)
from needle_dynamics.compiled.kernels import advance, Constants, slide, SUMS, Tables
from needle_dynamics.simulated.integrators import DEFAULT_STEP, kernel_constants, kernel_tables
from needle_ros.errors import (
    NeedleError,
    ParameterError,
    ShapeError,
)
import numba
import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

#: Speed that stands for the limit of rest in a direction [m/s].
_AT_REST: Final = 1e-300

#: Part by which a force has to exceed dry friction to count as more, so that a motion that ends
#: as slowly as an exponential function ends once.
_ROUNDING: Final = 1e-9

#: Pieces after which a motion counts as chatter.
_MOST_PIECES: Final = 1000


@dataclass(frozen=True, slots=True, eq=False)
class LoopRun:
    """
    One run of a closed loop.

    Attributes
    ----------
    model : NeedleModel
        The plant.
    time : ndarray, shape (k,)
        Times [s].
    states : ndarray, shape (k, 2 (2 + n))
        States.
    forces : ndarray, shape (k, 2 + n)
        f_y [N], tau [N m] and generalized forces: at the times, or over the periods that begin
        there.
    events : tuple of (float, str)
        When it stuck, broke away or touched the hub [s]; of a continuous loop only.

    """

    model: NeedleModel
    time: FloatArray
    states: FloatArray
    forces: FloatArray
    events: tuple[tuple[float, str], ...] = ()

    @property
    def depth(self) -> FloatArray:
        """Inserted length [m], shape (k,)."""
        return np.asarray(self.model.parameters.length - self.states[:, 0])

    @property
    def tip_deflection(self) -> FloatArray:
        """Deflection of the tip [m], shape (k,)."""
        return tip_deflections(self.model, self.states)


def tip_deflections(model: NeedleModel, states: FloatArray) -> FloatArray:
    """
    Do what `NeedleModel.tip_deflection` does for many states at once.

    Parameters
    ----------
    model : NeedleModel
        The model.
    states : ndarray, shape (k, 2 (2 + n))
        States.

    Returns
    -------
    ndarray, shape (k,)
        Deflections [m].

    """
    values = model.modes.values(model.parameters.length - states[:, 0])
    return np.asarray((values * states[:, 2 : model.coordinates]).sum(axis=1))


def run_continuous(
    law: ContinuousLaw,
    plant: NeedleModel,
    state: ArrayLike,
    goal: ArrayLike | Callable[[float], ArrayLike],
    times: ArrayLike,
    *,
    tolerance: float = 1e-6,
    method: str = 'Radau',
) -> LoopRun:
    """
    Solve the continuous closed loop, with sticking, break-away and hub as they are.

    Parameters
    ----------
    law : ContinuousLaw
        Law.
    plant : NeedleModel
        The true needle.
    state : array_like, shape (2 (2 + n),)
        Initial state; integrals of the error begin at zero.
    goal : array_like, shape (3, 2 + n), or callable
        Wanted q, q_dot and q_ddot, or a function of time [s] that returns them.
    times : array_like, shape (k,)
        Times at which the run is wanted [s], ascending; it begins at the first.
    tolerance : float
        Relative tolerance of the solver.
    method : str
        Solver, as SciPy names it: ``Radau`` for loops of high gain, which are stiff; ``DOP853``
        where the law takes the stiffness away, as `modal` inverse dynamics does.

    Returns
    -------
    LoopRun
        The run.

    Raises
    ------
    ShapeError, ParameterError
        If an argument is not valid.
    InsertedLengthError
        If the needle leaves its range.
    NeedleError
        If the solver gives up, or law and friction chatter.

    Notes
    -----
    Modes that the law leaves alone are solved at their own frequency, of kilohertz: with
    `physical` actuation that is for short times only. A motion that dies out as an exponential
    function counts as chatter once it is slower than the tolerance tells from rest.

    """
    wanted = np.array(times, dtype=float)
    if wanted.ndim != 1 or len(wanted) < 2 or not (np.diff(wanted) > 0.0).all():
        raise ShapeError(f'times must be at least two that ascend, got {wanted.tolist()}')
    if law.model.coordinates != plant.coordinates:
        raise ParameterError(
            f'the law must have the {plant.modes.count} modes of the plant, got '
            f'{law.model.modes.count}'
        )
    y = np.concatenate([plant.checked_state(state), np.zeros(law.integrals)])
    pieces = _Pieces(law, plant, goal, tolerance, method)
    time, states = float(wanted[0]), np.empty((len(wanted), len(y)))
    states[0] = y
    events: list[tuple[float, str]] = []
    done = 1
    for _ in range(_MOST_PIECES):
        here = wanted[done:]
        time, y, samples, what = pieces.solve(time, y, here)
        states[done : done + len(samples)] = samples
        done += len(samples)
        if done == len(wanted):
            break
        events.append((time, what))
    else:
        raise NeedleError(f'law and friction chatter: {_MOST_PIECES} changes up to {time:g} s')
    m = plant.coordinates
    forces = [pieces.forces(t, x) for t, x in zip(wanted, states, strict=True)]
    return LoopRun(plant, wanted, states[:, : 2 * m], np.array(forces), tuple(events))


class _Pieces:
    """Solves a closed loop from one change of friction to the next."""

    def __init__(
        self,
        law: ContinuousLaw,
        plant: NeedleModel,
        goal: ArrayLike | Callable[[float], ArrayLike],
        tolerance: float,
        method: str,
    ) -> None:
        self.law, self.plant, self.goal = law, plant, goal
        self.tolerance, self.method = tolerance, method
        p, m = plant.parameters, plant.coordinates
        self.low = -(plant.modes.reach - 1.0) * p.length
        self.high = p.length - p.minimum_depth
        # Sizes: the needle's length, a radian, a deflection of 1 cm; the same per second.
        sizes = np.full(m, 0.01 * sqrt(p.length))
        sizes[:2] = p.length, 1.0
        self.scale = np.concatenate([sizes, sizes, sizes[: law.integrals]])
        self.m = m

    def _clamped(self, y: FloatArray, way: int) -> FloatArray:
        """Return the state with its depth in range and its speed in the direction of sliding."""
        x = y[: 2 * self.m].copy()
        x[0] = min(max(x[0], self.low), self.high)
        if way == 0:
            x[self.m] = 0.0
        elif -way * x[self.m] <= 0.0:
            x[self.m] = -way * _AT_REST
        return x

    def forces(self, time: float, y: FloatArray, way: int | None = None) -> FloatArray:
        x = y[: 2 * self.m] if way is None else self._clamped(y, way)
        now = self.goal(time) if callable(self.goal) else self.goal
        return self.law.forces(x, now, y[2 * self.m :], time)

    def rate(self, time: float, y: FloatArray, way: int) -> FloatArray:
        m, x = self.m, self._clamped(y, way)
        now = self.goal(time) if callable(self.goal) else self.goal
        forces = self.law.forces(x, now, y[2 * m :], time)
        result = acceleration(self.plant, x, forces, time)
        errors = self.law.errors(x, now)[0][: self.law.integrals]
        rates = y[m : 2 * m].copy()
        if way == 0:
            rates[0] = result[0] = 0.0
        return np.concatenate([rates, result, errors])

    def jacobian(self, time: float, y: FloatArray, way: int) -> FloatArray:
        """
        Return the derivative of `rate` by central differences of the size of the state.

        One-sided ones of the size of rounding, SciPy's own, are too rough where gains of 1e4 act
        on the modal mass of a short needle: Newton's method then fails at most steps.
        """
        steps = 1e-4 * self.scale
        if y[self.m] != 0.0:
            # Not beyond rest: friction jumps there.
            steps[self.m] = 0.5 * abs(y[self.m])
        columns = []
        for i, step in enumerate(steps):
            high, low = y.copy(), y.copy()
            high[i] += step
            low[i] -= step
            change = self.rate(time, high, way) - self.rate(time, low, way)
            columns.append(change / (high[i] - low[i]))
        return np.array(columns).T

    def _excess(self, time: float, y: FloatArray, side: int) -> float:
        """Return by how much the drive exceeds what friction bears on a side of rest [N]."""
        x = self._clamped(y, 0)
        drive = self.forces(time, y, 0)[0] + self.plant.bias_forces(x, time)[0]
        bearable = self.plant.friction.force(0.0, side * inf)
        return float(side * (drive - bearable) - _ROUNDING * (abs(drive) + abs(bearable)))

    def _way(self, time: float, y: FloatArray) -> int:
        """Return which way the needle goes: 1 into the tissue, -1 out of it, 0 none."""
        speed = -y[self.m]
        at_hub = self.plant.parameters.hub_stop and y[0] <= 0.0
        if speed != 0.0 and not (at_hub and speed > 0.0):
            return 1 if speed > 0.0 else -1
        if self._excess(time, y, 1) > 0.0 and not at_hub:
            return 1
        return -1 if self._excess(time, y, -1) > 0.0 else 0

    def solve(
        self, time: float, y: FloatArray, wanted: FloatArray
    ) -> tuple[float, FloatArray, FloatArray, str]:
        """Go on to the next change or the last time; return time, state, samples and change."""
        way, m = self._way(time, y), self.m
        at_hub = self.plant.parameters.hub_stop and y[0] <= 0.0
        names: list[str] = []
        events: list[Callable[[float, FloatArray], float]] = []

        def watch(name: str, event: Callable[[float, FloatArray], float]) -> None:
            event.terminal, event.direction = True, 1.0  # type: ignore[attr-defined]
            names.append(name)
            events.append(event)

        if way == 0:
            if not at_hub:
                watch('breaks away inward', lambda t, z: self._excess(t, z, 1))
            watch('breaks away outward', lambda t, z: self._excess(t, z, -1))
        else:
            watch('comes to rest', lambda _, z: float(way * z[m]))
            watch('leaves its range', lambda _, z: float(z[0] - self.high))
            end_stop = 'touches the hub' if self.plant.parameters.hub_stop else 'leaves its range'
            watch(end_stop, lambda _, z: self.low - float(z[0]))
        implicit = {'jac': lambda t, z: self.jacobian(t, z, way)}
        run = solve_ivp(
            lambda t, z: self.rate(t, z, way),
            (time, float(wanted[-1])),
            y,
            method=self.method,
            t_eval=wanted,
            events=events,
            rtol=self.tolerance,
            atol=1e-3 * self.tolerance * self.scale,
            **(implicit if self.method in ('Radau', 'BDF') else {}),
        )
        if run.status < 0:
            raise NeedleError(f'the closed loop cannot be solved beyond {run.t[-1]:g} s')
        samples = np.array(run.y).reshape(len(y), -1).T
        # Held exactly, and never beyond the hub, whatever the solver's rounding.
        samples[:, 0] = np.maximum(samples[:, 0], self.low)
        if way == 0:
            samples[:, 0], samples[:, m] = y[0], 0.0
        if run.status == 0:
            return float(wanted[-1]), samples[-1].copy(), samples, ''
        which = next(i for i, at in enumerate(run.t_events) if len(at))
        time, end, what = (
            float(run.t_events[which][0]),
            run.y_events[which][0].copy(),
            names[which],
        )
        if what == 'leaves its range':
            depth = self.plant.parameters.length - end[0]
            raise InsertedLengthError(
                f'inserted length {depth:.6g} m left its range at {time:g} s'
            )
        if what == 'touches the hub':
            end[0] = 0.0
        if way != 0:
            end[m] = 0.0
        else:
            end[0] = y[0]
            # Friction is overcome: the least speed tells the direction.
            end[m] = -_AT_REST if what.endswith('inward') else _AT_REST
        return time, end, samples, what


def run_controller(
    controller: Controller,
    plant: NeedleParameters,
    state: ArrayLike,
    *,
    period: float,
    delay: int,
    duration: float,
    step: float = DEFAULT_STEP,
    ground_truth: bool = False,
) -> LoopRun:
    """
    Run the controller of the node, the very object, on a simulated needle.

    Parameters
    ----------
    controller : Controller
        Controller, with its target set.
    plant : NeedleParameters
        The true needle.
    state : array_like, shape (2 (2 + n),)
        Initial state.
    period : float
        Sample period [s], that of the controller.
    delay : int
        Periods from a measurement to the effect of its command.
    duration : float
        Time to simulate [s].
    step : float
        Longest step of the integrator [s].
    ground_truth : bool
        Tell the controller the load that the bent needle puts on insertion, as an observer
        without error would.

    Returns
    -------
    LoopRun
        Samples at the times of the measurements and one more; each force holds for the period
        that begins there.

    Raises
    ------
    InsertedLengthError
        If the needle leaves its range.

    """
    integrator = Integrator(plant, state, step)
    model, count = integrator.model, round(duration / period)
    time = np.arange(count + 1, dtype=np.float64) * period
    states = np.empty((count + 1, 2 * model.coordinates))
    forces = np.zeros((count + 1, model.coordinates))
    m, on_the_way = model.coordinates, deque([(0.0, 0.0)] * delay)
    for k in range(count):
        states[k] = x = integrator.state
        measured = Measurement(
            time=float(time[k]),
            depth=integrator.depth,
            speed=integrator.speed,
            angle=float(x[1]),
            angular_speed=float(x[m + 1]),
        )
        if ground_truth:
            load = -float(model.bias_forces(x, measured.time)[0])
            command = controller.command(measured, load)
        else:
            command = controller.command(measured)
        on_the_way.append((command.force, command.torque))
        applied = on_the_way.popleft()
        forces[k, :2] = applied
        integrator.time = float(time[k])
        integrator.advance(period, *applied)
    states[count], forces[count] = integrator.state, forces[count - 1]
    return LoopRun(model, time, states, forces)


# Not kept on disk: Numba would not renew it when the kernels that it calls change.
@numba.njit(error_model='numpy', nogil=True)  # type: ignore[untyped-decorator]
def _loop(
    c: Constants,
    tables: Tables,
    state: FloatArray,
    law: FloatArray,
    axis: tuple[float, float, float],
    limit: float,
    setpoints: FloatArray,
    goal: FloatArray,
    on_the_way: FloatArray,
    longest: float,
    depths: FloatArray,
    errors: FloatArray,
) -> int:
    """
    Run the loop of one sampled law; return how many periods it completed.

    ``on_the_way`` holds one command per period of delay. ``depths``, shape (k + 1,) or (0,), is
    filled if it is to be kept; ``errors`` gets the last, the largest and the mean square.
    """
    inertia, coulomb, viscous = axis
    memory = np.zeros(3)
    sums = np.zeros(SUMS)
    period, delay, m = law[1], on_the_way.shape[0], state.shape[0] // 2
    count = setpoints.shape[0]
    largest, squares = 0.0, 0.0
    for k in range(count + 1):
        depth, speed = c.length - state[0], -state[m]
        if depths.shape[0] > 0:
            depths[k] = depth
        error = goal[k] - depth
        largest = max(largest, abs(error))
        squares += error * error
        errors[0], errors[1], errors[2] = error, largest, squares / (k + 1)
        if k == count:
            break
        for i in range(delay):
            speed, moved = slide(speed, on_the_way[i], inertia, coulomb, viscous, period)
            depth = depth + moved
        command = law_step(
            law,
            memory,
            depth,
            speed,
            setpoints[k, 0],
            setpoints[k, 1],
            setpoints[k, 2],
            0.0,
            limit,
        )
        force = command
        if delay > 0:
            force = on_the_way[0]
            for i in range(1, delay):
                on_the_way[i - 1] = on_the_way[i]
            on_the_way[delay - 1] = command
        left = advance(
            c, tables, state, k * period, force, 0.0, 0.0, False, longest, False, period, sums
        )
        if left != 0.0:
            return k
    return int(count)


@dataclass(frozen=True, slots=True, eq=False)
class LoopBatch:
    """
    Many runs of sampled loops.

    Attributes
    ----------
    final, largest, rms : ndarray, shape (runs,)
        Goal minus inserted length [m]: at the end, the largest in modulus, root of mean square.
    states : ndarray, shape (runs, 2 (2 + n))
        States at the end.
    completed : ndarray, shape (runs,)
        Periods that were completed before the needle left its range.
    depths : ndarray, shape (runs, k + 1) or (runs, 0)
        Inserted lengths at the times of the measurements [m], if they were kept.

    """

    final: FloatArray
    largest: FloatArray
    rms: FloatArray
    states: FloatArray
    completed: FloatArray
    depths: FloatArray


def setpoint_table(reference: Reference, period: float, delay: int, count: int) -> FloatArray:
    """
    Return what a controller aims at: the reference when each command takes effect.

    Parameters
    ----------
    reference : Reference
        Motion.
    period : float
        Sample period [s].
    delay : int
        Periods from a measurement to the effect of its command.
    count : int
        Number of commands.

    Returns
    -------
    ndarray, shape (count, 3)
        Position, speed and acceleration.

    """
    points = (reference.at(k * period + delay * period) for k in range(count))
    return np.array([(at.position, at.speed, at.acceleration) for at in points])


def run_batch(
    laws: Law | Sequence[Law],
    plants: NeedleParameters | Sequence[NeedleParameters],
    states: ArrayLike,
    reference: Reference,
    *,
    delay: int,
    limit: float,
    duration: float,
    step: float = DEFAULT_STEP,
    keep: bool = False,
    workers: int | None = None,
    progress: Callable[[], object] | None = None,
) -> LoopBatch:
    """
    Run sampled laws of insertion on many needles, on all cores: what `run_controller` does.

    Rotation is not coupled to insertion; here it rests. The laws are not told of any load.

    Parameters
    ----------
    laws : Law or sequence of Law
        Law of insertion, for all runs or for each.
    plants : NeedleParameters or sequence of them
        The true needles.
    states : array_like, shape (runs, 2 (2 + n)) or (2 (2 + n),)
        Initial states.
    reference : Reference
        Motion to follow.
    delay : int
        Periods from a measurement to the effect of its command.
    limit : float
        Largest force [N].
    duration : float
        Time to simulate [s].
    step : float
        Longest step of the integrator [s].
    keep : bool
        Keep the inserted lengths of all periods.
    workers : int, optional
        Threads; one per core if not given.
    progress : callable, optional
        Called after each run.

    Returns
    -------
    LoopBatch
        Results; they do not depend on the number of threads.

    Raises
    ------
    ShapeError
        If the numbers of runs do not agree.
    ParameterError, InsertedLengthError
        If a value is not valid.

    """
    each_law = [laws] if isinstance(laws, Law) else list(laws)
    each = [plants] if isinstance(plants, NeedleParameters) else list(plants)
    starts = np.atleast_2d(np.array(states, dtype=float))
    sizes = {len(each_law), len(each), len(starts)} - {1}
    if len(sizes) > 1 or 0 in sizes:
        raise ShapeError(
            f'laws, plants and states must be for one number of runs, got {len(each_law)}, '
            f'{len(each)} and {len(starts)}'
        )
    periods = {law.period for law in each_law}
    if len(periods) > 1:
        raise ParameterError(f'laws must have one period, got {sorted(periods)} s')
    period = periods.pop()
    if not (isfinite(duration) and duration >= period and step > 0.0 and delay >= 0):
        raise ParameterError(
            f'duration must be finite and >= {period:g} s, step > 0 and delay >= 0, got '
            f'{duration!r}, {step!r} and {delay!r}'
        )
    count, runs = round(duration / period), sizes.pop() if sizes else 1
    setpoints = setpoint_table(reference, period, delay, count)
    goal = np.array([reference.at(k * period).position for k in range(count + 1)])
    models = [NeedleModel(p) for p in each]
    compiled = [(kernel_constants(model), kernel_tables(model)) for model in models]
    ends = np.array(
        [models[i % len(models)].checked_state(starts[i % len(starts)]) for i in range(runs)]
    )
    errors, completed = np.empty((runs, 3)), np.empty(runs)
    depths = np.full((runs, count + 1 if keep else 0), np.nan)

    def one(i: int) -> None:
        law = each_law[i % len(each_law)]
        constants, tables = compiled[i % len(compiled)]
        axis = law.axis.inertia, law.axis.coulomb, law.axis.viscous
        completed[i] = _loop(
            constants, tables, ends[i], law.constants, axis, float(limit), setpoints, goal,
            np.zeros(delay), float(step), depths[i], errors[i],
        )  # fmt: skip
        if progress is not None:
            progress()

    def share_of_runs(share: range) -> None:
        for i in share:
            one(i)

    # Compiled before the threads need it.
    one(0)
    ends[0] = models[0].checked_state(starts[0])
    workers = min(workers or os.cpu_count() or 1, runs)
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(share_of_runs, [range(k, runs, workers) for k in range(workers)]))
    return LoopBatch(
        final=errors[:, 0],
        largest=errors[:, 1],
        rms=np.sqrt(errors[:, 2]),
        states=ends,
        completed=completed,
        depths=depths,
    )
