# SPDX-License-Identifier: Apache-2.0
"""Parallel simulation of many steered needles on all cores."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from needle_dynamics.arrays import FloatArray, floats
from needle_dynamics.compiled.cut import insert, NO_FORCES
from needle_dynamics.display import Progress, progress_of
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.batch import number_of_runs, thread_count
from needle_dynamics.steering.needle import empty_cut, steered, wandering
from needle_dynamics.steering.parameters import noise_cell, SteeringParameters
from needle_ros.errors import ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike


def insert_batch(
    needles: NeedleParameters | Sequence[NeedleParameters],
    steering: SteeringParameters | Sequence[SteeringParameters],
    depths: ArrayLike,
    *,
    guides: ArrayLike = 0.0,
    tilts: ArrayLike = 0.0,
    rolls: ArrayLike = 0.0,
    seeds: ArrayLike = (0,),
    workers: int | None = None,
    progress: Progress | None = None,
) -> FloatArray:
    """
    Insert many needles in parallel; the result does not depend on the number of workers.

    Parameters
    ----------
    needles : NeedleParameters or sequence of them
        Needle and tissue, for all runs or for each.
    steering : SteeringParameters or sequence of them
        Additional constants of a steered needle; the correlation length must be the same for all.
    depths : array_like, shape (k,) or (runs, k)
        Depths of the tip [m]. Guide and roll change linearly between depths.
    guides, tilts : array_like, shape (), (k, 2) or (runs, k, 2)
        Position [m] and tilt of the guide in x and z; the first values apply when the tip touches
        the skin.
    rolls : array_like, shape (), (k,) or (runs, k)
        Roll of the base [rad].
    seeds : array_like, shape (n,)
        Seed of the path noise, for all runs or for each.
    workers : int, optional
        Threads; one per core by default.
    progress : bool or callable, optional
        True shows a progress bar; a function is called after each run.

    Returns
    -------
    ndarray, shape (runs, k, 3)
        Tip positions in x, y and z [m].

    Examples
    --------
    >>> import numpy as np
    >>> from needle_dynamics import insert_batch, NEEDLES
    >>> needle, steering, _ = NEEDLES['bending_35mm']
    >>> depths = np.linspace(0.0, 0.1, 21)
    >>> tilts = np.zeros((100, 21, 2))
    >>> tilts[:, :, 1] = np.linspace(-0.02, 0.02, 100)[:, np.newaxis]
    >>> tips = insert_batch(needle, steering, depths, tilts=tilts)
    >>> tips.shape
    (100, 21, 3)
    >>> print((1e3 * tips[[0, -1], -1, 2]).round(3))
    [-2.8  2.8]

    """
    poses = _poses(depths, guides, tilts, rolls)
    each = [needles] if isinstance(needles, NeedleParameters) else list(needles)
    beyond = [steering] if isinstance(steering, SteeringParameters) else list(steering)
    drawn_from = np.atleast_1d(np.asarray(seeds)).tolist()
    runs = number_of_runs(
        needles=len(each), steering=len(beyond), poses=len(poses), seeds=len(drawn_from)
    )
    cell = noise_cell(beyond[0])
    if any(noise_cell(one) != cell for one in beyond):
        raise ParameterError('path_noise_length must be the same for all runs')
    kinds = range(max(len(each), len(beyond)))
    pairs = [(each[i % len(each)], beyond[i % len(beyond)]) for i in kinds]
    constants = [steered(*pair) for pair in pairs]
    values = np.array(
        [[*n[:6], s.free_length] for n, (_, s) in zip(constants, pairs, strict=True)]
    )
    deep, reach = poses[:, :, 0].max(axis=1), values[:, 5] - values[:, 6]
    if (poses[:, :, 0] < 0.0).any() or (deep > reach).any():
        raise ParameterError(
            f'depths must be in [0, {reach.min():g}] m, the length of the needle minus its free '
            f'length, got up to {deep.max():g} m'
        )
    layers = np.full((len(pairs), 3, max(len(n.starts) for n in constants)), np.inf)
    for row, n in zip(layers, constants, strict=True):
        row[:, : len(n.starts)] = n.starts, n.stiffness, n.bevel
    draws = range(max(len(pairs), len(drawn_from)) if any(s.path_noise for s in beyond) else 1)
    drawn = [wandering(*pairs[i % len(pairs)], drawn_from[i % len(drawn_from)]) for i in draws]
    wander = np.zeros((len(drawn), max(map(len, drawn)), 2))
    for row, loads in zip(wander, drawn, strict=True):
        row[: len(loads)] = loads
    tips = np.empty((runs, poses.shape[1], 2))
    workers = thread_count(workers, runs)
    longest = values[:, 5].max()
    rooms = [empty_cut(longest, values[:, 1].min(), layers.shape[2]) for _ in range(workers)]

    with progress_of(progress, runs, 'runs') as advance, ThreadPoolExecutor(workers) as pool:

        def take(worker: int) -> None:
            share = np.arange(worker, runs, workers)
            # One call for all runs, or one for each that is reported.
            for part in share[:, np.newaxis] if progress else [share]:
                insert(values, layers, cell, wander, poses, part, rooms[worker], tips, NO_FORCES)
                advance()

        list(pool.map(take, range(workers)))
    x, z = tips[:, :, 0], tips[:, :, 1]
    return np.stack([x, np.broadcast_to(poses[:, :, 0], x.shape), z], axis=2)


def _poses(depths: ArrayLike, guides: ArrayLike, tilts: ArrayLike, rolls: ArrayLike) -> FloatArray:
    """Return the poses as an array, shape (runs or 1, k, 6)."""
    depth, roll = floats('depths', depths), floats('rolls', rolls)
    guide, tilt = floats('guides', guides), floats('tilts', tilts)
    if depth.ndim not in (1, 2) or 0 in depth.shape:
        raise ShapeError(f'depths must have shape (k,) or (runs, k), got {depth.shape}')
    k = depth.shape[-1]
    shapes = []
    for name, values, single in (
        ('depths', depth, (k,)),
        ('guides', guide, (k, 2)),
        ('tilts', tilt, (k, 2)),
        ('rolls', roll, (k,)),
    ):
        if values.shape != () and values.shape[-len(single) :] != single:
            several = f'(runs, {", ".join(map(str, single))})'
            raise ShapeError(f'{name} must have shape {single} or {several}, got {values.shape}')
        shapes.append(values.shape[: max(0, values.ndim - len(single))])
    try:
        runs = np.broadcast_shapes(*shapes) or (1,)
    except ValueError:
        raise ShapeError(f'depths, guides, tilts and rolls must agree, got {shapes}') from None
    if len(runs) > 1:
        raise ShapeError(f'there must be at most one axis of runs, got {runs}')
    poses = np.empty((*runs, k, 6))
    poses[..., 0], poses[..., 5] = depth, roll
    poses[..., [1, 3]], poses[..., [2, 4]] = guide, tilt
    return poses
