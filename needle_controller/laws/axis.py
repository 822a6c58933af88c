"""One axis as a sampled law sees it: a mass or oscillator, and the loop around a law on it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field, replace
from math import exp, isfinite
from typing import Final, NamedTuple

from needle_controller.compiled import laws as kernels
from needle_controller.compiled.laws import (
    law_force,
    law_match,
    law_remember,
    law_step,
)
from needle_dynamics import (
    FloatArray,
    NeedleParameters,
)
from needle_dynamics.compiled.kernels import decay_means, slide
from needle_ros.errors import (
    ParameterError,
)
import numpy as np

#: Coulomb friction is compensated in the direction of the speed that is wanted this much later
#: [s], or at the end of the period if that is longer: so a law breaks away at any rate.
BREAKAWAY_TIME: Final = 1e-3

#: Time constant with which a force taken over at a switch of laws fades [s].
HANDOVER_TIME: Final = 0.1


class Response(NamedTuple):
    """
    Linear response of an axis over a time, under a constant force.

    ``end position = position + pv speed + pf force`` and ``end speed = vv speed + vf force``.
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

    def response(self, t: float) -> Response:
        """Return the linear response over a time t [s] under a constant force, exactly."""
        x = self.viscous * t / self.inertia
        mean, ramp = decay_means(x)
        push = t / self.inertia
        return Response(mean * t, 1.0 - x * mean, ramp * t * push, mean * push)


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Where a reference is: position, speed and acceleration, in the units of its axis."""

    position: float
    speed: float = 0.0
    acceleration: float = 0.0


def _instant(position: float, speed: float, aim: Setpoint) -> kernels.Instant:
    """Return what a law answers to, as its compiled functions take it."""
    return float(position), float(speed), aim.position, aim.speed, aim.acceleration


def no_memory() -> FloatArray:
    """Return what a law remembers at the beginning."""
    return np.zeros(kernels.MEMORY)


def law_constants(period: float, breakaway_speed: float, **slots: float) -> FloatArray:
    """Return the constants that the compiled laws take, by the names of their slots."""
    c = np.zeros(kernels.CONSTANTS)
    c[kernels.PERIOD] = period
    c[kernels.BREAKAWAY] = breakaway_speed
    c[kernels.AHEAD] = max(period, BREAKAWAY_TIME)
    c[kernels.FADE] = exp(-period / HANDOVER_TIME)
    for name, value in slots.items():
        c[getattr(kernels, name)] = value
    return c


@dataclass(frozen=True, slots=True, kw_only=True)
class Law(ABC):
    """
    A sampled control law on one axis; what it remembers is kept by its loop.

    Attributes
    ----------
    axis : Axis
        Axis as the law believes it to be.
    period : float
        Sample period h [s].
    constants : ndarray, shape (CONSTANTS,)
        The law as the functions of `needle_controller.compiled.laws` take it.

    Notes
    -----
    ``memory`` is an array of shape (MEMORY,), see `no_memory`, that is written in place.

    """

    axis: Axis
    period: float
    constants: FloatArray = field(init=False, repr=False, compare=False)

    def _set_constants(self, breakaway_speed: float, **slots: float) -> None:
        response = self.axis.response(self.period)
        constants = law_constants(
            self.period,
            breakaway_speed,
            COULOMB=self.axis.coulomb,
            **{name.upper(): value for name, value in response._asdict().items()},
            **slots,
        )
        object.__setattr__(self, 'constants', constants)

    def force(
        self,
        position: float,
        speed: float,
        setpoint: Setpoint,
        memory: FloatArray,
        load: float = 0.0,
    ) -> float:
        """Return the force for the next period, before any limit; ``load`` is against it."""
        return law_force(self.constants, memory, _instant(position, speed, setpoint), load)

    def remember(
        self,
        position: float,
        speed: float,
        setpoint: Setpoint,
        memory: FloatArray,
        wanted: float,
        force: float,
    ) -> None:
        """Update the memory for a force that was wanted and the one that limits left."""
        law_remember(self.constants, memory, _instant(position, speed, setpoint), wanted, force)

    def match(
        self,
        position: float,
        speed: float,
        setpoint: Setpoint,
        memory: FloatArray,
        load: float,
        force: float,
    ) -> None:
        """Set the memory so that the next force is the given one: a switch without a bump."""
        law_match(self.constants, memory, _instant(position, speed, setpoint), load, force)

    def linear(self) -> Law:
        """Return the same law without Coulomb friction, for its poles."""
        return replace(self, axis=self.axis.without_coulomb())

    @abstractmethod
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
        self.memory = no_memory()
        self.last = 0.0
        self._take_over = False

    def stop(self) -> None:
        """Nothing is on the way any more; what the law remembers stays as it is."""
        for i in range(len(self.on_the_way)):
            self.on_the_way[i] = 0.0
        self.last = 0.0
        self._take_over = False

    def reset(self) -> None:
        """Forget the past: nothing on the way, nothing remembered."""
        self.stop()
        self.memory[:] = 0.0

    def switch(self, law: Law) -> None:
        """Go on with another law, or other gains: its first force is the last one again."""
        if law.period != self.law.period:
            raise ParameterError(
                f'the period must stay {self.law.period:g} s, got {law.period!r} s'
            )
        self.law = law
        self._take_over = True

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
        return self.answer(position, speed, setpoint, load)

    def answer(
        self, position: float, speed: float, setpoint: Setpoint, load: float = 0.0
    ) -> float:
        """Do what `command` does, from the state when the command takes effect."""
        if self._take_over:
            self._take_over = False
            self.law.match(position, speed, setpoint, self.memory, load, self.last)
        self.last = force = law_step(
            self.law.constants,
            self.memory,
            position,
            speed,
            setpoint.position,
            setpoint.speed,
            setpoint.acceleration,
            load,
            self.limit,
        )
        self.on_the_way.append(force)
        return force
