# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium, controlled over the Chrome DevTools protocol."""

from __future__ import annotations

import asyncio
from base64 import b64decode
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import count
import json
from pathlib import Path
import shutil
import subprocess
from tempfile import TemporaryDirectory
from typing import Any, Final

from aiohttp import ClientSession, ClientWebSocketResponse, WSMsgType

#: Program of the browser; None if none is installed.
BROWSER: Final = next(
    filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), None
)

#: Options of a browser without a window, which requests nothing from the network on its own.
HEADLESS: Final = (
    '--headless=new', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage', '--disable-quic',
    '--no-first-run', '--disable-background-networking', '--disable-component-update',
    '--disable-sync',
)  # fmt: skip

#: Timeout of the browser on a busy machine [s].
_PATIENCE: Final = 120.0


class BrowserError(RuntimeError):
    """Failure of the browser, or of a script in its page."""


class Tab:
    """A page in the browser."""

    def __init__(self, stream: ClientWebSocketResponse) -> None:
        self._stream, self._numbers = stream, count(1)
        #: URLs requested by the page, and errors of its script.
        self.requests: list[str] = []
        self.faults: list[str] = []

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        await self._stream.send_json({'id': number, 'method': method, 'params': parameters})
        while True:
            message = await self._stream.receive(_PATIENCE)
            if message.type is not WSMsgType.TEXT:
                raise BrowserError(f'the browser ended: {message}')
            said = json.loads(message.data)
            given = said.get('params', {})
            match said.get('method'):
                case 'Network.requestWillBeSent':
                    self.requests.append(given['request']['url'])
                case 'Network.webSocketCreated':
                    self.requests.append(given['url'])
                case 'Runtime.exceptionThrown':
                    self.faults.append(str(given['exceptionDetails']))
                case 'Log.entryAdded' if given['entry']['level'] == 'error':
                    self.faults.append(given['entry']['text'])
            if said.get('id') == number:
                if 'error' in said:
                    raise BrowserError(f'{method}: {said["error"]}')
                result: dict[str, Any] = said['result']
                return result

    async def run(self, script: str) -> Any:
        """Return the value of a script."""
        said = await self.call(
            'Runtime.evaluate', expression=script, returnByValue=True, awaitPromise=True
        )
        if 'exceptionDetails' in said:
            raise BrowserError(f'{script}: {said["exceptionDetails"]}')
        return said['result'].get('value')

    async def wait(self, script: str, what: str) -> Any:
        """Wait until the value of a script is true, and return it."""
        # While a page loads, its elements may be missing.
        script = f'(() => {{ try {{ return {script} }} catch {{ return null }} }})()'
        for _ in range(round(_PATIENCE / 0.1)):
            if value := await self.run(script):
                return value
            await asyncio.sleep(0.1)
        raise BrowserError(f'timeout waiting for {what}; faults: {self.faults}')

    async def size(self, width: int, height: int) -> None:
        """Set the page size [pixels]."""
        await self.call('Emulation.setScrollbarsHidden', hidden=True)
        await self.call(
            'Emulation.setDeviceMetricsOverride',
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip

    async def open(self, url: str) -> None:
        for domain in ('Page', 'Network', 'Runtime', 'Log'):
            await self.call(f'{domain}.enable')
        await self.call('Page.navigate', url=url)

    async def press(self, key: str) -> None:
        text = {'Enter': '\r', ' ': ' '}.get(key, '')
        code = {'Tab': 9, 'Enter': 13, ' ': 32}[key]
        for kind in ('keyDown', 'keyUp'):
            await self.call(
                'Input.dispatchKeyEvent', type=kind, key=key, code='Space' if key == ' ' else key,
                text=text if kind == 'keyDown' else '', windowsVirtualKeyCode=code,
            )  # fmt: skip

    async def image(self, height: int) -> bytes:
        """Return a screenshot of the page, as PNG, of at most a height [pixels]."""
        wide, tall = await self.run(
            '[document.documentElement.clientWidth, document.documentElement.scrollHeight]'
        )
        clip = {'x': 0, 'y': 0, 'width': wide, 'height': min(tall, height), 'scale': 1}
        said = await self.call('Page.captureScreenshot', captureBeyondViewport=True, clip=clip)
        return b64decode(said['data'])

    async def picture(self, path: Path) -> None:
        """Save a screenshot of the whole page."""
        said = await self.call('Page.captureScreenshot', captureBeyondViewport=True)
        path.write_bytes(b64decode(said['data']))


@asynccontextmanager
async def browser() -> AsyncIterator[Tab]:
    """Run a headless browser within the context."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        running = subprocess.Popen(
            [
                str(BROWSER),
                *HEADLESS,
                '--remote-debugging-port=0',
                f'--user-data-dir={scratch}/profile',
                'about:blank',
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            said = Path(scratch, 'profile/DevToolsActivePort')
            for _ in range(round(_PATIENCE / 0.1)):
                if said.is_file() and '\n' in said.read_text():
                    break
                await asyncio.sleep(0.1)
            port = said.read_text().splitlines()[0]
            async with ClientSession() as session:
                async with session.get(f'http://127.0.0.1:{port}/json/list') as reply:
                    (page,) = [one for one in await reply.json() if one['type'] == 'page']
                url = page['webSocketDebuggerUrl']
                async with session.ws_connect(url, max_msg_size=0) as stream:
                    yield Tab(stream)
        finally:
            running.terminate()
            try:
                running.wait(30.0)
            finally:
                running.kill()
                running.wait()
