"""
The page's server: one page, its files, and frames over a WebSocket.

Who may do what, and what refuses the others:

- It listens on an address of this machine only, unless it is opened for looking.
- A request must name an address, not a name that somebody else's name server may lead here, and
  a WebSocket must come from the page itself.
- Commands are taken only where there is a control, and only with the token of this process.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
import errno
from hmac import compare_digest
from ipaddress import ip_address
import json
from math import isfinite
from pathlib import Path
from secrets import token_urlsafe
from typing import Any, Final, Protocol
from urllib.parse import urlsplit

from aiohttp import web, WSCloseCode, WSMessage, WSMsgType
from needle_insertion.live.requests import REQUESTS
from needle_insertion.report.page import TEMPLATE_FOLDER
from needle_ros.errors import JobError, NeedleError, ParameterError, printable

#: Port by default.
PORT: Final = 8642

#: Most readers at a time, and longest message of one [bytes].
MOST_READERS: Final = 16
LONGEST: Final = 4096

#: Frames that a reader gets before it has seen the first of them, and commands of one that may
#: be under way.
_AHEAD: Final = 2
_MOST_ASKED: Final = 8

#: A reader that accepts no data for this time is disconnected [s].
_PATIENCE: Final = 10.0

#: Time between two looks whether a reader is still there [s].
_HEARTBEAT: Final = 20.0

_PAGE: Final = Path(__file__).with_name('page')

#: The files of the page; the drawing of the needle is that of the reports.
_FILES: Final = {
    '/': (_PAGE / 'watch.html', 'text/html'),
    '/watch.css': (_PAGE / 'watch.css', 'text/css'),
    '/watch.js': (_PAGE / 'watch.js', 'text/javascript'),
    '/needle.js': (TEMPLATE_FOLDER / 'needle.js', 'text/javascript'),
}

#: The browser loads nothing from elsewhere, shows the page in no other, and tells nobody of it.
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


class Reader(Protocol):
    """What one reader of the page sees."""

    async def next(self) -> str:
        """Wait until there is something new, and return it as JSON; what is old is left out."""

    def take(self, message: dict[str, Any]) -> None:
        """
        Do what this reader asks for.

        Parameters
        ----------
        message : dict
            From the page.

        Raises
        ------
        ParameterError
            If it is not valid.

        """


class Control(Protocol):
    """Requests that the buttons of the page send."""

    async def target(self, x: float, y: float, z: float) -> tuple[bool, str]:
        """
        Send a target of the tip.

        Parameters
        ----------
        x, y, z : float
            The target [m].

        Returns
        -------
        bool, str
            Whether it is accepted, and the answer of the node.

        Raises
        ------
        JobError
            If there is no answer.

        """

    async def ask(self, what: str) -> tuple[bool, str]:
        """
        Call the services of a request.

        Parameters
        ----------
        what : str
            A key of `needle_insertion.live.requests.REQUESTS`.

        Returns
        -------
        bool, str
            Whether it was executed, and the answers of the nodes.

        Raises
        ------
        JobError
            If there is no answer.

        """


class Server:
    """
    Serves the page.

    Parameters
    ----------
    readers : callable
        Makes what a new reader sees.
    host : str
        Address to listen on.
    port : int
        Port; 0 for a free one.
    control : Control, optional
        What the buttons do; without it there are none.

    Attributes
    ----------
    token : str
        Whoever has it may use the buttons; '' without a control.

    Raises
    ------
    ParameterError
        If the address is not one, or a control would be open to other machines.

    """

    def __init__(
        self,
        readers: Callable[[], Reader],
        host: str = '127.0.0.1',
        port: int = PORT,
        control: Control | None = None,
    ) -> None:
        try:
            self._local = ip_address(host).is_loopback
        except ValueError:
            raise ParameterError(
                f'--host must be an address such as 127.0.0.1 or 0.0.0.0, got {host!r}'
            ) from None
        if control is not None and not self._local:
            raise ParameterError(
                f'--control works on this machine only, and --host {host} opens the page to '
                'others: leave out one of them'
            )
        if not 0 <= port <= 65535:
            raise ParameterError(f'--port must be 0 to 65535, got {port}')
        self.token = token_urlsafe(24) if control is not None else ''
        self._readers, self._host, self._port = readers, host, port
        self._control = control
        self._open: set[web.WebSocketResponse] = set()
        self._runner: web.AppRunner | None = None

    @property
    def address(self) -> str:
        """URL of the page, with the token if there is one."""
        host = '127.0.0.1' if ip_address(self._host).is_unspecified else self._host
        host = f'[{host}]' if ':' in host else host
        # What follows # stays in the browser.
        return f'http://{host}:{self._port}/' + (f'#token={self.token}' if self.token else '')

    @property
    def words(self) -> list[str]:
        """What to say at the start, in lines."""
        lines = [f'page: {self.address}']
        if self.token:
            lines.append('whoever has this address may move the needle: keep it to yourself')
        elif not self._local:
            lines.append(
                f'other machines may look, by an address of this one and port {self._port}; '
                'nobody may command here'
            )
        return [*lines, 'Ctrl-C ends it']

    async def start(self) -> None:
        """
        Begin to listen.

        Raises
        ------
        ParameterError
            If the port is in use, or the address is not of this machine.

        """
        app = web.Application(middlewares=[self._guard], client_max_size=LONGEST)
        for path, (file, kind) in _FILES.items():
            app.router.add_get(path, _file(file, kind))
        app.router.add_get('/frames', self._frames)
        app.on_shutdown.append(self._close)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await self._runner.setup()
        site = web.TCPSite(self._runner, self._host, self._port)
        try:
            await site.start()
        except OSError as error:
            await self.end()
            other = self._port + 1 if self._port < 65535 else PORT
            raise ParameterError(
                f'cannot listen on {self._host}, port {self._port}: {_reason(error)}; valid: '
                f'another --port, such as {other}, or 0 for a free one'
            ) from error
        self._port = self._runner.addresses[0][1]

    async def end(self) -> None:
        """Let all readers go, and stop listening."""
        if self._runner is not None:
            await self._runner.cleanup()
            self._runner = None

    async def _close(self, _app: web.Application) -> None:
        for socket in [*self._open]:
            with suppress(asyncio.TimeoutError, ConnectionError):
                await asyncio.wait_for(socket.close(code=WSCloseCode.GOING_AWAY), 0.5)

    # Who is let in.

    @web.middleware
    async def _guard(
        self,
        request: web.Request,
        handler: Callable[[web.Request], Awaitable[web.StreamResponse]],
    ) -> web.StreamResponse:
        """Refuse what a page of somebody else could make a browser ask for."""
        fault = self._fault(request.headers.get('Host', ''), request.headers.get('Origin'))
        if fault:
            return web.Response(status=403, text=f'{fault}\n', headers=_HEADERS)
        try:
            return await handler(request)
        except web.HTTPException as error:
            error.headers.update(_HEADERS)
            raise

    def _fault(self, host: str, origin: str | None) -> str:
        """Return why a request is refused; '' if it is not."""
        try:
            parts = urlsplit(f'//{host}')
            name, port = parts.hostname or '', parts.port or 80
            # The name of this machine, or an address: no name server leads to these.
            allowed = name == 'localhost' or ip_address(name).is_loopback or not self._local
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

    # A reader.

    async def _frames(self, request: web.Request) -> web.StreamResponse:
        if len(self._open) >= MOST_READERS:
            return web.Response(
                status=503, text=f'{MOST_READERS} pages are open already\n', headers=_HEADERS
            )
        socket = web.WebSocketResponse(
            max_msg_size=LONGEST, heartbeat=_HEARTBEAT, compress=False, timeout=1.0
        )
        await socket.prepare(request)
        self._open.add(socket)
        connection = _Connection(socket, self._readers())
        sending = asyncio.create_task(connection.send())
        # A reader that takes nothing would keep `close` waiting.
        sending.add_done_callback(lambda _: _break_off(request))
        try:
            async for message in socket:
                await self._take(connection, message)
        finally:
            self._open.discard(socket)
            for task in (sending, *connection.asking):
                task.cancel()
        return socket

    async def _take(self, connection: _Connection, message: WSMessage) -> None:
        """Do what a message asks for, or say why not."""
        try:
            content = _message(message)
            if 'ask' in content:
                connection.begin(self._do(content), str(content['ask'])[:20])
            elif content.keys() == {'seen'} and type(content['seen']) is int:
                connection.seen(content['seen'])
            else:
                connection.reader.take(content)
        except NeedleError as error:
            await connection.answer(success=False, words=str(error))

    async def _do(self, message: dict[str, Any]) -> tuple[bool, str]:
        """Pass a command on, if it is one and may be given."""
        if self._control is None:
            raise ParameterError('this page is for looking only: needle watch --control')
        token = message.pop('token', '')
        # Text of JSON may have what cannot be encoded.
        given = token.encode(errors='replace') if isinstance(token, str) else b''
        if not compare_digest(given, self.token.encode()):
            raise ParameterError(
                'the token is not that of this process: open the URL that needle watch has printed'
            )
        what = message.pop('ask')
        if what == 'target':
            at = message.pop('at', None)
            if message or not isinstance(at, list) or len(at) != 3 or not all(map(_real, at)):
                raise ParameterError('a target is {"at": [x, y, z]} with numbers in m')
            x, y, z = map(float, at)
            return await self._control.target(x, y, z)
        if not isinstance(what, str) or what not in REQUESTS or message:
            raise ParameterError(f'ask must be one of target, {", ".join(REQUESTS)}, got {what!r}')
        return await self._control.ask(what)


class _Connection:
    """
    One reader: what is sent to it, and what it has asked for.

    It gets a frame only after it has seen those before, but for a few: one that is slow misses
    some and sees no old ones, and nothing piles up.
    """

    def __init__(self, socket: web.WebSocketResponse, reader: Reader) -> None:
        self.reader = reader
        self.asking: set[asyncio.Task[None]] = set()
        self._socket = socket
        self._credit = asyncio.Semaphore(_AHEAD)
        self._ahead = 0

    def seen(self, number: int) -> None:
        """Note that frames have been seen."""
        for _ in range(min(number, self._ahead)):
            self._ahead -= 1
            self._credit.release()

    async def send(self) -> None:
        """Send what is new."""
        while True:
            await self._credit.acquire()
            self._ahead += 1
            if not await self._put(await self.reader.next()):
                return

    def begin(self, doing: Coroutine[Any, Any, tuple[bool, str]], what: str) -> None:
        """Answer when something is done; meanwhile others may be asked for."""

        async def answer() -> None:
            try:
                success, words = await doing
            except NeedleError as error:
                success, words = False, str(error)
            await self.answer(success=success, words=words, asked=what)

        if len(self.asking) >= _MOST_ASKED:
            doing.close()
            raise JobError(f'{_MOST_ASKED} commands are under way already')
        task = asyncio.create_task(answer())
        self.asking.add(task)
        task.add_done_callback(self.asking.discard)

    async def answer(self, *, success: bool, words: str, asked: str = '') -> None:
        """Say what came of a message."""
        said = {'asked': asked, 'success': success, 'words': printable(words)}
        await self._put(json.dumps({'answer': said}))

    async def _put(self, text: str) -> bool:
        """Send a text; return whether it was taken."""
        try:
            await asyncio.wait_for(self._socket.send_str(text), _PATIENCE)
        except (ConnectionError, asyncio.TimeoutError):
            return False
        return True


def _break_off(request: web.Request) -> None:
    """End the connection of a request at once."""
    if request.transport is not None:
        request.transport.abort()


def _file(file: Path, kind: str) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
    text = file.read_text(encoding='utf-8')

    async def answer(_request: web.Request) -> web.StreamResponse:
        return web.Response(text=text, content_type=kind, charset='utf-8', headers=_HEADERS)

    return answer


def _message(message: WSMessage) -> dict[str, Any]:
    """Return what a message says."""
    try:
        content = json.loads(message.data, parse_constant=_no_number)
    except (ValueError, TypeError, RecursionError):
        content = None
    if message.type is not WSMsgType.TEXT or not isinstance(content, dict):
        raise ParameterError('a message must be text, a JSON object')
    return content


def _no_number(name: str) -> float:
    raise ValueError(name)


def _real(value: object) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    # Integers of JSON may have any number of digits.
    return number and abs(value) < 1e9 and isfinite(value)  # type: ignore[arg-type]


def _reason(error: OSError) -> str:
    """Return what the system says, without what asyncio adds to it."""
    if error.errno == errno.EADDRINUSE:
        return 'the port is in use'
    return error.strerror or str(error)
