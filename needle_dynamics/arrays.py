"""The array types of all packages."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

#: NumPy array of doubles.
FloatArray: TypeAlias = NDArray[np.float64]

#: NumPy array of complex numbers.
ComplexArray: TypeAlias = NDArray[np.complex128]

#: NumPy array of truth values.
BoolArray: TypeAlias = NDArray[np.bool_]

#: NumPy array of integers.
IntArray: TypeAlias = NDArray[np.int64]
