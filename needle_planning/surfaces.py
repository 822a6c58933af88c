# SPDX-License-Identifier: Apache-2.0
"""Voxels inside of closed surfaces, from STL files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
import re
from typing import Final

from needle_dynamics import FloatArray
from needle_planning.anatomy import SegmentationError
from needle_planning.voxels import check_size, Layer, to_ras
from needle_ros.errors import missing_extra
import numpy as np
from numpy.typing import NDArray

#: Largest size of the STL files of a grid [byte]: 1.3 million triangles, read with 1.3 GB.
_LARGEST: Final = 2**26
_CHUNK: Final = 2**18  #: Columns of voxels that are compared with triangles at once.


def read_surfaces(paths: Sequence[Path], space: str, spacing: float) -> Iterator[Layer]:
    """Yield the voxels inside of each surface, on one grid with a spacing [m] along RAS."""
    if (size := sum(path.stat().st_size for path in paths)) > _LARGEST:
        raise SegmentationError(
            f'has {size} bytes of surfaces, at most {_LARGEST} are read: reduce their triangles'
        )
    surfaces = [_triangles(path, space) for path in paths]
    low = np.floor(np.min([one.min((0, 1)) for one in surfaces], 0) / spacing)
    high = np.ceil(np.max([one.max((0, 1)) for one in surfaces], 0) / spacing)
    shape = tuple(int(size) for size in np.maximum(high - low, 1.0))
    check_size(shape)
    matrix = np.diag([spacing, spacing, spacing, 1.0])
    matrix[:3, 3] = (low + 0.5) * spacing
    for path, triangles in zip(paths, surfaces, strict=True):
        inside = voxels_inside((triangles - matrix[:3, 3]) / spacing, shape)
        if not inside.any():
            extent = float(np.ptp(triangles, axis=(0, 1)).max())
            raise SegmentationError(
                f'{path.name} encloses no voxel of {1e3 * spacing:g} mm: its extent is '
                f'{1e3 * extent:.3g} mm, read in mm as all STL files; reduce spacing, or scale it'
            )
        yield Layer(inside.view(np.uint8), matrix, {1: path.stem}, closed=True)


def _triangles(path: Path, space: str) -> FloatArray:
    """Return the corners of the triangles of a closed surface in RAS [m], shape (n, 3, 3)."""
    try:
        import trimesh
    except ModuleNotFoundError as error:
        raise missing_extra(error, f'reading {path.name}', 'plan') from error
    content = path.read_bytes()
    stated = re.search(rb'SPACE=(RAS|LPS)\b', content[:200])
    of_file = stated[1].decode() if stated else space
    if not of_file:
        raise SegmentationError(
            f'{path.name} does not state its space: add space: LPS or space: RAS to the labels'
        )
    try:
        mesh = trimesh.load_mesh(BytesIO(content), file_type='stl', process=False)
        corners = np.asarray(mesh.triangles, dtype=np.float64).reshape(-1, 3, 3)
    # Any, for random bytes.
    except Exception as error:
        raise SegmentationError(f'{path.name} is not an STL file: {error!r}') from error
    if not len(corners):
        raise SegmentationError(f'{path.name} is not an STL file, or truncated: no triangles')
    if not np.all(np.abs(corners) < 1e6):
        raise SegmentationError(f'{path.name} has corners beyond 1 km')
    if not _is_closed(corners):
        raise SegmentationError(f'{path.name} is not a closed surface')
    matrix = to_ras(np.eye(4), of_file, 1e-3)
    return np.asarray(corners @ matrix[:3, :3].T)


def _is_closed(corners: FloatArray) -> bool:
    """Return whether every edge belongs to an even number of triangles."""
    points = corners.reshape(-1, 3)
    order = np.lexsort(points.T)
    is_new = np.any(np.diff(points[order], axis=0, prepend=np.nan) != 0.0, axis=1)
    numbers = np.empty(len(points), np.int64)
    numbers[order] = np.cumsum(is_new)
    first, second = numbers, np.roll(numbers.reshape(-1, 3), -1, axis=1).ravel()
    edges = len(points) * np.minimum(first, second) + np.maximum(first, second)
    _, counts = np.unique(edges[first != second], return_counts=True)
    return len(counts) > 0 and not np.any(counts % 2)


def voxels_inside(triangles: FloatArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """
    Return the voxels whose centers are inside of a closed surface, by its crossings of columns.

    Parameters
    ----------
    triangles : array, shape (n, 3, 3)
        Corners of triangles, as voxel indices.
    shape : tuple of int
        Number of voxels along the three axes.

    Returns
    -------
    array of bool
        Voxels of `shape`.
    """
    # A common order of the corners: both triangles of an edge compute the same crossings of it.
    corners = _sorted_corners(triangles)
    low = np.clip(np.ceil(corners[:, :, :2].min(1)), 0, shape[:2]).astype(np.int64)
    high = np.clip(np.floor(corners[:, :, :2].max(1)) + 1, 0, shape[:2]).astype(np.int64)
    widths = np.maximum(high - low, 0)
    ends = np.cumsum(widths.prod(1))
    crossed = np.zeros(shape, np.bool_)
    for start in range(0, int(ends[-1]), _CHUNK):
        pairs = np.arange(start, min(start + _CHUNK, int(ends[-1])))
        which = np.searchsorted(ends, pairs, 'right')
        rest = pairs - (ends[which] - widths[which].prod(1))
        i, j = low[which].T + np.divmod(rest, widths[which, 1])
        through = _contains(corners[which], i, j)
        which, i, j = which[through], i[through], j[through]
        k = np.ceil(_heights(corners[which], i, j)).astype(np.int64)
        within = k < shape[2]
        at = tuple(axis[within] for axis in (i, j, np.maximum(k, 0)))
        np.logical_xor.at(crossed, at, True)
    return np.asarray(np.logical_xor.accumulate(crossed, axis=2, out=crossed))


def _sorted_corners(triangles: FloatArray) -> FloatArray:
    keys = np.lexsort(np.moveaxis(triangles, 2, 0)[::-1], axis=1)
    return np.asarray(np.take_along_axis(triangles, keys[:, :, None], 1))


def _contains(
    corners: FloatArray, i: NDArray[np.int64], j: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return whether each triangle contains a column, by the even-odd rule with open ends."""
    found = np.zeros(len(i), np.bool_)
    for a, b in ((0, 1), (1, 2), (0, 2)):
        (xa, ya), (xb, yb) = corners[:, a, :2].T, corners[:, b, :2].T
        spans = (ya > j) != (yb > j)
        share = (j - ya) / np.where(spans, yb - ya, 1.0)
        found ^= spans & (i < xa + share * (xb - xa))
    return found


def _heights(corners: FloatArray, i: NDArray[np.int64], j: NDArray[np.int64]) -> FloatArray:
    """Return where columns cross the planes of triangles, within the heights of their corners."""
    origin, z = corners[:, 0], corners[:, :, 2]
    normal = np.cross(corners[:, 1] - origin, corners[:, 2] - origin)
    flat = normal[:, 2] == 0.0
    slope = normal[:, :2] / np.where(flat, 1.0, normal[:, 2])[:, None]
    height = z[:, 0] - slope[:, 0] * (i - origin[:, 0]) - slope[:, 1] * (j - origin[:, 1])
    return np.clip(np.where(flat, z[:, 0], height), z.min(1), z.max(1))
