"""
Friction recordings by a simulator of their own, with noise of many kinds.

Nothing of the plant, its sensor or its protocol is used: strokes of random speed and length in and
out with rests at some of the turns, a force that is Coulomb and viscous friction with further
effects on request, and noise on force and motion. It shows what identification does with
recordings that its authors did not make.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp, pi, sqrt
from typing import Final

from needle_dynamics import FloatArray
from needle_identification import Recording
import numpy as np
from scipy.signal import lfilter

#: Samples in the simulation of the motion per sample of the recording.
_FINER: Final = 4

#: Strokes begin and end at these accelerations [m/s^2], and last so long [s].
_ACCELERATIONS: Final = (0.04, 0.15)
_STROKES: Final = (0.6, 1.8)

#: Speeds [m/s], from which those of the strokes are drawn evenly in their logarithm.
_SPEEDS: Final = (2e-3, 15e-3)

#: Rests at a third of the turns [s].
_RESTS: Final = (0.1, 0.5)
_REST_SHARE: Final = 0.33


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """
    A kind of recording: noise of force and motion, and what the truth holds beside (15).

    Attributes
    ----------
    white, colored, walk, mains : float
        Standard deviation of white and of exponentially correlated noise of the force [N], of the
        steps of a random walk [N / sqrt(s)], and amplitude of a hum of 50 Hz [N].
    memory : float
        Time over which colored noise is correlated [s].
    counts : float
        Smallest step of the force [N].
    rate, duration : float
        Samples per second, and length [s].
    speed_noise, position_noise, position_counts : float
        White noise of the speed [m/s] and of the position [m], and the step of the position [m].
    positions_only : bool
        Whether the recording has no speeds.
    late : float
        How late the force is stamped [s].
    truth : mapping of str to float
        Coefficients of further terms, by the names of the parameters.

    """

    white: float = 0.02
    colored: float = 0.0
    walk: float = 0.0
    mains: float = 0.0
    memory: float = 0.0
    counts: float = 0.0
    rate: float = 250.0
    duration: float = 40.0
    speed_noise: float = 0.0
    position_noise: float = 0.0
    position_counts: float = 1e-6
    positions_only: bool = False
    late: float = 0.0
    truth: Mapping[str, float] = field(default_factory=dict)


def recorded(
    kind: Kind, rng: np.random.Generator, name: str = ''
) -> tuple[Recording, Mapping[str, float]]:
    """
    Simulate a recording.

    Parameters
    ----------
    kind : Kind
        What it is like.
    rng : Generator
        Draws friction, strokes and noise.
    name : str
        Its name.

    Returns
    -------
    recording : Recording
        What a robot and its sensor would have recorded.
    truth : mapping of str to float
        Its true parameters by name.

    """
    truth = {
        'coulomb_friction': rng.uniform(0.3, 0.8),
        'viscous_friction': rng.uniform(200.0, 400.0),
        **kind.truth,
    }
    step = 1.0 / (kind.rate * _FINER)
    speed, acceleration = _strokes(rng, kind.duration, step)
    depth = 0.05 + np.concatenate([[0.0], np.cumsum(0.5 * step * (speed[1:] + speed[:-1]))])
    time: FloatArray = np.arange(len(speed)) * step
    force = _force(truth, time, speed, acceleration)
    force = np.interp(time - kind.late, time, force)
    kept = slice(None, None, _FINER)
    time, depth = time[kept], np.asarray(depth[kept])
    speed, force = speed[kept], np.asarray(force[kept])
    n = len(time)
    depth = depth + kind.position_noise * rng.standard_normal(n)
    recording = Recording(
        name=name or 'noise',
        time=time,
        depth=_counted(depth, kind.position_counts),
        speed=None if kind.positions_only else speed + kind.speed_noise * rng.standard_normal(n),
        force=_counted(force + _noise(kind, rng, n), kind.counts),
    )
    return recording, truth


def _strokes(
    rng: np.random.Generator, duration: float, step: float
) -> tuple[FloatArray, FloatArray]:
    """Return speed and acceleration of strokes in and out."""
    corners, speeds = [0.0, 0.5], [0.0, 0.0]
    sign = 1.0
    while corners[-1] < duration:
        speed = sign * exp(rng.uniform(*np.log(_SPEEDS)))
        ramp = abs(speed) / rng.uniform(*_ACCELERATIONS)
        for length, then in ((ramp, speed), (rng.uniform(*_STROKES), speed), (ramp, 0.0)):
            corners.append(corners[-1] + length)
            speeds.append(then)
        if rng.random() < _REST_SHARE:
            corners.append(corners[-1] + rng.uniform(*_RESTS))
            speeds.append(0.0)
        sign = -sign
    time = np.arange(0.0, duration, step)
    speed = np.interp(time, corners, speeds)
    slopes = np.append(np.diff(speeds) / np.diff(corners), 0.0)
    return speed, slopes[np.searchsorted(corners, time, 'right') - 1]


def _force(
    truth: Mapping[str, float], time: FloatArray, speed: FloatArray, acceleration: FloatArray
) -> FloatArray:
    """Return the force; at rest it is what is left of the friction, a part of Coulomb's."""
    sign = np.sign(speed)
    sign[speed == 0.0] = 0.3
    force = truth['coulomb_friction'] * sign + truth['viscous_friction'] * speed
    force += truth.get('offset', 0.0) + truth.get('force_drift', 0.0) * time
    force += truth.get('moving_mass', 0.0) * acceleration
    force += truth.get('stribeck_friction', 0.0) * sign * np.exp(-((speed / 1e-3) ** 2))
    out = speed < 0.0
    force += truth.get('withdrawal_coulomb', 0.0) * np.where(out, -1.0, 0.0)
    force += truth.get('withdrawal_viscous', 0.0) * np.where(out, speed, 0.0)
    return np.asarray(force)


def _noise(kind: Kind, rng: np.random.Generator, n: int) -> FloatArray:
    noise = kind.white * rng.standard_normal(n)
    if kind.colored:
        kept = exp(-1.0 / (kind.rate * kind.memory))
        steps = kind.colored * sqrt(1.0 - kept**2) * rng.standard_normal(n)
        steps[0] /= sqrt(1.0 - kept**2)
        noise += lfilter([1.0], [1.0, -kept], steps)
    noise += np.cumsum(kind.walk / sqrt(kind.rate) * rng.standard_normal(n))
    phase = rng.uniform(0.0, 2.0 * pi)
    noise += kind.mains * np.sin(2.0 * pi * 50.0 * np.arange(n) / kind.rate + phase)
    return np.asarray(noise)


def _counted(values: FloatArray, step: float) -> FloatArray:
    return np.round(values / step) * step if step else values
