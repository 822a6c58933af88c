# SPDX-License-Identifier: Apache-2.0
"""`needle watch` with real nodes: frames, buttons, rejections, and a browser."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
from time import monotonic
from typing import Any

from aiohttp import ClientSession, ClientWebSocketResponse
from needle_insertion.watch.view import View
from needle_insertion.watch.watch_node import WatchNode
from needle_planning import write_plan
import numpy as np
import pytest
from support.anatomies import plan_of
from support.installed import ROOT
from support.live_page import watching
from support.ros_graph import RosGraph
from support.watched import write_watched
from tools.browser import BROWSER, browser, Tab

#: A needle moved by a controller; low rate for a busy machine.
PLANT = {'needle': 'bending_35mm', 'steered': True, 'rate': 100.0, 'depth': 0.02}
CONTROLLER = {
    'needle': 'bending_35mm', 'rate': 100.0, 'deflection_feedback': 'none',
    'measurement_timeout': 5.0,
}  # fmt: skip

needs_browser = pytest.mark.skipif(BROWSER is None, reason='no Chromium on this machine')


class Reader:
    """Reads the frames of a page, and sends its commands."""

    def __init__(self, stream: ClientWebSocketResponse, token: str) -> None:
        self._stream, self._token = stream, token
        self.frame: dict[str, Any] = {}
        self.scene: dict[str, Any] = {}
        self.frames = 0

    async def _next(self) -> dict[str, Any]:
        message: dict[str, Any] = await asyncio.wait_for(self._stream.receive_json(), 60.0)
        self.scene = message.get('scene', self.scene)
        if 'frame' in message:
            self.frame = message['frame']
            self.frames += 1
            await self._stream.send_json({'seen': 1})
        return message

    async def until(self, condition: Callable[[dict[str, Any]], Any], what: str) -> None:
        """Read frames until a condition holds."""
        end = asyncio.get_running_loop().time() + 120.0
        while not (self.frame and condition(self.frame)):
            assert asyncio.get_running_loop().time() < end, (what, self.frame)
            await self._next()

    async def ask(self, what: str, **more: Any) -> dict[str, Any]:
        """Send a command, and return the answer."""
        proof = {'token': self._token, 'clicked': monotonic()}
        await self._stream.send_json({'ask': what, **proof, **more})
        while True:
            message = await self._next()
            if 'answer' in message:
                return message['answer']

    def level(self, node: str) -> int | None:
        """Return the level of a node; None without status or after a timeout."""
        found = [one for one in self.frame['nodes'] if one['name'] == node]
        return found[0]['level'] if found and not found[0]['silent'] else None

    def fine(self, node: str) -> bool:
        """Return whether a node works; on a busy machine it may warn of delays."""
        return self.level(node) in (0, 1)


@asynccontextmanager
async def reading(url: str) -> AsyncIterator[Reader]:
    """Read the frames of a page."""
    page, _, token = url.partition('#token=')
    async with ClientSession() as session, session.ws_connect(f'{page}frames') as stream:
        yield Reader(stream, token)


def begin(graph: RosGraph) -> None:
    """Start a plant and a controller."""
    graph.start('plant', PLANT)
    graph.start('controller', CONTROLLER)


async def ready(reader: Reader) -> None:
    """Wait until both nodes and the shape are received, and the controller has measurements."""
    await reader.until(
        lambda frame: (
            frame['shape'] == 'simulated'
            and frame['path'] is not None
            and reader.fine('/plant')
            and reader.fine('/controller')
            and reader.scene['limits']
            and reader.scene['tissue']
        ),
        'the nodes',
    )


def test_buttons_command_the_needle(ros_graph: RosGraph) -> None:
    """Target, stop, clear, pause and retract."""
    begin(ros_graph)

    async def look(url: str) -> None:
        async with reading(url) as reader:
            await ready(reader)
            assert reader.scene['tissue']['of'] == 'plant'
            assert reader.scene['limits']['force'] == 15.0
            assert reader.frame['depth'] == pytest.approx(0.02, abs=1e-3)
            assert (await reader.ask('target', at=[0.0, 0.03, 0.0]))['success']
            await reader.until(lambda frame: frame['target'] == [None, 0.03, None], 'the target')
            await reader.until(lambda frame: frame['depth'] > 0.022, 'motion')
            assert (await reader.ask('pause'))['success']
            assert (await reader.ask('resume'))['success']
            await reader.until(lambda frame: frame['depth'] > 0.0295, 'the end')
            assert reader.frame['error'] == pytest.approx(0.0, abs=1e-3)
            # The length of the cut path equals the insertion depth.
            assert reader.frame['path'][1][-1] == pytest.approx(reader.frame['depth'], abs=1e-3)
            said = await reader.ask('stop')
            assert said['success']
            await reader.until(lambda _: reader.level('/controller') == 2, 'the stop')
            assert (await reader.ask('clear'))['success']
            await reader.until(lambda _: reader.fine('/controller'), 'the release')
            assert (await reader.ask('retract'))['success']
            await reader.until(lambda frame: frame['depth'] < 0.025, 'the retreat')

    with watching(ros_graph.environment, '--control') as (running, url):
        assert running.stdout.readline().startswith('this address permits motion')
        asyncio.run(look(url))
        running.send_signal(signal.SIGINT)
        assert running.wait(60.0) == 0


def test_read_only_page_rejects_commands(ros_graph: RosGraph) -> None:
    """Ended nodes are shown as silent, restarted nodes as active."""
    ros_graph.start('controller', CONTROLLER)
    plant = ros_graph.start('plant', PLANT)

    async def look(url: str) -> None:
        async with reading(url) as reader:
            await ready(reader)
            for what in ('target', 'stop'):
                said = await reader.ask(what, at=[0.0, 0.03, 0.0])
                assert said['success'] is False
                assert 'this page is read-only' in said['words']
            plant.kill()
            await reader.until(lambda frame: 'joint_states' in frame['silent'], 'silence')
            await reader.until(lambda _: reader.level('/plant') is None, 'silence of the node')
            await reader.until(lambda frame: frame['shape'] == 'straight', 'no shape')
            ros_graph.start('plant', PLANT)
            await reader.until(lambda frame: frame['shape'] == 'simulated', 'the next plant')
            await reader.until(lambda frame: frame['silent'] == {}, 'its readings')
            await reader.until(lambda _: reader.fine('/plant'), 'its state')

    with watching(ros_graph.environment) as (running, url):
        assert '#' not in url
        asyncio.run(look(url))
        running.send_signal(signal.SIGTERM)
        assert running.wait(60.0) == 0


def test_read_only_node_has_no_publishers_or_clients(ros_graph: RosGraph) -> None:
    """No topic of the contract, and no service client."""
    node = WatchNode(View(), ros_graph.context)
    try:
        assert {one.topic_name for one in node.publishers} <= {'/parameter_events'}
        assert not [*node.clients]
        # Publishers of rclpy for tools.
        assert {one.srv_name for one in node.services} <= {'watch/get_type_description'}
    finally:
        node.destroy_node()


def test_button_without_nodes_is_reported(ros_graph: RosGraph) -> None:
    async def look(url: str) -> None:
        async with reading(url) as reader:
            await reader.until(lambda frame: frame['shape'] is None, 'a frame')
            said = await reader.ask('target', at=[0.0, 0.1, 0.0])
            assert said['words'].startswith('no node subscribes to target')
            said = await reader.ask('stop')
            assert said == {
                'asked': 'stop', 'success': False,
                'words': 'no node offers controller/stop or steering/stop or plant/stop',
            }  # fmt: skip

    with watching(ros_graph.environment, '--control') as (_, url):
        asyncio.run(look(url))


def test_invalid_domain_is_rejected(ros_graph: RosGraph) -> None:
    """One line, and status 2."""
    done = subprocess.run(
        [sys.executable, '-m', 'needle_insertion.cli', 'watch', '--port', '0'],
        env={**ros_graph.environment, 'PYTHONPATH': str(ROOT), 'ROS_DOMAIN_ID': 'lab'},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "error: ROS_DOMAIN_ID must be a whole number from 0 to 232, got 'lab'\n"


# In a browser.


#: Text of the page, and its overflow [pixels].
LOOK = """({
  overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
  text: document.body.innerText,
  blank: [...document.querySelectorAll('canvas')].filter((one) => one.clientWidth > 0)
    .filter((one) => !one.getContext('2d').getImageData(0, 0, one.width, one.height)
      .data.some((value) => value > 0)).map((one) => one.id),
})"""


async def shown(tab: Tab, url: str, width: int, picture: Path) -> dict[str, Any]:
    """Open a page with a width, and return its content."""
    await tab.size(width, 1000)
    await tab.open(url)
    await tab.wait('window.needleWatch && needleWatch.drawn > 20', 'the page')
    # The text is updated after the frames.
    await tab.wait("document.getElementById('state').dataset.level !== 'none'", 'the state')
    await tab.picture(picture)
    seen: dict[str, Any] = await tab.run(LOOK)
    return seen


@needs_browser
@pytest.mark.parametrize('width', [1400, 400])
def test_browser_shows_live_data(ros_graph: RosGraph, tmp_path: Path, width: int) -> None:
    """Drawing, layout, no external requests, and keyboard operation."""
    begin(ros_graph)

    async def look(url: str) -> None:
        async with reading(url) as reader:
            await ready(reader)
        async with browser() as tab:
            seen = await shown(tab, url, width, tmp_path / 'page.png')
            assert seen['overflow'] == 0
            assert seen['blank'] == []
            for words in ('Insertion depth', 'limit ±100', 'commanded ±15', 'Stop', 'plant'):
                assert words in seen['text']
            count = await tab.run('needleWatch.drawn')
            begun = asyncio.get_running_loop().time()
            await tab.wait(f'needleWatch.drawn >= {count + 60}', 'frames')
            spent = asyncio.get_running_loop().time() - begun
            # Printed for information: the rate depends on the machine.
            sys.stdout.write(f'{60.0 / spent:.1f} frames a second at {width} pixels\n')
            # The first element in tab order is the stop button.
            await tab.press('Tab')
            assert await tab.run('document.activeElement.id') == 'stop'
            await tab.press('Enter')
            words = "document.getElementById('answer').textContent"
            await tab.wait(f"{words}.startsWith('● stop')", 'the answer')
            await tab.wait("document.getElementById('state').dataset.level === 'error'", 'it')
            origin = url.partition('#')[0]
            others = [
                one for one in tab.requests
                if not one.startswith((origin, origin.replace('http', 'ws'), 'data:'))
            ]  # fmt: skip
            assert others == []
            # Without its token the page has no buttons, and says why.
            await tab.open(origin)
            note = "document.getElementById('looking').innerText"
            await tab.wait(
                f"{note} === 'Read-only page: open the address that the command "
                "printed, with its token.'",
                'the reason',
            )
            assert tab.faults == []

    with watching(ros_graph.environment, '--control') as (_, url):
        asyncio.run(look(url))


async def examine(tab: Tab) -> None:
    """Use zoom, cursor, choice of signals, exports, lateral scale and link of a recording."""
    assert await tab.run('charts.range()') == [0.0, 4.0]
    # A link to a moment and a range.
    await tab.run("location.hash = '#at=2.5&from=2&to=3'")
    clock = "document.getElementById('clock').textContent"
    await tab.wait(f"{clock}.startsWith('2.5 of')", 'the time of the link')
    assert await tab.run('charts.range()') == [2.0, 3.0]
    # Keys: a cursor one percent of the range later, in all charts, with values at this time.
    strips = "document.getElementById('strips')"
    key = strips + ".dispatchEvent(new KeyboardEvent('keydown', {{key: '{}'}}))"
    await tab.run(key.format('ArrowRight'))
    await tab.wait("document.getElementById('span').textContent.includes('2.510 s')", 'a cursor')
    texts = "[...document.querySelectorAll('figcaption span')].map((one) => one.textContent)"
    # The newest sample is of 2.50 s.
    assert 'measured 50.00' in await tab.run(texts)
    assert 'along 4.50' in await tab.run(texts)
    # The link follows a zoom about the cursor.
    await tab.run(key.format('+'))
    low, high = await tab.run('charts.range()')
    assert high - low == pytest.approx(1.0 / 1.5)
    await tab.wait('location.hash.includes(`from=${charts.range()[0].toFixed(3)}`)', 'the link')
    # Signals: a chart without signals is hidden.
    visible = "[...document.querySelectorAll('figure')].filter((one) => !one.hidden).length"
    assert await tab.run(visible) == 3
    for name in ('force', 'guide_x'):
        await tab.run(f"document.querySelector('[name={name}]').click()")
    await tab.wait(f"{visible} === 3 && charts.csv().includes('guide_x')", 'the chosen signals')
    # Exports: the rows of the shown range, and a picture.
    lines = (await tab.run('charts.csv()')).splitlines()
    assert lines[0] == 'time [s],depth [m],reference [m],tip_x [m],tip_z [m],guide_x [m]'
    times = [float(line.partition(',')[0]) for line in lines[1:]]
    assert times == sorted(times)
    assert low <= times[0] < times[-1] <= high
    await tab.run('URL.createObjectURL = (content) => { window.saved = content; return "#"; }')
    await tab.run("document.getElementById('save-picture').click()")
    assert await tab.wait('window.saved && saved.type', 'the picture') == 'image/png'
    # Magnified lateral scale: the needle takes more of the page.
    tall = "document.getElementById('needle').clientHeight"
    before = await tab.run(tall)
    lateral = "document.getElementById('lateral')"
    await tab.run(f"{lateral}.value = '5', {lateral}.dispatchEvent(new Event('change'))")
    await tab.wait(f'{tall} > {before}', 'the magnified needle')
    await tab.run("document.getElementById('whole').click()")
    assert await tab.run('charts.range()') == [0.0, 4.0]
    assert tab.faults == []


@needs_browser
@pytest.mark.parametrize('width', [1400, 400])
def test_browser_plays_a_recording(tmp_path: Path, width: int) -> None:
    """Slider, reduced motion, and end of the recording."""
    write_watched(tmp_path / 'bag')

    async def look(running: Any, url: str) -> None:
        async with browser() as tab:
            seen = await shown(tab, url, width, tmp_path / 'page.png')
            assert seen['overflow'] == 0
            assert 'recording bag' in seen['text']
            assert 'At the target' in seen['text']
            clock = "document.getElementById('clock').textContent"
            at = "document.getElementById('at')"
            # The clock is rounded: near the end it still runs.
            done = f"{clock}.startsWith('4.0 of') && !playback.playing"
            await tab.wait(done, 'the end of the recording')
            await tab.run(f"{at}.value = 3.5, {at}.dispatchEvent(new Event('input'))")
            await tab.wait(f"{clock}.startsWith('3.5 of')", 'the time')
            await tab.picture(tmp_path / 'middle.png')
            assert 'silent' in (await tab.run(LOOK))['text']
            assert tab.faults == []
            await examine(tab)
            calm = {'name': 'prefers-reduced-motion', 'value': 'reduce'}
            await tab.call('Emulation.setEmulatedMedia', features=[calm])
            count = await tab.run('needleWatch.drawn')
            await tab.run("document.getElementById('play').click()")
            await tab.wait(f"{clock}.startsWith('4.0 of')", 'the end')
            # Two frames a second for a playback of half a second.
            assert await tab.run('needleWatch.drawn') - count < 12
            running.send_signal(signal.SIGINT)
            state = "document.getElementById('state').textContent"
            await tab.wait(f"{state}.includes('not connected')", 'the end of the page')

    with watching(dict(os.environ), str(tmp_path / 'bag')) as (running, url):
        asyncio.run(look(running, url))


@needs_browser
def test_browser_draws_a_plan(tmp_path: Path) -> None:
    """The planned path and its free space, with their line in the legend."""
    write_watched(tmp_path / 'bag')
    plan = plan_of(np.zeros(3), np.array([0.0, 1.0, 0.0]))
    write_plan(plan, tmp_path / 'plan.yaml')

    async def look(url: str) -> None:
        async with browser() as tab:
            seen = await shown(tab, url, 400, tmp_path / 'page.png')
            assert seen['overflow'] == 0
            assert 'planned path of the tip, and its free space' in seen['text']
            # The same frame with and without the plan.
            same = await tab.run(
                "(() => { const one = document.getElementById('needle'), seen = [], at = frame; "
                'for (const plan of [drawing.plan, drawing.plan, null]) { drawing.plan = plan; '
                "drawing.draw(scene, at); seen.push(one.getContext('2d').getImageData(0, 0, "
                'one.width, one.height).data.join()) } '
                'return [seen[0] === seen[1], seen[1] === seen[2]] })()'
            )
            assert same == [True, False]
            assert tab.faults == []

    words = str(tmp_path / 'bag'), '--plan', str(tmp_path / 'plan.yaml')
    with watching(dict(os.environ), *words) as (_, url):
        asyncio.run(look(url))


@needs_browser
def test_browser_shows_the_anatomy(tmp_path: Path) -> None:
    """In 3D, with the needle of the frame where the guide is at the planned pose."""
    write_watched(tmp_path / 'bag')
    liver = ROOT / 'examples' / 'liver'
    files = str(liver / 'liver.seg.nrrd'), '--labels', str(liver / 'labels.yaml')
    entry, direction = np.array([0.14325, 0.02175, 0.0185]), np.array([-0.8, -0.6, 0.0])
    write_plan(plan_of(entry, direction), tmp_path / 'plan.yaml')

    async def look(url: str) -> None:
        async with browser() as tab:
            await tab.size(400, 1000)
            await tab.open(url)
            # Without a graphics card a picture may take a second.
            await tab.wait('needleWatch.anatomy && needleWatch.anatomy.now.count > 0', 'a needle')
            await tab.wait("document.getElementById('anatomy').dataset.drawn > 1", 'a picture')
            wide = 'document.documentElement.scrollWidth - document.documentElement.clientWidth'
            assert await tab.run(wide) == 0
            text = await tab.run("document.getElementById('anatomy').innerText")
            for words in ('ribs (obstacle)', 'liver (tissue)', 'needle now', 'free of margins'):
                assert words in text
            # Rows of the axes of the guide: y is the direction.
            axes = np.array(await tab.run('needleWatch.anatomy.content.axes'))
            np.testing.assert_allclose(axes[1], direction, atol=1e-12)
            assert tab.faults == []

    words = str(tmp_path / 'bag'), '--plan', str(tmp_path / 'plan.yaml'), '--anatomy', *files
    with watching(dict(os.environ), *words) as (_, url):
        asyncio.run(look(url))


@needs_browser
def test_browser_compares_two_recordings(tmp_path: Path) -> None:
    """Both have values at the cursor, lines of their own, and columns in the table."""
    for name in ('one', 'two'):
        write_watched(tmp_path / name)

    async def look(url: str) -> None:
        async with browser() as tab:
            seen = await shown(tab, url, 400, tmp_path / 'page.png')
            assert seen['overflow'] == 0
            assert 'Compared with two: times shifted by +0.500 s.' in seen['text']
            assert 'needle of the other recording' in seen['text']
            # The range has both recordings.
            assert await tab.run('charts.range()') == [0.0, 4.5]
            await tab.run('charts.cursor = 3, later()')
            texts = (
                "[...document.querySelectorAll('figcaption span')].map((one) => one.textContent)"
            )
            await tab.wait(f"{texts}.includes('measured 60.00')", 'the cursor')
            # At 20 mm/s half a second later.
            assert 'measured, other 50.00' in await tab.run(texts)
            # After the end of the second recording it has no value.
            await tab.run('charts.cursor = 1e3, later()')
            await tab.wait(f"{texts}.includes('measured, other –')", 'no value')
            lines = (await tab.run('charts.csv()')).splitlines()
            heads = lines[0].split(',')
            assert heads[1:5] == [
                'depth [m]', 'reference [m]', 'other_depth [m]', 'other_reference [m]',
            ]  # fmt: skip
            (row,) = [line.split(',') for line in lines if line.startswith('3,')]
            assert [float(row[1]), float(row[3])] == [0.06, 0.05]
            dashes = 'charts.series(charts.constructor.all[0]).map((one) => String(one.line))'
            assert len({*await tab.run(dashes)}) == 4
            assert tab.faults == []

    words = [str(tmp_path / 'one'), str(tmp_path / 'two'), '--shift', '0.5s']
    with watching(dict(os.environ), *words) as (_, url):
        asyncio.run(look(url))
