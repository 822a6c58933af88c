# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of the true axis about the nominal one, and limit cycles of dry friction."""

from dataclasses import dataclass, replace
from itertools import product
from math import ceil, log
from typing import Final

from needle_controller.compiled.laws import INVERSE_DYNAMICS
from needle_controller.compiled.loop import ring
from needle_controller.laws.axis import Axis
from needle_controller.laws.law import Law
from needle_ros.settings import CheckedSettings, constant
import numpy as np

_PARTS: Final = (1.0 / 64.0, 1.0 / 16.0, 1.0 / 4.0, 1.0)  #: Checked fractions of the carriage.
_STARTS: Final = (1e-3, 5e-5)  #: Initial positions of simulated limit cycles [m] or [rad].
_SHORTEST: Final = 0.5  #: Shortest duration of such a simulation [s].
_LONGEST: Final = 20.0  #: Longest duration [s].
_DECREASE: Final = 0.1  #: Decrease of errors in each third of it.
_LEAST: Final = 1e-6  #: Least range of motion that is a limit cycle [m] or [rad].


@dataclass(frozen=True, slots=True, kw_only=True)
class Uncertainty(CheckedSettings):
    """Largest deviation of the true axis from the modeled one, for the check of stability."""

    viscous: float = constant(0.3, '1', 'relative uncertainty of viscous friction', high=0.9)
    coulomb: float = constant(0.3, '1', 'relative uncertainty of Coulomb friction', high=0.9)
    inertia: float = constant(0.3, '1', 'relative uncertainty of the moving mass', high=0.9)
    carriage: float = constant(
        2.0, 'kg', 'mass that may move with the needle in addition to model.carriage_mass'
    )

    def axes(self, axis: Axis, *, carriage: bool = False) -> list[Axis]:
        """Return the axes at the uncertainty bounds, with ``carriage`` also with its mass."""
        extra = [part * self.carriage for part in _PARTS if carriage and self.carriage > 0.0]
        inertias = [*_bounds(axis.inertia, self.inertia)]
        inertias += [max(inertias) + mass for mass in extra]
        return [
            replace(axis, coulomb=coulomb, viscous=viscous, inertia=inertia)
            for coulomb, viscous, inertia in product(
                _bounds(axis.coulomb, self.coulomb), _bounds(axis.viscous, self.viscous), inertias
            )
        ]


def _bounds(value: float, share: float) -> list[float]:
    """Return a value and its bounds, without repetition; the value first."""
    return list(dict.fromkeys((value, value * (1.0 - share), value * (1.0 + share))))


def limit_cycle(law: Law, delay: int, unmodeled: int, plant: Axis, radius: float) -> float:
    """
    Simulate a law on another axis; return the amplitude of a limit cycle [m] or [rad], or 0.

    A limit cycle is possible if the law has an integral, or compensates friction in the direction
    of the measured velocity, as inverse dynamics without feedback does. Other laws are not
    simulated. ``radius`` is the spectral radius of the loop, below 1.
    """
    c = law.constants
    measured = c.kind == INVERSE_DYNAMICS and c.kp == 0.0
    if law.axis.coulomb == 0.0 or not (c.ki > 0.0 or measured):
        return 0.0
    periods = log(_DECREASE) / log(max(radius, 1e-3))
    count = ceil(min(max(periods, _SHORTEST / c.period), _LONGEST / c.period))
    amplitudes = [0.0]
    for start in _STARTS:
        pending = np.zeros(delay + unmodeled)
        before, after, turns = ring(
            law.packed, plant.constants, plant.inertia, delay, pending, start, count
        )
        if turns > 1 and after > max(0.5 * before, _LEAST):
            amplitudes.append(0.5 * after)
    return max(amplitudes)
