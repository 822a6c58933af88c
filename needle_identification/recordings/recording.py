# SPDX-License-Identifier: Apache-2.0
"""Recordings as validated arrays: force and motion of one experiment, and of a tip sensor."""

from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.display import Displayed
from needle_ros.errors import ShapeError, shown
from needle_ros.parameter_file import parameters_in
from needle_ros.quantities import AXES
import numpy as np

#: Standard deviation of a moving position, over the deviation of noise with the same differences:
#: white noise has 1, a sine with ten samples per period 2.3.
_MOVING: Final = 1.5


def freeze(recording: Any, first: str, missing: str = '', /, **columns: int | None) -> None:
    """Replace arrays (n,) or (n, columns) by finite read-only copies; ``missing`` may be nan."""
    object.__setattr__(recording, 'name', shown(recording.name))
    object.__setattr__(recording, 'losses', tuple(map(shown, recording.losses)))
    length = np.shape(getattr(recording, first))
    for field, count in {first: None, **columns}.items():
        rest = () if count is None else (count,)
        values = np.array(getattr(recording, field), dtype=np.float64)
        if len(length) != 1 or values.shape != length + rest:
            wanted = '(n,)' if count is None else f'(n, {count})'
            raise ShapeError(
                f'{recording.name}: {field} must have the shape {wanted} with the (n,) of '
                f'{first}, got {values.shape} and {length}'
            )
        if field != missing and not np.isfinite(values).all():
            raise ShapeError(f'{recording.name}: {field} must be finite')
        values.setflags(write=False)
        object.__setattr__(recording, field, values)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class BaseRecording(Displayed):
    """Force of one experiment over time, and its source."""

    name: str = 'recording'  #: for messages
    time: FloatArray  #: (n,) time [s], strictly increasing
    force: FloatArray
    losses: tuple[str, ...] = ()  #: lost, discarded or repaired data, one sentence each
    configuration: str = ''  #: parameter file of the recorded plant; empty if not recorded
    clock_offset: float = 0.0  #: clock of the force minus that of the motion [s], corrected

    @property
    def truth(self) -> Mapping[str, Any] | None:
        """Parameters of the recorded plant by name; None if there is no configuration."""
        return parameters_in(self.configuration) or None

    @property
    def digest(self) -> bytes:
        """SHA-256 of times and forces, to detect copies of a recording."""
        return sha256(self.time.tobytes() + self.force.tobytes()).digest()

    def __repr__(self) -> str:
        duration = self.time[-1] - self.time[0] if len(self.time) else 0.0
        return f'<{type(self).__name__} {self.name}: {len(self.time)} samples in {duration:.4g} s>'

    def _freeze(self, **columns: int | None) -> None:
        freeze(self, 'time', **columns)
        if not (np.diff(self.time) > 0.0).all():
            raise ShapeError(f'{self.name}: time must increase strictly')


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Recording(BaseRecording):
    """
    Force and motion of the needle base during one experiment.

    Examples
    --------
    >>> velocity = [0.0, 0.01, 0.01]
    >>> recording = Recording(time=[0.0, 0.1, 0.2], velocity=velocity, force=[0.0, 3.5, 3.6])
    >>> recording
    <Recording recording: 3 samples in 0.2 s>
    >>> recording.depth.tolist()
    [0.0, 0.0005, 0.0015]

    """

    force: FloatArray  #: (n,) force of the base on the needle f_y [N], positive into the tissue
    #: (n,) insertion velocity [m/s], positive into the tissue; None for positions only.
    velocity: FloatArray | None = None
    #: (n,) insertion depth s [m]; default: integral of the velocity from zero.
    depth: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.velocity is not None:
            self._freeze(velocity=None)
            if self.depth is None:
                object.__setattr__(self, 'depth', integrated(self.time, self.velocity))
        elif self.depth is None:
            raise ShapeError(f'{self.name}: velocity or depth must be given')
        self._freeze(depth=None, force=None)

    def columns(self) -> dict[str, FloatArray]:
        known = {} if self.velocity is None else {'velocity [m/s]': self.velocity}
        return {'time [s]': self.time, 'depth [m]': self.depth, **known, 'force [N]': self.force}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class IndentationRecording(BaseRecording):
    """Force and motion of an end-effector that presses a tissue in the plane."""

    force: FloatArray  #: (n, 2) force of the end-effector on the tissue, x and z [N]
    position: FloatArray  #: (n, 2) position of the end-effector in the plane, x and z [m]
    #: (n,) position of the end-effector along the third axis [m]; default zero.
    off_plane: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.off_plane is None:
            object.__setattr__(self, 'off_plane', np.zeros(np.shape(self.time)))
        self._freeze(position=2, off_plane=None, force=2)

    def columns(self) -> dict[str, FloatArray]:
        (x, z), (force_x, force_z) = self.position.T, self.force.T
        return {
            'time [s]': self.time,
            'position_x [m]': x,
            'position_y [m]': self.off_plane,
            'position_z [m]': z,
            'force_x [N]': force_x,
            'force_z [N]': force_z,
        }


def integrated(time: FloatArray, velocity: FloatArray) -> FloatArray:
    """Integrate a velocity [m/s], (n,), from zero over time [s] (trapezoidal rule)."""
    steps = np.diff(time) * (velocity[1:] + velocity[:-1]) / 2.0
    return np.concatenate([[0.0], np.cumsum(steps)])


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
