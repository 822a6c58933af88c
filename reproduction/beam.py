# SPDX-License-Identifier: Apache-2.0
"""Finite element beam of the whole needle, to test the model assumption about the outer part."""

from typing import Final, NamedTuple

from needle_dynamics import FloatArray, NeedleParameters
import numpy as np
from scipy.linalg import eigh

#: Support of the needle at its entry into the tissue, and the fixed coordinates of that point.
ENTRIES: Final = {'free': (), 'pinned': (0,), 'clamped': (0, 1)}

#: Number of elements outside and inside: frequency and compliance converge to six digits.
_ELEMENTS: Final = 24

#: Matrices of a cubic element of unit length, bending stiffness and mass; coordinates are value
#: and slope at both ends.
_BENDING: Final = np.array([
    [12.0, 6.0, -12.0, 6.0], [6.0, 4.0, -6.0, 2.0],
    [-12.0, -6.0, 12.0, -6.0], [6.0, 2.0, -6.0, 4.0],
])  # fmt: skip
_GRAM: Final = np.array([
    [156.0, 22.0, 54.0, -13.0], [22.0, 4.0, 13.0, -3.0],
    [54.0, 13.0, 156.0, -22.0], [-13.0, -3.0, -22.0, 4.0],
]) / 420.0  # fmt: skip


class WholeNeedle(NamedTuple):
    """Response of a beam that is clamped at its base."""

    frequency: float  #: First natural frequency [Hz].
    compliance: float  #: Deflection of the tip per lateral force at the tip [m/N].
    force: float  #: Magnitude of the lateral force at the base for 1 N at the tip [N].


def whole_needle(parameters: NeedleParameters, depth: float, entry: str) -> WholeNeedle:
    """Solve the needle on an elastic foundation from a depth [m]; ``entry`` is of `ENTRIES`."""
    p, n = parameters, _ELEMENTS
    lengths = np.repeat([(p.length - depth) / n, depth / n], n)
    stiffness, mass = np.zeros((2, 4 * n + 2, 4 * n + 2))
    for k, h in enumerate(lengths):
        part = slice(2 * k, 2 * k + 4)
        # Slopes are scaled by the length of the element.
        scale = np.array([1.0, h, 1.0, h])
        gram = _GRAM * np.outer(scale, scale) * h
        stiffness[part, part] += p.bending_stiffness / h**3 * _BENDING * np.outer(scale, scale)
        stiffness[part, part] += p.tissue_stiffness * gram if k >= n else 0.0
        mass[part, part] += p.linear_density * gram
    held = [0, 1, *(2 * n + coordinate for coordinate in ENTRIES[entry])]
    moving = np.setdiff1d(np.arange(4 * n + 2), held)
    inner = np.ix_(moving, moving)
    least = eigh(stiffness[inner], mass[inner], eigvals_only=True, subset_by_index=(0, 0))
    load = np.zeros(4 * n + 2)
    load[-2] = 1.0
    shape: FloatArray = np.zeros(4 * n + 2)
    shape[moving] = np.linalg.solve(stiffness[inner], load[moving])
    force = float(abs(stiffness[0] @ shape))
    return WholeNeedle(float(np.sqrt(least[0])) / (2.0 * np.pi), float(shape[-2]), force)
