"""Friction between needle and tissue along the insertion axis, including equation (15)."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from needle_dynamics.compiled.friction import (
    dry_friction,
    friction_force,
    FRICTION_LAWS,
    FrictionConstants,
)
from needle_ros.errors import ParameterError
from needle_ros.settings import check_choice


@dataclass(frozen=True, slots=True, kw_only=True)
class Friction:
    """
    A friction law with its constants; the defaults are those in (15).

    Only the laws listed here exist: the integrator step is compiled and cannot call a Python
    object. To add a law, add a branch to `dry_friction` in
    ``needle_dynamics/compiled/friction.py``, which documents the steps.

    Attributes
    ----------
    law : str
        ``coulomb``: dry friction mu_s, set-valued at rest. ``stribeck``: decreases from the
        break-away value at rest to mu_s, set-valued at rest. ``tanh``: smooth through zero
        velocity; a needle at rest creeps.
    coulomb, viscous : float
        Coulomb friction mu_s [N]; viscous friction mu_v [N s/m].
    withdrawal : float
        Ratio of friction on withdrawal to friction on insertion.
    breakaway : float
        Ratio of friction at rest to mu_s (``stribeck``).
    stribeck_speed : float
        Speed scale over which friction decreases to mu_s [m/s] (``stribeck``).
    smoothing_speed : float
        Speed scale over which friction changes sign [m/s] (``tanh``).

    Raises
    ------
    ParameterError
        If the law is unknown or a constant is outside its range.

    """

    law: str = 'coulomb'
    coulomb: float
    viscous: float
    withdrawal: float = 1.0
    breakaway: float = 1.0
    stribeck_speed: float = 1e-3
    smoothing_speed: float = 1e-4

    def __post_init__(self) -> None:
        check_choice('law', self.law, FRICTION_LAWS)
        least = {'coulomb': 0.0, 'viscous': 0.0, 'withdrawal': 0.0, 'breakaway': 1.0}
        for name, low in least.items():
            value = getattr(self, name)
            if not low <= value < inf:
                raise ParameterError(f'{name} must be finite and >= {low:g}, got {value!r}')
        for name in ('stribeck_speed', 'smoothing_speed'):
            value = getattr(self, name)
            if not 0.0 < value < inf:
                raise ParameterError(f'{name} must be finite and > 0 m/s, got {value!r}')

    @property
    def constants(self) -> FrictionConstants:
        """Constants in the layout of the compiled functions."""
        return FrictionConstants(
            FRICTION_LAWS.index(self.law),
            float(self.coulomb),
            float(self.viscous),
            float(self.withdrawal),
            float(self.breakaway),
            float(self.stribeck_speed),
            float(self.smoothing_speed),
        )

    def force(self, velocity: float, drive: float) -> float:
        """
        Evaluate the friction force on the needle.

        Parameters
        ----------
        velocity : float
            Insertion velocity s_dot [m/s], positive into the tissue.
        drive : float
            Sum of the other forces [N], positive into the tissue; used at rest.

        Returns
        -------
        float
            Force [N], positive against insertion.

        """
        return friction_force(self.constants, float(velocity), float(drive))

    def slope(self, velocity: float, direction: float) -> float:
        """
        Evaluate the derivative of the friction force with respect to the insertion velocity.

        Parameters
        ----------
        velocity : float
            Insertion velocity [m/s].
        direction : float
            Side of zero velocity: positive for insertion, otherwise withdrawal.

        Returns
        -------
        float
            Derivative [N s/m].

        """
        _, dry = dry_friction(self.constants, float(self.coulomb), abs(float(velocity)))
        return (1.0 if direction > 0.0 else self.withdrawal) * (self.viscous + dry)
