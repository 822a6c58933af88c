# SPDX-License-Identifier: Apache-2.0
"""Plant run: samples, and events that make it repeatable."""

from __future__ import annotations

import json
from typing import Any

from needle_dynamics import InsertionDepthError, NeedleModel, NeedleParameters, ParameterError
from needle_dynamics.simulated.assembly import PlantConstants
from needle_dynamics.simulated.commands import AppliedForces
from needle_dynamics.simulated.plant import Measurement, Plant
from needle_dynamics.simulated.run import (
    CONFIGURED,
    Event,
    Executions,
    PARAMETERS,
    PlantRun,
    RESET,
    TARE,
    TIME,
    TRAJECTORY,
)
from needle_ros.errors import JobError
from needle_ros.trajectories import JointPath
import numpy as np
from numpy.testing import assert_allclose
import pytest

#: A stamp with more digits than a float can hold to the nanosecond.
BEGIN = 1_700_000_000_123_456_789
#: The period is not a whole number of nanoseconds.
VALUES: dict[str, Any] = {'needle': 'phantom', 'depth': 0.1, 'rate': 300.0, 'sensor.rate': 6000.0}
COURSE = Event(
    TRAJECTORY, {'joints': ['insertion'], 'times': [0.1], 'positions': [[0.101]], 'efforts': [[]]}
)


def stamp(k: int) -> int:
    return BEGIN + round(k * 1e9 / 300.0)


def truth(measured: list[Measurement]) -> list[float]:
    """Return the values of `ground_truth`."""
    return next(values for name, _, values in measured if name == 'ground_truth')


def test_samples_match_the_topics_of_the_contract() -> None:
    """Each topic has the declared number of values; `joint_states` is last."""
    for mode, steered, last in (
        ('simulation', False, 'joint_states'),
        ('robot', False, 'joint_states'),
        ('simulation', True, 'joint_states'),
        ('robot', True, 'joint_states'),
        ('indenter', False, 'end_effector_pose'),
    ):
        plant = PlantRun({**VALUES, 'mode': mode, 'steered': steered})
        measured = plant.take(stamp(1))
        assert (measured[0][0], measured[-1][0]) == ('base_wrench', last)
        assert {name for name, _, _ in measured} == plant.topics.keys()
        for name, _, values in measured:
            assert len(values) == len(plant.topics[name].quantities)


def test_ground_truth_contains_the_acting_command() -> None:
    """To the last bit, in contrast to the measured mean; insertion decreases d."""
    plant = PlantRun(VALUES)
    force, torque = 1.0 / 3.0, 1e-9 / 7.0
    plant.commands.offer(stamp(0), '', force, torque, stamp(0))
    plant.take(stamp(1))
    plant.commands.offer(stamp(1), '', force, torque, stamp(1))
    assert truth(plant.take(stamp(2)))[8:] == [-force, torque, 0.0, 0.0]
    assert truth(plant.take(stamp(3), AppliedForces(0, 2.0)))[8:10] == [-2.0, 0.0]
    robot = PlantRun({**VALUES, 'mode': 'robot'})
    assert len(truth(robot.take(stamp(1)))) == 8


def test_only_time_jumps_are_events() -> None:
    """Stamps at rounded multiples of the period are not events."""
    plant = PlantRun(VALUES)
    kinds = []
    for k in range(1, 101):
        plant.take(stamp(k if k <= 50 else k + 7))
        kinds.append([event.kind for event in plant.events()])
    assert kinds[0] == [CONFIGURED, TIME]
    assert kinds[50] == [TIME]
    assert not any(kinds[1:50] + kinds[51:])
    assert plant.number == 100


def test_events_can_be_serialized_and_replayed() -> None:
    """Replayed events give the same samples after conversion to JSON."""
    first = PlantRun({**VALUES, 'mode': 'robot', 'seed': 5})
    done = {
        40: [Event(TARE), COURSE],
        60: [Event(PARAMETERS, {'model.coulomb_friction': 0.8})],
        120: [Event(RESET), COURSE],
    }
    samples, said = [], []
    for k in range(1, 151):
        for event in done.get(k, []):
            first.perform(event)
        samples.append(first.take(stamp(k)))
        said += [(k, event) for event in first.events()]
    assert [(k, event.kind) for k, event in said] == [
        (1, CONFIGURED), (1, TIME), (40, TARE), (40, TRAJECTORY), (60, PARAMETERS),
        (120, RESET), (120, TRAJECTORY),
    ]  # fmt: skip
    texts = [(k, event.kind, json.dumps(event.content)) for k, event in said]
    read = [(k, Event(kind, json.loads(text))) for k, kind, text in texts]
    second = PlantRun(read[0][1].content)
    for k, measured in enumerate(samples, 1):
        for at, event in read[1:]:
            if at == k:
                second.perform(event)
        assert second.take(stamp(k)) == measured


def test_rejected_inputs_are_not_events() -> None:
    """The error of the plant is raised, and nothing changes."""
    plant = PlantRun({**VALUES, 'mode': 'robot'})
    plant.take(stamp(1))
    plant.events()
    constants = plant.constants
    for event, error in (
        (Event(TRAJECTORY, {**COURSE.content, 'joints': ['x']}), ParameterError),
        (Event(PARAMETERS, {'model.coulomb_friction': -1.0}), ParameterError),
        # Deeper than the needle; also if it is requested again.
        (Event(PARAMETERS, {'model.minimum_depth': 0.15}), InsertionDepthError),
        (Event(PARAMETERS, {'model.minimum_depth': 0.15}), InsertionDepthError),
        (Event(TARE), JobError),
    ):
        with pytest.raises(error):
            plant.perform(event)
    with pytest.raises(ParameterError, match='in the modes robot and indenter only'):
        PlantRun(VALUES).perform(Event(TRAJECTORY, COURSE.content))
    # A fault changes measurements, not the plant.
    plant.perform(Event(PARAMETERS, {'fault.kind': 'drop'}))
    assert plant.events() == []
    assert plant.constants is constants or plant.constants == constants


def test_constants_are_read_from_the_parameters() -> None:
    """Missing values have their defaults, from the preset if given."""
    constants = PlantConstants.of({'needle': 'paper_mm', 'rate': 500, 'sensor.filter': 0})
    assert constants.model == NeedleParameters.preset('paper_mm')
    assert (constants.mode, constants.seed, constants.own.rate) == ('simulation', 1, 500.0)
    assert constants.sensor.filter == 0
    changed = PlantConstants.of({'needle': 'phantom', 'model.density': 7900})
    assert changed.model == NeedleParameters.preset('phantom', density=7900.0)
    start = changed.make()
    assert isinstance(start, Plant)
    assert list(start.integrator.state) == list(NeedleModel(changed.model).state_at(0.02, 0.0))


@pytest.mark.parametrize(
    ('values', 'complaint'),
    [
        ({'mode': 'dream'}, "mode must be one of simulation, robot, indenter, got 'dream'"),
        ({'needle': 'steel'}, 'needle must be one of paper_si, paper_mm, phantom, b'),
        ({'sensor.rate': -1.0}, 'sensor.rate must be finite, > 0 and <= 8000 Hz, got -1.0'),
        ({'rate': 1e5}, 'rate must be finite, >= 1 and <= 8000 Hz, got 100000.0'),
    ],
)
def test_invalid_parameters_are_rejected(values: dict[str, Any], complaint: str) -> None:
    """The message contains the name with its namespace."""
    with pytest.raises(ParameterError) as caught:
        PlantConstants.of(values)
    assert str(caught.value).startswith(complaint)


@pytest.mark.requirement('S-288')
@pytest.mark.parametrize('steered', [False, True])
@pytest.mark.parametrize('velocity', [0.01, 0.05])
@pytest.mark.parametrize('moment', [0.3, 0.5, 0.9])
def test_stop_of_a_withdrawal_does_not_insert(
    steered: bool, velocity: float, moment: float
) -> None:
    """A needle that is withdrawn rests within its braking distance, and never moves inward."""
    plant = PlantRun({**VALUES, 'mode': 'robot', 'steered': steered, 'depth': 0.08})
    plant.take(stamp(1))
    time = 0.04 / velocity
    motion = {'joints': ['insertion'], 'times': [time], 'positions': [[0.04]], 'efforts': [[]]}
    plant.perform(Event(TRAJECTORY, motion))
    stopped = 2 + round(moment * time * 300.0)
    depths = []
    # The position error decays with 20 1/s.
    for k in range(2, stopped + 180):
        if k == stopped:
            plant.halt()
        plant.take(stamp(k))
        depths.append(plant.plant.depth)
    after = np.array(depths[stopped - 3 :])
    # Counts of the encoders when the stop is requested.
    assert np.diff(after).max() <= 1e-6
    # The base brakes with 0.5 m/s^2, after the two periods since the first of these samples, and
    # with another period for the end of its motion.
    assert after[0] - after[-1] <= velocity**2 + velocity * 3.0 / 300.0 + 1e-6
    assert np.ptp(after[-20:]) <= 1e-6


@pytest.mark.requirement('S-278')
@pytest.mark.parametrize('drift', [-300_000, 0, 300_000])
@pytest.mark.parametrize('until', [1, 29, 30, 31])
def test_pause_holds_what_has_not_arrived_for_any_stamps(until: int, drift: int) -> None:
    """A path of 30 samples takes 30 samples around a pause, with stamps of another clock [ns]."""
    run = PlantRun({'mode': 'indenter', 'rate': 200.0})
    executions = Executions(run, ['x', 'z'])
    count = 0

    def take(samples: int) -> None:
        nonlocal count
        for _ in range(samples):
            count += 1
            executions.sampled = BEGIN + count * (5_000_000 + drift)
            run.take(executions.sampled)

    def force() -> float:
        return run.plant.references()['z'].effort

    take(10)
    path = JointPath(['x', 'z'], [0.15], [], [], [[0.0, -1.5]])
    executions.follow(path, ['x', 'z'], 0.0)
    take(until)
    executions.pause()
    take(100)
    # An indenter at rest keeps its force, one that moves releases it.
    assert force() == (0.0 if until < 30 else -1.5)
    assert executions.joints_held == ({'x', 'z'} if until < 30 else set())
    executions.resume()
    take(max(30 - until, 0))
    assert_allclose(force(), -1.5, rtol=1e-12)
