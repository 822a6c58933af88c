# SPDX-License-Identifier: Apache-2.0
"""Replay of recorded runs: identical results, and the location and reason of differences."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
import json
from math import sin
from pathlib import Path
import re
import time
from typing import Any

from geometry_msgs.msg import WrenchStamped
from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters
from needle_dynamics.simulated.base import BaseMotion, BaseParameters
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.simulated.indenter import IndenterParameters
from needle_dynamics.simulated.plant import Plant, PlantSample
from needle_dynamics.simulated.tip_sensor import TipParameters, TipSensor
from needle_identification import BagWriter, RecordingError
from needle_identification.bags.messages import encode, message_type
from needle_insertion.cli import main
from needle_insertion.graph.ros_graph import ACTIVATE, CONFIGURE, DEACTIVATE, Graph
from needle_insertion.replay.rerun import Rerun, verify
from needle_ros.base_node import COMMAND, SENSOR
import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from reproduction.campaign import Campaign
from reproduction.protocol import PROTOCOLS, SHIPPED_BAGS
from reproduction.record import record
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
import yaml

RATE = 200.0
PERIOD = 5_000_000
#: Activation of the plant [ns]; its first sample is a period later.
BEGIN = 1_700_000_000_123_456_789
SAMPLES = 120

KINDS = {
    '/plant/configuration': 'std_msgs/msg/String',
    '/plant/events': 'diagnostic_msgs/msg/DiagnosticArray',
    '/wrench_command': 'geometry_msgs/msg/WrenchStamped',
    '/joint_trajectory': 'trajectory_msgs/msg/JointTrajectory',
    '/joint_states': 'sensor_msgs/msg/JointState',
    '/base_wrench': 'geometry_msgs/msg/WrenchStamped',
    '/tip_deflection': 'geometry_msgs/msg/PointStamped',
    '/ground_truth': 'sensor_msgs/msg/JointState',
}
NODE: dict[str, Any] = {
    'rate': RATE,
    'seed': 7,
    'mode': 'simulation',
    'depth': 0.03,
    'tip_deflection': 5e-4,
    'step': 2e-5,
    'command_timeout': 0.1,
    'force_limit': 100.0,
    'torque_limit': 1.0,
    'real_time_factor': 1.0,
    'needle': 'phantom',
}
MODEL = NeedleParameters.preset('phantom')
TIP = TipParameters(rate=50.0, noise=1e-5, delay=0.012)


def configuration(**changes: object) -> dict[str, Any]:
    """Return the parameters as published by the node."""
    values = dict(NODE)
    for prefix, constants in (
        ('model.', MODEL),
        ('sensor.', ForceSensorParameters()),
        ('tip.', TIP),
        ('base.', BaseParameters()),
        ('indenter.', IndenterParameters()),
    ):
        for item in fields(constants):
            value = getattr(constants, item.name)
            if value != ():
                values[prefix + item.name] = list(value) if isinstance(value, tuple) else value
    return {**values, **changes}


def needle(mode: str = 'simulation', parameters: NeedleParameters = MODEL) -> Plant:
    """Create the plant as in the node."""
    state = NeedleModel(parameters).state_at(NODE['depth'], NODE['tip_deflection'])
    reach = parameters.minimum_depth, parameters.length
    return Plant(
        Integrator(parameters, state, NODE['step']),
        ForceSensor(ForceSensorParameters(), RATE, NODE['seed']),
        RATE,
        BaseMotion(BaseParameters(), NODE['depth'], reach, 100.0) if mode == 'robot' else None,
        TipSensor(TIP, RATE, NODE['seed']),
    )


def stamp(k: int) -> int:
    """Return the stamp of a sample, counted from 1 [ns]."""
    return BEGIN + k * PERIOD


def header(at: int) -> Any:
    time = message_type('builtin_interfaces/msg/Time')(*divmod(at, 10**9))
    return message_type('std_msgs/msg/Header')(time, '')


def vector(values: FloatArray | list[float]) -> Any:
    return message_type('geometry_msgs/msg/Vector3')(*map(float, values))


def wrench(at: int, numbers: FloatArray | list[float]) -> bytes:
    pair = message_type('geometry_msgs/msg/Wrench')(vector(numbers[:3]), vector(numbers[3:]))
    return encode(message_type(KINDS['/base_wrench'])(header(at), pair))


def joints(
    at: int,
    names: list[str],
    position: FloatArray | list[float],
    velocity: FloatArray | list[float],
    effort: list[float] | tuple[()] = (),
) -> bytes:
    arrays = (np.array(values, dtype=float) for values in (position, velocity, effort))
    return encode(message_type(KINDS['/joint_states'])(header(at), list(names), *arrays))


def tip(at: int, depth: float, deflection: float) -> bytes:
    point = message_type('geometry_msgs/msg/Point')(0.0, depth, deflection)
    return encode(message_type(KINDS['/tip_deflection'])(header(at), point))


def text(values: Mapping[str, Any]) -> bytes:
    document = yaml.safe_dump({'/plant': {'ros__parameters': values}})
    return encode(message_type(KINDS['/plant/configuration'])(document))


def event(at: int, number: int, kind: str, **content: object) -> Message:
    """Return the message of an event that takes effect at a sample."""
    pairs = [
        message_type('diagnostic_msgs/msg/KeyValue')(key, json.dumps(value))
        for key, value in {'sample': number, **content}.items()
    ]
    status = message_type('diagnostic_msgs/msg/DiagnosticStatus')(0, '/plant', kind, '', pairs)
    array = message_type(KINDS['/plant/events'])(header(at), [status])
    return Message('/plant/events', at + 500, 0, encode(array))


def beginning(**changes: object) -> list[Message]:
    """Return the messages of the configuration, and the events of the first sample."""
    values = configuration(**changes)
    return [
        Message('/plant/configuration', BEGIN - 1, 0, text(values)),
        event(stamp(1), 1, 'configured', **values),
        event(stamp(1), 1, 'time'),
    ]


def as_if(messages: list[Message], **changes: object) -> list[Message]:
    """Return a recording with other published parameters."""
    return [*beginning(**changes), *messages[len(beginning()) :]]


def without_events(messages: list[Message]) -> list[Message]:
    """Return a recording of a plant without events."""
    return [message for message in messages if message.topic != '/plant/events']


def trajectory(
    points: tuple[tuple[float, float], tuple[float, float], tuple[float, float]],
) -> bytes:
    duration = message_type('builtin_interfaces/msg/Duration')
    numbers = [np.zeros(0)] * 3
    made = [
        message_type('trajectory_msgs/msg/JointTrajectoryPoint')(
            np.array([depth]), *numbers, duration(*divmod(round(time * 1e9), 10**9))
        )
        for time, depth in points
    ]
    kind = message_type(KINDS['/joint_trajectory'])
    return encode(kind(header(0), ['insertion'], made))


@dataclass
class Message:
    """A message of a bag."""

    topic: str
    received: int
    stamp: int
    data: bytes


def measured(
    sample: PlantSample, k: int, torque: float, acting: float | None = None
) -> list[Message]:
    """Return the messages of a sample; ``acting`` is the force in mode simulation [N]."""
    state, at = sample.state, stamp(k)
    m = len(state) // 2
    names = ['d', 'theta', 'q1', 'q2']
    result = [Message('/base_wrench', 0, at, wrench(at, sample.wrench))]
    if sample.tip is not None:
        seen = at - sample.tip.age * PERIOD
        data = tip(seen, sample.tip.depth, sample.tip.deflection)
        result.append(Message('/tip_deflection', 0, seen, data))
    efforts = [] if acting is None else [-acting, torque, 0.0, 0.0]
    data = joints(at, names, state[:m], state[m:], efforts)
    result.append(Message('/ground_truth', 0, at, data))
    position, velocity = [sample.joint_position, state[1]], [sample.velocity, state[m + 1]]
    data = joints(at, ['insertion', 'rotation'], position, velocity, [sample.force, torque])
    result.append(Message('/joint_states', 0, at, data))
    for n, message in enumerate(result):
        message.received = at + 1000 + n
    return result


def force(k: int) -> float:
    """Return the command for a sample [N], different for each sample."""
    return 2.0 + 1.5 * sin(0.3 * k)


def simulated(
    late: tuple[int, ...] = (),
    lost: tuple[int, ...] = (),
    before: Callable[..., Any] | None = None,
) -> list[Message]:
    """
    Simulate a run under commands, each for a sample, which act one period later.

    Commands for the samples ``late`` arrive a period late, the samples ``lost`` are not recorded.
    ``before`` is called before each sample.
    """
    plant = needle()
    messages = beginning()
    held, newest, coming = 0.0, 0.0, None
    for k in range(1, SAMPLES + 1):
        if before is not None:
            before(plant, k)
        messages += measured(plant.advance(held, 1e-10 * held), k, 1e-10 * held, held)
        # The command newest at a sample acts until the next.
        held = newest
        if coming is not None:
            newest, coming = coming, None
        numbers = [0.0, force(k), 0.0, 1e-10 * force(k), 0.0, 0.0]
        command = Message('/wrench_command', stamp(k) + 2_000_000, stamp(k), b'')
        command.data = wrench(stamp(k), numbers)
        if k in late:
            coming = force(k)
            command.received += PERIOD
        else:
            newest = force(k)
        if k not in lost:
            messages.append(command)
    return messages


#: Times [s] and insertion depths [m] of a trajectory.
POINTS = ((0.1, 0.032), (0.2, 0.031), (0.25, 0.031))


def carried(comes: int, recorded: int) -> list[Message]:
    """Simulate a base that accepts a trajectory before a sample; it is recorded near another."""
    plant = needle('robot')
    times, depths = zip(*POINTS, strict=True)
    content: dict[str, Any] = {
        'joints': ['insertion'],
        'times': times,
        'positions': [[depth] for depth in depths],
        'efforts': [[]] * len(POINTS),
    }
    messages = [
        *beginning(mode='robot'),
        Message('/joint_trajectory', stamp(recorded) - 1_000_000, 0, trajectory(POINTS)),
        event(stamp(comes), comes, 'trajectory', **content),
    ]
    for k in range(1, SAMPLES + 1):
        if k == comes:
            plant.follow(**content)
        messages += measured(plant.advance(), k, 0.0)
    return messages


def written(path: Path, messages: Iterable[Message]) -> Path:
    """Write messages to a bag, in the order of receipt."""
    with BagWriter(path) as bag:
        for topic, kind in KINDS.items():
            bag.add_topic(topic, kind)
        for message in sorted(messages, key=lambda message: message.received):
            bag.write(message.topic, message.data, message.received)
    return path


def only(path: Path) -> Rerun:
    (result,) = verify(path)
    return result


def exact(result: Rerun) -> None:
    """Require that all numbers of all topics are bit-identical."""
    assert result.verdict == 'identical', result
    assert {topic.verdict for topic in result.topics.values()} == {'identical'}
    assert all(topic.compared for topic in result.topics.values())


# Identical runs.


def test_replay_of_a_run_under_commands_is_identical(tmp_path: Path) -> None:
    result = only(written(tmp_path / 'bag', simulated()))
    exact(result)
    assert result.recorded.numbers == list(range(1, SAMPLES + 1))
    assert {name: topic.compared for name, topic in result.topics.items()} == {
        '/joint_states': SAMPLES,
        '/base_wrench': SAMPLES,
        # Every fourth sample; a delay of three samples excludes the last measurement.
        '/tip_deflection': SAMPLES // 4 - 1,
        '/ground_truth': SAMPLES,
    }
    assert result.notes == []


def test_acting_force_is_taken_from_the_ground_truth(tmp_path: Path) -> None:
    """Commands may be late or missing."""
    messages = simulated(late=(20, 21, 60), lost=(40,))
    exact(only(written(tmp_path / 'bag', messages)))
    messages = [message for message in messages if message.topic != '/wrench_command']
    result = only(written(tmp_path / 'no commands', messages))
    exact(result)
    assert result.notes == []


@pytest.mark.parametrize('late', [(), (20,)])
def test_without_ground_truth_commands_act_after_a_period(
    tmp_path: Path, late: tuple[int, ...]
) -> None:
    """A late command causes a difference, with its reason."""
    messages = [m for m in simulated(late=late) if m.topic != '/ground_truth']
    result = only(written(tmp_path / 'bag', messages))
    assert result.notes == [
        'not in the bag: /ground_truth',
        (
            f'which command acted before {SAMPLES} samples is not in the bag: each is assumed '
            'to act one period after the sample that it responds to'
        ),
    ]
    if not late:
        exact(result)
    else:
        assert result.verdict == 'differs'
        assert result.reason == 'which command acted is not in the bag'
        # The command for sample 20 should act from sample 21 on.
        assert result.first is not None
        assert result.first['sample'] == 22


@pytest.mark.parametrize('shift', [-4, 0, 3])
def test_trajectories_start_at_the_sample_of_their_event(tmp_path: Path, shift: int) -> None:
    """At any time of recording, and without a recording of the trajectory."""
    messages = carried(40, 40 + shift)
    for name in ('bag', 'without'):
        result = only(written(tmp_path / name, messages))
        exact(result)
        assert result.notes == ['joint_trajectory from sample 40 on']
        messages = [message for message in messages if message.topic != '/joint_trajectory']


@pytest.mark.parametrize(('shift', 'verdict'), [(0, 'identical'), (2, 'differs')])
def test_without_events_trajectories_start_after_their_recording(
    tmp_path: Path, shift: int, verdict: str
) -> None:
    """They start with the next sample, which may be wrong."""
    messages = without_events(carried(40, 40 + shift))
    result = only(written(tmp_path / 'bag', messages))
    assert result.verdict == verdict
    unknown, begins = result.notes
    assert unknown.startswith('/plant/events is not in the bag')
    assert begins == f'joint_trajectory from sample {40 + shift} on'


def test_events_number_the_samples_of_late_recordings(tmp_path: Path) -> None:
    """Events are latched: a late recorder receives earlier events."""
    messages = [m for m in carried(40, 40) if m.stamp == 0 or m.stamp >= stamp(48)]
    result = only(written(tmp_path / 'bag', messages))
    exact(result)
    assert result.recorded.numbers[0] == 48
    assert result.notes == ['joint_trajectory from sample 40 on']


def test_lost_samples_are_computed(tmp_path: Path) -> None:
    """A best-effort subscription loses samples; the commands in the bag give the acting force."""
    gone = {stamp(k) for k in (30, 31, 32, 77)}
    measures = {'/joint_states', '/base_wrench', '/ground_truth'}
    messages = [m for m in simulated() if m.topic not in measures or m.stamp not in gone]
    result = only(written(tmp_path / 'bag', messages))
    exact(result)
    assert len(result.recorded.numbers) == SAMPLES - 4
    (note,) = result.notes
    assert note.startswith('which command acted before 4 samples is not in the bag')


def test_pauses_are_distinguished_from_lost_samples(tmp_path: Path) -> None:
    """After a pause the plant continues from its state, but the stamps have advanced."""
    shifted = [event(stamp(81) + 50 * PERIOD, 81, 'time')]
    for message in carried(40, 40):
        pause = 50 * PERIOD if message.received > stamp(81) else 0
        data, at = message.data, message.stamp + pause
        if message.stamp:
            # The stamp follows the encapsulation header.
            seconds, rest = divmod(at, 10**9)
            data = (
                data[:4] + seconds.to_bytes(4, 'little') + rest.to_bytes(4, 'little') + data[12:]
            )
        shifted.append(Message(message.topic, message.received + pause, at, data))
    shifted = [m for m in shifted if m.topic != '/tip_deflection']
    result = only(written(tmp_path / 'bag', shifted))
    exact(result)
    assert result.notes[-1] == 'time was paused, or samples were given up, before sample 81'
    # A truncated bag may lack the event.
    cut = only(written(tmp_path / 'cut', shifted[1:]))
    assert cut.reason == (
        'samples 81 to 130 are missing after the last message of /plant/events: the plant may '
        'have paused there'
    )


def test_tare_and_reset_are_replayed(tmp_path: Path) -> None:
    """At the samples of their events."""
    plant = needle('robot')
    messages = beginning(mode='robot')
    for k in range(1, SAMPLES + 1):
        if k == 50:
            plant.tare()
            messages.append(event(stamp(k), k, 'tare'))
        if k == 90:
            plant = needle('robot')
            messages.append(event(stamp(k), k, 'reset'))
        messages += measured(plant.advance(), k, 0.0)
    result = only(written(tmp_path / 'bag', messages))
    exact(result)
    assert result.notes == [
        'the sensor was zeroed (~/tare) before sample 50',
        'the plant was reset (~/reset) before sample 90',
    ]


@pytest.mark.parametrize('told', [True, False])
def test_parameter_changes_are_replayed(tmp_path: Path, told: bool) -> None:
    """By the event, or without events by the configuration recorded before the sample."""
    other = replace(MODEL, coulomb_friction=0.8)

    def changed(plant: Plant, k: int) -> None:
        if k == 50:
            plant.integrator.change(other)

    changes = {'model.coulomb_friction': 0.8}
    messages = simulated(before=changed)
    messages.append(event(stamp(50), 50, 'parameters', **changes))
    values = configuration(**changes)
    messages.append(Message('/plant/configuration', stamp(50) - 5, 0, text(values)))
    if not told:
        messages = without_events(messages)
    result = only(written(tmp_path / 'bag', messages))
    exact(result)
    assert result.notes[-1] == 'model.coulomb_friction changed before sample 50'


def test_reconfiguration_restarts_the_plant(tmp_path: Path) -> None:
    """Sample numbers continue; the parameters are in the event."""
    first, second = needle('robot'), needle('robot', replace(MODEL, coulomb_friction=0.8))
    values = configuration(mode='robot', **{'model.coulomb_friction': 0.8})
    messages = [*beginning(mode='robot'), event(stamp(60), 60, 'configured', **values)]
    for k in range(1, SAMPLES + 1):
        messages += measured((first if k < 60 else second).advance(), k, 0.0)
    result = only(written(tmp_path / 'bag', messages))
    exact(result)
    assert result.notes == ['the plant was configured again before sample 60']


# Runs that differ.


@pytest.mark.parametrize(
    ('topic', 'offset', 'quantity'),
    [
        ('/base_wrench', 20, 'force.x'),
        ('/joint_states', 60, 'position of insertion'),
        ('/ground_truth', 76, 'position of theta'),
    ],
)
def test_a_single_changed_sample_is_located(
    tmp_path: Path, topic: str, offset: int, quantity: str
) -> None:
    """Stamp, topic and value of the changed message are reported, and no other difference."""
    messages = simulated()
    message = next(m for m in messages if m.topic == topic and m.stamp == stamp(70))
    data = bytearray(message.data)
    recorded = np.frombuffer(bytes(data[offset : offset + 8]), dtype='<f8')[0] + 0.125
    data[offset : offset + 8] = np.float64(recorded).tobytes()
    message.data = bytes(data)
    result = only(written(tmp_path / 'bag', messages))
    assert result.verdict == 'differs'
    assert {name: found.differing for name, found in result.topics.items()} == {
        name: int(name == topic) for name in result.topics
    }
    first = result.first
    found = first['stamp'], first['sample'], first['topic'], first['quantity'], first['recorded']
    assert found == (stamp(70), 70, topic, quantity, recorded)
    # Tolerance for the rounding of the sum above.
    assert first['computed'] == pytest.approx(recorded - 0.125, abs=1e-12)
    assert 'one was altered in transit' in result.reason


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'model.viscous_friction': 250.0}, 'the plant was of another version, or its parameters'),
        (
            {'fault.kind': 'bias', 'fault.topic': 'joint_states'},
            'fault.kind = bias on joint_states',
        ),
    ],
    ids=['friction', 'fault'],
)
def test_changed_parameters_differ_with_a_reason(
    tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    """Parameters that differ from the run do not reproduce its samples."""
    changes = {'model.viscous_friction': 250.0, **changes}
    result = only(written(tmp_path / 'bag', as_if(simulated(), **changes)))
    assert result.verdict == 'differs'
    assert reason in result.reason
    # The needle moves when the command for sample 1 acts.
    assert result.first is not None
    assert result.first['sample'] <= 5


def test_changed_seeds_are_distinguished_from_changed_motion(tmp_path: Path) -> None:
    """Encoders have no noise: only force sensor and tip sensor differ."""
    result = only(written(tmp_path / 'bag', as_if(simulated(), seed=8)))
    assert result.verdict == 'differs'
    assert result.topics['/joint_states'].verdict == 'identical'
    reason = 'the motion is as computed: the seed or the constants of a sensor differ'
    assert result.reason == reason
    # At rest, a robot needs no joint_trajectory.
    kinds = '/joint_trajectory', '/plant/events'
    rest = [m for m in carried(SAMPLES + 1, SAMPLES + 1) if m.topic not in kinds]
    result = only(written(tmp_path / 'rest', as_if(rest, mode='robot', seed=8)))
    assert result.topics['/joint_states'].verdict == 'identical'
    assert result.reason == reason


def test_repeated_messages_are_counted(tmp_path: Path) -> None:
    """Equal configurations are no change of parameters."""
    once = without_events(carried(40, 40))
    result = only(written(tmp_path / 'bag', [one for m in once for one in (m, m)]))
    number = sum(m.topic == '/joint_states' for m in once)
    assert f'{number} of {2 * number} messages of /joint_states repeat a stamp' in result.notes
    assert not any('changed before' in note for note in result.notes)


@pytest.mark.parametrize('content', ['{not json', '', '[1, 2]'])
def test_unreadable_parameters_are_named(tmp_path: Path, content: str) -> None:
    messages = [m for m in simulated() if m.topic != '/plant/configuration']
    messages.append(
        Message(
            '/plant/configuration',
            stamp(1),
            0,
            encode(message_type('std_msgs/msg/String')(content)),
        )
    )
    with pytest.raises(RecordingError, match='/plant/configuration cannot be read as parameters'):
        verify(written(tmp_path / 'bag', messages))


def test_unknown_constants_are_reported(tmp_path: Path) -> None:
    """Constants of another version are ignored, a possible reason for a difference."""
    result = only(written(tmp_path / 'bag', as_if(simulated(), **{'model.tissue_density': 3.0})))
    assert result.notes == ['recorded by another version, with model.tissue_density']


def test_missing_commands_are_reported(tmp_path: Path) -> None:
    """The reason names the topics to record."""
    silent = [m for m in simulated() if m.topic not in ('/wrench_command', '/ground_truth')]
    result = only(written(tmp_path / 'bag', silent))
    assert result.verdict == 'differs'
    assert result.reason == (
        'the bag holds no wrench_command and no joint_commands: record them with the rest'
    )
    still = [m for m in without_events(carried(40, 40)) if m.topic != '/joint_trajectory']
    result = only(written(tmp_path / 'still', still))
    assert result.reason == 'the bag holds no joint_trajectory: record it with the rest'
    # The trajectory starts at sample 40.
    assert result.first is not None
    assert result.first['sample'] == 40


def test_differences_within_the_tolerance_are_accepted(tmp_path: Path) -> None:
    """The size of the difference is reported."""
    changes = {'model.viscous_friction': MODEL.viscous_friction * (1.0 + 1e-9)}
    path = written(tmp_path / 'bag', as_if(simulated(), **changes))
    (result,) = verify(path)
    assert result.verdict == 'within tolerance'
    found = result.topics['/joint_states']
    assert found.quantity == 'velocity of insertion'
    assert 0.0 < found.largest_difference < 1e-9
    (result,) = verify(path, 0.0)
    assert result.verdict == 'differs'


# Unusable recordings.


@pytest.mark.parametrize(
    ('kept', 'changes', 'complaint'),
    [
        (
            lambda m: m.topic != '/plant/configuration',
            {},
            'holds no parameters of a plant; record /plant/configuration',
        ),
        (
            lambda m: m.stamp == 0 or m.topic == '/wrench_command',
            {},
            'holds no measurements; record /base_wrench, /ground_truth, /joint_states',
        ),
        (bool, {'depth': 5.0}, 'the parameters of /plant: insertion depth'),
        (bool, {'mode': 'indenter'}, 'holds no measurements'),
    ],
    ids=['parameters', 'measurements', 'value', 'mode'],
)
def test_unusable_bags_are_a_one_line_error(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kept: Callable[..., Any] | type,
    changes: dict[str, Any],
    complaint: str,
) -> None:
    """The error names the bag and the missing content; the exit status is 2."""
    messages = as_if(simulated(), **changes)
    if changes.get('mode'):
        messages = [m for m in messages if m.topic != '/base_wrench']
    path = written(tmp_path / 'bag', filter(kept, messages))
    assert main(['verify', str(path)]) == 2
    said = capsys.readouterr().err
    assert str(path) in said
    assert complaint in said
    assert said.count('\n') == 1


def test_unusable_bags_are_skipped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Missing and damaged bags are reported; the usable bag has its row."""
    (tmp_path / 'bad.mcap').write_bytes(b'nothing of the kind')
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'empty/empty_0.mcap').touch()
    good = written(tmp_path / 'good', simulated())
    bags = [*map(str, (tmp_path / 'none', tmp_path / 'bad.mcap', tmp_path / 'empty', good))]
    assert main(['verify', *bags]) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert [line.split(':')[0] for line in lines] == ['error'] * 3
    for line in lines[1:]:
        assert 'holds no messages; ' in line
        assert 'is not an MCAP file' in line
    assert 'none does not exist' in captured.err
    assert '1 runs: 1 identical' in captured.out


def test_runs_of_sessions_have_different_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their bags are all folders with the name `bag`."""
    messages = [m for m in simulated() if m.topic != '/ground_truth']
    bags = [str(written(tmp_path / name / 'bag', messages)) for name in 'ab']
    assert main(['verify', *bags]) == 0
    said = capsys.readouterr().out
    rows = {line.split()[0] for line in said.splitlines() if line.endswith('identical')}
    assert rows >= {*bags}
    assert f'{bags[0]}, {bags[1]}: not in the bag: /ground_truth' in said


def test_note_on_two_runs_names_their_bag_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        for name in ('/left', '/right'):
            for topic, kind in KINDS.items():
                bag.add_topic(name + topic, kind)
            for message in simulated():
                bag.write(name + message.topic, message.data, message.received)
        bag.write('/left/wrench_command', b'', BEGIN)
    assert main(['verify', str(path)]) == 0
    *_, note, total = capsys.readouterr().out.splitlines()
    assert note == 'bag: 1 messages of /left/wrench_command are invalid'
    assert total == '2 runs: 2 identical'


def test_missing_parameters_are_named(tmp_path: Path) -> None:
    messages = without_events(simulated())
    values = configuration()
    del values['rate']
    messages[0].data = text(values)
    with pytest.raises(RecordingError, match=r"the parameters of /plant lack 'rate'"):
        verify(written(tmp_path / 'bag', messages))


def test_command_prints_tables_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit status 0 for identical runs, 1 for differences; JSON has the first difference."""
    same = written(tmp_path / 'same', simulated())
    other = written(tmp_path / 'other', as_if(simulated(), seed=8))
    assert main(['verify', str(same)]) == 0
    said = capsys.readouterr().out
    assert '/joint_states' in said
    assert said.splitlines()[-1] == '1 runs: 1 identical'
    assert main(['verify', str(same), str(other), '--json']) == 1
    first, second = json.loads(capsys.readouterr().out)
    assert (first['verdict'], first['first difference']) == ('identical', None)
    assert second['verdict'] == 'differs'
    assert second['first difference']['topic'] == '/base_wrench'
    assert second['topics']['/base_wrench']['unit'] in ('N', 'N m')
    assert main(['verify', str(other)]) == 1
    said = capsys.readouterr().out
    at = second['first difference']['stamp']
    assert f'other: differs first at {at // 10**9}.{at % 10**9:09d} s (sample ' in said
    assert main(['verify', str(same), '--tolerance', '2']) == 2
    assert '--tolerance must be in [0, 1), got 2' in capsys.readouterr().err


# Recordings of real nodes.


@pytest.mark.parametrize('name', ['friction', 'stiffness'])
def test_shipped_bags_are_reproduced(name: str) -> None:
    """All shipped bags are identical, up to the rounding of another machine."""
    for path in sorted(SHIPPED_BAGS.glob(f'{name}_*')):
        (result,) = verify(path)
        assert result.verdict in ('identical', 'within tolerance'), result
        assert result.recorded.numbers[0] == 1


@pytest.mark.parametrize(
    ('name', 'rate', 'speed'), [('friction', 100.0, 20.0), ('stiffness', 40.0, 40.0)]
)
def test_experiments_over_dds_are_reproduced(
    tmp_path: Path, name: str, rate: float, speed: float
) -> None:
    """A fresh recording of nodes on this machine is bit-identical."""
    campaign = Campaign(protocol=PROTOCOLS[name], repeats=1, rate=rate)
    (path,) = record(campaign, tmp_path, speed)
    result = only(path)
    exact(result)
    assert 'joint_trajectory from sample 1 on' in result.notes


def test_runs_under_commands_over_dds_are_reproduced(tmp_path: Path) -> None:
    """The replay is independent of the arrival of commands, also on a busy machine."""
    path = tmp_path / 'bag'
    with Graph(tmp_path / 'logs') as graph:
        node = graph.node('commander')
        publisher = node.create_publisher(WrenchStamped, 'wrench_command', COMMAND)
        heard = []

        def answer(message: JointState) -> None:
            heard.append(message)
            command = WrenchStamped()
            command.header.stamp = message.header.stamp
            command.wrench.force.y = force(len(heard))
            command.wrench.torque.x = 1e-3
            publisher.publish(command)

        node.create_subscription(JointState, 'joint_states', answer, SENSOR)
        recorder = graph.start('recorder', {'path': str(path)})
        graph.start('plant', {'autostart': False, 'rate': RATE, 'seed': 3})
        graph.wait_for(node, 'plant')
        topics = ['joint_states', 'base_wrench', 'tip_deflection', 'ground_truth']
        graph.change(node, 'plant', CONFIGURE)
        graph.spin_until(
            lambda: (
                publisher.get_subscription_count() == 2
                and all(node.count_subscribers(topic) for topic in topics)
                and node.count_subscribers('joint_states') == 2
            ),
            'the nodes',
        )
        graph.change(node, 'plant', ACTIVATE)
        graph.spin_until(lambda: len(heard) > 300, 'the samples')
        recorder.interrupt()
    result = only(path)
    exact(result)
    assert result.topics['/joint_states'].compared > 250


def test_all_plant_inputs_are_replayed(tmp_path: Path) -> None:
    """Also inputs before the start of the recorder: events are latched."""
    path = tmp_path / 'bag'
    with Graph(tmp_path / 'logs') as graph:
        node = graph.node('operator')
        heard: list[JointState] = []
        course = node.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        node.create_subscription(JointState, 'joint_states', heard.append, SENSOR)

        def further(count: int) -> None:
            seen = len(heard)
            graph.spin_until(lambda: len(heard) >= seen + count, 'samples')

        def call(kind: Any, name: str, request: Any) -> Any:
            client = node.create_client(kind, f'plant/{name}')
            graph.spin_until(client.service_is_ready, name)
            answer = client.call_async(request)
            graph.spin_until(answer.done, name)
            return answer.result()

        graph.start('plant', {'mode': 'robot', 'rate': RATE, 'depth': 0.1, 'seed': 3})
        graph.spin_until(lambda: heard and course.get_subscription_count(), 'the plant')
        further(40)
        assert call(Trigger, 'tare', Trigger.Request()).success
        points = [JointTrajectoryPoint(positions=[0.11]), JointTrajectoryPoint(effort=[2.0])]
        for second, point in enumerate(points, 1):
            point.time_from_start.sec = second
        course.publish(JointTrajectory(joint_names=['insertion'], points=points))
        further(100)
        recorder = graph.start('recorder', {'path': str(path)})
        graph.spin_until(lambda: node.count_subscribers('joint_states') == 2, 'the recorder')
        further(200)
        friction = Parameter('model.coulomb_friction', value=0.8).to_parameter_msg()
        changed = call(
            SetParameters, 'set_parameters', SetParameters.Request(parameters=[friction])
        )
        assert changed.results[0].successful
        further(40)
        assert call(SetBool, 'pause_time', SetBool.Request(data=True)).success
        # A pause of some periods.
        time.sleep(0.05)
        assert call(SetBool, 'pause_time', SetBool.Request(data=False)).success
        further(40)
        assert call(Trigger, 'reset', Trigger.Request()).success
        further(40)
        graph.change(node, 'plant', DEACTIVATE, ACTIVATE)
        further(40)
        recorder.interrupt()
    result = only(path)
    exact(result)
    assert result.recorded.numbers[0] > 100
    said = [re.sub(r' (before|from) sample \d+.*', '', note) for note in result.notes]
    # A stall of a busy machine also counts as a pause, and in real time it can lose samples.
    pause = 'time was paused, or samples were given up,'
    inputs = [note for note in said if note != pause and not note.startswith('the recorder lost ')]
    assert inputs == [
        'the sensor was zeroed (~/tare)',
        'joint_trajectory',
        'model.coulomb_friction changed',
        'the plant was reset (~/reset)',
    ]
    assert said.count(pause) >= 2


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('rate', 'x', "rate must be a number, or text with a unit of Hz, got 'x'"),
        ('rate', 0, 'rate must be finite, >= 1 and <= 8000 Hz, got 0.0'),
        ('rate', float('nan'), 'rate must be finite, >= 1 and <= 8000 Hz, got nan'),
        ('seed', -1, f'seed must be an integer from 0 to {2**62}, got -1'),
        ('seed', 'x', f"seed must be an integer from 0 to {2**62}, got 'x'"),
        ('seed', 1.5, f'seed must be an integer from 0 to {2**62}, got 1.5'),
        ('seed', True, f'seed must be an integer from 0 to {2**62}, got True'),
        ('needle', ['phantom'], 'needle must be one of '),
        ('mode', {}, 'mode must be one of '),
    ],
)
def test_invalid_plant_parameters_are_named(
    tmp_path: Path, name: str, value: object, reason: str
) -> None:
    """The plant would reject them; nothing is computed."""
    messages = without_events(simulated())
    messages[0].data = text(configuration(**{name: value}))
    with pytest.raises(RecordingError, match=re.escape(f'the parameters of /plant: {reason}')):
        verify(written(tmp_path / 'bag', messages))
