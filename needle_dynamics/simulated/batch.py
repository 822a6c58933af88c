# SPDX-License-Identifier: Apache-2.0
"""Parallel simulation of many insertions on all cores."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from math import ceil, inf
from typing import Final

from needle_dynamics.arrays import FloatArray, floats, IntArray
from needle_dynamics.compiled import lanes
from needle_dynamics.compiled.intervals import run
from needle_dynamics.compiled.lane_rows import COLUMNS, Constants, LaneModes, LAYER, SECOND
from needle_dynamics.compiled.many_batch import run_many
from needle_dynamics.compiled.many_lanes import MANY, PIECES, TERMS
from needle_dynamics.display import Progress, progress_of
from needle_dynamics.friction import LAW_NUMBERS
from needle_dynamics.model import NeedleModel, ROUNDING
from needle_dynamics.modes import mode_shapes
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.integrator import checked_step, DEFAULT_STEP
from needle_dynamics.simulated.needle_array import columns_of, NeedleArray
from needle_dynamics.simulated.trajectory import count_of, LEAST_TOLERANCE, refined
from needle_ros.errors import ParameterError, ShapeError
from needle_ros.process import cores
from needle_ros.settings import checked, is_whole
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike

_CHUNK: Final = 256  #: largest number of runs per task, enough to fill all vector lanes

#: Constants of the lanes that are attributes of `NeedleParameters`.
_OWN: Final = [one for one in Constants._fields if hasattr(NeedleParameters, one)]
_ONE_MODE: Final = [0, 1, 2, 4, 5, 6]  #: entries of a state in the lanes for a single mode


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Batch:
    """Result of many simulated runs."""

    parameters: Sequence[NeedleParameters]  #: constants of each run, or one for all
    #: Time of the k + 1 samples [s], and states, shape (runs, k + 1, 2 (2 + n)), NaN after a run
    #: has left its range; one sample for final states only.
    time: FloatArray
    states: FloatArray
    completed: FloatArray  #: end of the valid part of each run [s], shape (runs,)
    #: `Trajectory.error` of the valid part of each run, shape (runs,); NaN without a tolerance.
    error: FloatArray

    def __repr__(self) -> str:
        samples = f'{len(self.time)} samples' if len(self.time) > 1 else 'state at the end'
        whole = int(np.isfinite(self.states[:, -1, 0]).sum())
        return (
            f'Batch({len(self.states)} runs, {samples} up to {self.time[-1]:g} s, '
            f'{whole} runs complete)'
        )

    @property
    def depth(self) -> FloatArray:
        """Insertion depths [m], shape (runs, k + 1)."""
        lengths = columns_of(self.parameters, ['length'])['length']
        return np.asarray(lengths[:, np.newaxis] - self.states[:, :, 0])

    @property
    def velocity(self) -> FloatArray:
        """Insertion velocities [m/s], shape (runs, k + 1)."""
        return np.asarray(-self.states[:, :, self.states.shape[2] // 2])

    @property
    def tip_deflection(self) -> FloatArray:
        """Tip deflections [m], shape (runs, k + 1)."""
        shared = columns_of(self.parameters, ['length', 'reach'])
        if all((values == values[0]).all() for values in shared.values()):
            # The modes are the same.
            return NeedleModel(self.parameters[0]).tip_deflections(self.states)
        runs = zip(self.parameters, self.states, strict=True)
        return np.array([NeedleModel(p).tip_deflections(states) for p, states in runs])


def simulate_batch(
    parameters: NeedleParameters | Sequence[NeedleParameters],
    states: ArrayLike,
    forces: ArrayLike,
    torques: ArrayLike = 0.0,
    *,
    duration: float,
    interval: float,
    step: float | None = None,
    graded: bool = False,
    tolerance: float | None = None,
    keep: bool = True,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Batch:
    """
    Simulate many insertions in parallel; the result does not depend on the number of workers.

    Parameters
    ----------
    parameters : NeedleParameters or sequence of them
        Constants, for all runs or for each; a `NeedleArray` has arrays of those that differ. All
        must have the same number of modes.
    states : array_like, shape (runs, 2 (2 + n)) or (2 (2 + n),)
        Initial states.
    forces, torques : array_like, shape (), (runs,) or (runs, k)
        Insertion force [N] and torque [N m], constant over each interval.
    duration, interval : float
        As in `simulate` [s].
    step : float, optional
        Longest step of all runs [s], by default 1e-5.
    graded : bool
        As in `Integrator`.
    tolerance : float, optional
        Instead of a step: largest `Trajectory.error` of each run, whose samples then equal those
        of `simulate`, to the bit.
    keep : bool
        Keep the states at all samples, or only the final states.
    workers : int, optional
        Threads; one per core by default.
    progress : bool or callable, optional
        True shows a progress bar; a function is called after each run, from its worker thread.

    Returns
    -------
    Batch
        Results.

    Raises
    ------
    ToleranceError
        If a run cannot meet the tolerance.

    Examples
    --------
    A hundred forces in parallel:

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
    each: Sequence[NeedleParameters]
    if isinstance(parameters, NeedleArray):
        each = parameters
    else:
        each = (parameters,) if isinstance(parameters, NeedleParameters) else tuple(parameters)
    starts = np.atleast_2d(floats('states', states))
    pushes, turns = (
        values.reshape(-1, 1) if values.ndim < 2 else values
        for values in (floats('forces', forces), floats('torques', torques))
    )
    count = count_of(duration, interval)
    runs = number_of_runs(
        parameters=len(each), states=len(starts), forces=len(pushes), torques=len(turns)
    )
    inputs_fit = all(v.ndim == 2 and v.shape[1] in (1, count) for v in (pushes, turns))
    if starts.ndim != 2 or not starts.size or not inputs_fit:
        raise ShapeError(
            f'forces and torques must be constant or for {count} intervals, got states '
            f'{starts.shape}, forces {pushes.shape}, torques {turns.shape}'
        )
    if tolerance is not None and (step is not None or graded):
        raise ParameterError('tolerance excludes step and graded')
    if tolerance is not None:
        checked('tolerance', tolerance, low=LEAST_TOLERANCE)
    step = checked_step(DEFAULT_STEP if step is None else step)
    _check(each, starts)
    inputs = lanes.BatchTrajectory(pushes, turns, count, float(interval), step, graded)
    # In C order, as compiled.
    ends = np.broadcast_to(starts, (runs, starts.shape[1])).copy()
    workers = thread_count(workers, runs)
    with progress_of(progress, runs, 'runs') as advance:
        kept, completed, error = _take(
            each, ends, inputs, tolerance, keep=keep, workers=workers, progress=advance
        )
    time = np.arange(count + 1, dtype=np.float64) * interval
    return Batch(each, time if keep else time[-1:], kept, completed * interval, error)


def number_of_runs(**counts: int) -> int:
    """Return the number of runs of a batch; each input is for one run or for all."""
    found = {*counts.values()} - {1}
    if len(found) > 1 or 0 in found:
        given = ', '.join(f'{count} {name}' for name, count in counts.items())
        raise ShapeError(f'all inputs must be for the same number of runs or for one, got {given}')
    return found.pop() if found else 1


def thread_count(workers: int | None, runs: int) -> int:
    """Return the number of threads of a batch; by default one per core."""
    if workers is not None and (not is_whole(workers) or workers < 1):
        raise ParameterError(f'workers must be an integer >= 1, got {workers!r}')
    return min(int(workers or cores()), runs)


def _take(
    each: Sequence[NeedleParameters],
    states: FloatArray,
    inputs: lanes.BatchTrajectory,
    tolerance: float | None,
    *,
    keep: bool,
    workers: int,
    progress: Callable[[], object],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return states, completed intervals and errors of all runs; overwrite ``states``."""
    runs, width = states.shape
    kept = np.full((runs, inputs.intervals + 1 if keep else 1, width), np.nan)
    completed, errors = np.zeros(runs), np.full(runs, np.nan)

    @cache
    def model(k: int) -> NeedleModel:
        return NeedleModel(each[k])

    def alone(some: IntArray) -> None:
        for i in some:
            push, turn = (
                np.ascontiguousarray(np.broadcast_to(values[i % len(values)], (inputs.intervals,)))
                for values in (inputs.forces, inputs.torques)
            )
            needle = model(i % len(each))
            if tolerance is None:
                completed[i] = run(
                    needle.compiled, states[i], push, turn, inputs.interval, inputs.longest,
                    inputs.graded, 1, kept[i],
                )  # fmt: skip
            else:
                found = refined(needle, states[i], push, turn, inputs.interval, tolerance)
                completed[i], errors[i], states[i] = found.done, found.error, found.end
                if keep:
                    kept[i, : found.done + 1] = found.states[: found.done + 1]
            progress()

    def together(needles: FloatArray, modes: LaneModes, some: IntArray) -> None:
        advance = run_many if modes.number > 2 else lanes.run
        given = needles, modes, layers, inputs, some, wide, wide_kept, completed
        advance(lanes.LaneBatch(*given))
        for _ in some:
            progress()

    # Several runs per task: the overhead of one task per run exceeds the cost of short runs.
    size = min(_CHUNK, -(-runs // workers))
    jobs = list[Callable[[], None]]()
    layers = lane_layers(each)
    groups = lane_groups(each, runs, together=tolerance is None)
    wide, wide_kept = lane_states(states), lane_states(kept)
    for reach, some in groups.items():
        job = alone
        if reach is not None:
            job = partial(together, lane_constants(each), lane_modes(reach, each[0].modes))
        jobs += [partial(job, some[k : k + size]) for k in range(0, len(some), size)]
    with ThreadPoolExecutor(workers) as pool:
        for done in [pool.submit(job) for job in jobs]:
            done.result()
    _take_one_mode(groups, states, wide)
    _take_one_mode(groups, kept, wide_kept)
    if not keep:
        whole = completed == inputs.intervals
        kept[whole, 0] = states[whole]
    return kept, completed, errors


def _take_one_mode(
    groups: Mapping[float | None, IntArray], states: FloatArray, wide: FloatArray
) -> None:
    """Copy the states of needles with one mode from those of the lanes, if these are others."""
    for reach, some in groups.items():
        if reach is not None and wide is not states:
            states[some] = wide[some][..., _ONE_MODE]


def _check(each: Sequence[NeedleParameters], starts: FloatArray) -> None:
    """Reject initial states like `NeedleModel.checked_state`, but vectorized."""
    columns = columns_of(each, ['length', 'minimum_depth', 'reach', 'modes'])
    length, least, reach, modes = columns.values()
    depth = length - starts[:, 0]
    valid = (least - ROUNDING * length <= depth) & (depth <= reach * length)
    valid &= (4 + 2 * modes == starts.shape[1]) & np.isfinite(starts).all(axis=1)
    for i in np.flatnonzero(~valid).tolist():
        NeedleModel(each[i % len(each)]).checked_state(starts[i % len(starts)])


def lane_groups(
    each: Sequence[NeedleParameters], runs: int, *, together: bool = True
) -> dict[float | None, IntArray]:
    """Group the runs by the reach of a shared mode table; None for runs without one."""
    alike = isinstance(each, NeedleArray) or len(each) == 1
    some = each[:1] if alike else each
    reaches = [p.reach if together and _fits(p) else None for p in some]
    if alike:
        return {reaches[0]: np.arange(runs)}
    return {
        one: np.array([i for i, reach in enumerate(reaches) if reach == one])
        for one in dict.fromkeys(reaches)
    }


def _fits(p: NeedleParameters) -> bool:
    return p.modes <= MANY and p.formulation == 'complete'


def lane_constants(each: Sequence[NeedleParameters]) -> FloatArray:
    """Return the rows of `Constants`, shape (runs, 19)."""
    columns = columns_of(each, ['minimum_depth', 'reach', 'hub_stop', *_OWN])
    least, reach, stops = (columns.pop(name) for name in ('minimum_depth', 'reach', 'hub_stop'))
    length = columns['length']
    columns['lowest'] = least - ROUNDING * length
    columns['highest'] = reach * length
    columns['stop'] = np.where(stops, length, inf)
    if isinstance(each, NeedleArray):
        columns['law'] = np.full(len(each), LAW_NUMBERS[each.base.friction_law], dtype=np.float64)
    else:
        columns['law'] = np.array([LAW_NUMBERS[p.friction_law] for p in each], dtype=np.float64)
    return np.column_stack([columns[name] for name in Constants._fields])


def lane_layers(each: Sequence[NeedleParameters]) -> FloatArray:
    """Return the layers of `lanes.run`, shape (runs, m, `LAYER` + pairs of modes)."""
    if isinstance(each, NeedleArray):
        return _layers_of(each)
    varied = [k for k, p in enumerate(each) if _fits(p) and (p.swelling or p.layer_depths)]
    most = max((1 + len(each[k].layer_depths) for k in varied), default=0)
    found = _uniform(each, most, each[0].modes)
    for k in varied:
        layers = NeedleModel(each[k]).compiled.layers
        rows = _layer_rows(layers.starts, layers.stiffnesses, layers.gram)
        found[k, : len(rows), : rows.shape[1]] = rows
    return found


def _uniform(each: Sequence[NeedleParameters], most: int, modes: int) -> FloatArray:
    """Return the layers of needles in uniform tissue, with space for ``most`` layers."""
    found = np.zeros((len(each), most, LAYER + max(3, modes * (modes + 1) // 2)))
    if most:
        found[:, 1:, 0] = inf
        found[:, 0, 1] = columns_of(each, ['tissue_stiffness'])['tissue_stiffness']
    return found


def _layer_rows(starts: FloatArray, stiffnesses: FloatArray, gram: FloatArray) -> FloatArray:
    """Return layers, shape (..., m), as (..., m, columns), with the sums above, (..., n, n)."""
    upper = gram[(..., *np.triu_indices(gram.shape[-1]))]
    return np.concatenate([np.stack([starts, stiffnesses], axis=-1), upper], axis=-1)


def _layers_of(each: NeedleArray) -> FloatArray:
    """Return `lane_layers` of needles whose constants are arrays."""
    base, (depths, stiffnesses) = each.base, each.layers
    modes, (runs, further) = base.modes, depths.shape
    most = 1 + further if further or each.column('swelling').any() else 0
    found = _uniform(each, most if _fits(base) else 0, modes)
    if not found.shape[1] or not further:
        return found
    gram = np.zeros((runs, most, modes, modes))
    own = np.column_stack([each.column('tissue_stiffness'), stiffnesses])
    for i, at in enumerate(_grams_at_layers(each, depths), start=1):
        change = own[:, i - 1] - own[:, i]
        gram[:, i] = gram[:, i - 1] + change[:, np.newaxis, np.newaxis] * at
    rows = _layer_rows(np.column_stack([np.zeros(runs), depths]), own, gram)
    found[..., : rows.shape[2]] = rows
    return found


def _grams_at_layers(each: NeedleArray, depths: FloatArray) -> FloatArray:
    """Return the mode integrals G at layers, shape (layers, runs or 1, n, n)."""
    lengths, base = each.column('length'), each.base
    if not {'length', 'layer_depths'} & each.constants.keys():
        lengths, depths = lengths[:1], depths[:1]
    found = [
        [
            mode_shapes(length, base.modes, base.reach)
            .integrals(min(depth, base.reach * length)).gram
            for depth in row
        ]
        for length, row in zip(lengths.tolist(), depths.tolist(), strict=True)
    ]  # fmt: skip
    return np.array(found).swapaxes(0, 1)


@cache
def lane_modes(reach: float, modes: int) -> LaneModes:
    """Return the modes of length 1 for `lanes.run`."""
    if modes > 2:
        return LaneModes(modes, _pieces(reach, modes))
    series = mode_shapes(1.0, 2, reach).tables.series[:, :COLUMNS]
    more = -(len(series) - 1) % 4
    table = np.concatenate([series, np.zeros((more, COLUMNS))])
    if modes == 1:
        # The second mode has no effect.
        table[:, SECOND] = 0.0
    return LaneModes(2, table)


def _pieces(reach: float, modes: int) -> FloatArray:
    """Return the polynomials of `many_lanes`, interpolated at Chebyshev nodes."""
    count = ceil(reach * PIECES)
    shapes, upper = mode_shapes(1.0, modes, count / PIECES), np.triu_indices(modes)
    angles = (np.arange(TERMS) + 0.5) * np.pi / TERMS
    # Powers, the highest first, of each Chebyshev polynomial.
    powers = np.zeros((TERMS, TERMS))
    for k, one in enumerate(np.eye(TERMS)):
        own = chebyshev.cheb2poly(one)
        powers[TERMS - len(own) :, k] = own[::-1]
    table = []
    for piece in range(count):
        rows = []
        for xi in (piece + 0.5 + 0.5 * np.cos(angles)) / PIECES:
            at = shapes.integrals(xi)
            gram, curved = at.gram[upper] / xi**5, at.curvature_gram[upper] / xi
            rows.append(np.concatenate([gram, curved, at.value / xi**2, at.curvature]))
        table.append(powers @ chebyshev.chebfit(np.cos(angles), np.array(rows), TERMS - 1))
    return np.concatenate(table)


def lane_states(states: FloatArray) -> FloatArray:
    """Return states of one mode, shape (..., 6), with a second one, (..., 8); else the same."""
    if states.shape[-1] != len(_ONE_MODE):
        return states
    found = np.zeros((*states.shape[:-1], 8))
    found[..., _ONE_MODE] = states
    return found
