# SPDX-License-Identifier: Apache-2.0
"""Model of one axis in a sampled law: a mass with friction."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from math import inf
from typing import NamedTuple

from needle_dynamics import Friction, NeedleParameters
from needle_dynamics.compiled.friction import friction_flow
from needle_dynamics.compiled.oscillator import decay_means
from needle_ros.errors import ParameterError


def require_complete(parameters: NeedleParameters) -> None:
    if parameters.formulation != 'complete':
        raise ParameterError(
            "formulation must be 'complete' for controller and observer, got "
            f'{parameters.formulation!r}'
        )


class Response(NamedTuple):
    """
    Linear response of an axis over a time, under a constant force.

    Final position = position + pv velocity + pf force, final velocity = vv velocity + vf force;
    for rotation these are angles and torques.
    """

    pv: float  #: [s]
    vv: float  #: [1]
    pf: float  #: [m/N]
    vf: float  #: [m/(N s)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis(Friction):
    """Insertion (SI: kg, N, N s/m) or rotation (kg m^2, N m, N m s): a mass with friction."""

    inertia: float  #: [kg] or [kg m^2]
    coulomb: float = 0.0
    viscous: float = 0.0

    def __post_init__(self) -> None:
        # Without arguments, super does not work in a dataclass with slots.
        Friction.__post_init__(self)
        if not 0.0 < self.inertia < inf:
            raise ParameterError(f'inertia must be finite and > 0, got {self.inertia!r}')

    @classmethod
    def insertion(cls, parameters: NeedleParameters) -> Axis:
        """Return moving mass [kg] and friction of the insertion axis, row 1 of (16)."""
        return cls(inertia=parameters.moving_mass, **asdict(parameters.friction))

    @classmethod
    def rotation(cls, parameters: NeedleParameters) -> Axis:
        """Return the rotary inertia [kg m^2] of the frictionless rotation axis, row 2 of (16)."""
        return cls(inertia=0.5 * parameters.rotary_inertia)

    def without_coulomb(self) -> Axis:
        return replace(self, coulomb=0.0)

    def propagate(
        self, position: float, velocity: float, force: float, t: float
    ) -> tuple[float, float]:
        """Return position and velocity after a time t [s] under a constant force [N], exactly."""
        end, moved = friction_flow(self.constants, self.inertia, velocity, force, t)
        return position + moved, end

    def response(self, t: float, factor: float = 1.0) -> Response:
        """Return the exact linear response over a time [s], with a factor on viscous friction."""
        x = factor * self.viscous * t / self.inertia
        mean, ramp = decay_means(x)
        push = t / self.inertia
        return Response(mean * t, 1.0 - x * mean, ramp * t * push, mean * push)
