# SPDX-License-Identifier: Apache-2.0
"""Experiments: commands, recordings, and resumption after an interruption."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from needle_dynamics import ParameterError
from needle_dynamics.simulated.base import BaseParameters
from needle_dynamics.simulated.indenter import IndenterParameters
from needle_identification import (
    BagWriter,
    identify_friction,
    identify_stiffness,
    read_friction_recording,
    read_indentation_recording,
)
from needle_identification.bags.bag import read_topic
from needle_identification.bags.messages import encode, message_type
from needle_insertion.cli import main
from needle_insertion.report.paper_tables import FORCE_LEVELS, TABLE_1, TABLE_2
import numpy as np
import pytest
from reproduction import record as recorder
from reproduction.campaign import Campaign
from reproduction.population import draw_friction, draw_stiffness
from reproduction.protocol import (
    DIRECTIONS,
    ExperimentProtocol,
    PROTOCOLS,
    PUSH,
    SHIPPED_BAGS,
    SPEEDS,
    START_DEPTH,
)
from reproduction.record import ExperimentError, record, Rig, rig

FRICTION, STIFFNESS = PROTOCOLS['friction'], PROTOCOLS['stiffness']

#: Rate for identification, as in the shipped bags, slow enough for a busy machine.
RATE, SPEED = 100.0, 10.0


# Commands.


@pytest.mark.parametrize('protocol', PROTOCOLS.values(), ids=PROTOCOLS)
def test_times_increase(protocol: ExperimentProtocol) -> None:
    """Times of points are strictly increasing."""
    assert (np.diff([0.0, *(point.time for point in protocol.points)]) > 0.0).all()


def test_strokes_insert_and_withdraw_at_each_speed_within_base_limits() -> None:
    """Strokes are mostly at constant speed, in both directions, and end at the start."""
    moved = [point for point in FRICTION.points if point.positions]
    times = np.array([point.time for point in moved])
    depths = np.array([point.positions[0] for point in moved])
    speeds, spans = np.diff(depths) / np.diff(times), np.diff(times)
    for speed in SPEEDS:
        for direction in (1.0, -1.0):
            # 1e-9: rounding of metres over hundredths of seconds.
            held = spans[np.isclose(speeds, direction * speed, rtol=0.0, atol=1e-9)]
            assert held.sum() > 0.5
    assert depths[-1] == pytest.approx(START_DEPTH, abs=1e-12)
    # The velocity changes between the midpoints of two segments.
    accelerations = np.diff(speeds) / ((spans[1:] + spans[:-1]) / 2.0)
    base = BaseParameters()
    assert np.abs(accelerations).max() < base.acceleration_limit
    assert np.abs(speeds).max() < base.speed_limit


def test_push_exceeds_the_friction_of_sampled_needles() -> None:
    """The force rises from zero to 4/3 of the largest mu_s of 1000 samples."""
    first, last = (point.effort for point in FRICTION.points if point.effort)
    assert first == (0.0,)
    assert last == (PUSH,)
    assert max(drawn['coulomb_friction'] for drawn in draw_friction(1000, 1)) < 0.75 * PUSH


def test_each_force_level_has_presses_in_eight_directions() -> None:
    """Holds have five magnitudes in evenly spaced directions, with zero force in between."""
    forces = np.array([point.effort for point in STIFFNESS.points])
    held = np.flatnonzero((forces[1:] == forces[:-1]).all(axis=1) & forces[1:].any(axis=1))
    assert len(held) == DIRECTIONS * len(FORCE_LEVELS)
    assert not forces[held - 1].any()
    assert not forces[held + 2].any()
    # 1e-12: rounding of cos and sin.
    sizes = np.linalg.norm(forces[held], axis=1)
    assert sizes == pytest.approx(np.repeat(FORCE_LEVELS, DIRECTIONS), abs=1e-12)
    angles = np.arctan2(*forces[held].T[::-1]).reshape(-1, DIRECTIONS)
    assert np.diff(np.unwrap(angles)) == pytest.approx(2.0 * np.pi / DIRECTIONS, abs=1e-12)


def test_campaign_samples_around_the_tables_or_uses_their_means() -> None:
    """Each run has sampled values and a seed; ``fixed`` uses the means."""
    runs = Campaign(protocol=FRICTION, repeats=3, seed=5).runs
    assert list(runs) == ['friction_01', 'friction_02', 'friction_03']
    assert [run['seed'] for run in runs.values()] == [5, 6, 7]
    assert [run['model.coulomb_friction'] for run in runs.values()] == [
        drawn['coulomb_friction'] for drawn in draw_friction(3, 5)
    ]
    runs = Campaign(protocol=STIFFNESS, repeats=2, seed=5).runs
    assert [run['indenter.stiffness_zz'] for run in runs.values()] == [
        list(drawn['k_zz']) for drawn in draw_stiffness(2, 5)
    ]
    (fixed,) = Campaign(protocol=FRICTION, repeats=1, fixed=True).runs.values()
    assert fixed['model.viscous_friction'] == TABLE_1['viscous_friction'][0]
    (own,) = Campaign(protocol=FRICTION, repeats=1, needle='misra_2010').runs.values()
    assert own['model.youngs_modulus'] == 50e9
    assert 'model.coulomb_friction' not in own
    (fixed,) = Campaign(protocol=STIFFNESS, repeats=1, fixed=True).runs.values()
    assert fixed['indenter.stiffness_xz'] == list(TABLE_2['k_xz'][0])


@pytest.mark.parametrize('seed', [0, 2014])
def test_indenter_accepts_every_sampled_place(seed: int) -> None:
    """The simulated indenter rejects no sample."""
    for run in Campaign(protocol=STIFFNESS, repeats=40, seed=seed).runs.values():
        drawn: dict[str, Any] = {
            name.removeprefix('indenter.'): tuple(value)
            for name, value in run.items()
            if isinstance(value, list)
        }
        IndenterParameters(**drawn)


@pytest.mark.parametrize('rate', [40.0, 100.0, 333.0, 5000.0])
def test_sensor_rate_is_a_multiple_of_the_sampling_rate(rate: float) -> None:
    """The internal rate of the sensor is an integer multiple of the sampling rate."""
    (run,) = Campaign(protocol=FRICTION, repeats=1, rate=rate).runs.values()
    own = float(str(run['sensor.rate']))
    assert own % rate == 0.0
    assert rate <= own <= 8000.0


# Rejected recordings.


def pretended(folder: Path, configuration: str = '', **changes: object) -> None:
    """Write a bag that resembles the only run of the friction experiment, with changes."""
    (parameters,) = Campaign(protocol=FRICTION, repeats=1).runs.values()
    text = message_type('std_msgs/msg/String')
    kinds = {
        '/plant/configuration': 'std_msgs/msg/String',
        '/joint_trajectory': 'trajectory_msgs/msg/JointTrajectory',
    }
    trajectory = message_type(kinds['/joint_trajectory'])
    header, stamp = (
        message_type('std_msgs/msg/Header'),
        message_type('builtin_interfaces/msg/Time'),
    )
    values = {**parameters, **changes}
    empty = trajectory(
        header=header(stamp=stamp(sec=0, nanosec=0), frame_id=''), joint_names=[], points=[]
    )
    with BagWriter(folder) as bag:
        for topic, kind in kinds.items():
            bag.add_topic(topic, kind)
        said = configuration or str({'/plant': {'ros__parameters': values}})
        bag.write('/plant/configuration', encode(text(data=said)), 1)
        bag.write('/joint_trajectory', encode(empty), 2)


def test_other_bags_are_not_overwritten(tmp_path: Path) -> None:
    """A file, a folder, other parameters, another trajectory are reported; nothing is recorded."""
    campaign = Campaign(protocol=FRICTION, repeats=1)
    place = tmp_path / 'friction_01'
    place.write_text('notes')
    with pytest.raises(ParameterError, match='exists and is not a run of this experiment'):
        record(campaign, tmp_path)
    place.unlink()
    place.mkdir()
    with pytest.raises(ParameterError, match='exists and is not a run of this experiment'):
        record(campaign, tmp_path)
    place.rmdir()
    pretended(place, seed=7)
    with pytest.raises(ParameterError, match='recorded with seed = 7, requested is 2014'):
        record(campaign, tmp_path)
    pretended(tmp_path / 'none' / 'friction_01', configuration='none')
    with pytest.raises(ParameterError, match='exists and is not a run of this experiment'):
        record(campaign, tmp_path / 'none')
    pretended(tmp_path / 'other' / 'friction_01')
    with pytest.raises(ParameterError, match='recorded with another trajectory'):
        record(campaign, tmp_path / 'other')
    assert sorted(path.name for path in tmp_path.iterdir()) == ['friction_01', 'none', 'other']


# Recordings.


@pytest.mark.parametrize(('protocol', 'rate'), [(FRICTION, 100.0), (STIFFNESS, 40.0)])
def test_shipped_bags_match_the_command_that_records_them(
    protocol: ExperimentProtocol, rate: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parameters and trajectory are current: the command has nothing to record."""
    monkeypatch.delattr(recorder, 'rig')
    bags = record(Campaign(protocol=protocol, rate=rate), SHIPPED_BAGS)
    assert bags == sorted(SHIPPED_BAGS.glob(f'{protocol.name}_*'))


def digests(folder: Path) -> dict[str, str]:
    """Return the checksums of the files of a folder."""
    return {path.name: sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def test_interrupted_experiment_is_resumed(tmp_path: Path) -> None:
    """Ctrl-C leaves complete bags only; the same call keeps them and records the others."""
    words = ['experiment', 'friction', str(tmp_path), '--repeats', '3']
    words += ['--rate', f'{RATE:g}', '--speed', f'{SPEED:g}']
    foreign = tmp_path / 'notes.txt'
    foreign.write_text('keep me')
    # Remains of a killed call.
    (tmp_path / '.friction.unfinished' / 'run').mkdir(parents=True)
    first, last = tmp_path / 'friction_01', tmp_path / 'friction_03'
    command = [sys.executable, '-m', 'needle_insertion.cli', *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        # Timeout: the first start compiles for a minute.
        deadline = time.monotonic() + 300.0
        while not first.exists():
            with suppress(subprocess.TimeoutExpired):
                pytest.fail(f'ended early with status {process.wait(0.02)}')
            assert time.monotonic() < deadline
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=120.0)
    assert process.returncode == 130
    assert said.splitlines()[-1] == 'interrupted'
    assert not last.exists()
    assert not list(tmp_path.glob('.*'))
    kept = digests(first)

    assert main(words) == 0
    assert digests(first) == kept
    assert foreign.read_text() == 'keep me'
    names = [f'friction_0{k}' for k in (1, 2, 3)]
    assert sorted(path.name for path in tmp_path.iterdir()) == [*names, 'notes.txt']
    assert set(digests(last)) == {'friction_03_0.mcap', 'metadata.yaml'}
    for name, drawn in zip(names, draw_friction(3, 2014), strict=True):
        recording = read_friction_recording(tmp_path / name)
        assert recording.losses == ()
        assert recording.truth['model.coulomb_friction'] == drawn['coulomb_friction']
        estimate = identify_friction(recording)
        # 1 %: about ten standard errors; each run must have its own friction.
        for coefficient, value in drawn.items():
            assert estimate[coefficient].value == pytest.approx(value, rel=0.01)

    # Complete: no run is started.
    assert main(words) == 0


#: Notes of the rig on lost samples.
NOTES: list[str] = []


@pytest.fixture(scope='module')
def stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Return a rig for presses."""
    with rig(tmp_path_factory.mktemp('rig'), STIFFNESS, NOTES.append) as running:
        yield running


@pytest.fixture
def place() -> dict[str, Any]:
    """Return the only place of a campaign of presses."""
    campaign = Campaign(protocol=STIFFNESS, repeats=1, rate=RATE)
    (parameters,) = campaign.runs.values()
    return parameters


def test_stiffness_recording_gives_the_sampled_matrix(
    tmp_path: Path, stand: Rig, place: dict[str, Any]
) -> None:
    """The bag of a place gives the sampled matrix at each level."""
    stand.record(tmp_path / 'bag', place, 2.0 * SPEED)
    (drawn,) = draw_stiffness(1, place['seed'])
    estimate = identify_stiffness(read_indentation_recording(tmp_path / 'bag'))
    assert [level.force for level in estimate.levels] == pytest.approx(FORCE_LEVELS, abs=0.01)
    for k, level in enumerate(estimate.levels):
        for entry, values in drawn.items():
            # 15 N/m: about ten standard errors.
            assert level[entry].value == pytest.approx(values[k], abs=15.0)


def test_run_with_lost_samples_is_repeated_slower_and_fails_in_real_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stand: Rig, place: dict[str, Any]
) -> None:
    """A run with lost samples gives no bag; a slower attempt may."""
    judged, answers = [], iter(['few messages', 'fewer', 'fewest', 'few messages', ''])

    def lossy(bag: Path, *_rest: object) -> str:
        judged.append(bag)
        return next(answers)

    monkeypatch.setattr(recorder, '_lost', lossy)
    with pytest.raises(ExperimentError, match='fewest at 1 times real time; choose a lower'):
        stand.record(tmp_path / 'a', place, 3.0)
    assert not (tmp_path / 'a').exists()
    stand.record(tmp_path / 'b', place, 50.0)
    assert len(set(judged)) == 5
    ((_, configuration),) = read_topic(tmp_path / 'b', '/plant/configuration')
    assert 'real_time_factor: 25.0' in configuration.data
    said = ['few messages at 3 ', 'fewer at 1.5 ', 'few messages at 50 ']
    assert [one.partition(': ')[2] for one in NOTES] == [f'{one}times real time' for one in said]


@pytest.mark.parametrize(
    ('kept', 'complaint'),
    [
        (lambda k: k >= 0, ''),
        (lambda k: k % 100 != 50, 'has 1095 messages of 1106'),
        (lambda k: k < 900, 'lasts 8.99 s of 11.05 s'),
        (lambda k: k < 0, '/base_wrench has no messages'),
    ],
    ids=['whole', 'gaps', 'cut', 'none'],
)
def test_lost_samples_are_detected(
    tmp_path: Path, kept: Callable[..., Any], complaint: str
) -> None:
    """A bag is complete if the stamps of the sampled topics have no gaps up to the end."""
    header, stamp = (
        message_type('std_msgs/msg/Header'),
        message_type('builtin_interfaces/msg/Time'),
    )
    kind = 'geometry_msgs/msg/PointStamped'
    pointed, point = message_type(kind), message_type('geometry_msgs/msg/Point')
    with BagWriter(tmp_path / 'bag') as bag:
        for topic in FRICTION.topics:
            bag.add_topic(topic, kind)
            for k in filter(kept, range(1106)) if topic == '/base_wrench' else range(1106):
                at = header(stamp=stamp(sec=k // 100, nanosec=k % 100 * 10**7), frame_id='')
                message = pointed(header=at, point=point(x=0.0, y=0.0, z=0.0))
                bag.write(topic, encode(message), k)
    assert complaint in recorder._lost(tmp_path / 'bag', FRICTION, 100.0)
    assert bool(complaint) == bool(recorder._lost(tmp_path / 'bag', FRICTION, 100.0))
