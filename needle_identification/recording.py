"""What identification works on: one recording as arrays on one time base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from needle_dynamics import FloatArray, ShapeError
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
    speed : ndarray, shape (n,)
        Insertion speed s_dot [m/s], positive into the tissue.
    force : ndarray, shape (n,)
        Force of the base on the needle f_y [N], positive into the tissue.
    losses : tuple of str
        What was lost, left out or repaired on the way here, in words.
    configuration : str
        Parameter file of the plant that was recorded, ``''`` if there is none.

    Raises
    ------
    ShapeError
        If the arrays differ in length, hold what is not finite, or time does not increase.

    """

    name: str
    time: FloatArray
    depth: FloatArray
    speed: FloatArray
    force: FloatArray
    losses: tuple[str, ...] = ()
    configuration: str = ''

    def __post_init__(self) -> None:
        for field in ('time', 'depth', 'speed', 'force'):
            values = np.array(getattr(self, field), dtype=np.float64)
            if values.shape != np.shape(self.time) or values.ndim != 1:
                raise ShapeError(
                    f'{self.name}: {field} must have the shape (n,) of time, got {values.shape} '
                    f'and {np.shape(self.time)}'
                )
            if not np.isfinite(values).all():
                raise ShapeError(f'{self.name}: {field} must be finite')
            values.setflags(write=False)
            object.__setattr__(self, field, values)
        if not (np.diff(self.time) > 0.0).all():
            raise ShapeError(f'{self.name}: time must increase strictly')

    @property
    def truth(self) -> Mapping[str, Any] | None:
        """Parameters of the plant that was recorded, by name; None if it did not say."""
        try:
            document = yaml.safe_load(self.configuration)
        except yaml.YAMLError:
            return None
        if not isinstance(document, dict):
            return None
        for section in document.values():
            if isinstance(section, dict) and isinstance(section.get('ros__parameters'), dict):
                return dict(section['ros__parameters'])
        return None
