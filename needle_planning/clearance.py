# SPDX-License-Identifier: Apache-2.0
r"""
Clearance: distance from a needle to the obstacles of an anatomy, less their margins.

An obstacle is the union of its voxels, and a voxel is a closed box about its center. The clearance
of a point is

.. math:: c(p) = \min(\min_o (d_o(p) - m_o) - r, c_{max})

with the exact distance :math:`d_o` to the boxes of obstacle o, its margin :math:`m_o` and the
radius r of the needle. It is 1-Lipschitz. Inside a box the distance is zero, so that the clearance
is negative. Clearances above :math:`c_{max}` are not distinguished: only the boxes around the
region of a plan are kept. Outside the image there are no obstacles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil, log2
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray, IntArray
from needle_planning.anatomy import Anatomy, Structure
from needle_planning.compiled.boxes import BoxTree, LEAF, line_clearances, point_clearances
import numpy as np
from numpy.typing import ArrayLike, NDArray

LIMIT: Final = 0.03  #: Largest clearance that is distinguished [m].
_BITS: Final = 10  #: Bits of each coordinate of the order of the boxes.

#: No gain by a bow, see `line_clearances`.
NO_BOW: Final = np.zeros(1)


class LineClearance(NamedTuple):
    """Least clearance of straight lines."""

    least: FloatArray  #: least clearance with the gain, -inf for a line that ended early [m], (m,)
    #: Upper bound for all needles within the radius, deflected by the gain at most [m], (m,).
    upper: FloatArray
    places: FloatArray  #: fraction of the line at the least clearance, (m,)


class ImageFrame(NamedTuple):
    """
    Orthonormal frame along the axes of an image, with its origin at the center of voxel 0, 0, 0.

    It is left-handed if the axes of the image are.
    """

    spacing: FloatArray  #: distance of the voxels along the axes [m], shape (3,)
    axes: FloatArray  #: directions of the axes in patient coordinates, columns, shape (3, 3)
    origin: FloatArray  #: center of voxel 0, 0, 0 in patient coordinates [m], shape (3,)

    def of_patient(self, points: FloatArray) -> FloatArray:
        """Convert patient coordinates [m], shape (..., 3), to this frame."""
        return np.asarray((points - self.origin) @ self.axes)

    def to_patient(self, points: FloatArray) -> FloatArray:
        """Convert points of this frame [m], shape (..., 3), to patient coordinates."""
        return np.asarray(points @ self.axes.T + self.origin)


def image_frame(anatomy: Anatomy) -> ImageFrame:
    """Return the frame of an image, whose axes are perpendicular to each other."""
    affine = np.asarray(anatomy.to_patient, dtype=np.float64)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    # The nearest orthonormal matrix.
    left, _, right = np.linalg.svd(affine[:3, :3] / spacing)
    return ImageFrame(spacing, left @ right, affine[:3, 3])


def obstacles_of(anatomy: Anatomy) -> list[tuple[int, Structure]]:
    """Return label and structure of each obstacle, by label."""
    found = sorted(anatomy.structures.items())
    return [(label, one) for label, one in found if one.role == 'obstacle']


class Clearance:
    """
    Clearance of points and lines in a region of an anatomy, exact to rounding.

    Parameters
    ----------
    anatomies : sequence of Anatomy
        Images with obstacles, in the same patient coordinates; the least clearance counts.
    region : array_like, shape (k, 3)
        Points in patient coordinates; the clearance is exact in their bounding box along the axes
        of the image, and a lower bound outside.
    radius : float
        Radius of the needle [m].
    beyond : float
        Additional size of the region on each side [m].

    """

    def __init__(
        self,
        anatomies: Sequence[Anatomy],
        region: ArrayLike,
        *,
        radius: float = 0.0,
        beyond: float = 0.0,
    ) -> None:
        points = np.atleast_2d(np.asarray(region, dtype=np.float64))
        self._grids = [_Grid(one, points, radius, beyond) for one in anatomies]

    @property
    def unused(self) -> list[int]:
        """Numbers of the images without a voxel in the region or near it."""
        return [number for number, one in enumerate(self._grids) if one.is_empty]

    def at(self, points: ArrayLike) -> FloatArray:
        """Return the clearance of points in patient coordinates, shape (k, 3) [m]; shape (k,)."""
        given = np.asarray(points, dtype=np.float64)
        return np.min([one.points(given)[0] for one in self._grids], axis=0)  # type: ignore[no-any-return]

    def gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the clearance (k,) [m] of points (k, 3), and its gradient, shape (k, 3)."""
        values, gradients = self._grids[0].gradient(points)
        for one in self._grids[1:]:
            other, theirs = one.gradient(points)
            gradients = np.where((other < values)[:, np.newaxis], theirs, gradients)
            values = np.minimum(values, other)
        return values, gradients

    def structure_at(self, point: ArrayLike) -> str:
        """Return the name of the structure that limits the clearance of a point, '' beyond."""
        given = np.atleast_2d(np.asarray(point, dtype=np.float64))
        found = [one.nearest(given) for one in self._grids]
        return min(found, key=lambda one: one[0])[1]

    def lines(
        self,
        entries: ArrayLike,
        target: ArrayLike,
        *,
        radii: FloatArray | None = None,
        bow: FloatArray = NO_BOW,
        tolerance: float = 1e-6,
        enough: float = -np.inf,
    ) -> LineClearance:
        """
        Return the least clearance of lines from entry points to a target.

        Parameters
        ----------
        entries, target : array_like, shape (m, 3) and (3,)
            Ends of the lines in patient coordinates [m].
        radii : ndarray, shape (m,), optional
            Distance of further entry points, to which the upper bound applies [m].
        bow : ndarray, shape (p,)
            Gain at equal fractions of each line, from entry to target [m].
        tolerance : float
            The true least clearance is at most this smaller [m].
        enough : float
            A line ends early when its upper bound is at most this [m].

        Returns
        -------
        LineClearance
            Least clearance, upper bound and place.

        """
        starts = np.atleast_2d(np.asarray(entries, dtype=np.float64))
        end = np.asarray(target, dtype=np.float64)
        sizes = np.zeros(len(starts)) if radii is None else np.ascontiguousarray(radii)
        every = np.stack(
            [one.lines(starts, end, sizes, bow, tolerance, enough) for one in self._grids]
        )
        first = every[:, :, 0].argmin(axis=0), np.arange(len(starts))
        return LineClearance(every[first][:, 0], every[:, :, 1].min(axis=0), every[first][:, 2])


class _Grid:
    """Clearance to the obstacles of one image."""

    def __init__(self, anatomy: Anatomy, region: FloatArray, radius: float, beyond: float) -> None:
        # Imported here: it imports Numba.
        from needle_dynamics.compiled.boxed import Boxed

        self.frame = frame = image_frame(anatomy)
        self._obstacles = obstacles_of(anatomy)
        margins = np.array([one.margin + radius for _, one in self._obstacles])
        points = frame.of_patient(region)
        self._low, self._high = points.min(axis=0) - beyond, points.max(axis=0) + beyond
        away = LIMIT + margins.max(initial=0.0)
        shape = np.array(anatomy.labels.shape)
        low = np.ceil((self._low - away) / frame.spacing - 0.5).clip(0, shape).astype(int)
        high = np.floor((self._high + away) / frame.spacing + 1.5).clip(low, shape).astype(int)
        part = anatomy.labels[tuple(map(slice, low, high))]
        self.is_empty = not part.size
        labels = [label for label, _ in self._obstacles]
        first, last, kinds = _boxes(part, labels)
        region = np.stack([low - 0.5, low + part.shape - 0.5]) * frame.spacing

        def tree(first: IntArray, last: IntArray, margins: FloatArray) -> tuple[BoxTree, IntArray]:
            ends = (first + low - 0.5) * frame.spacing, (last + low + 0.5) * frame.spacing
            return _tree(*ends, margins, region)

        self._tree, order = tree(first, last, margins[kinds])
        self._kinds = np.append(kinds, -1)[order]
        first, last, kinds = _boxes(part, labels, others=True)
        gaps, _ = tree(first, last, np.zeros(len(kinds)))
        self._boxed, self._gaps = Boxed(self._tree), Boxed(gaps)

    def points(self, points: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """Return clearance and nearest box, and points of the frame, of points (k, 3)."""
        own = np.ascontiguousarray(self.frame.of_patient(points))
        values, nearest = np.empty(len(own)), np.empty(len(own), dtype=np.int64)
        point_clearances(self._boxed, own, values, nearest)
        outside = np.maximum(np.maximum(self._low - own, own - self._high), 0.0)
        bound = LIMIT - np.linalg.norm(outside, axis=1)
        nearest[bound < values] = -1
        return np.minimum(values, bound), nearest, own

    def gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        values, nearest, own = self.points(points)
        away = own - own.clip(self._tree.low[nearest], self._tree.high[nearest])
        away[nearest < 0] = 0.0
        size = np.linalg.norm(away, axis=1, keepdims=True)
        unit = np.divide(away, size, out=np.zeros_like(away), where=size > 0.0)
        return values, np.asarray(unit @ self.frame.axes.T)

    def nearest(self, point: FloatArray) -> tuple[float, str]:
        values, nearest, _ = self.points(point)
        kind = self._kinds[nearest[0]] if nearest[0] >= 0 else -1
        return float(values[0]), '' if kind < 0 else self._obstacles[kind][1].name

    def lines(
        self,
        entries: FloatArray,
        target: FloatArray,
        radii: FloatArray,
        bow: FloatArray,
        tolerance: float,
        enough: float,
    ) -> FloatArray:
        """Return the output of `line_clearances`, shape (m, 3)."""
        starts = np.ascontiguousarray(self.frame.of_patient(entries))
        end, found = self.frame.of_patient(target), np.empty((len(starts), 3))
        line_clearances(self._boxed, self._gaps, starts, end, radii, bow, tolerance, enough, found)
        return found


def _boxes(
    labels: NDArray[np.integer], wanted: list[int], *, others: bool = False
) -> tuple[IntArray, IntArray, IntArray]:
    """Return first and last voxel (n, 3) of boxes that cover labels, and numbers of these (n,)."""
    # Boxes are runs of voxels along the axis that is contiguous in memory.
    order = np.argsort(labels.strides, kind='stable')[::-1]
    found = [np.empty((0, 5), dtype=np.int64), *_runs(labels.transpose(order), wanted, others)]
    i, j, begin, end, kind = np.concatenate(found).T
    first, last = np.empty((2, len(i), 3), dtype=np.int64)
    first[:, order], last[:, order] = np.stack([i, j, begin], 1), np.stack([i, j, end], 1)
    return first, last, kind


def _runs(labels: NDArray[np.integer], wanted: list[int], others: bool) -> Iterator[IntArray]:
    """Yield i, j, first k, last k and number of the label of runs along k, shape (n, 5)."""
    if not labels.size:
        return
    low, high = int(labels.min()), int(labels.max())
    table = np.zeros(high - low + 1, dtype=np.uint16) if high - low < 2**16 else None
    if table is not None:
        for number, label in enumerate(wanted, 1):
            if low <= label <= high:
                table[label - low] = number
    for i, slab in enumerate(labels):
        padded = np.zeros((slab.shape[0], slab.shape[1] + 2), dtype=np.uint16)
        if table is not None:
            padded[:, 1:-1] = table[slab.astype(np.int64) - low]
        else:
            for number, label in enumerate(wanted, 1):
                padded[:, 1:-1][slab == label] = number
        if others:
            padded[:, 1:-1] = padded[:, 1:-1] == 0
        if not padded.any():
            continue
        j, change = np.nonzero(padded[:, 1:] != padded[:, :-1])
        kind = padded[j, change + 1].astype(np.int64) - 1
        # The next change ends a run; the last change of a row begins none.
        begin = np.flatnonzero(kind >= 0)
        yield np.stack(
            [
                np.full(len(begin), i), j[begin], change[begin], change[begin + 1] - 1,
                kind[begin],
            ],
            axis=1,
        )  # fmt: skip


def _tree(
    low: FloatArray, high: FloatArray, margins: FloatArray, region: FloatArray
) -> tuple[BoxTree, IntArray]:
    """Return the tree of boxes, and the number of the box in each place, -1 without one."""
    leaves = 2 ** max(0, ceil(log2(max(1.0, len(low) / LEAF))))
    order = np.full(leaves * LEAF, -1)
    order[: len(low)] = _along_a_curve(0.5 * (low + high))
    free = order < 0
    corners = np.full((2, len(order), 3), np.inf)
    margin = np.full(len(order), -np.inf)
    corners[:, ~free], margin[~free] = (
        np.stack([low, high])[:, order[~free]],
        margins[order[~free]],
    )
    bounds, most = np.full((2, 2 * leaves, 3), np.inf), np.full(2 * leaves, -np.inf)
    by_leaf = corners.reshape(2, leaves, LEAF, 3)
    bounds[0, leaves:] = by_leaf[0].min(axis=1)
    # A place without a box has no extent.
    bounds[1, leaves:] = np.where(np.isfinite(by_leaf[1]), by_leaf[1], -np.inf).max(axis=1)
    most[leaves:] = margin.reshape(leaves, LEAF).max(axis=1)
    count = leaves
    while count > 1:
        half = count // 2
        bounds[0, half:count] = bounds[0, count : 2 * count].reshape(half, 2, 3).min(axis=1)
        bounds[1, half:count] = bounds[1, count : 2 * count].reshape(half, 2, 3).max(axis=1)
        most[half:count] = most[count : 2 * count].reshape(half, 2).max(axis=1)
        count = half
    bounds[:, 0] = region
    tree = BoxTree(corners[0], corners[1], margin, bounds[0], bounds[1], most, LIMIT)
    return tree, order


def _along_a_curve(points: FloatArray) -> IntArray:
    """Return the order of points, shape (k, 3), along a curve of Morton: near points are near."""
    if not len(points):
        return np.empty(0, dtype=np.int64)
    size = np.ptp(points, axis=0).max()
    cells = ((points - points.min(axis=0)) * ((2**_BITS - 1) / (size or 1.0))).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind='stable')
