"""A plant from its constants, whoever runs it: the node, or a recorded run computed anew."""

from __future__ import annotations

from typing import Final

from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.simulated.indenter import Indenter, IndenterParameters
from needle_dynamics.simulated.integrators import Integrator
from needle_dynamics.simulated.plant import (
    BaseMotion,
    BaseParameters,
    Plant,
    TipParameters,
    TipSensor,
)

#: What a plant stands in for.
MODES: Final = ('simulation', 'robot', 'indenter')


def assemble(
    mode: str,
    *,
    rate: float,
    seed: int,
    step: float,
    depth: float,
    tip_deflection: float,
    force_limit: float,
    model: NeedleParameters,
    sensor: ForceSensorParameters,
    tip: TipParameters,
    base: BaseParameters,
    indenter: IndenterParameters,
) -> Plant | Indenter:
    """
    Make a plant at its start.

    Parameters
    ----------
    mode : str
        One of `MODES`.
    rate : float
        Samples per second [Hz].
    seed : int
        Seed of all noise.
    step : float
        Longest step of the integrator [s].
    depth, tip_deflection : float
        Inserted length and deflection of the tip at the start [m].
    force_limit : float
        Largest force of a push or press [N].
    model, sensor, tip, base, indenter
        Constants.

    Raises
    ------
    ParameterError
        If they do not go together.
    InsertedLengthError
        If the needle cannot be there.

    """
    felt = ForceSensor(sensor, rate, seed)
    seen = TipSensor(tip, rate, seed)
    if mode == 'indenter':
        return Indenter(indenter, felt, rate, seed, force_limit)
    state = NeedleModel(model).state_at(depth, tip_deflection)
    reach = model.minimum_depth, model.length
    carried = BaseMotion(base, depth, reach, force_limit) if mode == 'robot' else None
    return Plant(Integrator(model, state, step), felt, rate, carried, seen)
