# SPDX-License-Identifier: Apache-2.0
"""Model of one axis, sampled control laws on it, and their loop with delay, limit and memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from math import exp, inf, nan, sqrt
from typing import Any, ClassVar, Final, NamedTuple

from needle_controller.compiled.laws import (
    answer,
    BLOCK,
    FOLLOWS,
    law_force,
    LawConstants,
    LEARNED,
    MEASURED,
    MEMORY,
    TERMS,
)
from needle_controller.reference.setpoint import Setpoint
from needle_dynamics import FloatArray, Friction, NeedleParameters
from needle_dynamics.compiled.friction import decay_means, friction_flow
from needle_ros.errors import ParameterError
from needle_ros.settings import checked, CheckedSettings, constant
import numpy as np

#: Coulomb friction is compensated in the direction of the desired velocity this much later [s], or
#: at the end of the period if this is longer: a law then breaks away at any sample rate.
BREAKAWAY_TIME: Final = 1e-3

HANDOVER_TIME: Final = 0.1  #: Time constant of the force offset after a switch of laws [s].

#: Learned corrections with units, in the order of `needle_controller.compiled.laws`.
_TERMS: Final = {
    'dry friction': 'N',
    'viscous friction': 'N s/m',
    'dry friction per length': 'N/m',
}


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
    coulomb: float = constant(0.0, 'N', 'Coulomb friction mu_s')
    viscous: float = constant(0.0, 'N s/m', 'viscous friction mu_v')

    def __post_init__(self) -> None:
        # Without arguments, super does not work in a dataclass with slots.
        Friction.__post_init__(self)
        checked('inertia', self.inertia, low=0.0, open_low=True)

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


def no_memory() -> FloatArray:
    return np.zeros(MEMORY)


@dataclass(frozen=True, slots=True, kw_only=True)
class LawGains(CheckedSettings):
    """Gains of a law on one axis."""

    def scaled(self, factor: float) -> LawGains:
        """Return a copy with kp, ki, kd, kv and bandwidth multiplied by a positive factor."""
        scales = ('kp', 'ki', 'kd', 'kv', 'bandwidth')
        gains = [item.name for item in fields(self) if item.name in scales]
        return replace(self, **{name: factor * getattr(self, name) for name in gains})


@dataclass(frozen=True, slots=True, kw_only=True)
class Law:
    """Sampled control law on one axis; its memory is stored by its loop."""

    LINEAR: ClassVar[Mapping[str, Any]] = {}  #: Gains that make the law linear.

    axis: Axis  #: nominal model of the axis
    gains: LawGains
    period: float  #: sample period h [s]
    #: Constants for compiled functions, and the same as a plain tuple.
    constants: LawConstants = field(init=False, repr=False, compare=False)
    packed: tuple[float, ...] = field(init=False, repr=False, compare=False)

    def _set_constants(self, breakaway_speed: float, **gains: float) -> None:
        unused = ('model_kp', 'model_kv', 'filter_time', 'tracking', 'feed_forward', 'bound')
        friction = self.axis.constants._asdict()
        back = self.axis.response(self.period, self.axis.withdrawal)._asdict()
        values: dict[str, Any] = {
            **dict.fromkeys(unused, 0.0),
            'noise': inf,
            **self.axis.response(self.period)._asdict(),
            **{f'back_{name}': value for name, value in back.items()},
            **friction,
            'friction_law': friction.pop('law'),
            'inertia': self.axis.inertia,
            'period': self.period,
            'breakaway_speed': breakaway_speed,
            'ahead': max(self.period, BREAKAWAY_TIME),
            'fade': exp(-self.period / HANDOVER_TIME),
            **gains,
        }
        del values['law']
        constants = LawConstants(**{name: float(value) for name, value in values.items()})
        object.__setattr__(self, 'constants', constants)
        object.__setattr__(self, 'packed', tuple(constants))

    def force(
        self,
        position: float,
        velocity: float,
        setpoint: Setpoint,
        memory: FloatArray,
        load: float = 0.0,
    ) -> float:
        """
        Return the force for the next period, before any limit [N].

        The memory, shape (MEMORY,), is as from `no_memory`; ``load`` is a known force against the
        motion [N].
        """
        return law_force(self.packed, memory, _instant(position, velocity, setpoint), float(load))

    def linear(self) -> Law:
        """Return the law for its poles: without Coulomb friction, and with the gains `LINEAR`."""
        gains = replace(self.gains, **self.LINEAR)
        return replace(self, axis=self.axis.without_coulomb(), gains=gains)

    def scaled(self, factor: float) -> Law:
        """Return the law with all gains multiplied by a positive factor."""
        return replace(self, gains=self.gains.scaled(factor))


def _instant(position: float, velocity: float, setpoint: Setpoint) -> tuple[float, ...]:
    return float(position), float(velocity), *setpoint


class SampledLoop:
    """
    Sampled law with delay compensation and a force limit [N].

    A command computed from a measurement takes effect ``delay`` periods later. The law uses the
    state predicted for this time from the pending commands.
    """

    def __init__(self, law: Law, delay: int, limit: float) -> None:
        self.law = law
        self.limit = float(limit)
        #: Force of the last period, and a view of the commands without effect so far [N].
        self._forces = np.zeros(1 + delay)
        self.pending = self._forces[1:]
        self.memory = no_memory()
        self.last = 0.0  #: Last command [N].
        self._take_over = False

    def stop(self, acts: float = 0.0) -> None:
        """Replace pending commands by a force that acts [N]; discard the modeled motion."""
        self.pending[:] = acts
        self.memory[FOLLOWS] = self.memory[MEASURED] = 0.0
        self.last = 0.0
        self._take_over = False

    def reset(self) -> None:
        """Discard the pending commands and the memory."""
        self.stop()
        self.memory[:] = 0.0

    def switch(self, law: Law) -> None:
        """Continue with another law of the same period; its first force equals the last force."""
        if law.period != self.law.period:
            raise ParameterError(
                f'the period must stay {self.law.period:g} s, got {law.period!r} s'
            )
        if law.axis != self.law.axis:
            # The learned friction is relative to the previous axis model.
            self.memory[LEARNED:] = 0.0
        self.law = law
        self._take_over = True

    @property
    def learned(self) -> dict[str, tuple[float, float]]:
        """Learned friction beyond the model and its standard deviation, by name with unit."""
        if self.law.constants.bound == 0.0:
            return {}
        blocks = self.memory[LEARNED:].reshape(2, BLOCK)
        return {
            f'{term}, {direction} [{unit}]': (float(block[i]), sqrt(float(variance)))
            for direction, block in zip(('insertion', 'withdrawal'), blocks, strict=True)
            for i, (term, unit) in enumerate(_TERMS.items())
            if (variance := block[TERMS + i * (TERMS + 1)]) > 0.0
        }

    def unwind(self) -> None:
        """Discard pending commands, integrals and the modeled motion; see `stop`."""
        self.stop()
        self.memory[:LEARNED] = 0.0

    def command(
        self, position: float, velocity: float, setpoint: Setpoint, load: float = 0.0
    ) -> float:
        """
        Return the force to apply, within the limit [N] or [N m]; see `Law.force`.

        Position and velocity are measured now; the setpoint is for the effect of the command.
        """
        self.last = force = answer(
            self.law.packed, self.memory, self._forces, _instant(position, velocity, setpoint),
            float(load), self.limit, self.last if self._take_over else nan,
        )  # fmt: skip
        self._take_over = False
        return force
