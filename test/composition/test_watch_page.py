# SPDX-License-Identifier: Apache-2.0
"""Live page of `needle watch` in a browser: invalid readings, interruptions, commands."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import wraps
from math import nan
from typing import Any

from aiohttp import ClientSession
from needle_insertion.watch.server import MOST_READERS
from needle_ros.wire import Reading
import pytest
from support.live_page import joints, live_page
from tools.browser import BROWSER

pytestmark = pytest.mark.skipif(BROWSER is None, reason='no Chromium on this machine')


def in_loop(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run an asynchronous test in an event loop."""

    @wraps(test)
    def run(*given: Any, **more: Any) -> None:
        asyncio.run(asyncio.wait_for(test(*given, **more), 300.0))

    return run


def text(name: str) -> str:
    """Return a script for the text of an element."""
    return f"document.getElementById('{name}').textContent"


#: Draws each value as tip, depth, target and needle; returns the largest range and longest time.
EXTREMES = """(() => {
  const found = {end: 0, side: 0, slowest: 0, named: true};
  for (let power = -6; power < 308; power += 0.5) for (const sign of [1, -1]) {
    const v = sign * 10 ** power, begun = performance.now();
    drawing.draw({...scene, tissue: {layers: [[0, 1], [v, 2]], membranes: [[v, 1]]}},
      {...frame, depth: v, tip: [v, v, v], target: [v, v, v], needle: [[0, v], [0, v], [0, v]],
        path: [[v], [v], [v]], expected: {at: [v, v, v], half: [v, v]}});
    found.named = found.named && (drawing.left.length > 0) === (1e3 * Math.abs(v) > 1000);
    charts.data.depth = charts.data.force = [[frame.time - 2, frame.time - 1], [v, 0.999999 * v]];
    charts.draw(frame.time, {});
    found.end = Math.max(found.end, drawing.end);
    found.side = Math.max(found.side, drawing.side);
    found.slowest = Math.max(found.slowest, performance.now() - begun);
  }
  for (let k = 0; k < 3; k += 1) {
    drawing.since -= 11000;
    drawing.draw(scene, {...frame, needle: null, depth: null});
  }
  return {...found, again: [drawing.end, drawing.side]};
})()"""


@in_loop
async def test_any_reading_leaves_the_page_usable() -> None:
    """The drawn range is at most 1 m, each drawing is short, and the range shrinks again."""
    async with live_page(joint_states=joints('insertion', at=-3.7e28)) as (page, tab):
        await tab.wait(f"{text('far')}.startsWith('Not drawn, beyond 1000 mm: depth')", 'its name')
        words = 'document.body.innerText'
        await tab.wait(f"{words}.includes('values beyond 1000 mm are not drawn')", 'the chart')
        found = await tab.run(EXTREMES)
        assert found['end'] <= 1000
        assert found['side'] <= 1003
        assert found['slowest'] < 1000.0
        assert found['named']
        assert found['again'] == [60, 10]
        # A range that is reserved for later frames stays.
        reserved = (
            '(() => { drawing.reserve({...frame, depth: 0.3}, scene); '
            'for (let k = 0; k < 3; k += 1) '
            '{ drawing.since -= 11000; drawing.draw(scene, {...frame, depth: null}); } '
            'return drawing.end; })()'
        )
        assert await tab.run(reserved) == 320
        page.feed['joint_states'] = joints('insertion')
        await tab.wait("document.getElementById('far').hidden", 'the next reading')
        assert tab.faults == []


@in_loop
async def test_reason_is_beside_the_number() -> None:
    """Missing joint, wrong frame, and values that are not finite; invalid messages are counted."""
    numbers = "document.getElementById('numbers').innerText"
    async with live_page(joint_states=joints('arm', 'wrist')) as (page, tab):
        reason = "joint_states has no joint 'insertion'; joints found: 'arm', 'wrist'"
        await tab.wait(f'{numbers}.includes("{reason}")', 'the joints')
        await tab.wait(f'{text("shape")}.includes("{reason}")', 'the reason')
        page.feed['joint_states'] = joints('insertion')
        page.feed['base_wrench'] = Reading(1, 'camera', (), ((0.0, 7.0, 0.0, 0.0, 0.0, 0.0),))
        page.feed['tip_deflection'] = Reading(1, 'needle_entry', (), ((nan, 0.05, 1e-3),))
        page.view.invalid = 3
        frame = "■ base_wrench must be in frame 'needle_base', got 'camera'"
        await tab.wait(f'{numbers}.includes("{frame}")', 'the frame')
        # The value is shown with it.
        assert '7.00 N' in await tab.run(numbers)
        assert '■ NaN received' in await tab.run(numbers)
        await tab.wait(f"{text('invalid')}.startsWith('3 invalid messages received')", 'the count')
        page.feed.clear()
        await tab.wait(f"{numbers}.includes('○ silent for')", 'silence')
        assert tab.faults == []


#: Numbers of a row after its time, all equal.
ROW = 'Array(12).fill(0.05)'


@in_loop
async def test_pause_of_frames_is_a_gap() -> None:
    """Not a line; rows without a pause have none."""
    async with live_page(joint_states=joints('insertion')) as (_, tab):
        for last, gaps in ((1.4, 0), (2.5, 1)):
            rows = ', '.join(f'[{time}, ...{ROW}]' for time in (1.0, 1.1, last))
            found = await tab.run(f'(charts.live([{rows}]), charts.data.depth[1])')
            assert found.count(None) == gaps
            assert found[-1] == 0.05


@in_loop
async def test_missed_rows_arrive_with_the_next_frame() -> None:
    """A page in the background draws nothing: then its charts have all rows of this time."""
    async with live_page(joint_states=joints('insertion')) as (page, tab):
        await tab.run('window.before = requestAnimationFrame, requestAnimationFrame = () => 0')
        await tab.run('(waiting = true, charts.live([]))')
        first = page.live.number
        await page.live.newer(first + 40)
        expected = [row[0] for row in page.live.history][-30:]
        await tab.run('(requestAnimationFrame = before, waiting = false, later())')
        last = f'charts.data.depth[0].some((time) => time > {expected[-1]})'
        await tab.wait(last, 'the missed rows')
        assert {*expected} <= {*await tab.run('charts.data.depth[0]')}
        assert tab.faults == []


#: Whether a wheel event over a chart is used, and not left to the browser.
WHEEL = """((options) => {
  const event = new WheelEvent('wheel', {cancelable: true, bubbles: true, ...options});
  document.querySelector('#strips canvas').dispatchEvent(event);
  return event.defaultPrevented;
})"""


@in_loop
async def test_wheel_is_left_to_the_browser_where_nothing_is_zoomed() -> None:
    """Zoom of the browser, sideways scrolling, and at both ends of the zoom."""
    async with live_page(joint_states=joints('insertion')) as (_, tab):
        for options, used in (
            ('{deltaY: 100}', False),
            ('{deltaY: -100, ctrlKey: true}', False),
            ('{deltaY: -50, deltaX: 60}', False),
            ('{deltaY: -100, deltaX: 10}', True),
            ('{deltaY: 100}', True),
            ('{deltaY: 100}', False),
        ):
            assert await tab.run(f'{WHEEL}({options})') is used, options
        for _ in range(10):
            await tab.run(f'{WHEEL}({{deltaY: -100}})')
        assert await tab.run(f'{WHEEL}({{deltaY: -100}})') is False


@in_loop
async def test_signals_without_data_cannot_be_chosen() -> None:
    """Until their first value."""
    box = "document.querySelector('#signals [name={}]').disabled"
    async with live_page(joint_states=joints('insertion')) as (page, tab):
        await tab.wait(f'!{box.format("depth")}', 'the depth')
        assert await tab.run(box.format('roll'))
        assert await tab.run(box.format('tip_x'))
        page.feed['joint_states'] = joints('insertion', 'roll')
        await tab.wait(f'!{box.format("roll")}', 'the roll')
        assert await tab.run(box.format('tip_x'))


@in_loop
async def test_page_above_the_limit_states_the_reason() -> None:
    async with live_page() as (page, tab):
        address = page.server.address
        async with ClientSession() as session:
            others = range(MOST_READERS - 1)
            streams = [await session.ws_connect(f'{address}frames') for _ in others]
            await tab.run(
                '(() => { const one = new needleConnection.Connection(connection.url, () => null, '
                '() => null); window.second = one; })()'
            )
            reason = await tab.wait('second.refused', 'the reason')
            assert reason == await tab.run('second.trouble()')
            assert reason.startswith(f'{MOST_READERS} pages are open already')
            for stream in streams:
                await stream.close()
