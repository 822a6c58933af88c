# SPDX-License-Identifier: Apache-2.0
r"""
Search for the straight line with the largest clearance, by branch and bound.

A line leads from a point of the entry region to the target. If the entry point moves by a distance
:math:`\epsilon`, the point at the fraction s of the line moves by :math:`(1 - s) \epsilon`. The
clearance c is 1-Lipschitz, so that in a cell of the region with radius :math:`\epsilon` no line
has a larger clearance than

.. math:: \min_s \, c(p(s)) + (1 - s) \epsilon + b(s)

with the gain b(s) that a bow of the needle can add (zero for a straight needle), at any set of
fractions s. A cell whose bound exceeds the best line by at most the resolution h is discarded, and
the others are divided. Of all lines whose clearance equals that of the best one, to the accuracy
of a clearance, the shortest is used.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

from needle_controller.steering.insertion_plan import guide_axes
from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_dynamics.simulated.batch import thread_count
from needle_planning.anatomy import Anatomy
from needle_planning.clearance import Clearance, image_frame, ImageFrame, LineClearance, NO_BOW
from needle_ros.settings import checked
import numpy as np

_FIRST: Final = 16e-3  #: Size of the first cells [m].
_PART: Final = 0.1  #: Tolerance of the clearance of a line, as a fraction of the resolution.
_SQUARE: Final = 1e-3  #: Size of the squares of a disc [m].
_CHUNK: Final = 256  #: Lines of a job.
_JOBS: Final = 8  #: Jobs of lines of increasing length that are examined at once.
_NEAR: Final = 1e-6  #: Least length of a line [m].


class EntryRegion(NamedTuple):
    """Points where a needle may enter: equal boxes."""

    centers: FloatArray  #: centers of the boxes in patient coordinates [m], shape (n, 3)
    halves: FloatArray  #: half edges of each box in patient coordinates, rows [m], shape (3, 3)
    frame: ImageFrame  #: frame of the cells, along the axes of the image

    @property
    def radius(self) -> float:
        """Largest distance of a point of a box from its center [m]."""
        return float(np.linalg.norm(self.halves))


def voxel_region(anatomy: Anatomy, labels: list[int], target: FloatArray) -> EntryRegion | None:
    """
    Return the voxels with some labels, None without any.

    Of a thick region only the side away from the target counts: voxels from which the needle
    continues to an empty voxel or out of the image, or without any, out of the region. Where a
    face of the image cuts the region, no needle enters: there it is deeper along the normal of the
    face than it is wide.
    """
    inside = np.zeros_like(anatomy.labels, dtype=np.bool_)
    for label in labels:
        inside |= anatomy.labels == label
    # In the order of the memory.
    order = np.argsort(inside.strides, kind='stable')[::-1]
    found = np.argwhere(inside.transpose(order))
    if not len(found):
        return None
    index = np.empty_like(found)
    index[:, order] = found
    frame = image_frame(anatomy)
    centers = index * frame.spacing
    # A voxel is left out if the next one, away from the target, is also of the region.
    way = index - frame.of_patient(target) / frame.spacing
    size = np.abs(way).max(axis=1, keepdims=True)
    following = index + np.round(np.divide(way, size, where=size > 0.0, out=way)).astype(int)
    shape = np.array(inside.shape)
    there = ((following >= 0) & (following < shape)).all(axis=1)
    outside = ~_left_through_cut_faces(inside, index, following, way, frame.spacing)
    within = following[there]
    # The voxel of the target would continue with itself.
    outside[there] &= ~inside[tuple(within.T)] | (within == index[there]).all(axis=1)
    skin = outside.copy()
    skin[there] &= ~np.isin(anatomy.labels[tuple(within.T)], list(anatomy.structures))
    halves = (0.5 * frame.axes * frame.spacing).T
    kept = skin if skin.any() else outside
    return EntryRegion(frame.to_patient(centers[kept]), halves, frame)


def _left_through_cut_faces(
    inside: BoolArray, index: IntArray, following: IntArray, way: FloatArray, spacing: FloatArray
) -> BoolArray:
    """Return whether the way to the following voxel leaves the image where it cuts the region."""
    shape, found = np.array(inside.shape), np.zeros(len(index), dtype=np.bool_)
    # The way leaves a voxel along its largest component first.
    first = np.abs(way).argmax(axis=1)
    along = np.arange(3) == first[:, np.newaxis]
    next_one = np.where(along, following, index)
    inner = next_one.clip(0, shape - 1)
    leaves = (next_one != inner).any(axis=1)
    within = inside[tuple(inner.T)]
    for axis, end in product(range(3), (-1, 1)):
        out = (following[:, axis] == (-1 if end < 0 else shape[axis])) & within
        out &= (first == axis) | ~leaves
        if out.any():
            others = np.delete(inner[out], axis, axis=1)
            found[out] |= _cut_face(inside, axis, end, spacing)[tuple(others.T)]
    return found


def _cut_face(inside: BoolArray, axis: int, end: int, spacing: FloatArray) -> BoolArray:
    """Return where a face (axis, side -1 or 1) cuts a region of voxels, shape of the face."""
    inward = np.moveaxis(inside, axis, 0)[::-end]
    face, sizes = inward[0], np.delete(spacing, axis)
    depth = np.full(face.shape, len(inward))
    np.copyto(depth, inward.argmin(axis=0), where=~inward.all(axis=0))
    width = np.minimum(_runs(face) * sizes[0], _runs(face.T).T * sizes[1])
    return np.asarray(face & (depth * spacing[axis] > width))


def _runs(face: BoolArray) -> IntArray:
    """Return the number of voxels of the run along the first axis that contains each voxel."""
    # Each change of the value begins a new run.
    change = np.diff(face, axis=0, prepend=~face[:1])
    number = np.cumsum(change, axis=0) + np.arange(face.shape[1]) * (len(face) + 1)
    return np.asarray(np.bincount(number.ravel())[number])


def disc_region(point: FloatArray, radius: float, target: FloatArray) -> EntryRegion:
    """Return squares of about 1 mm on a disc around a point, perpendicular to the line to it."""
    axes = guide_axes(target - point)
    count = int(np.ceil(radius / _SQUARE))
    size = radius / (count + 0.5) if count else 0.0
    x, z = (one.ravel() for one in np.meshgrid(*[np.arange(-count, count + 1) * size] * 2))
    inside = x**2 + z**2 <= radius**2
    centers = point + np.outer(x[inside], axes[0]) + np.outer(z[inside], axes[2])
    halves = 0.5 * size * np.stack([axes[0], np.zeros(3), axes[2]])
    return EntryRegion(centers, halves, ImageFrame(np.ones(3), axes.T, point))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lines:
    """Result of the search: the lines that were examined, and the bound on all others."""

    #: entry points that are near enough, the best one first, else by clearance [m], shape (m, 3)
    entries: FloatArray
    clearances: FloatArray  #: least clearance of their lines with the gain [m], shape (m,)
    #: No needle from the region has a larger clearance if the gain bounds its deflection [m].
    bound: float
    nearest: FloatArray  #: entry point with the largest bound of all discarded cells [m], (3,)


class _Groups(NamedTuple):
    """Boxes in common cells of a grid."""

    points: IntArray  #: for each cell the box next to its mean, shape (m,)
    radii: FloatArray  #: largest distance of a point of the cell from the center of this box, (m,)


def _grouped(centers: FloatArray, radius: float, size: float) -> tuple[_Groups, IntArray]:
    """Return the cells of a size with boxes of a radius, and the cell of each box, shape (n,)."""
    _, cell = np.unique(np.floor(centers / size).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, one) for one in centers.T], axis=1) / count[:, np.newaxis]
    order = np.lexsort((np.linalg.norm(centers - mean[cell], axis=1), cell))
    points = order[np.cumsum(count) - count]
    away = np.linalg.norm(centers - centers[points[cell]], axis=1)
    radii = np.zeros(len(count))
    np.maximum.at(radii, cell, away)
    return _Groups(points, radii + radius), cell


class _Cells(NamedTuple):
    """Cells with an entry point each."""

    points: FloatArray  #: entry point in the cell, shape (m, 3)
    radii: FloatArray  #: largest distance of a point of the cell from it, shape (m,)


def search_lines(
    clearance: Clearance,
    region: EntryRegion,
    target: FloatArray,
    reach: float,
    resolution: float,
    *,
    bow: FloatArray = NO_BOW,
    progress: Callable[[str], object] | None = None,
) -> Lines:
    """
    Find the line with the largest clearance; of lines with equal clearance, the shortest.

    Parameters
    ----------
    clearance : Clearance
        Clearance in the region of all lines.
    region : EntryRegion
        Entry points.
    target : ndarray, shape (3,)
        End of all lines [m].
    reach : float
        Largest length of a line [m].
    resolution : float
        Resolution h of the clearance and of the length of a line [m].
    bow : ndarray, shape (p,)
        Gain at equal fractions of a line, from entry to target [m].
    progress : callable, optional
        Called with a description of each part of the search.

    Returns
    -------
    Lines
        If the largest clearance of a straight line is c, the first line has at least c - h; if the
        search finds no line with a positive clearance, c is at most h.

    """
    checked('resolution', resolution, 'm', low=0.0, open_low=True)
    search = _Search(clearance, target, reach, resolution, bow)
    centers, radius, size = region.centers, region.radius, _FIRST
    #: Upper bounds on the clearance of lines from each box, and numbers of the boxes that remain.
    bounds, boxes = np.full(len(centers), np.inf), np.arange(len(centers))
    while len(centers):
        cells, cell = _grouped(region.frame.of_patient(centers), radius, size)
        if progress is not None:
            progress(f'entry points {1e3 * size:.3g} mm apart')
        kept, upper = search.examine(_Cells(centers[cells.points], cells.radii))
        single = len(kept) == len(centers)
        bounds[boxes] = upper[cell]
        centers, boxes = centers[kept[cell]], boxes[kept[cell]]
        if single:
            break
        size *= 0.5
    # Each remaining cell is a box: divide it along its longest edge.
    halves = region.halves
    while len(centers) and np.linalg.norm(halves) > _least(resolution):
        longest = int(np.linalg.norm(halves, axis=1).argmax())
        halves = halves.copy()
        halves[longest] *= 0.5
        centers = np.concatenate([centers - halves[longest], centers + halves[longest]])
        radius = float(np.linalg.norm(halves))
        if progress is not None:
            progress(f'entry points {2e3 * radius:.2g} mm apart')
        kept, _ = search.examine(_Cells(centers, np.full(len(centers), radius)))
        centers = centers[kept]
    return search.result(region.centers, bounds)


def _least(resolution: float) -> float:
    """Return the radius of a cell that is not divided: its bound is within the resolution."""
    return (1.0 - 2.0 * _PART) * resolution


class _Search:
    """The best line so far, and all lines that were examined."""

    def __init__(
        self,
        clearance: Clearance,
        target: FloatArray,
        reach: float,
        resolution: float,
        bow: FloatArray,
    ) -> None:
        self._clearance, self._target, self._reach = clearance, target, reach
        self._resolution, self._bow = resolution, bow
        #: Accuracy of the clearance of a line, and difference of equal ones [m]. With a bow, lines
        #: are candidates whose clearance is computed later.
        self._tolerance = _PART * resolution
        self._equal = 0.0 if bow.any() else self._tolerance
        self._best = -np.inf
        self._found: list[tuple[FloatArray, FloatArray]] = []
        self._discarded = -np.inf
        self._nearest = target

    @property
    def _enough(self) -> float:
        """Bound of a cell that needs no further division [m]."""
        return max(self._best - self._equal, 0.0) + self._resolution

    def examine(self, cells: _Cells) -> tuple[BoolArray, FloatArray]:
        """Evaluate the lines of cells; return whether to divide each, and its bound, (m,)."""
        lengths = np.linalg.norm(cells.points - self._target, axis=1)
        possible = lengths - cells.radii <= self._reach
        enough = self._enough
        found = self._evaluate(cells, enough)
        usable = (lengths <= self._reach) & (lengths > _NEAR) & np.isfinite(found.least)
        if usable.any():
            # The true least clearance is within the tolerance of the value at examined points.
            least = found.least[usable] - self._tolerance
            self._found.append((cells.points[usable], least))
            self._best = max(self._best, float(least.max()))
        to_divide = possible & (found.upper > self._enough)
        done = np.flatnonzero(possible & ~to_divide)
        if len(done):
            first = done[found.upper[done].argmax()]
            if found.upper[first] > self._discarded:
                self._discarded, self._nearest = float(found.upper[first]), cells.points[first]
        return np.asarray(to_divide), found.upper

    def _evaluate(self, cells: _Cells, enough: float) -> LineClearance:
        def part(begin: int) -> LineClearance:
            some = slice(begin, begin + _CHUNK)
            return self._clearance.lines(
                cells.points[some],
                self._target,
                radii=np.ascontiguousarray(cells.radii[some]),
                bow=self._bow,
                tolerance=self._tolerance,
                enough=enough,
            )

        with ThreadPoolExecutor(thread_count(None, len(cells.points))) as pool:
            parts = list(pool.map(part, range(0, len(cells.points), _CHUNK)))
        return LineClearance(*(np.concatenate(one) for one in zip(*parts, strict=True)))

    def _shortest(
        self, entry: FloatArray, centers: FloatArray, bounds: FloatArray
    ) -> tuple[FloatArray, float]:
        """Return the shortest line that is as clear as the best, of `entry`: (3,), clearance."""
        # The difference is within the bound of the search.
        if not 0.0 < self._equal < self._best:
            return entry, self._best
        near = centers[bounds > self._best]
        points = np.concatenate([near, *(one for one, _ in self._found)])
        lengths = np.linalg.norm(points - self._target, axis=1)
        shorter = (lengths < np.linalg.norm(entry - self._target)) & (lengths > _NEAR)
        points = points[shorter][np.argsort(lengths[shorter], kind='stable')]
        for begin in range(0, len(points), _JOBS * _CHUNK):
            some = points[begin : begin + _JOBS * _CHUNK]
            found = self._evaluate(_Cells(some, np.zeros(len(some))), self._best)
            if len(equal := np.flatnonzero(found.least > self._best)):
                return some[equal[0]], float(found.least[equal[0]]) - self._equal
        return entry, self._best

    def result(self, centers: FloatArray, bounds: FloatArray) -> Lines:
        """Return the lines; `bounds` are those of lines from boxes with some centers, (n, 3)."""
        entries = np.concatenate([np.empty((0, 3)), *(one for one, _ in self._found)])
        values = np.concatenate([np.empty(0), *(one for _, one in self._found)])
        order = np.argsort(-values, kind='stable')
        entries, values = entries[order], values[order]
        if len(entries):
            first, value = self._shortest(entries[0], centers, bounds)
            entries, values = np.vstack([first, entries]), np.append(value, values)
        bound = max(self._discarded, self._best)
        return Lines(entries=entries, clearances=values, bound=bound, nearest=self._nearest)
