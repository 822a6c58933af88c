# SPDX-License-Identifier: Apache-2.0
"""Read the voxels of a segmentation in bounded memory, and turn their axes to the patient's."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations
from math import prod
from typing import Any, Final, NamedTuple, Protocol, TypeAlias, TypeVar

from needle_dynamics import FloatArray
from needle_planning.anatomy import check_axes, SegmentationError
import numpy as np
from numpy.typing import NDArray

_Image = TypeVar('_Image', bound=NDArray[np.integer])
Values: TypeAlias = NDArray[np.unsignedinteger]  #: values of voxels, 0 for the background

#: Largest number of voxels of a file; all grids have twice as many. 1.4 GB are used at most.
MOST_VOXELS: Final = 2**28
LARGEST_VALUE: Final = 2**16 - 1  #: Largest value of a voxel.
_ROUNDED: Final = 1e-3  #: Largest distance of a scaled value from a whole number.

_CHUNK: Final = 2**20  #: Voxels that are converted at once.

#: Signs of the axes of RAS in a space with the same axes.
SPACES: Final[Mapping[str, tuple[float, float, float]]] = {
    'RAS': (1.0, 1.0, 1.0),
    'LPS': (-1.0, -1.0, 1.0),
    'LAS': (-1.0, 1.0, 1.0),
}


class Readable(Protocol):
    """Source of bytes: a file, or a message."""

    def read(self, size: int, /) -> bytes | memoryview:
        """Return the next bytes, fewer at the end."""
        ...


class Layer(NamedTuple):
    """Values of the voxels of a grid that do not overlap."""

    values: Values  #: shape (i, j, k), axes nearest to x, y, z of the patient
    to_patient: FloatArray  #: from voxel indices to RAS [m], shape (4, 4)
    names: Mapping[int, str]  #: by value; every value but 0
    closed: bool = False  #: of a closed surface, which does not continue outside of the grid


@np.errstate(all='ignore')
def to_ras(matrix: FloatArray, space: str, unit: float) -> FloatArray:
    """
    Convert a matrix from voxels to a space into one from voxels to RAS [m].

    Every reader converts by this function and nowhere else; `unit` is the unit of the space [m].
    """
    return np.asarray(np.diag([*(unit * np.array(SPACES[space])), 1.0]) @ matrix)


def check_size(shape: tuple[int, ...]) -> None:
    """Raise `SegmentationError` unless a number of voxels can be read."""
    sizes = ' x '.join(map(str, shape))
    if not shape or min(shape) < 1:
        raise SegmentationError(f'has {sizes or "no"} voxels')
    if prod(shape) > MOST_VOXELS:
        raise SegmentationError(
            f'has {sizes} voxels, at most {MOST_VOXELS} are read: crop or resample it'
        )


@np.errstate(all='ignore')
def read_values(
    stream: Readable,
    shape: tuple[int, ...],
    dtype: np.dtype,
    slope: float,
    intercept: float,
    *,
    padding: int = 0,
) -> Values:
    """
    Read the values of all voxels, the first index fastest; they must be whole numbers.

    Values that are scaled must be whole numbers to 0.001, and are rounded. At most `padding` zeros
    may follow them [byte].
    """
    check_size(shape)
    if dtype.kind not in 'iuf':
        raise SegmentationError(f'has voxels of type {dtype}, read are integers and floats')
    scaled = (slope, intercept) != (1.0, 0.0)
    flat, size = np.empty(prod(shape), np.uint16), dtype.itemsize
    for start in range(0, flat.size, _CHUNK):
        part = flat[start : start + _CHUNK]
        content = stream.read(part.size * size)
        if len(content) < part.size * size:
            raise SegmentationError(
                f'is truncated: it has {start * size + len(content)} of {flat.size * size} bytes'
            )
        read = np.frombuffer(content, dtype)
        if scaled:
            given = slope * read + intercept
            whole = np.rint(given)
            read = np.where(np.abs(given - whole) <= _ROUNDED, whole, given)
        # NaN is not equal to itself.
        valid = (read >= 0) & (read <= LARGEST_VALUE)
        valid &= (read == np.rint(read)) if read.dtype.kind == 'f' else True
        if not valid.all():
            raise SegmentationError(
                f'has the value {_digits(read[~valid][0])}: a segmentation has whole numbers '
                f'from 0 to {LARGEST_VALUE}'
            )
        part[:] = read
    rest = stream.read(padding + 1)
    if len(rest) > padding or any(rest):
        raise SegmentationError(f'has more than the {flat.size * size} bytes of its voxels')
    return flat.reshape(shape, order='F')


def _digits(value: Any) -> str:
    """Return a number with the digits that distinguish it from others of its type."""
    return str(value).removesuffix('.0')


def present(values: Values) -> list[int]:
    """Return the values of voxels except 0, in ascending order."""
    seen = np.zeros(LARGEST_VALUE + 1, np.bool_)
    for plane in planes(values):
        seen[plane] = True
    return [int(value) for value in np.flatnonzero(seen) if value]


def value_names(name: str, values: list[int], *, alone: bool) -> dict[int, str]:
    """Return the name of each value: of the file if it is alone there, else of both."""
    return {value: name if alone else f'{name}:{value}' for value in values}


def planes(values: Values, like: Values | None = None) -> Values:
    """Return a view of voxels with their slowest index first, or the slowest of `like`."""
    strides = (values if like is None else like).strides
    return np.moveaxis(values, int(np.argmax(np.abs(strides))), 0)


def turned(values: _Image, to_patient: FloatArray) -> tuple[_Image, FloatArray]:
    """Permute and reverse the axes of an image so that they are nearest to those of RAS."""
    check_axes(to_patient)
    axes = to_patient[:3, :3] / np.linalg.norm(to_patient[:3, :3], axis=0)
    order = max(permutations(range(3)), key=lambda one: sum(abs(axes[range(3), one])))
    matrix = to_patient[:, [*order, 3]].copy()
    values = values.transpose(order)
    for axis in np.flatnonzero(np.diag(matrix)[:3] < 0.0):
        matrix[:, 3] += (values.shape[axis] - 1) * matrix[:, axis]
        matrix[:, axis] *= -1.0
        values = np.flip(values, int(axis))
    return values, matrix
