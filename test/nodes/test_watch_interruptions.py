# SPDX-License-Identifier: Apache-2.0
"""Page of `needle watch` during interruptions of its server, and after a restart."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
import signal

import pytest
from support.live_page import watching
from support.ros_graph import RosGraph
from support.watched import write_watched
from tools.browser import BROWSER, browser, Tab

pytestmark = pytest.mark.skipif(BROWSER is None, reason='no Chromium on this machine')

STATE = "document.getElementById('state').textContent"
ANSWER = "document.getElementById('answer').textContent"
#: Words of the buttons that are enabled, and levels of the numbers.
ENABLED = """[...document.querySelectorAll('#control button')].filter((one) => !one.disabled)
  .map((one) => one.textContent).join()"""
LEVELS = "[...new Set([...document.querySelectorAll('#numbers dl > div')].map((one) => "
LEVELS += 'one.dataset.level))].join()'
ALL = 'Stop,Clear stop,Pause,Continue,Retract,Send target'


async def click(tab: Tab, what: str) -> str:
    """Click a button, and return the answer that is shown at once."""
    button = f"document.querySelector('[data-ask={what}]')"
    if what == 'target':
        button = "document.querySelector('#target button')"
    return str(await tab.run(f'({button}.click(), {ANSWER})'))


def test_interruption_is_shown_and_old_clicks_are_refused(ros_graph: RosGraph) -> None:
    """Numbers are silent; a click before its end has no effect, except that of Stop."""

    async def look(server: int, url: str) -> None:
        async with browser() as tab:
            await tab.size(1400, 1000)
            await tab.open(url)
            await tab.wait(f"{ENABLED} === '{ALL}'", 'the buttons')
            assert await tab.run(STATE) == '○ no status received'
            for what, refused in (('retract', True), ('target', True), ('stop', False)):
                os.kill(server, signal.SIGSTOP)
                assert await click(tab, what) == f'○ sending {what} …'
                await tab.wait(f'/^■ no data for [2-9] s$/.test({STATE})', 'the interruption')
                assert await tab.run(LEVELS) == 'silent'
                # The text of a late frame does not hide it.
                assert (await tab.run(f'(say(), {STATE})')).startswith('■ no data for ')
                os.kill(server, signal.SIGCONT)
                reason = 'not executed: the click was ' if refused else 'no node offers '
                await tab.wait(f"{ANSWER}.startsWith('■ refused {what}: {reason}')", 'the answer')
                await tab.wait(f"{STATE} === '○ no status received'", 'the end')
            assert (await click(tab, 'retract')).startswith('○ sending')
            await tab.wait(f"{ANSWER}.startsWith('■ refused retract: no node offers')", 'a click')
            assert tab.faults == []

    with watching(ros_graph.environment, '--control') as (running, url):
        asyncio.run(look(running.pid, url))


def test_end_and_restart_of_the_server_are_shown(ros_graph: RosGraph) -> None:
    """Without a click: no connection, and a token that the next server does not accept."""

    async def look(tab: Tab, url: str) -> None:
        await tab.open(url)
        await tab.wait(f"{ENABLED} === '{ALL}'", 'the buttons')

    async def after_end(tab: Tab) -> None:
        words = 'not connected: needle watch has ended or is not reachable'
        await tab.wait(f"{STATE} === '■ {words}'", 'the end')
        assert (await tab.run(f'(say(), {STATE})')) == f'■ {words}'
        assert await tab.run(ENABLED) == 'Stop'
        assert await tab.run(LEVELS) == 'silent'
        assert await tab.run(ANSWER) == f'■ {words}'
        assert await click(tab, 'stop') == f'■ refused stop: not sent, {words}'
        # The button is disabled, and Enter in a field sends nothing either.
        submit = "document.getElementById('target').dispatchEvent(new Event('submit', "
        submit += '{cancelable: true}))'
        await tab.run(submit)
        assert await tab.run(ANSWER) == f'■ refused target: not sent, {words}'

    async def whole() -> None:
        async with browser() as tab:
            await tab.size(1400, 1000)
            with watching(ros_graph.environment, '--control') as (_, url):
                await look(tab, url)
            await after_end(tab)
            port = url.partition('/#')[0].rpartition(':')[2]
            with watching(ros_graph.environment, '--control', '--port', port):
                await tab.wait(f"{ANSWER}.includes('wrong token: open the URL')", 'the token')
                assert await tab.run(ENABLED) == 'Stop'

    asyncio.run(whole())


def test_paused_recording_is_not_silent_and_keeps_its_speed(tmp_path: Path) -> None:
    """The speed that the page shows is also that of the next server."""
    write_watched(tmp_path / 'bag')

    async def whole() -> None:
        async with browser() as tab:
            speed = "document.getElementById('speed')"
            with watching(dict(os.environ), str(tmp_path / 'bag')) as (running, url):
                await tab.open(url)
                await tab.wait('window.needleWatch && needleWatch.drawn > 2', 'the page')
                await tab.run(f"({speed}.value = '5', {speed}.dispatchEvent(new Event('change')))")
                await tab.wait('playback.speed === 5 && !playback.playing', 'the end')
                # The clock arrives twice during the pause.
                for _ in range(2):
                    arrived = await tab.run('connection.clock[1]')
                    await tab.wait(f'connection.clock[1] > {arrived}', 'the clock')
                assert not (await tab.run(STATE)).startswith('■ no data')
                os.kill(running.pid, signal.SIGSTOP)
                await tab.wait(f"{STATE}.startsWith('■ no data for ')", 'the interruption')
            await tab.wait(f"{STATE}.startsWith('■ not connected')", 'the end')
            port = url.rstrip('/').rpartition(':')[2]
            with watching(dict(os.environ), str(tmp_path / 'bag'), '--port', port):
                await tab.wait(f"!{STATE}.startsWith('■ not')", 'the next server')
                await tab.wait('playback.speed === 5', 'the speed')
                assert tab.faults == [one for one in tab.faults if 'ERR_CONNECTION' in one]

    asyncio.run(whole())
