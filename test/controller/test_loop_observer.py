# SPDX-License-Identifier: Apache-2.0
"""The observer in the compiled closed loop: the observer of the node, with each needle alone."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any

from needle_controller import (
    AdaptiveGains,
    Axis,
    InverseDynamicsGains,
    Measurement,
    Observer,
    ObserverSettings,
    PidGains,
    ReferenceLimits,
    Setpoint,
)
from needle_controller.compiled.loop import run_loop
from needle_controller.gains import LAW_OF
from needle_controller.in_loop.observed import compiled_observer, TipObserver
from needle_controller.in_loop.sampled import LoopInsertion, motion_of, run_insertions
from needle_controller.laws.law import Law, SampledLoop
from needle_controller.load_estimator import LoadEstimator
from needle_controller.reference.quintic import MinimumJerk
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters, ParameterError
from needle_ros.timing import NANOSECONDS
import numpy as np
from numpy.testing import assert_allclose
import pytest

PERIOD, COUNT = 1e-3, 700
NOMINAL = NeedleParameters.preset('phantom', swelling=0.2, swelling_time=0.3)
#: Needles that differ from the nominal one, from a depth at which the load is not zero.
MODELS = [
    NeedleModel(replace(NOMINAL, tissue_stiffness=stiffness, coulomb_friction=friction, **more))
    for stiffness, friction, more in (
        (700.0, 0.7, {}),
        (520.0, 0.5, {'layer_depths': (0.101,), 'layer_stiffnesses': (900.0,)}),
        (400.0, 0.6, {'friction_law': 'stribeck'}),
    )
]
STARTS = [model.state_at(0.1, 2e-3) for model in MODELS]
REFERENCE = MinimumJerk(Setpoint(0.1), 0.103, ReferenceLimits())
OPTIONS: dict[str, Any] = {'delay': 1, 'limit': 15.0, 'step': 5e-4}


def law_of(gains: Any) -> Law:
    return LAW_OF[type(gains)](axis=Axis.insertion(NOMINAL), gains=gains, period=PERIOD)


LAW = law_of(InverseDynamicsGains())


def observer(largest: float = 100.0, **settings: Any) -> TipObserver:
    return TipObserver(NOMINAL, ObserverSettings(**settings), PERIOD, largest)


def noise(seed: int) -> FloatArray:
    """Return errors of depth, velocity, force and tip, by the assumed noise of the tip."""
    random = np.random.default_rng(seed).standard_normal((COUNT, 4))
    return np.asarray(random * [1e-6, 1e-4, 0.01, 1e-4])


USUAL = observer()


@cache
def observed(k: int, law: Law = LAW, used: TipObserver = USUAL) -> LoopInsertion:
    one = [MODELS[k]], [STARTS[k]], [REFERENCE], [noise(k)], [k]
    return run_insertions(law, *one, observer=used, **OPTIONS)[0]


@pytest.mark.parametrize('gains', [InverseDynamicsGains(), AdaptiveGains(), PidGains()])
def test_commands_are_those_of_the_observer_of_the_node(gains: Any) -> None:
    """Law and load estimator as Python classes, on the same measurements."""
    law = law_of(gains)
    found = observed(0, law)
    commands, loads, estimator = by_node(found, law, observer())
    # Rounding of the law, which amplifies that of the measured velocity by its gains.
    assert_allclose(found.commands, commands, atol=1e-9)
    assert np.abs(loads).max() > 1e-3
    assert estimator.warning is None


def by_node(
    found: LoopInsertion, law: Law, used: TipObserver
) -> tuple[FloatArray, FloatArray, LoadEstimator]:
    """Return commands and loads of the classes of the node on the measurements of a run."""
    estimator = LoadEstimator(NOMINAL, Observer(NOMINAL, used.used, PERIOD), used.largest)
    loop, errors = SampledLoop(law, 1, 15.0), noise(0)
    commands, loads = np.zeros((2, COUNT))
    depth, velocity, tip = found.motion[:, :COUNT] + errors[:, [0, 1, 3]].T
    for k in range(COUNT):
        loads[k] = estimator.load
        ahead = REFERENCE.at((k + 1) * PERIOD)
        commands[k] = loop.command(depth[k], velocity[k], Setpoint(*ahead), loads[k])
        stamp = round(k * PERIOD * NANOSECONDS)
        estimator.take_tip(stamp, tip[k])
        estimator.take_encoders(stamp, Measurement(k * PERIOD, depth[k], velocity[k]))
        with suppress(ParameterError):
            estimator.update()
    return commands, loads, estimator


def test_wrench_without_readings_has_no_effect_on_the_load() -> None:
    """The loop leaves out the filters of the force sensor, in which nothing is measured."""
    used = observer()
    whole = replace(used.settings, tip_exposure=used.used.tip_exposure)
    found = observed(0)
    loads = []
    for settings in (used.used, whole):
        estimator = LoadEstimator(NOMINAL, Observer(NOMINAL, settings, PERIOD))
        for k in range(100):
            depth, velocity, tip = found.motion[:, k].tolist()
            estimator.take_tip(k * 1_000_000, tip)
            estimator.take_encoders(k * 1_000_000, Measurement(k * PERIOD, depth, velocity))
            estimator.update()
        loads.append(estimator.load)
    assert loads[0] != 0.0
    # Sums of other lengths: rounding.
    assert_allclose(loads[0], loads[1], rtol=1e-9)


@pytest.mark.parametrize(
    ('used', 'least'),
    [(observer(irregularity=0.0, tip_noise=1e-5), 50), (observer(largest=2e-4), 4)],
    ids=['inconsistent', 'implausible'],
)
def test_rejected_loads_are_not_used_as_in_the_node(used: TipObserver, least: int) -> None:
    """An inconsistent observer, and one with an implausible load, which restarts."""
    found = observed(0, LAW, used)
    commands, loads, estimator = by_node(found, LAW, used)
    assert_allclose(found.commands, commands, atol=1e-9)
    assert (loads[3:] == 0.0).sum() >= least
    assert (loads != 0.0).sum() > 50
    assert (estimator.warning is None) == (used.largest < 1.0)


def test_observed_needles_are_independent_in_lanes() -> None:
    """Together and alone, to the bit; each has its own observer."""
    args = MODELS, STARTS, [REFERENCE] * 3, [noise(k) for k in range(3)], [0, 1, 2]
    together = run_insertions(LAW, *args, observer=USUAL, **OPTIONS)
    for k, found in enumerate(together):
        alone = observed(k)
        assert np.array_equal(found.motion, alone.motion)
        assert np.array_equal(found.commands, alone.commands)


def test_single_loop_with_an_observer_equals_the_lanes() -> None:
    model, found = MODELS[1], observed(1)
    own, boxed = compiled_observer(observer())
    times = PERIOD * np.arange(COUNT + 2)
    setpoints = np.array([REFERENCE.at(t) for t in times.tolist()])
    states, commands = np.zeros((COUNT + 1, 8)), np.zeros(COUNT)
    run_loop(
        model.compiled, STARTS[1].copy(), LAW.packed, 15.0, setpoints[1:-1].copy(),
        setpoints[:-1, 0].copy(), np.zeros(2), 1, noise(1), np.empty((0, 3)), 5e-4, own, boxed,
        np.empty(0), states, commands, np.empty(3),
    )  # fmt: skip
    motion = motion_of(model, states)
    reached = np.abs(motion).max(axis=1, keepdims=True)
    # Rounding of the needle, as without an observer, which the closed loop amplifies.
    assert_allclose(found.motion / reached, motion / reached, atol=1e-9)
    assert_allclose(found.commands, commands, atol=1e-7)


def test_observer_changes_the_command_by_the_load() -> None:
    args = [MODELS[0]], [STARTS[0]], [REFERENCE], [noise(0)], [0]
    plain = run_insertions(LAW, *args, **OPTIONS)[0]
    without = run_insertions(LAW, *args[:3], [noise(0)[:, :3]], [0], **OPTIONS)[0]
    # The tip is measured by the observer only.
    assert np.array_equal(plain.commands, without.commands)
    changed = observed(0).commands - plain.commands
    assert 1e-3 < np.abs(changed).max() < 1.0
