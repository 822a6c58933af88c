# SPDX-License-Identifier: Apache-2.0
"""Page of `needle watch`: frames, recordings, and access control."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from functools import partial
import json
from math import inf, nan
import os
from pathlib import Path
import re
import signal
import socket
import subprocess
import sys
from time import monotonic
from typing import Any

from aiohttp import ClientSession, ClientWebSocketResponse, WSMsgType, WSServerHandshakeError
from hypothesis import given
from hypothesis import strategies as st
from needle_identification import BagWriter, RecordingError
from needle_identification.bags.messages import encode
from needle_insertion import cli
from needle_insertion.watch import recorded, server
from needle_insertion.watch.live import Live, LiveReader, RecordedReader
from needle_insertion.watch.recorded import PagePlayback, ShownRecording
from needle_insertion.watch.server import BEAT, LONGEST, MOST_READERS, Server
from needle_insertion.watch.view import scene, SIGNALS, View
from needle_ros import contract
from needle_ros.errors import JobError, MessageError, ParameterError
from needle_ros.parameter_file import parameters_in
from needle_ros.status import ControllerStatus, SteeringStatus
from needle_ros.wire import read_line, Reading
import numpy as np
import pytest
from support.anatomies import plan_of
from support.installed import ROOT
from support.samples import EPOCH, simulated, write_bag
from support.watched import (
    CONFIGURATIONS,
    DURATION,
    expected,
    marker,
    RATE,
    report,
    shape,
    TARGET,
    write_watched,
)


def joints(names: tuple[str, ...], *values: tuple[float, ...]) -> Reading:
    """Return a reading of joints."""
    return Reading(0, '', names, values)


def numbers(*values: float) -> Reading:
    """Return a reading of a type without joints."""
    return Reading(0, '', (), (values,))


def told(view: View, *names: str) -> None:
    """Store the configurations of nodes in a view."""
    for name in names:
        view.configuration(name, parameters_in(CONFIGURATIONS[name]))


# Frames.


def test_frame_contains_received_measurements() -> None:
    """Depth, velocity, force of the sensor, reference, error, tip and guide, in SI units."""
    view = View()
    view.reading(
        'joint_states',
        joints(('insertion', 'guide_x', 'guide_z'), (0.05, 1e-3, 2e-3), (0.01, 0, 0), (3.0, 0, 0)),
        1.0,
    )
    assert view.frame(1.0)['force'] == 3.0
    assert view.frame(1.0)['sensed'] is False
    view.reading('base_wrench', numbers(0.1, 2.5, 0.2, 0.0, 0.0, 0.0), 1.0)
    view.reading('tip_deflection', numbers(3e-3, 0.05, -1e-3), 1.0)
    view.reading('reference', joints(('insertion',), (0.051,), (0.01,), ()), 1.0)
    view.reading('tracking_error', joints(('insertion',), (0.001,), (0.0,), ()), 1.0)
    seen = view.frame(1.25)
    assert {
        'time': 1.25, 'depth': 0.05, 'velocity': 0.01, 'force': 2.5, 'sensed': True,
        'reference': 0.051, 'error': 0.001, 'tip': [3e-3, 0.05, -1e-3], 'guide': [1e-3, 2e-3],
        'roll': None, 'target': None, 'expected': None, 'silent': {}, 'nodes': [],
    }.items() <= seen.items()  # fmt: skip
    assert dict(zip(['time', *SIGNALS], view.row(1.25), strict=True)) == {
        'time': 1.25, 'depth': 0.05, 'reference': 0.051, 'velocity': 0.01, 'error': 0.001,
        'force': 2.5, 'force_x': 0.1, 'force_z': 0.2, 'roll': None,
        'tip_x': 3e-3, 'tip_z': -1e-3, 'guide_x': 1e-3, 'guide_z': 2e-3,
    }  # fmt: skip


any_number = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(any_number, min_size=3, max_size=3), st.integers(0, 3), st.floats(0.0, 1e150))
def test_frame_of_any_measurement_is_json(
    values: list[float], count: int, deviation: float
) -> None:
    """Numbers that are not finite, and joints without numbers, are None, as JSON requires."""
    view = View()
    view.reading('joint_states', joints(('insertion',) * count, tuple(values), (), ()), 0.0)
    view.reading('tip_deflection', numbers(*values), 0.0)
    view.reading('base_wrench', numbers(*values, *values), 0.0)
    view.line('needle', np.array([values, [0.0, 0.1, 0.0]]), 0.0)
    view.expected(expected(values[0], values[1], deviation))
    said = json.loads(json.dumps(view.frame(0.0), allow_nan=False))
    for shown, value in zip(said['tip'], values, strict=True):
        assert shown is None if not abs(value) < inf else shown == round(value, 7)


def test_shape_is_simulated_or_straight_line() -> None:
    """Without a recent shape a straight needle is drawn, and labeled."""
    view = View()
    assert view.frame(0.0)['shape'] is None
    told(view, 'plant')
    state = joints(('insertion', 'guide_x'), (0.05, 1e-3), (), ())
    view.reading('joint_states', state, 0.0)
    view.reading('tip_deflection', numbers(3e-3, 0.05, -1e-3), 0.0)
    straight = view.frame(0.0)
    assert straight['shape'] == 'straight'
    # From the base through the guide, 4 cm before the skin, to the tip.
    assert straight['needle'] == [[1e-3, 1e-3, 3e-3], [-0.15, -0.04, 0.05], [0.0, 0.0, -1e-3]]
    # A tip far away is not part of it.
    view.reading('tip_deflection', numbers(-3.7e28, 0.05, -1e-3), 0.1)
    assert view.frame(0.1)['needle'] == [[1e-3] * 3, [-0.15, -0.04, 0.05], [0.0] * 3]
    view.line('needle', shape(0.05), 0.5)
    view.line('path', shape(0.05)[20:], 0.5)
    bent = view.frame(0.6)
    assert bent['shape'] == 'simulated'
    np.testing.assert_allclose(np.transpose(bent['needle']), shape(0.05), atol=1e-6)
    later = view.frame(2.0)
    assert later['shape'] == 'straight'
    # The cut path stays.
    assert later['path'] == bent['path']


def test_decimated_line_keeps_its_ends() -> None:
    """A line has at most 120 points, including the first and the last point."""
    view = View()
    points = np.linspace([0.0, -0.04, 0.0], [1e-3, 0.1, 2e-3], 5000)
    view.line('path', points, 0.0)
    seen = np.transpose(view.frame(0.0)['path'])
    assert len(seen) == 120
    np.testing.assert_allclose(seen[[0, -1]], points[[0, -1]], atol=1e-6)


def test_silent_topics_and_nodes_are_reported() -> None:
    """Timeouts: topics after 1 s, nodes after 3 s; a target has no timeout."""
    view = View()
    view.reading('joint_states', joints(('insertion',), (0.05,), (), ()), 0.0)
    view.reading('target', numbers(0.0, 0.1, 0.0), 0.0)
    view.report(report('/plant', 'active'), 0.0)
    assert view.frame(0.9)['silent'] == {}
    seen = view.frame(2.5)
    assert seen['silent'] == {'joint_states': 2.5}
    assert not seen['nodes'][0]['silent']
    (plant,) = view.frame(4.0)['nodes']
    assert (plant['silent'], plant['age'], plant['words']) == (True, 4.0, 'active')


def test_nodes_are_sorted_by_level() -> None:
    """Each node once, with its newest status; control characters are replaced."""
    view = View()
    view.report(report('/a', 'active'), 0.0)
    view.report(report('/b', 'no\njoint_states\x1b[2J', level=1), 0.0)
    view.report(report('/c', 'active'), 0.0)
    stopped = SteeringStatus(step=3, steps=20, hit_probability=0.25, last_rejection='a\nb')
    view.report(report('/c', 'stopped', stopped, level=2), 1.0)
    nodes = view.frame(1.0)['nodes']
    assert [(one['name'], one['level']) for one in nodes] == [('/c', 2), ('/b', 1), ('/a', 0)]
    assert [nodes[0][key] for key in ('step', 'steps', 'last_rejection')] == [3, 20, 'a b']
    assert nodes[1]['last_rejection'] == ''
    assert view.frame(1.0)['hit_probability'] == 0.25
    assert nodes[1]['words'] == 'no joint_states?[2J'


def test_target_is_accepted_target_of_diagnostics() -> None:
    """The topic is used only without nodes of this package."""
    view = View()
    view.reading('target', numbers(1e-3, 0.2, 0.0), 0.0)
    assert view.frame(0.0)['target'] == [1e-3, 0.2, 0.0]
    view.report(report('/controller', 'active', ControllerStatus()), 0.0)
    assert view.frame(0.0)['target'] is None
    view.report(report('/controller', 'active', ControllerStatus(target=0.08)), 0.0)
    assert view.frame(0.0)['target'] == [None, 0.08, None]
    told(view, 'steering')
    assert view.frame(0.0)['target'] is None
    view.report(report('/steering', 'inserts', SteeringStatus(target=TARGET)), 0.0)
    assert view.frame(0.0)['target'] == list(TARGET)
    view.report(report('/steering', 'waits', SteeringStatus()), 0.0)
    assert view.frame(0.0)['target'] is None


def test_predicted_tip_has_95_percent_interval() -> None:
    """1.96 standard deviations on each side; no prediction without finite numbers."""
    view = View()
    view.expected(expected(1e-3, 2e-3, deviation=1e-3))
    assert view.frame(0.0)['expected'] == {
        'at': [1e-3, 0.1, 2e-3], 'half': [1.96e-3, 1.96e-3], 'correlation': 0.0,
    }  # fmt: skip
    view = View()
    view.expected(expected(nan, 2e-3, deviation=1e-3))
    assert view.frame(0.0)['expected'] is None
    assert view.frame(0.0)['invalid'] == 1


def test_tissue_and_limits_follow_from_configurations() -> None:
    """Layers, membranes and free length of the plant; limits and depths of the controller."""
    found = scene({name: parameters_in(text) for name, text in CONFIGURATIONS.items()})
    assert found == {
        'tissue': {
            'of': 'plant', 'length': 0.2, 'free': 0.04,
            'layers': [[0.0, 520.0], [0.04, 20000.0]], 'membranes': [[0.03, 1.2]],
        },
        'limits': {
            'force': 15.0, 'load': 30.0, 'speed': 0.1, 'error': 0.01, 'deflection': 0.05,
            'low': 0.001, 'high': 0.2,
        },
        'steered': True,
    }  # fmt: skip
    assert scene({}) == {'tissue': None, 'limits': {}, 'steered': False}


@pytest.mark.parametrize('value', [True, float('nan'), 10**400, '0.04'])
def test_invalid_number_of_a_configuration_is_left_out(value: object) -> None:
    """Alone and in a list: a Boolean is not 1, and an integer of 400 digits is no float."""
    stiffnesses = {'model.layer_stiffnesses': [2e4, 3e4]}
    plant = {'model.length': value, 'model.layer_depths': [value, 0.05], **stiffnesses}
    found = scene({'plant': plant, 'controller': {'force_limit': value}})
    assert found['tissue']['length'] is None
    assert found['tissue']['layers'] == [[0.0, 0.0], [0.05, 2e4]]
    assert found['limits'] == {}


@pytest.mark.parametrize(
    'text', ['', '- 1', 'a: b', 'a: {ros__parameters: 3}', '{', 'a: &x [*x]', 'a: {}\nb: {}']
)
def test_invalid_configuration_is_ignored(text: str) -> None:
    """It is counted as an unreadable message."""
    view = View()
    view.configuration('plant', parameters_in(text))
    assert view.scene['tissue'] is None
    assert view.frame(0.0)['invalid'] == 1


@given(
    st.dictionaries(
        st.sampled_from(['model.length', 'model.layer_depths', 'force_limit', 'highest_depth']),
        st.one_of(st.none(), st.text(), st.booleans(), any_number, st.lists(any_number)),
    )
)
def test_scene_of_any_configuration_is_json(parameters: dict[str, Any]) -> None:
    """Numbers that are not finite are left out."""
    json.dumps(scene({'plant': parameters, 'controller': parameters}), allow_nan=False)


def test_line_is_parsed_from_bytes() -> None:
    """Name and points of a marker; truncated bytes are rejected."""
    data = encode(marker('path', shape(0.05)))
    name, points = read_line(data)
    assert name == 'path'
    np.testing.assert_array_equal(points, shape(0.05))
    for end in (0, 3, 40, len(data) // 2):
        with pytest.raises(MessageError):
            read_line(data[:end])


# Recordings.


@pytest.fixture(scope='module')
def watched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag with all shown topics."""
    path = tmp_path_factory.mktemp('watched') / 'bag'
    write_watched(path)
    return path


@pytest.mark.parametrize('space', ['', '/robot'])
def test_bag_shows_measurements_at_any_time(tmp_path: Path, space: str) -> None:
    """Also of nodes in a namespace."""
    write_watched(tmp_path / 'bag', space)
    bag = ShownRecording(tmp_path / 'bag')
    assert bag.duration == DURATION
    assert bag.losses == ()
    for time in (1.0, 3.0, 1.0):
        seen = bag.view(time).frame(time)
        # At 20 mm/s the newest reading, less than 50 ms old, is within 1 mm.
        assert seen['depth'] == pytest.approx(0.02 * time, abs=1e-3)
        assert seen['force'] == pytest.approx(2.0 + time, abs=0.05)
        assert seen['shape'] == 'simulated'
        assert seen['needle'][1][-1] == pytest.approx(0.02 * time, abs=1e-3)
        assert seen['target'] == list(TARGET)
        assert seen['expected']['half'][0] == pytest.approx(1.96e-3 / (1.0 + int(time)))
        levels = {one['name']: (one['level'], one['silent']) for one in seen['nodes']}
        assert levels['/steering'] == (time > 2.5, False)
    assert {one['name']: one['silent'] for one in bag.view(3.9).frame(3.9)['nodes']} == {
        '/steering': False, '/plant': False, '/controller': True,
    }  # fmt: skip
    assert bag.view(0.0).scene['tissue']['of'] == 'plant'
    signals = bag.signals()
    assert [*signals] == [*SIGNALS]
    times, depths = map(np.array, signals['depth'])
    # Every sample; numbers are rounded to 1e-7.
    assert len(times) == round(DURATION * RATE) + 1
    np.testing.assert_allclose(depths, 0.02 * times, atol=1e-7)


def stamped(path: Path, times: np.ndarray, received: np.ndarray) -> ShownRecording:
    """Write depths at stamps [s], received at other times [s]; return them by both clocks."""
    write = contract.JOINT_STATES.template().serialize
    with BagWriter(path) as bag:
        bag.add_topic('/joint_states', contract.JOINT_STATES.type_name)
        for time, at in zip(times, received, strict=True):
            stamp = EPOCH + round(1e9 * time)
            bag.write(
                '/joint_states', write(stamp, 0.01 * time, *[0.0] * 5), EPOCH + round(1e9 * at)
            )
    return ShownRecording(path)


def test_times_are_of_the_headers(tmp_path: Path) -> None:
    """Messages that arrive late and together are shown at their stamps."""
    times = np.linspace(0.0, 2.0, 101)
    path = tmp_path / 'bag'
    bag = stamped(path, times, np.ceil(2.0 * times) + 5.0)
    assert bag.duration == 2.0
    assert bag.view(1.0).frame(1.0)['depth'] == pytest.approx(0.01, abs=1e-7)
    received = ShownRecording(path, 'receive')
    assert received.duration == pytest.approx(4.0)
    assert set(received.signals()['depth'][0]) == {0.0, 1.0, 2.0, 3.0, 4.0}


def test_contradicting_clocks_are_reported(tmp_path: Path) -> None:
    """One sample of another epoch makes the recording long."""
    times = np.linspace(0.0, 2.0, 101)
    bag = stamped(tmp_path / 'bag', np.append(times, 1e4), np.append(times, 2.02))
    (loss,) = bag.losses
    assert loss.endswith('within 2.02 s: use --time receive if clocks differed')


def test_pause_of_a_topic_is_a_gap(tmp_path: Path) -> None:
    times = np.concatenate([np.arange(50), np.arange(100, 150)]) / 50.0
    found, depths = stamped(tmp_path / 'bag', times, times).signals()['depth']
    assert depths.count(None) == 1
    k = depths.index(None)
    assert found[k - 1 : k + 2] == [0.98, 2.0, 2.0]


def test_row_of_a_silent_topic_is_a_gap() -> None:
    """Live, too: values are None from the timeout on."""
    view = View()
    view.reading('joint_states', joints(('insertion',), (0.02,), (), ()), 0.0)
    column = 1 + [*SIGNALS].index('depth')
    assert view.row(0.9)[column] == 0.02
    assert view.row(1.1)[column] is None


def test_bag_of_robot_has_straight_shape(tmp_path: Path) -> None:
    """Depth and force are shown, and the needle is straight."""
    write_bag(tmp_path / 'bag', simulated())
    bag = ShownRecording(tmp_path / 'bag')
    seen = bag.view(2.0).frame(2.0)
    assert seen['shape'] == 'straight'
    assert seen['depth'] > 0.02


def mark(view: View, number: int) -> None:
    """Store a number in a view."""
    view.invalid = number


def test_long_recording_is_decimated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages above the limit are decimated by two, over the whole recording."""
    monkeypatch.setattr(recorded, '_MOST', 100)
    kept = recorded._Kept(1.0 / 30.0)
    for k in range(100_000):
        kept.add(k / 100.0, partial(mark, number=k))
    assert 40 < len(kept._times) <= 100
    view = View()
    for time in (0.0, 1.0, 500.0, 999.0):
        kept.show(view, time)
        assert 0.0 <= time - view.invalid / 100.0 <= kept.interval + 0.02
    kept.show(view, -1.0)
    assert view.invalid > 0


def file_of(bag: Path) -> Path:
    """Return the file in the folder of a bag."""
    (file,) = bag.glob('*.mcap')
    return file


def test_readable_part_of_damaged_bag_is_shown(watched: Path, tmp_path: Path) -> None:
    """The page receives the losses with its first frame."""
    file = tmp_path / 'cut.mcap'
    data = file_of(watched).read_bytes()
    file.write_bytes(data[: 2 * len(data) // 3])
    bag = ShownRecording(file)
    assert 0.5 < bag.duration < DURATION
    first = asyncio.run(asyncio.wait_for(RecordedReader(bag).next(), 60.0))
    losses = json.loads(first)['setting']['recording']['losses']
    assert losses == [*bag.losses]
    assert 'cut.mcap' in losses[0]
    assert bag.view(0.5).frame(0.5)['depth'] == pytest.approx(0.01, abs=1e-3)


def unusable(folder: Path, what: str) -> Path:
    """Write a bag without content for the page."""
    path = folder / 'bag'
    if what == 'damaged':
        (folder / 'bag.mcap').write_bytes(bytes(range(256)) * 40)
        return folder / 'bag.mcap'
    if what == 'empty':
        recorded_bag = folder / 'other'
        write_watched(recorded_bag)
        data = file_of(recorded_bag).read_bytes()
        (folder / 'bag.mcap').write_bytes(data[:60])
        return folder / 'bag.mcap'
    if what == 'of others':
        with BagWriter(path) as bag:
            bag.add_topic('/chatter', 'std_msgs/msg/String')
            data = CONFIGURATIONS['plant'].encode()
            bag.write('/chatter', b'\0\1\0\0' + len(data).to_bytes(4, 'little') + data, 0)
    if what == 'invalid':
        with BagWriter(path) as bag:
            bag.add_topic('/joint_states', contract.JOINT_STATES.type_name)
            bag.write('/joint_states', b'\0\1\0\0no', 0)
    return path


@pytest.mark.parametrize('what', ['damaged', 'empty', 'of others', 'invalid', 'missing'])
def test_bag_without_content_is_rejected(
    tmp_path: Path, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line with its name, and status 2."""
    path = unusable(tmp_path, what)
    with pytest.raises(RecordingError):
        ShownRecording(path)
    assert cli.main(['watch', str(path), '--port', '0']) == 2
    said = capsys.readouterr()
    assert said.out == ''
    (line,) = said.err.splitlines()
    assert line.startswith('error: ')
    assert path.name in line


def test_playback_follows_speed_and_jumps() -> None:
    """Time advances with the speed, up to the end."""
    now = 100.0
    play = PagePlayback(10.0, lambda: now)
    assert play.playing
    now += 2.0
    assert play.at == 2.0
    play.take({'speed': 2.0})
    now += 1.0
    assert play.at == 4.0
    play.take({'play': False})
    now += 5.0
    assert play.at == 4.0
    play.take({'at': 9})
    assert play.at == 9.0
    play.take({'play': True})
    now += 5.0
    assert (play.at, play.playing) == (10.0, False)
    # At the end it restarts.
    play.take({'play': True})
    assert play.at == 0.0
    play.take({'at': 1e9})
    assert play.at == 10.0


@pytest.mark.parametrize(
    'message',
    [{}, {'at': '1'}, {'at': True}, {'play': 1}, {'speed': 0}, {'speed': 1e3}, {'at': 1, 'b': 2}],
)
def test_invalid_playback_message_is_rejected(message: dict[str, Any]) -> None:
    """The error lists the valid messages."""
    with pytest.raises(ParameterError, match='a recording accepts'):
        PagePlayback(10.0).take(message)


# Server.


class Counting:
    """Source of numbered frames: a new frame per request."""

    def __init__(self) -> None:
        self.number = 0
        self.taken: list[dict[str, Any]] = []

    async def next(self) -> str:
        self.number += 1
        await asyncio.sleep(0.001)
        return json.dumps({'frame': self.number})

    def take(self, message: dict[str, Any]) -> None:
        if 'at' not in message:
            raise ParameterError('takes at')
        self.taken.append(message)


class Buttons:
    """Control that records requests; a retraction ends on release."""

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.free = asyncio.Event()

    async def target(self, x: float, y: float, z: float) -> tuple[bool, str]:
        if y > 1.0:
            raise JobError('no node subscribes to target')
        self.done.append((x, y, z))
        return True, 'steering: target accepted'

    async def ask(self, what: str) -> tuple[bool, str]:
        self.done.append(what)
        if what == 'retract':
            await self.free.wait()
        return what != 'clear', f'{what} it is'


class Page:
    """Server with a client session."""

    def __init__(self, server: Server, session: ClientSession, made: list[Counting]) -> None:
        self.server, self.session, self.made = server, session, made
        self.url = server.address.partition('#')[0]
        self.port = self.url.rstrip('/').rpartition(':')[2]

    async def open(self, **headers: str) -> ClientWebSocketResponse:
        """Open the WebSocket of frames."""
        return await self.session.ws_connect(f'{self.url}frames', headers=headers)

    async def tell(self, stream: ClientWebSocketResponse, message: object) -> dict[str, Any]:
        """Send a message and return its answer."""
        await stream.send_str(message if isinstance(message, str) else json.dumps(message))
        return await answer(stream)


async def answer(stream: ClientWebSocketResponse) -> dict[str, Any]:
    """Return the next answer; acknowledge frames in between."""
    while True:
        said = await asyncio.wait_for(stream.receive_json(), 60.0)
        if 'answer' in said:
            return said['answer']
        await stream.send_json({'seen': 1})


async def frame(stream: ClientWebSocketResponse) -> Any:
    """Return the next frame, without the clock before it."""
    while 'frame' not in (message := await asyncio.wait_for(stream.receive_json(), 60.0)):
        assert message.keys() == {'clock'}
    return message['frame']


@asynccontextmanager
async def served(control: Buttons | None = None, **options: Any) -> AsyncIterator[Page]:
    """Serve numbered frames."""
    made: list[Counting] = []

    def reader() -> Counting:
        made.append(Counting())
        return made[-1]

    server = Server(reader, **{'port': 0, 'control': control, **options})
    await server.start()
    try:
        async with ClientSession() as session:
            yield Page(server, session, made)
    finally:
        await server.end()


def in_loop(test: Callable[[], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    """Run an asynchronous test in an event loop."""

    def run() -> None:
        asyncio.run(asyncio.wait_for(test(), 300.0))

    run.__doc__, run.__name__ = test.__doc__, test.__name__
    return run


@in_loop
async def test_page_has_no_external_content() -> None:
    """No file names another server, and the policy forbids other origins."""
    async with served() as page:
        for name in ('', 'watch.css', 'charts.js', 'watch.js', 'needle.js'):
            async with page.session.get(page.url + name) as reply:
                assert reply.status == 200
                text = await reply.text()
                assert not re.search(r'https?:|//\w+\.\w|@import|url\(', text), name
                policy = reply.headers['Content-Security-Policy']
                assert policy.startswith("default-src 'none'; script-src 'self'; ")
                assert 'http' not in policy
                assert reply.headers['X-Frame-Options'] == 'DENY'
        for name in ('nothing', '..%2fserver.py', 'watch.html'):
            async with page.session.get(page.url + name) as reply:
                assert reply.status == 404


@pytest.mark.requirement('S-161')
@in_loop
async def test_foreign_host_header_is_rejected() -> None:
    """DNS rebinding: a foreign name that resolves to 127.0.0.1 is rejected."""
    async with served() as page:
        for host in (
            f'evil.example:{page.port}', 'evil.example', '127.0.0.1', '127.0.0.1:1', '',
            f'127.0.0.1.evil.example:{page.port}', f'8.8.8.8:{page.port}', '[::1',
            f'@:{page.port}', f'evil@127.0.0.1:{page.port}', f'127.0.0.1:{page.port}/x',
            f'127.0.0.1:{page.port}?x', f'127.0.0.1:0{page.port}',
        ):  # fmt: skip
            async with page.session.get(page.url, headers={'Host': host}) as reply:
                assert reply.status in (400, 403), host
                assert 'needle' not in (await reply.text()).partition('header Host')[0]
            with pytest.raises(WSServerHandshakeError):
                await page.open(Host=host)
        for host in (f'localhost:{page.port}', f'127.0.0.1:{page.port}'):
            async with page.session.get(page.url, headers={'Host': host}) as reply:
                assert reply.status == 200


@pytest.mark.requirement('S-161')
@in_loop
async def test_foreign_origin_is_rejected() -> None:
    """Cross-site requests: the WebSocket of a foreign page is rejected."""
    async with served(Buttons()) as page:
        for origin in ('http://evil.example', 'null', 'https://127.0.0.1', 'http://127.0.0.1:1'):
            with pytest.raises(WSServerHandshakeError, match='403'):
                await page.open(Origin=origin)
        stream = await page.open(Origin=page.url.rstrip('/'))
        assert await frame(stream) == 1


@pytest.mark.requirement('S-161')
@in_loop
async def test_commands_require_token() -> None:
    """A missing or wrong token has no effect, and the answer explains the source of the token."""
    buttons = Buttons()
    async with served(buttons) as page:
        token = page.server.token
        assert len(token) >= 32
        assert page.server.address.endswith(f'#token={token}')
        stream = await page.open()
        for wrong in (None, '', 'x', token[:-1], token + 'x', 3, [token], 'ü', '\ud800'):
            message = {'ask': 'stop'} if wrong is None else {'ask': 'stop', 'token': wrong}
            said = await page.tell(stream, message)
            assert said['success'] is False
            assert 'open the URL printed by needle watch' in said['words']
        assert buttons.done == []
        said = await page.tell(stream, {'ask': 'stop', 'token': token})
        assert said == {'asked': 'stop', 'success': True, 'words': 'stop it is'}
        proof = {'token': token, 'clicked': monotonic()}
        said = await page.tell(stream, {'ask': 'clear', **proof})
        assert said['success'] is False
        said = await page.tell(stream, {'ask': 'target', 'at': [1e-3, 0.1, 0], **proof})
        assert said['words'] == 'steering: target accepted'
        assert buttons.done == ['stop', 'clear', (1e-3, 0.1, 0.0)]
    async with served(Buttons()) as page:
        assert page.server.token != token


@in_loop
async def test_page_without_control_rejects_commands() -> None:
    """There is no token, and any token is rejected."""
    async with served() as page:
        assert page.server.token == ''
        assert '#' not in page.server.address
        stream = await page.open()
        for token in ('', 'x'):
            said = await page.tell(stream, {'ask': 'stop', 'token': token})
            assert said['success'] is False
            assert said['words'] == 'this page is read-only: use needle watch --control'


@in_loop
async def test_invalid_command_is_rejected() -> None:
    """The answer lists valid commands, without any effect."""
    buttons = Buttons()
    async with served(buttons) as page:
        stream, token = await page.open(), page.server.token
        for message, words in (
            ({'ask': 'fly'}, 'ask must be one of target, pause, resume, retract, stop, clear, '),
            ({'ask': ['stop']}, 'ask must be one of'),
            ({'ask': 'stop', 'more': 1}, 'ask must be one of'),
            ({'ask': 'target'}, 'a target is {"at": [x, y, z]} with numbers in m'),
            ({'ask': 'target', 'at': [0, 0.1]}, 'a target is'),
            ({'ask': 'target', 'at': [0, '0.1', 0]}, 'a target is'),
            ({'ask': 'target', 'at': [0, True, 0]}, 'a target is'),
            ({'ask': 'target', 'at': [0, 10**400, 0]}, 'a target is'),
            ({'ask': 'target', 'at': [0, 2.0, 0]}, 'no node subscribes to target'),
        ):  # fmt: skip
            said = await page.tell(stream, {**message, 'token': token, 'clicked': monotonic()})
            assert said['success'] is False
            assert words in said['words']
        for text in (f'{{"ask": "target", "at": [0, {bad}, 0], "token": "{token}"}}'
                     for bad in ('NaN', 'Infinity', '-Infinity', '1e999')):  # fmt: skip
            assert (await page.tell(stream, text))['success'] is False
        assert buttons.done == []


@in_loop
async def test_stop_is_executed_during_other_command() -> None:
    """A stop is executed and answered during a retraction."""
    buttons = Buttons()
    async with served(buttons) as page:
        stream, token = await page.open(), page.server.token
        retract = {'ask': 'retract', 'token': token, 'clicked': monotonic()}
        await stream.send_json(retract)
        said = await page.tell(stream, {'ask': 'stop', 'token': token})
        assert said['asked'] == 'stop'
        for _ in range(20):
            await stream.send_json(retract)
        said = await answer(stream)
        assert said['words'] == '8 commands are already in progress'
        buttons.free.set()


@pytest.mark.parametrize('age', [-1e3, 0.0, 1.5, 1e6, None, '1', True])
@pytest.mark.parametrize('what', ['target', 'resume', 'retract', 'clear', 'pause', 'stop'])
def test_command_of_an_old_click_is_refused(what: str, age: Any) -> None:
    """Unless it ends a motion: a command that was delayed by an interruption has no effect."""

    async def look() -> None:
        buttons = Buttons()
        buttons.free.set()
        async with served(buttons) as page:
            stream = await page.open()
            clicked = monotonic() - age if type(age) is float else age
            at = {'at': [0.0, 0.1, 0.0]} if what == 'target' else {}
            message = {'ask': what, 'token': page.server.token, 'clicked': clicked, **at}
            said = await page.tell(stream, message)
            executed = what in ('stop', 'pause') or (age == 0.0 and type(age) is float)
            assert bool(buttons.done) == executed
            if not executed:
                assert said['success'] is False
                assert 'click' in said['words']
            if age == 1.5 and not executed:
                stated = float(said['words'].partition(' was ')[2].partition(' s ago')[0])
                # To its last digit, and later on a busy machine.
                assert age - 0.1 <= stated <= monotonic() - clicked + 0.1

    asyncio.run(asyncio.wait_for(look(), 60.0))


@in_loop
async def test_clock_is_sent_without_frames() -> None:
    """Also to a reader that acknowledges nothing: the time of sending, to its last digit."""
    async with served() as page:
        before, digit = monotonic(), 1e-3
        stream = await page.open()
        for _ in range(5):
            message: dict[str, Any] = {}
            while 'clock' not in message:
                message = await asyncio.wait_for(stream.receive_json(), 60.0)
            assert before - digit < message['clock'] < monotonic() + digit
            # The period, less the rounding of both times.
            before = message['clock'] + BEAT - digit


@in_loop
async def test_token_is_checked_without_a_command() -> None:
    """A page reports a wrong token before the first click."""
    buttons = Buttons()
    async with served(buttons) as page:
        stream = await page.open()
        for token, success in ((page.server.token, True), ('x', False)):
            said = await page.tell(stream, {'ask': 'check', 'token': token})
            assert (said['asked'], said['success']) == ('check', success)
        assert buttons.done == []


@pytest.mark.parametrize(
    'request_line',
    [f'GET / HTTP/1.1\r\nX: {"a" * 20_000}', f'GET /{"a" * 20_000}', 'GET / HTTP/1.1\r\nA : x'],
)
def test_rejected_request_prints_one_line(
    request_line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a traceback, and other requests are answered."""

    async def look() -> None:
        async with served() as page:
            reader, writer = await asyncio.open_connection('127.0.0.1', int(page.port))
            writer.write(f'{request_line}\r\n\r\n'.encode())
            assert b'400' in await reader.readline()
            writer.close()
            async with page.session.get(page.url) as reply:
                assert reply.status == 200

    asyncio.run(asyncio.wait_for(look(), 60.0))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('warning: request rejected: ')


@in_loop
async def test_invalid_messages_are_answered() -> None:
    """Frames continue; a message that is too long ends its connection only."""
    async with served() as page:
        stream = await page.open()
        for text in ('', '{', '[]', '3', 'null', '"x"', '[' * 4000, '{"seen": "all"}', '{"b": 1}'):
            said = await page.tell(stream, text)
            assert said['success'] is False
        await stream.send_bytes(b'\0\xff')
        assert 'must be text' in (await answer(stream))['words']
        for number in (-5, 10**300):
            await stream.send_json({'seen': number})
        await stream.send_json({'at': 3})
        await page.tell(stream, '{')
        assert page.made[0].taken == [{'at': 3}]

        await stream.send_str('x' * (LONGEST + 1))
        kinds = []
        while not stream.closed:
            kinds.append((await stream.receive(60.0)).type)
        assert kinds[-1] in (WSMsgType.CLOSE, WSMsgType.CLOSED)
        assert stream.close_code == 1009
        other = await page.open()
        assert await frame(other) == 1


@in_loop
async def test_slow_reader_skips_frames() -> None:
    """It receives two frames, and further frames only after acknowledgement; none are queued."""
    async with served() as page:
        slow, quick = await page.open(), await page.open()
        assert [await frame(slow) for _ in range(2)] == [1, 2]
        for _ in range(100):
            await quick.receive_json()
            await quick.send_json({'seen': 1})
        # The third frame is not requested before an acknowledgement.
        assert page.made[0].number == 2
        for _ in range(3):
            assert (await slow.receive_json()).keys() == {'clock'}


def test_plan_is_shown_in_the_frame_of_the_needle(watched: Path) -> None:
    """In any direction: along y from the entry point, with the clearance around it."""
    direction = np.array([0.48, -0.6, 0.64])
    plan = replace(
        plan_of(np.array([0.1, -0.2, 0.3]), direction),
        clearances=1e-3 * np.array([5.0, 3.0, 4.0, 1.0, 1.0, 2.0, 6.0]),
    )
    side = plan.axes[0]
    plan = replace(plan, path=plan.path + np.outer(np.linspace(0.0, 2e-3, 7), side))
    live = Live(View(), lambda _: None, control=False, plan=plan)
    reader = RecordedReader(ShownRecording(watched), None, plan)
    first = json.loads(asyncio.run(asyncio.wait_for(reader.next(), 60.0)))
    for shown in (live.setting['plan'], first['setting']['plan']):
        x, y, z = shown['path']
        # Written to a micrometer.
        np.testing.assert_allclose(x, np.linspace(0.0, 2e-3, 7), atol=6e-7)
        np.testing.assert_allclose(y, plan.depths, atol=6e-7)
        np.testing.assert_allclose(z, 0.0, atol=6e-7)
        free = np.array(shown['free']) - plan.radius
        # At both ends of each step, and as large as possible.
        both = np.maximum(free[1:], free[:-1])
        assert (both <= plan.clearances[1:] + 6e-7).all()
        np.testing.assert_allclose(free, 1e-3 * np.array([3, 3, 1, 1, 1, 2, 6]), atol=6e-7)
    assert Live(View(), lambda _: None, control=False).setting['plan'] is None


def test_wrong_plan_is_one_line(
    watched: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'plan.yaml').write_text('plan: 7')
    for name, message in (('plan.yaml', 'is not a plan of format 1'), ('no', 'cannot be read')):
        assert cli.main(['watch', str(watched), '--plan', str(tmp_path / name)]) == 2
        line = capsys.readouterr().err
        assert message in line
        assert len(line.splitlines()) == 1


@pytest.mark.parametrize('words', [['--anatomy', 'a.nrrd'], ['--labels', 'labels.yaml']])
def test_anatomy_without_plan_is_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(['watch', *words]) == 2
    line = capsys.readouterr().err
    assert '--anatomy needs --plan and --labels' in line
    assert len(line.splitlines()) == 1


@in_loop
async def test_live_reader_receives_newest_frame() -> None:
    """A slow reader receives the newest frame, a new reader the history."""
    view = View()
    live = Live(view, lambda _: None, control=False)
    running = asyncio.create_task(live.run())
    try:
        reader = LiveReader(live)
        first = json.loads(await reader.next())
        assert {'frame', 'scene', 'setting', 'history'} == set(first)
        while live.number < 10:
            await live.newer(live.number)
        view.reading('joint_states', joints(('insertion',), (0.05,), (), ()), 0.0)
        told(view, 'controller')
        number = live.number
        await live.newer(number + 1)
        later = json.loads(await reader.next())
        assert later['frame']['depth'] == 0.05
        assert later['scene']['limits']['force'] == 15.0
        assert set(json.loads(await reader.next())) == {'frame'}
        # Rows of skipped frames are sent later, each once.
        number = live.number
        await live.newer(number + 4)
        late = json.loads(await reader.next())
        assert len(late['missed']) >= 4
        rows = [row[0] for row in live.history]
        assert [row[0] for row in late['missed']] == rows[-len(late['missed']) - 1 : -1]
        assert len(json.loads(await LiveReader(live).next())['history']) > 10
        with pytest.raises(ParameterError):
            reader.take({'at': 1.0})
    finally:
        running.cancel()


def test_recorded_reader_controls_playback(watched: Path) -> None:
    """Frames of the requested time, all signals once; readers are independent."""
    bag = ShownRecording(watched)

    async def look() -> None:
        one, other = RecordedReader(bag), RecordedReader(bag)
        first = json.loads(await one.next())
        assert first['setting']['recording'] == {
            'name': watched.name, 'duration': DURATION, 'losses': [],
        }  # fmt: skip
        assert first['scene']['tissue']['of'] == 'plant'
        assert first['signals'] == bag.signals()
        for reader, at in ((one, 3.0), (other, 1.0)):
            reader.take({'play': False})
            reader.take({'at': at})
            seen = json.loads(await reader.next())
            assert seen['frame']['time'] == at
        # No new frame during a pause.
        waiting = asyncio.ensure_future(one.next())
        await asyncio.sleep(0.2)
        assert not waiting.done()
        one.take({'play': True})
        assert json.loads(await waiting)['frame']['time'] >= 3.0

    asyncio.run(asyncio.wait_for(look(), 60.0))


@in_loop
async def test_idle_connections_do_not_hold_the_page() -> None:
    """Above the limit they are closed at once, and without a request after some seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server, '_MOST_CONNECTIONS', 8)
        patch.setattr(server, '_PATIENCE', 2.0)
        await _with_idle_connections()


async def _with_idle_connections() -> None:
    async with served() as page:
        idle = [await asyncio.open_connection('127.0.0.1', page.port) for _ in range(20)]
        for _, writer in idle[:4]:
            writer.write(b'GET / HTTP/1.1\r\nHost')
        ended = [reader.read(1) for reader, _ in idle]
        await asyncio.gather(*ended, return_exceptions=True)
        for _, writer in idle:
            writer.close()
            with suppress(ConnectionError):
                await writer.wait_closed()
        async with page.session.get(page.url) as reply:
            assert reply.status == 200


@in_loop
async def test_readers_disconnect_without_leak() -> None:
    """An aborted connection is removed; readers above the limit are rejected."""
    async with served() as page:
        for _ in range(2 * MOST_READERS):
            stream = await page.open()
            await stream.receive_json()
            # Abort without close, as in a crash of the browser.
            assert stream._response.connection is not None
            stream._response.connection.transport.abort()
        for _ in range(600):
            if not page.server._open:
                break
            await asyncio.sleep(0.1)
        streams = [await page.open() for _ in range(MOST_READERS)]
        full = await page.open()
        message = await full.receive(60.0)
        assert (message.type, full.close_code) == (WSMsgType.CLOSE, 1013)
        assert message.extra == (
            f'{MOST_READERS} pages are open already: close one, then load this page again'
        )
        await streams[0].close()
        assert len(asyncio.all_tasks()) < 10 * MOST_READERS


@in_loop
async def test_port_in_use_is_reported() -> None:
    """The error proposes another port."""
    with socket.socket() as taken:
        taken.bind(('127.0.0.1', 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ParameterError) as error:
            await Server(Counting, port=port).start()
    assert str(error.value) == (
        f'cannot listen on 127.0.0.1, port {port}: the port is in use; use '
        f'another one, such as --port {port + 1}, or --port 0 for a free one'
    )


@pytest.mark.requirement('S-161')
def test_control_is_restricted_to_loopback() -> None:
    """Control and other machines exclude each other; the host must be an address."""
    with pytest.raises(ParameterError, match='--control works on this machine only'):
        Server(Counting, '0.0.0.0', control=Buttons())  # noqa: S104
    with pytest.raises(ParameterError, match='--host must be an address'):
        Server(Counting, 'lab.example')
    with pytest.raises(ParameterError, match='--port must be 0 to 65535'):
        Server(Counting, port=70_000)


@in_loop
async def test_open_page_requires_address_as_host() -> None:
    """The first lines report the read access of other machines."""
    async with served(host='0.0.0.0') as page:  # noqa: S104
        said = page.server.words
        assert 'read access for other machines' in said[1]
        for host, code in ((f'192.0.2.1:{page.port}', 200), (f'evil.example:{page.port}', 403)):
            async with page.session.get(page.url, headers={'Host': host}) as reply:
                assert reply.status == code
        stream = await page.open()
        refused = await page.tell(stream, {'ask': 'stop', 'token': ''})
        assert refused['success'] is False


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_exits_with_status_0(watched: Path, number: signal.Signals) -> None:
    """Also with a connected reader."""
    running = subprocess.Popen(
        [sys.executable, '-m', 'needle_insertion.cli', 'watch', str(watched), '--port', '0'],
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert running.stdout is not None
        line = running.stdout.readline()
        url = line.removeprefix('page: ').strip()

        async def look() -> None:
            async with ClientSession() as session, session.ws_connect(f'{url}frames') as stream:
                assert await frame(stream)
                running.send_signal(number)
                while not stream.closed:
                    await stream.receive(60.0)
                assert stream.close_code == 1001

        asyncio.run(look())
        assert running.wait(60.0) == 0
        assert running.stderr is not None
        assert running.stderr.read() == ''
    finally:
        running.kill()
        running.communicate()


def test_exclusive_options_are_rejected(watched: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A recording has no control."""
    assert cli.main(['watch', str(watched), '--control']) == 2
    assert 'error: --control needs a live insertion' in capsys.readouterr().err
    assert cli.main(['watch', str(watched), '--shift', '2s']) == 2
    assert 'error: --shift needs two recordings' in capsys.readouterr().err
    assert cli.main(['watch', str(watched), str(watched), '--shift', 'nan']) == 2
    assert 'error: --shift must be finite, got nan' in capsys.readouterr().err
