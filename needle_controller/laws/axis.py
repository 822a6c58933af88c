"""One axis as a sampled law sees it: a mass with friction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite
from typing import NamedTuple

from needle_dynamics import NeedleParameters
from needle_dynamics.compiled.friction import slide
from needle_dynamics.compiled.oscillator import decay_means
from needle_ros.errors import ParameterError


def require_complete(parameters: NeedleParameters) -> None:
    """
    Reject the formulation `as_printed`, which is for the model and the integrator only.

    Parameters
    ----------
    parameters : NeedleParameters
        The needle.

    Raises
    ------
    ParameterError
        If its formulation is not `complete`.

    """
    if parameters.formulation != 'complete':
        raise ParameterError(
            "formulation must be 'complete' for controller and observer, got "
            f'{parameters.formulation!r}'
        )


class Response(NamedTuple):
    """
    Linear response of an axis over a time, under a constant force.

    ``end position = position + pv speed + pf force`` and ``end speed = vv speed + vf force``.

    Attributes
    ----------
    pv, vv : float
        Response to the speed [s], [1].
    pf, vf : float
        Response to the force [m/N], [m/(N s)], or in angles and torques.

    """

    pv: float
    vv: float
    pf: float
    vf: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """
    Insertion (SI: kg, N, N s/m) or rotation (kg m^2, N m, N m s).

    Attributes
    ----------
    inertia, coulomb, viscous : float
        Inertia, Coulomb friction mu_s and viscous friction mu_v.

    Raises
    ------
    ParameterError
        If a value is not finite or negative, or the inertia is zero.

    """

    inertia: float
    coulomb: float = 0.0
    viscous: float = 0.0

    def __post_init__(self) -> None:
        for name in ('inertia', 'coulomb', 'viscous'):
            value = getattr(self, name)
            if not (isfinite(value) and value >= 0.0) or (name == 'inertia' and value == 0.0):
                sign = '>' if name == 'inertia' else '>='
                raise ParameterError(f'{name} must be finite and {sign} 0, got {value!r}')

    @classmethod
    def insertion(cls, parameters: NeedleParameters) -> Axis:
        """
        Return the insertion axis of a needle, first row of (16).

        Parameters
        ----------
        parameters : NeedleParameters
            The needle.

        Returns
        -------
        Axis
            Its moving mass [kg] and friction.

        """
        return cls(
            inertia=parameters.moving_mass,
            coulomb=parameters.coulomb_friction,
            viscous=parameters.viscous_friction,
        )

    @classmethod
    def rotation(cls, parameters: NeedleParameters) -> Axis:
        """
        Return the rotation axis of a needle, second row of (16), without friction.

        Parameters
        ----------
        parameters : NeedleParameters
            The needle.

        Returns
        -------
        Axis
            Its rotary inertia [kg m^2].

        """
        return cls(inertia=0.5 * parameters.rotary_inertia)

    def without_coulomb(self) -> Axis:
        """Return the axis without Coulomb friction."""
        return replace(self, coulomb=0.0)

    def propagate(
        self, position: float, speed: float, force: float, t: float
    ) -> tuple[float, float]:
        """
        Solve the motion under a constant force, exactly.

        Parameters
        ----------
        position, speed : float
            State at the beginning.
        force : float
            Force [N].
        t : float
            Time [s].

        Returns
        -------
        position, speed : float
            State at the end.

        """
        end, moved = slide(speed, force, self.inertia, self.coulomb, self.viscous, t)
        return position + moved, end

    def response(self, t: float) -> Response:
        """
        Return the linear response over a time [s], exactly.

        Parameters
        ----------
        t : float
            Time [s].

        Returns
        -------
        Response
            The response to a speed and to a constant force.

        """
        x = self.viscous * t / self.inertia
        mean, ramp = decay_means(x)
        push = t / self.inertia
        return Response(mean * t, 1.0 - x * mean, ramp * t * push, mean * push)
