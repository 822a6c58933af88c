"""
One TCP connection, as server or as client. It has no thread, and nothing in it waits.

pyigtl has a server and a client, too. They are not used, because a node could not live with them:
the server takes over SIGINT and SIGTERM, and listens on addresses that it chooses itself. Both
take a whole core when a peer has closed its end, until something is sent; they read whatever size
a header announces, do not compare checksums, send what has waited for a peer since long, and
print tracebacks.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from errno import EADDRINUSE, EINPROGRESS
import os
import select
import socket
from time import monotonic
from typing import Final

from needle_insertion.slicer.frames import Frame, Frames
from needle_insertion.slicer.settings import LinkSettings
from needle_ros.errors import MessageError
from needle_ros.journal import Journal, Severity

#: Time between attempts to listen or to connect [s].
_RETRY: Final = 1.0

#: A peer that takes no byte for so long has gone [s].
_PATIENCE: Final = 5.0

#: What is read at once and in one call of `poll`, and what may wait to be sent [bytes].
_AT_ONCE: Final = 1 << 14
_MOST_READ: Final = 1 << 18
_MOST_WAITING: Final = 1 << 18

#: Buffers of the system: what waits there is old when it arrives [bytes].
_SYSTEM_BUFFER: Final = 1 << 16

#: Strangers that are turned away in one call of `poll`.
_MOST_STRANGERS: Final = 8


class Link:
    """
    Keeps a connection to one peer, and takes it up again whenever it is lost.

    Parameters
    ----------
    settings : LinkSettings
        Where, and who connects.
    wanted : callable
        Returns whether a message of a type and a device name is wanted.
    journal : Journal
        Takes what there is to say.
    steady : callable
        Returns the time of a clock that never jumps [s].

    Attributes
    ----------
    peer : str
        Address of the peer, '' if there is none.
    complaint : str
        Why there can be no peer, '' if there can.
    left_out : int
        Messages that were not sent because the peer reads too slowly.

    """

    def __init__(
        self,
        settings: LinkSettings,
        wanted: Callable[[str, str], bool],
        journal: Journal,
        steady: Callable[[], float] = monotonic,
    ) -> None:
        self.peer = self.complaint = ''
        self.left_out = 0
        self._settings, self._wanted = settings, wanted
        self._journal, self._steady = journal, steady
        self._listener: socket.socket | None = None
        #: The connection, or one that is being made.
        self._socket: socket.socket | None = None
        self._frames = Frames(wanted, journal.refuse)
        self._out = bytearray()
        #: When the peer took something last, and when there was an attempt last.
        self._moved = self._tried = -_RETRY

    @property
    def place(self) -> str:
        """Address and port of the settings."""
        return f'{self._settings.host}:{self._settings.port}'

    @property
    def state(self) -> str:
        """Whether there is a peer, in words."""
        if self.peer:
            return f'connected with {self.peer}'
        verb = 'waits for a peer on' if self._settings.role == 'server' else 'tries to connect to'
        return self.complaint or f'{verb} {self.place}'

    def poll(self) -> list[Frame]:
        """
        Take up a connection if there is none, read what has come, and send what waits.

        Returns
        -------
        list of Frame
            The wanted messages that have come.

        """
        found = self._read() if self.peer else []
        if self._settings.role == 'server':
            self._listen()
            self._accept()
        elif not self.peer:
            self._connect()
        self._flush()
        return found

    def send(self, message: bytes) -> bool:
        """
        Send a message, all of it or nothing.

        Parameters
        ----------
        message : bytes
            Header and body.

        Returns
        -------
        bool
            Whether it is on its way; False if there is no peer, or one that reads too slowly.

        """
        if not self.peer:
            return False
        if len(self._out) + len(message) > _MOST_WAITING:
            self.left_out += 1
            self._journal.say(
                Severity.WARNING, f'{self.peer} reads too slowly: messages are left out', 'slow'
            )
            return False
        if not self._out:
            self._moved = self._steady()
        self._out += message
        self._flush()
        return True

    def close(self) -> None:
        """End the connection, and listen no more."""
        for one in (self._socket, self._listener):
            if one is not None:
                one.close()
        self._forget()
        self._listener, self._tried = None, -_RETRY

    # A peer comes.

    def _is_time(self) -> bool:
        now = self._steady()
        if now - self._tried < _RETRY:
            return False
        self._tried = now
        return True

    def _listen(self) -> None:
        """Open the port, if it is not open."""
        if self._listener is not None or not self._is_time():
            return
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SYSTEM_BUFFER)
            listener.setblocking(False)
            listener.bind((self._settings.host, self._settings.port))
            listener.listen(_MOST_STRANGERS)
        except OSError as error:
            listener.close()
            why = 'the port is in use' if error.errno == EADDRINUSE else _words(error)
            self._complain(f'cannot listen on {self.place}: {why}')
            return
        self._listener, self.complaint = listener, ''
        self._journal.say(Severity.INFO, f'listens on {self.place}')

    def _accept(self) -> None:
        """Take the first who comes, and turn all others away."""
        listener = self._listener
        for _ in range(_MOST_STRANGERS):
            if listener is None:
                return
            try:
                came, (host, port) = listener.accept()
            except OSError:
                # Nobody, or one who has gone again.
                return
            if self.peer:
                came.close()
                self._journal.say(
                    Severity.WARNING,
                    f'{host}:{port} turned away: {self.peer} is connected',
                    'stranger',
                )
            else:
                came.setblocking(False)
                self._greet(came, f'{host}:{port}')

    def _connect(self) -> None:
        """Begin to connect, or see how it goes."""
        coming = self._socket
        if coming is None:
            if not self._is_time():
                return
            coming = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            coming.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SYSTEM_BUFFER)
            coming.setblocking(False)
            self._socket = coming
            found = coming.connect_ex((self._settings.host, self._settings.port))
            if found == EINPROGRESS:
                return
        else:
            ready = select.poll()
            ready.register(coming, select.POLLOUT)
            if not ready.poll(0):
                if self._steady() - self._tried > _PATIENCE:
                    self._drop()
                    self._complain(f'cannot connect to {self.place}: no answer')
                return
            found = coming.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if found:
            self._drop()
            self._complain(f'cannot connect to {self.place}: {os.strerror(found).lower()}')
        else:
            self.complaint = ''
            self._greet(coming, self.place)

    def _greet(self, connection: socket.socket, peer: str) -> None:
        """Begin with a peer."""
        self._socket, self.peer = connection, peer
        self._frames = Frames(self._wanted, self._journal.refuse)
        # Whoever has gone already is found out when something is read.
        with suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SYSTEM_BUFFER)
            # One who has gone without a word, such as a machine without power.
            connection.setsockopt(
                socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1e3 * _PATIENCE)
            )
        self._journal.say(Severity.INFO, f'connected with {peer}', 'connected')

    def _complain(self, line: str) -> None:
        """Say why there can be no peer, once."""
        if line != self.complaint:
            self.complaint = line
            self._journal.say(
                Severity.ERROR, f'{line}; tries again every {_RETRY:g} s', 'no connection'
            )

    # A peer is there.

    def _read(self) -> list[Frame]:
        """Read what has come, a bounded part of it at once."""
        found: list[Frame] = []
        for _ in range(_MOST_READ // _AT_ONCE):
            if self._socket is None:
                break
            try:
                data = self._socket.recv(_AT_ONCE)
                if data:
                    found += self._frames.take(data)
                else:
                    self._lose('it closed the connection')
            except BlockingIOError:
                break
            except MessageError as error:
                self._journal.refuse(f'peer {self.peer} refused: {error}')
                self._lose('what it says cannot be understood')
            except OSError as error:
                self._lose(_words(error))
        return found

    def _flush(self) -> None:
        """Send what waits, as far as it goes without waiting."""
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
        """End with the peer, and say so."""
        self._journal.say(Severity.WARNING, f'{self.peer} is gone: {why}', 'gone')
        self._drop()

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._forget()

    def _forget(self) -> None:
        self._socket, self.peer = None, ''
        self._out.clear()


def _words(error: OSError) -> str:
    """Return what the system says of an error."""
    return (error.strerror or str(error)).lower()
