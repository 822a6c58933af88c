# SPDX-License-Identifier: Apache-2.0
"""Live page of `needle watch` in a browser, with given readings instead of a ROS graph."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
import subprocess
import sys
from typing import Any

from needle_insertion.watch.live import Live, LiveReader
from needle_insertion.watch.server import Server
from needle_insertion.watch.view import View
from needle_ros.wire import Reading
from support.installed import ROOT
from tools.browser import browser, Tab


def joints(*names: str, at: float = 0.05, stamp: int = 0) -> Reading:
    """Return a reading of joints at one position, at rest."""
    return Reading(stamp, '', names, ((at,) * len(names), (0.0,) * len(names), ()))


class LivePage:
    """View, server and browser of a page; each frame has the readings of `feed` again."""

    def __init__(self, control: Any = None, port: int = 0) -> None:
        self.view = View()
        self.feed: dict[str, Reading] = {}
        self.live = Live(self.view, self._poll, control=control is not None)
        self.server = Server(lambda: LiveReader(self.live), port=port, control=control)
        self._running: asyncio.Task[None] | None = None

    def _poll(self, now: float) -> None:
        for name, reading in self.feed.items():
            self.view.reading(name, reading, now)

    async def begin(self) -> None:
        await self.server.start()
        self._running = asyncio.create_task(self.live.run())

    async def end(self) -> None:
        if self._running is not None:
            self._running.cancel()
            with suppress(asyncio.CancelledError):
                await self._running
        await self.server.end()


@contextmanager
def watching(environment: dict[str, str], *words: str) -> Iterator[tuple[Any, str]]:
    """Start `needle watch`; return its process and the URL of its page."""
    running = subprocess.Popen(
        [sys.executable, '-m', 'needle_insertion.cli', 'watch', '--port', '0', *words],
        env={**environment, 'PYTHONPATH': str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert running.stdout is not None
        line = running.stdout.readline()
        assert line.startswith('page: http://127.0.0.1:'), line
        yield running, line.removeprefix('page: ').strip()
    finally:
        running.kill()
        running.communicate()


@asynccontextmanager
async def live_page(control: Any = None, **feed: Reading) -> AsyncIterator[tuple[LivePage, Tab]]:
    """Serve a page, and open it in a browser."""
    page = LivePage(control)
    page.feed |= feed
    await page.begin()
    try:
        async with browser() as tab:
            await tab.size(1400, 1000)
            await tab.open(page.server.address)
            await tab.wait('window.needleWatch && needleWatch.drawn > 2', 'the page')
            yield page, tab
    finally:
        await page.end()
