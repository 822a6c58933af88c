# SPDX-License-Identifier: Apache-2.0
"""Similarity of a force and a motion to friction, and their signs."""

from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
import numpy as np

_MOVING: Final = 0.05  # smallest speed in motion, as a fraction of the largest speed
_TRIED: Final = 20_000  # largest number of samples on which a pair of force and motion is fitted
_SPAN: Final = 0.01  # time before and after a sample for its speed, against noise and counts [s]
_LEAST: Final = 0.01  # smallest part of a recording that counts as a direction or a rest


class Likeness(NamedTuple):
    """Similarity of a pair of force and motion to friction."""

    explained: float = 0.0  # fraction of the force by Coulomb and viscous friction
    sense: float = 0.0  # 1.0 along the motion, -1.0 against it, 0.0 without reversal and rest


def likeness(time: FloatArray, velocity: FloatArray, force: FloatArray) -> Likeness:
    """Compare a force with a velocity at the same times [s], (n,) each."""
    every = max(1, len(time) // _TRIED)
    velocity, force = velocity[::every], force[::every]
    speed = np.abs(velocity)
    moving = speed > _MOVING * np.quantile(speed, 0.99)
    if np.count_nonzero(moving) < 10:
        return Likeness()
    signs = np.where(moving, np.sign(velocity), 0.0)
    x = np.column_stack([signs, velocity, np.ones_like(velocity)])[moving]
    y = force[moving]
    variance = float(np.var(y))
    if not variance:
        return Likeness()
    solution = np.linalg.lstsq(x, y, rcond=None)[0]
    # With motion in one direction, friction and an offset are not distinguishable.
    along, left = float(np.var(x[:, :2] @ solution[:2])), float(np.var(y - x @ solution))
    return Likeness(max(0.0, min(along, variance - left) / variance), _sense(signs, force))


def velocity_of(time: FloatArray, position: FloatArray) -> FloatArray:
    """Return the velocity from positions, (n,)."""
    reach = max(1, round(_SPAN / float(np.median(np.diff(time)))))
    at = np.arange(len(time))
    before, after = np.maximum(at - reach, 0), np.minimum(at + reach, len(time) - 1)
    return np.asarray((position[after] - position[before]) / (time[after] - time[before]))


def _sense(signs: FloatArray, force: FloatArray) -> float:
    # Between two directions, else between motion and rest: the force without its mean, which is
    # the zero of the sensor.
    for used in (signs != 0.0, np.full(len(signs), True)):
        common = np.sort([np.mean(signs[used] == kind) for kind in (-1.0, 0.0, 1.0)])
        if common[1] > _LEAST:
            return float(np.sign(signs[used] @ (force[used] - force[used].mean())))
    return 0.0
