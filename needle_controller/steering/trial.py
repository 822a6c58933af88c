"""A needle that differs from what is believed of it, and its insertion under a controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import hypot
from typing import NamedTuple

from needle_controller.steering.belief import SteeringBelief
from needle_controller.steering.controller import Guidance
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import SteeredNeedle
from needle_dynamics.steering.parameters import SteeringParameters, with_lengths
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """
    A needle as it is, and the turn of the sensor that sees it.

    Attributes
    ----------
    needle : NeedleParameters
        Needle and tissue.
    steering : SteeringParameters
        What they have beyond.
    tilt : tuple of float
        Tilt of the guide in x and z.
    bevel : ndarray, shape (2,)
        Load of the bevel in x and z [N].
    frame : ndarray, shape (2,)
        Turn of the sensor's frame: shift of the tip in x and z per depth [rad].
    seed : int
        Seed of the noise of the path.

    """

    needle: NeedleParameters
    steering: SteeringParameters
    tilt: tuple[float, float]
    bevel: FloatArray
    frame: FloatArray
    seed: int

    def start(self) -> SteeredNeedle:
        """
        Return the needle before it is inserted.

        Returns
        -------
        SteeredNeedle
            The needle.

        """
        roll = float(np.arctan2(*self.bevel))
        return SteeredNeedle(self.needle, self.steering, tilt=self.tilt, roll=roll, seed=self.seed)

    def tip(self, one: SteeredNeedle) -> FloatArray:
        """
        Return where the tip is in the frame of the sensor.

        Parameters
        ----------
        one : SteeredNeedle
            The needle.

        Returns
        -------
        ndarray, shape (2,)
            x and z [m].

        """
        return np.asarray(one.tip[[0, 2]] + self.frame * one.depth)


def drawn(
    needle: NeedleParameters,
    steering: SteeringParameters,
    belief: SteeringBelief,
    rng: np.random.Generator,
    seed: int,
) -> Truth:
    """
    Draw a needle that may be true.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue as they are believed.
    steering : SteeringParameters
        What they have beyond; bevel and path noise are those of the belief.
    belief : SteeringBelief
        Its spread is even, its deviations are normal.
    rng : Generator
        Where the numbers come from.
    seed : int
        Seed of the noise of the path.

    Returns
    -------
    Truth
        The needle.

    """
    length, skin = (1.0 + belief.spread * rng.uniform(-1.0, 1.0, 2)).tolist()
    sizes = belief.tilt, belief.frame, belief.bevel
    tilt, frame, bevel = (size * rng.standard_normal(2) for size in sizes)
    needle, steering = with_lengths(needle, steering, length, skin)
    steering = replace(
        steering,
        bevel_load=(hypot(*bevel),),
        path_noise=belief.path_noise,
        path_noise_length=belief.path_noise_length,
    )
    x, z = tilt.tolist()
    return Truth(
        needle=needle, steering=steering, tilt=(x, z), bevel=bevel, frame=frame, seed=seed
    )


class Inserted(NamedTuple):
    """
    An insertion that has ended.

    Attributes
    ----------
    needle : SteeredNeedle
        The needle at the end.
    way : float
        Way of the guide [m].
    turns : int
        How often the needle was turned.
    load : float
        Largest force on the guide after a motion of it [N].

    """

    needle: SteeredNeedle
    way: float
    turns: int
    load: float


def insert(
    truth: Truth,
    depths: FloatArray,
    look: Callable[[FloatArray], FloatArray | None],
    controller: Callable[[FloatArray | None], Guidance],
    watch: Callable[[SteeredNeedle], object] | None = None,
) -> Inserted:
    """
    Insert a needle in steps: look at the tip, move the guide and turn the needle, then insert it.

    Parameters
    ----------
    truth : Truth
        The needle.
    depths : ndarray, shape (n + 1,)
        Depths of the looks [m].
    look : callable
        Takes the tip in the frame of the sensor, shape (2,), and returns what it says of it, or
        None.
    controller : callable
        Takes that, and returns where guide and roll shall be in the next step.
    watch : callable, optional
        Called with the needle after each step.

    Returns
    -------
    Inserted
        The needle at the end, and what it took.

    """
    one = truth.start()
    begun, to, way, turns, load = one.roll, Guidance(0.0, 0.0), 0.0, 0, 0.0
    for k, depth in enumerate(depths.tolist()):
        if k:
            one.move(guide=to[:2], roll=begun + to.roll)
            load = max(load, hypot(*one.guide_load[0].tolist()))
            one.move(depth=depth)
            if watch is not None:
                watch(one)
        before, to = to, controller(look(truth.tip(one)))
        way += hypot(to.x - before.x, to.z - before.z)
        turns += to.roll != before.roll
    return Inserted(one, way, turns, load)
