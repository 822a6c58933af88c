# SPDX-License-Identifier: Apache-2.0
"""
OpenIGTLink messages of a peer over TCP, as server or client, without threads and blocking calls.

The server and the client of pyigtl are not used, because they are unsuitable for a node: the
server replaces the handlers of SIGINT and SIGTERM and selects its own addresses. Both use a full
core after a peer has closed its end, until data is sent; they read any size that a header
declares, do not verify checksums, send outdated data, and print tracebacks.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from errno import EADDRINUSE, EINPROGRESS
from ipaddress import AddressValueError, IPv4Address
import os
import select
import socket
import struct
from time import monotonic
from typing import Final, NamedTuple

from needle_ros.errors import MessageError, ParameterError
from needle_ros.event_log import EventLog, Severity
from needle_ros.settings import check_constants, choice, constant, text

#: Version, type, device name, time stamp (whole and fraction), size of the body, checksum.
HEADER: Final = struct.Struct('>H12s20sIIQQ')

#: Versions of the header: 1 and 2 of OpenIGTLink 1 to 3, and a future version.
_VERSIONS: Final = (1, 2, 3)

LARGEST: Final = 1 << 16  #: largest accepted body of a target [bytes]: 481 points

#: Largest skipped body [bytes]; a larger size is a protocol error.
_LARGEST_SKIPPED: Final = 1 << 30

_RETRY: Final = 1.0  #: time between attempts to listen or to connect [s]
_PATIENCE: Final = 5.0  #: timeout of a peer that accepts no byte [s]

#: Largest read, largest sum of reads in a call of `poll`, and largest send queue [bytes].
_AT_ONCE: Final = 1 << 14
_MOST_READ: Final = 1 << 18
_MOST_WAITING: Final = 1 << 18

#: Longest time in a call of `poll` for the bytes of a large message [s].
_LONGEST_READ: Final = 5e-3

#: Buffers of the system; small, because data in them becomes outdated [bytes].
_SYSTEM_BUFFER: Final = 1 << 16

#: Largest number of additional peers that are rejected in a call of `poll`.
_MOST_REJECTED: Final = 8


class Frame(NamedTuple):
    """Unparsed message: its type, such as ``POINT``, name of the device, header and body."""

    kind: str
    device: str
    data: bytes | bytearray
    error: str = ''  #: reason why the message is not complete


class Frames:
    """
    Splitter of a byte stream into messages; too large ones have an error in place of their data.

    `largest` returns the largest accepted body of a type and a device [bytes], 0 to skip it.
    """

    def __init__(self, largest: Callable[[str, str], int]) -> None:
        self._largest = largest
        self._rest = bytearray()
        self._skip = 0
        #: Size with which the next message is complete, and its type and device.
        self._whole, self._next = 0, ('', '')

    @property
    def is_large(self) -> bool:
        """Whether a message is incomplete that is larger than a target."""
        return self._whole > HEADER.size + LARGEST

    def lost(self) -> list[Frame]:
        """Return the incomplete message, if any, with the error that its end is lost."""
        received = f'{len(self._rest)} of {self._whole} bytes received'
        return [Frame(*self._next, b'', f'connection lost, {received}')] * bool(self._whole)

    def take(self, data: bytes) -> list[Frame]:
        """Return the messages completed by further bytes; `MessageError` if not OpenIGTLink."""
        self._rest += data
        stream, at, found = self._rest, 0, []
        if len(stream) < self._whole:
            return []
        self._whole = 0
        while True:
            step = min(self._skip, len(stream) - at)
            at, self._skip = at + step, self._skip - step
            if self._skip or len(stream) - at < HEADER.size:
                break
            kind, device, size = _header(bytes(stream[at : at + HEADER.size]))
            whole, largest = HEADER.size + size, self._largest(kind, device)
            if not largest:
                self._skip = whole
            elif size > largest:
                reason = f'a {kind} message of {size} bytes, {largest} at most'
                found.append(Frame(kind, device, b'', reason))
                self._skip = whole
            elif len(stream) - at < whole:
                self._whole, self._next = whole, (kind, device)
                break
            elif size > LARGEST:
                # Not copied.
                del stream[:at]
                message, stream, at = stream, stream[whole:], 0
                del message[whole:]
                found.append(Frame(kind, device, message))
            else:
                found.append(Frame(kind, device, bytes(stream[at : at + whole])))
                at += whole
        del stream[:at]
        self._rest = stream
        return found


def _header(header: bytes) -> tuple[str, str, int]:
    version, kind, device, _, _, size, _ = HEADER.unpack(header)
    name = kind.rstrip(b' \0')
    if version not in _VERSIONS or not name.isascii() or not name.decode('latin1').isprintable():
        raise MessageError(f'not OpenIGTLink: it begins with {header[:14]!r}')
    if size > _LARGEST_SKIPPED:
        raise MessageError(f'not OpenIGTLink: a {name.decode()} message of {size} bytes')
    # Slicer uses names of nodes, which may be truncated within a character.
    return name.decode(), device.rstrip(b' \0').decode(errors='replace'), size


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """Role and address of the connection, the limit of targets, and a plan to show."""

    role: str = choice('server', ('server', 'client'), 'the server waits, the client connects')
    host: str = text(
        '127.0.0.1', 'IPv4 address: as server, address of this machine to listen on (0.0.0.0: all '
        'addresses); as client, address of the peer',
    )  # fmt: skip
    port: int = constant(18944, '1', 'TCP port', low=1.0, high=65535.0, whole=True)
    reach: float = constant(
        0.3, 'm', 'largest accepted distance of a target from the entry point', open_low=True
    )
    plan: str = text(
        '', 'file of a plan (needle plan -o) whose needle is sent to each new peer; empty: none'
    )

    def __post_init__(self) -> None:
        check_constants(self)
        if self.host == 'localhost':
            object.__setattr__(self, 'host', '127.0.0.1')
        try:
            # A name lookup can block.
            IPv4Address(self.host)
        except AddressValueError as error:
            raise ParameterError(
                f'host must be an IPv4 address such as 127.0.0.1, got {self.host!r}'
            ) from error
        object.__setattr__(self, 'port', int(self.port))


class Connection:
    """Connection to a peer, which is restored whenever it is lost; `largest` as in `Frames`."""

    def __init__(
        self,
        settings: LinkSettings,
        largest: Callable[[str, str], int],
        events: EventLog,
        steady: Callable[[], float] = monotonic,
    ) -> None:
        #: Address of the peer, '' without a connection; reason why no connection is possible.
        self.peer = self.error = ''
        #: Number of messages that were dropped because the peer reads too slowly.
        self.left_out = 0
        self._settings, self._largest = settings, largest
        self._events, self._steady = events, steady
        self._listener: socket.socket | None = None
        #: The connection, established or in progress.
        self._socket: socket.socket | None = None
        self._frames = Frames(largest)
        #: Message that a lost connection left incomplete, until it is returned.
        self._lost: list[Frame] = []
        self._out = bytearray()
        #: Times of the last byte that the peer accepted, and of the last attempt to connect.
        self._moved = self._tried = -_RETRY

    @property
    def place(self) -> str:
        return f'{self._settings.host}:{self._settings.port}'

    @property
    def state(self) -> str:
        if self.peer:
            return f'connected with {self.peer}'
        verb = 'waits for a peer on' if self._settings.role == 'server' else 'tries to connect to'
        return self.error or f'{verb} {self.place}'

    def poll(self) -> list[Frame]:
        """
        Restore the connection if necessary, send queued data, and return received messages.

        Accepted messages that are too large, or lost with the connection, have an error.
        """
        found = self._read() if self.peer else []
        if self._settings.role == 'server':
            self._listen()
            self._accept()
        elif not self.peer:
            self._connect()
        self._flush()
        lost, self._lost = self._lost, []
        return found + lost

    def send(self, message: bytes) -> bool:
        """Queue a message (header and body); False without a peer or with a full queue."""
        if not self.peer:
            return False
        if len(self._out) + len(message) > _MOST_WAITING:
            self.left_out += 1
            line = f'{self.peer} reads too slowly: messages are left out'
            self._events.add(Severity.WARNING, line, 'slow')
            return False
        if not self._out:
            self._moved = self._steady()
        self._out += message
        self._flush()
        return True

    def close(self) -> None:
        self._drop()
        if self._listener is not None:
            self._listener.close()
        self._listener, self._tried = None, -_RETRY

    # Connection.

    def _is_time(self) -> bool:
        now = self._steady()
        if now - self._tried < _RETRY:
            return False
        self._tried = now
        return True

    def _listen(self) -> None:
        if self._listener is not None or not self._is_time():
            return
        listener = _new_socket()
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((self._settings.host, self._settings.port))
            listener.listen(_MOST_REJECTED)
        except OSError as error:
            listener.close()
            why = 'the port is in use' if error.errno == EADDRINUSE else _words(error)
            self._report(f'cannot listen on {self.place}: {why}')
            return
        self._listener, self.error = listener, ''
        self._events.add(Severity.INFO, f'listens on {self.place}')

    def _accept(self) -> None:
        listener = self._listener
        for _ in range(_MOST_REJECTED):
            if listener is None:
                return
            try:
                accepted, (host, port) = listener.accept()
            except OSError:
                # No peer, or a connection closed by the peer.
                return
            if self.peer:
                accepted.close()
                line = f'{host}:{port} turned away: {self.peer} is connected'
                self._events.add(Severity.WARNING, line, 'stranger')
            else:
                accepted.setblocking(False)
                self._establish(accepted, f'{host}:{port}')

    def _connect(self) -> None:
        coming = self._socket
        if coming is None:
            if not self._is_time():
                return
            self._socket = coming = _new_socket()
            found = coming.connect_ex((self._settings.host, self._settings.port))
            if found == EINPROGRESS:
                return
        else:
            ready = select.poll()
            ready.register(coming, select.POLLOUT)
            if not ready.poll(0):
                if self._steady() - self._tried > _PATIENCE:
                    self._drop()
                    self._report(f'cannot connect to {self.place}: no answer')
                return
            found = coming.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if found:
            self._drop()
            self._report(f'cannot connect to {self.place}: {os.strerror(found).lower()}')
        else:
            self.error = ''
            self._establish(coming, self.place)

    def _establish(self, connection: socket.socket, peer: str) -> None:
        self._socket, self.peer = connection, peer
        # A connection that is already closed is detected by the next read.
        with suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SYSTEM_BUFFER)
            # A peer that disappears without closing, such as a machine without power.
            connection.setsockopt(
                socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1e3 * _PATIENCE)
            )
        self._events.add(Severity.INFO, f'connected with {peer}', 'connected')

    def _report(self, line: str) -> None:
        if line != self.error:
            self.error = line
            self._events.add(
                Severity.ERROR, f'{line}; tries again every {_RETRY:g} s', 'no connection'
            )

    # Data.

    def _read(self) -> list[Frame]:
        found: list[Frame] = []
        left, end = _MOST_READ, self._steady() + _LONGEST_READ
        while self._socket is not None:
            is_large = self._frames.is_large
            if left <= 0 and not (is_large and self._steady() < end):
                break
            try:
                data = self._socket.recv(_AT_ONCE)
                left -= len(data)
                if data:
                    found += self._frames.take(data)
                else:
                    self._lose('it closed the connection')
            except BlockingIOError:
                # The peer sends the rest of a large message as soon as there is room for it.
                if not is_large or not _is_readable(self._socket, end - self._steady()):
                    break
            except MessageError as error:
                self._events.reject(f'peer {self.peer} refused: {error}')
                self._lose('it sent invalid data')
            except MemoryError:
                self._lose('its message exceeds the memory')
            except OSError as error:
                self._lose(_words(error))
        return found

    def _flush(self) -> None:
        while self._socket is not None and self._out:
            try:
                sent = self._socket.send(self._out)
            except BlockingIOError:
                if self._steady() - self._moved > _PATIENCE:
                    self._lose(f'it has read nothing for {_PATIENCE:g} s')
                return
            except OSError as error:
                self._lose(_words(error))
                return
            del self._out[:sent]
            self._moved = self._steady()

    def _lose(self, why: str) -> None:
        self._lost += self._frames.lost()
        self._events.add(Severity.WARNING, f'{self.peer} is gone: {why}', 'gone')
        self._drop()

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self.peer = None, ''
        self._frames = Frames(self._largest)
        self._out.clear()


def _new_socket() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SYSTEM_BUFFER)
    made.setblocking(False)
    return made


def _is_readable(connection: socket.socket, timeout: float) -> bool:
    """Wait for bytes, at most a time [s]."""
    ready = select.poll()
    ready.register(connection, select.POLLIN)
    return timeout > 0.0 and bool(ready.poll(1e3 * timeout))


def _words(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
