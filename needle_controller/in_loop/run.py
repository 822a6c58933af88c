# SPDX-License-Identifier: Apache-2.0
"""Result of a run of a closed loop."""

from dataclasses import dataclass

from needle_dynamics import FloatArray, NeedleModel
from needle_dynamics.display import Displayed
import numpy as np


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopRun(Displayed):
    """Result of a closed-loop run."""

    model: NeedleModel  #: the plant
    time: FloatArray  #: times [s], shape (k,)
    states: FloatArray  #: states X = [d, theta, q1, ..., qn] and rates, shape (k, 2 (2 + n))
    #: f_y [N], tau [N m] and generalized forces, shape (k, 2 + n): of a continuous law at the
    #: times, of a sampled law over the periods that start there.
    forces: FloatArray
    #: Time [s] and kind of each stop, break-away and hub contact; continuous laws only.
    events: tuple[tuple[float, str], ...] = ()

    @property
    def depth(self) -> FloatArray:
        """Insertion depth [m], shape (k,)."""
        return np.asarray(self.model.parameters.length - self.states[:, 0])

    @property
    def tip_deflection(self) -> FloatArray:
        """Deflection of the tip [m], shape (k,)."""
        values = self.model.modes.values(self.depth)
        return np.asarray((values * self.states[:, 2 : self.model.coordinates]).sum(axis=1))

    def columns(self) -> dict[str, FloatArray]:
        m = self.model.coordinates
        return {
            'time [s]': self.time,
            'depth [m]': self.depth,
            'velocity [m/s]': -self.states[:, m],
            'force [N]': self.forces[:, 0],
            'torque [N m]': self.forces[:, 1],
            'angle [rad]': self.states[:, 1],
            'tip_deflection [m]': self.tip_deflection,
            **{f'q{i} [m^3/2]': self.states[:, 1 + i] for i in range(1, m - 1)},
        }
