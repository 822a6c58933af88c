# SPDX-License-Identifier: Apache-2.0
"""Construction of a simulated plant from the parameters of a node or a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Final

from needle_dynamics.model import NeedleModel
from needle_dynamics.needles import find_needle
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.base import BaseMotion, BaseParameters
from needle_dynamics.simulated.commands import JointCommands
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters, HIGHEST_RATE
from needle_dynamics.simulated.indenter import Indenter, IndenterParameters
from needle_dynamics.simulated.integrator import Integrator
from needle_dynamics.simulated.plant import Plant, SimulatedPlant
from needle_dynamics.simulated.steered import GuideParameters, SteeredPlant
from needle_dynamics.simulated.tip_sensor import TipParameters, TipSensor
from needle_dynamics.steering.insertion import Insertion
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.errors import ParameterError
from needle_ros.sample_clock import SampleClock
from needle_ros.settings import (
    check_choice,
    check_constants,
    check_whole,
    constant,
    from_values,
    LARGEST_SEED,
    positive,
)

#: Modes: needle under force commands, needle moved by a robot, indenter.
MODES: Final = ('simulation', 'robot', 'indenter')


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantSettings:
    """Timing, initial state and limits of a simulated plant."""

    rate: float = constant(
        1000.0, 'Hz', 'samples per second of simulated time', low=1.0, high=HIGHEST_RATE
    )
    real_time_factor: float = constant(
        1.0, '1', "simulated seconds per second of the node's clock; 0: as fast as possible",
        high=100.0,
    )  # fmt: skip
    depth: float = positive(0.02, 'm', 'initial insertion depth')
    tip_deflection: float = constant(0.0, 'm', 'initial tip deflection', low=-0.1, high=0.1)
    modal: tuple[float, ...] = constant(
        (), 'm^3/2', 'initial q1 to qn, instead of tip_deflection', low=-1.0, high=1.0
    )
    step: float = constant(2e-5, 's', 'longest step of the integrator', low=1e-7, high=1e-2)
    command_timeout: float = positive(0.1, 's', 'age at which a command expires')
    force_limit: float = constant(15.0, 'N', 'largest commanded force')
    torque_limit: float = constant(1.0, 'N m', 'largest commanded torque')
    force_rate_limit: float = positive(
        3e4, 'N/s', 'largest growth rate of a commanded force; it may end at once'
    )
    power_limit: float = positive(1.5, 'W', 'largest energy supplied by commands within a second')
    backlog: float = positive(
        0.05, 's', 'longest stall after which all samples are still computed'
    )

    def __post_init__(self) -> None:
        check_constants(self)


#: Parameters by namespace, as settings with default values.
SETTINGS: Final[Mapping[str, Any]] = {
    '': PlantSettings(),
    'model.': NeedleParameters(),
    'sensor.': ForceSensorParameters(),
    'tip.': TipParameters(),
    'base.': BaseParameters(),
    'indenter.': IndenterParameters(),
    'steering.': SteeringParameters(),
    'guide.': GuideParameters(),
}


def defaults_of(prefix: str, needle: str) -> Any:
    """Return the default settings of a namespace in `SETTINGS` for the parameter ``needle``."""
    if prefix == 'model.':
        return find_needle(needle).needle
    return find_needle(needle).steering if prefix == 'steering.' else SETTINGS[prefix]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantConstants:
    """All constants of a simulated plant."""

    mode: str  #: one of `MODES`
    seed: int  #: seed of all noise
    steered: bool  #: whether the needle bends and cuts its own path
    own: PlantSettings  #: timing, initial state and limits
    model: NeedleParameters  #: needle and tissue
    sensor: ForceSensorParameters  #: force sensor
    tip: TipParameters  #: tip sensor
    base: BaseParameters  #: robot of mode `robot`
    indenter: IndenterParameters  #: tissue and robot of mode `indenter`
    steering: SteeringParameters  #: additional constants of a steered needle
    guide: GuideParameters  #: robot of the needle guide

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> PlantConstants:
        """Read the constants from parameters by name; defaults are of the parameter ``needle``."""
        mode, needle = values.get('mode', MODES[0]), values.get('needle', 'paper_si')
        check_choice('mode', mode, MODES)
        made = {}
        for prefix, defaults in SETTINGS.items():
            names = {item.name: f'{prefix}{item.name}' for item in fields(defaults)}
            given = {name: values[full] for name, full in names.items() if full in values}
            given = {**asdict(defaults_of(prefix, needle)), **given}
            made[prefix.rstrip('.') or 'own'] = from_values(type(defaults), given, prefix)
        seed = values.get('seed', 1)
        check_whole('seed', seed, 0, LARGEST_SEED)
        steered = values.get('steered', False)
        if not isinstance(steered, bool):
            raise ParameterError(f'steered must be true or false, got {steered!r}')
        if steered and mode == 'indenter':
            raise ParameterError('steered must be false in mode indenter: there is no needle')
        return cls(mode=mode, seed=seed, steered=steered, **made)

    def make(self) -> SimulatedPlant:
        """Build the plant in its initial state: a `Plant`, a `SteeredPlant` or an `Indenter`."""
        own, rate = self.own, self.own.rate
        sensor = ForceSensor(self.sensor, rate, self.seed)
        tip = TipSensor(self.tip, rate, self.seed, spatial=self.steered)
        if self.mode == 'indenter':
            return Indenter(self.indenter, sensor, rate, self.seed, own.force_limit)
        if self.steered:
            return self._steered(sensor, tip)
        state = NeedleModel(self.model).state_at(own.depth, own.tip_deflection, own.modal)
        integrator = Integrator(self.model, state, own.step)
        return Plant(integrator, sensor, rate, self._base(self.model.length), tip)

    def joint_commands(self) -> JointCommands:
        own = self.own
        return JointCommands(
            self.mode, steered=self.steered, shortest=1.0 / own.rate, longest=own.command_timeout
        )

    def _steered(self, sensor: ForceSensor, tip: TipSensor) -> SteeredPlant:
        own = self.own
        if own.tip_deflection or own.modal:
            raise ParameterError(
                'tip_deflection must be 0 and modal empty for a steered needle: it starts straight'
            )
        insertion = Insertion(
            self.model, self.steering, depth=own.depth, step=own.step, seed=self.seed
        )
        # Less than the hub depth, which a robot must not reach.
        base = self._base(insertion.axis.reach - self.model.minimum_depth)
        return SteeredPlant(insertion, sensor, tip, own.rate, self.guide, self.base, base)

    def _base(self, deepest: float) -> BaseMotion | None:
        if self.mode != 'robot':
            return None
        depths = self.model.minimum_depth, deepest
        return BaseMotion(self.base, self.own.depth, depths, self.own.force_limit)


def build_sample_clock(
    constants: PlantConstants, *, lockstep: bool, publish_clock: bool, use_sim_time: bool
) -> SampleClock:
    """Return the clock of a plant; reject settings that contradict each other."""
    own, mode = constants.own, constants.mode
    publishes = lockstep or publish_clock
    if publishes and use_sim_time:
        raise ParameterError(
            f'{"lockstep" if lockstep else "publish_clock"} and use_sim_time cannot both be '
            'true: the plant would follow its own /clock'
        )
    if lockstep and mode != 'simulation':
        raise ParameterError(
            'lockstep must be false except in mode simulation, where commands answer samples, '
            f'got mode {mode!r}'
        )
    if mode == 'simulation' and own.command_timeout < 1.0 / own.rate:
        raise ParameterError(
            f'command_timeout must be at least a period, {1.0 / own.rate:g} s, got '
            f'{own.command_timeout:g} s'
        )
    real_time = not publishes and own.real_time_factor == 1.0
    if mode == 'simulation' and real_time and own.backlog > 0.5 * own.command_timeout:
        raise ParameterError(
            f'backlog must be at most half of command_timeout, {own.command_timeout:g} s, got '
            f'{own.backlog:g} s: an overloaded plant would send samples that are too old to '
            'answer'
        )
    return SampleClock(
        own.rate, own.real_time_factor, own.backlog, own=publishes, lockstep=lockstep
    )
