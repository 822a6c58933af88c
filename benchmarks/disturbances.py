# SPDX-License-Identifier: Apache-2.0
"""Errors of simulated force and motion that the models of the noise do not contain."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import exp, pi
from typing import Final, NamedTuple

from needle_dynamics import FloatArray
import numpy as np
from scipy.signal import lfilter

START_DEPTH: Final = 0.05  #: insertion depth at the start [m]


class MotionSamples(NamedTuple):
    """Simulated samples, (n,) each: time [s], insertion depth [m], velocity [m/s], force [N]."""

    time: FloatArray
    depth: FloatArray
    speed: FloatArray
    force: FloatArray


#: Changes samples; the true parameters and the generator of the noise are given.
Change = Callable[[MotionSamples, Mapping[str, float], np.random.Generator], MotionSamples]


def low_pass(values: FloatArray, samples: float) -> FloatArray:
    """Filter values from rest by the time constant `samples`."""
    kept = exp(-1.0 / samples)
    return np.asarray(lfilter([1.0 - kept], [1.0, -kept], values))


def counted(values: FloatArray, step: float) -> FloatArray:
    return np.round(values / step) * step if step else values


def with_play(width: float, depth: FloatArray) -> FloatArray:
    """Return the position of a follower that has play of a width [m]."""
    found, half = depth.copy(), 0.5 * width
    last = float(depth[0])
    for k, now in enumerate(depth.tolist()):
        last = min(max(last, now - half), now + half)
        found[k] = last
    return found


def drive_play(
    made: MotionSamples, truth: Mapping[str, float], _: np.random.Generator
) -> MotionSamples:
    """Move the needle by a drive with 10 um of play; the motion is measured at the motor."""
    needle = np.gradient(with_play(1e-5, made.depth), made.time)
    needle[np.abs(needle) < 1e-6] = 0.0
    force = truth['coulomb_friction'] * np.sign(needle) + truth['viscous_friction'] * needle
    return made._replace(force=np.asarray(force))


def lugre(
    made: MotionSamples, truth: Mapping[str, float], _: np.random.Generator
) -> MotionSamples:
    """Return the friction of the LuGre model: bristles of 2e5 N/m, 30 % more at rest."""
    stiffness, damping, speed = 2e5, 200.0, 1e-3
    level = 1.0 + 0.3 * np.exp(-((made.speed / speed) ** 2))
    rate = stiffness * np.abs(made.speed) / (truth['coulomb_friction'] * level)
    kept = np.exp(-rate * made.time[1])
    bend, force = 0.0, truth['viscous_friction'] * made.speed
    for k, v in enumerate(made.speed.tolist()):
        end = v / rate[k] if v else bend
        force[k] += stiffness * bend + damping * rate[k] * (end - bend)
        bend = end + (bend - end) * kept[k]
    return made._replace(force=force)


def more_force(more: Callable[[MotionSamples], FloatArray]) -> Change:
    """Return a change that adds a function of the motion to the force."""
    return lambda made, _truth, _rng: made._replace(force=made.force + more(made))


def pink(read: MotionSamples, _: Mapping[str, float], rng: np.random.Generator) -> MotionSamples:
    """Add noise of 0.02 N with a power spectrum of 1 / f."""
    n = len(read.time)
    root = np.sqrt(np.arange(n // 2 + 1))
    lines = rng.standard_normal((2, len(root))) / np.maximum(root, 1.0) * (root > 0.0)
    noise = np.fft.irfft(lines[0] + 1j * lines[1], n)
    return read._replace(force=read.force + 0.02 * noise / noise.std())


def aliased(
    made: MotionSamples, _: Mapping[str, float], rng: np.random.Generator
) -> MotionSamples:
    """Add two harmonics that samples at 250 Hz show at 1.3 and 6.3 Hz."""
    turns = 2.0 * pi * np.outer([251.3, 493.7], made.time) + rng.uniform(0.0, 2.0 * pi, (2, 1))
    return made._replace(force=made.force + np.array([0.05, 0.03]) @ np.sin(turns))


def outliers(
    read: MotionSamples, _: Mapping[str, float], rng: np.random.Generator
) -> MotionSamples:
    n = len(read.time)
    spikes = np.where(rng.random(n) < 0.02, rng.exponential(0.3, n), 0.0)
    return read._replace(force=read.force + spikes)


def error_by_speed(
    read: MotionSamples, _: Mapping[str, float], rng: np.random.Generator
) -> MotionSamples:
    noise = 10.0 * np.abs(read.speed) * rng.standard_normal(len(read.time))
    return read._replace(force=read.force + noise)


def sticking(
    read: MotionSamples, _: Mapping[str, float], rng: np.random.Generator
) -> MotionSamples:
    """Count the force in 0.05 N, and repeat 70 % of the values that change by one count."""
    force = counted(read.force, 0.05)
    fresh = rng.random(len(force)) < 0.3
    for k in range(1, len(force)):
        if not fresh[k] and abs(force[k] - force[k - 1]) < 0.099:
            force[k] = force[k - 1]
    return read._replace(force=force)


def jitter(read: MotionSamples, _: Mapping[str, float], rng: np.random.Generator) -> MotionSamples:
    """Shift stamps by up to 1.5 ms, and drop a tenth of the samples."""
    n = len(read.time)
    late = read._replace(time=read.time + rng.uniform(-1.5e-3, 1.5e-3, n))
    kept = rng.random(n) > 0.1
    return MotionSamples(*(values[kept] for values in late))
