# SPDX-License-Identifier: Apache-2.0
"""
HTTP and WebSocket server of the page: its files, frames and commands.

Access control:

- The server listens on a loopback address unless other machines are given read access.
- The header Host must be an address, not a host name that another name server resolves to this
  machine, and a WebSocket must have the origin of the page itself.
- Commands require a control and the token of this process.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import suppress
import errno
from functools import partial
from hmac import compare_digest
from ipaddress import ip_address
import json
import logging
from pathlib import Path
from secrets import token_urlsafe
import sys
from time import monotonic
from typing import Any, cast, Final, Protocol
from urllib.parse import urlsplit

from aiohttp import web, WSCloseCode, WSMessage, WSMsgType
from aiohttp.http import HttpProcessingError
from needle_insertion.live.requests import REQUESTS
from needle_insertion.report.page import TEMPLATE_FOLDER
from needle_insertion.watch import HOST, PORT
from needle_ros.errors import JobError, NeedleError, ParameterError, printable, shown
from needle_ros.settings import is_number

#: Largest number of readers, and of bytes in a message of a reader.
MOST_READERS: Final = 16
LONGEST: Final = 4096

#: Largest number of unacknowledged frames and of commands in progress, per reader.
_AHEAD: Final = 2
_MOST_ASKED: Final = 8

#: Commands that may begin or permit a motion, and the largest time since their click [s].
_MOVING: Final = ('target', 'resume', 'retract', 'clear')
_LATE: Final = 1.0

_CHECK: Final = 'check'  #: Request without effect, whose answer is whether the token is valid.
BEAT: Final = 0.25  #: period of the clock that a page receives, also without frames [s]

_PATIENCE: Final = 10.0  #: timeout of a reader that accepts no data, or sends no request [s]
_MOST_CONNECTIONS: Final = 128  #: largest number of connections, far from that of open files
_HEARTBEAT: Final = 20.0  #: period of the heartbeat of a WebSocket [s]

_PAGE: Final = Path(__file__).with_name('page')

#: Files of the page; the drawing of the needle is shared with the reports.
_FILES: Final = {
    '/': (_PAGE / 'watch.html', 'text/html'),
    '/watch.css': (_PAGE / 'watch.css', 'text/css'),
    **{
        f'/{name}.js': (_PAGE / f'{name}.js', 'text/javascript')
        for name in ('charts', 'connection', 'watch')
    },
    **{
        f'/anatomy.{kind}': (TEMPLATE_FOLDER / f'anatomy.{kind}', f'text/{name}')
        for kind, name in (('js', 'javascript'), ('css', 'css'))
    },
    '/needle.js': (TEMPLATE_FOLDER / 'needle.js', 'text/javascript'),
}

#: No content from other origins, no embedding in other pages, no referrer.
_HEADERS: Final = {
    'Content-Security-Policy': "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    'X-Frame-Options': 'DENY',
    'X-Content-Type-Options': 'nosniff',
    'Referrer-Policy': 'no-referrer',
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Cache-Control': 'no-store',
}


class FrameReader(Protocol):
    """Interface of the source of frames for one reader of the page."""

    async def next(self) -> str:
        """Wait for the next frame and return it as JSON; outdated frames are skipped."""

    def take(self, message: dict[str, Any]) -> None:
        """Process a message from the page; `ParameterError` if it is invalid."""


class Control(Protocol):
    """Interface of the requests that the buttons of the page send."""

    async def target(self, x: float, y: float, z: float) -> tuple[bool, str]:
        """Send a target [m]; return acceptance and answer, `JobError` without an answer."""

    async def ask(self, what: str) -> tuple[bool, str]:
        """Call the services of a key of `REQUESTS`; return success and the answers."""


class _Refusal(asyncio.Protocol):
    """A connection that is closed at once."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        cast(asyncio.Transport, transport).abort()


class Server:
    """HTTP and WebSocket server; `ParameterError` if a control would be open to other machines."""

    def __init__(
        self,
        readers: Callable[[], FrameReader],
        host: str = HOST,
        port: int = PORT,
        control: Control | None = None,
        anatomy: str = 'null',
    ) -> None:
        try:
            self._local = ip_address(host).is_loopback
        except ValueError:
            raise ParameterError(
                f'--host must be an address such as {HOST} or 0.0.0.0, got {host!r}'
            ) from None
        if control is not None and not self._local:
            raise ParameterError(
                f'--control works on this machine only, and --host {host} opens the page to '
                'other machines: remove one of the options'
            )
        if not 0 <= port <= 65535:
            raise ParameterError(f'--port must be 0 to 65535, got {port}')
        #: Authorizes commands.
        self.token = token_urlsafe(24) if control is not None else ''
        self._readers, self._host, self._port = readers, host, port
        self._control = control
        #: Anatomy and plan in 3D for the page, as JSON.
        self._anatomy = {'text': anatomy, 'content_type': 'application/json'}
        self._open: set[web.WebSocketResponse] = set()
        self._runner: web.AppRunner | None = None
        self._listener: asyncio.Server | None = None
        #: Connections that have not sent a request yet.
        self._silent: set[Any] = set()

    @property
    def address(self) -> str:
        """URL of the page, including the token of a control."""
        host = '127.0.0.1' if ip_address(self._host).is_unspecified else self._host
        host = f'[{host}]' if ':' in host else host
        # The fragment after # is not sent by the browser.
        return f'http://{host}:{self._port}/' + (f'#token={self.token}' if self.token else '')

    @property
    def words(self) -> list[str]:
        lines = [f'page: {self.address}']
        if self.token:
            lines.append('this address permits motion of the needle: do not share it')
        elif not self._local:
            lines.append(
                f'read access for other machines, at an address of this machine and port '
                f'{self._port}; no commands'
            )
        return [*lines, 'stop with Ctrl-C']

    async def start(self) -> None:
        """Start to listen; `ParameterError` if the port is in use or the address is not local."""
        app = web.Application(middlewares=[self._guard], client_max_size=LONGEST)
        for path, (file, kind) in _FILES.items():
            content = {'text': file.read_text(encoding='utf-8'), 'content_type': kind}
            app.router.add_get(path, partial(_answer, content))
        app.router.add_get('/anatomy.json', partial(_answer, self._anatomy))
        app.router.add_get('/frames', self._frames)
        app.on_shutdown.append(self._close)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0, logger=_logger())
        await self._runner.setup()
        loop = asyncio.get_running_loop()
        try:
            self._listener = await loop.create_server(self._connection, self._host, self._port)
        except OSError as error:
            await self.end()
            other = self._port + 1 if self._port < 65535 else PORT
            # Without additions of asyncio.
            why = error.strerror or str(error)
            why = 'the port is in use' if error.errno == errno.EADDRINUSE else why
            raise ParameterError(
                f'cannot listen on {self._host}, port {self._port}: {why}; '
                f'use another one, such as --port {other}, or --port 0 for a free one'
            ) from error
        self._port = self._listener.sockets[0].getsockname()[1]

    def _connection(self) -> asyncio.Protocol:
        """Return the handler of a new connection, which must send a request in time."""
        server = self._runner.server if self._runner is not None else None
        if server is None or len(server.connections) >= _MOST_CONNECTIONS:
            return _Refusal()
        handler = server()
        self._silent.add(handler)
        asyncio.get_running_loop().call_later(_PATIENCE, self._expect_request, handler)
        return handler

    def _expect_request(self, handler: web.RequestHandler) -> None:
        if handler in self._silent and handler.transport is not None:
            handler.transport.abort()
        self._silent.discard(handler)

    async def end(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        if self._runner is not None:
            await self._runner.cleanup()
            self._runner = None

    async def _close(self, _app: web.Application) -> None:
        for socket in [*self._open]:
            with suppress(asyncio.TimeoutError, ConnectionError):
                await asyncio.wait_for(socket.close(code=WSCloseCode.GOING_AWAY), 0.5)

    # Access control.

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Reject requests that a foreign page can make a browser send."""
        self._silent.discard(request.protocol)
        fault = self._fault(request.headers.get('Host', ''), request.headers.get('Origin'))
        if fault:
            return web.Response(status=403, text=f'{fault}\n', headers=_HEADERS)
        try:
            return await handler(request)
        except web.HTTPException as error:
            error.headers.update(_HEADERS)
            raise

    def _fault(self, host: str, origin: str | None) -> str:
        try:
            parts = urlsplit(f'//{host}')
            name, port = parts.hostname or '', parts.port or 80
            # localhost or an address: not resolved by a name server.
            allowed = name == 'localhost' or ip_address(name).is_loopback or not self._local
            whole = f'[{name}]' if ':' in name else name
            allowed &= host.lower() in (f'{whole}:{port}', whole)
        except ValueError:
            allowed, port = False, 0
        if not allowed or port != self._port:
            return printable(
                f'the header Host must be an address of this server, such as '
                f'{self._host}:{self._port}, got {host!r}'
            )
        if origin is not None and origin != f'http://{host}':
            return printable(f'the header Origin must be http://{host}, got {origin!r}')
        return ''

    # Readers.

    async def _frames(self, request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(
            max_msg_size=LONGEST, heartbeat=_HEARTBEAT, compress=False, timeout=1.0
        )
        full = len(self._open) >= MOST_READERS
        await socket.prepare(request)
        if full:
            # The status of a rejected request is not visible to a page.
            reason = f'{MOST_READERS} pages are open already: close one, then load this page again'
            await socket.close(code=WSCloseCode.TRY_AGAIN_LATER, message=reason.encode())
            return socket
        self._open.add(socket)
        connection = _Connection(socket, self._readers())
        sending = [asyncio.create_task(one()) for one in (connection.send, connection.beat)]
        for task in sending:
            # A reader that accepts no data would block `close`.
            task.add_done_callback(lambda _: _break_off(request))
        try:
            async for message in socket:
                await self._take(connection, message)
        finally:
            self._open.discard(socket)
            for task in (*sending, *connection.asking):
                task.cancel()
        return socket

    async def _take(self, connection: _Connection, message: WSMessage) -> None:
        try:
            content = _message(message)
            if 'ask' in content:
                connection.begin(self._do(content), str(content['ask'])[:20])
            elif content.keys() == {'seen'} and type(content['seen']) is int:
                connection.acknowledge(content['seen'])
            else:
                connection.reader.take(content)
        except NeedleError as error:
            await connection.answer(success=False, words=str(error))

    async def _do(self, message: dict[str, Any]) -> tuple[bool, str]:
        if self._control is None:
            raise ParameterError('this page is read-only: use needle watch --control')
        token = message.pop('token', '')
        # JSON text can contain characters that cannot be encoded.
        given = token.encode(errors='replace') if isinstance(token, str) else b''
        if not compare_digest(given, self.token.encode()):
            raise ParameterError('wrong token: open the URL printed by needle watch')
        what, clicked = message.pop('ask'), message.pop('clicked', None)
        if what == _CHECK and not message:
            return True, ''
        if what in _MOVING:
            _check_age(clicked)
        if what == 'target':
            at = message.pop('at', None)
            if message or not isinstance(at, list) or len(at) != 3 or not all(map(is_number, at)):
                raise ParameterError('a target is {"at": [x, y, z]} with numbers in m')
            x, y, z = map(float, at)
            return await self._control.target(x, y, z)
        if not isinstance(what, str) or what not in REQUESTS or message:
            raise ParameterError(f'ask must be one of target, {", ".join(REQUESTS)}, got {what!r}')
        return await self._control.ask(what)


class _Connection:
    """Connection to one reader, which skips frames until it acknowledges all but `_AHEAD`."""

    def __init__(self, socket: web.WebSocketResponse, reader: FrameReader) -> None:
        self.reader = reader
        self.asking: set[asyncio.Task[None]] = set()
        self._socket = socket
        self._credit = asyncio.Semaphore(_AHEAD)
        self._ahead = 0

    def acknowledge(self, number: int) -> None:
        for _ in range(min(number, self._ahead)):
            self._ahead -= 1
            self._credit.release()

    async def beat(self) -> None:
        """Send the clock of commands: a page without it reports an interruption."""
        while await self._put(json.dumps({'clock': round(monotonic(), 3)})):
            await asyncio.sleep(BEAT)

    async def send(self) -> None:
        while True:
            await self._credit.acquire()
            self._ahead += 1
            if not await self._put(await self.reader.next()):
                return

    def begin(self, doing: Coroutine[Any, Any, tuple[bool, str]], what: str) -> None:

        async def answer() -> None:
            try:
                success, words = await doing
            except NeedleError as error:
                success, words = False, str(error)
            await self.answer(success=success, words=words, asked=what)

        if len(self.asking) >= _MOST_ASKED:
            doing.close()
            raise JobError(f'{_MOST_ASKED} commands are already in progress')
        task = asyncio.create_task(answer())
        self.asking.add(task)
        task.add_done_callback(self.asking.discard)

    async def answer(self, *, success: bool, words: str, asked: str = '') -> None:
        answer = {'asked': asked, 'success': success, 'words': printable(words)}
        await self._put(json.dumps({'answer': answer}))

    async def _put(self, text: str) -> bool:
        """Send a text; return whether the reader accepted it."""
        try:
            await asyncio.wait_for(self._socket.send_str(text), _PATIENCE)
        except (ConnectionError, asyncio.TimeoutError):
            return False
        return True


def _check_age(clicked: object) -> None:
    """Raise an error if a command is older than `_LATE` by the clock of the page."""
    if not is_number(clicked) or clicked > monotonic() + _LATE:
        raise ParameterError(
            f'a command needs "clicked", the last "clock" plus the time since then [s], got '
            f'{clicked!r}'
        )
    if (age := monotonic() - clicked) > _LATE:
        raise JobError(
            f'not executed: the click was {age:.1f} s ago, before an interruption of the '
            'connection; click again if it is still wanted'
        )


class _OneLine(logging.Handler):
    """Print rejected requests as one line, and errors of this program with their traceback."""

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        text = self.format(record)
        if isinstance(error, HttpProcessingError):
            text = shown(f'warning: request rejected: {error.message.partition(chr(10))[0]}')
        sys.stderr.write(f'{text}\n')


def _logger() -> logging.Logger:
    logger = logging.getLogger(__name__)
    logger.propagate, logger.handlers = False, [_OneLine()]
    return logger


def _break_off(request: web.Request) -> None:
    if request.transport is not None:
        request.transport.abort()


async def _answer(content: Mapping[str, str], _request: web.Request) -> web.StreamResponse:
    return web.Response(**content, charset='utf-8', headers=_HEADERS)  # type: ignore[arg-type]


def _message(message: WSMessage) -> dict[str, Any]:
    try:
        # Not a number, and infinity: `int` raises ValueError.
        content = json.loads(message.data, parse_constant=int)
    except (ValueError, TypeError, RecursionError):
        content = None
    if message.type is not WSMsgType.TEXT or not isinstance(content, dict):
        raise ParameterError('a message must be text, a JSON object')
    return content
