# SPDX-License-Identifier: Apache-2.0
"""Closed surfaces of the structures of an anatomy, of a limited number of triangles."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray, IntArray
from needle_planning.anatomy import Anatomy, Structure
from needle_planning.voxels import turned
import numpy as np
from numpy.typing import NDArray

#: Motions toward the mean of the neighbors, as a fraction: the second one restores the volume.
_MOTIONS: Final = (0.6, -0.63, 0.6, -0.63)
_HALF: Final = 0.5  #: Largest motion of a point along each axis [voxels].
_COARSER: Final = 1.25  #: Factor of the size of the cells in which points are merged.


class Surface(NamedTuple):
    """Surface of triangles."""

    points: FloatArray  #: in patient coordinates [m], shape (n, 3)
    triangles: IntArray  #: points of each, counterclockwise seen from outside, shape (m, 3)
    cell: float  #: size of the cells in which points were merged [m]; 0: none were


def surfaces(anatomy: Anatomy, most: int) -> Iterator[tuple[Structure, Surface]]:
    """Yield each structure with its surface of at most `most` triangles, by label."""
    from scipy.ndimage import find_objects

    # All orientations of an image have the same surfaces.
    labels, to_patient = turned(anatomy.labels, anatomy.to_patient)
    boxes, whole = find_objects(labels), (slice(None),) * 3
    for label, structure in sorted(anatomy.structures.items()):
        box = boxes[label - 1] if 0 < label <= len(boxes) else whole
        if box is None:
            continue
        mask = labels[box] == label
        if mask.any():
            first = np.array([one.start or 0 for one in box], dtype=np.float64)
            yield structure, surface(mask, to_patient, first, most)


def surface(
    mask: NDArray[np.bool_], to_patient: FloatArray, first: FloatArray, most: int
) -> Surface:
    """
    Return the surface of voxels by the method of surface nets [Gibson]_.

    A point is in each cube of eight voxel centers that the surface passes, at the mean of the
    places between neighbors that differ, then smoothed within half a voxel [Taubin]_.

    Parameters
    ----------
    mask : ndarray of bool, shape (i, j, k)
        Voxels inside.
    to_patient : ndarray, shape (4, 4)
        From voxel indices to patient coordinates [m].
    first : ndarray, shape (3,)
        Index of the first voxel of the mask.
    most : int
        Largest number of triangles; to reach it, the points in cells of a grid are merged.

    Returns
    -------
    Surface
        Surface, without triangles if it is smaller than a cell.

    References
    ----------
    .. [Gibson] S. F. F. Gibson, "Constrained elastic surface nets", MICCAI 1998,
       doi:10.1007/BFb0056277.
    .. [Taubin] G. Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995,
       doi:10.1145/218380.218473.

    """
    points, quads = _net(np.pad(mask, 1))
    points = _smooth(points, quads)
    matrix = to_patient[:3, :3]
    if np.linalg.det(matrix) < 0.0:
        quads = quads[:, ::-1]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    # Without the padding.
    points = (points + first - 1.0) @ matrix.T + to_patient[:3, 3]
    cell, merged = 0.0, (points, triangles)
    while len(merged[1]) > most:
        # The number of triangles is about proportional to the square of the cell.
        size = float(np.linalg.norm(matrix, axis=0).min())
        cell = cell * _COARSER or size * max(1.0, sqrt(len(triangles) / most))
        merged = _merged(points, triangles, cell)
    return Surface(*merged, cell)


def _net(solid: NDArray[np.bool_]) -> tuple[FloatArray, IntArray]:
    """Return the points of the cubes on a surface, and their quads around each crossed edge."""
    places, cubes = [], []
    for axis in range(3):
        low, high = (
            solid[tuple(part if k == axis else slice(None) for k in range(3))]
            for part in (slice(None, -1), slice(1, None))
        )
        edges = np.argwhere(low != high)
        u, v = np.roll(np.eye(3, dtype=np.int64), -1 - axis, axis=0)[:2]
        around = edges[:, np.newaxis] - [0 * u, u, u + v, v]
        outward = low[tuple(edges.T)]
        around[~outward] = around[~outward, ::-1]
        places.append(edges + 0.5 * np.eye(3)[axis])
        cubes.append(np.ravel_multi_index(np.moveaxis(around, 2, 0), solid.shape))
    each = np.concatenate(cubes)
    _, quads = np.unique(each, return_inverse=True)
    quads = quads.reshape(each.shape)
    return _means(quads, np.repeat(np.concatenate(places)[:, np.newaxis], 4, axis=1)), quads


def _means(groups: IntArray, values: FloatArray) -> FloatArray:
    """Return the mean of the values (..., 3) in each group of (...), shape (n, 3)."""
    groups, flat = groups.ravel(), values.reshape(-1, 3)
    count = np.bincount(groups)
    sums = [np.bincount(groups, weights=column) for column in flat.T]
    return np.asarray(np.stack(sums, axis=1) / count[:, np.newaxis])


def _smooth(points: FloatArray, quads: IntArray) -> FloatArray:
    found, neighbors = points, np.roll(quads, -1, axis=1)
    for part in _MOTIONS:
        moved = found + part * (_means(quads, found[neighbors]) - found)
        found = np.clip(moved, points - _HALF, points + _HALF)
    return found


def _merged(points: FloatArray, triangles: IntArray, cell: float) -> tuple[FloatArray, IntArray]:
    """Merge all points in each cell of a grid [m]; triangles with merged corners disappear."""
    # Cells from a corner of the surface: the same ones for all orientations of an image.
    index = np.floor((points - points.min(axis=0)) / cell + 1e-6).astype(np.int64)
    flat = np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0) + 1))
    _, which = np.unique(flat, return_inverse=True)
    corners = which[triangles]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    # Two layers of a thin structure become one.
    _, kept = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    corners = corners[np.sort(kept)]
    used, corners = np.unique(corners, return_inverse=True)
    return _means(which, points)[used], corners.reshape(-1, 3)
