# SPDX-License-Identifier: Apache-2.0
"""Similarity of a force and a motion to friction, and their signs."""

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
import numpy as np

EXPLAINED: Final = 0.3  #: smallest part of a force that is like friction

_ALIKE: Final = 0.02  # difference of this part below which the larger components are chosen
_IN_PROPORTION: Final = 0.95  # smallest squared correlation of components of an oblique motion
_OBLIQUE: Final = 0.1  # smallest motion of another component: the speed is 0.5 % too small
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


def most_alike(found: Sequence[tuple[Likeness, float, object]]) -> int:
    """
    Return the index of the pair that is most similar to friction, at least one pair.

    A pair has its likeness, its size, and its vectors of force and motion. All components of a
    vector may be alike if it is oblique to the axes: then the largest one is chosen.
    """
    best = max(range(len(found)), key=lambda k: found[k][0].explained)
    (explained, _), _, vectors = found[best]
    alike = [
        k
        for k, (one, _, same) in enumerate(found)
        if same == vectors and one.explained > explained - _ALIKE
    ]
    return max(alike, key=lambda k: found[k][1])


def oblique(name: str, moved: FloatArray, others: Mapping[str, FloatArray]) -> list[str]:
    """Warn of other components by name that move in proportion to a component, (n,) each."""
    return [
        f'{other} moves by {ratio:.2g} of {name}: the motion is oblique to the axis, '
        'rotate it or choose the axis along the needle'
        for other, ratio in _in_proportion(moved, others)
    ]


def tilted(name: str, force: FloatArray, others: Mapping[str, FloatArray]) -> list[str]:
    """Warn of other components by name that are in proportion to a force, (n,) each."""
    found = _in_proportion(force, others)
    if not found:
        return []
    factor = sqrt(1.0 + sum(ratio**2 for _, ratio in found))
    parts = ' and '.join(f'{other} is {ratio:.2g} of {name}' for other, ratio in found)
    part = f'a sensor that is tilted measures along {name} only a part of the force'
    return [f'{parts}: {part}, which is {factor:.3g} times as large; rotate its readings']


def _in_proportion(
    values: FloatArray, others: Mapping[str, FloatArray]
) -> list[tuple[str, float]]:
    """Return name and ratio of the components that are in proportion to a component."""
    about, found = values - values.mean(), []
    power = about @ about
    for other, component in others.items():
        along = component - component.mean()
        ratio = float(about @ along) / power if power else 0.0
        if abs(ratio) > _OBLIQUE and ratio**2 * power > _IN_PROPORTION * (along @ along):
            found.append((other, ratio))
    return found
