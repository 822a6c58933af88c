# SPDX-License-Identifier: Apache-2.0
"""Check the actions of an environment."""

from typing import Any

from needle_dynamics import FloatArray
from needle_dynamics.simulated.trajectory import floats
from needle_ros.errors import ParameterError, ShapeError
import numpy as np


def checked_actions(actions: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return actions as floats clipped to [-1, 1]; they must be finite and have the shape."""
    found = floats('actions', actions)
    if found.shape != shape:
        raise ShapeError(f'actions must have shape {shape}, got {found.shape}')
    wrong = found[~np.isfinite(found)]
    if len(wrong):
        raise ParameterError(f'actions must be finite, got {wrong[0]}')
    return np.clip(found, -1.0, 1.0)
