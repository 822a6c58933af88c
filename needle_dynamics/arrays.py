# SPDX-License-Identifier: Apache-2.0
"""Array types shared by all packages, and checked arrays."""

from collections.abc import Sequence
from reprlib import repr as shortened
from typing import Annotated, Final, NamedTuple, TypeAlias

from needle_ros.errors import ParameterError, ShapeError
import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]  #: NumPy array of doubles
ComplexArray: TypeAlias = NDArray[np.complex128]  #: NumPy array of complex numbers
BoolArray: TypeAlias = NDArray[np.bool_]  #: NumPy array of Booleans
IntArray: TypeAlias = NDArray[np.int64]  #: NumPy array of integers


class Shaped(NamedTuple):
    """Layout of an array argument of a compiled function: contiguous, in C order."""

    dtype: type
    dimensions: int
    writable: bool = True


#: Arrays with a fixed number of dimensions, for the signatures of compiled functions.
Vector: TypeAlias = Annotated[FloatArray, Shaped(np.float64, 1)]
Matrix: TypeAlias = Annotated[FloatArray, Shaped(np.float64, 2)]
Array3: TypeAlias = Annotated[FloatArray, Shaped(np.float64, 3)]
Array4: TypeAlias = Annotated[FloatArray, Shaped(np.float64, 4)]
FixedVector: TypeAlias = Annotated[FloatArray, Shaped(np.float64, 1, writable=False)]
FixedMatrix: TypeAlias = Annotated[FloatArray, Shaped(np.float64, 2, writable=False)]
ComplexVector: TypeAlias = Annotated[ComplexArray, Shaped(np.complex128, 1)]
ComplexMatrix: TypeAlias = Annotated[ComplexArray, Shaped(np.complex128, 2)]
ComplexArray3: TypeAlias = Annotated[ComplexArray, Shaped(np.complex128, 3)]
IntVector: TypeAlias = Annotated[IntArray, Shaped(np.int64, 1)]
BoolVector: TypeAlias = Annotated[BoolArray, Shaped(np.bool_, 1)]


_NO_NUMBERS: Final = 'cSUmM'  #: Kinds of arrays of complex numbers, text, dates and durations.


def floats(name: str, values: object, shape: Sequence[int | None] | None = None) -> FloatArray:
    """
    Return a copy of finite numbers as an array, of a shape if it is given; None is any length.

    Raises ShapeError for another shape, text and complex numbers, and ParameterError for infinity
    and nan.
    """
    try:
        given = np.asarray(values)
        if given.dtype.kind in _NO_NUMBERS:
            raise TypeError
        found = given.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        what = f'an array of {values.dtype}' if isinstance(values, np.ndarray) else None
        raise ShapeError(f'{name} must be real numbers, got {what or shortened(values)}') from None
    if shape is not None and not _fits(found.shape, shape):
        lengths = ', '.join('n' if length is None else str(length) for length in shape)
        lengths += ',' * (len(shape) == 1)
        raise ShapeError(f'{name} must have shape ({lengths}), got {found.shape}')
    if not np.isfinite(found).all():
        raise ParameterError(f'{name} must be finite, got {found[~np.isfinite(found)][0]}')
    return found


def _fits(found: Sequence[int], shape: Sequence[int | None]) -> bool:
    return len(found) == len(shape) and all(
        wanted in (None, length) for length, wanted in zip(found, shape, strict=True)
    )
