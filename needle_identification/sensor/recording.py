# SPDX-License-Identifier: Apache-2.0
"""Recording of a tip sensor, with the true position."""

from dataclasses import dataclass
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.display import Displayed
from needle_identification.recordings.recording import freeze
from needle_ros.axes import AXES
from needle_ros.errors import ShapeError
import numpy as np

#: Standard deviation of a moving position, over the deviation of noise with the same differences:
#: white noise has 1, a sine with ten samples per period 2.3.
_MOVING: Final = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class SensorRecording(Displayed):
    """Measured tip positions, and the true position by the same clock."""

    name: str = 'recording'  #: for messages
    axes: tuple[str, ...] = AXES  #: axes of the columns
    time: FloatArray  #: (n,) time of the measurements [s], strictly increasing
    tip: FloatArray  #: (n, k) measured position [m]
    true_time: FloatArray  #: (m,) time of the true position [s], strictly increasing
    true_tip: FloatArray  #: (m, k) true position [m]; a single row if constant
    losses: tuple[str, ...] = ()  #: discarded and corrected data

    def __post_init__(self) -> None:
        freeze(self, 'time', tip=len(self.axes))
        freeze(self, 'true_time', true_tip=len(self.axes))
        for field in ('time', 'true_time'):
            if (np.diff(getattr(self, field)) <= 0.0).any():
                raise ShapeError(f'{self.name}: {field} must be strictly increasing')
        if not len(self.true_time):
            raise ShapeError(f'{self.name}: true_tip must have a row')

    def __repr__(self) -> str:
        moving = 'moving' if self.moves else 'constant'
        return f'<SensorRecording {self.name}: {len(self.time)} samples, {moving} true position>'

    @property
    def moves(self) -> bool:
        """Whether the true position moves by more than its own white noise."""
        change = np.diff(self.true_tip, axis=0)
        # The mean square of the differences of white noise is twice its variance.
        noise = 0.5 * (change**2).mean() if len(change) else 0.0
        return bool(self.true_tip.var(axis=0).mean() > _MOVING**2 * noise)

    def columns(self) -> dict[str, FloatArray]:
        tips = dict(zip(self.axes, self.tip.T, strict=True))
        return {'time [s]': self.time, **{f'tip_{axis} [m]': tips[axis] for axis in tips}}
