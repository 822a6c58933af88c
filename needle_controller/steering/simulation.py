# SPDX-License-Identifier: Apache-2.0
"""Simulated needle that differs from the nominal model, and its insertion under a steering law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import hypot
from time import perf_counter
from typing import NamedTuple

from needle_controller.steering.checked_law import CheckedPlans, guarded
from needle_controller.steering.law import GuideSetpoint, SteeringLaw
from needle_controller.steering.settings import SteeringLimits, SteeringPrior
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.tip_sensor import TipErrorParameters, TipErrors
from needle_dynamics.steering.needle import SteeredNeedle
from needle_dynamics.steering.parameters import (
    by_layer,
    SteeringParameters,
    with_bevel,
    with_layers,
    with_lengths,
)
from needle_ros.settings import constant
import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundTruth:
    """Ground truth of a simulated needle, and the rotation of its sensor."""

    needle: NeedleParameters
    steering: SteeringParameters
    tilt: tuple[float, float]  #: Tilt of the guide in x and z [rad].
    bevel: FloatArray  #: Load of the bevel in x and z [N], shape (2,).
    frame: FloatArray  #: Shift of the tip in x and z per depth by the sensor [rad], shape (2,).
    seed: int  #: Seed of the noise of the path.

    def plant(self, depths: FloatArray) -> SteeringPlant:
        """Return the needle before an insertion to depths [m], shape (n + 1,)."""
        roll = float(np.arctan2(*self.bevel))
        needle = SteeredNeedle(
            self.needle, self.steering, tilt=self.tilt, roll=roll, seed=self.seed
        )
        return SteeringPlant(needle, depths, self.frame)


def true_needle(
    needle: NeedleParameters,
    steering: SteeringParameters,
    prior: SteeringPrior,
    *,
    lengths: Sequence[float],
    layers: Sequence[float] = (),
    bevel: float,
    path_noise: float | None = None,
) -> tuple[NeedleParameters, SteeringParameters]:
    """
    Return a needle that differs from the nominal one.

    ``lengths`` are the factors of bending length and skin, ``layers`` those of the stiffness of
    each layer. ``bevel`` is the load of the bevel in the layer where it is largest [N], and
    ``path_noise`` that of the prior unless it is given [rad^2/m].
    """
    length, skin = lengths
    needle, steering = with_lengths(needle, steering, length, skin)
    if len(layers):
        needle = with_layers(needle, layers)
    return needle, replace(
        with_bevel(steering, bevel),
        path_noise=prior.path_noise if path_noise is None else path_noise,
        path_noise_length=prior.path_noise_length,
    )


def sample_truth(
    needle: NeedleParameters,
    steering: SteeringParameters,
    prior: SteeringPrior,
    rng: np.random.Generator,
    seed: int,
) -> GroundTruth:
    """
    Sample a true needle: uniform in the spread of the prior, normal in its deviations.

    The factors of the layers are log-normal; the sampled load of the bevel acts in the layer with
    the largest nominal load.
    """
    lengths = (1.0 + prior.spread * rng.uniform(-1.0, 1.0, 2)).tolist()
    sizes = prior.tilt, prior.frame, prior.bevel
    tilt, frame, bevel = (size * rng.standard_normal(2) for size in sizes)
    layers = list[float]()
    if prior.layer_spread:
        count = len(needle.tissue.starts)
        spreads = by_layer('prior.layer_spread', prior.layer_spread, count)
        layers = np.exp(spreads * rng.standard_normal(count)).tolist()
    needle, steering = true_needle(
        needle, steering, prior, lengths=lengths, layers=layers, bevel=hypot(*bevel)
    )
    x, z = tilt.tolist()
    return GroundTruth(
        needle=needle, steering=steering, tilt=(x, z), bevel=bevel, frame=frame, seed=seed
    )


class SteeringPlant:
    """
    Simulated needle that is inserted in steps, and its tip in the frame of the sensor.

    `step` is the number of its present depth among ``depths`` of the tip measurements [m], shape
    (n + 1,); ``frame`` as in `GroundTruth`; ``origin`` is the position of the zero of the guide
    in the frame of the sensor, x and z [m].
    """

    def __init__(
        self,
        needle: SteeredNeedle,
        depths: FloatArray,
        frame: ArrayLike = (0.0, 0.0),
        origin: ArrayLike = (0.0, 0.0),
    ) -> None:
        self.needle, self.depths, self.step = needle, depths, 0
        self._roll = needle.roll
        self._frame: list[float] = np.array(frame).tolist()
        self._origin: list[float] = np.array(origin).tolist()

    @property
    def tip(self) -> FloatArray:
        """Position of the tip in the frame of the sensor, x and z [m]."""
        x, depth, z = self.needle.tip.tolist()
        (turn_x, turn_z), (at_x, at_z) = self._frame, self._origin
        return np.array([at_x + x + turn_x * depth, at_z + z + turn_z * depth])

    @property
    def done(self) -> bool:
        """Whether the needle is at the last depth."""
        return self.step == len(self.depths) - 1

    def guide(self, to: GuideSetpoint) -> None:
        """Move guide and roll, while the depth is constant."""
        self.needle.move(guide=to[:2], roll=self._roll + to.roll)

    def insert(self) -> None:
        """Insert the needle to the next depth."""
        self.needle.move(depth=float(self.depths[self.step + 1]))
        self.step += 1


@dataclass(frozen=True, slots=True, kw_only=True)
class SteppedTipErrors(TipErrorParameters):
    """Errors of averaged tip measurements beyond white noise, one measurement at each depth."""

    interval: float = constant(
        1.7, 's', 'time from one tip measurement to the next', open_low=True
    )


class SteppedTipSensor:
    """
    Averaged tip measurement of a plant at rest, in the frame of its sensor; None if it is lost.

    ``random`` generates white noise with the standard deviation ``noise`` [m], ``losses`` the
    losses, and ``seed`` all other ``errors``.
    """

    def __init__(
        self,
        plant: SteeringPlant,
        noise: float,
        errors: SteppedTipErrors,
        seed: int,
        random: np.random.Generator,
        losses: np.random.Generator,
    ) -> None:
        self._plant, self._noise, self._random = plant, noise, random
        self._interval = errors.interval
        self._errors = TipErrors(errors, np.random.default_rng([seed, 2]), losses)

    def __call__(self, tip: FloatArray) -> FloatArray | None:
        x, z = tip.tolist()
        depth = float(self._plant.depths[self._plant.step])
        x, _, z = self._errors.shifted(x, depth, z, self._interval)
        noise = self._noise * self._random.standard_normal(2)
        return None if self._errors.lost(self._interval) else np.array([x, z]) + noise


class SteeringRun(NamedTuple):
    """Simulated insertion under a steering law."""

    travel: float  #: Distance traveled by the guide [m].
    turns: int  #: Number of turns of the needle.
    load: float  #: Largest force on the guide after a motion of the guide [N].
    warning: str  #: First warning of the law before the last depth, with its depth, or ''.
    times: list[float]  #: Computation time of the law at each depth [s].


def simulate_steering(
    law: SteeringLaw,
    plant: SteeringPlant,
    sensor: Callable[[FloatArray], FloatArray | None],
    watch: Callable[[SteeringPlant], object] | None = None,
    limits: SteeringLimits | None = None,
    roll: float = 0.0,
) -> SteeringRun:
    """
    Insert a simulated needle in steps: measure the tip, plan, move guide and roll, insert.

    ``sensor`` returns a measurement of the tip, shape (2,) [m], or None. ``watch`` is called after
    each step. ``roll`` is the initial roll of the needle as given to the law [rad]. Raises
    `SteeringFaultError` if the law stops the insertion or exceeds ``limits``, if they are given,
    and `LawError` if it fails.
    """
    plans = CheckedPlans(law, len(plant.depths) - 1, limits, roll)
    travel, load = 0.0, 0.0
    warning, times = '', list[float]()
    while True:
        tip = sensor(plant.tip)
        begin = perf_counter()
        with guarded(law):
            law.update(tip, plant.step)
        before, to = plans.setpoint, plans.plan()
        times.append(perf_counter() - begin)
        travel += hypot(to.x - before.x, to.z - before.z)
        if plant.done:
            return SteeringRun(travel, plans.turns, load, warning, times)
        with guarded(law):
            if not warning and (new := law.warning):
                warning = f'at a depth of {1e3 * plant.depths[plant.step]:.4g} mm: {new}'
        plant.guide(to)
        load = max(load, hypot(*plant.needle.guide_load[0].tolist()))
        plant.insert()
        if watch is not None:
            watch(plant)
