"""One actuated axis as a sampled law sees it: a mass under viscous and Coulomb friction."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Protocol

from needle_dynamics import NeedleParameters
from needle_dynamics.kernels import decay_means, slide


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """
    Insertion (SI: kg, N, N s/m) or rotation (kg m^2, N m, N m s) with its friction.

    Attributes
    ----------
    inertia, coulomb, viscous : float
        Inertia, Coulomb friction mu_s and viscous friction mu_v.

    """

    inertia: float
    coulomb: float = 0.0
    viscous: float = 0.0

    @classmethod
    def insertion(cls, parameters: NeedleParameters) -> Axis:
        """Return the insertion axis, first row of (16)."""
        return cls(
            inertia=parameters.moving_mass,
            coulomb=parameters.coulomb_friction,
            viscous=parameters.viscous_friction,
        )

    @classmethod
    def rotation(cls, parameters: NeedleParameters) -> Axis:
        """Return the rotation axis, second row of (16)."""
        return cls(inertia=0.5 * parameters.rotary_inertia)

    def without_coulomb(self) -> Axis:
        """Return the linear part of the axis."""
        return replace(self, coulomb=0.0)

    def propagate(
        self, position: float, speed: float, force: float, t: float
    ) -> tuple[float, float]:
        """Return position and speed after a constant force for a time t [s], exactly."""
        end, moved = slide(speed, force, self.inertia, self.coulomb, self.viscous, t)
        return position + moved, end

    def response(self, t: float) -> tuple[float, float, float, float]:
        """
        Return the linear response over a time t [s] under a constant force.

        Returns
        -------
        tuple of float
            ``(decay, speed, drift, shift)`` with ``end = decay u + speed f`` for the speed and
            ``moved = drift u + shift f`` for the displacement.

        """
        x = self.viscous * t / self.inertia
        mean, ramp = decay_means(x)
        push = t / self.inertia
        return 1.0 - x * mean, mean * push, mean * t, ramp * t * push


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Where a reference is: position, speed and acceleration, in the units of its axis."""

    position: float
    speed: float = 0.0
    acceleration: float = 0.0


class Law(Protocol):
    """A sampled control law on one axis; what it remembers is passed in and out."""

    @property
    def axis(self) -> Axis:
        """The axis as the law believes it to be."""

    @property
    def period(self) -> float:
        """Sample period [s]."""

    def force(
        self, position: float, speed: float, setpoint: Setpoint, memory: float, load: float
    ) -> float:
        """Return the force for the next period, before any limit."""

    def remember(self, memory: float, position: float, setpoint: Setpoint, excess: float) -> float:
        """Return the new memory; ``excess`` is the force that a limit took away."""

    def linear(self) -> Law:
        """Return the same law without Coulomb friction, for its poles."""

    def scaled(self, factor: float) -> Law:
        """Return the same law with all gains times a factor."""


class SampledLoop:
    """
    A law with what the graph adds: delay and a force limit.

    A command computed from a measurement takes effect ``delay`` periods later. The law acts on
    the state predicted for then from the commands that are still on their way.

    Parameters
    ----------
    law : Law
        Control law.
    delay : int
        Periods from measurement to effect.
    limit : float
        Largest force.

    """

    def __init__(self, law: Law, delay: int, limit: float) -> None:
        self.law = law
        self.limit = limit
        self.on_the_way: deque[float] = deque([0.0] * delay, maxlen=delay)
        self.memory = 0.0

    def reset(self) -> None:
        """Forget the past: nothing on the way, nothing remembered."""
        for i in range(len(self.on_the_way)):
            self.on_the_way[i] = 0.0
        self.memory = 0.0

    def command(
        self, position: float, speed: float, setpoint: Setpoint, load: float = 0.0
    ) -> float:
        """
        Return the force to apply.

        Parameters
        ----------
        position, speed : float
            Measured now.
        setpoint : Setpoint
            Reference at the time the command takes effect.
        load : float
            Other known force against the motion.

        Returns
        -------
        float
            Force within the limit.

        """
        law = self.law
        for force in self.on_the_way:
            position, speed = law.axis.propagate(position, speed, force - load, law.period)
        wanted = law.force(position, speed, setpoint, self.memory, load)
        force = min(max(wanted, -self.limit), self.limit)
        self.memory = law.remember(self.memory, position, setpoint, wanted - force)
        self.on_the_way.append(force)
        return force
