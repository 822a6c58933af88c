# SPDX-License-Identifier: Apache-2.0
"""Continuous closed loop as the right-hand side of an ODE."""

from __future__ import annotations

from collections.abc import Callable

from needle_controller.laws.continuous import acceleration, ContinuousLaw
from needle_dynamics import FloatArray, NeedleModel
import numpy as np
from numpy.typing import ArrayLike


def closed_loop(
    law: ContinuousLaw, plant: NeedleModel, goal: ArrayLike | Callable[[float], ArrayLike]
) -> Callable[[float, ArrayLike], FloatArray]:
    """Return f(time, y) with y = [X, integral of the errors] for a law and a needle."""
    m = plant.coordinates

    def derivative(time: float, y: ArrayLike) -> FloatArray:
        whole = np.asarray(y, dtype=float)
        x, integral = whole[: 2 * m], whole[2 * m :]
        now = goal(time) if callable(goal) else goal
        forces = law.forces(x, now, integral, time)
        errors = law.errors(x, now)[0][: law.integrals]
        return np.concatenate([x[m:], acceleration(plant, x, forces, time), errors])

    return derivative
