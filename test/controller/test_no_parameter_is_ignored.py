# SPDX-License-Identifier: Apache-2.0
"""Every parameter has effect: each is read, and each friction constant changes the command."""

import ast
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from needle_controller import (
    AdaptiveGains,
    Controller,
    ControllerSettings,
    HardwareSettings,
    InverseDynamicsGains,
    Measurement,
    ObserverSettings,
    PidGains,
    ReferenceLimits,
    SafetyLimits,
    Uncertainty,
)
from needle_controller.commissioning import CommissioningSettings
from needle_dynamics import NeedleParameters
from needle_dynamics.compiled.friction import FrictionConstants
from needle_dynamics.simulated.tip_sensor import TipParameters
import pytest

ROOT = Path(__file__).parents[2]
PERIOD = 1e-3

SETTINGS = (
    ControllerSettings,
    Uncertainty,
    ReferenceLimits,
    SafetyLimits,
    ObserverSettings,
    HardwareSettings,
    CommissioningSettings,
    InverseDynamicsGains,
    AdaptiveGains,
    PidGains,
    NeedleParameters,
    FrictionConstants,
    TipParameters,
)


def names_read() -> Iterator[str]:
    """Yield every attribute that code of the packages reads, checks of the values left out."""
    for package in ('needle_dynamics', 'needle_controller'):
        for path in (ROOT / package).rglob('*.py'):
            for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
                # Checks of a value are ignored, except where laws are created.
                if isinstance(node, ast.FunctionDef) and node.name == '__post_init__':
                    node.body = [] if '_set_constants' not in ast.unparse(node) else node.body
                if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                    yield node.attr


@pytest.mark.parametrize('settings', SETTINGS, ids=lambda one: str(one.__name__))
def test_every_parameter_is_read(settings: Any) -> None:
    """By its name, in computing code."""
    known: Any = getattr(settings, '_fields', None) or [one.name for one in fields(settings)]
    assert set(known) <= {*names_read()}


def forces(law: str, gains: dict[str, Any], **changes: Any) -> list[float]:
    """Return the commands of a law to a needle that moves in, rests, and has a goal outside."""
    parameters = NeedleParameters.preset('phantom', **changes)
    controller = Controller(parameters, law, gains=gains)
    controller.set_target(0.05)
    found = []
    for i in range(40):
        speed = 0.002 if i < 20 else 0.0
        depth = 0.03 + 0.002 * PERIOD * min(i, 20)
        if i == 25:
            controller.set_target(0.01)
        now = i * PERIOD if i < 30 else i * PERIOD + 0.05 * (i - 29)
        measured = Measurement(time=now, depth=depth, velocity=speed)
        found.append(controller.command(measured).force)
    return found


@pytest.mark.parametrize('law', ['adaptive', 'inverse_dynamics', 'pid'])
@pytest.mark.parametrize(
    ('base', 'name', 'value'),
    [
        ({}, 'coulomb_friction', 0.7),
        ({}, 'viscous_friction', 320.0),
        ({}, 'withdrawal_friction', 0.6),
        ({}, 'friction_law', 'tanh'),
        ({'friction_law': 'stribeck', 'breakaway_friction': 1.2}, 'breakaway_friction', 1.5),
        ({'friction_law': 'stribeck', 'breakaway_friction': 1.2}, 'stribeck_speed', 5e-3),
        ({'friction_law': 'tanh'}, 'smoothing_speed', 1e-3),
    ],
)
def test_every_constant_of_friction_changes_the_command(
    law: str, base: dict[str, Any], name: str, value: Any
) -> None:
    """For each law; PID with feed-forward, because it does not compensate friction otherwise."""
    gains = {'pid': {'insertion': PidGains(feed_forward=True)}} if law == 'pid' else {}
    assert forces(law, gains, **base) != forces(law, gains, **{**base, name: value})
