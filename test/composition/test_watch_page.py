# SPDX-License-Identifier: Apache-2.0
"""Live page of `needle watch` in a browser: invalid readings, interruptions, commands."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import wraps
from math import nan
from typing import Any

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
