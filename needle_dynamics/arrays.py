# SPDX-License-Identifier: Apache-2.0
"""Array types shared by all packages."""

from typing import Annotated, NamedTuple, TypeAlias

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
IntMatrix: TypeAlias = Annotated[IntArray, Shaped(np.int64, 2)]
BoolVector: TypeAlias = Annotated[BoolArray, Shaped(np.bool_, 1)]
