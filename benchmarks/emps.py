# SPDX-License-Identifier: Apache-2.0
"""
Friction of a public machine axis: ``python -m benchmarks.emps DATA_EMPS.mat``.

The electro-mechanical positioning system (A. Janot, M. Gautier, M. Brunot, "Data set and reference
models of EMPS", 2019) is a carriage with a ball screw. The file is not part of this project. Its
reference model is the least-squares fit of its authors to all samples. Our identification is
compared with it with `reversals`, and without them with the same fit to the other samples.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import sys
from typing import Final

from benchmarks.page import table
from needle_dynamics import FloatArray
from needle_dynamics.compiled.friction import COULOMB, friction_flow, FrictionConstants
from needle_identification import (
    FrictionSettings,
    identify_friction,
    ParameterEstimate,
    read_friction_recording,
)
import numpy as np
from scipy.io import loadmat
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, filtfilt

_COLUMNS: Final = {'time': 't', 'depth': 'qm', 'force': 'vir*gtau'}
_TERMS: Final = ('inertia', 'viscous', 'coulomb', 'offset')
_SETTINGS: Final = FrictionSettings(terms=_TERMS)
_NAMES: Final = ('moving_mass', 'viscous_friction', 'coulomb_friction', 'offset')
_REFERENCE: Final = (95.1089, 203.5034, 20.3935, -3.1648)

_CUTOFFS: Final = (100.0, 40.0)  #: low-pass filters of the motion, and of the regression [Hz]
_REVERSAL: Final = 0.024  #: time around a reversal, of a filter of 30 Hz [s]


class MachineAxis:
    """Recording of the axis: samples every 1 ms, forces in N, positions in m."""

    def __init__(self, path: Path) -> None:
        data = {k: np.ravel(v) for k, v in loadmat(path).items() if not k.startswith('_')}
        self.position, self.goal = data['qm'], data['qg']
        self.gain, self.kp, self.kv = (float(data[name][0]) for name in ('gtau', 'kp', 'kv'))
        self.force = self.gain * data['vir']
        self.period = float(np.median(np.diff(data['t'])))

    def fit(self, *, without: float) -> FloatArray:
        """Fit all samples as the authors, except those within a time of a reversal [s]."""
        motion, both = (butter(4, 2.0 * one * self.period) for one in _CUTOFFS)
        position = filtfilt(*motion, self.position)
        velocity = np.gradient(position, self.period)
        acceleration = np.gradient(velocity, self.period)
        sign = np.sign(velocity)
        columns = np.column_stack([acceleration, velocity, sign, np.ones_like(sign)])
        near = np.diff(sign, prepend=sign[0]) != 0.0
        near = maximum_filter1d(near, 2 * round(without / self.period) + 1)
        used = ~near if without else np.ones_like(near)
        used[:50] = used[-50:] = False
        x, y = (filtfilt(*both, one, axis=0)[used] for one in (columns, self.force))
        return np.asarray(np.linalg.lstsq(x, y, rcond=None)[0])

    def simulated_error(self, values: FloatArray) -> float:
        """Return the error of positions simulated in the position loop, over their norm."""
        mass, viscous, coulomb, offset = values.tolist()
        friction = FrictionConstants(COULOMB, coulomb, viscous, 1.0, 1.0, 1.0, 1.0)
        x, v = float(self.position[0]), 0.0
        found = np.empty_like(self.position)
        for k, goal in enumerate(self.goal.tolist()):
            found[k] = x
            drive = self.gain * self.kv * (self.kp * (goal - x) - v) - offset
            v, way = friction_flow(friction, mass, v, drive, self.period)
            x += way
        return float(np.linalg.norm(found - self.position) / np.linalg.norm(self.position))


def main(path: Path) -> None:
    """Print the constants identified from the same samples as those of the reference fits."""
    axis, recording = MachineAxis(path), read_friction_recording(path, columns=_COLUMNS)
    fits = {False: axis.fit(without=_REVERSAL), True: np.array(_REFERENCE)}
    for reversals, reference in fits.items():
        ours = identify_friction(recording, replace(_SETTINGS, reversals=reversals))
        found: list[ParameterEstimate] = [ours[name] for name in _NAMES]
        rows = [
            (
                one.name,
                f'{one.value:.4g}',
                f'{one.interval[0]:.4g} to {one.interval[1]:.4g}',
                f'{other:.4g}',
                f'{one.value / other - 1.0:+.2%}',
            )
            for one, other in zip(found, reference.tolist(), strict=True)
        ]
        values = np.array([one.value for one in found])
        errors = [axis.simulated_error(each) for each in (values, reference)]
        other = 'reference' if reversals else 'method of the reference without reversals'
        sys.stdout.write(
            f'{table(("constant", "ours", "95 % interval", other, "difference"), rows)}\n\n'
            f'error of simulated positions: {errors[0]:.4%} and {errors[1]:.4%}\n\n'
        )


if __name__ == '__main__':
    main(Path(sys.argv[1]))
