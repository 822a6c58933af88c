# SPDX-License-Identifier: Apache-2.0
"""
Error stated by `simulate` compared with the true error, for random needles of every friction law.

The true error is the difference from a run with even steps of an eighth of the shortest step, or
of a fortieth of the time in which friction changes the velocity by its speed scale, if that is
shorter.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import exp
from typing import Any, Final

from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import (
    add_friction_law,
    FloatArray,
    NeedleError,
    NeedleModel,
    NeedleParameters,
    simulate,
    Trajectory,
)
import numpy as np

_DURATION: Final = 0.02  #: simulated time [s]
_FINEST: Final = 5e-9  #: shortest step of a reference [s]

#: Least travel to which an error refers, relative to the length; see `Trajectory.error`.
_TRAVEL: Final = 1e-4

#: Smallest error that is compared: references with a quarter of the step differ by about 1e-7.
_SMALLEST: Final = 1e-6

#: Speed in which the friction of the law of a user decays [m/s].
_OWN_SPEED: Final = 1e-3

_LAWS: Final = ('coulomb', 'stribeck', 'tanh', 'own')


def _own(coulomb: float, speed: float) -> float:
    """Return the friction of a law of a user: static friction is 1.5 times Coulomb friction."""
    return coulomb * (1.0 + 0.5 * exp(-speed / _OWN_SPEED))


def draw(law: str, number: int) -> Iterator[tuple[NeedleParameters, float, float, float]]:
    """Yield random needles with depth [m], tip deflection [m] and insertion force [N]."""
    rng = np.random.default_rng(_LAWS.index(law))
    if law == 'own':
        add_friction_law('own', _own)
    for _ in range(number):
        speed, breakaway = float(10.0 ** rng.uniform(-4.0, -0.3)), float(rng.uniform(1.05, 2.0))
        changes: dict[str, Any] = {
            'stribeck': {'stribeck_speed': speed, 'breakaway_friction': breakaway},
            'tanh': {'smoothing_speed': speed},
        }.get(law, {})
        preset = str(rng.choice(['paper_si', 'phantom']))
        p = NeedleParameters.preset(preset, friction_law=law, **changes)
        depth = float(rng.uniform(0.02, 0.08))
        tip = float(rng.choice([0.0, 1e-3 * rng.uniform()]))
        yield p, depth, tip, float(2.0 * rng.uniform(1.05, 4.0) * p.coulomb_friction)


def difference(run: Trajectory, fine: Trajectory) -> float:
    """Return the relative difference of two runs, in peak tip deflection and in travel."""
    tips, depths = fine.tip_deflection, fine.depth
    way = max(np.abs(depths - depths[0]).max(), _TRAVEL * fine.parameters.length)
    peak = np.abs(tips).max()
    tip = np.abs(run.tip_deflection - tips).max() / peak if peak > 0.0 else 0.0
    return float(max(tip, np.abs(run.depth - depths).max() / way))


def ratios(law: str, number: int) -> FloatArray:
    """Return the true error over the stated error for random needles of a law."""
    found = []
    for p, depth, tip, force in draw(law, number):
        start = NeedleModel(p).state_at(depth, tip)
        try:
            run = simulate(p, start, force, duration=_DURATION)
        except NeedleError:
            # The needle reaches its hub.
            continue
        scales = {'stribeck': p.stribeck_speed, 'tanh': p.smoothing_speed, 'own': _OWN_SPEED}
        speed = scales.get(law, 1.0)
        scale = p.moving_mass * speed / p.coulomb_friction
        step = min(float(run.steps.min()) / 8.0, max(scale / 40.0, _FINEST))
        fine = simulate(p, start, force, duration=_DURATION, step=step)
        error = difference(run, fine)
        found.append(error / max(run.error, _SMALLEST))
    return np.array(found)


def compare(tick: Tick, needles: int = 250) -> Answer:
    """Compare the errors for a number of needles of each law."""
    rows, bars = [], []
    for law in _LAWS:
        tick(law)
        found = ratios(law, needles)
        honest, largest = float((found <= 1.0).mean()), float(found.max())
        rows.append((law, str(len(found)), f'{100.0 * honest:.1f} %', f'{largest:.2f}'))
        bars += [
            Bar(f'at most as wrong as stated, {law}', 100.0 * honest, 95.0, '%', at_least=True),
            Bar(f'largest true over stated error, {law}', largest, 3.0),
        ]
    section = PageSection(
        'True and stated error of `simulate`',
        (
            'friction law',
            'needles',
            'at most as wrong as stated',
            'largest true over stated error',
        ),
        rows,
        'Presets paper_si and phantom, straight and bent, 2 to 8 cm inserted, '
        f'{_DURATION * 1e3:g} ms, default tolerance. Speed scales of 0.1 mm/s to 0.5 m/s, and '
        '1 mm/s in the law of a user. Runs that reach the hub are left out. Errors below '
        f'{_SMALLEST:g} are not compared: references differ by about 1e-7.',
    )
    return [section], bars
