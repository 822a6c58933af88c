"""Many simulated insertions at once, on all cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
import os

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.step import run
from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.integrator import checked_step, DEFAULT_STEP
from needle_dynamics.simulated.trajectory import count_of, floats
from needle_ros.errors import ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Batch:
    """
    Many simulated runs.

    Attributes
    ----------
    parameters : tuple of NeedleParameters
        Constants of each run, or one for all.
    time : ndarray, shape (k + 1,), or (1,) for the ends only
        Time of the samples [s].
    states : ndarray, shape (runs, k + 1, 2 (2 + n)), or (runs, 1, ...) for the ends only
        States; NaN after a run has left its range.
    completed : ndarray, shape (runs,)
        Time up to which each run is valid [s].

    """

    parameters: tuple[NeedleParameters, ...]
    time: FloatArray
    states: FloatArray
    completed: FloatArray

    def __repr__(self) -> str:
        samples = f'{len(self.time)} samples' if len(self.time) > 1 else 'state at the end'
        whole = int(np.isfinite(self.states[:, -1, 0]).sum())
        return (
            f'Batch({len(self.states)} runs, {samples} up to {self.time[-1]:g} s, '
            f'{whole} runs complete)'
        )

    @property
    def depth(self) -> FloatArray:
        """Inserted lengths [m], shape (runs, k + 1)."""
        lengths = np.array([p.length for p in self.parameters])[:, np.newaxis]
        return np.asarray(lengths - self.states[:, :, 0])

    @property
    def velocity(self) -> FloatArray:
        """Insertion velocities [m/s], shape (runs, k + 1)."""
        return np.asarray(-self.states[:, :, self.states.shape[2] // 2])

    @property
    def tip_deflection(self) -> FloatArray:
        """Deflections of the tip [m], shape (runs, k + 1)."""
        models = [NeedleModel(p) for p in self.parameters]
        if len(models) == 1:
            return models[0].tip_deflections(self.states)
        runs = zip(models, self.states, strict=True)
        return np.array([model.tip_deflections(states) for model, states in runs])


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
    progress: Callable[[], object] | None = None,
) -> Batch:
    """
    Simulate many insertions at once on all cores; the result does not depend on how many.

    Parameters
    ----------
    parameters : NeedleParameters or sequence of them
        Constants, for all runs or for each. All must have the same number of modes.
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
    progress : callable, optional
        Called after each run, from the thread that took it; for example ``update`` of a progress
        bar of tqdm.

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

    Examples
    --------
    A hundred forces at once:

    >>> import numpy as np
    >>> from needle_dynamics import NeedleModel, NeedleParameters, simulate_batch
    >>> parameters = NeedleParameters.preset('phantom')
    >>> start = NeedleModel(parameters).state_at(0.05)
    >>> forces = np.linspace(1.0, 4.0, 100)
    >>> batch = simulate_batch(parameters, start, forces, duration=0.1, interval=0.05)
    >>> batch
    Batch(100 runs, 3 samples up to 0.1 s, 100 runs complete)
    >>> batch.depth.shape
    (100, 3)
    >>> print(f'{batch.velocity[-1, -1]:.4f} m/s')
    0.0115 m/s

    """
    each = [parameters] if isinstance(parameters, NeedleParameters) else list(parameters)
    starts = np.atleast_2d(floats('states', states))
    pushes, turns = (
        values.reshape(-1, 1) if values.ndim < 2 else values
        for values in (floats('forces', forces), floats('torques', torques))
    )
    count = count_of(duration, interval)
    sizes = {len(each), len(starts), len(pushes), len(turns)} - {1}
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
    step = checked_step(step)
    if workers is not None and (not isinstance(workers, int) or workers < 1):
        raise ParameterError(f'workers must be an integer >= 1, got {workers!r}')
    runs = sizes.pop() if sizes else 1
    models = [NeedleModel(p) for p in each]
    needles = [model.compiled for model in models]
    starts = np.array(
        [models[i % len(models)].checked_state(starts[i % len(starts)]) for i in range(runs)]
    )
    result = np.full((runs, count + 1 if keep else 1, starts.shape[1]), np.nan)
    completed = np.empty(runs)

    def take(share: range) -> None:
        for i in share:
            push, turn = (
                np.ascontiguousarray(np.broadcast_to(values[i % len(values)], (count,)))
                for values in (pushes, turns)
            )
            done = run(
                needles[i % len(needles)], starts[i], push, turn, float(interval), step, graded,
                result[i],
            )  # fmt: skip
            completed[i] = done * interval
            if not keep and done == count:
                result[i, 0] = starts[i]
            if progress is not None:
                progress()

    workers = min(workers or os.cpu_count() or 1, runs)
    with ThreadPoolExecutor(workers) as pool:
        # A thread takes its share at once: one task per run would cost more than short runs do.
        list(pool.map(take, [range(k, runs, workers) for k in range(workers)]))
    time = np.arange(count + 1, dtype=np.float64) * interval
    return Batch(tuple(each), time if keep else time[-1:], result, completed)
