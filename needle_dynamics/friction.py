"""Friction between needle and tissue along the insertion axis: equation (15) and beyond."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf, tanh
from typing import Final

from needle_ros.errors import (
    ParameterError,
)
import numpy as np

#: Laws by name, in the order of their numbers in `needle_dynamics.compiled.kernels`.
FRICTION_LAWS: Final = ('coulomb', 'stribeck', 'tanh')


@dataclass(frozen=True, slots=True, kw_only=True)
class Friction:
    """
    A friction law; the defaults of all but its two coefficients are those of (15).

    Attributes
    ----------
    law : str
        ``coulomb``: dry friction mu_s, set-valued at rest. ``stribeck``: from the break-away
        value at rest down to mu_s, set-valued at rest. ``tanh``: smooth through zero; it creeps.
    coulomb, viscous : float
        Coulomb friction mu_s [N] and viscous friction mu_v [N s/m].
    withdrawal : float
        Friction on withdrawal over that on insertion.
    breakaway : float
        Friction at rest over mu_s (``stribeck``).
    stribeck_speed : float
        Speed over which it falls to mu_s [m/s].
    smoothing_speed : float
        Speed over which ``tanh`` turns [m/s].

    """

    law: str = 'coulomb'
    coulomb: float
    viscous: float
    withdrawal: float = 1.0
    breakaway: float = 1.0
    stribeck_speed: float = 1e-3
    smoothing_speed: float = 1e-4

    def __post_init__(self) -> None:
        if self.law not in FRICTION_LAWS:
            raise ParameterError(
                f'law must be one of {", ".join(FRICTION_LAWS)}, got {self.law!r}'
            )
        least = {'coulomb': 0.0, 'viscous': 0.0, 'withdrawal': 0.0, 'breakaway': 1.0}
        for name, low in least.items():
            value = getattr(self, name)
            if not low <= value < inf:
                raise ParameterError(f'{name} must be finite and >= {low:g}, got {value!r}')
        for name in ('stribeck_speed', 'smoothing_speed'):
            value = getattr(self, name)
            if not 0.0 < value < inf:
                raise ParameterError(f'{name} must be finite and > 0 m/s, got {value!r}')

    def force(self, speed: float, drive: float) -> float:
        """
        Friction force on the needle.

        Parameters
        ----------
        speed : float
            Insertion speed s_dot [m/s], positive into the tissue.
        drive : float
            Sum of the other forces [N], positive into the tissue; it decides at rest.

        Returns
        -------
        float
            Force [N], positive against insertion.

        """
        if speed == 0.0:
            bearable = self.coulomb * (self.breakaway if self.law == 'stribeck' else 1.0)
            if self.law == 'tanh':
                return 0.0
            return float(np.clip(drive, -self.withdrawal * bearable, bearable))
        dry = self.coulomb
        if self.law == 'stribeck':
            dry *= 1.0 + (self.breakaway - 1.0) * exp(-((speed / self.stribeck_speed) ** 2))
        elif self.law == 'tanh':
            dry *= tanh(abs(speed) / self.smoothing_speed)
        force = dry * np.sign(speed) + self.viscous * speed
        return float(force if speed > 0.0 else self.withdrawal * force)
