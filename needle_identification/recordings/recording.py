"""What identification works on: one recording as arrays on one time base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from needle_dynamics import (
    FloatArray,
)
from needle_ros.errors import (
    ShapeError,
)
import numpy as np
import yaml


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """
    Force and motion of the needle base during one experiment.

    Attributes
    ----------
    name : str
        Where it comes from, for messages.
    time : ndarray, shape (n,)
        Time [s], strictly increasing.
    depth : ndarray, shape (n,)
        Inserted length s [m].
    speed : ndarray, shape (n,), or None
        Insertion speed s_dot [m/s], positive into the tissue; None if only positions were
        recorded, which whoever needs the speed differentiates.
    force : ndarray, shape (n,)
        Force of the base on the needle f_y [N], positive into the tissue.
    losses : tuple of str
        What was lost, left out or repaired on the way here, in words.
    configuration : str
        Parameter file of the plant that was recorded, ``''`` if there is none.
    clock_offset : float
        Clock of the force minus clock of the motion [s], estimated from the times of reception
        and already corrected; 0 if they agree as far as can be told.

    Raises
    ------
    ShapeError
        If the arrays differ in length, hold what is not finite, or time does not increase.

    """

    name: str
    time: FloatArray
    depth: FloatArray
    speed: FloatArray | None
    force: FloatArray
    losses: tuple[str, ...] = ()
    configuration: str = ''
    clock_offset: float = 0.0

    def __post_init__(self) -> None:
        _hold(self, time=(), depth=(), speed=(), force=())

    @property
    def truth(self) -> Mapping[str, Any] | None:
        """Parameters of the plant that was recorded, by name; None if it did not say."""
        return _truth(self.configuration)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndentationRecording:
    """
    Force and motion of an end-effector that presses a tissue in the plane.

    Attributes
    ----------
    name : str
        Where it comes from, for messages.
    time : ndarray, shape (n,)
        Time [s], strictly increasing.
    position : ndarray, shape (n, 2)
        Position of the end-effector in the plane, x and z [m].
    off_plane : ndarray, shape (n,)
        Its position along the third axis [m].
    force : ndarray, shape (n, 2)
        Force of the end-effector on the tissue, x and z [N].
    losses, configuration, clock_offset
        As those of a `Recording`.

    Raises
    ------
    ShapeError
        If the arrays differ in length, hold what is not finite, or time does not increase.

    """

    name: str
    time: FloatArray
    position: FloatArray
    off_plane: FloatArray
    force: FloatArray
    losses: tuple[str, ...] = ()
    configuration: str = ''
    clock_offset: float = 0.0

    def __post_init__(self) -> None:
        _hold(self, time=(), position=(2,), off_plane=(), force=(2,))

    @property
    def truth(self) -> Mapping[str, Any] | None:
        """Parameters of the plant that was recorded, by name; None if it did not say."""
        return _truth(self.configuration)


def _hold(recording: Recording | IndentationRecording, **shapes: tuple[int, ...]) -> None:
    """Replace the arrays of a recording by copies that cannot change, and check them."""
    name, length = recording.name, np.shape(recording.time)
    for field, rest in shapes.items():
        given = getattr(recording, field)
        if given is None and field == 'speed':
            continue
        values = np.array(given, dtype=np.float64)
        if len(length) != 1 or values.shape != length + rest:
            raise ShapeError(
                f'{name}: {field} must have the shape {_shape(rest)} with the (n,) of time, got '
                f'{values.shape} and {length}'
            )
        if not np.isfinite(values).all():
            raise ShapeError(f'{name}: {field} must be finite')
        values.setflags(write=False)
        object.__setattr__(recording, field, values)
    if not (np.diff(recording.time) > 0.0).all():
        raise ShapeError(f'{name}: time must increase strictly')


def _shape(rest: tuple[int, ...]) -> str:
    return f'(n, {rest[0]})' if rest else '(n,)'


def _truth(configuration: str) -> Mapping[str, Any] | None:
    try:
        document = yaml.safe_load(configuration)
    except (yaml.YAMLError, ValueError, RecursionError):
        return None
    if not isinstance(document, dict):
        return None
    for section in document.values():
        if isinstance(section, dict) and isinstance(section.get('ros__parameters'), dict):
            return dict(section['ros__parameters'])
    return None
