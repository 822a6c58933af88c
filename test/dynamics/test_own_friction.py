# SPDX-License-Identifier: Apache-2.0
"""Friction laws of a user: equal to the shipped laws where they state the same, in every loop."""

from __future__ import annotations

from math import exp, tanh
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

from needle_controller import (
    Controller,
    InverseDynamics,
    InverseDynamicsGains,
    ReferenceLimits,
    run_batch,
    run_controller,
    Setpoint,
)
from needle_controller.laws.law import Axis
from needle_controller.reference.path import Trapezoid
from needle_dynamics import (
    add_friction_law,
    Friction,
    linearize,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    simulate,
    simulate_batch,
)
from needle_dynamics.compiled.friction import friction_force
import numpy as np
from numpy.testing import assert_allclose
import pytest


def decaying(coulomb: float, speed: float) -> float:
    """Return the friction of `stribeck` with a break-away ratio of 1.5."""
    ratio = speed / 1e-3
    return coulomb * (1.0 + 0.5 * exp(-ratio * ratio))


def smooth(coulomb: float, speed: float) -> float:
    """Return the friction of `tanh`."""
    return coulomb * tanh(speed / 1e-4)


@pytest.fixture(scope='module', autouse=True)
def _laws() -> None:
    add_friction_law('own_decaying', decaying)
    add_friction_law('own_smooth', smooth)


PAIRS = [('own_decaying', 'stribeck'), ('own_smooth', 'tanh')]


def needle(law: str) -> NeedleParameters:
    return NeedleParameters.preset('phantom', friction_law=law, breakaway_friction=1.5)


def start(law: str) -> Any:
    return NeedleModel(needle(law)).state_at(0.05, 5e-4)


@pytest.mark.parametrize(('own', 'shipped'), PAIRS)
def test_own_law_moves_the_needle_as_the_same_shipped_law(own: str, shipped: str) -> None:
    """In a simulation and in a batch, through a start from rest; to rounding."""

    def force(time: float) -> float:
        return 0.7 if time < 0.01 else 3.0

    options: dict[str, Any] = {'duration': 0.05, 'interval': 1e-3}
    one, other = (simulate(needle(law), start(law), force, **options) for law in (own, shipped))
    # Newton iterations with a numerical slope end at the same root, to 1e-15 of the largest speed.
    assert_allclose(one.states, other.states, rtol=1e-9, atol=1e-12)
    batches = [
        simulate_batch(needle(law), start(law), [0.5, 0.7, 3.0], **options)
        for law in (own, shipped)
    ]
    assert_allclose(batches[0].states, batches[1].states, rtol=1e-9, atol=1e-12)
    # It moves.
    assert np.ptp(one.depth) > 1e-5


@pytest.mark.parametrize(('own', 'shipped'), PAIRS)
def test_own_law_in_a_closed_loop(own: str, shipped: str) -> None:
    """As plant and as nominal model of the controller, which compensates it."""
    runs = []
    for law in (own, shipped):
        controller = Controller(needle(law))
        controller.set_target(0.052)
        runs.append(run_controller(controller, needle(law), start(law), duration=0.05))
    assert_allclose(runs[0].states, runs[1].states, rtol=1e-9, atol=1e-12)
    assert_allclose(runs[0].forces, runs[1].forces, rtol=1e-8, atol=1e-9)


def test_own_law_in_a_batch_of_closed_loops() -> None:
    found = []
    for law in ('own_decaying', 'stribeck'):
        plant = needle(law)
        loop = InverseDynamics(
            axis=Axis.insertion(plant), gains=InverseDynamicsGains(), period=1e-3
        )
        begin = Setpoint(position=0.05, velocity=0.0, acceleration=0.0)
        path = Trapezoid(begin, 0.052, ReferenceLimits(speed=0.01, acceleration=0.1))
        options: dict[str, Any] = {'delay': 1, 'limit': 15.0, 'duration': 0.05}
        found.append(run_batch(loop, plant, start(law), path, **options))
    assert_allclose(found[0].states, found[1].states, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(('own', 'shipped'), PAIRS)
def test_slope_of_an_own_law_in_the_linearization(own: str, shipped: str) -> None:
    """By differences, of second order: 1e-6 of the slope, with a step of 1e-5 of the speed."""
    for speed in (1e-4, 1e-3, 1e-2):
        one, other = (
            Friction(law=law, coulomb=0.56, viscous=300.0, breakaway=1.5).slope(speed, 1.0)
            for law in (own, shipped)
        )
        assert_allclose(one, other, rtol=1e-6)
    models = [NeedleModel(needle(law)) for law in (own, shipped)]
    found = [linearize(model, start(own), sliding='insertion').A for model in models]
    assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ('name', 'law', 'words'),
    [
        ('stribeck', decaying, 'must be an identifier other than coulomb, stribeck, tanh'),
        ('two words', decaying, "got 'two words'"),
        (
            'negative',
            lambda coulomb, speed: coulomb - 10.0 * speed,
            r'must be finite and > 0, got',
        ),
        ('infinite', lambda _coulomb, speed: 1.0 / speed, 'must be finite and >'),
        ('unknown', lambda coulomb, _speed: missing(coulomb), "cannot be compiled: .*'missing'"),  # type: ignore[name-defined]  # noqa: F821
        ('no_function', 'text', "no_function must be a function, got 'text'"),
    ],
)
def test_invalid_law_is_rejected(name: str, law: Any, words: str) -> None:
    with pytest.raises(ParameterError, match=words) as caught:
        add_friction_law(name, law)
    assert '\n' not in str(caught.value)


def test_law_is_replaced_by_a_law_of_the_same_name() -> None:
    """Constants that a compiled function holds stay valid."""
    add_friction_law('own_changed', lambda coulomb, _speed: coulomb)
    before = NeedleModel(needle('own_changed'))
    assert before.friction.force(0.1, 0.0) == pytest.approx(30.56)
    kept = before.friction.constants
    add_friction_law('own_changed', lambda coulomb, _speed: 2.0 * coulomb)
    assert NeedleModel(needle('own_changed')).friction.force(0.1, 0.0) == pytest.approx(31.12)
    assert friction_force(kept, 0.1, 0.0) == pytest.approx(30.56)


def test_law_of_another_process_is_unknown() -> None:
    """The error lists the laws of this process."""
    with pytest.raises(ParameterError, match=r'one of coulomb, stribeck, tanh, .*own_decaying'):
        NeedleParameters.preset('phantom', friction_law='of_another_process')


def test_first_compilation_in_python_is_announced(tmp_path: Path) -> None:
    """One line on standard error, and none for the next function."""
    code = (
        'from needle_dynamics import Friction\n'
        'one = Friction(coulomb=1.0, viscous=1.0)\n'
        'one.force(0.1, 0.0), one.slope(0.1, 1.0)\n'
    )
    done = subprocess.run(
        [sys.executable, '-c', code],
        env={**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
        timeout=300.0,
    )
    assert done.stderr.count('compiling for this machine (once)') == 1
    assert done.stderr.count('\n') == 1
