"""Simulated needle that differs from the nominal model, and its insertion under a controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import hypot
from typing import NamedTuple

from needle_controller.steering.law import GuideSetpoint
from needle_controller.steering.prior import SteeringPrior
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import SteeredNeedle
from needle_dynamics.steering.parameters import SteeringParameters, with_lengths
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundTruth:
    """
    Ground truth of a simulated needle, and the rotation of its sensor.

    Attributes
    ----------
    needle : NeedleParameters
        Needle and tissue.
    steering : SteeringParameters
        Their constants for steering.
    tilt : tuple of float
        Tilt of the guide in x and z.
    bevel : ndarray, shape (2,)
        Load of the bevel in x and z [N].
    frame : ndarray, shape (2,)
        Rotation of the sensor's frame: shift of the tip in x and z per depth [rad].
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
        """Return the needle before the insertion."""
        roll = float(np.arctan2(*self.bevel))
        return SteeredNeedle(self.needle, self.steering, tilt=self.tilt, roll=roll, seed=self.seed)

    def tip(self, one: SteeredNeedle) -> FloatArray:
        """Return the tip position of a needle in the frame of the sensor, x and z [m]."""
        return np.asarray(one.tip[[0, 2]] + self.frame * one.depth)


def drawn(
    needle: NeedleParameters,
    steering: SteeringParameters,
    prior: SteeringPrior,
    rng: np.random.Generator,
    seed: int,
) -> GroundTruth:
    """
    Sample a true needle from the prior uncertainty of a nominal needle.

    The spread of ``prior`` is uniform, its standard deviations are normal; it also gives bevel
    and path noise. ``seed`` is the seed of the path noise.
    """
    length, skin = (1.0 + prior.spread * rng.uniform(-1.0, 1.0, 2)).tolist()
    sizes = prior.tilt, prior.frame, prior.bevel
    tilt, frame, bevel = (size * rng.standard_normal(2) for size in sizes)
    needle, steering = with_lengths(needle, steering, length, skin)
    steering = replace(
        steering,
        bevel_load=(hypot(*bevel),),
        path_noise=prior.path_noise,
        path_noise_length=prior.path_noise_length,
    )
    x, z = tilt.tolist()
    return GroundTruth(
        needle=needle, steering=steering, tilt=(x, z), bevel=bevel, frame=frame, seed=seed
    )


class Inserted(NamedTuple):
    """
    Result of an insertion.

    Attributes
    ----------
    needle : SteeredNeedle
        The needle at the end.
    way : float
        Distance moved by the guide [m].
    turns : int
        Number of turns of the needle.
    load : float
        Largest force on the guide after a motion of the guide [N].

    """

    needle: SteeredNeedle
    way: float
    turns: int
    load: float


def insert(
    truth: GroundTruth,
    depths: FloatArray,
    look: Callable[[FloatArray], FloatArray | None],
    controller: Callable[[FloatArray | None], GuideSetpoint],
    watch: Callable[[SteeredNeedle], object] | None = None,
) -> Inserted:
    """
    Insert a needle in steps: measure the tip, move guide and roll, then insert.

    ``depths`` are the depths of the measurements [m], shape (n + 1,). ``look`` returns the
    measurement of the tip, shape (2,), or None; ``controller`` takes it and returns guide and roll
    for the next step. ``watch`` is called with the needle after each step.
    """
    one = truth.start()
    begun, to, way, turns, load = one.roll, GuideSetpoint(0.0, 0.0), 0.0, 0, 0.0
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
