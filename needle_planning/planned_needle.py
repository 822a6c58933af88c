# SPDX-License-Identifier: Apache-2.0
"""Shape of the needle of a plan, from its simulated insertion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from needle_controller.steering.insertion_plan import in_layers, Plan
from needle_dynamics.arrays import FloatArray
from needle_dynamics.needles import find_needle
from needle_dynamics.steering.needle import inserted_shape, SteeredNeedle
from needle_planning.paths import Line
from needle_ros.errors import ParameterError
import numpy as np

_POINTS: Final = 5e-4  #: Distance of the points of the shaft [m].
_SAME: Final = 2e-4  #: Largest distance of the tip from the plan, which states it to 50 um [m].


def shafts(plan: Plan, outside: float = 0.0) -> Iterator[FloatArray]:
    """
    Insert the needle of a plan, without uncertainty.

    Parameters
    ----------
    plan : Plan
        Plan.
    outside : float
        Length before the entry point that is included, at most the free length of the needle [m].

    Yields
    ------
    ndarray, shape (k, 3)
        Points of the shaft to the tip in patient coordinates [m], 0.5 mm apart, after each motion
        of the guide and after each insertion.

    Raises
    ------
    ParameterError
        The needle is unknown, or at the end not at the tip of the plan.

    """
    preset = find_needle(plan.needle)
    needle, steering, _ = in_layers(plan.layers, preset.needle, preset.steering)
    one = SteeredNeedle(needle, replace(steering, path_noise=0.0), roll=plan.roll)
    line, start = Line(plan.entry, plan.axes), -min(outside, steering.free_length)

    def points() -> FloatArray:
        count = max(2, round((one.depth - start) / _POINTS) + 1)
        depths = np.linspace(start, one.depth, count)
        return line.points(depths, inserted_shape(one, depths)[0])

    for guide, depth in zip(plan.guide.tolist(), plan.depths[1:].tolist(), strict=True):
        one.move(guide=guide)
        yield points()
        one.move(depth=depth)
        yield points()
    off = float(np.linalg.norm(points()[-1] - plan.path[-1]))
    if not off < _SAME:
        raise ParameterError(
            f'the needle {plan.needle} is not the one of the plan: its tip ends {1e3 * off:.2f} '
            'mm from the path'
        )


def complete_needle(plan: Plan, outside: float = 0.0) -> FloatArray:
    """Return the shaft of `shafts` at the end of the insertion, shape (k, 3) [m]."""
    *_, last = shafts(plan, outside)
    return last
