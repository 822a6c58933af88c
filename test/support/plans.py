# SPDX-License-Identifier: Apache-2.0
"""Plan of a bowed needle, without an image."""

from __future__ import annotations

from needle_controller.steering.insertion_plan import DIRECTIONS, guide_axes, Plan
from needle_dynamics import FloatArray, NEEDLES, SteeredNeedle
import numpy as np

NEEDLE, STEERING, _ = NEEDLES['bending_35mm']
SPACE = 5e-3  #: Free distance of the needle, which the guide moves more than the tip [m].
_PLACE = 2e-3  #: Distance of the places of free space [m].
CLEARANCE = 1.5e-3  #: Radius of the free tube around the path [m].


def bowed_plan(length: float = 0.06, steps: int = 12, bow: float = 3e-3) -> Plan:
    """Return a plan in a tube around a path bowed in x, with guide positions up to a bow [m]."""
    depths = np.linspace(0.0, length, steps + 1)
    guide = np.zeros((steps, 2))
    guide[1:, 0] = bow * np.sin(np.linspace(0.3, 4.0, steps - 1))
    ramp = np.zeros((steps, 2))
    ramp[:, 0] = np.linspace(0.0, bow, steps)
    # The tip is linear in the guide, and ends on the line to the target.
    guide -= _tips(depths, guide)[-1, 0] / _tips(depths, ramp)[-1, 0] * ramp
    guide *= bow / np.abs(guide).max()
    tips = _tips(depths, guide)
    entry, direction = np.array([0.1, 0.02, 0.03]), np.array([-1.0, 0.0, 0.0])
    path = entry + tips @ guide_axes(direction)
    return Plan(
        needle='bending_35mm', radius=6e-4, entry=entry, direction=direction, target=path[-1],
        roll=0.0, depths=depths, guide=guide, path=path, clearances=np.full(steps + 1, CLEARANCE),
        clearance=CLEARANCE, structure='tube', place=path[steps // 2],
        bow=float(np.abs(tips[:, 0]).max()), resolution=5e-4, straight_bound=0.0,
        bound=CLEARANCE, free=tube(length, SPACE),
    )  # fmt: skip


def _tips(depths: FloatArray, guide: FloatArray) -> FloatArray:
    """Return the tip of the needle at each depth [m], shape (steps + 1, 3)."""
    needle = SteeredNeedle(NEEDLE, STEERING)
    tips = [needle.tip]
    for depth, setpoint in zip(depths[1:].tolist(), guide, strict=True):
        needle.move(guide=setpoint.tolist())
        needle.move(depth=depth)
        tips.append(needle.tip)
    return np.array(tips)


def tube(length: float, radius: float) -> FloatArray:
    """Return the free space of a tube with a radius around a path [m], shape (places, 17)."""
    places = np.arange(0.5 * _PLACE, length, _PLACE)
    # The edges of the polygon touch the tube.
    around = np.full((len(places), DIRECTIONS), radius / np.cos(np.pi / DIRECTIONS))
    return np.column_stack([places, around])
