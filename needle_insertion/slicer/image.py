# SPDX-License-Identifier: Apache-2.0
"""Content of an OpenIGTLink IMAGE message: a label map in patient coordinates."""

from __future__ import annotations

import struct
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_insertion.slicer.needle import MILLIMETERS
from needle_planning.anatomy import SegmentationError
from needle_planning.voxels import (
    check_size,
    Layer,
    MOST_VOXELS,
    present,
    read_values,
    to_ras,
    turned,
    value_names,
)
import numpy as np

#: Version, components, scalar type, byte order, coordinates; voxels along i, j and k; steps to the
#: next voxel along i, j and k, and the center [mm]; first voxel and size of the transmitted part.
_HEADER: Final = struct.Struct('>HBBBB3H12f6H')

_VERSION: Final = 1

#: Largest body [bytes]: most voxels of two bytes, with metadata.
LARGEST_IMAGE: Final = 2 * MOST_VOXELS + (1 << 16)

#: Integer types by number; 10 and 11 are floats.
_TYPES: Final = {2: 'i1', 3: 'u1', 4: 'i2', 5: 'u2', 6: 'i4', 7: 'u4'}
_NAMES: Final = 'int8, uint8, int16, uint16, int32 or uint32'
_ORDERS: Final = {1: '>', 2: '<'}
_SPACES: Final = {1: 'RAS', 2: 'LPS'}


class _Content:
    """Voxels of a message, read in parts without a copy of all."""

    def __init__(self, content: memoryview) -> None:
        self._rest = content

    def read(self, size: int, /) -> memoryview:
        part, self._rest = self._rest[:size], self._rest[size:]
        return part


def read_image(content: memoryview, name: str) -> Layer:
    """
    Read a label map from the content of an IMAGE message of OpenIGTLink 1 to 3.

    Parameters
    ----------
    content : memoryview
        Content: header of the image, and voxels with the index i fastest.
    name : str
        Name of the image: of its label, or with ``:2`` of the label 2 if there are several.

    Returns
    -------
    Layer
        Values of the voxels, RAS.

    Raises
    ------
    SegmentationError
        It is not a complete label map: voxels must be whole numbers with one component.

    """
    if len(content) < _HEADER.size:
        raise SegmentationError(
            f'is truncated: it has {len(content)} of the {_HEADER.size} bytes of its header'
        )
    version, components, kind, order, space, *rest = _HEADER.unpack(content[: _HEADER.size])
    shape, steps, part = tuple(rest[:3]), np.array(rest[3:15]).reshape(4, 3), rest[15:]
    for what, given, valid in (
        ('version', version, {_VERSION: 1}),
        ('number of components', components, {1: 1}),
        ('byte order', order, _ORDERS),
        ('coordinates', space, _SPACES),
    ):
        if given not in valid:
            valid_ = ' or '.join(map(str, valid))
            raise SegmentationError(f'has the {what} {given}, a label map has {valid_}')
    if kind not in _TYPES:
        raise SegmentationError(f'has voxels of the scalar type {kind}, a label map has {_NAMES}')
    check_size(shape)
    if part != [0, 0, 0, *shape]:
        raise SegmentationError('is a part of an image: send the whole image')
    values = read_values(
        _Content(content[_HEADER.size :]), shape, np.dtype(_ORDERS[order] + _TYPES[kind]), 1.0, 0.0
    )
    if not (found := present(values)):
        raise SegmentationError('has no labeled voxel')
    matrix = to_ras(_matrix(steps, shape), _SPACES[space], 1.0 / MILLIMETERS)
    return Layer(*turned(values, matrix), value_names(name, found, alone=len(found) == 1))


@np.errstate(all='ignore')
def _matrix(steps: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return the matrix from voxels [mm]; the last row of `steps` is the center of the image."""
    matrix = np.eye(4)
    matrix[:3, :3] = steps[:3].T
    matrix[:3, 3] = steps[3] - matrix[:3, :3] @ (0.5 * (np.array(shape) - 1.0))
    return matrix
