# SPDX-License-Identifier: Apache-2.0
"""Synthetic recordings of strokes: friction, a base with limits, and a sensor."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from needle_identification import Recording
import numpy as np
from scipy.signal import butter, lfilter

#: Integration step [s], and steps per sample of the recording (250 Hz).
STEP, EVERY = 1e-3, 4
#: mu_s [N] and mu_v [N s/m].
COULOMB, VISCOUS = 0.56, 300.0
SPEEDS = (2e-3, 5e-3, 10e-3, 15e-3, 20e-3)
ACCELERATION = 0.5
NOISE = 0.02


@lru_cache(maxsize=16)
def motion(speeds: tuple[float, ...] = SPEEDS, push: float = 1.0) -> Any:
    """Return velocity [m/s] and force of an initial push [N] that rises for 1.5 s."""
    rise = np.maximum(np.arange(1, 1701) * STEP - 0.2, 0.0) / 1.5 * push
    rise = rise if push else rise[:0]
    pushed = np.maximum(rise - COULOMB, 0.0) / VISCOUS
    rows = []
    velocity = pushed[-1] if len(pushed) else 0.0
    for target, duration in [(0.0, 0.3)] + [
        leg for v in speeds for leg in ((v, 1.0), (0.0, 0.2), (-v, 1.0), (0.0, 0.2))
    ]:
        for _ in range(round(duration / STEP)):
            change = np.clip(target - velocity, -ACCELERATION * STEP, ACCELERATION * STEP)
            velocity = velocity + change
            # Avoid rounding errors at rest.
            velocity = 0.0 if abs(velocity) < 1e-12 else velocity
            rows.append(velocity)
    return np.concatenate([pushed, rows]), rise


def strokes(
    *,
    seed: int | None = None,
    speeds: tuple[float, ...] = SPEEDS,
    push: float = 1.0,
    offset: float = 0.0,
    withdrawal: float = 1.0,
    breakaway: float = 1.0,
    mass: float = 0.0,
    lag: float = 0.0,
    noise: float = NOISE,
    cutoff: float = 125.0,
) -> Recording:
    """Record strokes; with a seed through a noisy second-order sensor, else exactly."""
    velocity, rise = motion(speeds, push)
    time = np.asarray(STEP * np.arange(1, len(velocity) + 1), float)
    more = 1.0 + (breakaway - 1.0) * np.exp(-((velocity / 1e-3) ** 2))
    force = COULOMB * more * np.sign(velocity) + VISCOUS * velocity
    force = np.where(velocity < 0.0, withdrawal, 1.0) * force + mass * np.gradient(velocity, STEP)
    # Before the needle moves, the sensor measures the push.
    force[: len(rise)] = np.where(velocity[: len(rise)] > 0.0, force[: len(rise)], rise)
    force = np.interp(time - lag, time, force) + offset
    if seed is not None:
        force = force + np.random.default_rng(seed).normal(scale=noise, size=len(force))
        b, a = butter(2, cutoff, fs=1.0 / STEP)
        force = np.round(lfilter(b, a, force) / 0.0025) * 0.0025
    # Insertion depth at the samples: half a step before the sum of velocities.
    depth = 0.1 + STEP * (np.cumsum(velocity) - 0.5 * velocity)
    kept = slice(EVERY - 1, None, EVERY)
    return Recording(
        name='strokes',
        time=time[kept],
        depth=depth[kept],
        velocity=velocity[kept],
        force=force[kept],
    )
