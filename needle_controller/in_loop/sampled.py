# SPDX-License-Identifier: Apache-2.0
"""Sampled controllers with a simulated needle, and sampled laws with batches of needles."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain, repeat
from math import isfinite
from typing import Any, Final, NamedTuple, Protocol

from needle_controller.compiled.loop import LaneLoop, run_lanes, run_loop
from needle_controller.compiled.many_loop import run_many_lanes
from needle_controller.controller import ControllerOutput, Measurement
from needle_controller.in_loop.observed import compiled_observer, no_observer, TipObserver
from needle_controller.in_loop.run import LoopRun
from needle_controller.laws.law import Law
from needle_controller.reference.path import Trapezoid
from needle_controller.reference.setpoint import Reference
from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters
from needle_dynamics.arrays import floats
from needle_dynamics.compiled.lane_rows import LANES
from needle_dynamics.display import Progress, progress_of
from needle_dynamics.simulated.batch import (
    lane_constants,
    lane_groups,
    lane_layers,
    lane_modes,
    lane_states,
    number_of_runs,
    thread_count,
)
from needle_dynamics.simulated.integrator import DEFAULT_STEP
from needle_dynamics.simulated.trajectory import count_of
from needle_ros.errors import ParameterError, ShapeError
from needle_ros.settings import check_whole, checked
import numpy as np
from numpy.typing import ArrayLike

_LONGEST: Final = 1_000_000  #: largest delay of a controller [periods]
_NONE: Final = np.empty((0, 3))  #: no additional friction


class Commander(Protocol):
    """Interface of the controllers that `run_controller` accepts, such as `Controller`."""

    @property
    def period(self) -> float:
        """Sample period [s]."""

    @property
    def delay(self) -> int:
        """Periods from a measurement to the effect of its command."""

    def command(self, measured: Measurement, load: float = 0.0) -> ControllerOutput:
        """Return the command for a measurement and the load of the bent needle [N]."""


def run_controller(
    controller: Commander,
    plant: NeedleParameters,
    state: ArrayLike,
    *,
    duration: float,
    step: float = DEFAULT_STEP,
    ground_truth: bool = False,
) -> LoopRun:
    """
    Run a controller on a simulated needle: a `Controller` of the node, or a custom object.

    Parameters
    ----------
    controller : Commander
        A `Controller` with its target set, or an object with ``period``, ``delay`` and
        ``command`` as described by `Commander`.
    plant : NeedleParameters
        True parameters of the needle.
    state : array_like, shape (2 (2 + n),)
        Initial state.
    duration : float
        Time to simulate [s], a whole number of periods.
    step : float
        Longest step of the integrator [s].
    ground_truth : bool
        Pass the true load of the bent needle to the controller, as from an exact observer.

    Returns
    -------
    LoopRun
        Samples at the times of the measurements and at the end. Each force acts over the period
        that starts at its time.

    Raises
    ------
    InsertionDepthError
        If the needle leaves its range.
    ParameterError
        If period or delay of the controller or the duration is not valid, or ``command`` returns
        something else than a `ControllerOutput`.

    Examples
    --------
    >>> from needle_controller import Controller, run_controller
    >>> from needle_dynamics import NeedleModel, NeedleParameters
    >>> plant = NeedleParameters.preset('phantom')
    >>> start = NeedleModel(plant).state_at(0.02)
    >>> controller = Controller(plant)
    >>> controller.set_target(0.022)
    >>> run = run_controller(controller, plant, start, duration=0.5)
    >>> bool(abs(run.depth[-1] - 0.022) < 2e-5)
    True

    """
    name = type(controller).__name__
    period = getattr(controller, 'period', None)
    period = checked(f'{name}.period', period, 's', low=0.0, open_low=True)
    delay: Any = getattr(controller, 'delay', None)
    check_whole(f'{name}.delay', delay, 0, _LONGEST)
    count = count_of(duration, period, 'period')
    integrator = Integrator(plant, state, step)
    model = integrator.model
    time = np.arange(count + 1, dtype=np.float64) * period
    states = np.empty((count + 1, 2 * model.coordinates))
    forces = np.zeros((count + 1, model.coordinates))
    m, pending = model.coordinates, deque([(0.0, 0.0)] * delay)
    for k in range(count):
        states[k] = x = integrator.state
        measured = Measurement(
            time=float(time[k]),
            depth=integrator.depth,
            velocity=integrator.velocity,
            angle=float(x[1]),
            angular_velocity=float(x[m + 1]),
        )
        load = -float(model.bias_forces(x, measured.time)[0]) if ground_truth else 0.0
        command = controller.command(measured, load)
        if not isinstance(command, ControllerOutput):
            raise ParameterError(f'{name}.command must return a ControllerOutput, got {command!r}')
        pending.append((float(command.force), float(command.torque)))
        applied = pending.popleft()
        forces[k, :2] = applied
        integrator.time = float(time[k])
        integrator.advance(period, *applied)
    states[count], forces[count] = integrator.state, forces[count - 1]
    return LoopRun(model, time, states, forces)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopBatch:
    """Results of many runs of sampled laws."""

    final: FloatArray  #: goal minus insertion depth at the end [m], shape (runs,)
    largest: FloatArray  #: the largest in modulus [m]
    rms: FloatArray  #: its root mean square [m]
    states: FloatArray  #: states at the end, shape (runs, 2 (2 + n))
    completed: FloatArray  #: periods completed before the needle left its range
    #: Positions of the reference at the times of the measurements [m], shape (k + 1,).
    goal: FloatArray
    #: Insertion depths at these times [m], shape (runs, k + 1) or (runs, 0), with ``keep``.
    depths: FloatArray
    #: States at these times, shape (runs, k + 1, 2 (2 + n)) or (runs, 0, 2 (2 + n)), with
    #: ``record``; NaN after a needle has left its range.
    trajectories: FloatArray
    #: Command for each measurement [N], shape (runs, k) or (runs, 0), with ``record``.
    commands: FloatArray

    def __repr__(self) -> str:
        worst = np.abs(self.largest).max(initial=0.0)
        return (
            f'<LoopBatch: {len(self.final)} runs of {len(self.goal) - 1} periods, largest error '
            f'{1e3 * worst:.4g} mm>'
        )


def run_batch(
    laws: Law | Sequence[Law],
    plants: NeedleParameters | Sequence[NeedleParameters],
    states: ArrayLike,
    reference: Reference,
    *,
    delay: int,
    limit: float,
    duration: float,
    late: int = 0,
    noise: ArrayLike = (),
    added: ArrayLike = (),
    step: float = DEFAULT_STEP,
    keep: bool = False,
    record: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> LoopBatch:
    """
    Run sampled laws of insertion on many needles, on all cores; see `run_controller`.

    The loop is compiled and supports the laws of this package.
    Rotation is not coupled to insertion and is at rest. The laws do not compensate the load.

    Parameters
    ----------
    laws : Law or sequence of Law
        Law of insertion, for all runs or for each run.
    plants : NeedleParameters or sequence of NeedleParameters
        True parameters of the needles.
    states : array_like, shape (runs, 2 (2 + n)) or (2 (2 + n),)
        Initial states.
    reference : Reference
        Motion to follow.
    delay : int
        Periods from a measurement to the effect of its command.
    limit : float
        Largest force [N].
    duration : float
        Time to simulate [s], rounded to whole periods.
    late : int
        Additional periods of delay that the laws do not compensate.
    noise : array_like, shape (k, 3) or (0,)
        In each period: errors of the measured insertion depth [m] and velocity [m/s], and
        additional force on the needles [N].
    added : array_like, shape (m, 3)
        Additional friction by depth, for membranes and layers: insertion depth [m] above which
        Coulomb friction [N] and viscous friction [N s/m] are added, until the next row.
    step : float
        Longest step of the integrator [s].
    keep, record : bool
        Keep the insertion depths of all periods; keep their states and commands.
    workers : int, optional
        Number of threads; one per core by default.
    progress : bool or callable, optional
        True shows a progress bar; a function is called after each run.

    Returns
    -------
    LoopBatch
        Results, independent of the number of threads.

    """
    each_law = [laws] if isinstance(laws, Law) else list(laws)
    each = [plants] if isinstance(plants, NeedleParameters) else list(plants)
    starts = np.atleast_2d(np.array(states, dtype=float))
    runs = number_of_runs(laws=len(each_law), plants=len(each), states=len(starts))
    periods = {law.period for law in each_law}
    if len(periods) > 1:
        raise ParameterError(f'laws must have the same period, got {sorted(periods)} s')
    period = periods.pop()
    positive = step > 0.0 and limit > 0.0 and min(delay, late) >= 0
    if not (isfinite(duration) and duration >= period and positive):
        raise ParameterError(
            f'duration must be finite and >= {period:g} s, step and limit > 0, delay and late '
            f'>= 0, got {duration!r}, {step!r}, {limit!r}, {delay!r} and {late!r}'
        )
    count = round(duration / period)
    # Setpoint of a command: the reference at the time of its effect.
    motion = _setpoints(reference, period, count + delay + 1)
    setpoints, goal = motion[delay:-1], np.ascontiguousarray(motion[: count + 1, 0])
    blurred, along = _rows('noise', noise), _rows('added', added)
    if len(blurred) not in (0, count):
        raise ShapeError(f'noise must be of shape ({count}, 3), got {blurred.shape}')
    if (np.diff(along[:, 0]) <= 0.0).any() or (along[:, 1:] < 0.0).any():
        raise ParameterError(f'added must have increasing depths and friction >= 0, got {added!r}')
    models = [NeedleModel(p) for p in each]
    needles = [model.compiled for model in models]
    ends = np.array(
        [models[i % len(models)].checked_state(starts[i % len(starts)]) for i in range(runs)]
    )
    errors, completed = np.empty((runs, 3)), np.empty(runs)
    depths = np.full((runs, count + 1 if keep else 0), np.nan)
    trajectories = np.full((runs, count + 1 if record else 0, ends.shape[1]), np.nan)
    commands = np.full((runs, count if record else 0), np.nan)

    none, boxed = no_observer()

    def run(share: range, advance: Callable[[], object]) -> None:
        for i in share:
            law = each_law[i % len(each_law)]
            completed[i] = run_loop(
                needles[i % len(needles)], ends[i], law.packed, float(limit), setpoints,
                goal, np.zeros(delay + late), delay, blurred, along, float(step), none, boxed,
                depths[i], trajectories[i], commands[i], errors[i],
            )  # fmt: skip
            advance()

    workers = thread_count(workers, runs)
    with progress_of(progress, runs, 'runs') as each_run, ThreadPoolExecutor(workers) as pool:
        # The first run compiles the loop before the threads need it.
        run(range(1), each_run)
        shares = [range(1 + k, runs, workers) for k in range(workers)]
        list(pool.map(run, shares, repeat(each_run)))
    final, largest, squares = errors.T
    return LoopBatch(
        final, largest, np.sqrt(squares), ends, completed, goal, depths, trajectories, commands
    )


def _rows(name: str, values: ArrayLike) -> FloatArray:
    """Return finite values as rows, shape (n, 3); empty values have no rows."""
    rows = floats(name, values)
    return floats(name, rows, (None, 3)) if rows.size else np.empty((0, 3))


class LoopInsertion(NamedTuple):
    """A run of `run_insertions`."""

    #: Insertion depth [m], velocity [m/s] and tip deflection [m] at the measurements, shape
    #: (3, k + 1); NaN after the needle has left its range.
    motion: FloatArray
    commands: FloatArray  #: command for each measurement [N], shape (k,)
    goal: FloatArray  #: reference at the measurements [m], shape (k + 1,)
    completed: int  #: periods completed before the needle left its range


def run_insertions(
    law: Law,
    models: Sequence[NeedleModel],
    states: Sequence[FloatArray],
    references: Sequence[Reference],
    noises: Sequence[FloatArray],
    lates: Sequence[int],
    *,
    delay: int,
    limit: float,
    step: float,
    observer: TipObserver | None = None,
) -> list[LoopInsertion]:
    """
    Run a law on needles, each with its own reference, noise and additional delay, on one core.

    Arguments are as of `run_batch`, and a run has as many periods as its noise, shape (k, 3). With
    an observer, the law compensates its load, and a fourth column of the noise has the errors of
    the measured tip deflection [m].
    Several needles of the same reach that `simulate_batch` computes together are computed with
    each instruction; they differ from `run_batch` by rounding.
    """
    counts = np.array([len(noise) for noise in noises])
    # In falling order of duration, as for compiled code.
    order = np.argsort(-counts, kind='stable')
    runs, most = len(order), int(counts[order[0]])
    counts, delays = counts[order], delay + np.array(lates)[order]
    chosen = [models[i] for i in order]
    setpoints, blurred = np.zeros((runs, most, 3)), np.zeros((runs, most, 4))
    watch, boxed = no_observer() if observer is None else compiled_observer(observer)
    goal, commands = np.full((runs, most + 1), np.nan), np.full((runs, most), np.nan)
    starts, motions = np.array([states[i] for i in order]), np.full((runs, 3, most + 1), np.nan)
    wide = lane_states(starts)
    for k, i in enumerate(order.tolist()):
        count = counts[k]
        motion = _setpoints(references[i], law.period, count + delay + 1)
        setpoints[k, :count], goal[k, : count + 1] = motion[delay:-1], motion[: count + 1, 0]
        blurred[k, :count, : noises[i].shape[1]] = noises[i]
    completed = np.zeros(runs)
    parameters = [model.parameters for model in chosen]
    layers, modes = lane_layers(parameters), parameters[0].modes
    for reach, some in lane_groups(parameters, runs).items():
        if reach is not None:
            for part in np.split(some, range(LANES, len(some), LANES)):
                advance = run_many_lanes if modes > 2 else run_lanes
                loop = LaneLoop(
                    lane_constants(parameters), lane_modes(reach, modes), layers, law.packed,
                    float(limit), setpoints, goal, counts, delays, delay, blurred, step, watch,
                    part, wide, motions, commands, completed,
                )  # fmt: skip
                advance(loop, boxed)
            continue
        for k in some.tolist():
            n, model = counts[k], chosen[k]
            trajectory = np.full((n + 1, starts.shape[1]), np.nan)
            completed[k] = run_loop(
                model.compiled, starts[k], law.packed, limit, setpoints[k, :n], goal[k, : n + 1],
                np.zeros(delays[k]), delay, blurred[k, :n], _NONE, step, watch, boxed, np.empty(0),
                trajectory, commands[k, :n], np.empty(3),
            )  # fmt: skip
            motions[k, :, : n + 1] = motion_of(model, trajectory)
    found = [
        LoopInsertion(motion[:, : n + 1], force[:n], aim[: n + 1], int(done))
        for motion, force, aim, n, done in zip(
            motions, commands, goal, counts.tolist(), completed, strict=True
        )
    ]
    return [found[k] for k in np.argsort(order)]


def motion_of(model: NeedleModel, states: FloatArray) -> FloatArray:
    """Return insertion depth, velocity and tip deflection of states (k, 2 (2 + n)); (3, k)."""
    depth, velocity = model.parameters.length - states[:, 0], -states[:, model.coordinates]
    return np.stack([depth, velocity, model.tip_deflections(states)])


def _setpoints(reference: Reference, period: float, count: int) -> FloatArray:
    """Return position, velocity and acceleration of a reference at multiples of a period."""
    times = np.arange(count, dtype=np.float64) * period
    if isinstance(reference, Trapezoid):
        return np.ascontiguousarray(reference.sampled(times))
    # The reference rests after its end.
    moving = int(np.searchsorted(times, reference.duration))
    result = np.empty((count, 3))
    result[moving:] = reference.at(reference.duration + 1.0)
    # Assignment by rows or a list would take longer than the setpoints themselves.
    numbers = chain.from_iterable(map(reference.at, times[:moving].tolist()))
    result[:moving] = np.fromiter(numbers, np.float64, 3 * moving).reshape(-1, 3)
    return result
