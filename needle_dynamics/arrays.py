"""The array type of all packages."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

#: NumPy array of doubles.
FloatArray: TypeAlias = NDArray[np.float64]
